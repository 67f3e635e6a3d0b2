"""Noise of the sensor and the motion: one random stream per source.

`WorldNoise` draws the noise of one world or of many worlds of a scenario. Every step of
every stream has its own random numbers in a fixed layout. So the settings of one source
do not affect the noise of another, the length of a block has no effect, and a world has
the same noise alone and among others.
"""

import math
from collections.abc import Callable
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np

from ..arrays import Array, IntArray, WordArray
from ..restorable import Restorable
from ..sim_configs import Scenario
from ..sim_configs.scenario import SensorTable
from ..suggestions import imported
from . import random_numbers

Row = TypeVar("Row")

_FIRST_BLOCK = 8  # steps; short, so that a reset is quick
_GROWTH = 4  # of a block over the last one
_LONGEST_BLOCK = 128  # steps

# Random effects on the sensor in one step of K worlds: (unit, lots, clutter, order).
#
# It is a plain tuple, because a named one costs 1 % of a step. There are N landmarks,
# and C rows for clutter.
#
# unit : shape (K, 2N)
#     Noise of the bearings, then of the ranges, in standard deviations.
# lots : shape (K, N), or (K, 0) without dropout
#     Uniform random numbers. A reading drops out if its number is below the probability
#     of dropout.
# clutter : shape (K, C, 2), or None with identities
#     False readings (β, r), zeros where there is none [rad, m].
# order : shape (K, N + C), or None with identities
#     Uniform random numbers that sort the rows.
SensorNoise = tuple[Array, Array, Array | None, Array | None]


class NoiseRows(Restorable, Generic[Row]):
    """An endless iterator over rows of noise, one per step, drawn in growing blocks.

    Parameters
    ----------
    draw : callable
        Takes the key of an episode and an array of step numbers, and draws the noise of
        these steps.
    row : callable
        Takes the noise of several steps and an index k, and returns the row of step k.

    Examples
    --------
    >>> rows = NoiseRows(lambda key, steps: key + steps / 10, lambda noise, k: noise[k])
    >>> rows.begin(3.0, first=1)
    >>> float(next(rows)), float(next(rows))
    (3.1, 3.2)
    """

    changing = ()
    replaced = ("_draw", "_key", "_drawn", "_first", "_step", "_end")

    def __init__(
        self, draw: Callable[[Any, IntArray], Any], row: Callable[[Any, int], Row]
    ) -> None:
        self._draw, self._row = draw, row

    def begin(self, key: Any, first: int) -> None:
        """Start the rows of an episode; the next one is that of the step `first`."""
        self._key, self._drawn = key, None
        self._first = self._step = self._end = first

    def __next__(self) -> Row:
        step = self._step
        if step == self._end:  # the block is used up
            size = min(_GROWTH * (step - self._first), _LONGEST_BLOCK) or _FIRST_BLOCK
            self._drawn = self._draw(self._key, np.arange(step, step + size))
            self._first, self._end = step, step + size
        self._step = step + 1
        return self._row(self._drawn, step - self._first)


def row_of(noise: SensorNoise, k: int) -> SensorNoise:
    """Return the noise of step k from the noise of many steps of a world."""
    unit, lots, clutter, order = noise
    unit, lots = unit[k : k + 1], lots[k : k + 1]
    if clutter is None or order is None:
        return unit, lots, None, None
    return unit, lots, clutter[k], order[k]


class SensorSettings(NamedTuple):
    """Settings of the sensors of K worlds that differ, or of one world, K = 1."""

    #: Rows (sβ, sr, σr, k, dropout, max_range, field_of_view), shape (K, 7).
    #: sβ [rad] and sr [m] scale unit noise; sr = 1 where σr(r) = σr + k r has k > 0;
    #: σr = 0 where no number is a range.
    numbers: Array
    counts_below: Array  # P(at most k false readings), shape (K, C)

    @classmethod
    def of(cls, sensor: SensorTable) -> "SensorSettings":
        """Return the settings of one world."""
        first, std = sensor.std
        if sensor.kind == "range":
            first, std = std, first  # its noise is that of the range
        growth = sensor.range_std_per_metre
        scales = first, 1.0 if growth else std
        has_range = ":" not in sensor.kind and sensor.kind != "position"
        noise = *scales, std if has_range else 0.0, growth
        view = sensor.dropout, sensor.max_range, field_of_view(sensor)
        below = _poisson_cdf(sensor.clutter, sensor.max_clutter)
        return cls(np.array([[*noise, *view]]), below[None])


def field_of_view(sensor: SensorTable) -> float:
    """Return the angle of view: the world's, or that of a user's sensor if smaller."""
    own = 2 * math.pi
    if ":" in sensor.kind:
        own = float(part_of_sensor(sensor.kind, "field_of_view"))
    return min(sensor.field_of_view, own)


def part_of_sensor(kind: str, part: str) -> Any:
    """Return a part of a sensor that the user has written, "module:SENSOR".

    Raises
    ------
    ValueError
        If it cannot be imported.
    """
    return imported(f"{kind}.{part}", f"cannot import sensor.kind = '{kind}': ")


class WorldNoise:
    """Draws the noise of the worlds of a scenario.

    Row k of what it draws is the noise of the step ``steps[k]`` of the episode with the
    key ``keys[k]``, or of the only key: of K steps of one world, or of one step of K
    worlds.

    Parameters
    ----------
    scenario : Scenario
        Source of the noise's settings and the number of landmarks.
    """

    def __init__(self, scenario: Scenario) -> None:
        self._sensor = sensor = scenario.sensor
        self._faults = scenario.present_faults
        self._landmarks = count = scenario.landmarks.count
        hidden, rows = not sensor.identities, sensor.max_clutter
        widths = {  # of uniform numbers per step; one and two for each false row
            random_numbers.DROPOUT: count * (sensor.dropout > 0),
            random_numbers.CLUTTER: (1 + 2 * rows) * (hidden and sensor.clutter > 0),
            random_numbers.ORDER: (count + rows) * hidden,
        }
        self._widths = {stream: width for stream, width in widths.items() if width}
        self._settings = SensorSettings.of(sensor)
        self._motion_std = np.array(scenario.motion.std)

    def motion(
        self, keys: WordArray, steps: IntArray, std: Array | None = None
    ) -> Array:
        """Draw the motion noise (εx, εy, εα), shape (K, 3) [m, m, rad].

        Parameters
        ----------
        keys : uint64 ndarray, shape (K or 1, 2)
        steps : int64 ndarray, shape (K,)
        std : ndarray, shape (K, 3), optional
            Of each world, where worlds differ.
        """
        unit = np.empty((len(steps), 3))
        random_numbers.draw_normals(keys, steps, random_numbers.MOTION, unit)
        noise: Array = heavy_tails(unit, self._faults.motion_dof)
        noise *= self._motion_std if std is None else std
        return noise

    def sensor(
        self, keys: WordArray, steps: IntArray, settings: SensorSettings | None = None
    ) -> SensorNoise:
        """Draw the sensor noise; see `motion`."""
        settings = settings or self._settings
        unit = np.empty((len(steps), 2 * self._landmarks))
        random_numbers.draw_normals(keys, steps, random_numbers.MEASUREMENT, unit)
        unit = heavy_tails(unit, self._faults.sensor_dof)
        drawn = {
            stream: _uniform(keys, steps, stream, width)
            for stream, width in self._widths.items()
        }
        lots = drawn.get(random_numbers.DROPOUT, unit[:, :0])
        if random_numbers.ORDER not in drawn:
            return unit, lots, None, None
        clutter = self._clutter(len(steps), drawn.get(random_numbers.CLUTTER), settings)
        return unit, lots, clutter, drawn[random_numbers.ORDER]

    def _clutter(
        self, count: int, drawn: Array | None, settings: SensorSettings
    ) -> Array:
        """Draw false readings, uniform over the visible bearings and ranges.

        One number per step determines their count, two more determine (β, r) of each
        reserved row. Returns (β, r), shape (K, C, 2), zeros in empty rows.
        """
        sensor, rows = self._sensor, self._sensor.max_clutter
        if drawn is None:
            return np.zeros((count, rows, 2))
        counts = (settings.counts_below <= drawn[..., :1]).sum(axis=-1, keepdims=True)
        max_range, field_of_view = settings.numbers[:, 5:6], settings.numbers[:, 6:]
        bearings = (drawn[..., 1::2] - 0.5) * field_of_view
        width = max_range - sensor.min_range
        ranges = max_range - drawn[..., 2::2] * width  # above min_range
        present = np.arange(rows) < counts
        readings = np.stack([bearings, ranges], axis=-1)
        return np.where(present[..., None], readings, 0.0)


class PoseSensors:
    """The compass and the GPS of a scenario.

    Parameters
    ----------
    scenario : Scenario
        Source of their noise and their rates.
    """

    def __init__(self, scenario: Scenario) -> None:
        gps, compass = scenario.gps, scenario.compass
        sensors = gps, gps, compass
        #: (σx, σy, σθ) [m, m, rad]; 0 where there is no sensor.
        self.std = np.array([0.0 if each is None else each.std for each in sensors])
        self._every = np.array([0 if each is None else each.every for each in sensors])
        self.present = bool(self._every.any())

    def read(self, keys: WordArray, steps: IntArray, poses: Array) -> Array:
        """Return readings (x, y, θ), shape (K, 3), nan where there is none.

        Parameters
        ----------
        keys : uint64 ndarray, shape (K, 2)
            Of the episodes.
        steps : int64 ndarray, shape (K,)
        poses : ndarray, shape (K, 3)
            True poses [m, m, rad].
        """
        unit = np.empty((len(steps), 3))
        random_numbers.draw_normals(keys, steps, random_numbers.POSE, unit)
        readings = poses + unit * self.std
        readings[:, 2] = (readings[:, 2] + np.pi) % (2 * np.pi) - np.pi
        is_due = (self._every > 0) & (steps[:, None] % np.maximum(self._every, 1) == 0)
        return np.where(is_due, readings, np.nan)

    def by_name(self, readings: Array) -> dict[str, Array]:
        """Return readings (…, 3) as ``gps`` (…, 2) and ``compass`` (…), if present.

        ``gps_mask`` and ``compass_mask`` (…) are true where there is a reading; where
        there is none, it is 0.
        """
        is_read = np.isfinite(readings)
        values = np.where(is_read, readings, 0.0)
        found: dict[str, Array] = {}
        if self.std[0] > 0:
            found |= {"gps": values[..., :2], "gps_mask": is_read[..., 0]}
        if self.std[2] > 0:
            found |= {"compass": values[..., 2], "compass_mask": is_read[..., 2]}
        return found


def _uniform(keys: WordArray, steps: IntArray, stream: int, width: int) -> Array:
    """Draw uniform numbers, shape (K, width)."""
    drawn = np.empty((len(steps), width))
    random_numbers.draw_uniforms(keys, steps, stream, drawn)
    return drawn


def _poisson_cdf(mean: float, largest: int) -> Array:
    """Return P(at most k false readings) for k < largest, the truncation."""
    if mean == 0.0:
        return np.full(largest, np.inf)  # none
    logs = [k * math.log(mean) - mean - math.lgamma(k + 1) for k in range(largest)]
    return np.cumsum(np.exp(logs))


# --------------------------------------------------------------------------------------
# Heavy tails: normal noise turned into Student's t, number by number.
#
# The transformation keeps the rank of every number, so a world with heavy tails uses
# the random numbers of the same world without them.

#: Bound of normal noise in standard deviations; the probability beyond is 1e-23.
MANY_STD = 10.0


def heavy_tails(unit: Array, degrees: float) -> Array:
    """Turn standard normal numbers into numbers of Student's t distribution.

    ::

        t = F⁻¹(Φ(u)),   F the distribution function of Student's t

    The core keeps the scale of u, so the variance is degrees / (degrees - 2).

    Parameters
    ----------
    unit : ndarray
        u, standard normal.
    degrees : float
        Degrees of freedom, > 2; inf returns `unit` unchanged.

    Examples
    --------
    >>> heavy_tails(np.array([-1.0, 0.0, 3.0]), 4.0).round(3)
    array([-1.142,  0.   ,  6.62 ])
    >>> heavy_tails(np.array([3.0]), np.inf)
    array([3.])
    """
    if math.isinf(degrees):
        return unit
    from scipy.special import ndtr, stdtrit  # noqa: PLC0415 (slow to import)

    tail: Array = stdtrit(degrees, ndtr(-np.abs(unit)))  # exact far out, unlike 1 - p
    return np.copysign(tail, unit)


def largest_noise(degrees: float) -> float:
    """Return the bound of such noise, in the units of `unit`.

    Examples
    --------
    >>> largest_noise(np.inf)
    10.0
    """
    return float(heavy_tails(np.array(MANY_STD), degrees))
