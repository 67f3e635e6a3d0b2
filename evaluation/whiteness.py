"""Whiteness of innovations: autocorrelations and the Ljung-Box test."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import chdtrc

from ..arrays import Array


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
    known = np.isfinite(series)
    centred = np.where(known, series - np.mean(series[known]), 0.0)
    power = (centred**2).sum() / known.sum()
    shifts = range(1, lags + 1)
    pairs = np.array([(known[:, k:] & known[:, :-k]).sum() for k in shifts], float)
    sums = np.array([(centred[:, k:] * centred[:, :-k]).sum() for k in shifts])
    return sums / np.maximum(pairs, 1) / power, pairs


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
    if not 1 <= lags < series.shape[-1]:
        raise ValueError(f"lags must be in [1, {series.shape[-1]}), got {lags}")
    correlations, pairs = autocorrelation(series, lags=lags)
    statistic = float((pairs * correlations**2).sum())
    return LjungBox(statistic, float(chdtrc(lags, statistic)))


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
