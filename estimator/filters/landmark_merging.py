"""Merge landmarks of a Gaussian map: their offset, and the condition that it is 0.

Pure functions of mean (3 + 2n,) and covariance P (3 + 2n, 3 + 2n) in the order
(x, y, θ, l1x, l1y, …); a landmark is named by its slot 0 … n − 1.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...arrays import Array, IntArray
from ..models.rigid_motion import ErrorFrame, left_jacobian, points_of, state_of

MOST_ITERATIONS = 50
TURN_TOLERANCE = 1e-13  # iterations of a turn end when it changes by less [rad]


class ConditionedMap(NamedTuple):
    """Mean and covariance of robot and map after conditioning."""

    mean: Array  # (3 + 2n,)
    covariance: Array  # (3 + 2n, 3 + 2n), of the additive error


class Separation(NamedTuple):
    """Offset of two landmarks and its covariance."""

    offset: Array  # D = l_i − l_j, shape (2,) [m]
    covariance: Array  # C, shape (2, 2) [m²]

    @property
    def squared(self) -> float:
        """Dᵀ C⁻¹ D: χ² of 2 degrees of freedom if both are one; ∞ if C is singular."""
        (a, b), (_, c) = self.covariance
        determinant = a * c - b * b
        if not determinant > 0:
            return np.inf
        x, y = self.offset
        return float((c * x * x - 2 * b * x * y + a * y * y) / determinant)

    @property
    def largest_std(self) -> float:
        """Standard deviation in the most uncertain direction [m]."""
        return float(np.sqrt(max(np.linalg.eigvalsh(self.covariance)[-1], 0.0)))


def separation(mean: Array, covariance: Array, one: int, other: int) -> Separation:
    """Return the offset of two landmarks and its covariance.

    ::

        D = l_i − l_j,    C = P_ii + P_jj − P_ij − P_ji

    Parameters
    ----------
    mean, covariance : ndarray
        The map; entries behind it are ignored.
    one, other : int
        Slots i and j.
    """
    i, j = slice(3 + 2 * one, 5 + 2 * one), slice(3 + 2 * other, 5 + 2 * other)
    cross = covariance[i, j]
    spread = covariance[i, i] + covariance[j, j] - cross - cross.T
    return Separation(mean[i] - mean[j], spread)


def coincide(
    mean: Array,
    covariance: Array,
    one: int | Sequence[int],
    other: int | Sequence[int],
    *,
    frame: ErrorFrame = "additive",
    reference: Array | None = None,
) -> ConditionedMap:
    """Condition a map on two of its landmarks being one, or on several such pairs.

    The condition is a measurement 0 = l_i − l_j without noise.  With D = l̂_i − l̂_j::

        H = [… −J D …  I … −I …],   S = H P Hᵀ = L Lᵀ,   A = L⁻¹ H P
        δ = −Aᵀ L⁻¹ M D,    P ← P − Aᵀ A

    The columns are those of θ, l_i and l_j.  The condition holds no information about a
    rotation of the whole map, and neither must H.  Its heading column is therefore
    −J D, with D taken at the points where the filter linearises.  The additive EKF has
    no heading column, since the condition is linear in its error, and M = 1.  In the
    invariant frame δ is composed with the state and P follows, as in
    :class:`~slamgym.estimator.InvariantEkfSlam`.  There the condition
    R(t) D + V(t) (ξ_i − ξ_j) = 0 holds for M = V(−t)⁻¹, where t is the turn in δ, which
    is found by iteration.  Several pairs have their rows of D and H below each other.

    Parameters
    ----------
    mean, covariance : ndarray
        The map.
    one, other : int or sequence of int
        Slots i and j of the two landmarks, or of each pair.
    frame : {"additive", "invariant"}
        Error frame of the filter.
    reference : ndarray, shape (3 + 2n,), optional
        Points at which the filter linearises, where not at its estimate.

    Returns
    -------
    ConditionedMap
        Both landmarks of a pair have the same mean and covariance in it; drop either.

    Raises
    ------
    numpy.linalg.LinAlgError
        If C is not positive definite.

    Examples
    --------
    Two equally good estimates of one landmark meet halfway, with half the variance:

    >>> P = np.diag([0, 0, 0, 1.0, 1.0, 1.0, 1.0])
    >>> mean, P = coincide(np.array([0, 0, 0, 4.0, 0, 6.0, 0]), P, 0, 1)
    >>> mean[3:], P.diagonal()[3:]
    (array([5., 0., 5., 0.]), array([0.5, 0.5, 0.5, 0.5]))
    """
    i, j = _columns(one), _columns(other)
    offset = mean[i] - mean[j]
    rows = covariance[i] - covariance[j]
    if frame == "invariant" or reference is not None:
        at = mean if reference is None else reference
        lever = (at[i] - at[j]).reshape(-1, 2)[:, ::-1] * (1.0, -1.0)
        lever = lever.ravel()
        rows = rows + np.outer(lever, covariance[2])
        S = rows[:, i] - rows[:, j] + np.outer(rows[:, 2], lever)
    else:
        S = rows[:, i] - rows[:, j]
    L = np.linalg.cholesky((S + S.T) / 2)
    gains = np.linalg.solve(L, rows)
    P = covariance - gains.T @ gains
    if frame == "additive":
        return ConditionedMap(mean - gains.T @ np.linalg.solve(L, offset), P)
    shift = _turned_shift(L, gains, offset)
    return composed(mean, P, shift)


def _turned_shift(
    L: NDArray[np.floating], gains: NDArray[np.floating], offset: Array
) -> Array:
    """Return δ, iterated until its turn is the one at which M was computed."""
    points, turn = offset[::2] + 1j * offset[1::2], 0.0
    for _ in range(MOST_ITERATIONS):
        seen = points / left_jacobian(np.array(-turn))
        flat = np.column_stack([seen.real, seen.imag]).ravel()
        white = np.linalg.solve(L, flat)
        before, turn = turn, float(-gains[:, 2] @ white)
        if abs(turn - before) <= TURN_TOLERANCE:
            break
    return np.asarray(-gains.T @ white)


def _columns(slots: int | Sequence[int]) -> IntArray:
    """Return the columns of landmarks in the state."""
    first = 3 + 2 * np.atleast_1d(np.asarray(slots, dtype=np.int64))
    return np.asarray((first[:, None] + np.arange(2)).ravel())


def composed(mean: Array, covariance: Array, shift: Array) -> ConditionedMap:
    """Compose an invariant correction with the state, and transform P to match.

    ::

        q ← R(t) q + V(t) (δq − t J q),    θ ← θ + t,    t = δθ
        P ← T P Tᵀ,    T = I + v e_θᵀ,    v = J (q⁺ − q)
    """
    turn = shift[2]
    points, moves = points_of(mean), points_of(shift)
    turned = np.exp(1j * turn) * points
    moved = turned + left_jacobian(turn) * (moves - 1j * turn * points)
    way = state_of(1j * (moved - points), 0.0)
    cross = np.outer(way, covariance[2])
    P = covariance + (cross + cross.T) + covariance[2, 2] * np.outer(way, way)
    return ConditionedMap(state_of(moved, mean[2] + turn), P)
