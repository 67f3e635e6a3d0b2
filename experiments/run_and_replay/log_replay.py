"""Feed a log to an estimator, and keep what it believes at every step."""

from __future__ import annotations

import contextlib
import math
from bisect import bisect_right
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from os import PathLike
from typing import Generic, NamedTuple, TypeVar, overload

import numpy as np

from ...arrays import Array
from ...estimator import interface
from ...estimator.interface import Belief, MapView, SlamEstimator, UpdateReport
from ..logs import ground_truth, recording, slamlog
from .filter_settings import given_log, one_blas_thread, refuse_large_map, settings_for
from .trace import (
    DecisionRecorder,
    MapEstimate,
    RunDecisions,
    RunTrace,
    alarm_of,
    is_finite,
)

Progress = Callable[[int, int], object]
Watcher = Callable[[int, SlamEstimator, UpdateReport | None], object]

_MOST_MAPS = 500  # kept of a run by default
_MOST_JOINED = 50  # the same where each must be joined from submaps


class MapChanges(NamedTuple):
    """Changes of the map of a run other than added landmarks."""

    #: Tentative landmarks that were confirmed.
    confirmed: int = 0
    #: Landmarks marginalised.
    removed: int = 0
    #: Landmarks merged into another one.
    merged: int = 0
    #: Largest size of the map.
    most: int = 0


@dataclass(frozen=True, eq=False)
class Replay:
    """An estimator's run over a log."""

    #: The log.
    log: slamlog.SlamLog
    #: The estimator's belief after every step.
    trace: RunTrace
    #: Its belief at the end.
    belief: Belief
    #: Number of scans in the log.
    scans: int
    #: Their readings, counted by what became of them.
    readings: ReadingCounts
    #: Changes of its map.
    changes: MapChanges = field(default_factory=MapChanges)
    #: The step of the last reading of each landmark.
    last_seen: Mapping[int, int] = field(default_factory=dict)
    #: Its decisions about readings without identity, if the log has true ids.
    decisions: RunDecisions | None = None
    #: Whether it reports at the end that it is probably lost; None where identities are
    #: known, or it does not say.
    probably_lost: bool | None = None


def replay(
    log: slamlog.SlamLog | str | PathLike[str],
    estimator: SlamEstimator | str,
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
    log : SlamLog or path
        The log; a scan without landmark ids is left to the estimator to associate.
    estimator : SlamEstimator or str
        At its start, with an empty map; afterwards it is at the end of the log. Or the
        label of one, for the noise in the log, see `settings_for`.
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
    TypeError
        If the estimator is no filter, but a class, for example, or the log is none.
    numpy.linalg.LinAlgError
        If its covariance degenerates or is not finite, naming the time too.

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
    log = given_log(log)
    if isinstance(estimator, str):
        name = name or estimator
        estimator = settings_for(log, estimator=estimator).make(log.start)
    if isinstance(estimator, type) or not hasattr(estimator, "predict"):
        raise TypeError(
            f"estimator must be a filter, as make_estimator returns it, got {estimator}"
        )
    refuse_large_map(len(log.read_ids), estimator)
    steps = list(recording.steps_of(log))
    times = np.array([step.t for step in steps], dtype=np.float64)
    show_truth = _truth_source(estimator, log, times)
    most = _MOST_JOINED if interface.joins_its_map(estimator) else _MOST_MAPS
    history = MapHistory(None if keep_history else most)
    recorder = RunRecorder(estimator, len(steps), history)
    decisions = DecisionRecorder(estimator)
    watch, progress = watch or _unwatched, progress or _unwatched
    with one_blas_thread():
        for number, step in enumerate(steps):
            with _naming_time(log, step):
                show_truth(number)
                for row in step.motions:
                    for odometry, dt in recording.predictions(row, log.motion):
                        estimator.predict(odometry, dt)
                predicted = interface.marginal_without_joining(estimator, ())
                report: UpdateReport | None = None
                ids: list[int] | None = None
                if step.scan is not None:
                    named = step.scan.landmark_ids
                    ids = None if named is None else named.tolist()
                    report = estimator.update(step.scan.measurements, ids)
                    decisions.add(report, ground_truth.true_ids_of(step.scan))
                for fix_row in step.fixes:
                    taking = interface.taking_poses(estimator)
                    fix = taking.observe_pose(*fix_row.arguments)
                    report = interface.with_fix(report or UpdateReport(), fix)
                recorder.add(predicted, report, ids or ())
            watch(number, estimator, report)
            progress(number + 1, len(steps))
    hidden = ground_truth.hides_identities(log)
    made = decisions.result() if hidden else None
    identities = None if made is None else made.identities()
    trace = recorder.trace(_name_of(estimator, name), times, log, identities)
    return Replay(
        log,
        trace,
        recorder.belief,
        scans=sum(step.scan is not None for step in steps),
        readings=ReadingCounts(**recorder.readings),
        changes=MapChanges(**recorder.changes),
        last_seen=recorder.last_seen,
        decisions=made,
        probably_lost=alarm_of(estimator) if hidden else None,
    )


def _unwatched(*_: object) -> None:
    """Watch nothing."""


def _name_of(estimator: SlamEstimator, given: str | None) -> str:
    """Return a given name, or that of the class; of a managed filter, the filter's."""
    if given:
        return given
    from ...estimator.map_management.managed_slam import ManagedSlam  # noqa: PLC0415 (many)

    if isinstance(estimator, ManagedSlam):
        return type(estimator.filter).__name__
    return type(estimator).__name__


def _truth_source(
    estimator: SlamEstimator, log: slamlog.SlamLog, times: Array
) -> Callable[[int], None]:
    """Return the function that passes the truth of a step to an observing estimator.

    It does nothing for other estimators, or if the log lacks a part of the truth.
    """
    if not hasattr(estimator, "observe_truth"):
        return _unwatched
    if ground_truth.hides_identities(log):
        return _unwatched  # with hidden identities, the estimator's ids are its own
    poses = ground_truth.true_poses_of(log, times)
    landmarks = dict(zip(log.landmark_ids.tolist(), log.landmarks, strict=True))
    if poses is None or not np.isfinite(poses).all():
        return _unwatched
    if not landmarks.keys() >= log.read_ids:
        return _unwatched
    return lambda step: estimator.observe_truth(poses[step], landmarks)


@contextlib.contextmanager
def _naming_time(log: slamlog.SlamLog, step: recording.Step) -> Iterator[None]:
    """Name the time of a step in the estimator's errors."""
    try:
        yield
    except ValueError as error:
        is_numerical = isinstance(error, np.linalg.LinAlgError)
        kind = np.linalg.LinAlgError if is_numerical else ValueError
        raise kind(f"{log.name}, t = {step.t:g}: {error}") from error
    except Exception as error:
        error.add_note(f"the estimator failed, {log.name}, t = {step.t:g}")
        raise


class ReadingCounts(NamedTuple):
    """The readings of a log, counted by what became of them."""

    #: Corrected the belief.
    associated: int = 0
    #: Added a landmark to the map.
    added: int = 0
    #: Rejected by the chi-square gate.
    rejected: int = 0
    #: Too close to use.
    skipped: int = 0
    #: Associated ones within 10 σ of the robot, where linearisation is poor.
    near: int = 0
    #: Supported landmarks that are not yet confirmed.
    tentative: int = 0
    #: Fitted more than one landmark.
    ambiguous: int = 0
    #: Of landmarks that were not placed in the map when they were read.
    waiting: int = 0


_PREDICTED, _UPDATED, _BOTH = 0, 1, slice(None)


class RunRecorder:
    """Collect beliefs and reports, step by step, into the arrays of a trace."""

    def __init__(self, slam: SlamEstimator, steps: int, history: MapHistory) -> None:
        self._slam, self._steps = slam, steps
        self._poses = np.empty((2, steps, 3))  # predicted, then updated
        self._covariances = np.empty((2, steps, 3, 3))
        self._nis = np.zeros(steps)
        self._dof = np.zeros(steps, dtype=np.int64)
        self._history = history
        self._first: dict[int, tuple[Array, Array]] = {}
        self._first_covariance = self._covariances[_UPDATED, 0]  # until there is a map
        self._ids: tuple[int, ...] = ()
        #: The fields of `ReadingCounts` and of `MapChanges`.
        self.readings: Counter[str] = Counter()
        self.changes: Counter[str] = Counter()
        #: The step of the last reading of each landmark.
        self.last_seen: dict[int, int] = {}

    def add(
        self, predicted: Belief, report: UpdateReport | None, named: Sequence[int] = ()
    ) -> None:
        """Record one step, after the scan at its end, which names some landmarks."""
        step = len(self._history)
        self._put(_BOTH if report is None else _PREDICTED, step, predicted)
        if report is not None:
            updated = interface.marginal_without_joining(self._slam, ())
            self._put(_UPDATED, step, updated)
            self._nis[step] = report.nis
            self._dof[step] = report.degrees_of_freedom
            self._count(report)
            seen = (*report.associated_ids, *report.added_ids)
            self.last_seen |= dict.fromkeys(seen, step)
            self._keep_new(interface.mapped_ids(self._slam))
            if waiting := set(named).difference(seen, report.rejected_ids):
                waiting -= {*report.skipped_ids, *self._ids}
                self.readings["waiting"] += len(waiting)
        is_last = step == self._steps - 1
        if is_last:
            self.belief = self._slam.belief()
            self._put(_UPDATED, step, self.belief)  # a joined map corrects the pose
        is_due = is_last or self._history.is_due(step, self._ids)
        self._history.append(interface.view_map(self._slam) if is_due else None)

    def _put(self, track: int | slice, step: int, belief: Belief) -> None:
        if not is_finite(belief):
            raise np.linalg.LinAlgError("the belief is not finite")
        self._poses[track, step] = belief.pose
        self._covariances[track, step] = belief.pose_covariance

    def _count(self, report: UpdateReport) -> None:
        for outcome in ("associated", "added", "rejected", "skipped", "near"):
            self.readings[outcome] += len(getattr(report, f"{outcome}_ids"))
        self.readings["tentative"] += len(report.tentative_rows)
        self.readings["ambiguous"] += len(report.ambiguous_rows)
        for change in ("confirmed", "removed", "merged"):
            self.changes[change] += len(getattr(report, f"{change}_ids"))

    def trace(
        self,
        name: str,
        times: Array,
        log: slamlog.SlamLog,
        identities: Mapping[int, int] | None = None,
    ) -> RunTrace:
        """Return the trace of the run; identities are those of its own landmarks."""
        belief = self.belief
        first = [self._first[i] for i in belief.landmark_ids]
        covariances = np.array([P for _, P in first]).reshape(-1, 2, 2)
        return RunTrace(
            estimator=name,
            t=times,
            time_unit="steps" if (times == np.arange(len(times))).all() else "s",
            frame=belief.frame,
            predicted_poses=self._poses[_PREDICTED],
            predicted_pose_covariances=self._covariances[_PREDICTED],
            poses=self._poses[_UPDATED],
            pose_covariances=self._covariances[_UPDATED],
            true_poses=ground_truth.true_poses_of(log, times),
            nis=self._nis,
            nis_dof=self._dof,
            landmark_ids=np.array(belief.landmark_ids, dtype=np.int64),
            landmarks=belief.landmarks,
            first_landmarks=np.array([mean for mean, _ in first]).reshape(-1, 2),
            first_landmark_covariances=covariances,
            landmark_history=self._history,
            true_landmarks=ground_truth.true_landmarks_of(
                log,
                belief.landmark_ids,
                belief.landmarks,
                (times, self._poses[_UPDATED]),
                identities,
            ),
            world_landmarks=log.landmarks,
            first_covariance=self._first_covariance,
            final_covariance=belief.covariance,
        )

    def _keep_new(self, ids: tuple[int, ...]) -> None:
        """Keep landmarks as they are when they enter the map."""
        if ids == self._ids:
            return
        new = [i for i in ids if i not in self._first]
        belief = interface.marginal_without_joining(self._slam, new)
        if not self._first:
            self._first_covariance = belief.covariance
        pairs = zip(belief.landmarks, belief.landmark_covariances, strict=True)
        self._first |= dict(zip(new, pairs, strict=True))
        self._ids = ids
        self.changes["most"] = max(self.changes["most"], len(ids))


class MapHistory(Sequence[MapEstimate]):
    """The maps of a run, one per step; a step without one has the map before it.

    Parameters
    ----------
    most : int, optional
        Number of maps to keep, evenly spaced over the run; all by default. The first
        map with a landmark and the latest one are kept in addition.

    Examples
    --------
    >>> history = MapHistory(most=2)
    >>> for x in range(5):
    ...     history.append(Belief(np.array([0, 0, 0, x, 0.0]), np.eye(5), (7,)))
    >>> [float(landmarks.means[0, 0]) for landmarks in history]
    [0.0, 0.0, 2.0, 2.0, 4.0]
    """

    def __init__(self, most: int | None = None) -> None:
        most_steps = math.inf if most is None else most
        self._kept = ThinnedSteps[MapEstimate](most_steps, math.inf, last=-1)
        self._first_map: int | None = None
        self._length = 0

    def append(self, belief: Belief | MapView | None) -> None:
        """Append the belief after the next step; None if it is neither due nor last."""
        step = self._length
        self._length += 1
        if belief is None:
            return
        ids = belief.ids if isinstance(belief, MapView) else belief.landmark_ids
        means, covariances = belief.landmarks.copy(), belief.landmark_covariances
        self._latest = MapEstimate(np.array(ids, dtype=np.int64), means, covariances)
        if ids and self._first_map is None:
            self._first_map = step
            self._kept.always.add(step)
        if self._kept.is_due(step):
            self._kept.put(step, self._latest, size=0)

    def is_due(self, step: int, ids: Sequence[int]) -> bool:
        """Whether the map of a step will be kept; ``ids`` are the landmarks in it."""
        is_first_map = self._first_map is None and len(ids) > 0
        return is_first_map or self._kept.is_due(step)

    @overload
    def __getitem__(self, index: int) -> MapEstimate: ...
    @overload
    def __getitem__(self, index: slice) -> Sequence[MapEstimate]: ...
    def __getitem__(self, index: int | slice) -> MapEstimate | Sequence[MapEstimate]:
        """Return the map after a step, or the latest kept one before it."""
        if isinstance(index, slice):
            return [self[k] for k in range(*index.indices(self._length))]
        step = range(self._length)[index]
        if step == self._length - 1:
            return self._latest
        kept = list(self._kept.items)
        return self._kept.items[kept[bisect_right(kept, step) - 1]]

    def __len__(self) -> int:
        """Return the number of steps, kept or not."""
        return self._length


_Item = TypeVar("_Item")


class ThinnedSteps(Generic[_Item]):
    """Items by step; where they become too many, every second one is dropped.

    Parameters
    ----------
    most_steps : int
        Largest number of items, the last one not counted.
    most_size : int
        Largest sum of their sizes; at least two items are kept.
    last : int
        The last step, which is always kept.

    Attributes
    ----------
    items : dict of int to item
        The kept items, by their steps in ascending order.
    stride : int
        Steps between two items.
    always : set of int
        Steps whose items are kept, whatever the stride.

    Examples
    --------
    >>> kept = ThinnedSteps(most_steps=3, most_size=100, last=8)
    >>> for step in range(9):
    ...     if kept.is_due(step):
    ...         kept.put(step, f"map {step}", size=1)
    >>> list(kept.items), kept.stride
    ([0, 4, 8], 4)
    """

    def __init__(self, most_steps: float, most_size: float, last: int) -> None:
        self._most_steps, self._most_size = most_steps, most_size
        self._sizes: dict[int, int] = {}
        self._total = 0
        self.items: dict[int, _Item] = {}
        self.stride, self.always = 1, {last}

    def is_due(self, step: int) -> bool:
        """Whether the item of a step will be kept."""
        return step % self.stride == 0 or step in self.always

    def put(self, step: int, item: _Item, size: int) -> None:
        """Keep the item of a step that is due."""
        self.items[step], self._sizes[step] = item, size
        self._total += size
        while len(self.items) > 2 and (
            len(self.items) > self._most_steps + 1 or self._total > self._most_size
        ):
            self.stride *= 2
            for old in [k for k in self.items if not self.is_due(k)]:
                del self.items[old]
                self._total -= self._sizes.pop(old)
