"""Statistical decisions whose error rate is known, on plain arrays.

Each takes one number per run, or numbers that are white over time, because only these
are independent; see :mod:`.consistency_report` for why NEES is never pooled over time.
NEES ratios are NEES divided by its degrees of freedom: 1 where the claim is true.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.stats import chi2

from ..estimator.support import argument_checks
from .nees import Array, Band, average_band, ljung_box


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
    values = one_per_run("nees", nees, 1)
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
    values = one_per_run("nis", np.asarray(nis)[used], 1)
    freedom = int(np.asarray(degrees_of_freedom)[used].sum())
    return _chi_square(float(values.sum()), freedom, error_rate)


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
    values = argument_checks.as_floats("nees", nees)
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
        interval=to_band(np.array(band) / degrees_of_freedom),
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

    Each NIS is made about normal first, see :func:`normal_scores`.  NIS is quadratic:
    innovations correlated by ρ show as ρ² here, so this finds gross errors;
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
    test = ljung_box(normal_scores(nis, degrees_of_freedom), lags=lags)
    limit = float(chi2.ppf(1 - error_rate, lags))
    accepted = test.p_value >= error_rate
    return Decision(
        test.statistic, Band(0.0, limit), test.p_value, accepted, error_rate
    )


def normal_scores(
    chi_squares: ArrayLike, degrees_of_freedom: ArrayLike
) -> NDArray[np.float64]:
    """Make chi-square numbers about standard normal by a cube root [1]_.

    Parameters
    ----------
    chi_squares : array_like
        Each >= 0, as NIS or NEES.
    degrees_of_freedom : array_like, of the same shape
        n of each.

    Returns
    -------
    ndarray, of the same shape
        nan where there are 0 degrees of freedom.

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
    if argument_checks.above("factor", factor, 0) == 1:
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
    interval = to_band(_limits(freedom, error_rate) / freedom)
    accepted = p_value >= error_rate
    return Decision(total / freedom, interval, p_value, accepted, error_rate)


def _limits(freedom: int, error_rate: float) -> Array:
    return np.asarray(chi2.ppf([error_rate / 2, 1 - error_rate / 2], freedom))


def to_band(ends: Array) -> Band:
    """Return two ends, shape (2,), as a band."""
    return Band(float(ends[0]), float(ends[1]))


def one_per_run(name: str, values: Array, least: int) -> Array:
    """Return one finite number per run, at least so many, or refuse them."""
    array = argument_checks.as_floats(name, values)
    if array.ndim != 1 or len(array) < least or not np.isfinite(array).all():
        raise ValueError(
            f"{name} must be at least {least} finite numbers, one per run, "
            f"got shape {array.shape}"
        )
    return array
