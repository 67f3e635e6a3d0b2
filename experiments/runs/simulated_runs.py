"""Simulate many runs of one scenario as arrays, the input of a batch of filters."""

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
from gymnasium.utils import seeding

from ...arrays import Array, BoolArray
from ...envs.vector import WorldBatch
from ...estimator.support.memory_limit import refuse_beyond_memory
from ...sim_configs import Scenario, action_sequence, load_scenario


class SimulatedRuns(NamedTuple):
    """B runs of T = steps + 1 scans, the first before any motion, and L landmarks."""

    odometry: Array
    """(d, α) before each scan, shape (B, T, 2) [m, rad]; zeros before the first."""
    measurements: Array
    """Rows (β, r), shape (B, T, L, 2) [rad, m]."""
    visible: BoolArray
    """Whether a landmark is read, shape (B, T, L)."""
    true_poses: Array
    """(x, y, θ), shape (B, T, 3) [m, m, rad]."""
    landmarks: Array
    """True positions, shape (B, L, 2) [m]."""
    initial_poses: Array
    """Initial poses of the filters, shape (B, 3)."""

    @property
    def dt(self) -> Array:
        """Duration of the motion noise of each step, shape (T,)."""
        durations = np.ones(self.odometry.shape[1])
        durations[0] = 0.0
        return durations


def simulate_runs(
    scenario: Scenario | Mapping[str, object] | str | Path, runs: int, seed: int
) -> SimulatedRuns:
    """Drive the scenario's controls in ``runs`` worlds; run i has seed ``seed + i``.

    Parameters
    ----------
    scenario : Scenario, mapping, str or Path
        The world, with known identities.
    runs, seed : int
        Number of runs, and the seed of the first; run i depends on seed + i alone.

    Raises
    ------
    ValueError
        If ``runs`` is below 1, or the scenario hides identities.
    """
    world = load_scenario(scenario)
    if runs < 1:
        raise ValueError(f"runs must be >= 1, got {runs}")
    if not world.sensor.identities:
        raise ValueError(f"scenario '{world.name}' must not hide identities")
    actions, batch = action_sequence(world), WorldBatch(world, runs)
    batch.reset([seeding.np_random(seed + i)[0] for i in range(runs)])
    result = _room(batch, len(actions) + 1)
    _store(result, 0, batch)
    for step, action in enumerate(actions, start=1):
        batch.step(np.tile(action, (runs, 1)))
        _store(result, step, batch)
    return result


def _room(batch: WorldBatch, scans: int) -> SimulatedRuns:
    runs, landmarks = batch.mask.shape
    refuse_beyond_memory(
        f"a block of {runs} runs of {scans} scans of {landmarks} landmarks",
        17 * runs * scans * landmarks,  # a reading, and whether there is one
        "take fewer runs at a time (block_size), or fewer steps",
    )
    return SimulatedRuns(
        odometry=np.empty((runs, scans, 2)),
        measurements=np.empty((runs, scans, landmarks, 2)),
        visible=np.empty((runs, scans, landmarks), dtype=np.bool_),
        true_poses=np.empty((runs, scans, 3)),
        landmarks=batch.landmarks,
        initial_poses=batch.start_estimates,
    )


def _store(result: SimulatedRuns, scan: int, batch: WorldBatch) -> None:
    result.odometry[:, scan] = batch.odometry
    result.measurements[:, scan] = batch.measurements
    result.visible[:, scan] = batch.mask
    result.true_poses[:, scan] = batch.poses
