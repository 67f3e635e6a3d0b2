"""Statistics over the finite entries of arrays; None where there is none."""

import math

import numpy as np

from ...arrays import AnyArray


def finite(value: float) -> float | None:
    """Return a number, or None for nan and infinity, which JSON does not know."""
    return float(value) if math.isfinite(value) else None


def mean(values: AnyArray) -> float | None:
    """Average over the entries that are finite.

    Examples
    --------
    >>> mean(np.array([1.0, np.nan, 2.0])), mean(np.array([np.nan]))
    (1.5, None)
    """
    known = np.asarray(values)[np.isfinite(values)]
    return finite(known.mean()) if len(known) else None


def root_mean_square(values: AnyArray) -> float | None:
    """Take the root of the mean square of the entries that are finite."""
    with np.errstate(over="ignore"):
        square = mean(np.asarray(values) ** 2)
    return None if square is None else math.sqrt(square)


def quotient(values: AnyArray, freedom: AnyArray) -> float | None:
    """Divide sums, over the entries whose value is finite.

    Parameters
    ----------
    values, freedom : ndarray, of the same shape
        Chi-square numbers and their degrees of freedom.
    """
    known = np.isfinite(values)
    total = freedom[known].sum()
    return finite(values[known].sum() / total) if total else None


def standard_error(values: AnyArray) -> float | None:
    """Return the standard error of the mean, s / √M; None for fewer than two.

    Examples
    --------
    >>> standard_error(np.array([1.0, 3.0])), standard_error(np.array([1.0]))
    (1.0, None)
    """
    count = len(values)
    return finite(values.std(ddof=1) / math.sqrt(count)) if count > 1 else None
