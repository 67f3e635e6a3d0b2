"""Read pose-landmark graphs as text, in the formats of iSAM, TORO and g2o.

Lines ``ODOMETRY i j dx dy dθ …`` or ``EDGE2`` (pose j in the frame of pose i) and
``LANDMARK i j x y …`` (landmark j in the frame of pose i), or ``EDGE_SE2`` and
``EDGE_SE2_XY``. The information matrices at the ends of the lines are ignored unless
asked for, and so are the estimates in ``VERTEX`` and ``FIX`` lines.
"""

import math
from os import PathLike
from pathlib import Path

from ..events import EventRecorder, OdometryRow, Reading, Scan, wrap_bearing
from ..lines import LogLine, read_lines
from ..slamlog import SlamLog
from .graph import Graph, chain_of, id_at, reals_at, sort_lines, unread_landmarks
from .graph_noise import noise_header
from .graph_truth import with_truth


def read_isam(
    path: str | PathLike[str],
    *,
    truth: str | PathLike[str] | None = None,
    noise_from_file: bool = False,
) -> SlamLog:
    """Read a graph whose odometry lines form one chain of poses.

    Poses and landmarks share one sequence of ids in many files: landmarks keep theirs,
    while poses are renumbered, so that pose k has t = k. An increment (dx, dy, dθ)
    becomes two turn-last rows, (0, φ) with dt = 0 and (d, dθ - φ) with dt = 1, where
    d (cos φ, sin φ) = (dx, dy) and φ in [-π/2, π/2]; d < 0 means driving backwards.

    Loop closures, edges between two poses that were both visited before, are left out
    and counted in the header (``left_out``): a filter has no use for them. Landmarks
    that have a vertex, but no edge, are named there too.

    Parameters
    ----------
    path : path
        The file.
    truth : path, optional
        A graph of the true poses, see :func:`.graph_truth.with_truth`.
    noise_from_file : bool
        Whether the header gets the noise that the information matrices specify, see
        :func:`.graph_noise.noise_header`.

    Returns
    -------
    SlamLog
        Motion turn-last, one unit of time per pose. It starts at the first true pose,
        without a truth at the origin.

    Raises
    ------
    LogError
        If a line is of no known kind, or the odometry is no chain, or a landmark is
        seen from a pose outside the chain, or a graph with loop closures has no
        landmarks, or the truth is of other poses, or the noise is asked for and a line
        does not specify it.
    OSError
        If a file cannot be opened.
    """
    graph = sort_lines(read_lines(path))
    chain, steps, closures = chain_of(graph)
    header = {"source": "iSAM or g2o text", "truth": "none"}
    if closures and not graph.readings:
        raise graph.lines[-1].error(
            "readings of landmarks, as a filter has no use for loop closures "
            "between poses",
            "the end of the file",
        )
    left_out = [f"{closures} loop closures between poses"] * bool(closures)
    left_out += [f"landmark {i}, which no edge reads" for i in unread_landmarks(graph)]
    if left_out:
        header["left_out"] = "; ".join(left_out)
    if noise_from_file:
        header |= noise_header(graph, chain)
    log = SlamLog(
        name=Path(path).stem, header=header, events=_events(graph, chain, steps)
    )
    return log if truth is None else with_truth(log, steps, truth)


def _events(
    graph: Graph, chain: list[LogLine], steps: dict[int, int]
) -> tuple[OdometryRow | Scan, ...]:
    """Follow the chain of poses, and record the readings of each pose."""
    for pose in graph.readings.keys() - steps.keys():
        raise graph.readings[pose][0].error("a pose of the odometry", f"pose {pose}")
    recorder = EventRecorder()
    for pose, step in steps.items():
        if step:
            _take_increment(recorder, chain[step - 1], step)
        for line in graph.readings.get(pose, []):
            _take_reading(recorder, line, step)
    return recorder.finish()


def _take_increment(recorder: EventRecorder, line: LogLine, step: int) -> None:
    dx, dy, turn = reals_at(line, 3, 6)
    sign = -1.0 if dx < 0 else 1.0
    direction = math.atan2(sign * dy, abs(dx))
    distance = sign * math.hypot(dx, dy)
    recorder.add_turn_drive_turn(
        line, step, before=direction, d=distance, after=turn - direction
    )


def _take_reading(recorder: EventRecorder, line: LogLine, step: int) -> None:
    x, y = reals_at(line, 3, 5)
    bearing = wrap_bearing(math.atan2(y, x))
    recorder.add_reading(
        line, Reading(float(step), id_at(line, 2), bearing, math.hypot(x, y))
    )
