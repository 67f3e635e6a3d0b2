"""Noise of the sensor and the motion: one random stream per source.

`WorldNoise` scales the noise of one world to its scenario, and `VectorNoise` that of
many. Every step of every stream has its own random numbers in a fixed layout. So the
settings of one source do not affect the noise of another, the length of a block has no
effect, and a world has the same noise alone and among others.
"""

import math
from collections.abc import Callable, Iterable
from functools import partial
from itertools import repeat
from typing import Generic, NamedTuple, TypeVar, cast

import numpy as np

from ..arrays import Array, IntArray, WordArray
from ..jit import jit
from ..restorable import Restorable
from ..sim_configs import Scenario
from ..sim_configs.scenario import Sensor
from . import streams

Row = TypeVar("Row")

_FIRST_BLOCK = 8  # steps; short, so that a reset is quick
_GROWTH = 4  # of a block over the last one
_LONGEST_BLOCK = 128  # steps

# Random effects on the sensor in one step: (error, nearest, clutter, order).
#
# A plain tuple, because a named one costs 1 % of a step. N landmarks, C rows for
# clutter. Worlds that are simulated together add axes at the dots.
#
# error : shape (2, …, N)
#     (εβ, εr) [rad, m]; εr in units of σr(r) where that grows with the range.
# nearest : shape (…, N)
#     A landmark is read above this true range [m]. It is min_range or more, so that the
#     noisy range is positive; inf where the reading drops out.
# clutter : shape (2, …, C), or None with identities
#     False readings (β, r), zeros where there is none [rad, m].
# order : shape (…, N + C), or None with identities
#     Uniform random numbers that sort the rows.
SensorNoise = tuple[Array, Array, Array | None, Array | None]


class NoiseRows(Restorable, Generic[Row]):
    """An endless iterator over rows of noise, one per step, drawn in growing blocks.

    Parameters
    ----------
    draw : callable
        Takes an array of step numbers and draws the rows of these steps.
    first : int
        The first step.

    Examples
    --------
    >>> rows = NoiseRows(lambda steps: steps / 10, first=1)
    >>> float(next(rows)), float(next(rows))
    (0.1, 0.2)
    """

    changing = ("_to_come",)
    replaced = ("_draw", "_next", "_block")

    def __init__(
        self, draw: Callable[[IntArray], Iterable[Row]], first: int = 0
    ) -> None:
        self._draw = draw
        self._next = first
        self._block = _FIRST_BLOCK
        self._to_come: list[Row] = []  # the next one last

    def __next__(self) -> Row:
        if not self._to_come:
            end = self._next + self._block
            self._to_come = list(self._draw(np.arange(self._next, end)))[::-1]
            self._next, self._block = end, min(_GROWTH * self._block, _LONGEST_BLOCK)
        return self._to_come.pop()


class SensorSettings(NamedTuple):
    """Settings of the sensors of K worlds that differ, or of one world, K = 1."""

    #: Rows (sβ, sr, σr, k, dropout, max_range, field_of_view), shape (K, 7).
    #: sβ [rad] and sr [m] scale unit noise; sr = 1 where σr(r) = σr + k r has k > 0.
    numbers: Array
    counts_below: Array  # P(at most k false readings), shape (K, C)

    @classmethod
    def of(cls, sensor: Sensor) -> "SensorSettings":
        """Return the settings of one world."""
        first, std = sensor.std
        if sensor.kind == "range":
            first, std = std, first  # its noise is that of the range
        growth = sensor.range_std_per_metre
        scales = first, 1.0 if growth else std
        noise = *scales, 0.0 if sensor.kind == "position" else std, growth
        view = sensor.dropout, sensor.max_range, sensor.field_of_view
        below = _poisson_cdf(sensor.clutter, sensor.max_clutter)
        return cls(np.array([[*noise, *view]]), below[None])


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
            streams.DROPOUT: count * (sensor.dropout > 0),
            streams.CLUTTER: (1 + 2 * rows) * (hidden and sensor.clutter > 0),
            streams.ORDER: (count + rows) * hidden,
        }
        self._widths = {stream: width for stream, width in widths.items() if width}
        self._nearest = math.nextafter(sensor.min_range, -1.0)
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
        streams.draw_normals(keys, steps, streams.MOTION, unit[None])
        noise: Array = heavy_tails(unit, self._faults.motion_dof)
        noise *= self._motion_std if std is None else std
        return noise

    def sensor(
        self, keys: WordArray, steps: IntArray, settings: SensorSettings | None = None
    ) -> SensorNoise:
        """Draw the sensor noise; see `motion`."""
        settings = settings or self._settings
        unit = np.empty((2, len(steps), self._landmarks))
        streams.draw_normals(keys, steps, streams.MEASUREMENT, unit)
        unit = heavy_tails(unit, self._faults.sensor_dof)
        drawn = {
            stream: _uniform(keys, steps, stream, width)
            for stream, width in self._widths.items()
        }
        nearest = np.empty(unit.shape[1:])
        bias = self._faults.range_bias
        _scale(unit, settings.numbers, bias, self._nearest, nearest)
        if streams.DROPOUT in drawn:
            nearest[drawn[streams.DROPOUT] < settings.numbers[:, 4:5]] = np.inf
        if streams.ORDER not in drawn:
            return unit, nearest, None, None
        clutter = self._clutter(len(steps), drawn.get(streams.CLUTTER), settings)
        return unit, nearest, clutter, drawn[streams.ORDER]

    def _clutter(
        self, count: int, drawn: Array | None, settings: SensorSettings
    ) -> Array:
        """Draw false readings, uniform over the visible bearings and ranges.

        One number per step determines their count, two more determine (β, r) of each
        reserved row. Returns (β, r), shape (2, K, C), zeros in empty rows.
        """
        sensor, rows = self._sensor, self._sensor.max_clutter
        if drawn is None:
            return np.zeros((2, count, rows))
        counts = (settings.counts_below <= drawn[..., :1]).sum(axis=-1, keepdims=True)
        max_range, field_of_view = settings.numbers[:, 5:6], settings.numbers[:, 6:]
        bearings = (drawn[..., 1::2] - 0.5) * field_of_view
        width = max_range - sensor.min_range
        ranges = max_range - drawn[..., 2::2] * width  # above min_range
        present = np.arange(rows) < counts
        return np.where(present, np.stack([bearings, ranges]), 0.0)

    def motion_rows(self, key: WordArray) -> NoiseRows[list[float]]:
        """Return the motion noise of an episode from step 1 on, as lists of floats.

        Parameters
        ----------
        key : uint64 ndarray, shape (1, 2)
            Of the episode.
        """
        return NoiseRows(partial(self._motion_by_step, key), first=1)

    def sensor_rows(self, key: WordArray) -> NoiseRows[SensorNoise]:
        """Return the sensor noise of an episode from the start, step 0, on."""
        return NoiseRows(partial(self._sensor_by_step, key))

    def _motion_by_step(self, key: WordArray, steps: IntArray) -> list[list[float]]:
        return cast("list[list[float]]", self.motion(key, steps).tolist())

    def _sensor_by_step(self, key: WordArray, steps: IntArray) -> Iterable[SensorNoise]:
        error, nearest, clutter, order = self.sensor(key, steps)
        fields = _by_step(error), nearest, _by_step(clutter), order
        rows = (repeat(None) if field is None else field for field in fields)
        return cast("Iterable[SensorNoise]", zip(*rows, strict=False))


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
        self.present = gps is not None or compass is not None
        #: (σx, σy, σθ) [m, m, rad]; 0 where there is no sensor.
        self.std = np.array([0.0 if each is None else each.std for each in sensors])
        self._every = np.array([0 if each is None else each.every for each in sensors])

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
        streams.draw_normals(keys, steps, streams.POSE, unit[None])
        readings = poses + unit * self.std
        readings[:, 2] = (readings[:, 2] + np.pi) % (2 * np.pi) - np.pi
        is_due = (self._every > 0) & (steps[:, None] % np.maximum(self._every, 1) == 0)
        return np.where(is_due, readings, np.nan)

    def by_name(self, readings: Array) -> dict[str, Array]:
        """Return readings (…, 3) as ``gps`` (…, 2) and ``compass`` (…), if present."""
        found = {"gps": readings[..., :2], "compass": readings[..., 2]}
        here = self.std[[0, 2]] > 0
        return {
            k: v for (k, v), is_here in zip(found.items(), here, strict=True) if is_here
        }


def _uniform(keys: WordArray, steps: IntArray, stream: int, width: int) -> Array:
    """Draw uniform numbers, shape (K, width)."""
    drawn = np.empty((len(steps), width))
    streams.draw_uniforms(keys, steps, stream, drawn)
    return drawn


def _by_step(pairs: Array | None) -> Array | None:
    """Move the axis of steps to the front."""
    return None if pairs is None else np.ascontiguousarray(pairs.transpose(1, 0, 2))


@jit
def _scale(
    unit: Array, settings: Array, bias: float, smallest: float, nearest: Array
) -> None:
    """Turn unit noise ε, (2, K, N), into errors; write the range r of `SensorNoise`.

    This is the range above which r + (σr + k r) ε + bias > 0, at least `smallest`.
    """
    for row in range(len(nearest)):
        first, second, std, growth = settings[min(row, len(settings) - 1), :4]
        for i in range(nearest.shape[1]):
            noise = unit[1, row, i]
            reach = -std * noise - bias
            if growth > 0.0:
                slope = 1.0 + growth * noise
                reach = reach / slope if slope > 0.0 else np.inf
            nearest[row, i] = max(reach, smallest)
            unit[0, row, i] *= first
            unit[1, row, i] *= second


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
