"""True poses and landmarks for a log, from a graph file that holds them."""

import math
from collections.abc import Mapping
from dataclasses import replace
from os import PathLike
from pathlib import Path

import numpy as np

from ..lines import LogError, read_lines
from ..slamlog import SlamLog
from .graph import POSE_TAGS, Graph, chain_of, id_at, reals_at, sort_lines

Point = tuple[float, ...]


def with_truth(
    log: SlamLog, steps: Mapping[int, int], path: str | PathLike[str]
) -> SlamLog:
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
    graph = sort_lines(read_lines(path))
    poses, places = _values(graph)
    if not poses:
        poses = _composed(graph)
        places = _seen_places(graph, poses)
    _check_poses(path, poses, steps)
    table = np.array([(step, *poses[i]) for i, step in steps.items()])
    return replace(
        log,
        header={**log.header, "truth": f"graph {Path(path).name}"},
        start=table[0, 1:],
        landmark_ids=np.array(list(places), dtype=np.int64),
        landmarks=np.array(list(places.values())).reshape(-1, 2),
        ground_truth=table,
    )


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


def _check_poses(
    path: str | PathLike[str], poses: Mapping[int, Point], steps: Mapping[int, int]
) -> None:
    if len(poses) != len(steps):
        raise LogError(
            f"{path}: expected the true poses of the {len(steps)} poses of the log, "
            f"got {len(poses)}"
        )
    missing = steps.keys() - poses.keys()
    if missing:
        raise LogError(
            f"{path}: expected the poses of the log, found no pose {min(missing)}"
        )


def _composed(graph: Graph) -> dict[int, Point]:
    """Return the poses that exact odometry leads to, by id."""
    chain, steps, _ = chain_of(graph)
    poses: list[Point] = [(0.0, 0.0, 0.0)]
    for line in chain:
        dx, dy, turn = reals_at(line, 3, 6)
        poses.append((*_to_world(poses[-1], dx, dy), poses[-1][2] + turn))
    return {i: poses[step] for i, step in steps.items()}


def _seen_places(graph: Graph, poses: Mapping[int, Point]) -> dict[int, Point]:
    """Return the places where exact readings show the landmarks first, by id."""
    places: dict[int, Point] = {}
    for pose, lines in graph.readings.items():
        for line in lines:
            if pose not in poses:
                raise line.error("a pose of the odometry", f"pose {pose}")
            place = _to_world(poses[pose], *reals_at(line, 3, 5))
            places.setdefault(id_at(line, 2), place)
    return places


def _to_world(pose: Point, dx: float, dy: float) -> tuple[float, float]:
    x, y, heading = pose
    cos, sin = math.cos(heading), math.sin(heading)
    return x + cos * dx - sin * dy, y + sin * dx + cos * dy
