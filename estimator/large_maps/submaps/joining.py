"""Joining of closed submaps: one map in the world by sparse Gauss-Newton.

Submaps share neither measurements nor motion noise, so they are independent, and the
map is the least-squares solution of all their factors.  A landmark in several submaps
is one unknown, which fuses the submaps and closes loops.  A landmark in a single submap
is not an unknown; it follows from the others.  All factors are linearised at one point,
the solution, so that the map gains no information about its own position and
orientation.  Frame 0 is the start of the run, and fixed.
"""

from collections.abc import Callable, Sequence

import numpy as np
from scipy.sparse import coo_array

from ....arrays import Array, IntArray
from ...models.rigid_motion import ErrorFrame
from ..sparse_cholesky.coordinates import pairs
from ..sparse_cholesky.submap_dissection import dissect
from ..sparse_cholesky.submap_elimination import Quadratic, SubmapElimination
from . import gauss_newton
from .factor import FactorError, factor_error, whitened
from .frame_initialisation import SubmapSummary, points_seen
from .gauss_newton import Iterate, minimise
from .gaussian import Gaussian
from .private_landmarks import PrivateLandmarks, private_landmarks
from .store import Submap

CONVERGED = 1e-9
"""Decrement at which to stop: the step is then below 1e-4 standard deviations."""


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
        self._count = len(slots)
        self.frames = frames
        self._points = points_seen(summaries, frames, len(holders))[shared]
        self._parts = dissect(
            [self._unknowns(k) for k in range(self._count)], frames[:-1, :2]
        )
        self._elimination: SubmapElimination | None = None
        values = np.concatenate([frames[1:].ravel(), self._points.ravel()])
        if not minimise(self._linearise, values, converged):
            raise np.linalg.LinAlgError(
                f"the joined map did not converge in "
                f"{gauss_newton.ITERATIONS} iterations: the submaps contradict each "
                "other, as after a wrong landmark_id, or drifted too far"
            )

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
        size, cut = 3 + 2 * len(slots), 3 * self._count
        mean, own = np.zeros(size), np.zeros((size, size))
        mean[:3] = self.frames[-1]
        place = self._place[slots]
        fused = np.flatnonzero(place >= 0)
        rows = np.concatenate([np.arange(3), 3 + pairs(fused)])
        columns = np.concatenate([cut - 3 + np.arange(3), cut + pairs(place[fused])])
        mean[rows[3:]] = self._points[place[fused]].ravel()
        entries = [(columns, rows, np.ones(len(rows)))]
        others = np.flatnonzero(place < 0)
        owners = self._owner[slots[others]]
        for k in np.unique(owners).tolist():
            held = others[owners == k]
            private, where = self._private_landmarks(k, slots[held]), 3 + pairs(held)
            mean[where] = private.points
            own[where[:, None], where] = private.covariance
            at = np.broadcast_arrays(self._unknowns(k), where[:, None])
            entries.append((at[0].ravel(), at[1].ravel(), private.jacobian.ravel()))
        unknowns, at_rows, values = map(np.concatenate, zip(*entries, strict=True))
        shape = (size, cut + self._points.size)
        A = coo_array((values, (at_rows, unknowns)), shape).tocsc()
        return Gaussian(mean, own + self._factors.covariance(A))

    @property
    def _factors(self) -> SubmapElimination:
        assert self._elimination is not None
        return self._elimination

    def _linearise(self, values: Array) -> Iterate:
        """Set the unknowns to these values, and factorise the normal equations."""
        cut = 3 * self._count
        self.frames = np.vstack([self.frames[:1], values[:cut].reshape(-1, 3)])
        self._points = values[cut:].reshape(-1, 2)
        self._elimination = None  # frees the memory of the old factor first
        done = SubmapElimination(self._parts, len(values), self._normal_equations)
        self._elimination = done
        return Iterate(values, done.cost, done.decrement(), done.solution())

    def _normal_equations(self, index: int) -> Quadratic:
        """Return the squared error of a submap as a function of its unknowns."""
        submap = self._load(index)
        rows = self._shared_rows(submap)
        error, jacobian = self._error(index, submap.mean[rows])
        W = whitened(
            submap.covariance[rows[:, None], rows], np.column_stack([jacobian, error])
        )
        J, w = W[:, :-1], W[:, -1]
        return J.T @ J, -J.T @ w, float(w @ w)

    def _error(self, index: int, mean: Array) -> FactorError:
        """Return the error of the shared part of a submap, and its Jacobian."""
        points = self._points[self._shared[index]].ravel()
        world = np.concatenate([self.frames[index + 1], points])
        error, jacobian = factor_error(
            self.frames[index], world, mean, self._error_frame
        )
        return FactorError(error, jacobian if index else jacobian[:, 3:])

    def _unknowns(self, index: int) -> IntArray:
        """Return the unknowns of a submap: two frames, one if it is the first."""
        frames = np.arange(3 * max(index - 1, 0), 3 * index + 3)
        return np.concatenate([frames, 3 * self._count + pairs(self._shared[index])])

    def _shared_rows(self, submap: Submap) -> IntArray:
        """Return the rows of pose and shared landmarks in the state of a submap."""
        shared = np.flatnonzero(self._place[submap.slots] >= 0)
        return np.concatenate([np.arange(3), 3 + pairs(shared)])

    def _private_landmarks(self, index: int, wanted: IntArray) -> PrivateLandmarks:
        submap = self._load(index)
        rows = self._shared_rows(submap)
        error = self._error(index, submap.mean[rows])
        start = self.frames[index]
        return private_landmarks(submap, rows, wanted, start, error, self._error_frame)
