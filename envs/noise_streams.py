"""Noise drawn ahead: one random stream per source, handed out step by step.

Every stream is drawn in one fixed layout, step after step, so that no setting of one
source changes the noise of another, and the length of a block changes nothing.
"""

import math
from collections.abc import Callable, Sequence
from functools import partial
from itertools import repeat
from typing import Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from ..sim_configs import Scenario

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Row = TypeVar("Row")

MANY_STD = 10.0  # no normal noise exceeds so many standard deviations: odds 1e-23

_STEPS_PER_BLOCK = 128


class Streams(NamedTuple):
    """The independent generators of one episode, in the order they are spawned."""

    start: np.random.Generator
    map: np.random.Generator
    motion: np.random.Generator
    measurement: np.random.Generator
    dropout: np.random.Generator
    clutter: np.random.Generator
    order: np.random.Generator


def spawn_streams(rng: np.random.Generator) -> Streams:
    """Spawn the streams of one episode; the state of `rng` stays as it is.

    Examples
    --------
    >>> streams = spawn_streams(np.random.default_rng(0))
    >>> bool(streams.start.random() == streams.map.random())
    False
    """
    return Streams(*rng.spawn(len(Streams._fields)))


class SensorNoise(NamedTuple):
    """All that chance does to the sensor in one step, or in many.

    N landmarks, C rows reserved for clutter; the leading axes are steps or worlds.
    """

    reading: ComplexArray
    """εβ + i εr, shape (…, N) [rad, m]; εr / σr where σr grows with the range."""
    nearest: Array
    """True range above which a landmark is read, shape (…, N) [m].

    At least min_range; larger where a negative εr would leave no range above zero;
    infinite where the reading drops out.
    """
    clutter: ComplexArray | None
    """False readings β + i r, 0 where there is none, shape (…, C) [rad, m]."""
    order: Array | None
    """Uniform numbers that sort the rows, shape (…, N + C); None with identities."""


class NoiseRows(Generic[Row]):
    """Endless rows of noise, one per step, drawn in blocks.

    Parameters
    ----------
    draw : callable
        Takes a number of steps and draws the rows of as many steps to come.

    Examples
    --------
    >>> rows = NoiseRows(np.random.default_rng(0).standard_normal)
    >>> float(next(rows)) == np.random.default_rng(0).standard_normal()
    True
    """

    def __init__(self, draw: Callable[[int], Sequence[Row]]) -> None:
        self._draw = draw
        self._block: Sequence[Row] = ()
        self._next = 0

    def __next__(self) -> Row:
        if self._next == len(self._block):
            self._block = self._draw(_STEPS_PER_BLOCK)
            self._next = 0
        row = self._block[self._next]
        self._next += 1
        return row


def motion_noise_rows(streams: Streams, scenario: Scenario) -> NoiseRows[list[float]]:
    """Rows (εx, εy, εα) [m, m, rad], as the floats that a single robot needs."""
    return NoiseRows(partial(_motion_floats, streams, scenario))


def sensor_noise_rows(streams: Streams, scenario: Scenario) -> NoiseRows[SensorNoise]:
    """Rows of `SensorNoise`; the first belongs to the start, before any step."""
    return NoiseRows(partial(_sensor_noise_by_step, streams, scenario))


def draw_motion_noise(streams: Streams, scenario: Scenario, steps: int) -> Array:
    """Draw the motion noise of the steps that come next.

    Returns
    -------
    ndarray, shape (steps, 3)
        Rows (εx, εy, εα) [m, m, rad].
    """
    return streams.motion.standard_normal((steps, 3)) * scenario.motion.std


def draw_sensor_noise(streams: Streams, scenario: Scenario, steps: int) -> SensorNoise:
    """Draw the sensor's noise of the steps that come next.

    Returns
    -------
    SensorNoise
        With one leading axis, the steps.
    """
    sensor, count = scenario.sensor, scenario.landmarks.count
    bearing_std, range_std = sensor.std
    per_metre = sensor.range_std_per_metre
    unit = streams.measurement.standard_normal((steps, count, 2))
    nearest = _nearest_readable(unit[..., 1], range_std, per_metre)
    np.maximum(nearest, np.nextafter(sensor.min_range, -1.0), out=nearest)
    if sensor.dropout:
        nearest[streams.dropout.random((steps, count)) < sensor.dropout] = np.inf
    reading = (unit * (bearing_std, 1.0 if per_metre else range_std)).view(complex)
    clutter = order = None
    if not sensor.identities:
        clutter = _draw_clutter(streams, scenario, steps)
        order = streams.order.random((steps, count + sensor.max_clutter))
    return SensorNoise(reading[..., 0], nearest, clutter, order)


def _nearest_readable(unit: Array, std: float, per_metre: float) -> Array:
    """Find the true range r above which r + (σ + k r) ε is positive, ε unit noise."""
    if per_metre == 0.0:
        return -std * unit
    slope = 1.0 + per_metre * unit
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(slope > 0.0, -std * unit / slope, np.inf)


def _motion_floats(
    streams: Streams, scenario: Scenario, steps: int
) -> list[list[float]]:
    rows: list[list[float]] = draw_motion_noise(streams, scenario, steps).tolist()
    return rows


def _sensor_noise_by_step(
    streams: Streams, scenario: Scenario, steps: int
) -> list[SensorNoise]:
    block = draw_sensor_noise(streams, scenario, steps)
    columns = (repeat(None, steps) if part is None else part for part in block)
    return list(map(SensorNoise._make, zip(*columns, strict=True)))


def _draw_clutter(streams: Streams, scenario: Scenario, steps: int) -> ComplexArray:
    """Draw false readings, uniform over the bearings and ranges that the sensor sees.

    Per step one number chooses how many, then each reserved row draws (β, r).
    """
    sensor = scenario.sensor
    drawn = streams.clutter.random((steps, 1 + 2 * sensor.max_clutter))
    if sensor.clutter == 0:
        return np.zeros((steps, sensor.max_clutter), dtype=np.complex128)
    counts = np.searchsorted(_poisson_cdf(scenario), drawn[:, 0], side="right")
    width = sensor.max_range - sensor.min_range
    readings = np.empty((steps, sensor.max_clutter), dtype=np.complex128)
    readings.real = (drawn[:, 1::2] - 0.5) * sensor.field_of_view
    readings.imag = sensor.max_range - drawn[:, 2::2] * width  # above min_range
    readings[np.arange(sensor.max_clutter) >= counts[:, None]] = 0.0
    return readings


def _poisson_cdf(scenario: Scenario) -> Array:
    """P(at most k false readings) for k < max_clutter, where the law is cut off."""
    mean, largest = scenario.sensor.clutter, scenario.sensor.max_clutter
    logs = [k * math.log(mean) - mean - math.lgamma(k + 1) for k in range(largest)]
    return np.cumsum(np.exp(logs))
