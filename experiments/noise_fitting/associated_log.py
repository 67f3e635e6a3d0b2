"""Associate the readings of a log without identities, and write them into the log."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np

from ...arrays import Array, IntArray
from ...estimator.interface import SlamEstimator
from ...estimator.map_management.hypotheses import HypothesisSlam
from ...estimator.map_management.managed_slam import ManagedSlam
from ...estimator.smoother import Drive, RecordedSlam
from ...estimator.smoother.drive import Sightings
from ..logs.events import OdometryRow, Scan
from ..logs.slamlog import SlamLog
from ..logs.steps import predictions, steps_of
from ..runs.filter_settings import SMOOTHER, FilterSettings
from ..runs.log_replay import Progress, replay


def associated_log(
    log: SlamLog, settings: FilterSettings, progress: Progress | None = None
) -> SlamLog:
    """Return a log with the identities on which a filter decides.

    The landmarks are those of the filter's final map, as for the smoother; readings of
    others are left out. The odometry between two scans gets the time of the second one.
    True positions of landmarks are left out, because their ids would be others.

    Parameters
    ----------
    log : SlamLog
        Without identities.
    settings : FilterSettings
        Of the filter, with its landmark management.
    progress : callable, optional
        Called with (steps done, steps).
    """
    options = {**settings.options, "follow": settings.estimator}
    slam = replace(settings, estimator=SMOOTHER, options=options).make(log.start)
    replay(log, slam, progress=progress)
    header = {k: v for k, v in log.header.items() if k != "identities"}
    return replace(
        log,
        header=header,
        motion="turn-last",
        events=tuple(_events(log, _recorded(slam))),
        landmark_ids=np.empty(0, dtype=np.int64),
        landmarks=np.empty((0, 2)),
    )


def _recorded(slam: SlamEstimator) -> Drive:
    """Return the drive that a managed smoother has recorded."""
    inner = slam.best if isinstance(slam, HypothesisSlam) else slam
    inner = inner.filter if isinstance(inner, ManagedSlam) else inner
    if not isinstance(inner, RecordedSlam):
        raise ValueError(f"{type(inner).__name__} records no associations")
    return inner.recorded()


def _events(log: SlamLog, drive: Drive) -> Iterator[OdometryRow | Scan]:
    """Yield the events of a drive, pose by pose."""
    motions = [motion.steps for motion in drive.motions]
    times = _times_after(log, np.cumsum([len(steps) for steps in motions]))
    for pose, (steps, t) in enumerate(zip(motions, times.tolist(), strict=True)):
        for distance, turn, dt in steps:
            yield OdometryRow(t, distance, turn, dt)
        for readings, ids in _distinct(drive.sightings(pose)):
            yield Scan(t, readings, ids)


def _distinct(sightings: Sightings) -> Iterable[Sightings]:
    """Split the readings of one pose so that no landmark repeats."""
    _, which = np.unique(sightings.ids, return_inverse=True)
    turn = np.array([(which[:k] == j).sum() for k, j in enumerate(which)], dtype=int)
    for part in range(turn.max(initial=-1) + 1):
        chosen = turn == part
        yield Sightings(sightings.measurements[chosen], sightings.ids[chosen])


def _times_after(log: SlamLog, counts: IntArray) -> Array:
    """Return the times after these numbers of predictions."""
    times, until, done = [], [], 0
    for step in steps_of(log):
        done += sum(len(predictions(row, log.motion)) for row in step.motions)
        times.append(step.t)
        until.append(done)
    reached = np.searchsorted(until, counts)
    return np.array(times)[np.minimum(reached, len(times) - 1)]
