"""Lines of a pose-landmark graph in text, as iSAM, TORO and g2o write it, by kind."""

from __future__ import annotations

from dataclasses import dataclass, field

from ..lines import LogLine, shown

EDGE_TAGS = ("EDGE_SE2", "EDGE2")
ODOMETRY_TAGS = ("ODOMETRY", *EDGE_TAGS)
LANDMARK_TAGS = ("LANDMARK", "EDGE_SE2_XY")
POSE_TAGS = ("VERTEX2", "VERTEX_SE2")
VERTEX_TAGS = (*POSE_TAGS, "VERTEX_XY")
GRAPH_TAGS = (*ODOMETRY_TAGS, *LANDMARK_TAGS, *VERTEX_TAGS, "FIX")


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
    """

    lines: list[LogLine]
    edges: list[LogLine] = field(default_factory=list)
    readings: dict[int, list[LogLine]] = field(default_factory=dict)
    vertices: list[LogLine] = field(default_factory=list)


def sort_lines(lines: list[LogLine]) -> Graph:
    """Sort the lines of a graph by their kind.

    Raises
    ------
    LogError
        If a line is of no known kind, or has a wrong number of fields.
    """
    graph = Graph(lines)
    for line in lines:
        tag, *fields = line.text.split()
        if tag in ODOMETRY_TAGS:
            line.check_count(fields, (5, 11), f"{tag} i j dx dy dθ [6 of information]")
            graph.edges.append(line)
        elif tag in LANDMARK_TAGS:
            line.check_count(fields, (4, 7), f"{tag} i j x y [3 of information]")
            graph.readings.setdefault(id_at(line, 1), []).append(line)
        elif tag in VERTEX_TAGS:
            graph.vertices.append(line)
        elif tag != "FIX":
            raise line.error(" or ".join(GRAPH_TAGS), shown(line.text))
    return graph


def chain_of(graph: Graph) -> tuple[list[LogLine], dict[int, int], int]:
    """Follow the odometry of a graph from pose to pose, in the order of the file.

    Returns
    -------
    chain : list of LogLine
        One edge per step.
    steps : dict of int to int
        The step after which the robot is at a pose, by the id of the pose; 0 for the
        first pose.
    closures : int
        Number of other edges between poses of the chain: loop closures, which are in
        ``EDGE`` lines.

    Raises
    ------
    LogError
        If there is no odometry, or it is no chain.
    """
    if not graph.edges:
        raise graph.lines[-1].error("odometry", "the end of the file")
    pose = id_at(graph.edges[0], 1)
    chain: list[LogLine] = []
    steps, closures = {pose: 0}, 0
    for line in graph.edges:
        start, end = id_at(line, 1), id_at(line, 2)
        if _is_closure(line, start, end, steps):
            closures += 1
            continue
        if start != pose:
            raise line.error(f"odometry from pose {pose}", f"from pose {start}")
        if end in steps:
            raise line.error("odometry to a new pose", f"to pose {end} again")
        chain.append(line)
        pose, steps[end] = end, len(chain)
    return chain, steps, closures


def unread_landmarks(graph: Graph) -> list[int]:
    """Return the ids of landmarks that have a vertex, but no reading."""
    lines = [line for lines in graph.readings.values() for line in lines]
    read = {id_at(line, 2) for line in lines}
    named = {
        id_at(line, 1) for line in graph.vertices if line.text.split()[0] == "VERTEX_XY"
    }
    return sorted(named - read)


def _is_closure(line: LogLine, start: int, end: int, steps: dict[int, int]) -> bool:
    """Whether a line is an edge between two poses that were visited before."""
    is_edge = line.text.split()[0] in EDGE_TAGS
    return is_edge and start != end and {start, end} <= steps.keys()


def id_at(line: LogLine, place: int) -> int:
    """Read an id from a field of a line, the tag being field 0."""
    return line.to_id(line.text.split()[place])


def reals_at(line: LogLine, first: int, end: int | None = None) -> list[float]:
    """Read numbers from some fields of a line, the tag being field 0."""
    return [line.to_real(number) for number in line.text.split()[first:end]]
