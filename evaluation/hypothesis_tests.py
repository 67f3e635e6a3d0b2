"""Tests of the hypothesis "the filter is consistent", with known error rates.

Each test takes one number per run, or numbers that are white over time, because only
these are independent.  :mod:`.consistency_report` explains why NEES is never pooled
over time.  A NEES ratio is NEES divided by its degrees of freedom; a consistent filter
has a ratio of 1.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable, Iterable
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import chdtr, chdtrc, gammaincinv, stdtr, stdtrit

from .. import argument_checks
from ..arrays import Array, BoolArray, IntArray

#: Yields NIS and degrees of freedom of some runs at a time; each call begins again.
Scans = Callable[[], Iterable[tuple[Array, IntArray]]]


class HypothesisTest(NamedTuple):
    """Result of a test: whether a statistic is one that a consistent filter has."""

    statistic: float
    #: Values of the statistic that are accepted.
    interval: Band
    #: nan if the test could not decide.
    p_value: float
    #: Probability of rejecting a consistent filter.
    error_rate: float

    @property
    def accepted(self) -> bool:
        """Whether the test does not reject; a test that cannot decide accepts."""
        return not self.p_value < self.error_rate


class FamilyTest(NamedTuple):
    """Result of one test over a grid of steps, by Holm's method."""

    #: ANEES ratio at each step of the grid, shape (k,).
    statistic: Array
    #: Band that holds all ratios together (Bonferroni).
    interval: Band
    #: Smallest adjusted p-value.
    p_value: float
    #: Whether each step of the grid is rejected, shape (k,).
    rejected: BoolArray
    #: Largest probability of rejecting a consistent filter at any step.
    error_rate: float

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
    part = np.asarray(nis), np.asarray(degrees_of_freedom)
    return nis_test_in_parts(lambda: [part], error_rate=error_rate)


def nis_test_in_parts(parts: Scans, *, error_rate: float = 0.05) -> HypothesisTest:
    """Apply `nis_test` to some runs at a time."""
    total, freedom = 0.0, 0
    for nis, degrees_of_freedom in parts():
        used = degrees_of_freedom > 0
        total += float(one_per_run("nis", nis[used], 0).sum())
        freedom += int(degrees_of_freedom[used].sum())
    if not freedom:
        raise ValueError("degrees_of_freedom must be > 0 at some step, got none")
    return _chi_square_test(total, freedom, error_rate)


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
    _check_lags(lags, np.shape(nis)[-1])
    part = nis, degrees_of_freedom
    return whiteness_test_in_parts(lambda: [part], lags=lags, error_rate=error_rate)


def whiteness_test_in_parts(
    parts: Scans, *, lags: int = 10, error_rate: float = 0.05
) -> HypothesisTest:
    """Apply `whiteness_test` to some runs at a time."""
    test = _ljung_box(*autocorrelation_of_nis(parts, lags=lags))
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


class Band(NamedTuple):
    """Interval that holds a statistic with a stated probability."""

    low: float
    high: float


# --------------------------------------------------------------------------------------
# Tests of the time average of each run's NEES: one independent number per run.
#
# If NEES is correlated over time, the averages are skewed.  The t-test and its interval
# are therefore corrected for skewness by the monotone cubic of [1]_.
#
# References
# ----------
# .. [1] P. Hall, On the removal of skewness by transformation, JRSS B 54(1), 1992.

#: Ratios of NEES to its expectation that count as consistent.
EQUIVALENCE_MARGIN = Band(0.8, 1.25)
# Smallest number of runs with enough different resamples for a bootstrap.
FEWEST_RESAMPLED = 5
_DRAWN = 2**20  # numbers that are drawn together, to limit the memory


class EquivalenceTest(NamedTuple):
    """Result of a test that shows a ratio to be near 1."""

    statistic: float
    #: 90 % confidence interval of the ratio.
    interval: Band
    #: "consistent", "not consistent" or "not shown".
    verdict: str
    #: Probability of "consistent" for a filter at or beyond the margin.
    error_rate: float

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
    ratios, mean, error = _ratios(averages, degrees_of_freedom)
    skewness, runs = _skewness(ratios), len(ratios)
    score = _unskew((mean - 1) / error, skewness, runs) if error else np.inf
    limit = stdtrit(runs - 1, 1 - error_rate / 2)
    ends = 1 + error * _skew(np.array([-limit, limit]), skewness, runs)
    p_value = float(2 * stdtr(runs - 1, -abs(score)))
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
    ratios, mean, error = _ratios(averages, degrees_of_freedom)
    if len(ratios) < FEWEST_RESAMPLED or np.ptp(ratios) == 0:
        return HypothesisTest(mean, Band(-np.inf, np.inf), np.nan, error_rate)
    parts, size = [], max(1, _DRAWN // len(ratios))
    for begin in range(0, resamples, size):
        shape = min(size, resamples - begin), len(ratios)
        drawn = ratios[rng.integers(0, len(ratios), shape)]
        drawn = drawn[np.ptp(drawn, axis=1) > 0]
        errors = drawn.std(axis=1, ddof=1) / np.sqrt(len(ratios))
        parts.append((drawn.mean(axis=1) - mean) / errors)
    scores = np.sort(np.concatenate(parts))
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
    ratios, mean, error = _ratios(averages, degrees_of_freedom)
    limit = stdtrit(len(ratios) - 1, 1 - error_rate)
    ends = _skew(np.array([limit, -limit]), _skewness(ratios), len(ratios))
    interval = to_band(mean - error * ends)
    low, high = EQUIVALENCE_MARGIN
    verdict = "not shown"
    if low <= interval.low and interval.high <= high:
        verdict = "consistent"
    elif interval.high < low or interval.low > high:
        verdict = "not consistent"
    return EquivalenceTest(mean, interval, verdict, error_rate)


def _ratios(averages: Array, degrees_of_freedom: int) -> tuple[Array, float, float]:
    """Return the ratio of each run, and their mean with its standard error."""
    ratios = one_per_run("averages", averages, 2) / degrees_of_freedom
    error = ratios.std(ddof=1) / np.sqrt(len(ratios))
    return ratios, float(ratios.mean()), float(error)


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


class LjungBox(NamedTuple):
    """Result of :func:`ljung_box`."""

    statistic: float
    p_value: float


def autocorrelation(series: Array, *, lags: int) -> tuple[Array, Array]:
    """Return the autocorrelations of several runs together, and their pairs.

    Parameters
    ----------
    series : ndarray, shape (runs, steps)
        One standardised number per step, nan at steps without one.
    lags : int
        Largest lag, < steps.

    Returns
    -------
    correlations, pairs : ndarray, shape (lags,)
        Correlation at lags 1 … ``lags``, and the number of pairs behind each.
    """
    return _autocorrelation(lambda: [series], lags)


def autocorrelation_of_nis(parts: Scans, *, lags: int) -> tuple[Array, Array]:
    """Return the autocorrelations of NIS, transformed by :func:`normal_scores`."""
    return _autocorrelation(lambda: (normal_scores(*part) for part in parts()), lags)


def _autocorrelation(
    parts: Callable[[], Iterable[Array]], lags: int
) -> tuple[Array, Array]:
    """Return the autocorrelations from the series of some runs at a time."""
    total, count = 0.0, 0
    for series in parts():
        values = series[np.isfinite(series)]
        total, count = total + values.sum(), count + len(values)
    squares, shifts = 0.0, range(1, lags + 1)
    pairs, sums = np.zeros(lags), np.zeros(lags)
    for series in parts():
        known = np.isfinite(series)
        centred = np.where(known, series - total / count, 0.0)
        squares += (centred**2).sum()
        pairs += [(known[:, k:] & known[:, :-k]).sum() for k in shifts]
        sums += [(centred[:, k:] * centred[:, :-k]).sum() for k in shifts]
    return sums / np.maximum(pairs, 1) / (squares / count), pairs


def ljung_box(series: Array, *, lags: int = 10) -> LjungBox:
    """Test whether several runs of a standardised series are white.

    ::

        Q = Σₖ Nₖ rₖ²,   rₖ the autocorrelation at lag k of Nₖ pairs:  χ²(lags)

    Parameters
    ----------
    series : ndarray, shape (runs, steps)
        One standardised number per step, nan at steps without one.
    lags : int
        Largest lag, in [1, steps).

    Returns
    -------
    LjungBox

    Raises
    ------
    ValueError
        If there are no more steps than lags.
    """
    _check_lags(lags, series.shape[-1])
    return _ljung_box(*autocorrelation(series, lags=lags))


def _check_lags(lags: int, steps: int) -> None:
    if not 1 <= lags < steps:
        raise ValueError(f"lags must be in [1, {steps}), got {lags}")


def _ljung_box(correlations: Array, pairs: Array) -> LjungBox:
    statistic = float((pairs * correlations**2).sum())
    return LjungBox(statistic, float(chdtrc(len(pairs), statistic)))


def normal_scores(chi_squares: ArrayLike, degrees_of_freedom: ArrayLike) -> Array:
    """Transform chi-square numbers to approximately standard normal ones [1]_.

    Parameters
    ----------
    chi_squares : array_like
        NIS or NEES, each >= 0.
    degrees_of_freedom : array_like, same shape
        n of each.

    Returns
    -------
    ndarray, same shape
        nan at 0 degrees of freedom.

    References
    ----------
    .. [1] E. B. Wilson, M. M. Hilferty, The distribution of chi-square, PNAS 17, 1931.

    Examples
    --------
    >>> normal_scores([7.815, 5.991], [3, 2])  # the 95 % points
    array([1.653..., 1.657...])
    """
    freedom = np.asarray(degrees_of_freedom, dtype=np.float64)
    spread = 2 / (9 * np.maximum(freedom, 1))
    root = np.cbrt(np.asarray(chi_squares) / np.maximum(freedom, 1))
    return np.where(freedom > 0, (root - (1 - spread)) / np.sqrt(spread), np.nan)


def to_band(ends: ArrayLike) -> Band:
    """Return two ends, shape (2,), as a band of ratios, which are >= 0."""
    low, high = np.maximum(ends, 0.0)
    return Band(float(low), float(high))


def chi_square_quantile(probability: ArrayLike, degrees_of_freedom: ArrayLike) -> Array:
    """Return the number that a chi-square number is below with a probability.

    To the bit as ``scipy.stats.chi2.ppf``, which checks its arguments for many times
    as long, and takes a second to import.
    """
    return np.asarray(2 * gammaincinv(np.asarray(degrees_of_freedom) / 2, probability))


def chi_square_limits(degrees_of_freedom: int, tail: float) -> Array:
    """Return the two quantiles that leave the probability ``tail`` on either side."""
    return chi_square_quantile([tail, 1 - tail], degrees_of_freedom)


def average_band(
    runs: int, degrees_of_freedom: int, *, probability: float = 0.95
) -> Band:
    """Return the two-sided interval of the average of ``runs`` chi-square numbers.

    Parameters
    ----------
    runs, degrees_of_freedom : int
        M and n: M times the average is chi-square with M n degrees of freedom.
    probability : float
        Probability of lying inside.

    Raises
    ------
    ValueError
        If a number is not whole or below 1, or the probability not between 0 and 1.

    Examples
    --------
    Bailey's 50 runs of a pose:

    >>> average_band(50, 3)
    Band(low=2.359..., high=3.716...)
    """
    freedom = argument_checks.whole("degrees_of_freedom", degrees_of_freedom, 1)
    freedom *= argument_checks.whole("runs", runs, 1)
    if not 0 < probability < 1:
        raise ValueError(f"probability must be between 0 and 1, got {probability!r}")
    return to_band(chi_square_limits(freedom, (1 - probability) / 2) / runs)


def family_band(
    runs: int, degrees_of_freedom: int, times: int, probability: float = 0.95
) -> Band:
    """Return the band that holds the averages at all ``times`` together.

    Bonferroni: each lies outside with probability (1 − probability) / times.

    Examples
    --------
    >>> family_band(50, 3, 1)
    Band(low=2.359..., high=3.716...)
    """
    return average_band(
        runs, degrees_of_freedom, probability=1 - (1 - probability) / times
    )
