"""Read pose-landmark graphs as text, in the formats of iSAM and g2o.

Lines ``ODOMETRY i j dx dy dθ …`` (pose j in the frame of pose i) and
``LANDMARK i j x y …`` (landmark j in the frame of pose i), or ``EDGE_SE2`` and
``EDGE_SE2_XY``. The information matrices at the ends of the lines, and the estimates in
``VERTEX`` and ``FIX`` lines, are ignored.
"""

import math
from os import PathLike
from pathlib import Path

from ..events import EventRecorder, OdometryRow, Reading, Scan, wrap_bearing
from ..lines import LogLine, read_lines, shown
from ..slamlog import SlamLog

ODOMETRY_TAGS = ("ODOMETRY", "EDGE_SE2")
LANDMARK_TAGS = ("LANDMARK", "EDGE_SE2_XY")
ESTIMATE_TAGS = ("VERTEX_SE2", "VERTEX_XY", "FIX")
ISAM_TAGS = ODOMETRY_TAGS + LANDMARK_TAGS + ESTIMATE_TAGS


def read_isam(path: str | PathLike[str]) -> SlamLog:
    """Read a graph whose odometry lines form one chain of poses.

    Poses and landmarks share one sequence of ids in the file: landmarks keep theirs,
    while poses are renumbered, so that pose k has t = k. An increment (dx, dy, dθ)
    becomes two turn-last rows, (0, φ) with dt = 0 and (d, dθ - φ) with dt = 1, where
    d (cos φ, sin φ) = (dx, dy) and φ in [-π/2, π/2]; d < 0 means driving backwards.

    Parameters
    ----------
    path : path
        The file.

    Returns
    -------
    SlamLog
        Motion turn-last, one unit of time per pose, starting at the origin, no truth.

    Raises
    ------
    LogError
        If a line is of no known kind, or the odometry is no chain (as with the loop
        closures of a pose graph), or a landmark is seen from a pose outside the chain.
    OSError
        If the file cannot be opened.
    """
    lines = read_lines(path)
    odometry: list[LogLine] = []
    seen_from: dict[int, list[LogLine]] = {}
    for line in lines:
        tag, *fields = line.text.split()
        if tag in ODOMETRY_TAGS:
            line.check_count(fields, (5, 11), f"{tag} i j dx dy dθ [6 of information]")
            odometry.append(line)
        elif tag in LANDMARK_TAGS:
            line.check_count(fields, (4, 7), f"{tag} i j x y [3 of information]")
            seen_from.setdefault(_id(line, 1), []).append(line)
        elif tag not in ESTIMATE_TAGS:
            raise line.error(" or ".join(ISAM_TAGS), shown(line.text))
    if not odometry:
        raise lines[-1].error("odometry", "the end of the file")
    return SlamLog(
        name=Path(path).stem,
        header={"source": "iSAM or g2o text", "truth": "none"},
        events=_walk(odometry, seen_from),
    )


def _walk(
    odometry: list[LogLine], seen_from: dict[int, list[LogLine]]
) -> tuple[OdometryRow | Scan, ...]:
    """Follow the chain of poses, and record the readings of each pose."""
    recorder = EventRecorder()
    pose = _id(odometry[0], 1)
    visited = {pose}
    _take_readings(recorder, seen_from.get(pose, []), 0)
    for step, line in enumerate(odometry, 1):
        if _id(line, 1) != pose:
            raise line.error(f"odometry from pose {pose}", f"from pose {_id(line, 1)}")
        pose = _id(line, 2)
        if pose in visited:
            raise line.error("odometry to a new pose", f"to pose {pose} again")
        visited.add(pose)
        _take_increment(recorder, line, step)
        _take_readings(recorder, seen_from.get(pose, []), step)
    for pose in seen_from.keys() - visited:
        raise seen_from[pose][0].error("a pose of the odometry", f"pose {pose}")
    return recorder.finish()


def _take_increment(recorder: EventRecorder, line: LogLine, step: int) -> None:
    dx, dy, turn = map(line.to_real, line.text.split()[3:6])
    sign = -1.0 if dx < 0 else 1.0
    direction = math.atan2(sign * dy, abs(dx))
    distance = sign * math.hypot(dx, dy)
    recorder.add_turn_drive_turn(
        line, step, before=direction, d=distance, after=turn - direction
    )


def _take_readings(recorder: EventRecorder, lines: list[LogLine], step: int) -> None:
    for line in lines:
        x, y = map(line.to_real, line.text.split()[3:5])
        bearing = wrap_bearing(math.atan2(y, x))
        recorder.add_reading(
            line, Reading(float(step), _id(line, 2), bearing, math.hypot(x, y))
        )


def _id(line: LogLine, place: int) -> int:
    return line.to_id(line.text.split()[place])
