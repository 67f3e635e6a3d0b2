"""Simulate many runs of one scenario as arrays, the input of a batch of filters."""

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
from gymnasium.utils import seeding

from ...arrays import Array, BoolArray, IntArray
from ...envs.vector import WorldBatch
from ...estimator.support.memory_limit import refuse_beyond_memory
from ...sim_configs import Scenario, action_sequence, load_scenario


class SimulatedRuns(NamedTuple):
    """B runs of T = steps + 1 scans, the first before any motion, and L landmarks.

    A scan has M rows: one for each landmark, or more where identities are hidden.
    """

    odometry: Array
    """(d, α) before each scan, shape (B, T, 2) [m, rad]; zeros before the first."""
    measurements: Array
    """Rows (β, r), shape (B, T, M, 2) [rad, m]."""
    visible: BoolArray
    """Whether a row holds a reading, shape (B, T, M)."""
    true_poses: Array
    """(x, y, θ), shape (B, T, 3) [m, m, rad]."""
    landmarks: Array
    """True positions, shape (B, L, 2) [m]."""
    initial_poses: Array
    """Initial poses of the filters, shape (B, 3)."""
    true_ids: IntArray | None = None
    """The true landmark of each row of a world that hides identities, -1 for clutter
    and empty rows, shape (B, T, M); the rows are then not those of the landmarks."""

    @property
    def dt(self) -> Array:
        """Duration of the motion noise of each step, shape (T,)."""
        durations = np.ones(self.odometry.shape[1])
        durations[0] = 0.0
        return durations

    def identified(self) -> "SimulatedRuns":
        """Return the same readings by landmark, without the clutter."""
        if self.true_ids is None:
            return self
        run, scan, row = np.nonzero(self.visible & (self.true_ids >= 0))
        landmark = self.true_ids[run, scan, row]
        shape = (*self.visible.shape[:2], self.landmarks.shape[1])
        measurements, visible = np.zeros((*shape, 2)), np.zeros(shape, dtype=np.bool_)
        measurements[run, scan, landmark] = self.measurements[run, scan, row]
        visible[run, scan, landmark] = True
        return self._replace(measurements=measurements, visible=visible, true_ids=None)


def simulate_runs(
    scenario: Scenario | Mapping[str, object] | str | Path, runs: int, seed: int
) -> SimulatedRuns:
    """Drive the scenario's controls in ``runs`` worlds; run i has seed ``seed + i``.

    Parameters
    ----------
    scenario : Scenario, mapping, str or Path
        The world.
    runs, seed : int
        Number of runs, and the seed of the first; run i depends on seed + i alone.

    Raises
    ------
    ValueError
        If ``runs`` is below 1.
    """
    world = load_scenario(scenario)
    if runs < 1:
        raise ValueError(f"runs must be >= 1, got {runs}")
    actions, batch = action_sequence(world), WorldBatch(world, runs)
    batch.reset([seeding.np_random(seed + i)[0] for i in range(runs)])
    result = _room(batch, len(actions) + 1)
    _store(result, 0, batch)
    for step, action in enumerate(actions, start=1):
        batch.step(np.tile(action, (runs, 1)))
        _store(result, step, batch)
    return result


def _room(batch: WorldBatch, scans: int) -> SimulatedRuns:
    runs, rows = batch.mask.shape
    is_hidden = batch.landmark_ids is not None
    refuse_beyond_memory(
        f"a block of {runs} runs of {scans} scans of {rows} landmarks",
        # a reading, whether there is one, and where it is hidden, of what
        (25 if is_hidden else 17) * runs * scans * rows,
        "take fewer runs at a time (block_size), or fewer steps",
    )
    return SimulatedRuns(
        odometry=np.empty((runs, scans, 2)),
        measurements=np.empty((runs, scans, rows, 2)),
        visible=np.empty((runs, scans, rows), dtype=np.bool_),
        true_poses=np.empty((runs, scans, 3)),
        landmarks=batch.landmarks,
        initial_poses=batch.start_estimates,
        true_ids=np.empty((runs, scans, rows), dtype=np.int64) if is_hidden else None,
    )


def _store(result: SimulatedRuns, scan: int, batch: WorldBatch) -> None:
    result.odometry[:, scan] = batch.odometry
    result.measurements[:, scan] = batch.measurements
    result.visible[:, scan] = batch.mask
    result.true_poses[:, scan] = batch.poses
    if result.true_ids is not None and batch.landmark_ids is not None:
        result.true_ids[:, scan] = batch.landmark_ids
