"""Expected readings of several landmarks, conditioned on pairs of a scan, compiled.

``shifts[d]`` is h minus h(x) and ``joints[d]`` is C after some pairs, its lower half
only; :mod:`slamgym.estimator.association.joint_assignment` has the equations.
"""

from typing import NamedTuple

import numpy as np

from ...arrays import Array, BoolArray, IntArray
from ...jit import jit, njit_internal
from ..models.bearing_range import expected_reading_jit, reading_slopes_jit
from ..models.bearing_range import wrap_angle_jit as wrap

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
    missing: Array
    """λ of each reading, shape (m,)."""
    gate: float
    """Largest νᵀ S⁻¹ ν of a pair, given the pairs before it."""
    limits: Array
    """Largest νᵀ S⁻¹ ν of 0 … m pairs together, shape (m + 1,)."""
    pairs_first: bool
    """Most pairs first, then the least νᵀ S⁻¹ ν, in place of the likelihood."""


@jit
def fill_expected(
    mean: Array, P: Array, slots: IntArray, expected: Array, joint: Array
) -> None:
    """Fill h(x), shape (J, 2), and C = H P Hᵀ, shape (2J, 2J), of some landmarks.

    Parameters
    ----------
    mean, P : ndarray
        (x, y, θ, l1x, …) and its covariance; there may be more behind the landmarks.
    slots : ndarray of int64, shape (J,)
        Places of the landmarks in the map.
    """
    H, columns = np.empty((2 * len(slots), 5)), np.empty((len(slots), 5), np.int64)
    columns[:, :3] = np.arange(3)
    for j in range(len(slots)):
        c = 3 + 2 * slots[j]
        columns[j, 3], columns[j, 4] = c, c + 1
        dx, dy = mean[c] - mean[0], mean[c + 1] - mean[1]
        bearing, expected[j, 1] = expected_reading_jit(dx, dy, mean[2])
        expected[j, 0] = wrap(bearing)
        slopes = reading_slopes_jit(dx, dy)
        for i in range(2):
            x, y = slopes[2 * i], slopes[2 * i + 1]
            row = H[2 * j + i]
            row[0], row[1], row[2], row[3], row[4] = -x, -y, i - 1.0, x, y
    left = np.empty(5)
    for a in range(2 * len(slots)):
        for j in range(a // 2 + 1):
            for n in range(5):
                left[n] = 0.0
                for k in range(5):
                    left[n] += H[a, k] * P[columns[a // 2, k], columns[j, n]]
            for b in (2 * j, 2 * j + 1):
                value = 0.0
                for n in range(5):
                    value += left[n] * H[b, n]
                joint[a, b] = joint[b, a] = value


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
    count: int,
    shifts: Array,
    joints: Array,
    here: int,
    to: int,
) -> None:
    """Condition the expected readings of the first ``count`` landmarks on one pair.

    ::

        h ← h + K (z − h),  C ← C − K C
    """
    C, shift, after, moved = joints[here], shifts[here], joints[to], shifts[to]
    s00 = C[2 * j, 2 * j] + variance[0]
    s10 = C[2 * j + 1, 2 * j]
    s11 = C[2 * j + 1, 2 * j + 1] + variance[1]
    n0, n1 = innovation[j, 0] - shift[j, 0], innovation[j, 1] - shift[j, 1]
    determinant = s00 * s11 - s10 * s10
    cross = np.empty((2, 2 * count))
    for k in range(2):
        b = 2 * j + k
        for a in range(2 * count):
            cross[k, a] = C[max(a, b), min(a, b)]
    for a in range(2 * count):
        k0 = (cross[0, a] * s11 - cross[1, a] * s10) / determinant
        k1 = (cross[1, a] * s00 - cross[0, a] * s10) / determinant
        moved[a // 2, a % 2] = shift[a // 2, a % 2] + k0 * n0 + k1 * n1
        row, old = after[a], C[a]
        for b in range(a + 1):
            row[b] = old[b] - k0 * cross[0, b] - k1 * cross[1, b]


@njit_internal
def condition_on_all(
    problem: Problem, marks: IntArray, shifts: Array, joints: Array
) -> int:
    """Condition on all pairs of an assignment; return the level of the result, 0 or 1.

    Parameters
    ----------
    problem : Problem
    marks : ndarray, shape (m,)
        An assignment.
    shifts, joints : ndarray, shapes (2, J, 2) and (2, 2J, 2J)
        Overwritten.
    """
    here, landmarks = 0, problem.feasible.shape[1]
    shifts[0] = 0.0
    joints[0] = problem.joint
    for i in range(len(marks)):
        if marks[i] != UNPAIRED:
            z, q = problem.innovations[i], problem.variances[i]
            condition(z, q, marks[i], landmarks, shifts, joints, here, 1 - here)
            here = 1 - here
    return here


@jit
def fill_distances(problem: Problem, marks: IntArray, distances: Array) -> None:
    """Find the least νᵀ S⁻¹ ν of each unpaired reading to a landmark without one.

    A scan shows a landmark once: a reading beside one that is taken is of another.

    Parameters
    ----------
    problem : Problem
    marks, distances : ndarray, shape (M, m)
        Assignments; the distances are infinite before.
    """
    innovations, variances = problem.innovations, problem.variances
    rows, landmarks = problem.feasible.shape
    shifts = np.empty((2, landmarks, 2))
    joints = np.empty((2, 2 * landmarks, 2 * landmarks))
    taken = np.zeros(landmarks, np.bool_)
    for s in range(len(marks)):
        here = condition_on_all(problem, marks[s], shifts, joints)
        taken[:] = False
        for i in range(rows):
            if marks[s, i] != UNPAIRED:
                taken[marks[s, i]] = True
        for i in range(rows):
            if marks[s, i] == UNPAIRED:
                for j in range(landmarks):
                    if taken[j]:
                        continue
                    x, _ = fit(
                        innovations[i], variances[i], shifts[here], joints[here], j, 1.0
                    )
                    distances[s, i] = min(distances[s, i], x)


@jit
def largest_change(problem: Problem, marks: IntArray, fewer: IntArray) -> float:
    """Bound how much some pairs change any coordinate of the state, in its σ.

    With means μ and deviations σ, after all pairs 1 and without some of them 2, no
    coordinate has a larger √((μ₂ − μ₁)² + σ₂² − σ₁²) / σ₁.  One pair with innovation ν,
    given the others, shifts a coordinate of variance P by at most √(P λ νᵀ S⁻¹ ν) and
    leaves it at least the variance (1 − λ) P::

        λ = largest eigenvalue of S⁻¹ C = 1 − smallest eigenvalue of S⁻¹ Q

    Parameters
    ----------
    problem : Problem
    marks, fewer : ndarray, shape (m,)
        Two assignments.

    Returns
    -------
    float
        Infinite unless ``fewer`` is ``marks`` without some pairs.
    """
    for i in range(len(marks)):
        if fewer[i] != marks[i] and fewer[i] != UNPAIRED:
            return np.inf
    landmarks = problem.feasible.shape[1]
    shifts = np.empty((2, landmarks, 2))
    joints = np.empty((2, 2 * landmarks, 2 * landmarks))
    here = condition_on_all(problem, fewer, shifts, joints)
    shift, variance = 0.0, 1.0  # in the σ after all pairs
    for i in range(len(marks)):
        j = marks[i]
        if fewer[i] == j:
            continue
        z, q, C = problem.innovations[i], problem.variances[i], joints[here]
        x, determinant = fit(z, q, shifts[here], C, j, 1.0)
        s00, s11 = C[2 * j, 2 * j] + q[0], C[2 * j + 1, 2 * j + 1] + q[1]
        half = (s11 * q[0] + s00 * q[1]) / (2 * determinant)
        root = np.sqrt(max(half * half - q[0] * q[1] / determinant, 0.0))
        left = half - root  # 1 − λ
        shift = (shift + np.sqrt(x * (1 - left))) / np.sqrt(left)
        variance /= left
        condition(z, q, j, landmarks, shifts, joints, here, 1 - here)
        here = 1 - here
    return float(np.sqrt(shift * shift + variance - 1))
