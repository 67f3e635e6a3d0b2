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
from pathlib import Path
from typing import Any

import numpy as np

from ...arrays import Array
from ...sim_configs import Scenario
from .formats import filtered_path, numbers, read_metadata, write_lines, write_metadata
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
        landmarks = dict(enumerate(array_of(each, "landmarks")))
        poses, mapped = filtered_path(each)
        places = dict(sorted({**_first_seen(each, poses), **mapped}.items()))
        graph = [
            *_vertices(places, poses, len(landmarks)),
            *_odometry_edges(each, len(landmarks), smallest_std),
        ]
        readings = list(_readings(each, smallest_std))
        positions = [position for position, _ in readings]
        write_lines(path / f"{name}.g2o", [*graph, *positions, f"FIX {len(landmarks)}"])
        write_lines(
            path / f"{name}_gtsam.g2o", [*graph, *(line for _, line in readings)]
        )
        truth = _vertices(landmarks, each.poses, len(landmarks))
        write_lines(path / f"{name}_truth.g2o", list(truth))


def read(path: Path) -> Iterator[Trajectory]:
    """Yield the trajectories of a shard; see `TrajectoryFormat`."""
    for name, about in read_metadata(path):
        yield _trajectory(path / name, about)


def _vertices(landmarks: dict[int, Array], poses: Array, first: int) -> Iterator[str]:
    for place, position in landmarks.items():
        yield f"VERTEX_XY {place} {numbers(position)}"
    for place, pose in enumerate(poses, start=first):
        yield f"VERTEX_SE2 {place} {numbers(pose)}"


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
) -> Iterator[str]:
    """Yield odometry with the information of its noise.

    The noise (εx, εy) refers to the old heading, while the error of an edge refers to
    the new one, rotated by α::

        Ω = diag(R(-α) diag(σx⁻², σy⁻²) R(α), σα⁻²)
    """
    motion = trajectory.scenario.motion
    for step, (distance, turn) in enumerate(trajectory.odometry.tolist(), first_pose):
        rests = not motion.noise_at_rest and distance == turn == 0.0
        std = (0.0, 0.0, 0.0) if rests else motion.std
        along, aside, heading = (max(value, smallest) ** -2 for value in std)
        xx, xy, yy = _turned(along, aside, -turn)
        information = numbers((xx, xy, 0, yy, 0, heading))
        yield (
            f"EDGE_SE2 {step} {step + 1} {numbers((distance, 0, turn))} {information}"
        )


def _readings(trajectory: Trajectory, smallest: float) -> Iterator[tuple[str, str]]:
    """Yield every reading as a position in the robot's frame, and as (β, r, σβ, σr).

    The information of the position is of first order.
    """
    mask = array_of(trajectory, "mask")
    measurements = array_of(trajectory, "measurements")
    sensor = trajectory.scenario.sensor
    bearing_std = max(sensor.std[0], smallest)
    for step, landmark in np.argwhere(mask).tolist():
        bearing, distance = measurements[step, landmark].tolist()
        range_std = max(sensor.std[1] + sensor.range_std_per_metre * distance, smallest)
        information = _turned(range_std**-2, (distance * bearing_std) ** -2, bearing)
        position = distance * math.cos(bearing), distance * math.sin(bearing)
        ends = f"{mask.shape[1] + step} {landmark}"
        yield (
            f"EDGE_SE2_XY {ends} {numbers((*position, *information))}",
            f"BR {ends} {numbers((bearing, distance, bearing_std, range_std))}",
        )


def _turned(along: float, aside: float, angle: float) -> tuple[float, float, float]:
    """Return xx, xy, yy of R(angle) diag(along, aside) R(angle)ᵀ."""
    cos, sin = math.cos(angle), math.sin(angle)
    return (
        along * cos * cos + aside * sin * sin,
        (along - aside) * sin * cos,
        along * sin * sin + aside * cos * cos,
    )


def _trajectory(path: Path, about: dict[str, Any]) -> Trajectory:
    graph = _fields(path.with_name(f"{path.name}_gtsam.g2o"))
    truth = _fields(path.with_name(f"{path.name}_truth.g2o"))
    odometry = _table(graph, "EDGE_SE2", (3, 5))
    landmarks = _table(truth, "VERTEX_XY", (2, 3))
    shape = (len(odometry) + 1, len(landmarks))
    measurements, mask = np.zeros((*shape, 2)), np.zeros(shape, dtype=np.bool_)
    for tag, *fields in graph:
        if tag == "BR":
            place = int(fields[0]) - len(landmarks), int(fields[1])
            measurements[place] = float(fields[2]), float(fields[3])
            mask[place] = True
    return Trajectory(
        **about,
        start_estimate=_table(graph, "VERTEX_SE2", (2, 3, 4))[0],
        odometry=odometry,
        poses=_table(truth, "VERTEX_SE2", (2, 3, 4)),
        landmarks=landmarks,
        measurements=measurements,
        mask=mask,
    )


def _fields(path: Path) -> list[list[str]]:
    return [line.split() for line in path.read_text(encoding="utf-8").splitlines()]


def _table(lines: Iterable[list[str]], tag: str, columns: tuple[int, ...]) -> Array:
    """Return columns of all lines with a tag; column 0 is the tag."""
    rows = [[float(line[k]) for k in columns] for line in lines if line[0] == tag]
    return np.array(rows)
