"""Pose-landmark graphs in text, as iSAM, TORO and g2o write them: `read_isam`.

Lines ``ODOMETRY i j dx dy dθ …`` or ``EDGE2`` (pose j in the frame of pose i) and
``LANDMARK i j x y …`` (landmark j in the frame of pose i), or ``EDGE_SE2`` and
``EDGE_SE2_XY``, or GTSAM's ``BR i j bearing range …``. The lines may have any order.
The information at their ends is ignored unless asked for, and so are the estimates in
``VERTEX`` lines, and ``FIX`` and ``PARAMS`` lines. `sort_lines` sorts the lines of a
file by kind.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from os import PathLike
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ....arrays import Array
from .. import slamlog
from ..log_lines import LogLine, content_of, read_lines, shown
from .planar_paths import TruePath

EDGE_TAGS = ("EDGE_SE2", "EDGE2")
ODOMETRY_TAGS = ("ODOMETRY", *EDGE_TAGS)
LANDMARK_TAGS = ("LANDMARK", "EDGE_SE2_XY", "BR")
POSE_TAGS = ("VERTEX2", "VERTEX_SE2")
VERTEX_TAGS = (*POSE_TAGS, "VERTEX_XY")
GRAPH_TAGS = (*ODOMETRY_TAGS, *LANDMARK_TAGS, *VERTEX_TAGS, "FIX")
#: Of g2o: frames of sensors, and measured poses.
UNUSED = ("PARAMS_", "EDGE_PRIOR_")
#: By which a line of any graph begins, planar or not.
PREFIXES = ("EDGE", "VERTEX", "PARAMS_")


@dataclass
class Graph:
    """The lines of a graph, every one with a known tag.

    Attributes
    ----------
    lines : list of LogLine
        All lines, in the order of the file.
    edges : list of LogLine
        Relative poses: pose j in the frame of pose i.
    readings : dict of int to list of LogLine
        Landmarks in the frame of a pose, by the id of that pose.
    vertices : list of LogLine
        Values of poses and landmarks: estimates, or the truth.
    priors : int
        Number of measured poses, which are not read.
    """

    lines: list[LogLine]
    edges: list[LogLine] = field(default_factory=list)
    readings: dict[int, list[LogLine]] = field(default_factory=dict)
    vertices: list[LogLine] = field(default_factory=list)
    priors: int = 0


def sort_lines(lines: list[LogLine]) -> Graph:
    """Sort the lines of a graph by their kind.

    Raises
    ------
    LogError
        If a line has no known tag, or has a wrong number of fields.
    """
    graph = Graph(lines)
    for line in lines:
        tag, *fields = line.text.split()
        if tag in ODOMETRY_TAGS:
            line.check_count(fields, (5, 11), f"{tag} i j dx dy dθ [6 of information]")
            graph.edges.append(line)
        elif tag in LANDMARK_TAGS:
            is_polar = tag == "BR"
            form = "bearing range [σβ σr]" if is_polar else "x y [3 of information]"
            line.check_count(fields, (4, 6 if is_polar else 7), f"{tag} i j {form}")
            graph.readings.setdefault(id_at(line, 1), []).append(line)
        elif tag in VERTEX_TAGS:
            graph.vertices.append(line)
        elif tag.startswith(UNUSED):
            graph.priors += tag.startswith("EDGE")
        elif tag != "FIX":
            planar = " of a planar graph" if "SE3" in tag else ""
            raise line.error(" or ".join(GRAPH_TAGS) + planar, shown(line.text))
    return graph


class Increment(NamedTuple):
    """The motion of one step, and the line that it comes from."""

    #: The edge, in either direction.
    line: LogLine
    #: The new pose (dx, dy, dθ) in the frame of the old one [m, m, rad].
    motion: tuple[float, float, float]


def chain_of(graph: Graph) -> tuple[list[Increment], dict[int, int], int]:
    """Follow the odometry of a graph from pose to pose.

    Odometry is the edge between two poses whose ids are next to each other, in either
    direction, wherever it stands. Of several such edges it is an ``ODOMETRY`` line, or
    one that leads forward. If the ids do not grow along the drive, every edge must
    begin at the end of the edge before it.

    Returns
    -------
    chain : list of Increment
        One per step.
    steps : dict of int to int
        The step after which the robot is at a pose, by the id of the pose; 0 for the
        first pose.
    closures : int
        Number of other edges between poses of the chain: loop closures.

    Raises
    ------
    LogError
        If there is no odometry, or it is no chain.
    """
    if not graph.edges:
        raise graph.lines[-1].error("odometry", "the end of the file")
    between: dict[tuple[int, int], LogLine] = {}
    for line in graph.edges:
        i, j = id_at(line, 1), id_at(line, 2)
        if i == j:
            raise line.error("odometry to a new pose", f"to pose {j} again")
        pair = (min(i, j), max(i, j))
        other = between.get(pair)
        between[pair] = line if other is None else min(line, other, key=_rank)
    poses = sorted({pose for pair in between for pose in pair})
    pairs = list(pairwise(poses))
    if not between.keys() >= set(pairs):
        starts, ends = (
            [id_at(line, place) for line in graph.edges] for place in (1, 2)
        )
        poses = [starts[0], *ends]
        if starts[1:] != ends[:-1] or len(set(poses)) < len(poses):
            raise _gap(graph, next(pair for pair in pairs if pair not in between))
        pairs = list(pairwise(poses))
    chain = [_increment(between[min(pair), max(pair)], start=pair[0]) for pair in pairs]
    steps = {pose: step for step, pose in enumerate(poses)}
    return chain, steps, len(graph.edges) - len(chain)


def _rank(line: LogLine) -> tuple[object, ...]:
    """Order the edges between two poses: the first one is the odometry."""
    tag, start, end, *numbers = line.text.split()
    return tag != "ODOMETRY", int(start) > int(end), -len(numbers), numbers


def _gap(graph: Graph, pair: tuple[int, int]) -> slamlog.LogError:
    """Return the error that no edge leads from one pose to the next."""
    at_end = (
        line for line in graph.edges if pair[1] in (id_at(line, 1), id_at(line, 2))
    )
    return next(at_end).error(
        f"odometry between the consecutive poses {pair[0]} and {pair[1]}",
        "no such edge in the file",
    )


def _increment(line: LogLine, *, start: int) -> Increment:
    """Return the motion of an edge from its pose ``start`` to the other one."""
    dx, dy, turn = reals_at(line, 3, 6)
    if id_at(line, 1) == start:
        return Increment(line, (dx, dy, turn))
    cos, sin = math.cos(turn), math.sin(turn)
    return Increment(line, (-cos * dx - sin * dy, sin * dx - cos * dy, -turn))


def unread_landmarks(graph: Graph) -> list[int]:
    """Return the ids of landmarks that have a vertex, but no reading."""
    lines = [line for lines in graph.readings.values() for line in lines]
    read = {id_at(line, 2) for line in lines}
    named = {
        id_at(line, 1) for line in graph.vertices if line.text.split()[0] == "VERTEX_XY"
    }
    return sorted(named - read)


def id_at(line: LogLine, place: int) -> int:
    """Read an id from a field of a line, the tag being field 0."""
    return line.to_id(line.text.split(maxsplit=place + 1)[place])


def reals_at(line: LogLine, first: int, end: int | None = None) -> list[float]:
    """Read numbers from some fields of a line, the tag being field 0."""
    return [line.to_real(number) for number in line.text.split()[first:end]]


# --------------------------------------------------------------------------------------
# The noise that the information matrices of a graph specify, as a filter assumes it.
#
# An edge with the information Ω claims the standard deviation ``sqrt(uᵀ Ω⁻¹ u)`` along
# a unit vector u. For odometry u is along and across the drive, and in the turn; for a
# reading it is along and across the line of sight. Correlations are ignored.
#
# Four conventions are in use:
#
# * iSAM's ``ODOMETRY``, ``EDGE2`` and ``LANDMARK`` lines hold the upper triangular R of
#   Ω = Rᵀ R by rows, in the frame of pose i.
# * g2o's ``EDGE_SE2`` and ``EDGE_SE2_XY`` lines hold the upper triangle of Ω by rows;
#   that of an ``EDGE_SE2`` is in the frame of pose j.
# * GTSAM's ``BR`` lines hold the standard deviations of bearing and range.
# * A file with ``VERTEX2`` lines is TORO's, whose ``EDGE2`` lines hold Ω in the order
#   xx, xy, yy, θθ, xθ, yθ.

#: Relative difference of standard deviations up to which they count as equal.
ALIKE = 1e-3

G2O, ISAM, TORO = "g2o", "iSAM", "TORO"
_ROWS = {2: (0, 1, 1, 2), 3: (0, 1, 2, 1, 3, 4, 2, 4, 5)}
_TORO_ROWS = (0, 1, 4, 1, 2, 5, 4, 5, 3)


def noise_header(graph: Graph, chain: Sequence[Increment]) -> dict[str, str]:
    """Return the noise of a graph as entries of a log's header.

    Each standard deviation is the median over the lines. Readings have the bearing
    noise σβ or, if this fits better, the noise b across the line of sight of a sensor
    of positions, so that σβ = b / r.

    Returns
    -------
    dict of str to str
        ``motion_std``, ``measurement_std`` if the graph has readings,
        ``bearing_std_metres`` for a sensor of positions, and ``noise``, which states
        whether the matrices differ.

    Raises
    ------
    LogError
        If a line has no information, or a singular or indefinite one.
    """
    is_toro = any(line.text.split()[0] == "VERTEX2" for line in graph.vertices)
    motion = np.array([_motion_std(each.line, is_toro=is_toro) for each in chain])
    header = {"motion_std": slamlog.numbers(*np.median(motion, axis=0))}
    are_alike = _alike(motion)
    lines = [line for at_pose in graph.readings.values() for line in at_pose]
    if lines:
        sensor, stds = _sensor_noise(lines)
        header |= sensor
        are_alike &= _alike(stds)
    what = "its" if are_alike else "the medians of its differing"
    return {**header, "noise": f"from the file, by {what} information matrices"}


def _sensor_noise(lines: Sequence[LogLine]) -> tuple[dict[str, str], Array]:
    """Return the entries of the readings, and the deviations that they are from."""
    bearing, across, along = np.array([_reading_std(line) for line in lines]).T
    if _spread(across) < _spread(bearing):
        sensor = {"bearing_std_metres": slamlog.numbers(np.median(across))}
        sensor["measurement_std"] = slamlog.numbers(0.0, np.median(along))
        return sensor, np.column_stack([across, along])
    stds = slamlog.numbers(float(np.median(bearing)), np.median(along))
    return {"measurement_std": stds}, np.column_stack([bearing, along])


def _motion_std(line: LogLine, *, is_toro: bool) -> Array:
    """Return (σx, σy, σα) along the drive, across, and of the turn.

    They do not depend on the direction of the edge.
    """
    dx, dy, turn = reals_at(line, 3, 6)
    angle = math.atan(dy / dx) if dx else math.copysign(math.pi / 2, dy) * (dy != 0)
    tag = line.text.split()[0]
    kind = {"EDGE_SE2": G2O, "EDGE2": TORO if is_toro else ISAM}.get(tag, ISAM)
    if kind == G2O:
        angle -= turn
    cos, sin = math.cos(angle), math.sin(angle)
    return _stds(line, 6, kind, np.array([(cos, sin, 0), (-sin, cos, 0), (0, 0, 1)]))


def _reading_std(line: LogLine) -> Array:
    """Return the standard deviations of the bearing, across, and of the range."""
    _, distance = polar_at(line)
    if not distance:
        raise line.error("a landmark away from its pose", "distance 0")
    if line.text.startswith("BR"):
        stds = reals_at(line, 5)
        if not (stds and min(stds) > 0):
            raise line.error(
                "standard deviations > 0 at the end of the line", line.text
            )
        return np.array([stds[0], distance * stds[0], stds[1]])
    x, y = reals_at(line, 3, 5)
    cos, sin = x / distance, y / distance
    kind = ISAM if line.text.split()[0] == "LANDMARK" else G2O
    across, along = _stds(line, 5, kind, np.array([(-sin, cos), (cos, sin)]))
    return np.array([across / distance, across, along])


def _stds(line: LogLine, first: int, kind: str, directions: Array) -> Array:
    """Return the standard deviation along each row of ``directions``."""
    values = np.array(reals_at(line, first))
    if not len(values):
        raise line.error("information at the end of the line", "none")
    size = directions.shape[1]
    rows = _TORO_ROWS if kind == TORO and size == 3 else _ROWS[size]
    matrix = values[list(rows)].reshape(size, size)
    if kind == ISAM:
        upper = np.triu(matrix)
        matrix = upper.T @ upper
    try:
        lower = np.linalg.cholesky(matrix)
    except np.linalg.LinAlgError:
        raise line.error("positive definite information", line.text) from None
    # with Ω = L Lᵀ, uᵀ Ω⁻¹ u = ‖L⁻¹ u‖²
    return np.asarray(np.linalg.norm(np.linalg.solve(lower, directions.T), axis=0))


def _alike(table: Array) -> bool:
    """Whether the rows of a table are equal but for rounding."""
    return bool(np.allclose(table, np.median(table, axis=0), rtol=ALIKE, atol=0))


def _spread(values: Array) -> float:
    """Return how much positive numbers differ, relative to their size."""
    return float(np.std(np.log(values)))


Point = tuple[float, ...]


def with_truth(
    log: slamlog.SlamLog, steps: Mapping[int, int], path: str | PathLike[str]
) -> slamlog.SlamLog:
    """Return the log with the truth of a graph file.

    The file holds a line ``VERTEX2`` or ``VERTEX_SE2`` for every pose, and may hold a
    ``VERTEX_XY`` for every landmark. Or it has no such line, but exact ``EDGE2`` or
    ``ODOMETRY`` and ``LANDMARK`` lines: its poses then follow from them, from the
    origin. Ids are those of the log's file.

    Parameters
    ----------
    log : SlamLog
        A log without truth, in which pose k has t = k.
    steps : mapping of int to int
        k of every pose, by its id in the file of the log.
    path : path
        The file.

    Returns
    -------
    SlamLog
        The log, which starts at the first true pose.

    Raises
    ------
    LogError
        If the file is no such graph, or its poses are not those of the log.
    OSError
        If it cannot be opened.
    """
    graph = sort_lines(content_of(read_lines(path)))
    poses, places = _values(graph)
    if not poses:
        poses = _composed(graph)
        places = _seen_places(graph, poses)
    if len(poses) != len(steps):
        raise slamlog.LogError(
            f"{path}: expected the true poses of the {len(steps)} poses of the log, "
            f"got {len(poses)}"
        )
    if missing := steps.keys() - poses.keys():
        raise slamlog.LogError(
            f"{path}: expected the poses of the log, found no pose {min(missing)}"
        )
    table = np.array([(step, *poses[i]) for i, step in steps.items()])
    return replace(
        log,
        header={**log.header, "truth": f"graph {Path(path).name}"},
        start=table[0, 1:],
        landmark_ids=np.array(list(places), dtype=np.int64),
        landmarks=np.array(list(places.values())).reshape(-1, 2),
        ground_truth=table,
    )


def true_path(lines: list[LogLine]) -> TruePath:
    """Return the poses in the vertices of a graph, by their ids."""
    poses, _ = _values(sort_lines(lines))
    if not poses:
        raise lines[-1].error(f"{' or '.join(POSE_TAGS)} lines", "the end of the file")
    rows = [(k, *poses[i]) for k, i in enumerate(sorted(poses))]
    return TruePath(np.array(rows, dtype=np.float64), has_times=False)


def _values(graph: Graph) -> tuple[dict[int, Point], dict[int, Point]]:
    """Return the poses and the places of landmarks in the vertices, by id."""
    poses: dict[int, Point] = {}
    places: dict[int, Point] = {}
    for line in graph.vertices:
        tag, *fields = line.text.split()
        known, form = (poses, "i x y θ") if tag in POSE_TAGS else (places, "i x y")
        line.check_count(fields, (len(form.split()),), f"{tag} {form}")
        if id_at(line, 1) in known:
            raise line.error("each vertex once", f"{tag} {fields[0]} again")
        known[id_at(line, 1)] = tuple(reals_at(line, 2))
    return poses, places


def _composed(graph: Graph) -> dict[int, Point]:
    """Return the poses that exact odometry leads to, by id."""
    chain, steps, _ = chain_of(graph)
    poses: list[Point] = [(0.0, 0.0, 0.0)]
    for _, (dx, dy, turn) in chain:
        poses.append((*_to_world(poses[-1], dx, dy), poses[-1][2] + turn))
    return {i: poses[step] for i, step in steps.items()}


def _seen_places(graph: Graph, poses: Mapping[int, Point]) -> dict[int, Point]:
    """Return the places where exact readings show the landmarks first, by id."""
    places: dict[int, Point] = {}
    for pose, lines in graph.readings.items():
        for line in lines:
            if pose not in poses:
                raise line.error("a pose of the odometry", f"pose {pose}")
            first, second = reals_at(line, 3, 5)
            if line.text.startswith("BR"):
                bearing, distance = first, second
                first = distance * math.cos(bearing)
                second = distance * math.sin(bearing)
            place = _to_world(poses[pose], first, second)
            places.setdefault(id_at(line, 2), place)
    return places


def _to_world(pose: Point, dx: float, dy: float) -> tuple[float, float]:
    x, y, heading = pose
    cos, sin = math.cos(heading), math.sin(heading)
    return x + cos * dx - sin * dy, y + sin * dx + cos * dy


def read_isam(
    path: str | PathLike[str],
    *,
    truth: str | PathLike[str] | None = None,
    noise_from_file: bool = False,
) -> slamlog.SlamLog:
    """Read a graph whose odometry forms one chain of poses.

    Poses and landmarks share one sequence of ids in many files: landmarks keep theirs,
    while poses are renumbered, so that pose k has t = k. An increment (dx, dy, dθ)
    becomes two turn-last rows, (0, φ) with dt = 0 and (d, dθ - φ) with dt = 1, where
    d (cos φ, sin φ) = (dx, dy) and φ in [-π/2, π/2]; d < 0 means driving backwards.

    The order of the lines has no meaning: see :func:`.graph.chain_of` for the odometry,
    and a scan is in the order of its landmarks' ids. Loop closures, the other edges
    between poses, are left out and counted in the header (``left_out``): a filter has
    no use for them. So are measured poses. Landmarks that have a vertex, but no edge,
    are named there too.

    Parameters
    ----------
    path : path
        The file.
    truth : path, optional
        A graph of the true poses, see :func:`.graph.with_truth`.
    noise_from_file : bool
        Whether the header gets the noise that the information matrices specify, see
        :func:`.graph.noise_header`.

    Returns
    -------
    SlamLog
        Motion turn-last, one unit of time per pose. It starts at the first true pose,
        without a truth at the origin.

    Raises
    ------
    LogError
        If a line has no known tag, or the odometry is no chain, or a landmark is
        seen from a pose outside the chain, or a graph with loop closures has no
        landmarks, or the truth is of other poses, or the noise is asked for and a line
        does not specify it.
    OSError
        If a file cannot be opened.
    """
    graph = sort_lines(content_of(read_lines(path)))
    if not graph.readings and _has_closures(graph):
        raise graph.lines[-1].error(
            "readings of landmarks, as a filter has no use for loop closures between "
            f"poses: {', '.join(LANDMARK_TAGS)} lines",
            "the end of the file",
        )
    chain, steps, closures = chain_of(graph)
    header = {"source": "iSAM or g2o text", "truth": "none"}
    left_out = [f"{closures} loop closures between poses"] * bool(closures)
    left_out += [f"{graph.priors} measured poses"] * bool(graph.priors)
    left_out += [f"landmark {i}, which no edge reads" for i in unread_landmarks(graph)]
    if left_out:
        header["left_out"] = "; ".join(left_out)
    if noise_from_file:
        header |= noise_header(graph, chain)
    log = slamlog.SlamLog(
        name=Path(path).stem, header=header, events=_events(graph, chain, steps)
    )
    return log if truth is None else with_truth(log, steps, truth)


def _has_closures(graph: Graph) -> bool:
    """Whether a graph has more edges between poses than a chain of them has."""
    poses = {id_at(line, place) for line in graph.edges for place in (1, 2)}
    return len(graph.edges) >= max(len(poses), 1)


def _events(
    graph: Graph, chain: list[Increment], steps: dict[int, int]
) -> tuple[slamlog.Event, ...]:
    """Follow the chain of poses, and record the readings of each pose."""
    for pose in graph.readings.keys() - steps.keys():
        raise graph.readings[pose][0].error("a pose of the odometry", f"pose {pose}")
    recorder = slamlog.EventRecorder()
    for pose, step in steps.items():
        if step:
            _take_increment(recorder, chain[step - 1], step)
        lines = graph.readings.get(pose, [])
        if len(lines) > 1:
            lines = sorted(lines, key=lambda at: id_at(at, 2))
        for line in lines:
            reading = slamlog.Reading(float(step), id_at(line, 2), *polar_at(line))
            recorder.add_reading(line, reading)
    return recorder.finish()


def polar_at(line: LogLine) -> tuple[float, float]:
    """Return bearing and range of the landmark in a line [rad, m]."""
    first, second = reals_at(line, 3, 5)
    if line.text.startswith("BR"):
        return slamlog.wrap_bearing(first), second
    bearing = slamlog.wrap_bearing(math.atan2(second, first))
    return bearing, math.hypot(first, second)


def _take_increment(
    recorder: slamlog.EventRecorder, increment: Increment, step: int
) -> None:
    line, (dx, dy, turn) = increment
    sign = -1.0 if dx < 0 else 1.0
    direction = math.atan2(sign * dy, abs(dx))
    distance = sign * math.hypot(dx, dy)
    recorder.add_turn_drive_turn(
        line, step, before=direction, d=distance, after=turn - direction
    )
