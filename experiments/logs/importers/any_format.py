"""Read a log of any known format, and the true path of a robot: one door for files."""

from __future__ import annotations

import difflib
import re
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ....evaluation.trajectory_error import poses_at
from .. import log_lines, slamlog
from . import course, graph, named_columns, utias, victoria_park
from .planar_paths import TruePath, numeric_rows, path_format_of, path_of


class _Format(NamedTuple):
    """A format, as a refusal names it."""

    name: str
    row: str
    #: First words of its lines.
    tags: tuple[str, ...] = ()
    has_commas: bool = False
    is_log: bool = True


FORMATS = (
    _Format("slamlog 1", f"{slamlog.FORMAT_LINE!r} above rows", ("slamlog",), True),
    _Format("csv with named columns", named_columns.EXPECTED, ("t", "time"), True),
    _Format("course data.txt", "'β r β r …' and 'd α' in turn"),
    _Format("Freiburg sensor.dat", "'ODOMETRY r1 t r2'", ("ODOMETRY", "SENSOR")),
    _Format("iSAM or g2o text", "'EDGE_SE2 i j dx dy dθ …'", graph.GRAPH_TAGS),
    _Format("TUM", "'t x y z qx qy qz qw'", is_log=False),
    _Format("KITTI", "12 numbers of a matrix [R t]", is_log=False),
    _Format("EuRoC", "'#timestamp, p_RS_R_x, …'", ("timestamp",), True, is_log=False),
)
#: Files of UTIAS MR.CLAM, whose folder is a log.
_OF_UTIAS = re.compile(
    r"Robot\d+_\w+\.dat|Barcodes\.dat|Landmark_Groundtruth\.dat", re.IGNORECASE
)
_NUMBERS = "numbers without names"
#: Beginnings of texts that are not tables, and names of their formats.
_MARKUP = (
    (r"[{\[]", "JSON"),
    (r"<", "XML"),
    (r"---|[\w-]+:(\s|$)", "YAML ('rostopic echo -p' writes csv)"),
)
READERS = {
    "slamlog": slamlog.read_slamlog,
    "course": course.read_course,
    "freiburg": course.read_freiburg,
    "victoria": victoria_park.read_victoria_park,
}


def read_log(
    path: str | PathLike[str],
    *,
    landmarks: ArrayLike | None = None,
    robot: int | None = None,
    truth: str | PathLike[str] | None = None,
    noise_from_file: bool = False,
) -> slamlog.SlamLog:
    """Read a log of any known format, which is detected from the content.

    Parameters
    ----------
    path : path
        A file in the format ``slamlog 1``, a course ``data.txt``, a Freiburg
        ``sensor.dat`` (with ``world.dat`` beside it), an iSAM or g2o text, csv files
        with named columns in a folder or in one file, the folder of a UTIAS MR.CLAM
        data set, or that of Victoria Park, with ``aa3_dr.mat``, ``aa3_gpsx.mat``, and
        the trees as ``victoria_park.csv``.
    landmarks : array_like, shape (n, 2), optional
        True positions of the landmarks 0, 1, …, n - 1 [m], in place of those in the
        log.
    robot : int, optional
        Which robot of a UTIAS folder; the lowest by default.
    truth : path, optional
        A file of the true path, in place of that in the log; see `read_true_path`. For
        an iSAM or g2o text it may be a graph of the true poses, by their ids:
        ``VERTEX2`` or ``VERTEX_SE2`` lines, or exact edges.
    noise_from_file : bool, default False
        Whether the header of an iSAM or g2o text gets the noise that the information
        matrices specify: ``motion_std``, ``measurement_std``, ``bearing_std_metres``.

    Returns
    -------
    SlamLog
        The log.

    Raises
    ------
    LogError
        If the content is no log of a known format, or malformed, or if the truth is not
        of the log's poses.
    OSError
        If a file cannot be opened.
    ValueError
        If ``robot`` is given for a log that is no UTIAS folder, or ``noise_from_file``
        for one that is no graph.
    """
    source = Path(path)
    if source.is_dir():
        kind, tables = _format_of_folder(source)
    else:
        path = log_lines.ReadFile(path)
        kind, tables = _format_of_log(source, log_lines.read_lines(path))
    for name, is_given, needed, what in (
        ("robot", robot is not None, "utias", "a UTIAS folder"),
        ("noise_from_file", noise_from_file, "isam", "a graph, iSAM or g2o text"),
    ):
        if is_given and kind != needed:
            raise ValueError(f"{name} needs {what}, but {source} is none")
    if kind == "utias":
        log = utias.read_utias(source, robot=robot)
    elif kind == "csv":
        log = named_columns.read_named(tables, source.resolve().stem, source)
    elif kind == "isam":
        log = _read_graph(path, truth, noise_from_file=noise_from_file)
    else:
        log = READERS[kind](path)
    if truth is not None and kind != "isam":
        log = _with_true_path(log, truth)
    return log if landmarks is None else _with_landmarks(log, landmarks)


def read_true_path(path: str | PathLike[str]) -> TruePath:
    """Read the true path of a robot from a file of any known format.

    Parameters
    ----------
    path : path
        A TUM, KITTI or EuRoC file, a csv file with columns t, x, y, theta (or a
        quaternion), rows ``t x y θ``, a graph with the poses as vertices, or a log with
        ground truth.

    Returns
    -------
    TruePath
        Its rows, and whether they have times.

    Raises
    ------
    LogError
        If the file holds no path, or the robot leaves the plane.
    OSError
        If it cannot be opened.
    """
    source = Path(path)
    if source.is_dir():
        return _known(TruePath(read_log(source).ground_truth), source)
    path = log_lines.ReadFile(path)
    lines = log_lines.read_lines(path)
    kind, table = _format_of(source, lines)
    if table is not None and (table.has_path or "truth" in table.kinds):
        return _known(TruePath(named_columns.true_path_of(table)), source)
    if kind == "csv" and table is not None:
        raise named_columns.lacking("truth", [table], source)
    if kind == "isam":
        return graph.true_path(log_lines.content_of(lines))
    content = log_lines.content_of(lines)
    numbers = numeric_rows(content)
    if numbers is not None and kind == _NUMBERS:
        if numbers.shape[1] != 4:
            raise _unnamed(lines)
        return TruePath(numbers)  # rows t x y θ
    if numbers is not None and kind != "course":
        return path_of(numbers, kind, content)
    return _known(TruePath(read_log(path).ground_truth), source)


def _known(path: TruePath, source: Path) -> TruePath:
    """Return a path with poses; refuse an empty one."""
    if not len(path.rows):
        raise slamlog.LogError(
            f"{source}: expected a true path with poses, got none: rows "
            "'groundtruth,t,x,y,theta' of a log hold it, or a file in the format of "
            "TUM, 't x y z qx qy qz qw'"
        )
    return path


def _read_graph(
    path: str | PathLike[str],
    truth: str | PathLike[str] | None,
    *,
    noise_from_file: bool,
) -> slamlog.SlamLog:
    """Read a graph, and its truth from another graph or from a path."""
    is_graph = False
    if truth is not None:
        truth = log_lines.ReadFile(truth)
        is_graph = _format_of(Path(truth), log_lines.read_lines(truth))[0] == "isam"
    log = graph.read_isam(
        path, truth=truth if is_graph else None, noise_from_file=noise_from_file
    )
    return log if truth is None or is_graph else _with_true_path(log, truth)


def _with_landmarks(log: slamlog.SlamLog, landmarks: ArrayLike) -> slamlog.SlamLog:
    """Return a log with other true positions of its landmarks."""
    positions = slamlog.float_array("landmarks", landmarks, columns=2)
    return replace(
        log,
        header={**log.header, "truth": "landmarks given by the caller"},
        landmark_ids=np.arange(len(positions)),
        landmarks=positions,
    )


def _with_true_path(log: slamlog.SlamLog, path: str | PathLike[str]) -> slamlog.SlamLog:
    """Return a log with the true path of a file, and the true pose as its start.

    Poses without times are those of the log's times. Stamps on the clock of the log's
    ``epoch`` are set to its own.
    """
    rows, has_times = read_true_path(path)
    times = [event.t for event in log.events] or [0.0]
    first = log.events[0] if log.events else None
    start = times[0] - (first.dt if isinstance(first, slamlog.OdometryRow) else 0.0)
    if not has_times:
        due = np.unique([start, *times])
        if len(due) != len(rows):
            raise slamlog.LogError(
                f"{path}: expected a pose for each of the {len(due)} times of the log, "
                f"as the poses have no times, got {len(rows)}"
            )
        rows = np.column_stack([due, rows[:, 1:]])
    falls = np.flatnonzero(np.diff(rows[:, 0]) < 0)
    if len(falls):
        before, after = rows[falls[0] : falls[0] + 2, 0]
        raise slamlog.LogError(
            f"{path}, pose {falls[0] + 1}: expected a time >= {before:.15g}, that of "
            f"the pose before it, got {after:.15g}: sort the rows by time"
        )
    epoch = float(log.header.get("epoch", 0.0))
    if abs(rows[0, 0]) > epoch / 2 > 0:
        rows = np.column_stack([rows[:, 0] - epoch, rows[:, 1:]])
    if rows[-1, 0] < start or rows[0, 0] > times[-1]:
        raise slamlog.LogError(
            f"{path}: expected times of the log, {start:.15g} to {times[-1]:.15g}, got "
            f"{rows[0, 0]:.15g} to {rows[-1, 0]:.15g}: give both on one clock"
        )
    known = poses_at([start], rows)[0]
    begins = bool(np.isfinite(known).all()) and not log.start.any()
    return replace(
        log,
        header={**log.header, "truth": Path(path).name},
        start=known if begins else log.start,
        ground_truth=rows,
    )


def _format_of_folder(folder: Path) -> tuple[str, list[named_columns.Table]]:
    """Detect the format by the files of a folder, and read tables of named columns."""
    if (folder / victoria_park.DRIVE).is_file():
        return "victoria", []
    is_utias = utias.robots_in(folder)
    tables = [] if is_utias else named_columns.tables_in(folder)
    return "csv" if tables else "utias", tables


def _format_of_log(
    source: Path, lines: list[log_lines.LogLine]
) -> tuple[str, list[named_columns.Table]]:
    """Detect the format of a log; refuse a file that holds a path only."""
    if _OF_UTIAS.fullmatch(source.name):
        raise slamlog.LogError(
            f"{source}: expected a log, got a file of UTIAS MR.CLAM: give its folder, "
            "which holds the odometry, the measurements and Barcodes.dat of a drive"
        )
    kind, table = _format_of(source, lines)
    if kind == _NUMBERS:
        raise _unnamed(lines)
    if kind in {known.name for known in FORMATS if not known.is_log}:
        raise lines[0].error(
            "a log of odometry and readings",
            f"a path in the format of {kind}, which --truth reads (truth= in Python)",
        )
    return kind, [] if table is None else [table]


def _format_of(
    source: Path, lines: list[log_lines.LogLine]
) -> tuple[str, named_columns.Table | None]:
    """Detect the format from the first lines of a file that are not comments."""
    if slamlog.format_line_of(lines) is not None:
        return "slamlog", None
    content = log_lines.content_of(lines)
    kind = _kind_by_tag(content[0])
    if kind:
        return kind, None
    table = named_columns.read_table(source, lines)
    if table is None or not table.kinds >= {"odometry", "measurements"}:
        kind = _format_of_numbers(content, has_names=table is not None)
    if kind or table is not None:
        return kind or "csv", table
    if content[0].text.split(",")[0].strip() in slamlog.ROW_FORMS:
        wanted = f"{slamlog.FORMAT_LINE!r} above the rows of a slamlog"
        raise lines[0].error(wanted, log_lines.shown(lines[0].text))
    if all(map(log_lines.is_number, content[0].text.split())):
        return "course", None
    raise _unknown(next(at for at in lines if log_lines.without_comment(at.text)))


def _format_of_numbers(content: list[log_lines.LogLine], *, has_names: bool) -> str:
    """Return the format of a table of numbers; empty if it has no known one."""
    numbers = numeric_rows(content)
    if numbers is None:
        return ""
    kind = path_format_of(numbers)
    if kind == "TUM" and has_names and "," in content[0].text:
        return "EuRoC"  # without velocities
    if kind or has_names:
        return kind
    # In a course, every second row has two numbers.
    return _NUMBERS if len(numbers) > 1 and numbers.shape[1] > 2 else ""


def _unnamed(lines: list[log_lines.LogLine]) -> slamlog.LogError:
    """Return the error of a table of numbers whose columns have no names."""
    line = log_lines.content_of(lines)[0]
    return line.error(
        "a first row that names the columns, such as 't,d,alpha' or 't,x,y,theta', or "
        "the folder of a UTIAS data set",
        f"{len(log_lines.split_fields(line.text))} numbers in each row",
    )


def _kind_by_tag(line: log_lines.LogLine) -> str:
    """Return the format whose lines begin with a tag; empty if it has none."""
    tag, *fields = line.text.split()
    if (tag, len(fields)) == ("ODOMETRY", 3) or tag == "SENSOR":
        return "freiburg"
    is_graph = tag in graph.GRAPH_TAGS or tag.startswith(graph.PREFIXES)
    return "isam" if is_graph else ""


def _unknown(line: log_lines.LogLine) -> slamlog.LogError:
    """Return the error of an unknown format, with the two that come nearest."""
    for pattern, name in _MARKUP:
        if re.match(pattern, line.text):
            raise line.error(
                f"a log or a path; the nearest formats are csv with named columns "
                f"({named_columns.EXPECTED}) and slamlog 1",
                f"{name}, {log_lines.shown(line.text)}: convert it to one of them",
            )
    first, *_ = log_lines.split_fields(line.text)
    is_numeric = log_lines.is_number(first)

    def nearness(known: _Format) -> float:
        tags = [] if is_numeric else [tag.lower() for tag in known.tags]
        ratios = (
            difflib.SequenceMatcher(None, first[:40].lower(), tag).ratio()
            for tag in tags
        )
        similar = max(ratios, default=0.5 if is_numeric and not known.tags else 0.0)
        return similar + 0.5 * (known.has_commas == ("," in line.text))

    nearest = sorted(FORMATS, key=nearness, reverse=True)[:2]
    return line.error(
        f"a log or a path; the nearest formats are "
        f"{' and '.join(f'{known.name} ({known.row})' for known in nearest)}",
        log_lines.shown(line.text),
    )
