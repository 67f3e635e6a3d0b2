"""Logs of odometry and measurements in the text format ``slamlog 1``.

A `SlamLog` holds events, odometry rows and scans, and the truth if it is known;
`read_slamlog` and `write_slamlog` read and write it. Every importer returns one.

A CSV file with a header of ``# key: value`` lines, the first one
``# format: slamlog 1``, and rows of five kinds, named by their first field. Other
lines that begin with ``#`` are comments::

    landmark,id,x,y                             true position
    odometry,t,d,alpha,dt                       drive and turn until t
    measurement,t,id,bearing,range[,size[,true_id]]     id empty when unknown
    pose,t,x,y,theta,std,std_theta              GPS or compass; empty what is not read
    groundtruth,t,x,y,theta                     theta empty when unknown

A true id, -1 for a reading of no landmark, is for scores alone: no filter is given it.

Units are metres, radians, and seconds or steps. Odometry and measurement rows have the
order in which a filter consumes them; consecutive measurement rows of equal t are one
scan.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from itertools import repeat
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ...arrays import Array, IntArray
from ...estimator.models.bearing_range import wrap_angle
from ...estimator.models.motions import find_motion
from .decimals import texts
from .log_lines import (
    LogError,
    LogLine,
    read_lines,
    rows_of,
    shown,
    to_lines,
    write_whole,
)

__all__ = [
    "LogError",
    "OdometryRow",
    "PoseRow",
    "Scan",
    "SlamLog",
    "read_slamlog",
    "write_slamlog",
]
__dir__ = __all__.copy

#: Meanings of the odometry of a unicycle.
UNICYCLES = ("turn-last", "midpoint")
FORMAT_LINE = "# format: slamlog 1"
ROW_FORMS = {
    "landmark": "landmark,id,x,y",
    "odometry": "odometry,t,d,alpha,dt",
    "measurement": "measurement,t,id,bearing,range[,size[,true_id]]",
    "pose": "pose,t,x,y,theta,std,std_theta",
    "groundtruth": "groundtruth,t,x,y,theta",
}
_COUNTS: dict[str, tuple[int, ...]] = {
    **{kind: (form.count(","),) for kind, form in ROW_FORMS.items()},
    "measurement": (4, 5, 6),
}


@dataclass(frozen=True, eq=False, repr=False)
class SlamLog:
    """One drive: the readings of the robot, and the truth as far as it is known.

    Attributes
    ----------
    name : str
        Name of the log.
    header : dict of str to str
        Further notes on the log, such as ``source`` or ``groundtruth_offset``.
    motion : str
        Meaning of an odometry row: ``"turn-last"``, drive d, then turn α;
        ``"midpoint"``, an arc, driven by d along the heading θ + α/2; or a drive, as
        ``"differential[track_width=0.4]"``, whose columns then stand for d and α.
    start : ndarray, shape (3,)
        Pose (x, y, θ) before the first event [m, m, rad].
    landmark_ids : ndarray of int64, shape (n,)
        Landmarks with a known true position.
    landmarks : ndarray, shape (n, 2)
        These true positions [m].
    events : tuple of OdometryRow, Scan and PoseRow
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
    motion: str = "turn-last"
    start: Array = field(default_factory=lambda: np.zeros(3))
    landmark_ids: IntArray = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    landmarks: Array = field(default_factory=lambda: np.empty((0, 2)))
    events: tuple[Event, ...] = ()
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

    def __repr__(self) -> str:
        """Summarise the log in a line, whatever its length.

        Examples
        --------
        >>> SlamLog("drive", events=(OdometryRow(1.0, 2.0, 0.0, 1.0),))
        SlamLog('drive', 1 odometry rows, 0 scans, 0 true landmarks, 0 true poses)
        """
        counts = {
            "odometry rows": sum(isinstance(e, OdometryRow) for e in self.events),
            "scans": len(self.scans),
            "true landmarks": len(self.landmarks),
            "true poses": len(self.ground_truth),
        }
        parts = ", ".join(f"{count} {what}" for what, count in counts.items())
        return f"SlamLog({self.name!r}, {parts})"

    @property
    def scans(self) -> list[Scan]:
        """The scans among its events."""
        return [event for event in self.events if isinstance(event, Scan)]

    @property
    def read_ids(self) -> set[int]:
        """The landmarks that its readings name."""
        named = (scan.landmark_ids for scan in self.scans)
        return {i for ids in named if ids is not None for i in ids.tolist()}


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
    return parsed(read_lines(path), Path(path).stem)


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
    text = _text([*_rendered_head(log), *_rendered_events(log), *_rendered_truth(log)])
    copy = _read_back(log, text, path)
    if len(copy.events) != len(log.events):
        raise LogError(f"{path}: consecutive scans must differ in t, got equal times")
    write_whole(path, text)


def write_events(
    log: SlamLog, events: Iterable[str], path: str | PathLike[str]
) -> None:
    """Write a log whose events are given as lines; only its head is read back.

    Parameters
    ----------
    log : SlamLog
        The log, without events.
    events : iterable of str
        Rows of odometry and measurements.
    path : path
        The file to write; its folder must exist.
    """
    head = list(_rendered_head(log))
    _read_back(log, _text(head), path)
    truth = rows_of(",", repeat("groundtruth"), *map(texts, log.ground_truth.T))
    write_whole(path, _text([*head, *events, *truth]))


def _text(lines: Iterable[str]) -> str:
    return "\n".join(lines) + "\n"


def _read_back(log: SlamLog, text: str, path: str | PathLike[str]) -> SlamLog:
    copy = parsed(to_lines(text, str(path)), log.name)
    if (copy.name, copy.header) != (log.name, log.header):
        raise LogError(
            f"{path}: name and header must be single lines without spaces at the ends"
        )
    return copy


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
        kind, *fields = line.text.split(",")
        if len(line.text.split(None, 1)) > 1:
            kind, *fields = (part.strip() for part in (kind, *fields))
        if kind not in ROW_FORMS:
            raise line.error("a row of " + ", ".join(ROW_FORMS), shown(kind))
        line.check_count(fields, _COUNTS[kind], ROW_FORMS[kind])
        getattr(self, f"_take_{kind}")(line, fields)

    def _take_header(self, line: LogLine) -> None:
        key, colon, _ = line.text[1:].partition(":")
        key = key.strip()
        if not colon or not key:  # a comment
            if key.partition(" ")[0] in KNOWN_KEYS:
                raise line.error("# key: value", shown(line.text))
            return
        if key in self.header:
            raise line.error("each key of the header once", f"{key} again")
        self.header[key] = line

    def _take_landmark(self, line: LogLine, fields: list[str]) -> None:
        landmark_id = line.to_id(fields[0])
        if landmark_id in self.landmarks:
            raise line.error("each landmark once", f"id {landmark_id} again")
        self.landmarks[landmark_id] = (line.to_real(fields[1]), line.to_real(fields[2]))

    def _take_odometry(self, line: LogLine, fields: list[str]) -> None:
        self.recorder.add_row(line, OdometryRow(*line.to_reals(fields)))

    def _take_measurement(self, line: LogLine, fields: list[str]) -> None:
        t, bearing, distance = line.to_reals((fields[0], fields[2], fields[3]))
        landmark_id = line.to_id(fields[1]) if fields[1] else None
        size, true_id = None, None
        if len(fields) == 6:
            true_id = NO_LANDMARK if fields[5] == "-1" else line.to_id(fields[5])
        if fields[4:5] not in ([], [""]) or len(fields) == 5:
            size = line.to_real(fields[4])
        self.recorder.add_reading(
            line, Reading(t, landmark_id, bearing, distance, size, true_id)
        )

    def _take_pose(self, line: LogLine, fields: list[str]) -> None:
        t = line.to_real(fields[0])
        others = (line.to_real(f) if f else math.nan for f in fields[1:])
        x, y, heading, std, heading_std = others
        here = math.isfinite(x), math.isfinite(heading)
        if math.isnan(x) != math.isnan(y) or not any(here):
            raise line.error("x and y, or theta, or all three", ",".join(fields[1:4]))
        for is_here, each in zip(here, (std, heading_std), strict=True):
            if is_here and not each > 0:
                raise line.error(
                    "a standard deviation > 0 for each part that is given", str(each)
                )
        self.recorder.add_row(line, PoseRow(t, (x, y, heading), (std, heading_std)))

    def _take_groundtruth(self, line: LogLine, fields: list[str]) -> None:
        t, x, y = line.to_reals(fields[:3])
        heading = line.to_real(fields[3]) if fields[3] else math.nan
        if self.ground_truth and t < self.ground_truth[-1][0]:
            before = self.ground_truth[-1][0]
            raise line.error(f"t >= {before}, the ground truth before", str(t))
        self.ground_truth.append((t, x, y, heading))


#: Keys of the header whose values must be numbers.
_NOISES = {"motion_std", "measurement_std", "start_sigma", "range_std_per_metre"}
#: Keys of the header that have a meaning.
KNOWN_KEYS = _NOISES | {
    *("format", "name", "motion", "start", "sensor", "bearing_std_metres"),
    *("noise_at_rest", "groundtruth_offset", "identities"),
}


def format_line_of(lines: list[LogLine]) -> int | None:
    """Return the place of the line of the format among the first comments, if any."""
    for place, line in enumerate(lines):
        if not line.text.startswith("#"):
            return None
        if "".join(line.text.split()) == "".join(FORMAT_LINE.split()):
            return place
    return None


def parsed(lines: list[LogLine], default_name: str) -> SlamLog:
    """Return the log in the lines of a file; raise errors as `read_slamlog` does."""
    place = format_line_of(lines)
    if place is None:
        raise lines[0].error(FORMAT_LINE, shown(lines[0].text))
    parser = _SlamlogParser()
    for line in (*lines[:place], *lines[place + 1 :]):
        parser.take(line)
    log = SlamLog(
        name=default_name,
        landmark_ids=np.array(list(parser.landmarks), dtype=np.int64),
        landmarks=np.array(list(parser.landmarks.values())).reshape(-1, 2),
        events=parser.recorder.finish(),
        ground_truth=np.array(parser.ground_truth).reshape(-1, 4),
    )
    return with_header(log, parser.header)


def with_header(log: SlamLog, header: Mapping[str, LogLine]) -> SlamLog:
    """Return a log with the settings of lines ``# key: value``, given by key.

    Raises
    ------
    LogError
        If a known key has an invalid value.
    """
    notes = {key: _value(line) for key, line in header.items()}
    for key in _NOISES & notes.keys():
        for number in notes[key].split(","):
            header[key].to_real(number)
    known = ("name", "motion", "start")
    others = {key: value for key, value in notes.items() if key not in known}
    return replace(
        log,
        name=notes.get("name", log.name),
        header={**log.header, **others},
        motion=_motion(header["motion"]) if "motion" in notes else log.motion,
        start=_start(header["start"]) if "start" in notes else log.start,
    )


def _value(line: LogLine) -> str:
    return line.text.partition(":")[2].strip()


def _motion(line: LogLine) -> str:
    motion = _value(line)
    if motion not in UNICYCLES:
        try:
            find_motion(motion)
        except (ValueError, ImportError, AttributeError):
            expected = f"{', '.join(UNICYCLES)} or a drive"
            raise line.error(expected, shown(motion)) from None
    return motion


def _start(line: LogLine) -> Array:
    fields = _value(line).split(",")
    line.check_count(fields, (3,), "# start: x,y,theta")
    return np.array([line.to_real(number) for number in fields])


def _rendered_head(log: SlamLog) -> Iterator[str]:
    yield FORMAT_LINE
    yield f"# name: {log.name}"
    yield f"# motion: {log.motion}"
    yield f"# start: {numbers(*log.start)}"
    for key, value in log.header.items():
        yield f"# {key}: {value}"
    for landmark_id, position in zip(log.landmark_ids, log.landmarks, strict=True):
        yield f"landmark,{landmark_id},{numbers(*position)}"


def _rendered_events(log: SlamLog) -> Iterator[str]:
    for event in log.events:
        if isinstance(event, OdometryRow):
            yield f"odometry,{numbers(event.t, event.d, event.alpha, event.dt)}"
        elif isinstance(event, PoseRow):
            values = ",".join(map(_known, (*event.reading, *event.std)))
            yield f"pose,{numbers(event.t)},{values}"
        else:
            yield from _rendered_scan(event)


def _rendered_truth(log: SlamLog) -> Iterator[str]:
    for row in log.ground_truth.tolist():  # faster than loading a kernel
        yield f"groundtruth,{','.join(map(_known, row))}"


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


# --------------------------------------------------------------------------------------
# The events of a log: odometry rows, and scans of simultaneous readings.

#: The true id of a reading that shows no landmark.
NO_LANDMARK = -1


@dataclass(frozen=True)
class OdometryRow:
    """One odometry reading u = (d, α) and the time at its end.

    Attributes
    ----------
    t : float
        Time at the end of the motion [s, or steps].
    d, alpha : float
        Distance driven [m] and heading turned, counter-clockwise [rad]; or the two
        columns of another drive.
    dt : float
        Duration for the motion noise: noise variances grow with dt, and a row with
        dt = 0 has none.
    """

    t: float
    d: float
    alpha: float
    dt: float


@dataclass(frozen=True)
class PoseRow:
    """One reading of the pose, by GPS or compass or both.

    Attributes
    ----------
    t : float
        Time of the reading [s, or steps].
    reading : (float, float, float)
        (x, y, θ) [m, m, rad]; nan what is not read.
    std : (float, float)
        Standard deviations of x and of y, and of θ [m, rad].
    """

    t: float
    reading: tuple[float, float, float]
    std: tuple[float, float]

    @property
    def arguments(self) -> tuple[Array, Array, Array]:
        """What :meth:`~slamgym.estimator.EkfSlam.observe_pose` takes: z, H and R."""
        z, deviation = np.array(self.reading), np.array([self.std[0], *self.std])
        here = np.isfinite(z)
        return z[here], np.eye(3)[here], np.diag(deviation[here] ** 2)


@dataclass(frozen=True, eq=False)
class Scan:
    """Simultaneous readings of m >= 1 landmarks.

    Attributes
    ----------
    t : float
        Time of the readings [s, or steps].
    measurements : ndarray, shape (m, 2)
        Rows (β, r): bearing from the heading, and range [rad, m]; or the numbers of
        another sensor, which the log's header names.
    landmark_ids : ndarray of int64, shape (m,), or None
        Landmark of each row, without repetition; None if unknown.
    sizes : ndarray, shape (m,), or None
        Diameters of the seen objects [m], if the sensor measures them.
    true_ids : ndarray of int64, shape (m,), or None
        The true landmark of each row, -1 for none, where it is known but hidden: for
        scores, not for filters.

    Raises
    ------
    ValueError
        If the shapes do not match, or there is no reading.
    """

    t: float
    measurements: Array
    landmark_ids: IntArray | None = None
    sizes: Array | None = None
    true_ids: IntArray | None = None

    def __post_init__(self) -> None:
        readings = float_array("measurements", self.measurements, columns=2)
        if not len(readings):
            raise ValueError("measurements must be m >= 1 rows (bearing, range), got 0")
        object.__setattr__(self, "measurements", readings)
        columns = {"landmark_ids": np.int64, "sizes": np.float64, "true_ids": np.int64}
        for name, dtype in columns.items():
            value = getattr(self, name)
            if value is None:
                continue
            column = np.asarray(value, dtype=dtype)
            if column.shape != (len(readings),):
                raise ValueError(
                    f"{name} must have one entry per measurement, "
                    f"got shape {column.shape} for {len(readings)}"
                )
            object.__setattr__(self, name, column)


#: What a log holds, in the order in which a filter takes it.
Event = OdometryRow | Scan | PoseRow


def float_array(name: str, value: ArrayLike, *, columns: int) -> Array:
    """Return a table of numbers as an array of shape (n, columns), or raise ValueError.

    Examples
    --------
    >>> float_array("landmarks", [(3, 6)], columns=2)
    array([[3., 6.]])
    """
    array = np.asarray(value, dtype=np.float64)
    if array.ndim != 2 or array.shape[1] != columns:
        raise ValueError(f"{name} must be shape (n, {columns}), got {array.shape}")
    return array


class Reading(NamedTuple):
    """One measurement row of a log, before it becomes part of a scan."""

    t: float
    landmark_id: int | None
    bearing: float
    range: float
    size: float | None = None
    true_id: int | None = None


#: Fields that all readings of a scan have, or none of them.
_OPTIONAL = "ids", "sizes", "true ids"


def wrap_bearing(angle: float) -> float:
    """Wrap an angle into [-π, π); an angle inside is unchanged, bit for bit.

    Examples
    --------
    >>> wrap_bearing(0.1), wrap_bearing(0.1 + 2 * math.pi)
    (0.1, 0.09999999999999964)
    """
    return angle if -math.pi <= angle < math.pi else wrap_angle(angle)


class EventRecorder:
    """Collect rows in their order; consecutive readings of equal time form one scan.

    Each row comes with its line in the file, which errors name.

    Examples
    --------
    >>> line = LogLine("drive.csv", 1, "")
    >>> recorder = EventRecorder()
    >>> recorder.add_row(line, OdometryRow(1.0, 3.0, 0.0, dt=1.0))
    >>> recorder.add_reading(line, Reading(1.0, 0, 0.1, 2.0))
    >>> recorder.add_reading(line, Reading(1.0, 4, 0.2, 5.0))
    >>> row, scan = recorder.finish()
    >>> scan.landmark_ids
    array([0, 4])
    """

    def __init__(self) -> None:
        self._events: list[Event] = []
        self._readings: list[Reading] = []
        self._seen: set[int] = set()
        self._time = -math.inf
        self._unknown = (False,) * len(_OPTIONAL)  # in the readings of this scan

    def add_row(self, line: LogLine, row: OdometryRow | PoseRow) -> None:
        """Append a row that is no part of a scan; raise LogError if t runs backwards.

        So does a negative dt of odometry.
        """
        if isinstance(row, OdometryRow) and row.dt < 0:
            raise line.error("dt >= 0", str(row.dt))
        self._advance(line, row.t)
        self._close_scan()
        self._events.append(row)

    def add_turn_drive_turn(
        self, line: LogLine, step: int, *, before: float, d: float, after: float
    ) -> None:
        """Append a motion of one step as two turn-last rows, the first with dt = 0."""
        self.add_row(line, OdometryRow(float(step), 0.0, before, dt=0.0))
        self.add_row(line, OdometryRow(float(step), d, after, dt=1.0))

    def add_reading(self, line: LogLine, reading: Reading) -> None:
        """Append a reading; raise LogError if it contradicts the rows before it."""
        self._advance(line, reading.t)
        if self._readings and self._readings[-1].t != reading.t:
            self._close_scan()
        ids, size, true = reading.landmark_id, reading.size, reading.true_id
        unknown = ids is None, size is None, true is None
        if not self._readings:
            self._unknown = unknown
        elif unknown != self._unknown:
            whether = zip(_OPTIONAL, unknown, self._unknown, strict=True)
            name = next(name for name, here, first in whether if here != first)
            raise line.error(f"{name} in all rows of a scan or in none", "both")
        if reading.landmark_id is not None:
            if reading.landmark_id in self._seen:
                raise line.error(
                    "each landmark once per scan", f"id {reading.landmark_id} again"
                )
            self._seen.add(reading.landmark_id)
        self._readings.append(reading)

    def finish(self) -> tuple[Event, ...]:
        """Return the events recorded so far."""
        self._close_scan()
        return tuple(self._events)

    def _advance(self, line: LogLine, t: float) -> None:
        if t < self._time:
            raise line.error(f"t >= {self._time}, the time before", str(t))
        self._time = t

    def _close_scan(self) -> None:
        if not self._readings:
            return
        times, ids, bearings, ranges, sizes, true = zip(*self._readings, strict=True)
        readings = np.array([bearings, ranges]).T.copy()
        known: list[Any] = [  # of all readings or of none
            None if column[0] is None else column for column in (ids, sizes, true)
        ]
        self._events.append(Scan(times[0], readings, *known))
        self._readings.clear()
        self._seen.clear()
