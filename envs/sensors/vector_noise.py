"""Noise of many worlds, each with the numbers of a single world with its key."""

import numpy as np

from ...arrays import Array, BoolArray, IndexArray, WordArray
from ...sim_configs import Scenario
from .noise_streams import SensorNoise, SensorScales, WorldNoise


class VectorNoise:
    """Draws the noise of B worlds, step by step.

    Parameters
    ----------
    scenario : Scenario
        The scenario of every world.
    count : int
        B.
    """

    def __init__(self, scenario: Scenario, count: int) -> None:
        self._noise = WorldNoise(scenario)
        self._keys = np.zeros((count, 2), dtype=np.uint64)
        self._steps = np.zeros(count, dtype=np.int64)

    def begin(self, worlds: IndexArray, keys: WordArray) -> None:
        """Begin the episodes with these keys, (b, 2), in some worlds, (b,).

        The start, step 0, has sensor noise but no motion noise.
        """
        self._keys[worlds] = keys
        self._steps[worlds] = 0

    def advance(self, moving: BoolArray | None) -> None:
        """Go to the next step in the worlds that move (None: all)."""
        self._steps += 1 if moving is None else moving

    def motion(self, std: Array | None = None) -> Array:
        """Return (εx, εy, εα) of this step, shape (B, 3) [m, m, rad].

        `std`, (B, 3), holds where worlds differ.
        """
        return self._noise.motion(self._keys, self._steps, std)

    def sensor(
        self, worlds: IndexArray | slice | None, scales: SensorScales | None = None
    ) -> SensorNoise:
        """Return the sensor noise of this step in some worlds (None: all)."""
        keys, steps = self._keys, self._steps
        if worlds is not None:
            keys, steps = keys[worlds], steps[worlds]
        return self._noise.sensor(keys, steps, scales)
