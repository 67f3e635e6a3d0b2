"""Shards as folders of slamlog CSVs, one per episode: the input of a filter, exact.

A log holds the start, odometry, measurements, true poses and landmarks; reading gives
the same bits. It does not hold the actions, the collisions, and the true ids of hidden
identities.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ....envs.spaces import count_rows
from ....sim_configs import Scenario
from ...logs.events import OdometryRow, Scan
from ...logs.recording import log_header
from ...logs.slamlog import SlamLog, read_slamlog, write_slamlog
from ..trajectory import Trajectory, array_of
from .episode_files import read_metadata, write_metadata

ENDING = ""
LIBRARIES: tuple[str, ...] = ()


def check(scenario: Scenario) -> None:
    """Accept every scenario."""


def write(trajectories: Sequence[Trajectory], path: Path) -> None:
    """Write a shard; see `TrajectoryFormat`."""
    for name, trajectory in write_metadata(trajectories, path):
        write_slamlog(to_slamlog(trajectory), path / f"{name}.csv")


def read(path: Path) -> Iterator[Trajectory]:
    """Yield the trajectories of a shard; see `TrajectoryFormat`."""
    for name, about in read_metadata(path):
        yield _trajectory(read_slamlog(path / f"{name}.csv"), about)


def to_slamlog(trajectory: Trajectory) -> SlamLog:
    """Return the log of a trajectory, for replay.

    Time counts steps, as in :func:`~slamgym.experiments.logs.recording.record_episode`,
    whose log of the same seed is equal.

    Raises
    ------
    ValueError
        If the trajectory lacks measurements or landmarks.
    """
    landmarks = array_of(trajectory, "landmarks")
    measurements = array_of(trajectory, "measurements")
    mask = array_of(trajectory, "mask")
    known = trajectory.scenario.sensor.identities
    events: list[OdometryRow | Scan] = []
    for step, seen in enumerate(mask):
        if step > 0:
            distance, turn = trajectory.odometry[step - 1].tolist()
            events.append(OdometryRow(float(step), distance, turn, dt=1.0))
        if seen.any():
            ids = np.flatnonzero(seen) if known else None
            events.append(Scan(float(step), measurements[step][seen], ids))
    times = np.arange(len(trajectory.poses), dtype=np.float64)
    return SlamLog(
        name=trajectory.scenario.name,
        header=log_header(trajectory.scenario, trajectory.seed),
        start=trajectory.start_estimate,
        landmark_ids=np.arange(len(landmarks)),
        landmarks=landmarks,
        events=tuple(events),
        ground_truth=np.column_stack([times, trajectory.poses]),
    )


def _trajectory(log: SlamLog, about: dict[str, Any]) -> Trajectory:
    moves = [event for event in log.events if isinstance(event, OdometryRow)]
    rows = count_rows(about["scenario"])
    measurements = np.zeros((len(moves) + 1, rows, 2))
    mask = np.zeros((len(moves) + 1, rows), dtype=np.bool_)
    for event in log.events:
        if isinstance(event, Scan):
            places = event.landmark_ids
            if places is None:
                places = np.arange(len(event.measurements))
            measurements[int(event.t), places] = event.measurements
            mask[int(event.t), places] = True
    return Trajectory(
        **about,
        start_estimate=log.start,
        odometry=np.array([(move.d, move.alpha) for move in moves]),
        poses=log.ground_truth[:, 1:],
        landmarks=log.landmarks,
        measurements=measurements,
        mask=mask,
    )
