"""Drive an estimator through a log, and keep what it believed on the way."""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...estimator.interface import (
    Belief,
    SlamEstimator,
    SupportsJoin,
    SupportsTruth,
    UpdateReport,
)
from ...estimator.map_management.managed_slam import ManagedSlam
from ...estimator.map_management.map_view import (
    mapped_ids,
    marginal_without_joining,
    view_map,
)
from ..logs.events import Scan
from ..logs.ground_truth import true_landmarks_of, true_poses_of
from ..logs.slamlog import SlamLog
from ..logs.steps import Step, predictions, steps_of
from .blas_threads import one_blas_thread
from .map_history import MapHistory
from .memory_check import refuse_large_map
from .trace import RunTrace

Array = NDArray[np.float64]
Progress = Callable[[int, int], object]

# Maps kept of a run, unless all are asked for; and where each must be joined for that.
_MOST_MAPS, _MOST_JOINED = 500, 50


class ReadingCounts(NamedTuple):
    """What became of the readings of a log."""

    associated: int = 0
    """Corrected the belief."""
    added: int = 0
    """Put a landmark into the map."""
    rejected: int = 0
    """Refused by the chi-square gate."""
    skipped: int = 0
    """Too close to use."""
    near: int = 0
    """Of those associated: within 10 σ of the robot, where linearising is unsafe."""
    tentative: int = 0
    """Spoke for landmarks not yet confirmed."""
    ambiguous: int = 0
    """Could have been of more than one landmark."""


class MapChanges(NamedTuple):
    """What was done to the map of a run besides adding to it."""

    confirmed: int = 0
    """Landmarks that were tentative before they were added."""
    removed: int = 0
    """Landmarks marginalised."""
    merged: int = 0
    """Landmarks found to be another one."""
    most: int = 0
    """Size of the map when it was largest."""


@dataclass(frozen=True, eq=False)
class Replay:
    """An estimator's run over a log."""

    log: SlamLog
    """What it was driven through."""
    trace: RunTrace
    """What it believed after every step."""
    belief: Belief
    """What it believes at the end."""
    scans: int
    """How many scans the log holds."""
    readings: ReadingCounts
    """What it did with their readings."""
    changes: MapChanges = field(default_factory=MapChanges)
    """What it did to its map."""


def replay(
    log: SlamLog,
    estimator: SlamEstimator,
    *,
    name: str | None = None,
    keep_history: bool = False,
    progress: Progress | None = None,
) -> Replay:
    """Feed a log to an estimator: for each step its motion, then its scan.

    Of a filter that joins its map when it is asked (``submaps``), the trace holds what
    it could say at once, from the surroundings of the robot as of the last submap that
    it closed; its map is joined for the pictures, and at the end.

    Parameters
    ----------
    log : SlamLog
        The log; a scan without landmark ids is left to the estimator to associate.
    estimator : SlamEstimator
        At its start, with an empty map; it is at the end of the log afterwards.
        One with a door for the truth (``ideal``) is told it, where the log has it all.
    name : str, optional
        What to call the estimator; its class by default.
    keep_history : bool, default False
        Whether the trace keeps the map after every step, for pictures of each, or
        only of some hundred steps spread over the run.
    progress : callable, optional
        Called with (steps done, steps) after every step.

    Returns
    -------
    Replay
        The trace, the final belief, and what became of the readings.

    Raises
    ------
    ValueError
        If the estimator refuses a reading, naming the time in the log; before the
        first step, if the log names more landmarks than a belief of it may hold.
    numpy.linalg.LinAlgError
        If its covariance degenerates, naming the time too.
    MemoryError
        If memory will not suffice for the landmarks that the log names.

    Examples
    --------
    >>> from slamgym.estimator import make_estimator
    >>> from slamgym.experiments.logs.slamlog import OdometryRow, Scan, SlamLog
    >>> scans = [Scan(t, np.array([[0.0, 5.0 - 2 * t]]), [4]) for t in (0.0, 1.0)]
    >>> log = SlamLog("drive", events=(scans[0], OdometryRow(1, 2.0, 0.0, 1), scans[1]))
    >>> slam = make_estimator("ekf", motion_std=(0.1,) * 3, measurement_std=(0.1, 0.1))
    >>> replay(log, slam).readings
    ReadingCounts(associated=1, added=1, rejected=0, skipped=0, near=1, ...
    """
    refuse_large_map(log, estimator)
    steps = list(steps_of(log))
    times = np.array([step.t for step in steps], dtype=np.float64)
    tell_truth = _truth_teller(estimator, log, times)
    most = _MOST_JOINED if isinstance(estimator, SupportsJoin) else _MOST_MAPS
    history = MapHistory(None if keep_history else most)
    recorder = _Recorder(estimator, len(steps), history)
    with one_blas_thread():
        for number, step in enumerate(steps):
            try:
                tell_truth(number)
                _take(step, log, estimator, recorder)
            except ValueError as error:
                raise _kind(error)(f"{log.name}, t = {step.t:g}: {error}") from error
            if progress is not None:
                progress(number + 1, len(steps))
    trace = recorder.trace(name or _name_of(estimator), times, log)
    scans = sum(step.scan is not None for step in steps)
    return Replay(
        log, trace, recorder.belief, scans, recorder.counts(), recorder.changes()
    )


def _name_of(estimator: SlamEstimator) -> str:
    """Name its class, of a managed filter that of the filter."""
    inner = estimator.filter if isinstance(estimator, ManagedSlam) else estimator
    return type(inner).__name__


def _truth_teller(
    estimator: SlamEstimator, log: SlamLog, times: Array
) -> Callable[[int], None]:
    """Return what passes the truth of a step to an estimator that takes it."""
    poses = true_poses_of(log, times)
    seen = {i for e in log.events if isinstance(e, Scan) for i in _ids(e) or ()}
    landmarks = dict(zip(log.landmark_ids.tolist(), log.landmarks, strict=True))
    if not isinstance(estimator, SupportsTruth):
        return lambda _: None
    if poses is None or not seen <= set(landmarks):
        return lambda _: None
    if not np.isfinite(poses).all():
        return lambda _: None
    return lambda step: estimator.observe_truth(poses[step], landmarks)


def _take(
    step: Step, log: SlamLog, estimator: SlamEstimator, recorder: "_Recorder"
) -> None:
    for row in step.motions:
        for odometry, dt in predictions(row, log.motion):
            estimator.predict(odometry, dt)
    predicted = marginal_without_joining(estimator, ())
    report = None
    if step.scan is not None:
        report = estimator.update(step.scan.measurements, _ids(step.scan))
    recorder.add(predicted, report)


def _kind(error: ValueError) -> type[ValueError]:
    is_numerical = isinstance(error, np.linalg.LinAlgError)
    return np.linalg.LinAlgError if is_numerical else ValueError


def _counts_steps(times: Array) -> bool:
    return bool((times == np.arange(len(times))).all())


def _ids(scan: Scan) -> list[int] | None:
    return None if scan.landmark_ids is None else scan.landmark_ids.tolist()


class _Recorder:
    """Collect beliefs and reports, step by step, into the arrays of a trace."""

    def __init__(self, slam: SlamEstimator, steps: int, history: MapHistory) -> None:
        self._slam, self._steps = slam, steps
        self._predicted = _PoseTrack(steps)
        self._updated = _PoseTrack(steps)
        self._nis = np.zeros(steps)
        self._dof = np.zeros(steps, dtype=np.int64)
        self._history = history
        self._first: dict[int, tuple[Array, Array]] = {}
        self._first_covariance: Array | None = None
        self._readings: Counter[str] = Counter()
        self._changes: Counter[str] = Counter()
        self._ids: tuple[int, ...] = ()

    def add(self, predicted: Belief, report: UpdateReport | None) -> None:
        """Take in one step, after the scan at its end."""
        step = len(self._history)
        self._predicted.put(step, predicted)
        updated = predicted
        if report is not None:
            updated = marginal_without_joining(self._slam, ())
            self._nis[step] = report.nis
            self._dof[step] = report.degrees_of_freedom
            self._count(report)
            self._meet_new(mapped_ids(self._slam))
        self._updated.put(step, updated)
        if step == self._steps - 1:
            self.belief = self._slam.belief()
            if isinstance(self._slam, SupportsJoin):
                self._updated.put(step, self.belief)
        if step == self._steps - 1 or self._history.is_due(step, self._ids):
            self._history.append(view_map(self._slam))
        else:
            self._history.leave_out()

    def counts(self) -> ReadingCounts:
        """Count the readings by what became of them."""
        return ReadingCounts(**self._readings)

    def changes(self) -> MapChanges:
        """Count what was done to the map."""
        return MapChanges(**self._changes)

    def _count(self, report: UpdateReport) -> None:
        for fate in ("associated", "added", "rejected", "skipped", "near"):
            self._readings[fate] += len(getattr(report, f"{fate}_ids"))
        self._readings["tentative"] += len(report.tentative_rows)
        self._readings["ambiguous"] += len(report.ambiguous_rows)
        for change in ("confirmed", "removed", "merged"):
            self._changes[change] += len(getattr(report, f"{change}_ids"))

    def trace(self, name: str, times: Array, log: SlamLog) -> RunTrace:
        """Make the trace of a run over a log."""
        belief = self.belief
        first = [self._first[i] for i in belief.landmark_ids]
        first_covariance = self._first_covariance
        if first_covariance is None:
            first_covariance = self._updated.covariances[0]
        return RunTrace(
            estimator=name,
            t=times,
            time_unit="steps" if _counts_steps(times) else "s",
            frame=belief.frame,
            predicted_poses=self._predicted.poses,
            predicted_pose_covariances=self._predicted.covariances,
            poses=self._updated.poses,
            pose_covariances=self._updated.covariances,
            true_poses=true_poses_of(log, times),
            nis=self._nis,
            nis_dof=self._dof,
            landmark_ids=np.array(belief.landmark_ids, dtype=np.int64),
            landmarks=belief.landmarks,
            first_landmarks=np.array([mean for mean, _ in first]).reshape(-1, 2),
            first_landmark_covariances=np.array([P for _, P in first]).reshape(
                -1, 2, 2
            ),
            landmark_history=self._history,
            true_landmarks=true_landmarks_of(
                log, belief.landmark_ids, belief.landmarks
            ),
            first_covariance=first_covariance,
            final_covariance=belief.covariance,
        )

    def _meet_new(self, ids: tuple[int, ...]) -> None:
        """Remember landmarks as they are when they enter the map."""
        if ids == self._ids:
            return
        new = [i for i in ids if i not in self._first]
        belief = marginal_without_joining(self._slam, new)
        if self._first_covariance is None:
            self._first_covariance = belief.covariance
        pairs = zip(belief.landmarks, belief.landmark_covariances, strict=True)
        self._first |= dict(zip(new, pairs, strict=True))
        self._ids = ids
        self._changes["most"] = max(self._changes["most"], len(ids))


class _PoseTrack:
    """Poses (steps, 3) and their covariances (steps, 3, 3)."""

    def __init__(self, steps: int) -> None:
        self.poses = np.empty((steps, 3))
        self.covariances = np.empty((steps, 3, 3))

    def put(self, step: int, belief: Belief) -> None:
        self.poses[step] = belief.pose
        self.covariances[step] = belief.pose_covariance
