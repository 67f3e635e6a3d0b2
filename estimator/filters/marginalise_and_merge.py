"""Edit a Gaussian map: take landmarks out of it, make two of them one.

Pure functions of mean (3 + 2n,) and covariance P (3 + 2n, 3 + 2n) in the order
(x, y, θ, l1x, l1y, …); a landmark is named by its slot 0 … n − 1.
"""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from ...arrays import Array, ComplexArray
from ..error_frames import ErrorFrame
from ..models.rigid_motion import left_jacobian


class ConditionedMap(NamedTuple):
    """Mean and covariance of robot and map after a condition."""

    mean: Array
    """Shape (3 + 2n,)."""
    covariance: Array
    """Shape (3 + 2n, 3 + 2n), of the additive error."""


class Separation(NamedTuple):
    """How far two landmarks lie from each other, and how well that is known."""

    offset: Array
    """l_i − l_j, shape (2,) [m]."""
    covariance: Array
    """C of it, shape (2, 2) [m²]."""

    @property
    def squared(self) -> float:
        """Dᵀ C⁻¹ D, χ² of 2 degrees of freedom if both are one; infinite without C."""
        (a, b), (_, c) = self.covariance
        determinant = a * c - b * b
        if not determinant > 0:
            return np.inf
        x, y = self.offset
        return float((c * x * x - 2 * b * x * y + a * y * y) / determinant)

    @property
    def largest_std(self) -> float:
        """Standard deviation in the direction known worst [m]."""
        return float(np.sqrt(max(np.linalg.eigvalsh(self.covariance)[-1], 0.0)))


def without_landmarks(array: Array, slots: Iterable[int]) -> Array:
    """Drop the entries of landmarks from a mean, or rows and columns from a covariance.

    To leave out entries of a Gaussian is to marginalise them: all other numbers keep
    their last bit.

    Parameters
    ----------
    array : ndarray, shape (3 + 2n,) or (3 + 2n, 3 + 2n)
    slots : iterable of int
        The landmarks to drop.

    Examples
    --------
    >>> without_landmarks(np.arange(7.0), [0])
    array([0., 1., 2., 5., 6.])
    """
    columns = [column for slot in slots for column in (3 + 2 * slot, 4 + 2 * slot)]
    for axis in range(array.ndim):
        array = np.delete(array, columns, axis=axis)
    return array


def separation(mean: Array, covariance: Array, one: int, other: int) -> Separation:
    """Return the offset of two landmarks and its covariance.

    ::

        D = l_i − l_j,    C = P_ii + P_jj − P_ij − P_ji

    Parameters
    ----------
    mean, covariance : ndarray
        The map; entries beyond it do no harm.
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
    """Condition a map on two of its landmarks being one: a reading of distance zero.

    The reading 0 = l_i − l_j has no noise.  With D = l̂_i − l̂_j::

        H = [… −J D …  I … −I …],   S = H P Hᵀ = L Lᵀ,   A = L⁻¹ H P
        δ = −Aᵀ L⁻¹ D,    P ← P − Aᵀ A

    The columns are those of θ, l_i and l_j.  The reading does not tell a turn of the
    whole map, and H must not either: its heading column, which multiplies an offset
    that is but noise, is J D with D taken at the points where the filter linearises.
    The additive EKF has none there, for it is linear in its own error.  In the
    invariant frame δ is composed with the state, and P carried along, as
    :class:`~slamgym.estimator.filters.invariant.InvariantEkfSlam` does.

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
        In it both landmarks have the same mean and covariance; drop either.

    Raises
    ------
    numpy.linalg.LinAlgError
        If C is not positive definite: then nothing can be said of their distance.

    Examples
    --------
    Two equally good estimates of one landmark meet halfway, twice as certain:

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
    """Compose an invariant correction with the state, and carry P along.

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
