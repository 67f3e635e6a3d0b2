"""Tests of the time average of each run's NEES: one independent number per run.

If NEES is correlated over time, the averages are skewed.  The t-test and its interval
are therefore corrected for skewness by the monotone cubic of [1]_.

References
----------
.. [1] P. Hall, On the removal of skewness by transformation, JRSS B 54(1), 1992.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.stats import t as student

from ..arrays import Array
from .chi_square import Band, to_band
from .hypothesis_tests import HypothesisTest, one_per_run

EQUIVALENCE_MARGIN = Band(0.8, 1.25)
"""Ratios of NEES to its expectation that count as consistent."""
FEWEST_RESAMPLED = 5
"""Smallest number of runs with enough different resamples for a bootstrap."""


class EquivalenceTest(NamedTuple):
    """Result of a test that shows a ratio to be near 1."""

    statistic: float
    interval: Band
    """90 % confidence interval of the ratio."""
    verdict: str
    """"consistent", "not consistent" or "not shown"."""
    error_rate: float
    """Probability of "consistent" for a filter at or beyond the margin."""

    @property
    def accepted(self) -> bool:
        """Whether the ratio is shown to be near 1."""
        return self.verdict == "consistent"


def time_average_test(
    averages: Array, degrees_of_freedom: int, *, error_rate: float = 0.05
) -> HypothesisTest:
    """Test the mean of the per-run time averages of NEES by a t-test.

    If NEES hardly changes over time, the plain t-test rejects 8 % of consistent filters
    at 10 runs and 7.5 % at 20 runs instead of 5 %.  With the correction for skewness it
    rejects 5 to 6 %.

    Parameters
    ----------
    averages : ndarray, shape (M,)
        Average NEES of each of M >= 2 runs, not divided by n.
    degrees_of_freedom : int
        n of one NEES.
    error_rate : float
        Probability of rejecting a consistent filter.
    """
    ratios = one_per_run("averages", averages, 2) / degrees_of_freedom
    mean, error = _mean_and_error(ratios)
    skewness, runs = _skewness(ratios), len(ratios)
    score = _unskew((mean - 1) / error, skewness, runs) if error else np.inf
    limit = student.ppf(1 - error_rate / 2, runs - 1)
    ends = 1 + error * _skew(np.array([-limit, limit]), skewness, runs)
    p_value = float(2 * student.sf(abs(score), runs - 1))
    return HypothesisTest(mean, to_band(ends), p_value, error_rate)


def bootstrap_test(
    averages: Array,
    degrees_of_freedom: int,
    *,
    rng: np.random.Generator,
    resamples: int = 1999,
    error_rate: float = 0.05,
) -> HypothesisTest:
    """Test the mean of the per-run time averages by the studentised bootstrap.

    If NEES hardly changes over time, the percentile bootstrap would reject 9 % of
    consistent filters at 50 runs and 11 % at 20.  Resamples that repeat a single run
    have no spread to divide by and are left out.  With fewer than 5 runs, or if all
    averages are equal, the test cannot decide: its p-value is nan, and it accepts any
    mean.

    Parameters
    ----------
    averages, degrees_of_freedom, error_rate
        As in :func:`time_average_test`.
    rng : numpy.random.Generator
        Draws the resamples.
    resamples : int
        Number of resamples.
    """
    ratios = one_per_run("averages", averages, 2) / degrees_of_freedom
    mean, error = _mean_and_error(ratios)
    if len(ratios) < FEWEST_RESAMPLED or np.ptp(ratios) == 0:
        return HypothesisTest(mean, Band(-np.inf, np.inf), np.nan, error_rate)
    drawn = ratios[rng.integers(0, len(ratios), (resamples, len(ratios)))]
    drawn = drawn[np.ptp(drawn, axis=1) > 0]
    errors = drawn.std(axis=1, ddof=1) / np.sqrt(len(ratios))
    scores = np.sort((drawn.mean(axis=1) - mean) / errors)
    score = (mean - 1) / error
    below = np.searchsorted(scores, score, "right")
    above = len(scores) - np.searchsorted(scores, score, "left")
    p_value = min(1.0, 2 * (1 + min(below, above)) / (len(scores) + 1))
    ends = 1 + error * np.quantile(scores, [error_rate / 2, 1 - error_rate / 2])
    return HypothesisTest(mean, to_band(ends), p_value, error_rate)


def equivalence_test(
    averages: Array, degrees_of_freedom: int, *, error_rate: float = 0.05
) -> EquivalenceTest:
    """Test whether the mean ratio is shown to lie inside [.8, 1.25].

    Parameters
    ----------
    averages, degrees_of_freedom
        As in :func:`time_average_test`, whose interval this uses.
    error_rate : float
        Probability of claiming consistency at the margin.  The interval leaves out
        twice this probability.
    """
    ratios = one_per_run("averages", averages, 2) / degrees_of_freedom
    mean, error = _mean_and_error(ratios)
    limit = student.ppf(1 - error_rate, len(ratios) - 1)
    ends = _skew(np.array([limit, -limit]), _skewness(ratios), len(ratios))
    interval = to_band(mean - error * ends)
    low, high = EQUIVALENCE_MARGIN
    verdict = "not shown"
    if low <= interval.low and interval.high <= high:
        verdict = "consistent"
    elif interval.high < low or interval.low > high:
        verdict = "not consistent"
    return EquivalenceTest(mean, interval, verdict, error_rate)


def _mean_and_error(values: Array) -> tuple[float, float]:
    return float(values.mean()), float(values.std(ddof=1) / np.sqrt(len(values)))


def _skewness(values: Array) -> float:
    spread = values.std()
    centred = values - values.mean()
    return float((centred**3).mean() / spread**3) if spread else 0.0


def _unskew(score: float, skewness: float, runs: int) -> float:
    """Hall's g(t) = t + γ t²/(3√M) + γ² t³/(27 M) + γ/(6√M)."""
    c = skewness / np.sqrt(runs)
    return float(score + c * score**2 / 3 + c**2 * score**3 / 27 + c / 6)


def _skew(scores: Array, skewness: float, runs: int) -> Array:
    """Return the inverse of :func:`_unskew`."""
    c = skewness / np.sqrt(runs)
    if abs(c) < 1e-9:
        return scores
    return np.asarray(3 / c * (np.cbrt(1 + c * (scores - c / 6)) - 1))
