"""The events of a log as arrays for the kernels: motions, readings, landmarks."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from ...arrays import Array, BoolArray, IntArray
from ...estimator.kernels.drive_likelihood import DriveEvents
from ...estimator.smoother.drive import Sightings
from ..logs.events import OdometryRow
from ..logs.slamlog import SlamLog
from ..logs.steps import predictions, steps_of

Motion = tuple[float, float, float]
Stretch = tuple[int, int]
"""Steps of a drive, from the first to before the second."""


class TimedEvents(NamedTuple):
    """The events of a log, and the time of each step."""

    events: DriveEvents
    times: Array
    """Shape (S,)."""


def events_of(log: SlamLog) -> TimedEvents:
    """Return the events of a log that identifies its readings, one step of each replay.

    Raises
    ------
    ValueError
        If the log has no scan, no motion, or no landmark that is read twice.
    """
    collected, times = _EventList(), []
    for step in steps_of(log):
        motions = _motions_of(log, step.motions)
        scan, sightings = step.scan, None
        if scan is not None and scan.landmark_ids is not None:
            sightings = Sightings(scan.measurements, scan.landmark_ids)
        collected.add(motions, sightings)
        times.append(step.t)
    timed = TimedEvents(collected.events(), np.array(times))
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


def stretches_of(events: DriveEvents, most: int) -> list[Stretch]:
    """Cut a drive into consecutive stretches with at most so many landmarks each.

    A step with more landmarks is a stretch of its own.
    """
    begins, seen = [0], set[int]()
    for s in range(len(events.first_readings) - 1):
        first, end = events.first_readings[s : s + 2]
        read = set(events.landmarks[first:end].tolist())
        if seen and len(seen | read) > most:
            begins.append(s)
            seen = set()
        seen |= read
    return list(pairwise([*begins, len(events.first_readings) - 1]))


def parts_of(
    events: DriveEvents, stretches: Sequence[Stretch]
) -> tuple[DriveEvents, ...]:
    """Return stretches of a drive, the landmarks of each numbered from 0."""
    if len(stretches) == 1:
        return (events,)
    return tuple(_part(events, *stretch) for stretch in stretches)


def sample_of(
    events: DriveEvents, stretches: Sequence[Stretch], most_readings: int
) -> tuple[DriveEvents, list[Stretch]]:
    """Return evenly spread stretches of a drive as one drive, and where they are there.

    About as many readings as asked remain.
    """
    every = int(np.ceil(len(events.readings) / most_readings))
    chosen = stretches[every // 2 :: every] if every > 1 else stretches
    ends = np.cumsum([0, *(end - begin for begin, end in chosen)]).tolist()
    return _joined(events, chosen), list(pairwise(ends))


def _joined(events: DriveEvents, stretches: Sequence[Stretch]) -> DriveEvents:
    def rows(first: IntArray) -> tuple[IntArray, IntArray]:
        """Return which rows are in the stretches, and where those of a step begin."""
        spans = [np.arange(first[begin], first[end]) for begin, end in stretches]
        counts = [np.diff(first[begin : end + 1]) for begin, end in stretches]
        until = np.concatenate([[0], np.cumsum(np.concatenate(counts))])
        return np.concatenate(spans), until

    motions, first_motions = rows(events.first_motions)
    readings, first_readings = rows(events.first_readings)
    return DriveEvents(
        events.motions[motions],
        first_motions,
        events.readings[readings],
        events.landmarks[readings],
        first_readings,
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
