"""Chi-square bands: where averages of NEES and NIS lie if a filter is consistent."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import gammaincinv

from ..arrays import Array


class Band(NamedTuple):
    """Interval that holds a statistic with a stated probability."""

    low: float
    high: float


def to_band(ends: ArrayLike) -> Band:
    """Return two ends, shape (2,), as a band."""
    low, high = np.asarray(ends)
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

    Examples
    --------
    Bailey's 50 runs of a pose:

    >>> average_band(50, 3)
    Band(low=2.359..., high=3.716...)
    """
    tail = (1 - probability) / 2
    return to_band(chi_square_limits(runs * degrees_of_freedom, tail) / runs)


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
