"""Many independent runs of one filter at once, on the kernels of the single filter.

`BatchSlam` runs them. The functions below it check its arguments; `BatchBeliefs` and
`BatchTrace` are its results.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ... import argument_checks
from ...argument_checks import aligned_zeros, shaped, usable_cores
from ...arrays import LARGEST, SMALLEST, AnyArray, Array, BoolArray, IntArray
from ...restorable import Restorable, State
from ..beliefs import Belief, columns_of
from ..guards import saved_states
from ..kernels.batch import (
    NEVER,
    RunArrays,
    StepData,
    begin_runs,
    drive_at_truth,
    drive_runs,
    share_out,
)
from ..kernels.scan_update import (
    AFTER_STDS,
    FIRST_STD,
    FRAMES,
    Rules,
    Workspace,
    workspace_for,
)
from ..models.bearing_range import wrap_angle
from ..models.sensor_kernels import for_sensor
from ..models.sensors import Sensor, only_placing
from .ekf import EkfSlam
from .gaussian_map import GaussianMap
from .pose_readings import ObservedMap, PoseReading, gate_of


class BatchSlam(Restorable):
    """B runs of one filter, each with its own data, visibility and map.

    Run i has the same bits as a single filter with the data of run i, up to rounding
    of readings of the pose.  Landmark ids
    are the rows 0 … L−1 of the measurement arrays.  The runs are distributed over
    threads.  A run fails if its data is not finite or exceeds 1e12, or if its
    innovation covariance is not positive definite.  It is nan from this step on, and
    the other runs continue.

    Parameters
    ----------
    estimator : EkfSlam
        Filter to copy rules and noise from; an ``ekf``, ``invariant``, ``iterated``,
        ``first_estimates`` or ``observability_constrained``.
    runs, landmarks : int
        B, and L, the most landmarks a run can meet.
    initial_poses : array_like, shape (3,) or (B, 3)
        Means of the first poses [m, m, rad].
    initial_pose_std : array_like, shape (3,)
        Their standard deviation.
    threads : int, optional
        By default, the number of cores.

    Raises
    ------
    ValueError
        If the filter cannot run in batches, or an argument has the wrong shape.

    Examples
    --------
    >>> from slamgym.estimator import make_batch
    >>> batch = make_batch(
    ...     "ekf", runs=2, landmarks=1, motion_std=(0, 0, 0), measurement_std=(0.1, 0.1)
    ... )
    >>> trace = batch.run(
    ...     odometry=np.array([[(1.0, 0.0)], [(2.0, 0.0)]]),
    ...     measurements=np.full((2, 1, 1, 2), 1.0),
    ...     visible=np.ones((2, 1, 1), dtype=bool),
    ... )
    >>> trace.poses[:, -1, 0]
    array([1., 2.])
    """

    def __init__(
        self,
        estimator: EkfSlam,
        runs: int,
        landmarks: int,
        *,
        initial_poses: ArrayLike = (0.0, 0.0, 0.0),
        initial_pose_std: ArrayLike = (0.0, 0.0, 0.0),
        threads: int | None = None,
    ) -> None:
        if not can_batch(estimator):
            raise ValueError(f"{type(estimator).__name__} cannot run in batches")
        self.runs = argument_checks.whole("runs", runs, 1)
        self.landmarks = argument_checks.whole("landmarks", landmarks, 0)
        only_placing(estimator.sensor, "a batch")
        self.sensor = estimator.sensor
        #: What distinguishes this filter's updates from another's.
        self.rules = estimator.rules
        self.rule_values = estimator.rule_values.copy()
        self.motion_values = estimator.motion_values
        self.motion = estimator.motion
        self._threads = argument_checks.whole("threads", threads or usable_cores(), 1)
        std = argument_checks.standard_deviations(
            "initial_pose_std", initial_pose_std, 3
        )
        first = first_poses("initial_poses", initial_poses, self.runs)
        capacity = GaussianMap.capacity_for(self.landmarks)
        self._means = np.zeros((self.runs, capacity))
        self._references = np.zeros((self.runs, capacity))
        self._covariances = aligned_zeros(self.runs, capacity, capacity)
        self._slots = np.full((self.runs, self.landmarks), -1, dtype=np.int64)
        self._mapped = np.zeros(self.runs, dtype=np.int64)
        #: Step of the last :meth:`run` at which a run stopped, -1 if it did not.
        #:
        #: A stopped run remains stopped, at step 0 of every later :meth:`run`.
        self.failed_at = np.full(self.runs, NEVER, dtype=np.int64)
        begin_runs(tuple(self._arrays()), self.failed_at == NEVER, first.copy(), std**2)
        self._kept_room: Workspace | None = None
        self._last_step = BatchTrace.empty(self.runs, 1)  # of `step`, never read

    def reset(
        self,
        poses: ArrayLike,
        pose_std: ArrayLike = (0.0, 0.0, 0.0),
        *,
        runs: ArrayLike | None = None,
    ) -> None:
        """Restart runs with empty maps, also those that had stopped.

        Parameters
        ----------
        poses : array_like, shape (3,) or (B, 3)
            Means of the first poses [m, m, rad].
        pose_std : array_like, shape (3,)
            Their standard deviation.
        runs : array_like of bool, shape (B,), optional
            The runs that start anew; by default all; the others continue.
        """
        std = argument_checks.standard_deviations("pose_std", pose_std, 3)
        first = first_poses("poses", poses, self.runs)
        chosen = chosen_runs(runs, self.runs)
        begin_runs(tuple(self._arrays()), chosen, np.array(first), std**2)
        self.failed_at[chosen] = NEVER

    def beliefs(self) -> BatchBeliefs:
        """Return a snapshot of all beliefs; a run that stopped has its last."""
        return self.storage().beliefs()

    def storage(self) -> BatchStorage:
        """Return the arrays that the runs work on, without a copy.

        They change with the next :meth:`run` or :meth:`reset`.
        """
        return BatchStorage.of(self._means, self._covariances, self._slots)

    @property
    def references(self) -> Array:
        """Linearisation points, stored like the means, for filters that fix them."""
        return BatchStorage.of(self._references, self._covariances, self._slots).means

    def state(self) -> State:
        """Return the state of all runs, for `restore`."""
        return tuple(array.copy() for array in (*self._arrays(), self.failed_at))

    def restore(self, state: State) -> None:
        """Return to a state of these runs, without checks."""
        for array, value in zip((*self._arrays(), self.failed_at), state, strict=True):
            array[...] = value

    def load(
        self,
        beliefs: BatchBeliefs,
        *,
        references: ArrayLike | None = None,
        runs: ArrayLike | None = None,
    ) -> None:
        """Continue runs from given beliefs, also those that had stopped.

        Parameters
        ----------
        beliefs : BatchBeliefs
            Of B runs, as :meth:`beliefs` returns them, or `BatchBeliefs.of` makes them.
        references : array_like, shape (B, 3 + 2L), optional
            Linearisation points of filters that fix them; the means by default.
        runs : array_like of bool, shape (B,), optional
            All by default.

        Raises
        ------
        ValueError
            If a shape is wrong, or a belief cannot be; nothing is loaded.
        """
        chosen = chosen_runs(runs, self.runs)
        loaded = checked_beliefs(beliefs, references, chosen, self.landmarks)
        for run in np.flatnonzero(chosen).tolist():
            loaded.write(run, self._arrays())
        self.failed_at[chosen] = NEVER

    def belief(self, run: int) -> Belief:
        """Return the belief of one run as a snapshot."""
        n = 3 + 2 * int(self._mapped[run])
        slots = self._slots[run]
        order = np.argsort(slots[slots >= 0])
        return Belief(
            self._means[run, :n],
            self._covariances[run, :n, :n],
            tuple(np.flatnonzero(slots >= 0)[order].tolist()),
            FRAMES[self.rules.frame],
        )

    @property
    def nbytes(self) -> int:
        """Memory of the beliefs of all runs [bytes]."""
        return sum(array.nbytes for array in self._arrays())

    def _arrays(self) -> RunArrays:
        return RunArrays(
            self._means, self._covariances, self._references, self._slots, self._mapped
        )

    def run(
        self,
        odometry: ArrayLike,
        measurements: ArrayLike,
        visible: ArrayLike,
        dt: ArrayLike = 1.0,
        *,
        runs: ArrayLike | None = None,
    ) -> BatchTrace:
        """Run T steps, each a predict and an update.

        Parameters
        ----------
        odometry : array_like, shape (B, T, 2) or (B, T, 3)
            (d, α) before each scan [m, rad], or the columns of another drive; or the
            displacement (dx, dy, α) in the robot's frame [m, m, rad] of any drive.
        measurements : array_like, shape (B, T, L, 2)
            Rows (β, r) of landmarks 0 … L−1 [rad, m]; what is not visible is not read.
        visible : array_like of bool, shape (B, T, L)
            Which readings there are.
        dt : float or array_like, shape (T,) or (B, T)
            Duration that the motion noise of each step counts.  A first scan before
            any motion is odometry (0, 0) with dt = 0.
        runs : array_like of bool, shape (B,), optional
            The runs that take part; by default all.  The others stay as they are,
            and their data is not read; the trace has nan for them.

        Returns
        -------
        BatchTrace
        """
        u = argument_checks.as_floats("odometry", odometry)
        steps = u.shape[1] if u.ndim == 3 else 0
        u = self._displacements(u, (self.runs, steps))
        durations = durations_of(dt)
        if durations.shape not in ((), (1,), (steps,), (self.runs, steps)):
            raise ValueError(
                f"dt must be one number or {steps}, got shape {durations.shape}"
            )
        durations = np.broadcast_to(durations, (self.runs, steps))
        data = self._checked((self.runs, steps), u, measurements, visible, durations)
        trace = BatchTrace.empty(self.runs, steps)
        self.failed_at = self.failed_at.copy()  # a caller may hold the former one
        self._drive(data, trace, runs)
        trace.poses[..., 2] = wrap_angle(trace.poses[..., 2])
        return trace

    def step(
        self,
        odometry: ArrayLike,
        measurements: ArrayLike,
        visible: ArrayLike,
        dt: ArrayLike,
        *,
        runs: ArrayLike | None = None,
    ) -> None:
        """Run one step, without a trace; :attr:`failed_at` is 0 for runs that fail.

        Parameters
        ----------
        odometry, measurements, visible, runs
            As in :meth:`run`, without the axis of steps.
        dt : array_like, shape (B,)
            Duration of the step of each run.
        """
        durations = durations_of(dt)
        data = self._checked((self.runs,), odometry, measurements, visible, durations)
        one_step = tuple([part[:, None] for part in data])
        self._drive(one_step, self._last_step, runs)

    def observe_pose(
        self,
        readings: ArrayLike,
        matrix: ArrayLike,
        covariance: ArrayLike,
        *,
        runs: ArrayLike | None = None,
    ) -> tuple[Array, IntArray]:
        """Correct the beliefs with a reading of each pose, such as compass or GPS.

        Parameters
        ----------
        readings : array_like, shape (B, k)
            z of every run; not read of those that do not take part.
        matrix, covariance : array_like
            H and R, as of :meth:`EkfSlam.observe_pose`.
        runs : array_like of bool, shape (B,), optional
            The runs that take part; all by default, without those that have stopped.

        Returns
        -------
        nis, degrees_of_freedom : ndarray, shape (B,)
            νᵀ S⁻¹ ν and k; 0 and 0 for a run that has not used its reading.
        """
        chosen = chosen_runs(runs, self.runs) & (self.failed_at == NEVER)
        z = argument_checks.as_floats("readings", readings).copy()
        if z.shape[:1] != (self.runs,):
            raise ValueError(
                f"readings must have a row for each of {self.runs} runs, got shape "
                f"{z.shape}"
            )
        z[~chosen] = 0.0
        given = PoseReading.checked(z, matrix, covariance, (self.runs,))
        size, n = len(given.matrix), 3 + 2 * self.landmarks
        rows = np.flatnonzero(chosen)
        found = given.of(rows).correct(
            self._means[rows, :n],
            self._covariances[rows, :n, :n],
            frame=FRAMES[self.rules.frame],
            once=self.rules.iterations == 1,
        )
        used = found.nis <= gate_of(self.rules, size)
        rows, found = rows[used], ObservedMap(*(part[used] for part in found))
        self._means[rows, :n], self._covariances[rows, :n, :n] = found[:2]
        nis, freedom = np.zeros(self.runs), np.zeros(self.runs, dtype=np.int64)
        nis[rows], freedom[rows] = found.nis, size
        return nis, freedom

    def __repr__(self) -> str:
        few, most = self._mapped.min(), self._mapped.max()
        landmarks = f"{few} to {most} of {self.landmarks} landmarks"
        stopped = int((self.failed_at != NEVER).sum())
        return f"BatchSlam of {self.runs} runs, {landmarks} mapped, {stopped} stopped"

    def _checked(
        self,
        shape: tuple[int, ...],
        odometry: ArrayLike,
        measurements: ArrayLike,
        visible: ArrayLike,
        durations: Array,
    ) -> StepData:
        """Return the data of steps, of ``shape`` (B,) or (B, T), or refuse them."""
        moved = self._displacements(odometry, shape)
        z = shaped("measurements", measurements, (*shape, self.landmarks, 2))
        seen = _shaped_flags("visible", visible, (*shape, self.landmarks))
        dt = shaped("dt", durations, shape)
        z, seen, dt = map(_writeable, (z, seen, dt))
        return StepData(moved, z, seen, dt)

    def _displacements(self, odometry: ArrayLike, shape: tuple[int, ...]) -> Array:
        u = argument_checks.as_floats("odometry", odometry)
        if u.shape == (*shape, 3):
            return _writeable(u)
        return self.motion.displacements(shaped("odometry", u, (*shape, 2)))

    def _drive(
        self, data: tuple[Any, ...], trace: BatchTrace, runs: ArrayLike | None
    ) -> None:
        drive = partial(self._drive_part, data, trace, chosen_runs(runs, self.runs))
        share_out(drive, self.runs, self._threads)

    def _drive_part(
        self, data: tuple[Any, ...], trace: BatchTrace, chosen: BoolArray, part: slice
    ) -> None:
        for_sensor(drive_runs, self.sensor)(
            _of(part, self._arrays()),
            _of(part, data),
            _of(part, trace),
            chosen[part],
            self.failed_at[part],
            self.motion_values,
            self.rule_values,
            tuple(self._room()),
        )

    def _room(self) -> Workspace:
        """Give each share a workspace of its own; kept where there is one thread."""
        if self._threads == 1 and self._kept_room is not None:
            return self._kept_room
        room = workspace_for(self.rules, self.landmarks, self._means.shape[1])
        self._kept_room = room
        return room


def can_batch(estimator: object) -> bool:
    """Whether a filter consists of the shared kernels only, and can run in batches."""
    shared = ("predict", "update", "belief", "move_kernel", "update_kernel")
    return isinstance(estimator, EkfSlam) and all(
        getattr(type(estimator), name) is getattr(EkfSlam, name) for name in shared
    )


def _of(part: slice, arrays: tuple[Any, ...]) -> tuple[Any, ...]:
    """Return views on some of the runs; a plain tuple, as kernels take it."""
    if part == slice(0, len(arrays[0])):  # all of them, without the time of a view
        return tuple(arrays)
    return tuple([array[part] for array in arrays])


def filter_at_truth(
    piece: Sequence[AnyArray],
    start_std: Array,
    motion_std: Array,
    measurement_std: Array,
    sensor: Sensor,
    threads: int | None,
) -> tuple[Array, IntArray]:
    """Filter runs at their truth; return covariances and slots as `drive_at_truth`.

    ``piece`` holds the arrays of `TrueDrives`, then ``least`` and ``spread``, which are
    filled.
    """
    threads = argument_checks.whole("threads", threads or usable_cores(), 1)
    visible = piece[2]
    known = int(visible.any(axis=1).sum(axis=1).max(initial=0))
    readings = int(visible.sum(axis=2).max(initial=0)) + 3
    capacity = GaussianMap.capacity_for(known)
    P = aligned_zeros(len(visible), capacity, capacity)
    P[:, range(3), range(3)] = start_std**2
    slots = np.full(visible[:, 0].shape, NEVER)
    rules = np.array(Rules(min_range=SMALLEST))
    rules[FIRST_STD:AFTER_STDS] = sensor.noise(measurement_std)
    kernel, noise = for_sensor(drive_at_truth, sensor), (motion_std**2, rules)

    def drive(part: slice) -> None:
        own, at, *drives, least, spread = [each[part] for each in (P, slots, *piece)]
        rows = workspace_for(Rules(), readings, capacity).rows
        kernel(own, at, tuple(drives), least, spread, *noise, rows)

    share_out(drive, len(visible), threads)
    return P, slots


# --------------------------------------------------------------------------------------
# The arguments of a batch of runs, checked, and its results.


def durations_of(dt: ArrayLike) -> Array:
    """Return durations, or refuse such as are not finite or below 0."""
    durations = argument_checks.as_floats("dt", dt)
    few = durations.size < 100  # numpy needs longer for a few numbers
    ends = durations.ravel().tolist() if few else (durations.min(), durations.max())
    if not all(0.0 <= each <= LARGEST for each in ends):
        raise ValueError(
            f"dt must be finite numbers >= 0 and at most {LARGEST:g}, got {dt!r}"
        )
    return durations


def _shaped_flags(name: str, value: ArrayLike, shape: tuple[int, ...]) -> BoolArray:
    """Return ``value`` as truth values of one shape, or refuse it."""
    flags = np.ascontiguousarray(value, dtype=np.bool_)
    if flags.shape != shape:
        raise ValueError(f"{name} must have shape {shape}, got {flags.shape}")
    return flags


def _writeable(array: AnyArray) -> AnyArray:
    """Return the array, or a copy if it is read-only: kernels take no such array."""
    return array if array.flags.writeable else array.copy()


def chosen_runs(runs: ArrayLike | None, count: int) -> BoolArray:
    """Return which of the runs are chosen, shape (B,); all for None."""
    if runs is None:
        return np.ones(count, dtype=np.bool_)
    chosen = np.asarray(runs)
    if chosen.shape != (count,) or chosen.dtype != np.bool_:
        raise ValueError(
            f"runs must be {count} booleans, got {chosen.dtype} with shape "
            f"{chosen.shape}"
        )
    return chosen


class LoadedBeliefs(NamedTuple):
    """Beliefs that have been checked; arrays as in `BatchBeliefs`."""

    means: Array
    covariances: Array
    references: Array
    mapped: BoolArray

    def write(self, run: int, arrays: RunArrays) -> None:
        """Replace the belief of a run; its landmarks are stored in order of id."""
        ids = np.flatnonzero(self.mapped[run])
        at = columns_of(ids.tolist())
        size = len(at)
        for array in arrays[:3]:
            array[run] = 0.0
        arrays.means[run, :size] = self.means[run, at]
        arrays.references[run, :size] = self.references[run, at]
        arrays.covariances[run, :size, :size] = self.covariances[run][np.ix_(at, at)]
        arrays.slots[run] = -1
        arrays.slots[run, ids] = np.arange(len(ids))
        arrays.mapped[run] = len(ids)


def checked_beliefs(
    beliefs: BatchBeliefs, references: ArrayLike | None, runs: BoolArray, landmarks: int
) -> LoadedBeliefs:
    """Return beliefs of B runs over L landmarks, or refuse those of the chosen runs."""
    count, size = len(runs), 3 + 2 * landmarks
    points = means = shaped("beliefs.means", beliefs.means, (count, size))
    P = shaped("beliefs.covariances", beliefs.covariances, (count, size, size))
    if references is not None:
        points = shaped("references", references, (count, size))
    mapped = np.asarray(beliefs.mapped)
    if mapped.dtype != np.bool_:
        raise ValueError(f"beliefs.mapped must be booleans, got {mapped.dtype}")
    mapped = _shaped_flags("beliefs.mapped", mapped, (count, landmarks))
    arrays = (
        (means, "beliefs.means"),
        (P, "beliefs.covariances"),
        (points, "references"),
    )
    for run in np.flatnonzero(runs).tolist():
        for array, name in arrays:
            if not np.isfinite(array[run]).all():
                raise ValueError(f"{name} must be finite, but is not in run {run}")
        if not np.array_equal(P[run], P[run].T):
            raise ValueError(
                f"beliefs.covariances must be symmetric, but is not in run {run}"
            )
        if not saved_states.is_semidefinite(P[run]):
            raise ValueError(
                "beliefs.covariances must be positive semidefinite, but has the "
                f"eigenvalue {np.linalg.eigvalsh(P[run])[0]:.3g} in run {run}"
            )
    return LoadedBeliefs(means, P, points, mapped)


def first_poses(name: str, poses: ArrayLike, count: int) -> Array:
    """Return the first pose of every run, shape (B, 3), or refuse them."""
    first = argument_checks.as_floats(name, poses)
    if first.shape == (count, 3) and np.abs(first).max() <= LARGEST:
        return first
    if first.shape not in ((3,), (count, 3)) or not np.isfinite(first).all():
        raise ValueError(
            f"{name} must be finite with shape (3,) or ({count}, 3), "
            f"got shape {first.shape}"
        )
    argument_checks.refuse_beyond(name, first, poses)
    return np.broadcast_to(first, (count, 3))


class BatchTrace(NamedTuple):
    """The belief of every run about its pose, after every step; B runs, T steps."""

    #: (x, y, θ), shape (B, T, 3) [m, m, rad], heading in [-π, π).
    poses: Array
    #: Shape (B, T, 3, 3).
    pose_covariances: Array
    #: νᵀ S⁻¹ ν of each scan, shape (B, T).
    nis: Array
    #: Of the NIS, shape (B, T).
    degrees_of_freedom: IntArray

    @classmethod
    def empty(cls, runs: int, steps: int) -> BatchTrace:
        """Return a trace of runs that have not begun: nan, and zero degrees."""
        return cls(
            np.full((runs, steps, 3), np.nan),
            np.full((runs, steps, 3, 3), np.nan),
            np.full((runs, steps), np.nan),
            np.zeros((runs, steps), dtype=np.int64),
        )


class BatchBeliefs(NamedTuple):
    """The present belief of every run; the states are (x, y, θ, l0x, l0y, …)."""

    #: Shape (B, 3 + 2L), landmarks by id, zeros where not mapped; θ in [-π, π).
    means: Array
    #: Of the additive error, shape (B, 3 + 2L, 3 + 2L), zeros where not mapped.
    covariances: Array
    #: Which landmarks are in the map, shape (B, L).
    mapped: BoolArray

    @classmethod
    def of(cls, beliefs: Sequence[Belief], landmarks: int) -> BatchBeliefs:
        """Return beliefs of single filters with L landmarks, whose ids are 0 … L−1.

        Raises
        ------
        ValueError
            If a belief has a landmark with another id.
        """
        count, size = len(beliefs), 3 + 2 * landmarks
        means, covariances = np.zeros((count, size)), np.zeros((count, size, size))
        mapped = np.zeros((count, landmarks), dtype=np.bool_)
        for run, belief in enumerate(beliefs):
            ids = belief.landmark_ids
            if not all(0 <= i < landmarks for i in ids):
                raise ValueError(
                    f"landmark ids must be below landmarks = {landmarks}, got {ids}"
                )
            at = columns_of(ids)
            means[run, at], mapped[run, list(ids)] = belief.mean, True
            covariances[run][np.ix_(at, at)] = belief.covariance
        return cls(means, covariances, mapped)

    @property
    def poses(self) -> Array:
        """(x, y, θ), shape (B, 3) [m, m, rad]."""
        return self.means[:, :3]

    @property
    def landmarks(self) -> Array:
        """Positions, shape (B, L, 2) [m], zeros where not mapped."""
        return self.means[:, 3:].reshape(len(self.means), -1, 2)

    @property
    def landmark_covariances(self) -> Array:
        """Marginal covariance of each landmark, shape (B, L, 2, 2) [m²]."""
        count = self.mapped.shape[1]
        blocks = self.covariances[:, 3:, 3:].reshape(-1, count, 2, count, 2)
        each = np.arange(count)
        return np.moveaxis(blocks[:, each, :, each, :], 0, 1)


class BatchStorage(NamedTuple):
    """The arrays that hold the beliefs of all runs: live and read-only.

    Entries beyond the mapped landmarks are arbitrary.
    """

    #: Shape (B, capacity): (x, y, θ), then the landmarks by slot; θ is not wrapped.
    means: Array
    #: Of the additive error, shape (B, capacity, capacity).
    covariances: Array
    #: Shape (B, L): landmark i has column 3 + 2 slots[i]; -1 where not mapped.
    slots: IntArray

    @classmethod
    def of(cls, means: Array, covariances: Array, slots: IntArray) -> BatchStorage:
        """Return read-only views of the arrays."""
        views = means.view(), covariances.view(), slots.view()
        for view in views:
            view.flags.writeable = False
        return cls(*views)

    def beliefs(self) -> BatchBeliefs:
        """Return the beliefs with the landmarks by id, as a snapshot."""
        runs, mapped = len(self.slots), self.slots >= 0
        places = 3 + 2 * np.where(mapped, self.slots, 0)
        pose = np.broadcast_to(np.arange(3), (runs, 3))
        pairs = (places[:, :, None] + np.arange(2)).reshape(runs, -1)
        at = np.concatenate([pose, pairs], axis=1)
        held = np.ones(at.shape, dtype=np.bool_)
        held[:, 3:] = np.repeat(mapped, 2, axis=1)
        row = np.arange(runs)[:, None]
        means = self.means[row, at] * held
        covariances = self.covariances[row[:, :, None], at[:, :, None], at[:, None]]
        covariances *= held[:, :, None] & held[:, None]
        means[:, 2] = wrap_angle(means[:, 2])
        return BatchBeliefs(means, covariances, mapped)
