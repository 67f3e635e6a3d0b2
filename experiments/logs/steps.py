"""Split a log into the steps of a filter: a motion, then the scan at its end.

Symbols
-------
u = (d, α)   odometry: drive d, then turn α [m, rad]
"""

from collections.abc import Iterator
from typing import NamedTuple

from .events import OdometryRow, Scan
from .slamlog import Motion, SlamLog


class Step(NamedTuple):
    """The motion between two times of a log, and the scan at the second one."""

    t: float
    """Time of the end [s, or steps]."""
    motions: tuple[OdometryRow, ...]
    """The motion; empty before the first scan, or between scans at rest."""
    scan: Scan | None
    """The scan at the end."""


class Prediction(NamedTuple):
    """One call of an estimator's ``predict``."""

    odometry: tuple[float, float]
    """(d, α) [m, rad]."""
    dt: float
    """Duration for the motion noise."""


def steps_of(log: SlamLog) -> Iterator[Step]:
    """Split a log into steps; step 0 is the start, before any motion.

    Odometry rows that end at the same time, such as a turn and a drive, are one
    motion. A scan belongs to the motion that ends at its time; a scan at another time
    is a step without motion.

    Parameters
    ----------
    log : SlamLog
        Any log.

    Yields
    ------
    Step
        At least one.

    Examples
    --------
    >>> rows = (OdometryRow(1.0, 0.0, 0.3, 0.0), OdometryRow(1.0, 2.0, 0.0, 1.0))
    >>> [len(step.motions) for step in steps_of(SlamLog("drive", events=rows))]
    [0, 2]
    """
    step = Step(_start_time(log), (), None)
    is_start = True
    for event in log.events:
        if isinstance(event, OdometryRow):
            if is_start or step.scan is not None or step.t != event.t:
                yield step
                step = Step(event.t, (), None)
            step = step._replace(motions=(*step.motions, event))
            is_start = False
        else:
            if step.scan is not None or step.t != event.t:
                yield step
                step, is_start = Step(event.t, (), None), False
            step = step._replace(scan=event)
    yield step


def predictions(row: OdometryRow, motion: Motion) -> tuple[Prediction, ...]:
    """Convert an odometry row to the motion model: drive d, then turn α.

    A midpoint row, an arc driven along the heading θ + α/2, is exactly two of them.

    Parameters
    ----------
    row : OdometryRow
        The row.
    motion : "turn-last" or "midpoint"
        Motion model of the log.

    Examples
    --------
    >>> for u, dt in predictions(OdometryRow(1.0, 2.0, 0.4, 1.0), "midpoint"):
    ...     print(u, dt)
    (0.0, 0.2) 0.0
    (2.0, 0.2) 1.0
    """
    if motion == "turn-last":
        return (Prediction((row.d, row.alpha), row.dt),)
    half = row.alpha / 2
    return Prediction((0.0, half), 0.0), Prediction((row.d, half), row.dt)


def _start_time(log: SlamLog) -> float:
    """Return the start time: of the first scan, or before the first motion."""
    if not log.events:
        return 0.0
    first = log.events[0]
    if isinstance(first, Scan):
        return first.t
    duration = 0.0
    for event in log.events:
        if not isinstance(event, OdometryRow) or event.t != first.t:
            break
        duration += event.dt
    return first.t - duration
