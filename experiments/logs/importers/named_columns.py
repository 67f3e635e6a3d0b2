"""Logs in csv files whose first row names the columns: `read_named`.

A folder holds such files, or one file holds everything. Each file is a table of one or
several of four kinds, which its columns tell apart::

    odometry       t, d, alpha        drive d, then turn alpha, until t
                   t, dx, dy, dtheta  the new pose in the frame of the old one
                   t, v, omega        velocities from t until the next row
    measurements   t, id, bearing, range
    truth          t, x, y, theta
    landmarks      id, x, y

Other columns are ignored. `SYNONYMS` lists further names of each column; a unit may
follow in brackets or after an underscore. Poses in a table with odometry, or in a file
whose name suggests an estimate, are the truth only if the name of a column or of the
file marks them. Comments ``# key: value`` with the keys of a slamlog have the same
effect as there.
"""

import contextlib
import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ....arrays import Array
from ....evaluation.trajectory_error import poses_at
from .. import log_lines, slamlog
from .planar_paths import heading_of

ENDINGS = (".csv", ".tsv", ".txt")
#: Names of each column in lower case, without marks; the first one found counts.
SYNONYMS = {
    "t": "t time timestamp stamp headerstamp sec secs seconds step k",
    "d": "d ds dist distance deltad deltas dd driven forward translation trans dtrans",
    "alpha": "alpha dtheta deltatheta dyaw deltayaw dheading deltaheading dth dpsi "
    "turn turned rotation rot drot dalpha α δθ",
    "dx": "dx deltax",
    "dy": "dy deltay",
    "v": "v vel velocity speed linear linearvelocity linvel vx linearx",
    "omega": "omega w yawrate turnrate angular angularvelocity angvel wz angularz ω",
    "dt": "dt deltat duration",
    "id": "id landmark landmarkid lm lmid tag tagid marker markerid beacon beaconid "
    "feature featureid subject",
    "bearing": "bearing beta b angle azimuth phi β",
    "range": "range r rho dist distance",
    "x": "x tx px posx positionx xtrue truex gtx xgt prsrx",
    "y": "y ty py posy positiony ytrue truey gty ygt prsry",
    "theta": "theta yaw heading psi th thetatrue truetheta gttheta gtyaw yawtrue θ",
    "qx": "qx orientationx qrsx",
    "qy": "qy orientationy qrsy",
    "qz": "qz orientationz qrsz",
    "qw": "qw orientationw qrsw",
}
_NAMES = {column: names.split() for column, names in SYNONYMS.items()}
#: Parts of names without a meaning, as in ``field.pose.pose.position.x`` of ROS.
_IGNORED = {"field", "pose", "twist", "robot", "odom", "odometry", "measured"}
#: Words for each unit by its size in SI units.
_WORDS = {
    1.0: "m metre metres meter meters m/s mps rad radian radians rad/s radps s sec "
    "secs second seconds 1 -",
    math.pi / 180: "deg degree degrees ° deg/s °/s dps degps",
    1e-2: "cm cm/s",
    1e-3: "mm mm/s mrad mrad/s ms msec millisecond milliseconds",
    1 / 3.6: "km/h kmh kph",
    1e-6: "us µs μs usec microsecond microseconds",
    1e-9: "ns nsec nanosec nanosecond nanoseconds",
    1e3: "km",
}
UNITS = {word: size for size, words in _WORDS.items() for word in words.split()}
UNITS[""] = 1.0
_IN_TIME = {"sec": "s", "second": "s", "hr": "h", "hour": "h"}
#: Names of t that state its unit.
_TIMED = ("sec", "secs", "seconds", "step", "k")
#: The columns of each kind, in the forms that it may have.
FORMS = {
    "odometry": (("t", "d", "alpha"), ("t", "dx", "dy", "alpha"), ("t", "v", "omega")),
    "measurements": (("t", "bearing", "range"),),
    "truth": (("t", "x", "y"),),
    "landmarks": (("id", "x", "y"),),
}
EXPECTED = (
    "columns t, d, alpha (or t, v, omega) of odometry, and t, id, bearing, range of "
    "measurements"
)
#: What the name of a file says about its kind.
_STEMS = {
    "odometry": "odom|motion|control|veloc",
    "measurements": "meas|observation|reading|sensor|detect",
    "truth": "truth|gt(?!h)",
    "landmarks": "landmark|map|world|beacon",
}
#: Parts of names that mark poses as the truth, and of file names that mark estimates.
_TRUE = "truth|true|gt(?!h)|mocap|vicon|optitrack"  # not length
_ESTIMATED = "odom|estim|slam|ekf|filter|predict|dead|wheel|encoder|imu"
#: Columns of the files that the documentation names.
_EXAMPLES = {
    "odometry": "t, d, alpha or t, v, omega",
    "measurements": "t, id, bearing, range",
    "groundtruth": "t, x, y, theta",
    "landmarks": "id, x, y",
}
#: Stamps beyond these [s] are in other units: no drive is so long, and epoch times
#: are near 1.7e9 s.
_HUGE = ((1e17, 1e-9), (1e14, 1e-6), (1e11, 1e-3))
#: Limits of steps of odometry, and of the truth, whose stamps can be in seconds [s].
_SHORTEST, _LONGEST, _LONGEST_OF_TRUTH = 5e-4, 5.0, 60.0
_FEWEST_INSIDE = 0.1  # least share of readings within the time of the odometry
#: A first stamp beyond this is an epoch time, which is subtracted [s].
_EPOCH = 1e8
TIME_DIGITS = 6
_MOST_SHOWN = 3  # tables of an unknown kind in an error
_EMPTY = ("", "nan", "none", "null")


class Cells(NamedTuple):
    """One row of a table."""

    line: log_lines.LogLine
    fields: list[str]


class Column(NamedTuple):
    """A column of a table."""

    place: int
    #: Size of its unit in SI units.
    scale: float
    #: Whether its name states a unit.
    has_unit: bool = False


class Table(NamedTuple):
    """A file whose first row names its columns."""

    file: Path
    columns: Mapping[str, Column]
    rows: list[Cells]
    #: Keys of a slamlog in its comments.
    notes: Mapping[str, log_lines.LogLine]
    header: log_lines.LogLine

    @property
    def kinds(self) -> set[str]:
        """The kinds of table that it is, by its columns and by its name."""
        there = self.columns.keys()
        found = {
            kind
            for kind, forms in FORMS.items()
            if any(there >= set(form) for form in forms)
        }
        named = {k for k in found if re.search(_STEMS[k], self.file.stem.lower())}
        if named:
            return named
        if "t" in there:  # of the robot, not of landmarks
            found.discard("landmarks")
        return found if self.has_truth else found - {"truth"}

    @property
    def has_path(self) -> bool:
        """Whether it has the columns of a path, not of landmarks with time stamps."""
        there = self.columns.keys()
        return there >= {"t", "x", "y"} and ("id" not in there or "bearing" in there)

    @property
    def has_truth(self) -> bool:
        """Whether it has a path that is the truth, judging by names."""
        stem = self.file.stem.lower()
        if re.search(_TRUE, f"{stem} {self.header.text.lower()}"):
            return self.columns.keys() >= {"t", "x", "y"}
        has_odometry = any(self.columns.keys() >= set(f) for f in FORMS["odometry"])
        return self.has_path and not has_odometry and not re.search(_ESTIMATED, stem)

    def number(self, row: Cells, column: str) -> float:
        """Read a cell in SI units; raise LogError unless it is a finite number."""
        place, scale, _ = self.columns[column]
        return row.line.to_real(row.fields[place]) * scale

    def filled(self, columns: Iterable[str]) -> Iterator[Cells]:
        """Yield the rows in which not all of some columns are empty."""
        places = [self.columns[column].place for column in columns if column != "t"]
        for row in self.rows:
            if any(row.fields[place].lower() not in _EMPTY for place in places):
                yield row

    def form_of(self, kind: str) -> tuple[str, ...]:
        """Return the first form of a kind whose columns it has."""
        there = self.columns.keys()
        return next(form for form in FORMS[kind] if there >= set(form))

    def times(self, rows: Sequence[Cells]) -> Array:
        """Return the stamps of rows [s], those in ns or other small units converted."""
        times = np.array([self.number(row, "t") for row in rows])
        size = np.abs(times).max(initial=0.0)
        scale = next((scale for limit, scale in _HUGE if size > limit), 1.0)
        return times * scale

    def check_step(self, times: Array, longest: float) -> None:
        """Raise LogError if stamps without a unit are probably not in seconds."""
        gaps = np.diff(np.unique(times))
        step = float(np.median(gaps)) if len(gaps) > 1 else longest
        if not (self.columns["t"].has_unit or _SHORTEST <= step <= longest):
            raise self.header.error(
                "the unit of t in its name, such as 't [ms]', 't [us]' or 't [s]'",
                f"steps of {step:.3g} without a unit",
            )


def read_table(path: Path, lines: list[log_lines.LogLine]) -> Table | None:
    """Read a file whose first row, or the comment before it, names the columns.

    Returns
    -------
    Table or None
        None if there is no such row, or it names no two known columns with t or id.

    Raises
    ------
    LogError
        If a row has another number of fields, or a known column an unknown unit.
    """
    texts = [log_lines.without_comment(line.text) for line in lines]
    content = [k for k, text in enumerate(texts) if text]
    if len(content) < 2:
        return None
    header = _header_of(lines, texts, content[0])
    names = log_lines.split_fields(header.text)
    _check_units(header, names)
    columns = _columns(names)
    if len(columns) < 2 or not columns.keys() & {"t", "id"}:
        return None
    notes, rows = {}, []
    for line, text in zip(lines, texts, strict=True):
        key = line.text.lstrip("#%/ ").partition(":")[0].strip()
        if not text and key in slamlog.KNOWN_KEYS:
            notes[key] = line
        elif text and line.number > header.number:
            rows.append(Cells(line, log_lines.split_fields(text)))
    for row in rows:
        if len(row.fields) != len(names):
            wanted = f"{len(names)} fields, as in line {header.number}"
            raise row.line.error(wanted, str(len(row.fields)))
    return Table(path, columns, rows, notes, header)


def _header_of(
    lines: list[log_lines.LogLine], texts: list[str], first: int
) -> log_lines.LogLine:
    """Return the first row, or the comment before a row of numbers of its length."""
    fields = log_lines.split_fields(texts[first])
    if first and any(map(log_lines.is_number, fields)):
        remark = lines[first - 1].text.lstrip("#%/ ")
        if len(log_lines.split_fields(remark)) == len(fields):
            return lines[first - 1]._replace(text=remark)
    return lines[first]._replace(text=texts[first])


def _check_units(header: log_lines.LogLine, names: Sequence[str]) -> None:
    """Refuse an unknown unit in brackets after the name of a known column."""
    known = {name for spellings in _NAMES.values() for name in spellings}
    for name in names:
        match = _UNIT.fullmatch(name.lower())
        if match and _unit(match[2]) not in UNITS and _plain(match[1]) in known:
            wanted = "one of the units m, cm, mm, km, rad, deg, s, ms, us and ns"
            raise header.error(wanted, f"{log_lines.shown(name)}: convert the column")


def _columns(names: Sequence[str]) -> dict[str, Column]:
    """Return the known columns."""
    found: dict[str, tuple[int, Column]] = {}
    for place, name in enumerate(names):
        for column, spellings in _NAMES.items():
            for spelling, unit in _readings_of(name):
                if spelling in spellings:
                    rank = spellings.index(spelling)
                    if column not in found or rank < found[column][0]:
                        has_unit = bool(unit) or spelling in _TIMED
                        found[column] = rank, Column(place, UNITS[unit], has_unit)
                    break
    taken = {column: each.place for column, (_, each) in found.items()}
    if "d" in taken and taken.get("range") == taken["d"]:
        del found["d" if "bearing" in found else "range"]
    return {column: each for column, (_, each) in found.items()}


_UNIT = re.compile(r"\s*(.*?)\s*[\[(](.*)[\])]\s*")


def _parts(text: str) -> list[str]:
    """Return the words of a column's name that have a meaning."""
    parts = [part for part in re.split(r"[^\w°]+|_", text) if part]
    return [part for part in parts if part not in _IGNORED] or parts


def _plain(text: str) -> str:
    """Return the name of a column without marks."""
    return "".join(_parts(text))


def _readings_of(name: str) -> Iterator[tuple[str, str]]:
    """Yield the ways to read a column's name: without marks, and its unit.

    Examples
    --------
    >>> list(_readings_of("Bearing [deg]")), list(_readings_of("range_mm"))
    ([('bearing', 'deg')], [('rangemm', ''), ('range', 'mm')])
    >>> ("omega", "deg/s") in _readings_of("omega_deg_s")
    True
    """
    match = _UNIT.fullmatch(name.lower())
    text, unit = match.groups() if match else (name.lower(), "")
    parts = _parts(text)
    if (unit := _unit(unit)) in UNITS:
        yield "".join(parts), unit
    for k in range(1, len(parts)):
        if not match and (unit := _unit("/".join(parts[k:]))) in UNITS:
            yield "".join(parts[:k]), unit


def _unit(text: str) -> str:
    """Return a unit in its usual form, such as deg/s for ``deg per sec``.

    Examples
    --------
    >>> _unit("deg per sec"), _unit(" m / s "), _unit("rad/per/s"), _unit("sec")
    ('deg/s', 'm/s', 'rad/s', 'sec')
    """
    words = [word for word in re.split(r"[/\s]+|\bper\b", text) if word]
    return "/".join([*words[:1], *(_IN_TIME.get(word, word) for word in words[1:])])


def tables_in(folder: Path) -> list[Table]:
    """Return the files of a folder that are tables of a known kind."""
    found = []
    for file in _files_of(folder):
        try:
            table = read_table(file, log_lines.read_lines(file))
        except slamlog.LogError:
            if any(re.search(stem, file.stem.lower()) for stem in _STEMS.values()):
                raise
            continue
        if table is not None and (table.kinds or table.has_path):
            found.append(table)
        elif file.stem.lower() in _EXAMPLES:
            first = log_lines.read_lines(file)[0]
            wanted = f"a first row with the columns {_EXAMPLES[file.stem.lower()]}"
            raise first.error(wanted, log_lines.shown(first.text))
    return found


def _files_of(folder: Path) -> list[Path]:
    """Return the files of a folder that may be tables."""
    files = (file for file in sorted(folder.iterdir()) if file.is_file())
    return [file for file in files if file.suffix.lower() in ENDINGS]


def read_named(tables: Sequence[Table], name: str, source: Path) -> slamlog.SlamLog:
    """Join tables to a log.

    Odometry is divided in proportion at the times of measurements between its rows.
    Measurements outside the time of the odometry are left out and counted in the header
    (``left_out``). Times count from the first odometry if it is an epoch time
    (``epoch`` in the header). The log starts at the true pose, if that is known.

    Parameters
    ----------
    tables : sequence of Table
        The files, each of at least one kind.
    name : str
        Name of the log.
    source : Path
        The folder or the file, which errors name.

    Returns
    -------
    SlamLog
        Motion midpoint for velocities, turn-last for increments.

    Raises
    ------
    LogError
        If odometry or measurements are missing, if two tables have one kind, or if a
        row is malformed.
    """
    of = _by_kind(tables, source)
    form = of["odometry"].form_of("odometry")
    rows = list(of["odometry"].filled(form))
    if not rows:
        raise of["odometry"].header.error("rows of odometry below it", "empty ones")
    stamps = of["odometry"].times(rows)
    of["odometry"].check_step(stamps, _LONGEST)
    epoch = float(stamps[0]) if stamps[0] > _EPOCH else 0.0

    def on_clock(times: Array) -> Array:
        return np.round(times - epoch, TIME_DIGITS) if epoch else times

    timed = _readings(of["measurements"], on_clock)
    seen = np.array([reading.t for _, reading in timed])
    motions = _motions(of["odometry"], form, rows, on_clock(stamps), seen)
    # Before its first increment a robot stands; its velocity is not known then.
    begin = motions[0].start if "v" in form else -math.inf
    inside = [each for each in timed if begin <= each[1].t <= motions[-1].end]
    if len(inside) < _FEWEST_INSIDE * len(timed):
        line, reading = next(each for each in timed if each not in inside)
        raise line.error(
            f"readings within the time of the odometry, {motions[0].start:.15g} to "
            f"{motions[-1].end:.15g}, on one clock and in one unit",
            f"{len(timed) - len(inside)} of {len(timed)} outside it, the first at t = "
            f"{reading.t:.15g}",
        )
    truth = true_path_of(of["truth"]) if "truth" in of else np.empty((0, 4))
    truth[:, 0] = on_clock(truth[:, 0])
    places = _landmarks(of["landmarks"]) if "landmarks" in of else {}
    known = _true_start(motions[0], truth)
    is_known = bool(np.isfinite(known).all())
    left_out = [f"{len(timed) - len(inside)} readings outside the time of the odometry"]
    left_out = left_out * (len(inside) < len(timed)) + [
        f"the poses of {table.file.name}, since no name marks them as the truth: name "
        "the columns x_true, y_true, theta_true, or give the file as --truth"
        for table in tables
        if table.has_path and not table.has_truth
    ]
    header = {
        "source": f"csv with named columns: {', '.join(t.file.name for t in tables)}",
        "start_from": "ground truth" if is_known else "origin (no truth then)",
        "truth": of["truth"].file.name if "truth" in of else "none",
        "epoch": repr(epoch),
        "left_out": "; ".join(left_out),
    }
    motion = "midpoint" if "v" in form else "turn-last"
    notes = {key: value for table in tables for key, value in table.notes.items()}
    return slamlog.with_header(
        slamlog.SlamLog(
            name=name,
            header={
                key: text for key, text in header.items() if text not in ("", "0.0")
            },
            motion=motion,
            start=known if is_known else np.zeros(3),
            landmark_ids=np.array(list(places), dtype=np.int64),
            landmarks=np.array(list(places.values())).reshape(-1, 2),
            events=_events(motions, inside),
            ground_truth=truth,
        ),
        notes,
    )


def _by_kind(tables: Sequence[Table], source: Path) -> dict[str, Table]:
    """Return the table of each kind; refuse two of one kind, and a lacking one."""
    of: dict[str, Table] = {}
    for table in tables:
        for kind in table.kinds:
            if kind in of:
                raise slamlog.LogError(
                    f"{source}: expected one file with {kind}, got "
                    f"{of[kind].file.name} and {table.file.name}: move one away"
                )
            of[kind] = table
    for kind in ("odometry", "measurements"):
        if kind not in of:
            raise lacking(kind, tables, source)
    if of["odometry"].has_truth:  # regardless of the file's name
        of.setdefault("truth", of["odometry"])
    return of


def lacking(kind: str, tables: Sequence[Table], source: Path) -> slamlog.LogError:
    """Return the error that no table has the columns of a kind."""
    form = _EXAMPLES["groundtruth" if kind == "truth" else kind]
    if kind == "measurements":
        form += ", one row per reading"
    heads = {table.file: table.header.text for table in tables}
    if source.is_dir():
        others = [file for file in _files_of(source) if file not in heads]
        for file in others[:_MOST_SHOWN]:
            with contextlib.suppress(slamlog.LogError):
                heads[file] = log_lines.read_lines(file)[0].text
    shown = (f"{file.name} with {log_lines.shown(heads[file])}" for file in heads)
    got = "; ".join(shown)
    other = "" if source.is_dir() else ", or give the folder of several such files"
    if kind == "odometry" and any(table.has_path for table in tables):
        other += "; poses give odometry by their differences: t, dx, dy, dtheta"
    return slamlog.LogError(
        f"{source}: expected {kind}, a table with the columns {form}; got {got}: "
        f"rename or convert the columns{other}"
    )


class _TimedOdometry(NamedTuple):
    """The odometry between two times; the second one is that of a row."""

    line: log_lines.LogLine
    start: float
    end: float
    #: (dx, dy, turn); dy is 0 for a unicycle [m, m, rad].
    increment: tuple[float, float, float]
    #: Duration for the noise.
    dt: float


def _motions(
    table: Table,
    form: tuple[str, ...],
    rows: Sequence[Cells],
    stamps: Array,
    seen: Array,
) -> list[_TimedOdometry]:
    """Return the motions of an odometry table in order of time.

    The first increment begins at the last reading before its end, and lasts as long as
    most others.
    """
    for k in np.flatnonzero(np.diff(stamps) < 0)[:1].tolist():
        wanted = f"t >= {stamps[k]:.15g}, the time before"
        raise rows[k + 1].line.error(wanted, f"{stamps[k + 1]:.15g}")
    gaps = np.diff(stamps)
    if "v" in form:
        if len(rows) < 2:
            raise rows[0].line.error("at least two rows of v and omega", "one")
        return [
            _TimedOdometry(
                row.line,
                float(start),
                float(start + dt),
                (table.number(row, "v") * dt, 0.0, table.number(row, "omega") * dt),
                float(dt),
            )
            for row, start, dt in zip(rows[:-1], stamps[:-1], gaps, strict=True)
        ]
    typical = float(np.median(gaps)) if len(gaps) else 1.0
    begin = float(seen[seen < stamps[0]].max(initial=-math.inf))
    begin = begin if math.isfinite(begin) else float(stamps[0]) - typical
    starts = [begin, *stamps[:-1].tolist()]
    lengths = [typical, *gaps.tolist()]
    motions = []
    for row, start, end, length in zip(
        rows, starts, stamps.tolist(), lengths, strict=True
    ):
        ahead = table.number(row, form[1])
        aside = table.number(row, "dy") if "dy" in form else 0.0
        increment = ahead, aside, table.number(row, "alpha")
        dt = table.number(row, "dt") if "dt" in table.columns else length
        motions.append(_TimedOdometry(row.line, start, end, increment, dt))
    return motions


_TimedReadings = list[tuple[log_lines.LogLine, slamlog.Reading]]


def _readings(table: Table, on_clock: Callable[[Array], Array]) -> _TimedReadings:
    """Return the readings in order of time."""
    rows = list(table.filled(("bearing", "range")))
    times = on_clock(table.times(rows))
    timed = []
    for k in np.argsort(times, kind="stable").tolist():
        t, row = float(times[k]), rows[k]
        # Not wrapped, which would hide degrees and ranges.
        bearing = table.number(row, "bearing")
        distance = table.number(row, "range")
        reading = slamlog.Reading(t, _id_in(table, row), bearing, distance)
        timed.append((row.line, reading))
    return timed


def _true_start(first: _TimedOdometry, truth: Array) -> Array:
    """Return the true pose before the first motion, nan where unknown.

    The truth may begin within the first half of the motion, because stamps are rounded,
    or at the end of an empty motion.
    """
    start = first.start
    latest = start + (first.end - start) / 2 if any(first.increment) else first.end
    if len(truth) and start < truth[0, 0] <= latest:
        start = float(truth[0, 0])
    return np.asarray(poses_at([start], truth)[0])


def _id_in(table: Table, row: Cells) -> int | None:
    """Read an id, which pandas may write as 3.0; None for -1 and empty cells."""
    if "id" not in table.columns:
        return None
    text = row.fields[table.columns["id"].place]
    text = re.sub(r"\.0+$", "", text)
    return None if text.lower() in (*_EMPTY, "-1") else row.line.to_id(text)


def _events(
    motions: Sequence[_TimedOdometry], timed: _TimedReadings
) -> tuple[slamlog.Event, ...]:
    """Record motions and readings, and divide motions at readings within them."""
    recorder = slamlog.EventRecorder()
    k = 0

    def record_until(t: float) -> None:
        nonlocal k
        while k < len(timed) and timed[k][1].t <= t:
            recorder.add_reading(*timed[k])
            k += 1

    record_until(motions[0].start)
    for motion in motions:
        at = motion.start
        while k < len(timed) and timed[k][1].t < motion.end:
            t = timed[k][1].t
            if t > at:
                _add_part(recorder, motion, at, t)
                at = t
            record_until(t)
        _add_part(recorder, motion, at, motion.end)
        record_until(motion.end)
    return recorder.finish()


def _add_part(
    recorder: slamlog.EventRecorder, motion: _TimedOdometry, start: float, end: float
) -> None:
    """Record the part of a motion between two times."""
    share = 1.0
    if (start, end) != (motion.start, motion.end):
        share = (end - start) / (motion.end - motion.start)
    dx, dy, turn = (share * part for part in motion.increment)
    if dy:
        sign = -1.0 if dx < 0 else 1.0
        before = math.atan2(sign * dy, abs(dx))
        row = slamlog.OdometryRow(end, 0.0, before, dt=0.0)
        recorder.add_row(motion.line, row)
        dx, turn = sign * math.hypot(dx, dy), turn - before
    row = slamlog.OdometryRow(end, dx, turn, dt=share * motion.dt)
    recorder.add_row(motion.line, row)


def true_path_of(table: Table) -> Array:
    """Return the rows (t, x, y, θ) of a table of truth in order of time.

    θ is nan where it is not given.
    """
    rows = list(table.filled(("x", "y")))
    times = table.times(rows)
    table.check_step(times, _LONGEST_OF_TRUTH)
    headings = np.full(len(rows), np.nan)
    if "theta" in table.columns:
        place = table.columns["theta"].place
        for k, row in enumerate(rows):
            if row.fields[place].lower() not in _EMPTY:
                headings[k] = table.number(row, "theta")
    elif {"qx", "qy", "qz", "qw"} <= table.columns.keys():
        parts = ("qx", "qy", "qz", "qw")
        quaternions = [[table.number(row, part) for part in parts] for row in rows]
        headings = heading_of(
            np.array(quaternions).reshape(-1, 4), [row.line for row in rows]
        )
    places = [(table.number(row, "x"), table.number(row, "y")) for row in rows]
    path = np.column_stack([times, np.array(places).reshape(-1, 2), headings])
    return path[np.argsort(times, kind="stable")]


def _landmarks(table: Table) -> dict[int, tuple[float, float]]:
    """Read the true positions of landmarks by id."""
    places: dict[int, tuple[float, float]] = {}
    for row in table.rows:
        landmark_id = _id_in(table, row)
        if landmark_id is None or landmark_id in places:
            raise row.line.error("each landmark once, by its id", str(landmark_id))
        places[landmark_id] = table.number(row, "x"), table.number(row, "y")
    return places
