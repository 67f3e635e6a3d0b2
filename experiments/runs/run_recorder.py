"""Record what an estimator believes during a run, step by step, as a trace."""

from collections import Counter
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from ...arrays import Array
from ...estimator.interface import Belief, SlamEstimator, SupportsJoin, UpdateReport
from ...estimator.map_management.map_editor import (
    mapped_ids,
    marginal_without_joining,
    view_map,
)
from ..logs.ground_truth import true_landmarks_of, true_poses_of
from ..logs.slamlog import SlamLog
from .map_history import MapHistory
from .trace import RunTrace


class ReadingCounts(NamedTuple):
    """The readings of a log, counted by what became of them."""

    associated: int = 0
    """Corrected the belief."""
    added: int = 0
    """Added a landmark to the map."""
    rejected: int = 0
    """Rejected by the chi-square gate."""
    skipped: int = 0
    """Too close to use."""
    near: int = 0
    """Associated ones within 10 σ of the robot, where linearisation is poor."""
    tentative: int = 0
    """Supported landmarks that are not yet confirmed."""
    ambiguous: int = 0
    """Fitted more than one landmark."""


class MapChanges(NamedTuple):
    """Changes of the map of a run other than added landmarks."""

    confirmed: int = 0
    """Tentative landmarks that were confirmed."""
    removed: int = 0
    """Landmarks marginalised."""
    merged: int = 0
    """Landmarks merged into another one."""
    most: int = 0
    """Largest size of the map."""


class RunRecorder:
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
        self.last_seen: dict[int, int] = {}
        """The step of the last reading of each landmark."""

    def add(self, predicted: Belief, report: UpdateReport | None) -> None:
        """Record one step, after the scan at its end."""
        step = len(self._history)
        self._predicted.put(step, predicted)
        updated = predicted
        if report is not None:
            updated = marginal_without_joining(self._slam, ())
            self._nis[step] = report.nis
            self._dof[step] = report.degrees_of_freedom
            self._count(report)
            seen = (*report.associated_ids, *report.added_ids)
            self.last_seen |= dict.fromkeys(seen, step)
            self._keep_new(mapped_ids(self._slam))
        self._updated.put(step, updated)
        if step == self._steps - 1:
            self.belief = self._slam.belief()
            if isinstance(
                self._slam, SupportsJoin
            ):  # the joined map corrects the pose too
                self._updated.put(step, self.belief)
        if step == self._steps - 1 or self._history.is_due(step, self._ids):
            self._history.append(view_map(self._slam))
        else:
            self._history.leave_out()

    def counts(self) -> ReadingCounts:
        """Count the readings."""
        return ReadingCounts(**self._readings)

    def changes(self) -> MapChanges:
        """Count the changes of the map."""
        return MapChanges(**self._changes)

    def _count(self, report: UpdateReport) -> None:
        for outcome in ("associated", "added", "rejected", "skipped", "near"):
            self._readings[outcome] += len(getattr(report, f"{outcome}_ids"))
        self._readings["tentative"] += len(report.tentative_rows)
        self._readings["ambiguous"] += len(report.ambiguous_rows)
        for change in ("confirmed", "removed", "merged"):
            self._changes[change] += len(getattr(report, f"{change}_ids"))

    def trace(
        self,
        name: str,
        times: Array,
        log: SlamLog,
        identities: Mapping[int, int] | None = None,
    ) -> RunTrace:
        """Return the trace of the run; identities are those of its own landmarks."""
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
                log, belief.landmark_ids, belief.landmarks, identities
            ),
            first_covariance=first_covariance,
            final_covariance=belief.covariance,
        )

    def _keep_new(self, ids: tuple[int, ...]) -> None:
        """Keep landmarks as they are when they enter the map."""
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


def _counts_steps(times: Array) -> bool:
    return bool((times == np.arange(len(times))).all())
