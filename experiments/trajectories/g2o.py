"""Shards as folders of pose-landmark graphs in g2o text, for graph optimisers.

Vertices 0 … N - 1 are the landmarks, N + k is the pose of step k. Three files per
episode:

``NAME.g2o``
    ``EDGE_SE2`` odometry (d, 0, α) and ``EDGE_SE2_XY`` readings in the form of g2o. The
    vertices stand where an invariant EKF puts them during the drive, near enough for
    Gauss-Newton and Levenberg-Marquardt. The first pose is fixed.
``NAME_gtsam.g2o``
    The same with readings as ``BR`` lines, bearing and range, because GTSAM ignores
    ``EDGE_SE2_XY``, and without ``FIX``, which GTSAM rejects.
``NAME_truth.g2o``
    Vertices alone: the true poses and landmarks.

The files hold start, odometry, readings and truth with exact numbers, and the
information of the noise, but no actions and no collisions. Hidden identities are
refused.
"""

import math
from collections.abc import Iterable, Iterator, Sequence
from itertools import count, repeat
from pathlib import Path
from typing import Any

import numpy as np

from ...arrays import Array
from ...sim_configs import Scenario
from ..logs.decimals import texts
from ..logs.log_lines import columns_of, rows_of, table_of
from .formats import filtered_path, read_metadata, write_lines, write_metadata
from .trajectory import Trajectory, array_of

LIBRARIES = ("numba", "scipy")
#: The smallest standard deviation in the files [m, rad]: noise of zero would have
#: infinite information, and optimisers do not converge with 1e-6.
OPTIONS = {"smallest_std": 1e-3}


def check(scenario: Scenario) -> None:
    """Refuse hidden identities, and sensors and drives that the edges do not hold."""
    scenario.refuse_models("format 'g2o'")
    if not scenario.sensor.identities:
        raise ValueError(
            f"format 'g2o' needs sensor.identities = true, scenario '{scenario.name}' "
            "hides them"
        )


def write(
    trajectories: Sequence[Trajectory],
    path: Path,
    smallest_std: float = OPTIONS["smallest_std"],
) -> None:
    """Write a shard; see `TrajectoryFormat`."""
    for each in trajectories:
        check(each.scenario)
    for name, each in write_metadata(trajectories, path):
        landmarks = array_of(each, "landmarks")
        poses, mapped = filtered_path(each)
        places = dict(sorted({**_first_seen(each, poses), **mapped}.items()))
        first = len(landmarks)
        graph = _vertices(list(places), np.array([*places.values()]), poses, first)
        graph += _odometry_edges(each, first, smallest_std)
        positions, polar = _readings(each, smallest_std)
        write_lines(path / f"{name}.g2o", [*graph, *positions, f"FIX {first}"])
        write_lines(path / f"{name}_gtsam.g2o", [*graph, *polar])
        truth = _vertices(range(first), landmarks, each.poses, first)
        write_lines(path / f"{name}_truth.g2o", truth)


def read(path: Path) -> Iterator[Trajectory]:
    """Yield the trajectories of a shard; see `TrajectoryFormat`."""
    for name, about in read_metadata(path):
        yield _trajectory(path / name, about)


def _vertices(
    ids: Iterable[int], landmarks: Array, poses: Array, first: int
) -> list[str]:
    places = landmarks.reshape(-1, 2).T
    each = rows_of(" ", repeat("VERTEX_XY"), map(str, ids), *map(texts, places))
    return each + rows_of(
        " ", repeat("VERTEX_SE2"), map(str, count(first)), *map(texts, poses.T)
    )


def _first_seen(trajectory: Trajectory, poses: Array) -> dict[int, Array]:
    """Return the position of every seen landmark from its first reading."""
    mask = array_of(trajectory, "mask")
    measurements = array_of(trajectory, "measurements")
    placed = {}
    for landmark in np.flatnonzero(mask.any(axis=0)).tolist():
        step = int(mask[:, landmark].argmax())
        (bearing, distance), (x, y, heading) = measurements[step, landmark], poses[step]
        angle = heading + bearing
        placed[landmark] = np.array(
            [x + distance * math.cos(angle), y + distance * math.sin(angle)]
        )
    return placed


def _odometry_edges(
    trajectory: Trajectory, first_pose: int, smallest: float
) -> list[str]:
    """Return odometry with the information of its noise.

    The noise (εx, εy) refers to the old heading, while the error of an edge refers to
    the new one, rotated by α::

        Ω = diag(R(-α) diag(σx⁻², σy⁻²) R(α), σα⁻²)
    """
    motion, odometry = trajectory.scenario.motion, trajectory.odometry
    moves = np.logical_or(odometry.any(axis=1), motion.noise_at_rest)
    at_rest = max(0.0, smallest) ** -2
    moving = [max(std, smallest) ** -2 for std in motion.std]
    along, aside = (np.where(moves, value, at_rest) for value in moving[:2])
    heading = texts(np.where(moves, moving[2], at_rest))
    xx, xy, yy = map(texts, _turned(along, aside, -odometry[:, 1]))
    start, end, zero = count(first_pose), count(first_pose + 1), repeat("0.0")
    distance, turn = map(texts, odometry.T)
    ends = repeat("EDGE_SE2"), map(str, start), map(str, end)
    information = xx, xy, zero, yy, zero, heading
    return rows_of(" ", *ends, distance, zero, turn, *information)


def _readings(trajectory: Trajectory, smallest: float) -> tuple[list[str], list[str]]:
    """Return all readings as positions in the robot's frame, and as (β, r, σβ, σr).

    The information of the position is of first order.
    """
    mask = array_of(trajectory, "mask")
    bearing, distance = array_of(trajectory, "measurements")[mask].T
    sensor = trajectory.scenario.sensor
    bearing_std = max(sensor.std[0], smallest)
    range_std = sensor.std[1] + sensor.range_std_per_metre * distance
    range_std = np.maximum(range_std, smallest)
    cos, sin = _cos_sin(bearing)
    along, aside = (
        np.array([*map(math.pow, stds.tolist(), repeat(-2.0))])
        for stds in (range_std, distance * bearing_std)
    )
    information = _turned(along, aside, bearing)
    step, landmark = np.nonzero(mask)
    places = [map(str, (mask.shape[1] + step).tolist()), map(str, landmark.tolist())]
    ends = rows_of(" ", *places)
    columns = distance * cos, distance * sin, *information
    polar = *map(texts, (bearing, distance)), repeat(repr(bearing_std))
    return (
        rows_of(" ", repeat("EDGE_SE2_XY"), ends, *map(texts, columns)),
        rows_of(" ", repeat("BR"), ends, *polar, texts(range_std)),
    )


def _turned(along: Array, aside: Array, angles: Array) -> tuple[Array, Array, Array]:
    """Return xx, xy, yy of R(angle) diag(along, aside) R(angle)ᵀ."""
    cos, sin = _cos_sin(angles)
    return (
        along * cos * cos + aside * sin * sin,
        (along - aside) * sin * cos,
        along * sin * sin + aside * cos * cos,
    )


def _cos_sin(angles: Array) -> tuple[Array, Array]:
    """Return cosine and sine, with the same bits on every processor."""
    listed = angles.tolist()
    return np.array(list(map(math.cos, listed))), np.array(list(map(math.sin, listed)))


def _trajectory(path: Path, about: dict[str, Any]) -> Trajectory:
    graph, truth = (
        path.with_name(f"{path.name}_{end}.g2o").read_text(encoding="utf-8").split("\n")
        for end in ("gtsam", "truth")
    )
    _, *start = columns_of(graph, "VERTEX_SE2", " ", 5)
    _, _, distance, _, turn, *_ = columns_of(graph, "EDGE_SE2", " ", 12)
    landmarks = table_of(columns_of(truth, "VERTEX_XY", " ", 4)[1:])
    shape = (len(distance) + 1, len(landmarks))
    measurements, mask = np.zeros((*shape, 2)), np.zeros(shape, dtype=np.bool_)
    step, landmark, *reading, _, _ = columns_of(graph, "BR", " ", 7)
    places = (
        np.array([*map(int, step)], dtype=np.int64) - len(landmarks),
        np.array([*map(int, landmark)], dtype=np.int64),
    )
    measurements[places], mask[places] = table_of(reading), True
    return Trajectory(
        **about,
        start_estimate=table_of(column[:1] for column in start)[0],
        odometry=table_of([distance, turn]),
        poses=table_of(columns_of(truth, "VERTEX_SE2", " ", 5)[1:]),
        landmarks=landmarks,
        measurements=measurements,
        mask=mask,
    )
