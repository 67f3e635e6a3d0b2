"""Feed a log to an estimator, and keep what it believes at every step."""

import contextlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from itertools import chain

import numpy as np

from ...arrays import Array
from ...estimator.interface import (
    Belief,
    SlamEstimator,
    SupportsJoin,
    SupportsTruth,
    UpdateReport,
)
from ...estimator.map_management.hypotheses import HypothesisSlam
from ...estimator.map_management.managed_slam import ManagedSlam
from ...estimator.map_management.map_editor import marginal_without_joining
from ..logs.anonymous import hides_identities, true_ids_of
from ..logs.events import Scan
from ..logs.ground_truth import true_poses_of
from ..logs.slamlog import SlamLog
from ..logs.steps import Step, predictions, steps_of
from .association import DecisionRecorder, RunDecisions
from .blas_threads import one_blas_thread
from .map_history import MapHistory
from .memory_check import refuse_large_map
from .run_recorder import MapChanges, ReadingCounts, RunRecorder
from .trace import RunTrace

Progress = Callable[[int, int], object]
Watcher = Callable[[int, SlamEstimator, UpdateReport | None], object]

_MOST_MAPS = 500  # kept of a run by default
_MOST_JOINED = 50  # the same where each must be joined from submaps


@dataclass(frozen=True, eq=False)
class Replay:
    """An estimator's run over a log."""

    log: SlamLog
    """The log."""
    trace: RunTrace
    """The estimator's belief after every step."""
    belief: Belief
    """Its belief at the end."""
    scans: int
    """Number of scans in the log."""
    readings: ReadingCounts
    """Their readings, counted by what became of them."""
    changes: MapChanges = field(default_factory=MapChanges)
    """Changes of its map."""
    last_seen: Mapping[int, int] = field(default_factory=dict)
    """The step of the last reading of each landmark."""
    decisions: RunDecisions | None = None
    """Its decisions about readings without identity, if the log has true ids."""


def replay(
    log: SlamLog,
    estimator: SlamEstimator,
    *,
    name: str | None = None,
    keep_history: bool = False,
    progress: Progress | None = None,
    watch: Watcher | None = None,
) -> Replay:
    """Feed a log to an estimator: for each step its motion, then its scan.

    For a filter that joins its map on demand (``submaps``), the trace holds the local
    belief around the robot as of the last closed submap; the map is joined for the
    pictures and at the end.

    Parameters
    ----------
    log : SlamLog
        The log; a scan without landmark ids is left to the estimator to associate.
    estimator : SlamEstimator
        At its start, with an empty map; afterwards it is at the end of the log.
        One that observes the truth (``ideal``) receives it, if the log holds all of it.
    name : str, optional
        Name of the estimator in the trace; its class by default.
    keep_history : bool, default False
        Whether the trace keeps the map after every step, for pictures of each, or
        only of some hundred steps spread over the run.
    progress : callable, optional
        Called with (steps done, steps) after every step.
    watch : callable, optional
        Called with (step, estimator, report) after every step; the report is None if
        the step has no scan. It must not change the estimator.

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
        If memory does not suffice for the landmarks that the log names.

    Examples
    --------
    >>> from slamgym.estimator import make_estimator
    >>> from slamgym.experiments.logs import OdometryRow, Scan, SlamLog
    >>> scans = [Scan(t, np.array([[0.0, 5.0 - 2 * t]]), [4]) for t in (0.0, 1.0)]
    >>> log = SlamLog("drive", events=(scans[0], OdometryRow(1, 2.0, 0.0, 1), scans[1]))
    >>> slam = make_estimator("ekf", motion_std=(0.1,) * 3, measurement_std=(0.1, 0.1))
    >>> replay(log, slam).readings
    ReadingCounts(associated=1, added=1, rejected=0, skipped=0, near=1, ...
    """
    refuse_large_map(log, estimator)
    steps = list(steps_of(log))
    times = np.array([step.t for step in steps], dtype=np.float64)
    show_truth = _truth_source(estimator, log, times)
    recorder = RunRecorder(estimator, len(steps), _history(estimator, keep_history))
    decisions = DecisionRecorder(estimator)
    watch, progress = watch or _unwatched, progress or _unwatched
    with one_blas_thread():
        for number, step in enumerate(steps):
            with _naming_time(log, step):
                show_truth(number)
                report = _take(step, log, estimator, recorder, decisions)
            watch(number, estimator, report)
            progress(number + 1, len(steps))
    made = decisions.result() if hides_identities(log) else None
    identities = None if made is None else made.identities()
    trace = recorder.trace(_name_of(estimator, name), times, log, identities)
    return Replay(
        log,
        trace,
        recorder.belief,
        scans=sum(step.scan is not None for step in steps),
        readings=recorder.counts(),
        changes=recorder.changes(),
        last_seen=recorder.last_seen,
        decisions=made,
    )


def _history(estimator: SlamEstimator, keep_all: bool) -> MapHistory:
    if keep_all:
        return MapHistory(None)
    joins = isinstance(estimator, SupportsJoin)
    return MapHistory(_MOST_JOINED if joins else _MOST_MAPS)


def _unwatched(*_: object) -> None:
    """Watch nothing."""


def _name_of(estimator: SlamEstimator, given: str | None) -> str:
    """Return a given name, or that of the class; of a managed filter, the filter's."""
    if given:
        return given
    if isinstance(estimator, ManagedSlam | HypothesisSlam):
        return type(estimator.filter).__name__
    return type(estimator).__name__


def _truth_source(
    estimator: SlamEstimator, log: SlamLog, times: Array
) -> Callable[[int], None]:
    """Return the function that passes the truth of a step to an observing estimator.

    It does nothing for other estimators, or if the log lacks a part of the truth.
    """
    if not isinstance(estimator, SupportsTruth) or hides_identities(log):
        return _unwatched  # with hidden identities, the estimator's ids are its own
    poses = true_poses_of(log, times)
    landmarks = dict(zip(log.landmark_ids.tolist(), log.landmarks, strict=True))
    if poses is None or not np.isfinite(poses).all():
        return _unwatched
    if not _seen(log) <= landmarks.keys():
        return _unwatched
    return lambda step: estimator.observe_truth(poses[step], landmarks)


def _seen(log: SlamLog) -> set[int]:
    """Return the ids of the landmarks that the log has readings of."""
    scans = (event for event in log.events if isinstance(event, Scan))
    return set(chain.from_iterable(_ids(scan) or () for scan in scans))


def _take(
    step: Step,
    log: SlamLog,
    estimator: SlamEstimator,
    recorder: RunRecorder,
    decisions: DecisionRecorder,
) -> UpdateReport | None:
    for row in step.motions:
        for odometry, dt in predictions(row, log.motion):
            estimator.predict(odometry, dt)
    predicted = marginal_without_joining(estimator, ())
    report = None
    if step.scan is not None:
        report = estimator.update(step.scan.measurements, _ids(step.scan))
        decisions.add(report, true_ids_of(step.scan))
    recorder.add(predicted, report)
    return report


@contextlib.contextmanager
def _naming_time(log: SlamLog, step: Step) -> Iterator[None]:
    """Name the time of a step in the estimator's errors."""
    try:
        yield
    except ValueError as error:
        is_numerical = isinstance(error, np.linalg.LinAlgError)
        kind = np.linalg.LinAlgError if is_numerical else ValueError
        raise kind(f"{log.name}, t = {step.t:g}: {error}") from error


def _ids(scan: Scan) -> list[int] | None:
    return None if scan.landmark_ids is None else scan.landmark_ids.tolist()
