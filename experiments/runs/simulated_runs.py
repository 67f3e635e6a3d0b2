"""Simulate many runs of one scenario as arrays, the input of a batch of filters."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from gymnasium.utils import seeding

from ...arrays import AnyArray, Array, BoolArray, IntArray
from ...envs.vector import MixedWorlds, WorldBatch
from ...estimator.support.memory_limit import refuse_beyond_memory
from ...sim_configs import Scenario, action_sequence, load_scenario
from ...sim_configs.drawn_scenarios import refuse_ranges

_EACH_SCAN = ("odometry", "measurements", "mask", "poses", "landmark_ids")


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
    refuse_ranges(world)
    if runs < 1:
        raise ValueError(f"runs must be >= 1, got {runs}")
    actions, batch = action_sequence(world), WorldBatch(world, runs)
    batch.reset([seeding.np_random(seed + i)[0] for i in range(runs)])
    scans, rows = len(actions) + 1, batch.mask.shape[1]
    refuse_beyond_memory(
        f"a block of {runs} runs of {scans} scans of {rows} landmarks",
        # a reading, whether there is one, and where it is hidden, of what
        (17 if batch.landmark_ids is None else 25) * runs * scans * rows,
        "take fewer runs at a time (block_size), or fewer steps",
    )
    record = empty_record(batch, _EACH_SCAN, scans)
    take(record, 0, batch)
    for step, action in enumerate(actions, start=1):
        batch.step(np.tile(action, (runs, 1)))
        take(record, step, batch)
    return SimulatedRuns(
        odometry=record["odometry"],
        measurements=record["measurements"],
        visible=record["mask"],
        true_poses=record["poses"],
        landmarks=batch.landmarks,
        initial_poses=batch.start_estimates,
        true_ids=record.get("landmark_ids"),
    )


def empty_record(
    worlds: WorldBatch | MixedWorlds, names: Sequence[str], times: int
) -> dict[str, AnyArray]:
    """Return arrays (B, times, …) to record arrays (B, …) of B worlds by their names.

    Arrays that the worlds do not have are left out.
    """
    now = {name: getattr(worlds, name) for name in names}
    return {
        name: np.empty((len(array), times, *array.shape[1:]), array.dtype)
        for name, array in now.items()
        if array is not None
    }


def take(
    record: Mapping[str, AnyArray], place: int, worlds: WorldBatch | MixedWorlds
) -> None:
    """Record the present arrays of the worlds at an index of time."""
    for name, array in record.items():
        array[:, place] = getattr(worlds, name)
