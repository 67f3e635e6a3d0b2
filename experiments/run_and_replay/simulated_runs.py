"""Simulate many runs of one scenario as arrays, the input of a batch of filters."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from gymnasium.utils import seeding

from ...arrays import AnyArray, Array, BoolArray, IntArray
from ...envs.vector import WorldBatch
from ...sim_configs import Scenario, action_sequence, load_scenario
from ...sim_configs.scenario_files import refuse_ranges

_EACH_SCAN = ("odometry", "poses", "pose_readings")
_READINGS = ("measurements", "mask", "landmark_ids")


class SimulatedRuns(NamedTuple):
    """B runs of T = steps + 1 scans, the first before any motion, and L landmarks.

    A scan has M rows: one for each landmark, or for each that `ids` names; those of a
    world that hides identities show no landmark.
    """

    #: (d, α) before each scan, shape (B, T, 2) [m, rad]; zeros before the first.
    odometry: Array
    #: Rows (β, r), shape (B, T, M, 2) [rad, m].
    measurements: Array
    #: Whether a row holds a reading, shape (B, T, M).
    visible: BoolArray
    #: (x, y, θ), shape (B, T, 3) [m, m, rad].
    true_poses: Array
    #: True positions, shape (B, L, 2) [m].
    landmarks: Array
    #: Initial poses of the filters, shape (B, 3).
    initial_poses: Array
    #: The true landmark of each row of a world that hides identities, -1 for clutter
    #: and empty rows, shape (B, T, M); the rows are then not those of the landmarks.
    true_ids: IntArray | None = None
    #: The landmark of each row, ascending, shape (M,); None if row i is landmark i.
    ids: IntArray | None = None
    #: Of (x, y, θ) by GPS and compass, nan where there is none, shape (B, T, 3).
    pose_readings: Array | None = None
    #: Their standard deviations, shape (3,) [m, m, rad].
    pose_std: Array | None = None

    @property
    def dt(self) -> Array:
        """Duration of the motion noise of each step, shape (T,)."""
        durations = np.ones(self.odometry.shape[1])
        durations[0] = 0.0
        return durations

    def pose_reading(self, step: int) -> tuple[Array, Array, Array] | None:
        """Return what a filter takes of every pose: z (B, k), H (k, 3) and R (k, k).

        None where there is no reading.
        """
        if self.pose_readings is None or self.pose_std is None:
            return None
        now = self.pose_readings[:, step]
        here = np.isfinite(now[0])  # in all runs alike
        if not here.any():
            return None
        return now[:, here], np.eye(3)[here], np.diag(self.pose_std[here] ** 2)

    @property
    def fix_std(self) -> Array:
        """Deviations of the readings of the poses, inf without, shape (B, T, 3)."""
        if self.pose_readings is None or self.pose_std is None:
            return np.full((*self.odometry.shape[:2], 3), np.inf)
        return np.where(np.isfinite(self.pose_readings), self.pose_std, np.inf)

    @property
    def landmarks_of_rows(self) -> Array:
        """True positions of the landmark of each row, shape (B, M, 2) [m]."""
        return self.landmarks if self.ids is None else self.landmarks[:, self.ids]

    def ids_of(self, rows: IntArray) -> list[int]:
        """Return the landmarks of rows."""
        names: list[int] = (rows if self.ids is None else self.ids[rows]).tolist()
        return names

    def identified(self) -> "SimulatedRuns":
        """Return the same readings by landmark, without the clutter.

        Where identities are hidden, only landmarks that some run reads have rows.
        """
        if self.true_ids is None:
            return self
        run, scan, row = np.nonzero(self.visible & (self.true_ids >= 0))
        ids, column = np.unique(self.true_ids[run, scan, row], return_inverse=True)
        shape = (*self.visible.shape[:2], len(ids))
        measurements, visible = np.zeros((*shape, 2)), np.zeros(shape, dtype=np.bool_)
        measurements[run, scan, column] = self.measurements[run, scan, row]
        visible[run, scan, column] = True
        return self._replace(
            measurements=measurements, visible=visible, true_ids=None, ids=ids
        )


def simulate_runs(
    scenario: Scenario | Mapping[str, object] | str | Path,
    runs: int,
    seed: int,
    *,
    only_read: bool = False,
) -> SimulatedRuns:
    """Drive the scenario's controls in ``runs`` worlds; run i has seed ``seed + i``.

    Parameters
    ----------
    scenario : Scenario, mapping, str or Path
        The world.
    runs, seed : int
        Number of runs, and the seed of the first; run i depends on seed + i alone.
    only_read : bool
        Whether to leave out rows without a reading in any run, such as those of the
        distant landmarks of a large world.

    Raises
    ------
    ValueError
        If ``runs`` is below 1.
    MemoryError
        If the readings do not fit into memory.
    """
    world = load_scenario(scenario)
    refuse_ranges(world)
    if runs < 1:
        raise ValueError(f"runs must be >= 1, got {runs}")
    actions, batch = action_sequence(world), WorldBatch(world, runs)
    batch.reset([seeding.np_random(seed + i)[0] for i in range(runs)])
    scans = len(actions) + 1
    record, readings = empty_record(batch, _EACH_SCAN, scans), _Readings(batch, scans)
    if not only_read:
        readings.kept[:] = True
    take(record, 0, batch)
    readings.take(batch)
    for step, action in enumerate(actions, start=1):
        batch.step(np.tile(action, (runs, 1)))
        take(record, step, batch)
        readings.take(batch)
    rows, found = readings.joined()
    named = batch.landmark_ids is None and len(rows) < batch.mask.shape[1]
    return SimulatedRuns(
        odometry=record["odometry"],
        measurements=found["measurements"],
        visible=found["mask"],
        true_poses=record["poses"],
        landmarks=batch.landmarks,
        initial_poses=batch.start_estimates,
        true_ids=found.get("landmark_ids"),
        ids=rows if named else None,
        pose_readings=record.get("pose_readings"),
        pose_std=batch.pose_sensors.std if batch.pose_sensors.present else None,
    )


class _Readings:
    """The readings of B runs, of the rows that hold one in any run.

    Parameters
    ----------
    worlds : WorldBatch
        The runs.
    scans : int
        T.
    """

    def __init__(self, worlds: WorldBatch, scans: int) -> None:
        now = {name: getattr(worlds, name) for name in _READINGS}
        self._blank = {  # an empty row
            name: (array.dtype, array.shape[2:], -1 if name == "landmark_ids" else 0)
            for name, array in now.items()
            if array is not None
        }
        self.kept = np.zeros(worlds.mask.shape[1], dtype=np.bool_)
        self._shape = len(worlds.mask), scans
        self._scans: list[tuple[IntArray, dict[str, AnyArray]]] = []

    def take(self, worlds: WorldBatch) -> None:
        """Take the present scan of the worlds."""
        rows = np.flatnonzero(worlds.mask.any(axis=0))
        self.kept[rows] = True
        scan = {name: getattr(worlds, name)[:, rows] for name in self._blank}
        self._scans.append((rows, scan))

    def joined(self) -> tuple[IntArray, dict[str, AnyArray]]:
        """Return the kept rows, and the arrays (B, T, M, …) of all scans, once."""
        kept = np.flatnonzero(self.kept)
        shape = (*self._shape, len(kept))
        arrays = {
            name: np.full((*shape, *rest), blank, dtype)
            for name, (dtype, rest, blank) in self._blank.items()
        }
        for place in reversed(range(shape[1])):
            rows, scan = self._scans.pop()
            columns = np.searchsorted(kept, rows)
            for name, array in scan.items():
                arrays[name][:, place, columns] = array
        return kept, arrays


def empty_record(
    worlds: WorldBatch, names: Sequence[str], times: int
) -> dict[str, AnyArray]:
    """Return arrays (B, times, …) that record named arrays (B, …) of B worlds.

    Arrays that the worlds do not have are left out.
    """
    return {
        name: np.empty((len(array), times, *array.shape[1:]), array.dtype)
        for name in names
        if (array := getattr(worlds, name)) is not None
    }


def take(record: Mapping[str, AnyArray], place: int, worlds: WorldBatch) -> None:
    """Record the present arrays of the worlds at an index of time."""
    for name, array in record.items():
        array[:, place] = getattr(worlds, name)
