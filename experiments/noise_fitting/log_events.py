"""The events of a log as arrays for the kernels: motions, readings, landmarks."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ...arrays import Array, BoolArray
from ...estimator.interface import SlamEstimator
from ...estimator.kernels.drive_likelihood import DriveEvents
from ...estimator.map_management.hypotheses import HypothesisSlam
from ...estimator.map_management.managed_slam import ManagedSlam
from ...estimator.smoother import Drive, RecordedSlam
from ...estimator.smoother.drive import Sightings
from ..logs.anonymous import hides_identities
from ..logs.events import OdometryRow
from ..logs.slamlog import SlamLog
from ..logs.steps import predictions, steps_of
from ..runs.filter_settings import SMOOTHER, FilterSettings
from ..runs.log_replay import Progress, replay

Motion = tuple[float, float, float]


class TimedEvents(NamedTuple):
    """The events of a log, and the time of each step."""

    events: DriveEvents
    times: Array
    """Shape (S,)."""


def events_of(
    log: SlamLog, settings: FilterSettings, progress: Progress | None = None
) -> TimedEvents:
    """Return the events of a log; a filter associates readings without identity.

    Raises
    ------
    ValueError
        If the log has no scan, no motion, or no landmark that is read twice.
    """
    if hides_identities(log):
        timed = _associated(log, settings, progress)
    else:
        timed = _identified(log)
    _refuse_empty(log, timed.events)
    return timed


def without_readings(events: DriveEvents, dropped: BoolArray) -> DriveEvents:
    """Return the events without some readings, where ``dropped`` (M,) is True."""
    kept = ~dropped
    counts = np.concatenate([[0], np.cumsum(kept)])
    return events._replace(
        readings=events.readings[kept],
        landmarks=events.landmarks[kept],
        first_readings=counts[events.first_readings],
    )


def parts_of(events: DriveEvents, most: int) -> tuple[DriveEvents, ...]:
    """Cut a drive into consecutive parts of at most so many landmarks each.

    The landmarks of each part are numbered from 0.  A step with more landmarks is a
    part of its own.
    """
    begins, seen = [0], set[int]()
    for s in range(len(events.first_readings) - 1):
        first, end = events.first_readings[s : s + 2]
        read = set(events.landmarks[first:end].tolist())
        if seen and len(seen | read) > most:
            begins.append(s)
            seen = set()
        seen |= read
    if len(begins) == 1:
        return (events,)
    ends = [*begins[1:], len(events.first_readings) - 1]
    return tuple(
        _part(events, begin, end) for begin, end in zip(begins, ends, strict=True)
    )


def _part(events: DriveEvents, begin: int, end: int) -> DriveEvents:
    motions = events.first_motions[begin : end + 1]
    readings = events.first_readings[begin : end + 1]
    within = slice(readings[0], readings[-1])
    _, landmarks = np.unique(events.landmarks[within], return_inverse=True)
    return DriveEvents(
        events.motions[motions[0] : motions[-1]],
        motions - motions[0],
        events.readings[within],
        landmarks.astype(np.int64),
        readings - readings[0],
    )


class _EventList:
    """Collects steps one after the other."""

    def __init__(self) -> None:
        self.motions: list[Motion] = []
        self.sightings = [Sightings(np.empty((0, 2)), np.empty(0, dtype=np.int64))]
        self.until_motions, self.until_readings = [0], [0]

    def add(self, motions: Iterable[Motion], sightings: Sightings | None) -> None:
        """Append a step."""
        self.motions += motions
        count = 0
        if sightings is not None:
            self.sightings.append(sightings)
            count = len(sightings.ids)
        self.until_motions.append(len(self.motions))
        self.until_readings.append(self.until_readings[-1] + count)

    def events(self) -> DriveEvents:
        """Return all steps as arrays, the landmarks numbered by their ids."""
        readings, ids = zip(*self.sightings, strict=True)
        _, landmarks = np.unique(np.concatenate(ids), return_inverse=True)
        return DriveEvents(
            np.array(self.motions, dtype=np.float64).reshape(-1, 3),
            np.array(self.until_motions, dtype=np.int64),
            np.concatenate(readings),
            landmarks.astype(np.int64),
            np.array(self.until_readings, dtype=np.int64),
        )


def _identified(log: SlamLog) -> TimedEvents:
    """Return events whose steps are those of a replay."""
    collected, times = _EventList(), []
    for step in steps_of(log):
        motions = _motions_of(log, step.motions)
        scan, sightings = step.scan, None
        if scan is not None and scan.landmark_ids is not None:
            sightings = Sightings(scan.measurements, scan.landmark_ids)
        collected.add(motions, sightings)
        times.append(step.t)
    return TimedEvents(collected.events(), np.array(times))


def _associated(
    log: SlamLog, settings: FilterSettings, progress: Progress | None
) -> TimedEvents:
    """Return events with one step per scan, as a filter associates the readings.

    The landmarks are those of its final map, as for the smoother.
    """
    options = {**settings.options, "follow": settings.estimator}
    slam = replace(settings, estimator=SMOOTHER, options=options).make(log.start)
    replay(log, slam, progress=progress)
    drive = _recorded(slam)
    collected, counts = _EventList(), []
    for pose in range(drive.poses):
        motions: tuple[Motion, ...] = drive.motions[pose].steps
        for sightings in _distinct(drive.sightings(pose)):
            collected.add(motions, sightings)
            motions = ()
            counts.append(len(collected.motions))
    return TimedEvents(collected.events(), _times_at(log, counts))


def _recorded(slam: SlamEstimator) -> Drive:
    """Return the drive that a managed smoother has recorded."""
    inner = slam.best if isinstance(slam, HypothesisSlam) else slam
    inner = inner.filter if isinstance(inner, ManagedSlam) else inner
    if not isinstance(inner, RecordedSlam):
        raise ValueError(f"{type(inner).__name__} records no associations")
    return inner.recorded()


def _distinct(sightings: Sightings) -> Iterable[Sightings]:
    """Split the readings of one pose so that no landmark repeats; at least one part."""
    _, which = np.unique(sightings.ids, return_inverse=True)
    turn = np.array([(which[:k] == j).sum() for k, j in enumerate(which)], dtype=int)
    for part in range(turn.max(initial=0) + 1):
        chosen = turn == part
        yield Sightings(sightings.measurements[chosen], sightings.ids[chosen])


def _times_at(log: SlamLog, counts: list[int]) -> Array:
    """Return the times after these numbers of odometry readings."""
    times, until, done = [], [], 0
    for step in steps_of(log):
        done += len(_motions_of(log, step.motions))
        times.append(step.t)
        until.append(done)
    reached = np.searchsorted(until, counts)
    return np.array(times)[np.minimum(reached, len(times) - 1)]


def _motions_of(log: SlamLog, rows: Iterable[OdometryRow]) -> list[Motion]:
    return [(*u, dt) for row in rows for u, dt in predictions(row, log.motion)]


def _refuse_empty(log: SlamLog, events: DriveEvents) -> None:
    if not len(events.readings):
        raise ValueError(
            f"{log.name} holds no scan: without readings of landmarks there are no "
            "innovations to fit a noise to"
        )
    if not events.motions[:, :2].any():
        raise ValueError(
            f"{log.name} holds no motion: the noise of a robot at rest cannot be fitted"
        )
    if len(np.unique(events.landmarks)) == len(events.landmarks):
        raise ValueError(
            f"{log.name} reads no landmark twice: there are no innovations to fit a "
            "noise to"
        )
