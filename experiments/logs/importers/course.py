"""Logs of courses: the homework of CMU 16-833 and the Freiburg robot mapping course.

`read_course` reads ``data.txt``. Lines alternate: readings ``β r β r …`` of all
landmarks, in the same order each time, and odometry ``d α``, separated by white space.

`read_freiburg` reads ``sensor.dat`` with lines ``ODOMETRY r1 t r2`` (turn r1, drive t,
turn r2) and ``SENSOR id range bearing``, and `read_world` the true landmarks in
``world.dat`` with lines ``id x y``.
"""

from os import PathLike
from pathlib import Path
from typing import cast

import numpy as np

from ....arrays import Array, IntArray
from .. import slamlog
from ..log_lines import content_of, read_lines, shown

#: Ground truth that the homework prints for the six landmarks of its log [m].
PUBLISHED_LANDMARKS = np.array([[3, 6], [3, 12], [7, 8], [7, 14], [11, 6], [11, 12.0]])
MATCH_DISTANCE = 1.0  # [m]


def read_course(path: str | PathLike[str]) -> slamlog.SlamLog:
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
    lines = content_of(read_lines(path))
    count = len(lines[0].text.split())
    if count % 2:
        raise lines[0].error("pairs of bearing and range", f"{count} numbers")
    recorder = slamlog.EventRecorder()
    for k, line in enumerate(lines):
        t, fields = float((k + 1) // 2), line.text.split()
        if k % 2:
            line.check_count(fields, (2,), "odometry d α")
            d, alpha = map(line.to_real, fields)
            recorder.add_row(line, slamlog.OdometryRow(t, d, alpha, dt=1.0))
            continue
        line.check_count(fields, (count,), f"{count // 2} pairs of bearing and range")
        numbers = list(map(line.to_real, fields))
        pairs = zip(map(slamlog.wrap_bearing, numbers[::2]), numbers[1::2], strict=True)
        for landmark, reading in enumerate(pairs):
            recorder.add_reading(line, slamlog.Reading(t, landmark, *reading))
    events = recorder.finish()
    ids, landmarks, origin = _truth(path, cast(slamlog.Scan, events[0]))
    return slamlog.SlamLog(
        name=Path(path).stem,
        header={"source": "course data.txt", "truth": origin},
        landmark_ids=ids,
        landmarks=landmarks,
        events=events,
    )


def _truth(
    path: str | PathLike[str], first_scan: slamlog.Scan
) -> tuple[IntArray, Array, str]:
    """Return the ids, the true positions, and their source."""
    ids = np.arange(len(first_scan.measurements))
    world = world_beside(path)
    if world is not None:
        world_ids, positions = read_world(world)
        if not set(ids) <= set(world_ids):
            raise slamlog.LogError(
                f"{world}: expected landmarks 0 to {ids[-1]} as {path} counts them, "
                f"got {', '.join(map(str, world_ids))}"
            )
        return world_ids, positions, world.name
    if _is_published_world(first_scan):
        origin = "CMU 16-833 course, matched to the first scan"
        return ids, PUBLISHED_LANDMARKS.copy(), origin
    return ids[:0], np.empty((0, 2)), "none"


def _is_published_world(scan: slamlog.Scan) -> bool:
    """Whether a scan from the origin shows each published landmark at its position."""
    if len(scan.measurements) != len(PUBLISHED_LANDMARKS):
        return False
    bearing, distance = scan.measurements.T
    seen = np.stack([distance * np.cos(bearing), distance * np.sin(bearing)], axis=1)
    apart = np.linalg.norm(seen - PUBLISHED_LANDMARKS, axis=1)
    return bool((apart <= MATCH_DISTANCE).all())


ROW_FORMS = {"ODOMETRY": "ODOMETRY r1 t r2", "SENSOR": "SENSOR id range bearing"}


def read_freiburg(path: str | PathLike[str]) -> slamlog.SlamLog:
    """Read a Freiburg log, and its landmarks if ``world.dat`` is in the same folder.

    Each step becomes two turn-last rows, (0, r1) with dt = 0 and (t, r2) with dt = 1,
    which is the same motion. Bearings are wrapped into [-π, π).

    Parameters
    ----------
    path : path
        The file of ODOMETRY and SENSOR lines.

    Returns
    -------
    SlamLog
        Motion turn-last, one unit of time per step, starting at the origin.

    Raises
    ------
    LogError
        If a line has another form.
    OSError
        If the file cannot be opened.
    """
    recorder, step = slamlog.EventRecorder(), 0
    for line in content_of(read_lines(path)):
        kind, *fields = line.text.split()
        if kind not in ROW_FORMS:
            raise line.error(" or ".join(ROW_FORMS.values()), shown(line.text))
        line.check_count(fields, (3,), ROW_FORMS[kind])
        if kind == "ODOMETRY":
            step += 1
            before, d, after = map(line.to_real, fields)
            recorder.add_turn_drive_turn(line, step, before=before, d=d, after=after)
        else:
            bearing = slamlog.wrap_bearing(line.to_real(fields[2]))
            landmark_id, distance = line.to_id(fields[0]), line.to_real(fields[1])
            recorder.add_reading(
                line, slamlog.Reading(float(step), landmark_id, bearing, distance)
            )
    world = world_beside(path)
    ids, landmarks = read_world(world) if world else (np.arange(0), np.empty((0, 2)))
    truth = world.name if world else "none"
    return slamlog.SlamLog(
        name=Path(path).stem,
        header={"source": "Freiburg robot mapping course", "truth": truth},
        landmark_ids=ids,
        landmarks=landmarks,
        events=recorder.finish(),
    )


def read_world(path: str | PathLike[str]) -> tuple[IntArray, Array]:
    """Read landmark ids (n,) and positions (n, 2) [m].

    Raises
    ------
    LogError
        If a line is not ``id x y``, or an id comes twice.
    OSError
        If the file cannot be opened.
    """
    positions: dict[int, tuple[float, float]] = {}
    for line in content_of(read_lines(path)):
        fields = line.text.split()
        line.check_count(fields, (3,), "id x y")
        landmark_id = line.to_id(fields[0])
        if landmark_id in positions:
            raise line.error("each landmark once", f"id {landmark_id} again")
        positions[landmark_id] = (line.to_real(fields[1]), line.to_real(fields[2]))
    return np.array(list(positions), dtype=np.int64), np.array(list(positions.values()))


def world_beside(path: str | PathLike[str]) -> Path | None:
    """Return the ``world.dat`` in the folder of a log, if there is one.

    Examples
    --------
    >>> world_beside("nowhere/data.txt") is None
    True
    """
    world = Path(path).parent / "world.dat"
    return world if world.is_file() else None
