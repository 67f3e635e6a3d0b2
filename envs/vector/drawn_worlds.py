"""The settings of worlds that draw their own from ranges, as arrays."""

from collections.abc import Sequence

import numpy as np

from ...arrays import Array, ComplexArray, IndexArray, WordArray
from ...sim_configs import Scenario
from ..sensors.bearing_range import Reach
from ..sensors.noise_streams import SensorScales
from ..streams.episodes import EpisodeStarts, drawn_scenarios

Rows = IndexArray | slice | None


class DrawnWorlds:
    """The scenarios that B worlds drew for their episodes.

    Parameters
    ----------
    scenario : Scenario
        With ranges.
    count : int
        B.

    Attributes
    ----------
    scenarios : list of Scenario, length B
        The present draws.
    """

    def __init__(self, scenario: Scenario, count: int) -> None:
        self._family = scenario
        self.scenarios = [scenario] * count
        self._motion_std = np.zeros((count, 3))
        self._reach = Reach(*(np.zeros((count, 1)) for _ in Reach._fields))
        clutter = np.zeros((count, scenario.sensor.max_clutter))
        numbers = {name: np.zeros((count, 1)) for name in SensorScales._fields}
        arrays = {"scale": np.zeros((2, count, 1)), "counts_below": clutter}
        self._scales = SensorScales(**{**numbers, **arrays})

    def begin(
        self, worlds: IndexArray, keys: WordArray
    ) -> tuple[ComplexArray, Array, Array]:
        """Draw the scenarios of the episodes with these keys, (b, 2), in some worlds.

        Returns
        -------
        landmarks, poses, estimates : ndarray, shapes (b, N), (b, 3), (b, 3)
            See `EpisodeStarts`.
        """
        drawn = drawn_scenarios(self._family, keys)
        for world, scenario in zip(worlds.tolist(), drawn, strict=True):
            self.scenarios[world] = scenario
            self._motion_std[world] = scenario.motion.std
            _set_rows(self._reach, Reach.of(scenario.sensor), world)
            scales = SensorScales.of(scenario.sensor)
            self._scales.scale[:, world, 0] = scales.scale[:, 0, 0]
            below = scales.counts_below if scenario.sensor.clutter else np.inf
            self._scales.counts_below[world] = below
            _set_rows(self._scales[1:4], scales[1:4], world)
            _set_rows(self._scales[5:], scales[5:], world)
        return _starts(drawn, keys)

    def motion_std(self) -> Array:
        """Return (σx, σy, σα) of every world, (B, 3) [m, m, rad]."""
        return self._motion_std

    def sensor_scales(self, worlds: Rows) -> SensorScales:
        """Return the scales of the noise of some worlds (None: all)."""
        if worlds is None:
            return self._scales
        scale, *others = map(np.asarray, self._scales)
        return SensorScales(scale[:, worlds], *(array[worlds] for array in others))

    def reach(self, worlds: Rows) -> Reach:
        """Return the reach of the sensors of some worlds (None: all)."""
        if worlds is None:
            return self._reach
        return Reach(*(np.asarray(array)[worlds] for array in self._reach))


def _set_rows(arrays: Sequence[object], values: Sequence[object], world: int) -> None:
    """Write the values of a world; no limit is an infinite one."""
    for array, value in zip(arrays, values, strict=True):
        assert isinstance(array, np.ndarray)
        array[world] = np.inf if value is None else value


def _starts(
    scenarios: list[Scenario], keys: WordArray
) -> tuple[ComplexArray, Array, Array]:
    landmarks, poses, estimates = [], [], []
    for row, scenario in enumerate(scenarios):
        starts, key = EpisodeStarts(scenario), keys[row : row + 1]
        landmarks.append(starts.landmarks(key)[0])
        pose, estimate = starts.poses(key)
        poses.append(pose[0])
        estimates.append(estimate[0])
    return np.array(landmarks), np.array(poses), np.array(estimates)
