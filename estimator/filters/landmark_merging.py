"""Merge two landmarks of a Gaussian map: their offset, and the condition that it is 0.

Pure functions of mean (3 + 2n,) and covariance P (3 + 2n, 3 + 2n) in the order
(x, y, θ, l1x, l1y, …); a landmark is named by its slot 0 … n − 1.
"""

from typing import NamedTuple

import numpy as np

from ...arrays import Array, ComplexArray
from ..error_frames import ErrorFrame
from ..models.rigid_motion import left_jacobian


class ConditionedMap(NamedTuple):
    """Mean and covariance of robot and map after conditioning."""

    mean: Array
    """Shape (3 + 2n,)."""
    covariance: Array
    """Shape (3 + 2n, 3 + 2n), of the additive error."""


class Separation(NamedTuple):
    """Offset of two landmarks and its covariance."""

    offset: Array
    """D = l_i − l_j, shape (2,) [m]."""
    covariance: Array
    """C, shape (2, 2) [m²]."""

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
    one: int,
    other: int,
    *,
    frame: ErrorFrame = "additive",
    reference: Array | None = None,
) -> ConditionedMap:
    """Condition a map on two of its landmarks being one.

    The condition is a measurement 0 = l_i − l_j without noise.  With D = l̂_i − l̂_j::

        H = [… −J D …  I … −I …],   S = H P Hᵀ = L Lᵀ,   A = L⁻¹ H P
        δ = −Aᵀ L⁻¹ D,    P ← P − Aᵀ A

    The columns are those of θ, l_i and l_j.  The condition holds no information about a
    rotation of the whole map, and neither must H.  Its heading column is therefore
    −J D, with D taken at the points where the filter linearises.  The additive EKF has
    no heading column, since the condition is linear in its error.  In the invariant
    frame δ is composed with the state and P follows, as in
    :class:`~slamgym.estimator.filters.invariant.InvariantEkfSlam`.

    Parameters
    ----------
    mean, covariance : ndarray
        The map.
    one, other : int
        Slots i and j of the two landmarks.
    frame : {"additive", "invariant"}
        Error frame of the filter.
    reference : ndarray, shape (3 + 2n,), optional
        Points at which the filter linearises, where not at its estimate.

    Returns
    -------
    ConditionedMap
        Both landmarks have the same mean and covariance in it; drop either.

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
    i, j = 3 + 2 * one, 3 + 2 * other
    offset = mean[i : i + 2] - mean[j : j + 2]
    rows = covariance[i : i + 2] - covariance[j : j + 2]
    if frame == "invariant" or reference is not None:
        at = mean if reference is None else reference
        dx, dy = at[i : i + 2] - at[j : j + 2]
        rows = rows + np.outer((dy, -dx), covariance[2])
        S = rows[:, i : i + 2] - rows[:, j : j + 2]
        S = S + np.outer(rows[:, 2], (dy, -dx))
    else:
        S = rows[:, i : i + 2] - rows[:, j : j + 2]
    L = np.linalg.cholesky((S + S.T) / 2)
    white = np.linalg.solve(L, np.column_stack([rows, -offset]))
    gains, shift = white[:, :-1], white[:, :-1].T @ white[:, -1]
    P = covariance - np.outer(gains[0], gains[0]) - np.outer(gains[1], gains[1])
    if frame == "additive":
        return ConditionedMap(mean + shift, P)
    return _composed(mean, P, shift)


def _composed(mean: Array, covariance: Array, shift: Array) -> ConditionedMap:
    """Compose an invariant correction with the state, and transform P to match.

    ::

        q ← R(t) q + V(t) (δq − t J q),    θ ← θ + t,    t = δθ
        P ← T P Tᵀ,    T = I + v e_θᵀ,    v = J (q⁺ − q)
    """
    turn = shift[2]
    points, moves = _points(mean), _points(shift)
    turned = np.exp(1j * turn) * points
    moved = turned + left_jacobian(turn) * (moves - 1j * turn * points)
    way = _state(1j * (moved - points), 0.0)
    cross = np.outer(way, covariance[2])
    P = covariance + (cross + cross.T) + covariance[2, 2] * np.outer(way, way)
    return ConditionedMap(_state(moved, mean[2] + turn), P)


def _points(state: Array) -> ComplexArray:
    """Robot position and landmarks as complex numbers, shape (1 + n,)."""
    plane = np.delete(state, 2).reshape(-1, 2)
    return np.asarray(plane[:, 0] + 1j * plane[:, 1])


def _state(points: ComplexArray, heading: float) -> Array:
    flat = np.column_stack([points.real, points.imag]).ravel()
    return np.insert(flat, 2, heading)
