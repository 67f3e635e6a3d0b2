"""Noise drawn ahead: one random stream per source, handed out step by step.

Every stream is drawn in one fixed layout, step after step, so that no setting of one
source changes the noise of another, and the length of a block changes nothing.
"""

import math
from collections.abc import Callable, Iterable
from functools import partial
from itertools import repeat
from typing import Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from ..sim_configs import Scenario

Array = NDArray[np.float64]
Row = TypeVar("Row")

MANY_STD = 10.0
"""No normal noise exceeds so many standard deviations: the odds are 1e-23."""

_FIRST_BLOCK = 16  # steps; short, so that a reset is quick
_LONGEST_BLOCK = 128  # steps; later blocks grow to this

SensorNoise = tuple[Array, Array, Array | None, Array | None]
"""What chance does to the sensor in one step: (error, nearest, clutter, order).

A plain tuple, since a named one would cost 1 % of a step. N landmarks, C rows for
clutter; worlds simulated side by side add axes where the dots are.

error : shape (2, …, N)
    (εβ, εr) [rad, m]; εr in units of σr(r) where that grows with the range.
nearest : shape (…, N)
    A landmark is read above this true range [m]: at least min_range; more where a
    negative εr would leave no range above zero; inf where the reading drops out.
clutter : shape (2, …, C), or None with identities
    False readings (β, r), zeros where there is none [rad, m].
order : shape (…, N + C), or None with identities
    Uniform numbers that sort the rows.
"""


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


class NoiseRows(Generic[Row]):
    """Endless rows of noise, one per step, drawn in blocks that grow.

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

    def __init__(self, draw: Callable[[int], Iterable[Row]]) -> None:
        self._draw = draw
        self._block = _FIRST_BLOCK
        self._to_come: list[Row] = []  # the next one last

    def __next__(self) -> Row:
        if not self._to_come:
            self._to_come = list(self._draw(self._block))[::-1]
            self._block = min(2 * self._block, _LONGEST_BLOCK)
        return self._to_come.pop()


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
        Its four arrays, with the steps as their first axis.
    """
    sensor, count = scenario.sensor, scenario.landmarks.count
    bearing_std, range_std = sensor.std
    per_metre = sensor.range_std_per_metre
    unit = streams.measurement.standard_normal((steps, 2, count))
    scale = np.array([[bearing_std], [1.0 if per_metre else range_std]])
    nearest = _nearest_readable(unit[:, 1], range_std, per_metre)
    np.maximum(nearest, np.nextafter(sensor.min_range, -1.0), out=nearest)
    if sensor.dropout:
        nearest[streams.dropout.random((steps, count)) < sensor.dropout] = np.inf
    if sensor.identities:
        return unit * scale, nearest, None, None
    order = streams.order.random((steps, count + sensor.max_clutter))
    return unit * scale, nearest, _draw_clutter(streams, scenario, steps), order


def _motion_floats(
    streams: Streams, scenario: Scenario, steps: int
) -> list[list[float]]:
    rows: list[list[float]] = draw_motion_noise(streams, scenario, steps).tolist()
    return rows


def _sensor_noise_by_step(
    streams: Streams, scenario: Scenario, steps: int
) -> Iterable[SensorNoise]:
    error, nearest, clutter, order = draw_sensor_noise(streams, scenario, steps)
    return zip(
        error,
        nearest,
        repeat(None) if clutter is None else clutter,
        repeat(None) if order is None else order,
        strict=False,  # repeat has no end
    )


def _nearest_readable(unit: Array, std: float, per_metre: float) -> Array:
    """Find the range r above which r + (σ + k r) ε is positive, with unit noise ε."""
    if per_metre == 0.0:
        return -std * unit
    slope = 1.0 + per_metre * unit
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(slope > 0.0, -std * unit / slope, np.inf)


def _draw_clutter(streams: Streams, scenario: Scenario, steps: int) -> Array:
    """Draw false readings, uniform over the bearings and ranges that the sensor sees.

    Per step one number chooses how many, then each reserved row draws (β, r).
    Returns (β, r), shape (steps, 2, C), zeros where there is none.
    """
    sensor, rows = scenario.sensor, scenario.sensor.max_clutter
    if sensor.clutter == 0:
        return np.zeros((steps, 2, rows))
    drawn = streams.clutter.random((steps, 1 + 2 * rows))
    counts = np.searchsorted(_poisson_cdf(scenario), drawn[:, 0], side="right")
    width = sensor.max_range - sensor.min_range
    bearings = (drawn[:, 1::2] - 0.5) * sensor.field_of_view
    ranges = sensor.max_range - drawn[:, 2::2] * width  # never min_range, maybe 0
    present = np.arange(rows) < counts[:, None]
    return np.where(present[:, None], np.stack([bearings, ranges], axis=1), 0.0)


def _poisson_cdf(scenario: Scenario) -> Array:
    """P(at most k false readings) for k < max_clutter, where the law is cut off."""
    mean, largest = scenario.sensor.clutter, scenario.sensor.max_clutter
    logs = [k * math.log(mean) - mean - math.lgamma(k + 1) for k in range(largest)]
    return np.cumsum(np.exp(logs))
