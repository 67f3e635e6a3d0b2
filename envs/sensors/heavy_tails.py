"""Heavy tails: normal noise turned into Student's t, number by number.

The transformation keeps the rank of every number, so a world with heavy tails uses the
random numbers of the same world without them.
"""

import math

import numpy as np

from ...arrays import Array

MANY_STD = 10.0
"""Bound of normal noise in standard deviations; the probability beyond is 1e-23."""


def heavy_tails(unit: Array, degrees: float) -> Array:
    """Turn standard normal numbers into numbers of Student's t distribution.

    ::

        t = F⁻¹(Φ(u)),   F the distribution function of Student's t

    The core keeps the scale of u, so the variance is degrees / (degrees - 2).

    Parameters
    ----------
    unit : ndarray
        u, standard normal.
    degrees : float
        Degrees of freedom, > 2; inf returns `unit` unchanged.

    Examples
    --------
    >>> heavy_tails(np.array([-1.0, 0.0, 3.0]), 4.0).round(3)
    array([-1.142,  0.   ,  6.62 ])
    >>> heavy_tails(np.array([3.0]), np.inf)
    array([3.])
    """
    if math.isinf(degrees):
        return unit
    from scipy.special import ndtr, stdtrit  # noqa: PLC0415 (slow to import)

    tail: Array = stdtrit(degrees, ndtr(-np.abs(unit)))  # exact far out, unlike 1 - p
    return np.copysign(tail, unit)


def largest_noise(degrees: float) -> float:
    """Return the bound of such noise, in the units of `unit`.

    Examples
    --------
    >>> largest_noise(np.inf)
    10.0
    """
    return float(heavy_tails(np.array(MANY_STD), degrees))
