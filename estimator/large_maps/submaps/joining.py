"""Joining closed submaps: one map in the world, found by sparse Gauss-Newton.

Submaps that share no reading and no noise are independent; so the map that they make
together is the least-squares solution of all that they say of frames and landmarks.  A
landmark in several submaps is one unknown: that fuses them and closes loops.
Landmarks of a single submap need not be unknowns: they follow from the others.
All is linearised at one point, the solution, so that nothing is learnt about where the
map as a whole lies and how it is turned; frame 0 is where the run began, and fixed.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_solve
from scipy.sparse import coo_array

from ...error_frames import ErrorFrame
from ..sparse_cholesky.coordinates import pairs
from ..sparse_cholesky.submap_dissection import dissect
from ..sparse_cholesky.submap_elimination import Quadratic, SubmapElimination
from .factor import floor, inverse_spread, points_of, relation, whitened
from .frame_initialisation import Outline, points_seen
from .store import Submap

Array = NDArray[np.float64]
Int = NDArray[np.int64]

ITERATIONS, HALVINGS, MEMORY = 100, 8, 5
CONVERGED = 1e-9
"""Of the decrement: the step is then below 1e-4 standard deviations."""


class Gaussian(NamedTuple):
    """Of a pose and landmarks, of the additive error."""

    mean: Array
    """Shape (3 + 2n,)."""
    covariance: Array
    """Shape (3 + 2n, 3 + 2n)."""


class Alone(NamedTuple):
    """The landmarks that a single submap holds, in the world."""

    slots: Int
    points: Array
    """Shape (2n,) [m]."""
    jacobian: Array
    """By the unknowns of the submap, shape (2n, u)."""
    covariance: Array
    """Their own, given these unknowns, shape (2n, 2n)."""


class Point(NamedTuple):
    """One iterate of Gauss-Newton."""

    values: Array
    """Of all unknowns, shape (N,)."""
    cost: float
    """Sum of the squared errors, in standard deviations."""
    decrement: float
    """What the step would take from it, were all linear."""
    step: Array


class JoinedMap:
    """All closed submaps in one map.

    Parameters
    ----------
    load : callable
        Gives a submap by its index.
    outlines : sequence of Outline
        Of the K submaps.
    frame : {"additive", "invariant"}
        Coordinates of the submaps' errors.
    frames : ndarray, shape (K + 1, 3)
        First guess of the frames in the world, the last being where the present
        submap begins; frame 0 is taken as it is.
    converged : float
        The decrement, in squared standard deviations, at which to stop.

    Raises
    ------
    numpy.linalg.LinAlgError
        Where Gauss-Newton does not converge.
    """

    def __init__(
        self,
        load: Callable[[int], Submap],
        outlines: Sequence[Outline],
        frame: ErrorFrame,
        frames: Array,
        converged: float = CONVERGED,
    ) -> None:
        self._load, self._error_frame = load, frame
        slots = [outline.slots for outline in outlines]
        self._slots, self._converged = slots, converged
        touched = np.bincount(np.concatenate(slots))
        self._owner = np.full(len(touched), -1)
        for index, mine in enumerate(slots):
            self._owner[mine] = index
        shared = touched > 1
        self._place = np.where(shared, np.cumsum(shared) - 1, -1)
        self._shared = np.flatnonzero(shared)
        self.size = 3 * len(slots) + 2 * len(self._shared)
        self.frames = frames
        self._points = points_seen(outlines, frames, len(touched))[self._shared]
        self._parts = dissect(
            [self._unknowns(k) for k in range(len(slots))], frames[:-1, :2]
        )
        self._elimination: SubmapElimination | None = None
        self._settle()

    @property
    def nbytes(self) -> int:
        """Memory that it takes, the submaps not counted [bytes]."""
        return self._factors.nbytes + self.frames.nbytes + self._points.nbytes

    def marginal(self, slots: Int) -> Gaussian:
        """Return the last frame and some landmarks, given frame 0.

        Parameters
        ----------
        slots : ndarray of int, shape (v,)
            Of landmarks in closed submaps.
        """
        count, size = len(self._slots), 3 + 2 * len(slots)
        mean, own = np.zeros(size), np.zeros((size, size))
        mean[:3] = self.frames[-1]
        place = self._place[slots]
        fused = np.flatnonzero(place >= 0)
        rows = np.concatenate([np.arange(3), 3 + pairs(fused)])
        columns = [3 * count - 3 + np.arange(3), 3 * count + pairs(place[fused])]
        mean[rows[3:]] = self._points[place[fused]].ravel()
        found = [(np.concatenate(columns), rows, np.ones(len(rows)))]
        others = np.flatnonzero(place < 0)
        owners = self._owner[slots[others]]
        for k in np.unique(owners).tolist():
            mine = others[owners == k]
            alone, where = self._alone(k, slots[mine]), 3 + pairs(mine)
            mean[where] = alone.points
            own[where[:, None], where] = alone.covariance
            at = np.broadcast_arrays(self._unknowns(k), where[:, None])
            found.append((at[0].ravel(), at[1].ravel(), alone.jacobian.ravel()))
        unknowns, rows, values = map(np.concatenate, zip(*found, strict=True))
        A = coo_array((values, (rows, unknowns)), (size, self.size)).tocsc()
        own += self._factors.covariance(A)
        return Gaussian(mean, own)

    def _settle(self) -> None:
        """Gauss-Newton; where it creeps, the last steps foretell the next ones."""
        now = self._at(self._unknown_values())
        past: list[Point] = []
        for _ in range(ITERATIONS):
            if now.decrement <= self._converged:
                return
            past = [*past[-MEMORY:], now] if now.decrement < 1 else []
            bold = self._at(now.values + accelerated(past)) if len(past) > 1 else None
            if bold and bold.cost <= _most(now) and bold.decrement < now.decrement:
                now = bold
            else:
                now = self._descended(now)
        raise np.linalg.LinAlgError(
            f"the joined map did not converge in {ITERATIONS} iterations: the submaps "
            "contradict each other, as after a wrong landmark_id, or drifted too far"
        )

    def _descended(self, now: Point) -> Point:
        for halving in range(HALVINGS):
            trial = self._at(now.values + now.step / 2**halving)
            if trial.cost <= _most(now):
                break
        return trial

    @property
    def _factors(self) -> SubmapElimination:
        assert self._elimination is not None
        return self._elimination

    def _unknown_values(self) -> Array:
        return np.concatenate([self.frames[1:].ravel(), self._points.ravel()])

    def _at(self, values: Array) -> Point:
        """Move to these values of the unknowns, and linearise there."""
        cut = 3 * len(self._slots)
        self.frames = np.vstack([self.frames[:1], values[:cut].reshape(-1, 3)])
        self._points = values[cut:].reshape(-1, 2)
        self._elimination = None  # it may be large: never two of them
        done = SubmapElimination(self._parts, self.size, self._say)
        self._elimination = done
        return Point(values, done.cost, done.decrement(), done.solution())

    def _say(self, index: int) -> Quadratic:
        """Return what a submap says of its unknowns, at the present point."""
        submap = self._load(index)
        kept = _state(self._place[submap.slots] >= 0)
        error, jacobian = self._relation(index, submap.mean[kept])
        W = whitened(
            submap.covariance[kept[:, None], kept], np.column_stack([jacobian, error])
        )
        J, w = W[:, :-1], W[:, -1]
        return J.T @ J, -J.T @ w, float(w @ w)

    def _relation(self, index: int, mean: Array) -> tuple[Array, Array]:
        """Error of the part of a submap that is unknown, and its derivative."""
        place = self._place[self._slots[index]]
        world = np.concatenate(
            [self.frames[index + 1], self._points[place[place >= 0]].ravel()]
        )
        error, jacobian = relation(self.frames[index], world, mean, self._error_frame)
        return error, jacobian if index else jacobian[:, 3:]

    def _unknowns(self, index: int) -> Int:
        place = self._place[self._slots[index]]
        frames = np.arange(3 * max(index - 1, 0), 3 * index + 3)
        return np.concatenate([frames, 3 * len(self._slots) + pairs(place[place >= 0])])

    def _alone(self, index: int, wanted: Int) -> Alone:
        """Bring landmarks that only this submap holds into the world.

        Their error e_p given that of the rest, e_b, is G e_b and noise w::

            G = P_pb P_bb⁻¹,    cov w = P_pp − G P_bp
            Y_p = V(t) (G e_b + w) + R(t) m̂_p,     l = p_k + R(θ_k) Y_p
        """
        submap = self._load(index)
        base = _state(self._place[submap.slots] >= 0)
        by_slot = {slot: place for place, slot in enumerate(submap.slots.tolist())}
        mine = 3 + pairs(np.array([by_slot[s] for s in wanted.tolist()]))
        P = submap.covariance
        P_bb, P_bp = P[base[:, None], base], P[base[:, None], mine]
        lower = np.linalg.cholesky(P_bb + floor(P_bb))
        G = cho_solve((lower, True), P_bp, check_finite=False).T
        error, jacobian = self._relation(index, submap.mean[base])
        points = submap.mean[mine[::2]] + 1j * submap.mean[mine[1::2]]
        moved = (G @ error).view(np.complex128)
        by_rest = G @ jacobian
        scale = 1.0 + 0.0j
        if self._error_frame == "additive":
            seen = points + moved
        else:
            turn = float(error[2])
            scale, slope = inverse_spread(turn)
            turned = np.exp(1j * turn) * points
            seen = turned + moved / scale
            by_turn = slope * (seen - turned) - 1j * scale * turned
            by_rest -= np.outer(by_turn.view(np.float64), jacobian[2])
        start = self.frames[index]
        out = np.exp(1j * start[2])
        by_rest = times(out / scale, by_rest)
        if index:
            by_rest[0::2, 0] += 1.0
            by_rest[1::2, 1] += 1.0
            by_rest[:, 2] += (1j * out * seen).view(np.float64)
        noise = P[mine[:, None], mine] - G @ P_bp
        noise = times(out / scale, times(out / scale, noise).T)
        world = complex(*start[:2]) + out * seen
        return Alone(wanted, world.view(np.float64), by_rest, (noise + noise.T) / 2)


def accelerated(past: Sequence[Point]) -> Array:
    """Return a step that foresees how the steps of an iteration shrink [1]_.

    Parameters
    ----------
    past : sequence of Point
        The last iterates, two or more.

    References
    ----------
    .. [1] D. G. Anderson, Iterative procedures for nonlinear integral equations,
       Journal of the ACM 12(4), 1965.

    Examples
    --------
    Each step of this iteration is half of the last; the limit is 8:

    >>> values = [0.0, 4.0]
    >>> past = [Point(np.array([v]), 0, 0, np.array([(8 - v) / 2])) for v in values]
    >>> (values[-1] + accelerated(past)).round(12)
    array([8.])
    """
    moves = np.diff([point.values for point in past], axis=0)
    changes = np.diff([point.step for point in past], axis=0)
    step = past[-1].step
    weights = np.linalg.lstsq(changes.T, step)[0]
    return np.asarray(step - weights @ (moves + changes))


def _most(point: Point) -> float:
    """Return the cost that the next iterate may have, rounding allowed for."""
    return point.cost * (1 + 1e-9) + 1e-9


def times(factor: complex, rows: Array) -> Array:
    """Multiply pairs of rows, as real and imaginary part, by a complex number."""
    product = factor * (rows[0::2] + 1j * rows[1::2])
    out = np.empty_like(rows)
    out[0::2], out[1::2] = product.real, product.imag
    return out


def _state(kept: NDArray[np.bool_]) -> Int:
    """Rows of a submap's state: the pose, and the landmarks kept."""
    return np.concatenate([np.arange(3), 3 + pairs(np.flatnonzero(kept))])


def with_uncertain_start(map_: Gaussian, start: Array, covariance: Array) -> Gaussian:
    """Let the whole map, pose and landmarks, move and turn with where the run began.

    Parameters
    ----------
    map_ : Gaussian
        Given that the run began at ``start``.
    start, covariance : ndarray, shapes (3,) and (3, 3)
        Where it began.
    """
    lever = 1j * (points_of(map_.mean) - complex(*start[:2]))
    G = np.zeros((len(map_.mean), 3))
    rows = np.r_[0, 3 : len(G) : 2]
    G[rows, 0] = G[rows + 1, 1] = G[2, 2] = 1.0
    G[rows, 2], G[rows + 1, 2] = lever.real, lever.imag
    return Gaussian(map_.mean, map_.covariance + G @ covariance @ G.T)
