"""The settings of a filter, checked and converted to rules for kernels."""

from __future__ import annotations

from math import inf, log1p

import numpy as np
from numpy.typing import ArrayLike

from ...arrays import Array
from ..kernels.rules import Rules
from ..support import argument_checks


def checked_rules(
    measurement_std: ArrayLike,
    *,
    linearisation: int,
    frame: int,
    landmark_init: str,
    range_std_per_metre: float,
    bearing_std_metres: float = 0.0,
    range_noise_at: str,
    gate_probability: float | None,
    min_range: float,
) -> Rules:
    """Return the rules of an update, from the arguments of :class:`.ekf.EkfSlam`."""
    sensor = argument_checks.standard_deviations("measurement_std", measurement_std, 2)
    argument_checks.one_of("landmark_init", landmark_init, ("full", "independent"))
    argument_checks.one_of("range_noise_at", range_noise_at, ("expected", "reading"))
    return Rules(
        linearisation=linearisation,
        frame=frame,
        correlated=landmark_init == "full",
        bearing_std=float(sensor[0]),
        range_std=float(sensor[1]),
        range_std_per_metre=argument_checks.range_growth(range_std_per_metre),
        min_range=argument_checks.positive("min_range", min_range),
        gate=_gate(gate_probability),
        noise_as_read=range_noise_at == "reading",
        bearing_std_metres=argument_checks.at_least(
            "bearing_std_metres", bearing_std_metres, 0.0
        ),
    )


def reading_variances(rules: Rules, ranges: Array) -> Array:
    """Return (σβ², σr²) of readings at these ranges [m], shape (m, 2)."""
    range_std = rules.range_std + rules.range_std_per_metre * ranges
    away = np.maximum(ranges, rules.min_range)
    bearing_std = rules.bearing_std + rules.bearing_std_metres / away
    return np.column_stack([bearing_std, range_std]) ** 2


def _gate(probability: float | None) -> float:
    """Return the χ²(2) quantile of the gate."""
    if probability is None:
        return inf
    if not (isinstance(probability, float) and 0 < probability < 1):
        raise ValueError(
            f"gate_probability must lie between 0 and 1, got {probability!r}"
        )
    return -2 * log1p(-probability)  # P(χ²₂ > g) = e^{−g/2}
