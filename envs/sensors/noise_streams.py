"""Noise of one world: one random stream per source, drawn in blocks of steps.

Every stream is drawn step after step in a fixed layout. So the settings of one source
do not affect the noise of another, and the length of a block has no effect.
"""

import math
from collections.abc import Callable, Iterable
from functools import partial
from typing import Generic, NamedTuple, TypeVar, cast

import numpy as np

from ...arrays import Array
from ...sim_configs import Scenario
from .heavy_tails import heavy_tails

Row = TypeVar("Row")

_FIRST_BLOCK = 16  # steps; short, so that a reset is quick
_LONGEST_BLOCK = 128  # steps; later blocks grow to this

SensorNoise = tuple[Array, Array, Array | None, Array | None]
"""Random effects on the sensor in one step: (error, nearest, clutter, order).

A plain tuple, because a named one costs 1 % of a step. N landmarks, C rows for clutter.
Worlds that are simulated together add axes at the dots.

error : shape (2, …, N)
    (εβ, εr) [rad, m]; εr in units of σr(r) where that grows with the range.
nearest : shape (…, N)
    A landmark is read above this true range [m]. It is min_range or more, so that the
    noisy range is positive; inf where the reading drops out.
clutter : shape (2, …, C), or None with identities
    False readings (β, r), zeros where there is none [rad, m].
order : shape (…, N + C), or None with identities
    Uniform random numbers that sort the rows.
"""


class Streams(NamedTuple):
    """The independent generators of one episode, in the order of spawning."""

    start: np.random.Generator
    map: np.random.Generator
    motion: np.random.Generator
    measurement: np.random.Generator
    dropout: np.random.Generator
    clutter: np.random.Generator
    order: np.random.Generator


def spawn_streams(rng: np.random.Generator) -> Streams:
    """Spawn the streams of one episode; the state of `rng` does not change.

    Examples
    --------
    >>> streams = spawn_streams(np.random.default_rng(0))
    >>> bool(streams.start.random() == streams.map.random())
    False
    """
    return Streams(*rng.spawn(len(Streams._fields)))


class NoiseRows(Generic[Row]):
    """An endless iterator over rows of noise, one per step, drawn in growing blocks.

    Parameters
    ----------
    draw : callable
        Takes a number of steps and draws the rows of that many next steps.

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
    """Return the rows (εx, εy, εα) [m, m, rad] of an episode, as floats."""
    return NoiseRows(partial(_draw_motion_noise, streams, scenario))


def sensor_noise_rows(streams: Streams, scenario: Scenario) -> NoiseRows[SensorNoise]:
    """Return the rows of `SensorNoise`; the first one is that of the start."""
    return NoiseRows(partial(_sensor_noise_by_step, streams, scenario))


def _draw_motion_noise(
    streams: Streams, scenario: Scenario, steps: int
) -> list[list[float]]:
    unit = streams.motion.standard_normal((steps, 3))
    degrees = scenario.present_faults.motion_dof
    noise = heavy_tails(unit, degrees) * scenario.motion.std
    rows: list[list[float]] = noise.tolist()
    return rows


class UnitDraws(NamedTuple):
    """Random numbers for the sensor before any scaling, for K steps or K worlds.

    A field that the scenario does not need is None and is not drawn.
    """

    measurement: Array
    """Standard normal, shape (2, K, N)."""
    dropout: Array | None
    """Uniform, shape (K, N)."""
    clutter: Array | None
    """Uniform, one for the count and two for each row, shape (K, 1 + 2 C)."""
    order: Array | None
    """Uniform, shape (K, N + C)."""


def unit_widths(scenario: Scenario) -> tuple[int, int, int, int]:
    """Count the random numbers of each field of `UnitDraws` per step.

    Examples
    --------
    >>> from slamgym.sim_configs import load_scenario
    >>> unit_widths(load_scenario("dropout"))[:2]
    (24, 12)
    """
    sensor, count = scenario.sensor, scenario.landmarks.count
    hidden, rows = not sensor.identities, sensor.max_clutter
    return (
        2 * count,
        count if sensor.dropout else 0,
        1 + 2 * rows if hidden and sensor.clutter else 0,
        count + rows if hidden else 0,
    )


class SensorNoiseModel:
    """Scales unit draws to the noise of a scenario's sensor.

    Parameters
    ----------
    scenario : Scenario
        Source of the sensor's settings.
    """

    def __init__(self, scenario: Scenario) -> None:
        self._sensor = sensor = scenario.sensor
        faults = scenario.present_faults
        self._degrees, self._bias = faults.sensor_dof, faults.range_bias
        bearing_std, self._std = sensor.std
        self._growth = sensor.range_std_per_metre
        range_std = 1.0 if self._growth else self._std
        self._scale = np.array([[[bearing_std]], [[range_std]]])
        self._nearest = np.nextafter(sensor.min_range, -1.0)
        self._counts_below = _poisson_cdf(sensor.clutter, sensor.max_clutter)

    def apply(self, draws: UnitDraws) -> SensorNoise:
        """Scale the draws of some steps or worlds."""
        sensor, unit = self._sensor, heavy_tails(draws.measurement, self._degrees)
        nearest = _nearest_readable(unit[1], self._std, self._growth, self._bias)
        np.maximum(nearest, self._nearest, out=nearest)
        if draws.dropout is not None:
            nearest[draws.dropout < sensor.dropout] = np.inf
        if sensor.identities:
            return unit * self._scale, nearest, None, None
        return unit * self._scale, nearest, self._clutter(draws), draws.order

    def _clutter(self, draws: UnitDraws) -> Array:
        """Draw false readings, uniform over the visible bearings and ranges.

        One number per step determines their count, two more determine (β, r) of each
        reserved row. Returns (β, r), shape (2, K, C), zeros in empty rows.
        """
        sensor, rows = self._sensor, self._sensor.max_clutter
        if draws.clutter is None:
            return np.zeros((*draws.measurement.shape[:-1], rows))
        drawn = draws.clutter
        counts = np.searchsorted(self._counts_below, drawn[..., 0], side="right")
        width = sensor.max_range - sensor.min_range
        bearings = (drawn[..., 1::2] - 0.5) * sensor.field_of_view
        ranges = sensor.max_range - drawn[..., 2::2] * width  # above min_range
        present = np.arange(rows) < counts[..., None]
        return np.where(present, np.stack([bearings, ranges]), 0.0)


def draw_sensor_noise(streams: Streams, scenario: Scenario, steps: int) -> SensorNoise:
    """Draw the sensor noise of the next steps.

    Returns
    -------
    SensorNoise
        Its four arrays, with the steps as their first axis.
    """
    normal, *widths = unit_widths(scenario)
    sources = streams.dropout, streams.clutter, streams.order
    unit = streams.measurement.standard_normal((steps, 2, normal // 2))
    uniform = [
        source.random((steps, width)) if width else None
        for source, width in zip(sources, widths, strict=True)
    ]
    draws = UnitDraws(unit.transpose(1, 0, 2), *uniform)
    error, nearest, clutter, order = SensorNoiseModel(scenario).apply(draws)
    if clutter is not None:
        clutter = clutter.transpose(1, 0, 2)
    return error.transpose(1, 0, 2), nearest, clutter, order


def _sensor_noise_by_step(
    streams: Streams, scenario: Scenario, steps: int
) -> Iterable[SensorNoise]:
    fields = draw_sensor_noise(streams, scenario, steps)
    rows = ([None] * steps if field is None else field for field in fields)
    return cast("Iterable[SensorNoise]", zip(*rows, strict=True))


def _nearest_readable(unit: Array, std: float, per_metre: float, bias: float) -> Array:
    """Return the range r above which r + (σ + k r) ε + bias > 0, with unit noise ε."""
    if per_metre == 0.0:
        return -std * unit - bias
    slope = 1.0 + per_metre * unit
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(slope > 0.0, (-std * unit - bias) / slope, np.inf)


def _poisson_cdf(mean: float, largest: int) -> Array:
    """Return P(at most k false readings) for k < largest, the truncation."""
    if mean == 0.0:
        return np.empty(0)
    logs = [k * math.log(mean) - mean - math.lgamma(k + 1) for k in range(largest)]
    return np.cumsum(np.exp(logs))
