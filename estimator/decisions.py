"""Statistical decisions whose error rate is known, on plain arrays.

Each takes one number per run, or numbers that are white over time, because only these
are independent; see :mod:`.consistency_report` for why NEES is never pooled over time.
NEES ratios are NEES divided by its degrees of freedom: 1 where the claim is true.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2
from scipy.stats import t as student

from . import validation
from .consistency import Array, Band, average_band, ljung_box

EQUIVALENCE_MARGIN = Band(0.8, 1.25)


class Decision(NamedTuple):
    """Whether a statistic lies where it would if the filter were consistent."""

    statistic: float
    interval: Band
    """Values of the statistic that are accepted."""
    p_value: float
    accepted: bool
    error_rate: float
    """Probability of refusing a consistent filter."""


class FamilyDecision(NamedTuple):
    """One decision over a grid of steps, after Holm."""

    statistic: Array
    """ANEES ratio at each step of the grid, shape (k,)."""
    interval: Band
    """The band to draw: all ratios lie inside together (Bonferroni)."""
    p_value: float
    """Smallest p-value, adjusted."""
    rejected: NDArray[np.bool_]
    """Steps of the grid that are refused, shape (k,)."""
    accepted: bool
    error_rate: float
    """Probability of refusing a consistent filter: at most this."""


class Equivalence(NamedTuple):
    """Whether the ratio is shown to be near 1."""

    statistic: float
    interval: Band
    """90 % confidence interval of the ratio."""
    verdict: str
    """"consistent", "not consistent" or "not shown"."""
    accepted: bool
    error_rate: float
    """Probability of "consistent" for a filter at or beyond the margin."""


def final_step_decision(
    nees: Array, degrees_of_freedom: int, *, error_rate: float = 0.05
) -> Decision:
    """Decide on the sum of the last NEES of M runs, exactly χ²(M n); two-sided.

    Parameters
    ----------
    nees : ndarray, shape (M,)
        NEES of independent runs at one step chosen beforehand.
    degrees_of_freedom : int
        n of one NEES.
    error_rate : float
        Probability of refusing a consistent filter.

    Examples
    --------
    >>> final_step_decision(np.full(50, 3.0), 3).accepted
    True
    """
    values = _runs("nees", nees, 1)
    freedom = len(values) * degrees_of_freedom
    return _chi_square(float(values.sum()), freedom, error_rate)


def nis_decision(
    nis: Array, degrees_of_freedom: NDArray[np.int64], *, error_rate: float = 0.05
) -> Decision:
    """Decide on the sum of the NIS of all runs and steps; two-sided.

    Innovations of a consistent filter are white, so NIS may be pooled over time.

    Parameters
    ----------
    nis, degrees_of_freedom : ndarray, shape (M, T)
        Steps with 0 degrees of freedom are left out.
    error_rate : float
        Probability of refusing a consistent filter.
    """
    used = np.asarray(degrees_of_freedom) > 0
    if not used.any():
        raise ValueError("degrees_of_freedom must be > 0 at some step, got none")
    values = _runs("nis", np.asarray(nis)[used], 1)
    freedom = int(np.asarray(degrees_of_freedom)[used].sum())
    return _chi_square(float(values.sum()), freedom, error_rate)


def time_average_decision(
    averages: Array, degrees_of_freedom: int, *, error_rate: float = 0.05
) -> Decision:
    """Decide on the per-run time averages of NEES by a t-test of their mean.

    The averages are skewed where NEES is correlated over time: then the plain t-test
    refuses 8 % at 10 runs and 7.5 % at 20 instead of 5 %.  So t is corrected for
    skewness by the monotone cubic of [1]_, which leaves 5 to 6 %.

    Parameters
    ----------
    averages : ndarray, shape (M,)
        Average NEES of each of M >= 2 runs, not divided by n.
    degrees_of_freedom : int
        n of one NEES.
    error_rate : float
        Probability of refusing a consistent filter.

    References
    ----------
    .. [1] P. Hall, On the removal of skewness by transformation, JRSS B 54(1), 1992.
    """
    ratios = _runs("averages", averages, 2) / degrees_of_freedom
    mean, error = _mean_and_error(ratios)
    skewness, runs = _skewness(ratios), len(ratios)
    score = _unskew((mean - 1) / error, skewness, runs) if error else np.inf
    limit = student.ppf(1 - error_rate / 2, runs - 1)
    ends = 1 + error * _skew(np.array([-limit, limit]), skewness, runs)
    p_value = float(2 * student.sf(abs(score), runs - 1))
    return Decision(mean, _band(ends), p_value, p_value >= error_rate, error_rate)


def bootstrap_decision(
    averages: Array,
    degrees_of_freedom: int,
    *,
    rng: np.random.Generator,
    resamples: int = 1999,
    error_rate: float = 0.05,
) -> Decision:
    """Decide on the per-run time averages by the studentised bootstrap.

    The percentile bootstrap would refuse 9 to 11 % at 20 to 50 runs.

    Parameters
    ----------
    averages, degrees_of_freedom, error_rate
        As in :func:`time_average_decision`.
    rng : numpy.random.Generator
        Draws the resamples.
    resamples : int
        How many.
    """
    ratios = _runs("averages", averages, 2) / degrees_of_freedom
    mean, error = _mean_and_error(ratios)
    drawn = ratios[rng.integers(0, len(ratios), (resamples, len(ratios)))]
    errors = drawn.std(axis=1, ddof=1) / np.sqrt(len(ratios))
    offsets = drawn.mean(axis=1) - mean
    scores = np.sort(offsets / np.maximum(errors, np.finfo(float).tiny))
    score = (mean - 1) / error if error else np.inf
    below = np.searchsorted(scores, score, "right")
    above = resamples - np.searchsorted(scores, score, "left")
    p_value = min(1.0, 2 * (1 + min(below, above)) / (resamples + 1))
    ends = 1 + error * np.quantile(scores, [error_rate / 2, 1 - error_rate / 2])
    return Decision(mean, _band(ends), p_value, p_value >= error_rate, error_rate)


def family_band(
    runs: int, degrees_of_freedom: int, times: int, probability: float = 0.95
) -> Band:
    """Return the band in which the averages at all ``times`` lie together.

    Bonferroni: each outside with probability (1 − probability) / times.

    Examples
    --------
    >>> family_band(50, 3, 1)
    Band(low=2.359..., high=3.716...)
    """
    return average_band(
        runs, degrees_of_freedom, probability=1 - (1 - probability) / times
    )


def family_decision(
    nees: Array, degrees_of_freedom: int, *, error_rate: float = 0.05
) -> FamilyDecision:
    """Decide on the averages at several steps at once, after Holm.

    The error rate is at most the stated one; it is reached where the steps are far
    enough apart to be uncorrelated.

    Parameters
    ----------
    nees : ndarray, shape (M, k)
        NEES of independent runs on a decimated grid of k steps.
    degrees_of_freedom : int
        n of one NEES.
    error_rate : float
        Probability of refusing a consistent filter anywhere.
    """
    values = validation.as_floats("nees", nees)
    runs, times = values.shape
    freedom, totals = runs * degrees_of_freedom, values.sum(axis=0)
    p = 2 * np.minimum(chi2.cdf(totals, freedom), chi2.sf(totals, freedom))
    order = np.argsort(p)
    holm = np.maximum.accumulate(p[order] * np.arange(times, 0, -1))
    rejected = np.zeros(times, dtype=np.bool_)
    rejected[order] = holm < error_rate
    band = family_band(runs, degrees_of_freedom, times, 1 - error_rate)
    return FamilyDecision(
        statistic=totals / freedom,
        interval=_band(np.array(band) / degrees_of_freedom),
        p_value=float(min(1.0, holm[0])),
        rejected=rejected,
        accepted=not rejected.any(),
        error_rate=error_rate,
    )


def whiteness_decision(
    nis: Array,
    degrees_of_freedom: NDArray[np.int64],
    *,
    lags: int = 10,
    error_rate: float = 0.05,
) -> Decision:
    """Decide whether the NIS is white, by Ljung-Box over all runs.

    Each NIS is made about normal by Wilson and Hilferty's cube root first.  NIS is
    quadratic: innovations correlated by ρ show as ρ² here, so this finds gross errors;
    :func:`.consistency.ljung_box` takes normalised innovations where these are at hand.

    Parameters
    ----------
    nis, degrees_of_freedom : ndarray, shape (M, T)
        Steps with 0 degrees of freedom are left out.
    lags : int
        How many autocorrelations are summed.
    error_rate : float
        Probability of refusing white ones.
    """
    freedom = np.asarray(degrees_of_freedom, dtype=np.float64)
    spread = 2 / (9 * np.maximum(freedom, 1))
    root = np.cbrt(np.asarray(nis) / np.maximum(freedom, 1))
    scores = np.where(freedom > 0, (root - (1 - spread)) / np.sqrt(spread), np.nan)
    test = ljung_box(scores, lags=lags)
    limit = float(chi2.ppf(1 - error_rate, lags))
    accepted = test.p_value >= error_rate
    return Decision(
        test.statistic, Band(0.0, limit), test.p_value, accepted, error_rate
    )


def equivalence_decision(
    averages: Array, degrees_of_freedom: int, *, error_rate: float = 0.05
) -> Equivalence:
    """Decide whether the mean ratio is shown to lie inside [.8, 1.25].

    Parameters
    ----------
    averages, degrees_of_freedom
        As in :func:`time_average_decision`, whose interval this uses.
    error_rate : float
        Of claiming consistency at the margin; the interval has twice as much outside.
    """
    ratios = _runs("averages", averages, 2) / degrees_of_freedom
    mean, error = _mean_and_error(ratios)
    limit = student.ppf(1 - error_rate, len(ratios) - 1)
    ends = _skew(np.array([limit, -limit]), _skewness(ratios), len(ratios))
    interval = _band(mean - error * ends)
    low, high = EQUIVALENCE_MARGIN
    verdict = "not shown"
    if low <= interval.low and interval.high <= high:
        verdict = "consistent"
    elif interval.high < low or interval.low > high:
        verdict = "not consistent"
    return Equivalence(mean, interval, verdict, verdict == "consistent", error_rate)


def runs_to_detect(
    factor: float,
    degrees_of_freedom: int,
    *,
    power: float = 0.9,
    error_rate: float = 0.05,
) -> int:
    """Return how many runs the final step needs to find covariances too small.

    Parameters
    ----------
    factor : float
        By which they are too small, > 0 and not 1.
    degrees_of_freedom : int
        n of one NEES.
    power : float
        Probability of finding it.
    error_rate : float
        Of the decision.

    Examples
    --------
    >>> [runs_to_detect(factor, 3) for factor in (1.1, 1.2, 1.5)]
    [767, 209, 42]
    """
    if validation.above("factor", factor, 0) == 1:
        raise ValueError("factor must differ from 1, got 1")

    def found(runs: int) -> bool:
        low, high = _limits(runs * degrees_of_freedom, error_rate) / factor
        freedom = runs * degrees_of_freedom
        return bool(chi2.cdf(low, freedom) + chi2.sf(high, freedom) >= power)

    most = 1
    while not found(most):
        most *= 2
    least = most // 2
    while most - least > 1:
        middle = (least + most) // 2
        least, most = (least, middle) if found(middle) else (middle, most)
    return most


def _chi_square(total: float, freedom: int, error_rate: float) -> Decision:
    p_value = float(2 * min(chi2.cdf(total, freedom), chi2.sf(total, freedom)))
    interval = _band(_limits(freedom, error_rate) / freedom)
    accepted = p_value >= error_rate
    return Decision(total / freedom, interval, p_value, accepted, error_rate)


def _limits(freedom: int, error_rate: float) -> Array:
    return np.asarray(chi2.ppf([error_rate / 2, 1 - error_rate / 2], freedom))


def _band(ends: Array) -> Band:
    return Band(float(ends[0]), float(ends[1]))


def _runs(name: str, values: Array, least: int) -> Array:
    """Return one finite number per run, at least so many, or refuse them."""
    array = validation.as_floats(name, values)
    if array.ndim != 1 or len(array) < least or not np.isfinite(array).all():
        raise ValueError(
            f"{name} must be at least {least} finite numbers, one per run, "
            f"got shape {array.shape}"
        )
    return array


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
    """Undo :func:`_unskew`."""
    c = skewness / np.sqrt(runs)
    if abs(c) < 1e-9:
        return scores
    return np.asarray(3 / c * (np.cbrt(1 + c * (scores - c / 6)) - 1))
