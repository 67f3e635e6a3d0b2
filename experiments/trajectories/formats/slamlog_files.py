"""Shards as folders of slamlog CSVs, one per episode: the input of a filter, exact.

A log holds the start, odometry, measurements, true poses and landmarks, and the true
ids of hidden identities; reading gives the same bits. It does not hold the actions and
the collisions.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ....envs.spaces import count_rows
from ...logs.events import NO_LANDMARK, OdometryRow, Scan
from ...logs.recording import log_header
from ...logs.slamlog import SlamLog, read_slamlog, write_slamlog
from ..trajectory import Trajectory, array_of
from .episode_files import read_metadata, write_metadata


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

    Time counts steps, as in `record_episode`,
    whose log of the same seed is equal.

    Raises
    ------
    ValueError
        If the trajectory lacks measurements or landmarks.
    """
    landmarks = array_of(trajectory, "landmarks")
    measurements = array_of(trajectory, "measurements")
    mask = array_of(trajectory, "mask")
    true_ids = trajectory.landmark_ids
    events: list[OdometryRow | Scan] = []
    for step, seen in enumerate(mask):
        if step > 0:
            distance, turn = trajectory.odometry[step - 1].tolist()
            events.append(OdometryRow(float(step), distance, turn, dt=1.0))
        if seen.any():
            readings = measurements[step][seen]
            if trajectory.scenario.sensor.identities:
                scan = Scan(float(step), readings, np.flatnonzero(seen))
            else:
                of = None if true_ids is None else true_ids[step][seen]
                scan = Scan(float(step), readings, true_ids=of)
            events.append(scan)
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
    true_ids = np.full(mask.shape, NO_LANDMARK, dtype=np.int64)
    for scan in _scans(log):
        ids = scan.landmark_ids
        places = int(scan.t), np.arange(len(scan.measurements)) if ids is None else ids
        measurements[places], mask[places] = scan.measurements, True
        if scan.true_ids is not None:
            true_ids[places] = scan.true_ids
    hides = not about["scenario"].sensor.identities
    return Trajectory(
        **about,
        start_estimate=log.start,
        odometry=np.array([(move.d, move.alpha) for move in moves]),
        poses=log.ground_truth[:, 1:],
        landmarks=log.landmarks,
        measurements=measurements,
        mask=mask,
        landmark_ids=true_ids if hides and _tells_true_ids(log) else None,
    )


def _tells_true_ids(log: SlamLog) -> bool:
    return all(scan.true_ids is not None for scan in _scans(log))


def _scans(log: SlamLog) -> Iterator[Scan]:
    return (event for event in log.events if isinstance(event, Scan))
