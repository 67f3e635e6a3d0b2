"""Many independent runs of one filter at once, on the kernels of the single filter."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ...arrays import Array, BoolArray, IntArray
from ..kernels.batch import (
    NEVER,
    StepData,
    drive_runs,
    step_runs,
)
from ..kernels.scan_rows import Workspace
from ..models.angles import wrap_angle
from ..support import argument_checks
from ..support.threads import share_out, usable_cores
from .batch_arguments import (
    chosen_runs,
    first_poses,
    step_data,
    step_scans,
)
from .batch_beliefs import BatchOfBeliefs
from .batch_results import BatchTrace
from .ekf import EkfSlam
from .map_filter import FRAMES
from .scan_workspace import workspace_for


class BatchSlam(BatchOfBeliefs):
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
        super().__init__(first, std, self.landmarks, FRAMES[self.rules.frame])
        self._kept_room: Workspace | None = None

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
        trace = BatchTrace.empty(*data.odometry.shape[:2])
        chosen = chosen_runs(runs, self.runs)
        failed_at = np.where(chosen, self.failed_at, 0)  # the kernel passes these over
        drive = partial(self._drive, data, durations, trace, failed_at)
        share_out(drive, self.runs, self._threads)
        self.failed_at = np.where(chosen, failed_at, self.failed_at)
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
        shape = self.runs, self.landmarks
        scans = step_scans(odometry, measurements, visible, dt, shape)
        drive = partial(self._step, scans, chosen_runs(runs, self.runs))
        share_out(drive, self.runs, self._threads)

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

    def _step(self, scans: tuple[Any, ...], chosen: BoolArray, part: slice) -> None:
        step_runs(
            _of(part, self._arrays()),
            _of(part, scans),
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
    return (
        isinstance(estimator, EkfSlam)
        and type(estimator).predict is EkfSlam.predict
        and type(estimator).update is EkfSlam.update
        and type(estimator).belief is EkfSlam.belief
    )


def _of(part: slice, arrays: tuple[Any, ...]) -> tuple[Any, ...]:
    """Return views on some of the runs; a plain tuple, as kernels take it."""
    return tuple(array[part] for array in arrays)
