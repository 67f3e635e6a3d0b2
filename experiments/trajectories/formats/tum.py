"""Shards as folders of TUM files: the true path and the path by odometry alone.

The lines are ``t x y z qx qy qz qw`` with t in seconds and z = 0, as evo reads them.
There are two files per episode, ``NAME_truth.tum`` and ``NAME_odometry.tum``; the
latter integrates odometry from the initial pose of filters.

The files hold the paths alone: no readings, landmarks, actions or collisions. Positions
are exact; headings read back in [-π, π] within 1e-15, and odometry within 1e-15 times
the size of the coordinates.
"""

import math
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from ....arrays import Array
from ....estimator.models.bearing_range import wrap_angle
from ..trajectory import Trajectory
from .dead_reckoning import dead_reckoning
from .episode_files import numbers, read_metadata, write_lines, write_metadata


def write(trajectories: Sequence[Trajectory], path: Path) -> None:
    """Write a shard; see `TrajectoryFormat`."""
    for name, each in write_metadata(trajectories, path):
        dt = each.scenario.dt
        write_lines(path / f"{name}_truth.tum", _lines(each.poses, dt))
        path_by_odometry = dead_reckoning(each.start_estimate, each.odometry)
        write_lines(path / f"{name}_odometry.tum", _lines(path_by_odometry, dt))


def read(path: Path) -> Iterator[Trajectory]:
    """Yield the trajectories of a shard; see `TrajectoryFormat`."""
    for name, about in read_metadata(path):
        reckoned = _poses(path / f"{name}_odometry.tum")
        yield Trajectory(
            **about,
            start_estimate=reckoned[0],
            odometry=_increments(reckoned),
            poses=_poses(path / f"{name}_truth.tum"),
        )


def _lines(poses: Array, dt: float) -> list[str]:
    return [
        numbers((step * dt, x, y, 0, 0, 0, math.sin(half), math.cos(half)))
        for step, (x, y, half) in enumerate((poses * (1.0, 1.0, 0.5)).tolist())
    ]


def _poses(path: Path) -> Array:
    table: Array = np.loadtxt(path, ndmin=2)
    half = np.arctan2(table[:, 6], table[:, 7])
    heading = [wrap_angle(2.0 * angle) for angle in half.tolist()]
    return np.column_stack([table[:, 1:3], heading])


def _increments(poses: Array) -> Array:
    """Return the odometry of a dead-reckoned path: distances and turns."""
    dx, dy = np.diff(poses[:, :2], axis=0).T
    heading = poses[:-1, 2]
    turns = [wrap_angle(turn) for turn in np.diff(poses[:, 2]).tolist()]
    return np.column_stack([dx * np.cos(heading) + dy * np.sin(heading), turns])
