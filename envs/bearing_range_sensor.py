"""The bearing-range sensor: which landmarks it sees, and what it reads of them.

Symbols
-------
p = (x, y, θ)  true robot pose in the world frame [m, m, rad]
l = (lx, ly)   landmark [m, m], as the complex number lx + i ly
z = (β, r)     reading: bearing from the robot's heading, and range [rad, m]
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..sim_configs import Scenario
from .line_of_sight import LineOfSight
from .noise_streams import MANY_STD, ComplexArray, SensorNoise

Array = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

_PI = np.array(np.pi)


class Scan(NamedTuple):
    """The readings of one moment; fresh arrays."""

    measurements: Array
    """Rows (bearing in [-π, π), range), zeros where unseen, shape (…, M, 2)."""
    mask: BoolArray
    """Which rows hold a reading, shape (…, M)."""
    landmark_ids: NDArray[np.int64] | None
    """The landmark of each row, -1 where there is none, shape (…, M).

    None when row i is landmark i.
    """


class BearingRangeSensor:
    """Measures N landmarks as a scenario's sensor does, for any leading axes.

    A landmark is seen when its true range lies in [min_range, max_range], its true
    bearing within half the field of view of the heading, no wall hides it, it does
    not drop out, and its noisy range is above zero.

    Parameters
    ----------
    scenario : Scenario
        Whose sensor, walls and number of landmarks are meant.
    """

    def __init__(self, scenario: Scenario) -> None:
        sensor = scenario.sensor
        self._count = scenario.landmarks.count
        self._hides_identities = not sensor.identities
        self._range_std = sensor.std[1], sensor.range_std_per_metre
        self._constant_noise = sensor.range_std_per_metre == 0.0
        self._max_range = np.array(sensor.max_range) if np.isfinite(sensor.max_range) else None
        self._half_view = np.array(sensor.field_of_view / 2) if sensor.field_of_view<2*np.pi else None
        self._may_wrap = sensor.field_of_view / 2 + MANY_STD * sensor.std[0] >= np.pi
        self._sight = None
        if sensor.occlusion and scenario.walls:
            self._sight = LineOfSight(scenario.walls)

    def scan(
        self,
        landmarks: ComplexArray,
        position: complex | ComplexArray,
        heading: complex | ComplexArray,
        noise: SensorNoise,
    ) -> Scan:
        """Measure the landmarks from one pose.

        Parameters
        ----------
        landmarks : complex ndarray, shape (…, N)
            l [m].
        position : complex, or complex ndarray, shape (…, 1)
            x + iy [m].
        heading : complex, or complex ndarray, shape (…, 1)
            cos θ + i sin θ.
        noise : SensorNoise
            Of this step.

        Returns
        -------
        Scan
            With M = N, or N + C when identities are hidden.
        """
        true = np.empty(landmarks.shape, dtype=np.complex128)
        relative = (landmarks - position) * heading
        bearings = np.arctan2(relative.imag, relative.real, true.real)
        ranges = np.abs(relative, true.imag)
        mask = ranges > noise.nearest
        if self._max_range is not None:
            mask &= ranges <= self._max_range
        if self._half_view is not None:
            mask &= np.abs(bearings) <= self._half_view
        if self._sight is not None:
            mask &= ~self._sight.blocked(landmarks, position)
        true += noise.reading if self._constant_noise else self._scaled(noise, ranges)
        if self._may_wrap and np.count_nonzero(np.abs(bearings) >= _PI):
            true.real = wrap_bearings(bearings)
        rows = np.zeros((*mask.shape, 2))
        np.copyto(rows.view(np.complex128)[..., 0], true, where=mask)
        return rows, mask, None

    def _scaled(self, noise: ComplexArray, ranges: Array) -> ComplexArray:
        """Give noise in units of σr(r) = σr + k r its size; leave other as it is."""
        constant, per_metre = self._range_std
        if per_metre == 0.0:
            return noise
        return noise.real + 1j * (noise.imag * (constant + per_metre * ranges))


def wrap_bearings(bearings: Array) -> Array:
    """Bring angles into [-π, π), without rounding those that lie there already.

    Examples
    --------
    >>> wrap_bearings(np.array([0.1, np.pi, 1.0 - 2 * np.pi])).round(12)
    array([ 0.1       , -3.14159265,  1.        ])
    """
    wrapped = bearings - 2 * np.pi * np.floor((bearings + np.pi) / (2 * np.pi))
    wrapped = np.where(wrapped >= np.pi, wrapped - 2 * np.pi, wrapped)
    wrapped = np.where(wrapped < -np.pi, wrapped + 2 * np.pi, wrapped)
    return np.where(np.abs(bearings) < np.pi, bearings, wrapped)


def hide_identities(
    readings: ComplexArray, mask: BoolArray, noise: SensorNoise
) -> Scan:
    """Mix readings with clutter and pack them at the front in random order.

    Parameters
    ----------
    readings : complex ndarray, shape (…, N)
        β + i r of each landmark, 0 where unseen [rad, m].
    mask : bool ndarray, shape (…, N)
        Which landmarks are seen.
    noise : SensorNoise
        Of this step; its clutter and its order are used.

    Returns
    -------
    Scan
        With M = N + C rows, and the landmark of each row.
    """
    assert noise.clutter is not None
    assert noise.order is not None
    rows = np.concatenate([readings, noise.clutter], axis=-1)
    filled = np.concatenate([mask, noise.clutter.imag > 0.0], axis=-1)
    ids = np.full(filled.shape, -1, dtype=np.int64)
    ids[..., : mask.shape[-1]] = np.where(mask, np.arange(mask.shape[-1]), -1)
    order = np.argsort(np.where(filled, noise.order, 1.0), axis=-1, kind="stable")
    return Scan(
        as_rows(np.take_along_axis(rows, order, axis=-1)),
        np.take_along_axis(filled, order, axis=-1),
        np.take_along_axis(ids, order, axis=-1),
    )


def as_rows(readings: ComplexArray) -> Array:
    """View β + i r, shape (…, M), as rows (β, r), shape (…, M, 2)."""
    return readings.view(np.float64).reshape(*readings.shape, 2)
