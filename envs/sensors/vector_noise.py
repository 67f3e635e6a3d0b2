"""Noise of many worlds, each from its own generators, drawn some steps ahead.

The layout of every stream is that of a single world. So world i has the noise of a
single world with the same generator, independent of the other worlds.
"""

from collections.abc import Iterable, Sequence

import numpy as np

from ...arrays import Array, BoolArray, IndexArray
from ...sim_configs import Scenario
from .heavy_tails import heavy_tails
from .noise_streams import (
    SensorNoise,
    SensorNoiseModel,
    Streams,
    UnitDraws,
    unit_widths,
)

_BLOCK_NUMBERS = 1024  # per world and block: fits the cache, amortises the calls
_FEWEST_STEPS = 8
_PAIR = np.array([[0], [1]])
_UNIFORM = Streams._fields.index("dropout")  # this stream and the later ones


class VectorNoise:
    """Draws and delivers the noise of B worlds.

    Parameters
    ----------
    scenario : Scenario
        The scenario of every world.
    count : int
        B.
    """

    def __init__(self, scenario: Scenario, count: int) -> None:
        widths = (3, *unit_widths(scenario))
        steps = max(_FEWEST_STEPS, _BLOCK_NUMBERS // sum(widths))
        self._steps = min(steps, scenario.steps + 1)
        self._model = SensorNoiseModel(scenario)
        self._motion_dof = scenario.present_faults.motion_dof
        self._motion_std = np.tile(
            scenario.motion.std, (count, 1)
        )  # tiled: numpy runs one loop
        self._sources = [
            _Source(name, count, self._steps, width)
            for name, width in zip(Streams._fields[2:], widths, strict=True)
        ]
        self._motion, self._measurement, *self._uniform = self._sources
        self._place = np.arange(count) * self._steps  # row of each world
        self._end = self._place + self._steps
        self._at_least_left = self._steps

    def begin(self, worlds: Sequence[int], streams: Sequence[Streams]) -> None:
        """Set the streams of a new episode in these worlds, and go to its start.

        The start has sensor noise but no motion noise.
        """
        for world, generators in zip(worlds, streams, strict=True):
            for source in self._sources:
                source.begin(world, generators)
        self._place[worlds] = self._end[worlds] - self._steps
        self._at_least_left = int((self._end - self._place).min())

    def advance(self, moving: BoolArray | None) -> None:
        """Go to the next step in the worlds that move (None: all)."""
        self._place += 1 if moving is None else moving
        self._at_least_left -= 1
        if self._at_least_left == 0:
            self._draw_ahead()

    def motion(self) -> Array:
        """Return (εx, εy, εα) of this step, shape (B, 3) [m, m, rad]."""
        unit = heavy_tails(self._motion.rows(self._place), self._motion_dof)
        noise: Array = unit * self._motion_std
        return noise

    def sensor(self, worlds: IndexArray | slice | None) -> SensorNoise:
        """Return the sensor noise of this step in some worlds (None: all).

        Its arrays are valid until the next call.
        """
        place = self._place if worlds is None else self._place[worlds]
        return self._model.apply(
            UnitDraws(
                self._measurement.pairs(place),
                *(each.rows(place) if each.width else None for each in self._uniform),
            )
        )

    def _draw_ahead(self) -> None:
        worlds = np.flatnonzero(self._place == self._end)
        for source in self._sources:
            source.draw(worlds.tolist())
        self._place[worlds] -= self._steps
        self._at_least_left = int((self._end - self._place).min())


class _Source:
    """One stream of every world: K steps drawn ahead, `width` numbers per step."""

    def __init__(self, name: str, count: int, steps: int, width: int) -> None:
        self.width = width
        self._steps = steps
        self._stream = Streams._fields.index(name)
        self._first = 1 if name == "motion" else 0
        self._ahead = np.zeros((count * steps, width))  # world after world
        self._rngs: list[np.random.Generator | None] = [None] * count
        self._chosen = np.empty((count, width))

    def begin(self, world: int, streams: Streams) -> None:
        if self.width:
            self._rngs[world] = streams[self._stream]
            self._fill(world, self._first)

    def draw(self, worlds: Iterable[int]) -> None:
        if self.width:
            for world in worlds:
                self._fill(world, 0)

    def rows(self, places: IndexArray) -> Array:
        chosen = self._chosen[: len(places)]
        self._ahead.take(places, 0, chosen, "clip")
        return chosen

    def pairs(self, places: IndexArray) -> Array:
        """Return the two halves of the rows, shape (2, b, width / 2)."""
        halves = self._ahead.reshape(-1, self.width // 2)
        all_worlds = len(places) == len(self._chosen)
        out = self._chosen.reshape(2, -1, self.width // 2) if all_worlds else None
        chosen: Array = halves.take(2 * places + _PAIR, 0, out, "clip")
        return chosen

    def _fill(self, world: int, first: int) -> None:
        rng, end = self._rngs[world], (world + 1) * self._steps
        if rng is not None:  # None before the first reset
            draw = rng.random if self._stream >= _UNIFORM else rng.standard_normal
            draw(out=self._ahead[end - self._steps + first : end])
