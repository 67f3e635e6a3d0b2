"""Tests of the actual noise of a world: its size, its mean and its tails.

In a world without faults, the standardised noise is independent and standard normal.
Every test here therefore has a known distribution for any number of runs or steps.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from scipy.stats import chi2, norm
from scipy.stats import t as student

from ..arrays import Array
from .noise_sums import CHANNELS, MOMENTS

_NOISE = {
    "along": "motion noise",
    "sideways": "motion noise",
    "turn": "motion noise",
    "bearing": "bearing noise",
    "range": "range noise",
}
_SYMBOLS = dict(zip(CHANNELS, ("σx", "σy", "σα", "σβ", "σr"), strict=True))
_BIASES = {
    "along": "odometry scale",
    "turn": "odometry turn",
    "bearing": "bearing bias",
    "range": "range bias",
}
HEAVY_TAILS = "heavy tails"
_LEAST_VARIANCE = 0.05
_LEAST_BIAS = 0.1
_LEAST_KURTOSIS = 0.5
_FEWEST = 30  # numbers, for the distribution of the kurtosis


class Finding(NamedTuple):
    """The result of one test on one noise."""

    cause: str
    p_value: float
    """Two-sided, not adjusted for other tests."""
    impact: float
    """Estimate of the relative change in NEES; ranks findings."""
    matters: bool
    """Whether it is large enough to change NEES."""
    text: str
    """What is wrong, to follow "because"."""


def noise_findings(sums: Array) -> list[Finding]:
    """Test each noise that has numbers.

    ::

        size   (n − 1) s² ~ χ²(n − 1),    matters if |s² − 1| ≥ .05
        mean   b = Σ g w / Σ g²,  b √(Σ g²) / s ~ t(n − 1),
               matters if b² Σ g², averaged over runs, ≥ .1
        tails  kurtosis of n numbers [1]_,  matters if it is .5 above that of a normal

    Parameters
    ----------
    sums : ndarray, shape (B, 5, 7)
        Of :func:`.noise_sums.noise_sums`.

    References
    ----------
    .. [1] F. J. Anscombe, W. J. Glynn, Distribution of the kurtosis statistic b2 for
       normal samples, Biometrika 70(1), 1983.
    """
    return [
        finding
        for index, channel in enumerate(CHANNELS)
        if sums[:, index, 0].sum() >= _FEWEST
        for finding in _tests(channel, sums[:, index].sum(axis=0), len(sums))
    ]


def significant_findings(sums: Array, error_rate: float) -> list[Finding]:
    """Return what is wrong with the noise, the largest effect first.

    The p-values are adjusted for the number of tests.
    """
    findings = noise_findings(sums)
    tests = max(1, len(findings))
    adjusted = [f._replace(p_value=min(1.0, f.p_value * tests)) for f in findings]
    guilty = [f for f in adjusted if f.p_value < error_rate and f.matters]
    return sorted(guilty, key=lambda f: -f.impact)


def _tests(channel: str, total: Array, runs: int) -> Iterator[Finding]:
    found = dict(zip(MOMENTS, total.tolist(), strict=True))
    count = found["count"]
    mean = found["first"] / count
    variance = (found["second"] - count * mean**2) / (count - 1)
    if channel in _BIASES and found["leverage"] > 0:
        yield _bias(channel, found, variance, runs)
    tails = _tails(channel, found, mean, variance)
    if tails is not None:
        yield tails
    if tails is None or not (tails.matters and tails.p_value < 1e-4):
        yield _size(channel, count, variance)


def _size(channel: str, count: float, variance: float) -> Finding:
    below = chi2.cdf((count - 1) * variance, count - 1)
    above = chi2.sf((count - 1) * variance, count - 1)
    which = "too small" if variance > 1 else "too large"
    return Finding(
        f"{_NOISE[channel]} {which}",
        float(min(1.0, 2 * min(below, above))),
        abs(float(np.log(max(variance, 1e-12)))),
        abs(variance - 1) >= _LEAST_VARIANCE,
        f"{_SYMBOLS[channel]} is {np.sqrt(variance):.3g} times what it assumes",
    )


def _bias(channel: str, found: dict[str, float], variance: float, runs: int) -> Finding:
    bias = found["slope"] / found["leverage"]
    strength = bias**2 * found["leverage"] / max(variance, 1e-12)
    p_value = 2 * student.sf(np.sqrt(strength), found["count"] - 1)
    return Finding(
        _BIASES[channel],
        float(p_value),
        strength / runs / 3,
        strength / runs >= _LEAST_BIAS,
        _bias_text(channel, bias),
    )


def _bias_text(channel: str, bias: float) -> str:
    if channel == "along":  # true minus odometry
        way = "long" if bias < 0 else "short"
        return f"the odometry reads distances {abs(bias):.2%} too {way}"
    if channel == "turn":
        way = "left" if bias < 0 else "right"
        size = np.degrees(abs(bias))
        return f"the odometry reads turns {size:.2g}° per step too far to the {way}"
    way = "large" if bias > 0 else "small"
    if channel == "bearing":
        return f"bearings are {np.degrees(abs(bias)):.2g}° too {way}"
    return f"ranges are {abs(bias):.2g} m too {way}"


def _tails(
    channel: str, found: dict[str, float], mean: float, variance: float
) -> Finding | None:
    """Test the fourth moment about the mean; None where all numbers are equal."""
    count = found["count"]
    second = variance * (count - 1) / count
    if second <= 0:
        return None
    fourth = (
        found["fourth"] - 4 * mean * found["third"] + 6 * mean**2 * found["second"]
    ) / count - 3 * mean**4
    kurtosis = fourth / second**2
    p_value = float(2 * norm.sf(abs(_kurtosis_score(kurtosis, count))))
    return Finding(
        HEAVY_TAILS,
        p_value,
        max(abs(float(np.log(variance))), (kurtosis - 3) / 10),
        kurtosis - 3 >= _LEAST_KURTOSIS,
        f"the noise of {_SYMBOLS[channel]} has a kurtosis of {kurtosis:.3g}, a normal "
        "one 3",
    )


def _kurtosis_score(kurtosis: float, n: float) -> float:
    """Return a standard normal number for the kurtosis of n normal ones."""
    expected = 3 * (n - 1) / (n + 1)
    variance = 24 * n * (n - 2) * (n - 3) / ((n + 1) ** 2 * (n + 3) * (n + 5))
    x = (kurtosis - expected) / np.sqrt(variance)
    skew = (
        6 * (n * n - 5 * n + 2) / ((n + 7) * (n + 9))
        * np.sqrt(6 * (n + 3) * (n + 5) / (n * (n - 2) * (n - 3)))
    )  # fmt: skip
    a = 6 + 8 / skew * (2 / skew + np.sqrt(1 + 4 / skew**2))
    cube = (1 - 2 / a) / max(1 + x * np.sqrt(2 / (a - 4)), 1e-12)
    return float((1 - 2 / (9 * a) - np.cbrt(cube)) / np.sqrt(2 / (9 * a)))
