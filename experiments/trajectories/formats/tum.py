"""Shards as folders of TUM files: the true path and the path by odometry alone.

Lines ``t x y z qx qy qz qw``, t in seconds, z = 0, which evo and its kin read. Two
files per episode, ``NAME_truth.tum`` and ``NAME_odometry.tum``; the latter adds the
odometry up from the pose that a filter starts from.

They hold the paths alone: no readings, landmarks, actions or collisions. Positions are
exact; headings read back in [-π, π] within 1e-15, and odometry within 1e-15 times the
size of the coordinates.
"""

import math
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ....estimator.models.angles import wrap_angle
from ....sim_configs import Scenario
from ..trajectory import Array, Trajectory
from .dead_reckoning import dead_reckoning
from .episode_files import numbers, read_notes, write_lines, write_notes

ENDING = ""
LIBRARIES: tuple[str, ...] = ()


def check(scenario: Scenario) -> None:
    """Accept every scenario."""


def write(trajectories: Sequence[Trajectory], path: Path) -> None:
    """Write a shard; see `trajectory_formats`."""
    path.mkdir()
    names = write_notes(trajectories, path)
    for name, each in zip(names, trajectories, strict=True):
        dt = each.scenario.dt
        write_lines(path / f"{name}_truth.tum", _lines(each.poses, dt))
        path_by_odometry = dead_reckoning(each.start_estimate, each.odometry)
        write_lines(path / f"{name}_odometry.tum", _lines(path_by_odometry, dt))


def read(path: Path) -> Iterator[Trajectory]:
    """Yield the trajectories of a shard; see `trajectory_formats`."""
    for notes in read_notes(path):
        reckoned = _poses(path / f"{notes.name}_odometry.tum")
        yield Trajectory(
            scenario=notes.scenario,
            controller=notes.controller,
            seed=notes.seed,
            start_estimate=reckoned[0],
            odometry=_increments(reckoned),
            poses=_poses(path / f"{notes.name}_truth.tum"),
        )


def _lines(poses: Array, dt: float) -> list[str]:
    return [
        numbers((step * dt, x, y, 0, 0, 0, math.sin(half), math.cos(half)))
        for step, (x, y, half) in enumerate((poses * (1.0, 1.0, 0.5)).tolist())
    ]


def _poses(path: Path) -> Array:
    table: NDArray[np.float64] = np.loadtxt(path, ndmin=2)
    half = np.arctan2(table[:, 6], table[:, 7])
    heading = [wrap_angle(2.0 * angle) for angle in half.tolist()]
    return np.column_stack([table[:, 1:3], heading])


def _increments(poses: Array) -> Array:
    """Undo dead reckoning: the distances along the old headings, and the turns."""
    dx, dy = np.diff(poses[:, :2], axis=0).T
    heading = poses[:-1, 2]
    turns = [wrap_angle(turn) for turn in np.diff(poses[:, 2]).tolist()]
    return np.column_stack([dx * np.cos(heading) + dy * np.sin(heading), turns])
