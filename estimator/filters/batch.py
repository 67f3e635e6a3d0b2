"""Many independent runs of one filter at once, on the kernels of the single filter."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ...arrays import Array, IntArray
from ..interface import Belief
from ..kernels.batch import NEVER, RunArrays, StepData, drive_runs
from ..kernels.belief_arrays import aligned_zeros
from ..kernels.scan_rows import Workspace
from ..models.angles import wrap_angle
from ..support import argument_checks
from ..support.threads import share_out, usable_cores
from .batch_arguments import checked_beliefs, chosen_runs, first_poses, step_data
from .batch_results import BatchBeliefs, BatchStorage, BatchTrace
from .ekf import EkfSlam
from .gaussian_map import GaussianMap
from .map_filter import FRAMES
from .scan_workspace import workspace_for


class BatchSlam:
    """B runs of one filter, each with its own data, visibility and map.

    Run i has the same bits as a single filter with the data of run i.  Landmark ids
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
        self.rules = estimator.rules
        """What distinguishes this filter's updates from another's."""
        self.rule_values = estimator.rule_values.copy()
        self.motion_values = estimator.motion_values
        self._threads = argument_checks.whole("threads", threads or usable_cores(), 1)
        std = argument_checks.standard_deviations(
            "initial_pose_std", initial_pose_std, 3
        )
        first = first_poses("initial_poses", initial_poses, self.runs)
        capacity = GaussianMap.capacity_for(self.landmarks)
        self._means = np.zeros((self.runs, capacity))
        self._references = np.zeros((self.runs, capacity))
        self._covariances = aligned_zeros(self.runs, capacity, capacity)
        self._means[:, :3] = self._references[:, :3] = first
        self._covariances[:, range(3), range(3)] = std**2
        self._slots = np.full((self.runs, self.landmarks), -1, dtype=np.int64)
        self._mapped = np.zeros(self.runs, dtype=np.int64)
        self._kept_room: Workspace | None = None
        self.failed_at = np.full(self.runs, NEVER, dtype=np.int64)
        """Step of the last :meth:`run` at which a run stopped, -1 if it did not.

        A stopped run remains stopped, at step 0 of every later :meth:`run`.
        """

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
        odometry : array_like, shape (B, T, 2)
            (d, α) before each scan [m, rad].
        measurements : array_like, shape (B, T, L, 2)
            Rows (β, r) of landmarks 0 … L−1 [rad, m]; what is not visible is not read.
        visible : array_like of bool, shape (B, T, L)
            Which readings there are.
        dt : float or array_like, shape (T,)
            Duration that the motion noise of each step counts.  A first scan before
            any motion is odometry (0, 0) with dt = 0.
        runs : array_like of bool, shape (B,), optional
            The runs that take part; by default all.  The others stay as they are,
            and their data is not read; the trace has nan for them.

        Returns
        -------
        BatchTrace
        """
        data, durations = step_data(
            odometry, measurements, visible, dt, (self.runs, self.landmarks)
        )
        count, steps = data.odometry.shape[:2]
        trace = BatchTrace(
            np.full((count, steps, 3), np.nan),
            np.full((count, steps, 3, 3), np.nan),
            np.full((count, steps), np.nan),
            np.zeros((count, steps), dtype=np.int64),
        )
        chosen = chosen_runs(runs, self.runs)
        failed_at = np.where(chosen, self.failed_at, 0)  # the kernel passes these over
        drive = partial(self._drive, data, durations, trace, failed_at)
        share_out(drive, self.runs, self._threads)
        self.failed_at = np.where(chosen, failed_at, self.failed_at)
        trace.poses[..., 2] = wrap_angle(trace.poses[..., 2])
        return trace

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
        self._means[chosen] = self._references[chosen] = 0.0
        self._covariances[chosen] = 0.0
        at = np.flatnonzero(chosen)
        self._means[at, :3] = self._references[at, :3] = first[at]
        self._covariances[at[:, None], range(3), range(3)] = std**2
        self._slots[chosen] = -1
        self._mapped[chosen] = 0
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

    def __repr__(self) -> str:
        few, most = self._mapped.min(), self._mapped.max()
        landmarks = f"{few} to {most} of {self.landmarks} landmarks"
        stopped = int((self.failed_at != NEVER).sum())
        return f"BatchSlam of {self.runs} runs, {landmarks} mapped, {stopped} stopped"

    def _drive(
        self,
        data: StepData,
        dt: Array,
        trace: BatchTrace,
        failed_at: IntArray,
        part: slice,
    ) -> None:
        drive_runs(
            _of(part, self._arrays()),
            _of(part, data),
            dt,
            _of(part, trace),
            failed_at[part],
            self.motion_values,
            self.rule_values,
            _of(slice(None), self._room()),
        )

    def _arrays(self) -> RunArrays:
        return RunArrays(
            self._means, self._covariances, self._references, self._slots, self._mapped
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
    return (
        isinstance(estimator, EkfSlam)
        and type(estimator).predict is EkfSlam.predict
        and type(estimator).update is EkfSlam.update
        and type(estimator).belief is EkfSlam.belief
    )


def _of(part: slice, arrays: tuple[Any, ...]) -> tuple[Any, ...]:
    """Return views on some of the runs; a plain tuple, as kernels take it."""
    return tuple(array[part] for array in arrays)
