"""Logs of odometry and measurements in the text format ``slamlog 1``.

A CSV file with a header of ``# key: value`` lines, the first one
``# format: slamlog 1``, and rows of four kinds, named by their first field::

    landmark,id,x,y                             true position
    odometry,t,d,alpha,dt                       drive and turn until t
    measurement,t,id,bearing,range[,size[,true_id]]     id empty when unknown
    groundtruth,t,x,y,theta                     theta empty when unknown

A true id, -1 for a reading of no landmark, is for scores alone: no filter is given it.

Units are metres, radians, and seconds or steps. Odometry and measurement rows have the
order in which a filter consumes them; consecutive measurement rows of equal t are one
scan.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path
from typing import Literal, cast, get_args

import numpy as np

from ...arrays import Array, IntArray
from .events import (
    NO_LANDMARK,
    EventRecorder,
    OdometryRow,
    Reading,
    Scan,
    float_array,
)
from .lines import LogError, LogLine, read_lines, shown, to_lines, write_whole

__all__ = [
    "LogError",
    "OdometryRow",
    "Scan",
    "SlamLog",
    "read_slamlog",
    "write_slamlog",
]

Motion = Literal["turn-last", "midpoint"]
FORMAT_LINE = "# format: slamlog 1"
ROW_FORMS = {
    "landmark": "landmark,id,x,y",
    "odometry": "odometry,t,d,alpha,dt",
    "measurement": "measurement,t,id,bearing,range[,size[,true_id]]",
    "groundtruth": "groundtruth,t,x,y,theta",
}


@dataclass(frozen=True, eq=False)
class SlamLog:
    """One drive: the readings of the robot, and the truth as far as it is known.

    Attributes
    ----------
    name : str
        Name of the log.
    header : dict of str to str
        Further notes on the log, such as ``source`` or ``groundtruth_offset``.
    motion : "turn-last" or "midpoint"
        Meaning of an odometry row: drive d, then turn α; or an arc, driven by d along
        the heading θ + α/2.
    start : ndarray, shape (3,)
        Pose (x, y, θ) before the first event [m, m, rad].
    landmark_ids : ndarray of int64, shape (n,)
        Landmarks with a known true position.
    landmarks : ndarray, shape (n, 2)
        These true positions [m].
    events : tuple of OdometryRow and Scan
        Input of a filter in order; times do not decrease.
    ground_truth : ndarray, shape (k, 4)
        Rows (t, x, y, θ) of the true path [s, m, m, rad]; θ is nan where unknown.

    Raises
    ------
    ValueError
        If the shapes do not match.
    """

    name: str
    header: dict[str, str] = field(default_factory=dict)
    motion: Motion = "turn-last"
    start: Array = field(default_factory=lambda: np.zeros(3))
    landmark_ids: IntArray = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    landmarks: Array = field(default_factory=lambda: np.empty((0, 2)))
    events: tuple[OdometryRow | Scan, ...] = ()
    ground_truth: Array = field(default_factory=lambda: np.empty((0, 4)))

    def __post_init__(self) -> None:
        ids = np.asarray(self.landmark_ids, dtype=np.int64)
        positions = float_array("landmarks", self.landmarks, columns=2)
        if ids.shape != (len(positions),):
            raise ValueError(
                "landmark_ids must have one entry per row of landmarks, "
                f"got shape {ids.shape} for {len(positions)}"
            )
        start = np.asarray(self.start, dtype=np.float64)
        if start.shape != (3,):
            raise ValueError(f"start must be shape (3,), got {start.shape}")
        truth = float_array("ground_truth", self.ground_truth, columns=4)
        object.__setattr__(self, "landmark_ids", ids)
        object.__setattr__(self, "landmarks", positions)
        object.__setattr__(self, "start", start)
        object.__setattr__(self, "ground_truth", truth)
        object.__setattr__(self, "events", tuple(self.events))


def read_slamlog(path: str | PathLike[str]) -> SlamLog:
    """Read a log in the format ``slamlog 1``.

    The defaults of ``name``, ``motion`` and ``start`` in the header are the name of the
    file, turn-last, and the origin.

    Parameters
    ----------
    path : path
        The file.

    Returns
    -------
    SlamLog
        The log; every number is the float nearest to its text.

    Raises
    ------
    LogError
        If the file is no such log, with file, line, what was expected and what was
        found.
    OSError
        If the file cannot be opened.
    """
    return _parse(read_lines(path), Path(path).stem)


def write_slamlog(log: SlamLog, path: str | PathLike[str]) -> None:
    """Write a log so that :func:`read_slamlog` returns the same numbers, bit by bit.

    The file appears complete or not at all, and replaces one that is there already.

    Parameters
    ----------
    log : SlamLog
        The log.
    path : path
        The file to write; its folder must exist.

    Raises
    ------
    LogError
        If the log would not read back unchanged, for example because a number is not
        finite, or if the file cannot be written.
    """
    text = "\n".join(_rendered(log)) + "\n"
    copy = _parse(to_lines(text, str(path)), log.name)
    if (copy.name, copy.header) != (log.name, log.header):
        raise LogError(f"{path}: name and header must be single lines without margins")
    if len(copy.events) != len(log.events):
        raise LogError(f"{path}: consecutive scans must differ in t, got equal times")
    write_whole(path, text)


class _SlamlogParser:
    """Parse the lines of a log one after the other."""

    def __init__(self) -> None:
        self.header: dict[str, LogLine] = {}
        self.landmarks: dict[int, tuple[float, float]] = {}
        self.ground_truth: list[tuple[float, float, float, float]] = []
        self.recorder = EventRecorder()

    def take(self, line: LogLine) -> None:
        if line.text.startswith("#"):
            self._take_header(line)
            return
        kind, *fields = (part.strip() for part in line.text.split(","))
        if kind not in ROW_FORMS:
            raise line.error("a row of " + ", ".join(ROW_FORMS), shown(kind))
        counts = (4, 5, 6) if kind == "measurement" else (ROW_FORMS[kind].count(","),)
        line.check_count(fields, counts, ROW_FORMS[kind])
        getattr(self, f"_take_{kind}")(line, fields)

    def _take_header(self, line: LogLine) -> None:
        key, colon, _ = line.text[1:].partition(":")
        if not colon or not key.strip():
            raise line.error("# key: value", shown(line.text))
        if key.strip() in self.header:
            raise line.error("each key of the header once", f"{key.strip()} again")
        self.header[key.strip()] = line

    def _take_landmark(self, line: LogLine, fields: list[str]) -> None:
        landmark_id = line.to_id(fields[0])
        if landmark_id in self.landmarks:
            raise line.error("each landmark once", f"id {landmark_id} again")
        self.landmarks[landmark_id] = (line.to_real(fields[1]), line.to_real(fields[2]))

    def _take_odometry(self, line: LogLine, fields: list[str]) -> None:
        self.recorder.add_odometry(line, OdometryRow(*map(line.to_real, fields)))

    def _take_measurement(self, line: LogLine, fields: list[str]) -> None:
        t, bearing, distance = map(line.to_real, (fields[0], fields[2], fields[3]))
        landmark_id = line.to_id(fields[1]) if fields[1] else None
        size, true_id = None, None
        if len(fields) == 6:
            true_id = NO_LANDMARK if fields[5] == "-1" else line.to_id(fields[5])
        if fields[4:5] not in ([], [""]) or len(fields) == 5:
            size = line.to_real(fields[4])
        self.recorder.add_reading(
            line, Reading(t, landmark_id, bearing, distance, size, true_id)
        )

    def _take_groundtruth(self, line: LogLine, fields: list[str]) -> None:
        t, x, y = map(line.to_real, fields[:3])
        heading = line.to_real(fields[3]) if fields[3] else math.nan
        if self.ground_truth and t < self.ground_truth[-1][0]:
            before = self.ground_truth[-1][0]
            raise line.error(f"t >= {before}, the ground truth before", str(t))
        self.ground_truth.append((t, x, y, heading))


def _parse(lines: list[LogLine], default_name: str) -> SlamLog:
    if "".join(lines[0].text.split()) != "".join(FORMAT_LINE.split()):
        raise lines[0].error(FORMAT_LINE, shown(lines[0].text))
    parser = _SlamlogParser()
    for line in lines[1:]:
        parser.take(line)
    notes = {key: _value(line) for key, line in parser.header.items()}
    known = ("name", "motion", "start")
    return SlamLog(
        name=notes.get("name", default_name),
        header={key: value for key, value in notes.items() if key not in known},
        motion=_motion(parser.header.get("motion")),
        start=_start(parser.header.get("start")),
        landmark_ids=np.array(list(parser.landmarks), dtype=np.int64),
        landmarks=np.array(list(parser.landmarks.values())).reshape(-1, 2),
        events=parser.recorder.finish(),
        ground_truth=np.array(parser.ground_truth).reshape(-1, 4),
    )


def _value(line: LogLine) -> str:
    return line.text.partition(":")[2].strip()


def _motion(line: LogLine | None) -> Motion:
    if line is None:
        return "turn-last"
    if _value(line) not in get_args(Motion):
        raise line.error(" or ".join(get_args(Motion)), shown(_value(line)))
    return cast(Motion, _value(line))


def _start(line: LogLine | None) -> Array:
    if line is None:
        return np.zeros(3)
    fields = _value(line).split(",")
    line.check_count(fields, (3,), "# start: x,y,theta")
    return np.array([line.to_real(number) for number in fields])


def _rendered(log: SlamLog) -> Iterator[str]:
    yield FORMAT_LINE
    yield f"# name: {log.name}"
    yield f"# motion: {log.motion}"
    yield f"# start: {numbers(*log.start)}"
    for key, value in log.header.items():
        yield f"# {key}: {value}"
    for landmark_id, position in zip(log.landmark_ids, log.landmarks, strict=True):
        yield f"landmark,{landmark_id},{numbers(*position)}"
    for event in log.events:
        if isinstance(event, OdometryRow):
            yield f"odometry,{numbers(event.t, event.d, event.alpha, event.dt)}"
        else:
            yield from _rendered_scan(event)
    for *position, heading in log.ground_truth:
        yield f"groundtruth,{numbers(*position)},{_known(heading)}"


def _rendered_scan(scan: Scan) -> Iterator[str]:
    for k, reading in enumerate(scan.measurements):
        landmark_id = "" if scan.landmark_ids is None else scan.landmark_ids[k]
        size = "" if scan.sizes is None else f",{numbers(scan.sizes[k])}"
        if scan.true_ids is not None:
            size = f"{size or ','},{scan.true_ids[k]}"
        yield f"measurement,{numbers(scan.t)},{landmark_id},{numbers(*reading)}{size}"


def numbers(*values: float) -> str:
    """Write numbers with commas between, so that reading gives the same bits."""
    return ",".join(repr(float(value)) for value in values)


def _known(value: float) -> str:
    return "" if math.isnan(value) else numbers(value)
