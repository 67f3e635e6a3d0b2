"""The noise that a filter assumes, as a vector of seven standard deviations."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ...arrays import Array, BoolArray
from ..runs.filter_settings import FilterSettings


class NoiseEntry(NamedTuple):
    """One standard deviation."""

    name: str
    unit: str
    """Of a motion: per unit of the log's time."""


ENTRIES = (
    NoiseEntry("σx", "m"),
    NoiseEntry("σy", "m"),
    NoiseEntry("σα", "rad"),
    NoiseEntry("σβ", "rad"),
    NoiseEntry("σr", "m"),
    NoiseEntry("σr per metre", "m/m"),
    NoiseEntry("σβ in metres", "m"),
)
BEARING, RANGE, PER_METRE, IN_METRES = 3, 4, 5, 6  # columns of the sensor's noise
SMALL = 0.1  # share of its neighbours at which the search for a zero begins


def noise_of(settings: FilterSettings) -> Array:
    """Return the noise of settings, shape (7,)."""
    options = settings.options
    return np.array(
        [
            *settings.motion_std,
            *settings.measurement_std,
            options.get("range_std_per_metre", 0.0),
            options.get("bearing_std_metres", 0.0),
        ]
    )


def with_noise(settings: FilterSettings, noise: Array) -> FilterSettings:
    """Return settings with another noise (7,), rounded to 4 significant digits."""
    values = [float(f"{value:.4g}") for value in noise]
    more = {"range_std_per_metre": values[PER_METRE]}
    if "bearing_std_metres" in settings.options or values[IN_METRES]:
        more["bearing_std_metres"] = values[IN_METRES]
    return replace(
        settings,
        motion_std=tuple(values[:3]),
        measurement_std=tuple(values[BEARING:PER_METRE]),
        options={**settings.options, **more},
    )


def fitted_entries(noise: Array) -> BoolArray:
    """Return which entries are fitted, (7,): all, but σβ in metres only if used."""
    fitted = np.ones(len(ENTRIES), dtype=np.bool_)
    fitted[IN_METRES] = noise[IN_METRES] > 0
    return fitted


def positive_start(noise: Array, typical_range: float) -> Array:
    """Replace zeros of a noise (7,) by small numbers, with which a search can begin.

    Examples
    --------
    >>> positive_start(np.array([0.1, 0, 0.05, 0.02, 0.1, 0, 0]), 5.0)
    array([0.1  , 0.01 , 0.05 , 0.02 , 0.1  , 0.002, 0.   ])
    """
    start, metres = noise.copy(), max(typical_range, 1e-3)
    along, turning = noise[:2].max(), noise[2]
    range_std = max(noise[RANGE], noise[PER_METRE] * metres, 1e-3)
    bearing_std = max(noise[BEARING], noise[IN_METRES] / metres, 1e-3)
    instead = (
        *((SMALL * along or 0.01),) * 2,
        SMALL * (turning or along or 0.01),
        SMALL * bearing_std,
        SMALL * range_std,
        SMALL * range_std / metres,
        0.0,
    )
    return np.where(start > 0, start, instead)


def replaceable_by_zero(noise: Array) -> BoolArray:
    """Return which entries of a sensor's noise another entry can replace, (7,)."""
    can = np.zeros(len(ENTRIES), dtype=np.bool_)
    can[[RANGE, PER_METRE]] = noise[RANGE] > 0 and noise[PER_METRE] > 0
    can[[BEARING, IN_METRES]] = noise[BEARING] > 0 and noise[IN_METRES] > 0
    return can
