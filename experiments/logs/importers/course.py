"""The log of the EKF-SLAM homework of CMU 16-833 (``data.txt``).

Lines alternate: readings ``β r β r …`` of all landmarks, in the same order each time,
and odometry ``d α``, separated by white space.
"""

from os import PathLike
from pathlib import Path
from typing import cast

import numpy as np

from ....arrays import Array, IntArray
from ..events import EventRecorder, OdometryRow, Reading, Scan, wrap_bearing
from ..lines import LogError, LogLine, read_lines
from ..slamlog import SlamLog
from .world_file import read_world, world_beside

PUBLISHED_LANDMARKS = np.array([[3, 6], [3, 12], [7, 8], [7, 14], [11, 6], [11, 12.0]])
"""Ground truth that the homework prints for the six landmarks of its log [m]."""
MATCH_DISTANCE = 1.0  # [m]


def read_course(path: str | PathLike[str]) -> SlamLog:
    """Read a course log; readings carry the landmark ids 0, 1, … in their order.

    The format holds no truth. The truth comes from a ``world.dat`` in the same folder.
    Without one it is the published ground truth, but only if the first scan, taken from
    the origin, places each of six landmarks within 1 m of it. The header names the
    source.

    Parameters
    ----------
    path : path
        The file.

    Returns
    -------
    SlamLog
        Motion turn-last, one unit of time per step, starting at the origin.

    Raises
    ------
    LogError
        If the lines do not alternate.
    OSError
        If the file cannot be opened.
    """
    lines = read_lines(path)
    count = len(lines[0].text.split())
    if count % 2:
        raise lines[0].error("pairs of bearing and range", f"{count} numbers")
    recorder = EventRecorder()
    for k, line in enumerate(lines):
        if k % 2:
            _take_odometry(recorder, line, (k + 1) // 2)
        else:
            _take_scan(recorder, line, k // 2, count)
    events = recorder.finish()
    ids, landmarks, origin = _truth(path, cast(Scan, events[0]))
    return SlamLog(
        name=Path(path).stem,
        header={"source": "course data.txt", "truth": origin},
        landmark_ids=ids,
        landmarks=landmarks,
        events=events,
    )


def _truth(path: str | PathLike[str], first_scan: Scan) -> tuple[IntArray, Array, str]:
    """Return the ids, the true positions, and their source."""
    ids = np.arange(len(first_scan.measurements))
    world = world_beside(path)
    if world is not None:
        world_ids, positions = read_world(world)
        if not set(ids) <= set(world_ids):
            raise LogError(
                f"{world}: expected landmarks 0 to {ids[-1]} as {path} counts them, "
                f"got {', '.join(map(str, world_ids))}"
            )
        return world_ids, positions, world.name
    if _is_published_world(first_scan):
        origin = "CMU 16-833 course, matched to the first scan"
        return ids, PUBLISHED_LANDMARKS.copy(), origin
    return ids[:0], np.empty((0, 2)), "none"


def _is_published_world(scan: Scan) -> bool:
    """Whether a scan from the origin shows each published landmark at its position."""
    if len(scan.measurements) != len(PUBLISHED_LANDMARKS):
        return False
    bearing, distance = scan.measurements.T
    seen = np.stack([distance * np.cos(bearing), distance * np.sin(bearing)], axis=1)
    apart = np.linalg.norm(seen - PUBLISHED_LANDMARKS, axis=1)
    return bool((apart <= MATCH_DISTANCE).all())


def _take_odometry(recorder: EventRecorder, line: LogLine, step: int) -> None:
    fields = line.text.split()
    line.check_count(fields, (2,), "odometry d α")
    d, alpha = map(line.to_real, fields)
    recorder.add_odometry(line, OdometryRow(float(step), d, alpha, dt=1.0))


def _take_scan(recorder: EventRecorder, line: LogLine, step: int, count: int) -> None:
    fields = line.text.split()
    line.check_count(fields, (count,), f"{count // 2} pairs of bearing and range")
    pairs = np.array([line.to_real(field) for field in fields]).reshape(-1, 2)
    for k, (bearing, distance) in enumerate(pairs):
        reading = Reading(float(step), k, wrap_bearing(float(bearing)), float(distance))
        recorder.add_reading(line, reading)
