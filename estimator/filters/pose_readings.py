"""Condition a Gaussian map: on its pose, on a place, or on landmarks being one.

`PoseReading` is a reading of the pose.  Below it are pure functions of mean (3 + 2n,)
and covariance P (3 + 2n, 3 + 2n) in the order (x, y, θ, l1x, l1y, …); a landmark is
named by its slot 0 … n − 1.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ... import argument_checks
from ...arrays import Array, IntArray
from ..beliefs import Belief, UpdateReport
from ..kernels.scan_update import Rules
from ..models.bearing_range import wrap_angle
from ..models.relative_geometry import lever_of
from ..models.rigid_motion import ErrorFrame, left_jacobian, points_of, state_of

MOST_ITERATIONS = 50
STEP_TOLERANCE = 1e-10  # iterations of a pose end when it moves by less [m, rad]
TURN_TOLERANCE = 1e-13  # iterations of a turn end when it changes by less [rad]


class ConditionedMap(NamedTuple):
    """Mean and covariance of robot and map after conditioning."""

    mean: Array  # (3 + 2n,)
    covariance: Array  # (3 + 2n, 3 + 2n), of the additive error


# --------------------------------------------------------------------------------------
# A reading of the pose: compass, GPS, or any other linear function of (x, y, θ).


class PoseReport(UpdateReport):
    """The results of a reading of the pose, stored outside the filter's memory."""

    is_detached = False

    def detach(self) -> None:
        """Change nothing: the results are copies."""


class PoseReading(NamedTuple):
    """A reading z = H (x, y, θ) + w of the pose, w of covariance R.

    A component that depends on the heading alone is an angle: its innovation is
    wrapped.
    """

    #: z, shape (k,), or (B, k) of B runs.
    value: Array
    #: H, shape (k, 3).
    matrix: Array
    #: R, shape (k, k), positive definite.
    covariance: Array

    @classmethod
    def checked(
        cls,
        value: ArrayLike,
        matrix: ArrayLike,
        covariance: ArrayLike,
        runs: tuple[int, ...] = (),
    ) -> PoseReading:
        """Return the reading, or refuse it; ``runs`` are the leading axes of z."""
        H = argument_checks.as_floats("matrix", matrix)
        H = H[None] if H.ndim == 1 else H
        size = len(H)
        z = argument_checks.as_floats("reading", value)
        R = argument_checks.as_floats("covariance", covariance)
        z = z.reshape(*runs, 1) if size == 1 and z.shape == runs else z
        R = R.reshape(1, 1) if size == 1 and R.size == 1 else R
        for name, array, shape in (
            ("matrix", H, (size, 3)),
            ("reading", z, (*runs, size)),
            ("covariance", R, (size, size)),
        ):
            if array.shape != shape or not size:
                raise ValueError(f"{name} must have shape {shape}, got {array.shape}")
            if not np.isfinite(array).all():
                raise ValueError(f"{name} must be finite, got {array.tolist()}")
            argument_checks.refuse_beyond(name, array, array.tolist())
        if not np.allclose(R, R.T) or np.linalg.eigvalsh(R)[0] <= 0:
            raise ValueError(
                f"covariance must be symmetric and positive definite, got {R.tolist()}"
            )
        return cls(z.copy(), H.copy(), (R + R.T) / 2)

    def innovation(self, pose: Array) -> Array:
        """Return z − H (x, y, θ) at poses (..., 3), shape (..., k), angles wrapped."""
        difference = self.value - pose @ self.matrix.T
        is_angle = ~self.matrix[:, :2].any(axis=1)
        return np.where(is_angle, wrap_angle(difference), difference)

    def of(self, runs: IntArray) -> PoseReading:
        """Return the readings of some runs."""
        return self._replace(value=self.value[runs])

    def correct(
        self, mean: Array, covariance: Array, *, frame: ErrorFrame, once: bool
    ) -> ObservedMap:
        """Condition beliefs (..., 3 + 2n) on the reading, see :func:`observe`."""
        H, R, nu = self.matrix, self.covariance, self.innovation(mean[..., :3])
        return observe(mean, covariance, H, R, nu, frame=frame, once=once)

    def rows(self) -> list[tuple[float, float, float]]:
        """Return the reading as rows of three numbers; the first ends with −k."""
        size = len(self.matrix)
        table = np.zeros((2 + 2 * size, 3))
        table[0, 2], table[1, :size] = -size, self.value
        table[2 : 2 + size], table[2 + size :, :size] = self.matrix, self.covariance
        return [(a, b, c) for a, b, c in table.tolist()]

    @classmethod
    def of_rows(cls, rows: Sequence[Sequence[float]]) -> PoseReading:
        """Return the reading whose :meth:`rows` follow the first, 1 + 2k of them."""
        table, size = np.array(rows), len(rows) // 2
        return cls(table[0, :size], table[1 : 1 + size], table[1 + size :, :size])


def gate_of(rules: Rules, size: int) -> float:
    """Return the χ² quantile of the gate for another number of components."""
    if rules.gate == np.inf:
        return np.inf
    from scipy.special import gammainc, gammaincinv  # noqa: PLC0415 (slow to import)

    probability = gammainc(rules.numbers / 2, rules.gate / 2)
    return 2 * float(gammaincinv(size / 2, probability))


class ObservedMap(NamedTuple):
    """A belief after a reading of the pose or of a place; may have leading axes."""

    #: Shape (n,).
    mean: Array
    #: Shape (n, n).
    covariance: Array
    #: ν at the prior, shape (k,).
    innovation: Array
    #: L, shape (k, k), L Lᵀ = S.
    factor: Array
    #: νᵀ S⁻¹ ν, shape ().
    nis: Array

    def report(self) -> PoseReport:
        """Return the report of the reading."""
        return PoseReport(
            nis=float(self.nis),
            degrees_of_freedom=len(self.innovation),
            innovation=self.innovation,
            factor=self.factor,
        )


def observe(
    mean: Array,
    covariance: Array,
    H: Array,
    R: Array,
    nu: Array,
    *,
    frame: ErrorFrame = "additive",
    once: bool = False,
) -> ObservedMap:
    """Condition beliefs on a linear reading of their first components.

    ::

        S = H P Hᵀ + R = L Lᵀ,   A = L⁻¹ H P,   δ = Aᵀ L⁻¹ ν,   P ← P − Aᵀ A

    In the invariant frame δ is composed with the state and P follows, as in
    :class:`~slamgym.estimator.InvariantEkfSlam`.  There the slopes depend on the
    position p at which the reading is linearised, and p̂ of the prior::

        H_δ = H [I  J (p − p̂); 0  1]

    They are those of the corrected position, found by iteration with the same prior
    and ν − H (x ⊕ δ − x) + H_δ δ in place of ν.  Two readings at one place then have
    the same slopes, and do not appear to observe the heading.

    Parameters
    ----------
    mean, covariance : ndarray, shape (..., n) and (..., n, n)
        The beliefs; entries behind them must be zero.
    H : ndarray, shape (k, m)
        ∂h of the first m components of the state; m = 3 where it is iterated.
    R : ndarray, shape (k, k)
        Noise of the reading.
    nu : ndarray, shape (..., k)
        ν = z − h(x) at the prior.
    frame : {"additive", "invariant"}
        Error frame of the filter.
    once : bool
        Whether to leave out the iterations.  Where they do not end, they are left out
        as well.
    """
    m = H.shape[1]
    L, gains = _whitened(covariance, H, R)
    white = np.linalg.solve(L, nu[..., None])
    shift = (_turned(gains) @ white)[..., 0]
    nis = np.asarray((white**2).sum(axis=(-2, -1)))
    if frame == "additive":
        return ObservedMap(mean + shift, _reduced(covariance, gains), nu, L, nis)
    first, moves = (shift, gains), np.ones(nis.shape, dtype=np.bool_)
    for _ in range(0 if once else MOST_ITERATIONS):
        way = moves_of(shift[..., :m])
        slopes = slopes_at(H, way[..., :2])
        root, rows = _whitened(covariance, slopes, R)
        again = nu - way @ H.T
        again = again[..., None] + slopes @ shift[..., :m, None]
        after = (_turned(rows) @ np.linalg.solve(root, again))[..., 0]
        change = np.abs(after[..., :3] - shift[..., :3]).max(axis=-1)
        shift = np.where(moves[..., None], after, shift)
        gains = np.where(moves[..., None, None], rows, gains)
        moves = moves & (change > STEP_TOLERANCE)
        if not moves.any():
            break
    shift = np.where(moves[..., None], first[0], shift)
    gains = np.where(moves[..., None, None], first[1], gains)
    return ObservedMap(*retracted(mean, _reduced(covariance, gains), shift), nu, L, nis)


def _reduced(covariance: Array, gains: Array) -> Array:
    """Return P − Aᵀ A."""
    return np.asarray(covariance - _turned(gains) @ gains)


def _whitened(covariance: Array, H: Array, R: Array) -> tuple[Array, Array]:
    """Return L, the factor of S = H P Hᵀ + R, and A = L⁻¹ H P."""
    m = H.shape[-1]
    rows = H @ covariance[..., :m, :]
    L = np.asarray(np.linalg.cholesky(rows[..., :m] @ _turned(H) + R))
    return L, np.asarray(np.linalg.solve(L, rows))


def slopes_at(H: Array, moved: Array) -> Array:
    """Return H_δ where the position has moved (..., 2) from the prior [m]."""
    lever = lever_of(moved)  # J (p − p̂)
    slopes = np.broadcast_to(H, (*moved.shape[:-1], *H.shape)).copy()
    slopes[..., 2] += lever @ H[:, :2].T
    return slopes


def observe_relative_pose(
    belief: Belief, pose: Array, slots: IntArray, covariance: Array
) -> ObservedMap:
    """Condition a belief on a pose relative to the centroid and turn of landmarks.

    With d = l − c of the landmarks l around their centroid c, a pose (p, θ) that keeps
    its place among k landmarks moves with them by ::

        e_θ = Σ (J d)ᵀ e_l / Σ ‖d‖²,    e_p = Σ e_l / k + J (p − c) e_θ

    H are the slopes of the difference.  The innovation is taken at the given pose; in
    the invariant frame it is an error of SE(2) and H that at the prior.

    Parameters
    ----------
    belief : Belief
    pose : ndarray, shape (3,)
        (x, y, θ) if the landmarks are where they are estimated [m, m, rad].
    slots : ndarray of int, shape (k,)
        Places of the landmarks in the belief, two at least.
    covariance : ndarray, shape (3, 3)
        R, of the noise.
    """
    landmarks, k = belief.landmarks[slots], len(slots)
    centre, nu, at = landmarks.mean(axis=0), pose - belief.pose, pose[:2]
    nu[2] = wrap_angle(float(nu[2]))
    if belief.frame == "invariant":
        nu[:2] = state_of(points_of(nu) / left_jacobian(nu[2]), nu[2])[:2]
        at = belief.pose[:2]
    turned = lever_of(landmarks - centre).ravel()
    turned, lever = turned / max((turned**2).sum(), 1e-12), lever_of(at - centre)
    H, columns = np.eye(3, len(belief.mean)), _columns(slots.tolist())
    H[2, columns] = -turned
    H[:2, columns] = -np.tile(np.eye(2) / k, k) - np.outer(lever, turned)
    arguments = belief.mean, belief.covariance, H, covariance, nu
    return observe(*arguments, frame=belief.frame, once=True)


# --------------------------------------------------------------------------------------
# Landmarks that are one.


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
        If S is not positive definite, or in the invariant frame no turn is found.

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
        lever = lever_of((at[i] - at[j]).reshape(-1, 2)).ravel()
        rows = rows - np.outer(lever, covariance[2])
        S = rows[:, i] - rows[:, j] - np.outer(rows[:, 2], lever)
    else:
        S = rows[:, i] - rows[:, j]
    L = np.linalg.cholesky((S + S.T) / 2)
    gains = np.linalg.solve(L, rows)
    P = covariance - gains.T @ gains
    if frame == "additive":
        return ConditionedMap(mean - gains.T @ np.linalg.solve(L, offset), P)
    return retracted(mean, P, _turned_shift(L, gains, offset))


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
    if not abs(turn) < 2 * np.pi:  # where V(−t)⁻¹ does not exist
        raise np.linalg.LinAlgError("the landmarks are too far apart to coincide")
    return np.asarray(-gains.T @ white)


def _columns(slots: int | Sequence[int]) -> IntArray:
    """Return the columns of landmarks in the state."""
    first = 3 + 2 * np.atleast_1d(np.asarray(slots, dtype=np.int64))
    return np.asarray((first[:, None] + np.arange(2)).ravel())


def retracted(mean: Array, covariance: Array, shift: Array) -> ConditionedMap:
    """Compose an invariant correction δ with states, and transform P to match.

    ::

        q ← R(t) q + V(t) (δq − t J q) = q + V(t) δq,    θ ← θ + t,    t = δθ
        P ← T P Tᵀ,    T = I + v e_θᵀ,    v = J (q⁺ − q)
    """
    moves = moves_of(shift)
    way = state_of(1j * points_of(moves), np.zeros(mean.shape[:-1]))[..., None]
    cross = way * covariance[..., 2:3, :]
    square = covariance[..., 2:3, 2:3] * (way * _turned(way))
    return ConditionedMap(mean + moves, covariance + (cross + _turned(cross)) + square)


def moves_of(shift: Array) -> Array:
    """Return the way x ⊕ δ − x of every coordinate, over any leading axes."""
    turn = shift[..., 2]
    return state_of(left_jacobian(turn)[..., None] * points_of(shift), turn)


def _turned(matrices: Array) -> Array:
    return np.swapaxes(matrices, -1, -2)
