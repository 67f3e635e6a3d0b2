"""Expected readings of several landmarks, conditioned on pairs of a scan, compiled.

``shifts[d]`` is h minus h(x) and ``joints[d]`` is C after some pairs, its lower half
only; :mod:`slamgym.estimator.association.joint_assignment` has the equations.
"""

from typing import NamedTuple

import numpy as np

from ...arrays import Array, BoolArray, IntArray
from ..support.jit import jit, njit_internal

UNPAIRED = -1

PAIR_BONUS = 1e6
"""Cost that a pair saves where the number of pairs counts before all else."""


class Problem(NamedTuple):
    """Readings of one scan and the landmarks that they may belong to."""

    innovations: Array
    """ν = z − h(x), shape (m, J, 2), bearings in [-π, π)."""
    joint: Array
    """C = H P Hᵀ of all expected readings, shape (2J, 2J)."""
    variances: Array
    """Diagonal of Q for each reading, shape (m, 2)."""
    feasible: BoolArray
    """Pairs to consider, shape (m, J)."""
    missing: float
    """λ."""
    gate: float
    """Largest νᵀ S⁻¹ ν of a pair, given the pairs before it."""
    limits: Array
    """Largest νᵀ S⁻¹ ν of 0 … m pairs together, shape (m + 1,)."""
    pairs_first: bool
    """Most pairs first, then the least νᵀ S⁻¹ ν, in place of the likelihood."""


@njit_internal
def fit(
    innovation: Array, variance: Array, shift: Array, C: Array, j: int, inflation: float
) -> tuple[float, float]:
    """Return νᵀ S⁻¹ ν and det S of a reading at landmark j, with C times inflation."""
    s00 = inflation * C[2 * j, 2 * j] + variance[0]
    s10 = inflation * C[2 * j + 1, 2 * j]
    s11 = inflation * C[2 * j + 1, 2 * j + 1] + variance[1]
    n0, n1 = innovation[j, 0] - shift[j, 0], innovation[j, 1] - shift[j, 1]
    determinant = s00 * s11 - s10 * s10
    squared = n0 * n0 * s11 - 2 * n0 * n1 * s10 + n1 * n1 * s00
    return squared / determinant, determinant


@njit_internal
def condition(
    innovation: Array,
    variance: Array,
    j: int,
    ahead: IntArray,
    shifts: Array,
    joints: Array,
    here: int,
    to: int,
) -> None:
    """Condition the expected readings of the landmarks ``ahead`` on one pair.

    ::

        h ← h + K (z − h),  C ← C − K C
    """
    C, shift, after, moved = joints[here], shifts[here], joints[to], shifts[to]
    s00 = C[2 * j, 2 * j] + variance[0]
    s10 = C[2 * j + 1, 2 * j]
    s11 = C[2 * j + 1, 2 * j + 1] + variance[1]
    n0, n1 = innovation[j, 0] - shift[j, 0], innovation[j, 1] - shift[j, 1]
    determinant = s00 * s11 - s10 * s10
    cross = np.empty((2 * len(ahead), 2))
    for p in range(2 * len(ahead)):
        a = 2 * ahead[p // 2] + p % 2
        for k in range(2):
            b = 2 * j + k
            cross[p, k] = C[max(a, b), min(a, b)]
    for p in range(2 * len(ahead)):
        a = 2 * ahead[p // 2] + p % 2
        k0 = (cross[p, 0] * s11 - cross[p, 1] * s10) / determinant
        k1 = (cross[p, 1] * s00 - cross[p, 0] * s10) / determinant
        moved[a // 2, a % 2] = shift[a // 2, a % 2] + k0 * n0 + k1 * n1
        for q in range(p + 1):
            b = 2 * ahead[q // 2] + q % 2
            after[a, b] = C[a, b] - k0 * cross[q, 0] - k1 * cross[q, 1]


@jit
def fill_distances(problem: Problem, marks: IntArray, distances: Array) -> None:
    """Find the least νᵀ S⁻¹ ν of each unpaired reading, given the pairs.

    Parameters
    ----------
    problem : Problem
    marks, distances : ndarray, shape (M, m)
        Assignments; the distances are infinite before.
    """
    innovations, joint, variances = problem[:3]
    rows, landmarks = problem[3].shape
    every = np.arange(landmarks)
    shifts = np.zeros((2, landmarks, 2))
    joints = np.empty((2, 2 * landmarks, 2 * landmarks))
    for s in range(len(marks)):
        here = 0
        shifts[0] = 0.0
        joints[0] = joint
        for i in range(rows):
            if marks[s, i] != UNPAIRED:
                condition(
                    innovations[i],
                    variances[i],
                    marks[s, i],
                    every,
                    shifts,
                    joints,
                    here,
                    1 - here,
                )
                here = 1 - here
        for i in range(rows):
            if marks[s, i] == UNPAIRED:
                for j in range(landmarks):
                    x, _ = fit(
                        innovations[i], variances[i], shifts[here], joints[here], j, 1.0
                    )
                    distances[s, i] = min(distances[s, i], x)
