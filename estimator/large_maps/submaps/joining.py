"""Joining of closed submaps: one map in the world by sparse Gauss-Newton.

Submaps share neither measurements nor motion noise, so they are independent, and the
map is the least-squares solution of all their factors.  A landmark in several submaps
is one unknown, which fuses the submaps and closes loops.  A landmark in a single submap
is not an unknown; it follows from the others.  All factors are linearised at one point,
the solution, so that the map gains no information about its own position and
orientation.  Frame 0 is the start of the run, and fixed.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from scipy.linalg import lapack
from scipy.sparse import coo_array

from ....arrays import Array, IntArray
from ...models.rigid_motion import ErrorFrame, compose, pose_rotation
from ..elimination import Quadratic, SubmapElimination, dissect
from ..multifrontal import pairs
from .factor import (
    FactorError,
    Gaussian,
    factor_error,
    gradient,
    inverse_spread,
    quadratic,
    regularised,
    times,
)
from .store import Submap

# Decrement at which to stop: the step is then below 1e-4 standard deviations.
CONVERGED = 1e-9
# A part of the map with more entries per unknown uses the covariance of all unknowns.
MANY = 0.75
# Number of submaps whose factors are kept from one iteration to the next: 40 MB.
MOST_KEPT = 500


class JoinedMap:
    """All closed submaps in one map.

    Parameters
    ----------
    load : callable
        Returns a submap by its index.
    summaries : sequence of SubmapSummary
        Of the K submaps.
    error_frame : {"additive", "invariant"}
        Coordinates of the submaps' errors.
    frames : ndarray, shape (K + 1, 3)
        Initial values of the frames in the world.  Frame 0 is fixed, and the active
        submap begins at the last frame.
    converged : float
        The decrement, in squared standard deviations, at which to stop.
    trusted : float
        The decrement at which one more step is the last. The map is not linearised
        after it, and only its frames and landmarks are up to date.

    Raises
    ------
    numpy.linalg.LinAlgError
        If Gauss-Newton does not converge.
    """

    def __init__(
        self,
        load: Callable[[int], Submap],
        summaries: Sequence[SubmapSummary],
        error_frame: ErrorFrame,
        frames: Array,
        converged: float = CONVERGED,
        trusted: float = 0.0,
    ) -> None:
        self._load, self._error_frame = load, error_frame
        slots = [summary.slots for summary in summaries]
        holders = np.bincount(np.concatenate(slots))
        self._owner = np.full(len(holders), -1)
        for index, held in enumerate(slots):
            self._owner[held] = index
        is_shared = holders > 1
        self._place = np.where(is_shared, np.cumsum(is_shared) - 1, -1)
        shared = np.flatnonzero(is_shared)
        self._shared = [places[places >= 0] for places in map(self._place.take, slots)]
        # Rows of pose and shared landmarks in the states of the submaps.
        self._rows = [
            np.concatenate([np.arange(3), 3 + pairs(np.flatnonzero(places >= 0))])
            for places in map(self._place.take, slots)
        ]
        self._count = len(slots)
        self.frames = frames
        self._points = points_seen(summaries, frames, len(holders))[shared]
        self._unknowns = [self._unknowns_of(k) for k in range(self._count)]
        self._parts = dissect(self._unknowns, frames[:-1, :2])
        self._elimination: SubmapElimination | None = None
        # m̂, L⁻¹ and P⁻¹ of submaps, until the first marginal.
        self._kept: dict[int, tuple[Array, Array, Array]] = {}
        values = np.concatenate([frames[1:].ravel(), self._points.ravel()])
        is_slow = trusted > 0 or self._count > MOST_KEPT
        correct = None if is_slow else self._correct
        found = minimise(self._linearise, values, converged, trusted, correct)
        if found is None:
            raise np.linalg.LinAlgError(
                f"the joined map did not converge in "
                f"{ITERATIONS} iterations: the submaps contradict each "
                "other, as after a wrong landmark_id, or drifted too far"
            )
        self._move(found)

    @property
    def nbytes(self) -> int:
        """Memory of the joined map, without the submaps [bytes]."""
        return self._factors.nbytes + self.frames.nbytes + self._points.nbytes

    def marginal(self, slots: IntArray) -> Gaussian:
        """Return the last frame and some landmarks, given frame 0.

        Parameters
        ----------
        slots : ndarray of int, shape (v,)
            Of landmarks in closed submaps.
        """
        mean, cut = np.zeros(3 + 2 * len(slots)), 3 * self._count
        mean[:3] = self.frames[-1]
        place = self._place[slots]
        fused = np.flatnonzero(place >= 0)
        rows = np.concatenate([np.arange(3), 3 + pairs(fused)])
        columns = np.concatenate([cut - 3 + np.arange(3), cut + pairs(place[fused])])
        mean[rows[3:]] = self._points[place[fused]].ravel()
        others = np.flatnonzero(place < 0)
        owners = self._owner[slots[others]]
        owned: list[Owned] = []
        for k in np.unique(owners).tolist():
            held = others[owners == k]
            private, where = self._private_landmarks(k, slots[held]), 3 + pairs(held)
            mean[where] = private.points
            owned.append(Owned(where, self._unknowns[k], private))
        self._kept.clear()
        is_large = len(slots) > 0 and len(mean) > MANY * (cut + self._points.size)
        covariance = self._large_covariance if is_large else self._small_covariance
        return Gaussian(mean, *covariance(len(mean), rows, columns, owned))

    def _small_covariance(
        self, size: int, rows: IntArray, columns: IntArray, owned: Sequence[Owned]
    ) -> tuple[Array]:
        """Return the covariance of a small part of the map, from the factors.

        Parameters
        ----------
        size : int
            Length of its state.
        rows, columns : ndarray, shape (v,)
            Entries of the state that are unknowns, and the indices of these unknowns.
        owned : sequence of Owned
            The other entries, by submap.
        """
        own = np.zeros((size, size))
        entries = [(columns, rows, np.ones(len(rows)))]
        for where, unknowns, private in owned:
            own[where[:, None], where] = private.covariance
            at = np.broadcast_arrays(unknowns, where[:, None])
            entries.append((at[0].ravel(), at[1].ravel(), private.jacobian.ravel()))
        at_unknowns, at_rows, values = map(np.concatenate, zip(*entries, strict=True))
        shape = (size, 3 * self._count + self._points.size)
        A = coo_array((values, (at_rows, at_unknowns)), shape).tocsc()
        return (own + self._factors.covariance(A),)

    def _large_covariance(
        self, size: int, rows: IntArray, columns: IntArray, owned: Sequence[Owned]
    ) -> tuple[Array, IntArray]:
        """Return the covariance of a large part, and the column of each of its entries.

        The other unknowns follow after the part. For the parameters, see
        `_small_covariance`.
        """
        number = np.full(3 * self._count + self._points.size, -1)
        number[columns] = rows
        others = number < 0
        total = size + int(others.sum())
        number[others] = np.arange(size, total)
        found = self._factors.inverse(number, total)
        for where, unknowns, private in owned:
            at = number[unknowns]
            found.append(where, at, private.jacobian, private.covariance)
        return found.matrix, found.places[:size]

    @property
    def _factors(self) -> SubmapElimination:
        assert self._elimination is not None
        return self._elimination

    def _linearise(self, values: Array) -> Iterate:
        """Set the unknowns to these values, and factorise the normal equations."""
        self._move(values)
        self._elimination = None  # frees the memory of the old factor first
        done = SubmapElimination(self._parts, len(values), self._normal_equations)
        self._elimination = done
        return Iterate(values, done.cost, done.decrement(), done.solution())

    def _correct(self, values: Array) -> tuple[float, Array]:
        """Return decrement and step at these values, with the last factor."""
        self._move(values)
        g = np.zeros(len(values))
        for k, unknowns in enumerate(self._unknowns):
            mean, root = self._whitening(k)
            g[unknowns] += gradient(self._error(k, mean), root, is_first=k == 0)
        return self._factors.solve(g)

    def _move(self, values: Array) -> None:
        cut = 3 * self._count
        self.frames = np.vstack([self.frames[:1], values[:cut].reshape(-1, 3)])
        self._points = values[cut:].reshape(-1, 2)

    def _normal_equations(self, index: int) -> Quadratic:
        """Return the squared error of a submap as a function of its unknowns."""
        kept = self._kept.get(index)
        if kept is None:
            mean, root = self._whitening(index)
            kept = mean, root, root.T @ root
            if self._count <= MOST_KEPT:
                self._kept[index] = kept
        mean, root, information = kept
        found = self._error(index, mean)
        return quadratic(found, root, information, is_first=index == 0)

    def _whitening(self, index: int) -> tuple[Array, Array]:
        """Return m̂ of the shared part of a submap, and L⁻¹, where L Lᵀ = P."""
        if index in self._kept:
            return self._kept[index][:2]
        submap, rows = self._load(index), self._rows[index]
        lower = np.linalg.cholesky(regularised(submap.covariance, rows))
        return submap.mean[rows], lapack.dtrtri(lower.T, overwrite_c=1)[0].T

    def _error(self, k: int, mean: Array) -> FactorError:
        """Return the error of the shared part of a submap, and its Jacobian."""
        points = self._points[self._shared[k]].ravel()
        world = np.concatenate([self.frames[k + 1], points])
        return factor_error(self.frames[k], world, mean, self._error_frame)

    def _unknowns_of(self, index: int) -> IntArray:
        """Return the unknowns of a submap: two frames, one if it is the first."""
        frames = np.arange(3 * max(index - 1, 0), 3 * index + 3)
        return np.concatenate([frames, 3 * self._count + pairs(self._shared[index])])

    def _private_landmarks(self, index: int, wanted: IntArray) -> PrivateLandmarks:
        mean, root = self._whitening(index)
        found = private_landmarks(
            self._load(index),
            (self._rows[index], root),
            wanted,
            self.frames[index],
            self._error(index, mean),
            self._error_frame,
        )
        return found if index else found._replace(jacobian=found.jacobian[:, 3:])


# --------------------------------------------------------------------------------------
# Initial values of the frames of submaps, by divide and conquer.
#
# Gauss-Newton needs initial values near the right minimum, and composing the frames one
# by one drifts too far from it.  Blocks of submaps, and blocks of blocks, are therefore
# aligned as rigid bodies with the landmarks that they share, and joined first where
# their heading may drift.  Block boundaries follow the binary digits of the number of
# submaps, so that most blocks can be reused when the map grows by one submap.

Refine = Callable[[int, int, Array], Array]

# Up to this many submaps, composing their frames is accurate enough.
LARGEST_COMPOSED = 4
# Standard deviation of the heading along a block up to which the block is not joined:
# Gauss-Newton on the whole map then takes no more steps [rad].
SMALL_TURN = 0.1


class SubmapSummary(NamedTuple):
    """The part of a closed submap that stays in memory."""

    slots: IntArray  # its landmarks, shape (n,)
    mean: Array  # as in the submap, shape (3 + 2n,)
    pose_covariance: Array  # covariance of its last pose, shape (3, 3)

    @property
    def nbytes(self) -> int:
        """Memory of the arrays [bytes]."""
        return sum(part.nbytes for part in self)


def summarise(submap: Submap) -> SubmapSummary:
    """Return the part of a submap that stays in memory."""
    return SubmapSummary(submap.slots, submap.mean, submap.covariance[:3, :3].copy())


class FrameInitialisation:
    """Initial frames, with a cache of joined blocks.

    The result depends only on the arguments, not on the cache.

    Parameters
    ----------
    blocks : mapping, optional
        The cache of one for fewer submaps.
    """

    def __init__(self, blocks: Mapping[tuple[int, int], Array] | None = None) -> None:
        self.blocks = dict(blocks or {})

    def frames(
        self, summaries: Sequence[SubmapSummary], known: Array, refine: Refine
    ) -> Array:
        """Return initial values of all frames in the world, shape (K + 1, 3).

        Parameters
        ----------
        summaries : sequence of SubmapSummary
            The K closed submaps.
        known : ndarray, shape (J + 1, 3)
            Frames of an earlier join; at least the start.
        refine : callable
            Returns improved frames a to b, given (a, b, frames).
        """
        first = len(known) - 1
        frames, size = known, 1
        while 2 * size <= len(summaries) - first:
            size *= 2
        begin = first
        while begin < len(summaries):
            while begin + size > len(summaries):
                size //= 2
            block = self._block(summaries, begin, begin + size, refine)
            frames = _merged(summaries, begin - len(frames) + 1, frames, block)
            begin += size
        return frames

    def _block(
        self, summaries: Sequence[SubmapSummary], a: int, b: int, refine: Refine
    ) -> Array:
        """Return the frames a to b relative to frame a."""
        if (a, b) not in self.blocks:
            if b - a <= LARGEST_COMPOSED:
                frames = [np.zeros(3)]
                for summary in summaries[a:b]:
                    frames.append(compose(frames[-1], summary.mean[:3])[0])
                rough = np.array(frames)
            else:
                middle = (a + b) // 2
                left = self._block(summaries, a, middle, refine)
                right = self._block(summaries, middle, b, refine)
                rough = _merged(summaries, a, left, right)
                del self.blocks[a, middle], self.blocks[middle, b]
            turned = sum(s.pose_covariance[2, 2] for s in summaries[a:b])
            is_rough = turned > SMALL_TURN**2
            self.blocks[a, b] = refine(a, b, rough) if is_rough else rough
        return self.blocks[a, b]


def points_seen(summaries: Sequence[SubmapSummary], frames: Array, count: int) -> Array:
    """Return the landmarks at the positions of the first submap that holds each.

    Parameters
    ----------
    summaries : sequence of SubmapSummary
    frames : ndarray, shape (K, 3) or more
        Of these submaps.
    count : int
        Number of slots.

    Returns
    -------
    ndarray, shape (count, 2)
        NaN for landmarks that no submap holds [m].
    """
    points = np.full((count, 2), np.nan)
    last_first = summaries[::-1]  # of several positions, the last one is kept
    slots = np.concatenate([summary.slots for summary in last_first])
    landmarks = np.concatenate([summary.mean[3:] for summary in last_first])
    counts = [len(summary.slots) for summary in last_first]
    x, y, heading = np.repeat(frames[len(summaries) - 1 :: -1], counts, axis=0).T
    seen = x + 1j * y + np.exp(1j * heading) * landmarks.view(np.complex128)
    points[slots] = seen.view(np.float64).reshape(-1, 2)
    return points


def _merged(
    summaries: Sequence[SubmapSummary], first: int, left: Array, right: Array
) -> Array:
    """Align the right frames with the left ones, which begin at submap ``first``."""
    middle = first + len(left) - 1
    start = left[-1]
    if middle > first:
        before = summaries[first:middle]
        after = summaries[middle : middle + len(right) - 1]
        count = 1 + max(int(o.slots.max(initial=0)) for o in [*before, *after])
        goal = points_seen(before, left, count)
        seen = points_seen(after, right, count)
        common = np.flatnonzero(~np.isnan(goal[:, 0] + seen[:, 0]))
        start = align(start, before[-1].pose_covariance, seen[common], goal[common])
    moved = start + right @ pose_rotation(start[2]).T
    return np.concatenate([left[:-1], moved])


def align(start: Array, covariance: Array, seen: Array, landmarks: Array) -> Array:
    """Align a frame with landmarks by least squares.

    Each landmark has the same weight as the expected position of the frame.

    Parameters
    ----------
    start, covariance : ndarray, shapes (3,) and (3, 3)
        Expected frame.
    seen : ndarray, shape (n, 2)
        Landmarks in the frame [m].
    landmarks : ndarray, shape (n, 2)
        The same landmarks in the world [m].

    Returns
    -------
    ndarray, shape (3,)

    Examples
    --------
    >>> seen = np.array([[1.0, 0.0], [2.0, 0.0], [3.0, 1.0]])
    >>> align(np.zeros(3), np.diag([1.0, 1.0, 1e-9]), seen, seen + [0.0, 1.0]).round(2)
    array([0.  , 0.75, 0.  ])
    """
    prior = np.linalg.inv(regularised(covariance, np.arange(3)))
    weight = 2 / max(covariance[0, 0] + covariance[1, 1], 1e-18)
    q, goal = seen[:, 0] + 1j * seen[:, 1], landmarks[:, 0] + 1j * landmarks[:, 1]
    pose = start.copy()
    for _ in range(5):
        turned = np.exp(1j * pose[2]) * q
        error = goal - complex(*pose[:2]) - turned
        rows = np.zeros((2 * len(q), 3))
        rows[0::2, 0] = rows[1::2, 1] = 1.0
        rows[:, 2] = (1j * turned).view(np.float64)
        H = prior + weight * rows.T @ rows
        right = prior @ (start - pose) + weight * rows.T @ error.view(np.float64)
        pose = pose + np.linalg.solve(H, right)
    return pose


class Owned(NamedTuple):
    """Landmarks of a single submap in a part of the map."""

    where: IntArray  # (2n,) their entries in the state
    unknowns: IntArray  # (u,) of the submap
    private: PrivateLandmarks


class PrivateLandmarks(NamedTuple):
    """n landmarks of a single submap, in the world."""

    points: Array  # (2n,) [m]
    jacobian: Array  # by frames and shared landmarks of the submap, shape (2n, u)
    covariance: Array  # conditional covariance given these unknowns, shape (2n, 2n)


def private_landmarks(
    submap: Submap,
    shared: tuple[IntArray, Array],
    wanted: IntArray,
    start: Array,
    factor: FactorError,
    frame: ErrorFrame,
) -> PrivateLandmarks:
    """Transform landmarks that only one submap holds into the world.

    Given the error e_b of the shared part, their error is e_p = G e_b + w, with noise
    w::

        G = P_pb P_bb⁻¹,    cov w = P_pp − G P_bp,    P_bb = L Lᵀ
        Y_p = V(t) (G e_b + w) + R(t) m̂_p,     l = p_k + R(θ_k) Y_p

    Parameters
    ----------
    submap : Submap
    shared : tuple of two ndarrays
        Rows of the pose and the shared landmarks in the submap's state; L⁻¹.
    wanted : ndarray, shape (n,)
        Slots of the landmarks.
    start : ndarray, shape (3,)
        Frame of the submap in the world.
    factor : FactorError
        e_b.
    frame : {"additive", "invariant"}
        Coordinates of the error.
    """
    turn = float(factor.error[2])
    sorter = np.argsort(submap.slots)
    rows = 3 + pairs(sorter[np.searchsorted(submap.slots, wanted, sorter=sorter)])
    P = submap.covariance
    whitened = shared[1] @ P[shared[0][:, None], rows]
    G = whitened.T @ shared[1]
    points = submap.mean[rows[::2]] + 1j * submap.mean[rows[1::2]]
    moved = (G @ factor.error).view(np.complex128)
    by_unknowns = factor.through(G)
    scale = 1.0 + 0.0j
    if frame == "additive":
        seen = points + moved
    else:
        scale, slope = inverse_spread(turn)
        turned = np.exp(1j * turn) * points
        seen = turned + moved / scale
        by_turn = slope * (seen - turned) - 1j * scale * turned
        # ∂t/∂θ_k = −1, ∂t/∂θ_{k+1} = 1
        by_unknowns[:, 2] += by_turn.view(np.float64)
        by_unknowns[:, 5] -= by_turn.view(np.float64)
    out = np.exp(1j * start[2])
    by_unknowns = times(out / scale, by_unknowns)
    by_unknowns[0::2, 0] += 1.0
    by_unknowns[1::2, 1] += 1.0
    by_unknowns[:, 2] += (1j * out * seen).view(np.float64)
    noise = P[rows[:, None], rows] - whitened.T @ whitened
    noise = times(out / scale, times(out / scale, noise).T)
    world = complex(*start[:2]) + out * seen
    return PrivateLandmarks(world.view(np.float64), by_unknowns, (noise + noise.T) / 2)


# --------------------------------------------------------------------------------------
# Gauss-Newton iteration with step halving and Anderson acceleration.

ITERATIONS, HALVINGS, MEMORY = 200, 8, 5
# Below a decrement of `CLOSE`, steps use the last linearisation while each multiplies
# the decrement by at most `SLOW`.  They take a third of the time, and stop at `CLOSER`
# times the decrement at which the iteration stops.
CLOSE, SLOW, CLOSER = 1e3, 0.1, 1e-2
# Iterations after which an extrapolated step only has to lower the cost.
#
# Where large errors remain at the solution, as after improbable readings, plain steps
# approach it slowly, and their decrement rises and falls on the way.
PATIENCE = 30


class Iterate(NamedTuple):
    """One iterate of Gauss-Newton."""

    values: Array  # all unknowns, shape (N,)
    cost: float  # sum of the squared errors, in standard deviations
    decrement: float  # decrease of the cost by a full step in a linear problem
    step: Array

    @property
    def largest_cost(self) -> float:
        """Largest cost that the next iterate may have, allowing for rounding."""
        return self.cost * (1 + 1e-9) + 1e-9


Correct = Callable[[Array], tuple[float, Array]]


def minimise(
    evaluate: Callable[[Array], Iterate],
    values: Array,
    converged: float,
    trusted: float = 0.0,
    correct: Correct | None = None,
) -> Array | None:
    """Iterate until the decrement is small; return the values, or None if it is not.

    Parameters
    ----------
    evaluate : callable
        Linearises the problem at given values.  Its last call is at the result, except
        after the step that ``trusted`` describes.
    values : ndarray, shape (N,)
        Where to begin.
    converged : float
        The decrement at which to stop.
    trusted : float
        The decrement at which to stop after one more step, without evaluating it.
    correct : callable, optional
        Returns decrement and step at given values, with the last linearisation.
    """
    now = evaluate(values)
    past: list[Iterate] = []
    for iteration in range(ITERATIONS):
        if now.decrement <= converged:
            return now.values
        if now.decrement <= trusted:
            return now.values + now.step
        if correct is not None and now.decrement < CLOSE:
            near = evaluate(_corrected(correct, now, converged))
            if near.decrement > SLOW * now.decrement:
                correct = None
            if near.decrement < now.decrement and near.cost <= now.largest_cost:
                now = near
                continue
        past = [*past[-MEMORY:], now] if now.decrement < 1 else []
        largest = np.inf if iteration >= PATIENCE else now.decrement
        trial = _accelerated(evaluate, past, largest)
        now = _descend(evaluate, now) if trial is None else trial
    return None


def _corrected(correct: Correct, now: Iterate, converged: float) -> Array:
    """Step with one linearisation as long as the decrement falls fast."""
    values, last = now.values + now.step, now.decrement
    while last > CLOSER * converged:
        decrement, step = correct(values)
        if decrement > SLOW * last:
            break
        values, last = values + step, decrement
    return values


def _accelerated(
    evaluate: Callable[[Array], Iterate], past: list[Iterate], largest: float
) -> Iterate | None:
    """Step from the last iterates; None where that lowers too little."""
    if len(past) < 2:
        return None
    now = past[-1]
    trial = evaluate(now.values + accelerated(past))
    is_better = trial.cost <= now.largest_cost and trial.decrement < largest
    return trial if is_better else None


def _descend(evaluate: Callable[[Array], Iterate], now: Iterate) -> Iterate:
    """Take the largest of the halved steps that does not increase the cost."""
    for halving in range(HALVINGS):
        trial = evaluate(now.values + now.step / 2**halving)
        if trial.cost <= now.largest_cost:
            break
    return trial


def accelerated(past: Sequence[Iterate]) -> Array:
    """Return a step extrapolated from the last iterates (Anderson acceleration [1]_).

    Parameters
    ----------
    past : sequence of Iterate
        The last iterates, two or more.

    References
    ----------
    .. [1] D. G. Anderson, Iterative procedures for nonlinear integral equations,
       Journal of the ACM 12(4), 1965.

    Examples
    --------
    Each step of this iteration is half the previous one; the limit is 8:

    >>> values = [0.0, 4.0]
    >>> past = [Iterate(np.array([v]), 0, 0, np.array([(8 - v) / 2])) for v in values]
    >>> (values[-1] + accelerated(past)).round(12)
    array([8.])
    """
    moves = np.diff([iterate.values for iterate in past], axis=0)
    changes = np.diff([iterate.step for iterate in past], axis=0)
    step = past[-1].step
    weights = np.linalg.lstsq(changes.T, step)[0]
    return np.asarray(step - weights @ (moves + changes))
