"""The bearing-range sensor: which landmarks it sees, and what it reads of them.

Symbols
-------
p = (x, y, θ)  true robot pose in the world frame [m, m, rad]
l = (lx, ly)   landmark [m, m], as the complex number lx + i ly
z = (β, r)     reading: bearing from the robot's heading, and range [rad, m]

Readings are kept as (all bearings, all ranges) here, so that each is contiguous.
Every function takes leading axes too, for worlds simulated side by side.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...sim_configs import Scenario
from .line_of_sight import LineOfSight
from .noise_streams import MANY_STD, SensorNoise

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
BoolArray = NDArray[np.bool_]

_PI = np.array(np.pi)  # 0-d arrays compare twice as fast as Python floats
_UNSEEN = np.array(0.0)
_LAST = np.array(np.inf)  # sorts behind every other row


class AnonymousScan(NamedTuple):
    """Readings without identities, packed at the front in random order."""

    readings: Array
    """(β, r), zeros in empty rows, shape (2, …, M) [rad, m]."""
    mask: BoolArray
    """Which rows hold a reading, shape (…, M)."""
    landmark_ids: NDArray[np.int64]
    """The true landmark of each row, -1 for clutter and empty rows, shape (…, M)."""


class BearingRangeSensor:
    """Measures N landmarks as a scenario's sensor does.

    A landmark is read when its true range lies in [min_range, max_range] and its true
    bearing within half the field of view of the heading, no wall hides it, the reading
    does not drop out, and its noisy range is above zero.

    Parameters
    ----------
    scenario : Scenario
        Whose sensor and walls are meant.
    """

    def __init__(self, scenario: Scenario) -> None:
        sensor = scenario.sensor
        bearing_std, self._std = sensor.std
        self._growth = sensor.range_std_per_metre  # of σr, per metre of range
        self._max_range = _limit(sensor.max_range, above=math.inf)
        self._half_view = _limit(sensor.field_of_view / 2, above=math.pi)
        self._may_wrap = sensor.field_of_view / 2 + MANY_STD * bearing_std >= math.pi
        hides = sensor.occlusion and scenario.walls
        self._sight = LineOfSight(scenario.walls) if hides else None

    def scan(
        self,
        landmarks: ComplexArray,
        position: ComplexArray,
        inverse_heading: ComplexArray,
        noise: SensorNoise,
    ) -> tuple[Array, BoolArray]:
        """Measure the landmarks from one pose.

        ::

            δ = (l - p) (cos θ - i sin θ),   z = (arg δ, |δ|) + ε

        Parameters
        ----------
        landmarks : complex ndarray, shape (…, N)
            l [m].
        position : complex ndarray, shape () or (…, 1)
            x + iy [m].
        inverse_heading : complex ndarray, shape () or (…, 1)
            cos θ - i sin θ.
        noise : SensorNoise
            Of this step.

        Returns
        -------
        readings : ndarray, shape (2, …, N)
            (β in [-π, π), r), zeros where unseen [rad, m].
        mask : bool ndarray, shape (…, N)
            Which landmarks are seen.
        """
        error, nearest, _, _ = noise
        relative = (landmarks - position) * inverse_heading
        readings = np.empty(error.shape)  # true ones first
        y, x = relative.imag, relative.real
        if y.ndim > 1:  # twice as fast, when there are many
            y, x = y.copy(), x.copy()
        bearings = np.arctan2(y, x, readings[0])
        ranges = np.abs(relative, readings[1])
        mask: BoolArray = ranges > nearest
        if self._max_range is not None:
            mask &= ranges <= self._max_range
        if self._half_view is not None:
            mask &= np.abs(bearings) <= self._half_view
        if self._sight is not None:
            mask &= ~self._sight.blocked(landmarks, position)
        if self._growth:
            error = np.stack([error[0], error[1] * (self._std + self._growth * ranges)])
        readings += error
        if self._may_wrap and np.count_nonzero(np.abs(bearings) >= _PI):
            wrap_bearings(bearings)
        if mask.ndim > 1:
            return _only_seen(readings, mask), mask
        seen = np.zeros(readings.shape)
        np.copyto(seen, readings, where=mask)
        return seen, mask


def _limit(value: float, above: float) -> Array | None:
    """Keep a limit in the form that compares fastest, or None if it has no effect."""
    return np.array(value) if value < above else None


def _only_seen(readings: Array, mask: BoolArray) -> Array:
    """Put zeros where the mask is False, in the way that is fastest for many."""
    if np.count_nonzero(mask) == mask.size:
        return readings
    return np.where(mask, readings, _UNSEEN)


def wrap_bearings(bearings: Array) -> None:
    """Bring angles into [-π, π) in place; those that lie there keep every bit.

    Examples
    --------
    >>> bearings = np.array([0.1, np.pi, 1.0 - 2 * np.pi])
    >>> wrap_bearings(bearings)
    >>> bearings.round(12)
    array([ 0.1       , -3.14159265,  1.        ])
    """
    outside = (bearings >= np.pi) | (bearings < -np.pi)
    wrapped = (bearings[outside] + np.pi) % (2 * np.pi) - np.pi
    wrapped[wrapped >= np.pi] = -np.pi  # a tiny negative remainder rounds up to 2π
    bearings[outside] = wrapped


def hide_identities(
    readings: Array, mask: BoolArray, noise: SensorNoise
) -> AnonymousScan:
    """Mix readings with clutter and pack them at the front in random order.

    Parameters
    ----------
    readings : ndarray, shape (2, …, N)
        (β, r) of each landmark, zeros where unseen [rad, m].
    mask : bool ndarray, shape (…, N)
        Which landmarks are seen.
    noise : SensorNoise
        Of this step; its clutter and its order are used.

    Returns
    -------
    AnonymousScan
        With M = N + C rows.
    """
    _, _, clutter, order = noise
    assert clutter is not None
    assert order is not None
    count = mask.shape[-1]
    rows = np.zeros((3, *order.shape))
    rows[:2, ..., :count] = readings
    rows[:2, ..., count:] = clutter
    rows[2] = -1.0
    np.copyto(rows[2, ..., :count], np.arange(count), where=mask)
    places = np.argsort(np.where(rows[1] > 0.0, order, _LAST), axis=-1)
    packed = _take(rows, places)
    return AnonymousScan(packed[:2], packed[1] > 0.0, packed[2].astype(np.int64))


def _take(rows: Array, places: NDArray[np.intp]) -> Array:
    """Sort the last axis of rows, (3, …, M), by places, (…, M)."""
    if places.ndim == 1:
        return rows[:, places]  # 20 µs faster
    return np.take_along_axis(rows, places[None], axis=-1)
