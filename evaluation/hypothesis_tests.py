"""Tests of the hypothesis "the filter is consistent", with known error rates.

Each test takes one number per run, or numbers that are white over time, because only
these are independent.  :mod:`.consistency_report` explains why NEES is never pooled
over time.  A NEES ratio is NEES divided by its degrees of freedom; a consistent filter
has a ratio of 1.
"""

from __future__ import annotations

from bisect import bisect_left
from typing import NamedTuple

import numpy as np
from scipy.special import chdtr, chdtrc

from ..arrays import Array, BoolArray, IntArray
from ..estimator.support import argument_checks
from .chi_square import (
    Band,
    chi_square_limits,
    chi_square_quantile,
    family_band,
    to_band,
)
from .whiteness import ljung_box, normal_scores


class HypothesisTest(NamedTuple):
    """Result of a test: whether a statistic is one that a consistent filter has."""

    statistic: float
    interval: Band
    """Values of the statistic that are accepted."""
    p_value: float
    """nan if the test could not decide."""
    error_rate: float
    """Probability of rejecting a consistent filter."""

    @property
    def accepted(self) -> bool:
        """Whether the test does not reject; a test that cannot decide accepts."""
        return not self.p_value < self.error_rate


class FamilyTest(NamedTuple):
    """Result of one test over a grid of steps, by Holm's method."""

    statistic: Array
    """ANEES ratio at each step of the grid, shape (k,)."""
    interval: Band
    """Band that holds all ratios together (Bonferroni)."""
    p_value: float
    """Smallest adjusted p-value."""
    rejected: BoolArray
    """Whether each step of the grid is rejected, shape (k,)."""
    error_rate: float
    """Largest probability of rejecting a consistent filter at any step."""

    @property
    def accepted(self) -> bool:
        """Whether no step is rejected."""
        return not self.rejected.any()


def final_step_test(
    nees: Array, degrees_of_freedom: int, *, error_rate: float = 0.05
) -> HypothesisTest:
    """Test the sum of the final NEES of M runs, which is exactly χ²(M n); two-sided.

    Parameters
    ----------
    nees : ndarray, shape (M,)
        NEES of independent runs at one step chosen beforehand.
    degrees_of_freedom : int
        n of one NEES.
    error_rate : float
        Probability of rejecting a consistent filter.

    Examples
    --------
    >>> final_step_test(np.full(50, 3.0), 3).accepted
    True
    """
    values = one_per_run("nees", nees, 1)
    freedom = len(values) * degrees_of_freedom
    return _chi_square_test(float(values.sum()), freedom, error_rate)


def nis_test(
    nis: Array, degrees_of_freedom: IntArray, *, error_rate: float = 0.05
) -> HypothesisTest:
    """Test the sum of the NIS of all runs and steps; two-sided.

    The innovations of a consistent filter are white, so NIS may be pooled over time.

    Parameters
    ----------
    nis, degrees_of_freedom : ndarray, shape (M, T)
        Steps with 0 degrees of freedom are left out.
    error_rate : float
        Probability of rejecting a consistent filter.
    """
    used = np.asarray(degrees_of_freedom) > 0
    if not used.any():
        raise ValueError("degrees_of_freedom must be > 0 at some step, got none")
    values = one_per_run("nis", np.asarray(nis)[used], 1)
    freedom = int(np.asarray(degrees_of_freedom)[used].sum())
    return _chi_square_test(float(values.sum()), freedom, error_rate)


def family_test(
    nees: Array, degrees_of_freedom: int, *, error_rate: float = 0.05
) -> FamilyTest:
    """Test the averages at several steps at once, by Holm's method.

    The error rate is at most the stated one.  It is reached if the steps are far enough
    apart to be uncorrelated.

    Parameters
    ----------
    nees : ndarray, shape (M, k)
        NEES of independent runs on a decimated grid of k steps.
    degrees_of_freedom : int
        n of one NEES.
    error_rate : float
        Probability of rejecting a consistent filter at any step.
    """
    values = argument_checks.as_floats("nees", nees)
    runs, times = values.shape
    freedom, totals = runs * degrees_of_freedom, values.sum(axis=0)
    p = 2 * np.minimum(chdtr(freedom, totals), chdtrc(freedom, totals))
    order = np.argsort(p)
    holm = np.maximum.accumulate(p[order] * np.arange(times, 0, -1))
    rejected = np.zeros(times, dtype=np.bool_)
    rejected[order] = holm < error_rate
    band = family_band(runs, degrees_of_freedom, times, 1 - error_rate)
    return FamilyTest(
        statistic=totals / freedom,
        interval=to_band(np.array(band) / degrees_of_freedom),
        p_value=float(min(1.0, holm[0])),
        rejected=rejected,
        error_rate=error_rate,
    )


def whiteness_test(
    nis: Array,
    degrees_of_freedom: IntArray,
    *,
    lags: int = 10,
    error_rate: float = 0.05,
) -> HypothesisTest:
    """Test whether the NIS is white, by Ljung-Box over all runs.

    :func:`.normal_scores` first transforms each NIS.  NIS is quadratic: innovations
    with correlation ρ give ρ² here, so this test finds gross errors only.
    :func:`.ljung_box` takes normalised innovations, if they are available.

    Parameters
    ----------
    nis, degrees_of_freedom : ndarray, shape (M, T)
        Steps with 0 degrees of freedom are left out.
    lags : int
        Number of autocorrelations in the sum.
    error_rate : float
        Probability of rejecting a white series.
    """
    test = ljung_box(normal_scores(nis, degrees_of_freedom), lags=lags)
    limit = float(chi_square_quantile(1 - error_rate, lags))
    return HypothesisTest(test.statistic, Band(0.0, limit), test.p_value, error_rate)


def runs_to_detect(
    factor: float,
    degrees_of_freedom: int,
    *,
    power: float = 0.9,
    error_rate: float = 0.05,
) -> int:
    """Return how many runs :func:`final_step_test` needs to find wrong covariances.

    Parameters
    ----------
    factor : float
        Factor by which the covariances are too small, > 0 and not 1.
    degrees_of_freedom : int
        n of one NEES.
    power : float
        Probability of finding it.
    error_rate : float
        Probability of rejecting a consistent filter.

    Examples
    --------
    >>> [runs_to_detect(factor, 3) for factor in (1.1, 1.2, 1.5)]
    [767, 209, 42]
    """
    if argument_checks.above("factor", factor, 0) == 1:
        raise ValueError("factor must differ from 1, got 1")

    def found(runs: int) -> bool:
        freedom = runs * degrees_of_freedom
        low, high = chi_square_limits(freedom, error_rate / 2) / factor
        return bool(chdtr(freedom, low) + chdtrc(freedom, high) >= power)

    most = 1
    while not found(most):
        most *= 2
    return bisect_left(range(most + 1), True, most // 2 + 1, key=found)


def one_per_run(name: str, values: Array, least: int) -> Array:
    """Return one finite number per run, or raise if there are fewer than ``least``."""
    array = argument_checks.as_floats(name, values)
    if array.ndim != 1 or len(array) < least or not np.isfinite(array).all():
        raise ValueError(
            f"{name} must be at least {least} finite numbers, one per run, "
            f"got shape {array.shape}"
        )
    return array


def _chi_square_test(total: float, freedom: int, error_rate: float) -> HypothesisTest:
    p_value = float(2 * min(chdtr(freedom, total), chdtrc(freedom, total)))
    interval = to_band(chi_square_limits(freedom, error_rate / 2) / freedom)
    return HypothesisTest(total / freedom, interval, p_value, error_rate)
