"""Is a filter as good as it says?  NEES of poses, headings and maps; NIS; their bands.

NEES = eᵀ P⁻¹ e of an error e with claimed covariance P: chi-square with as many degrees
of freedom as e has entries, if the claim is true.  Averages over runs (ANEES) are not
divided by the dimension unless the name says so.  The frame of an error, additive or
invariant (:mod:`.error_frames`), is always named: where the heading is uncertain the
additive NEES rejects even the right filter.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from .error_frames import (
    ErrorFrame,
    additive_error,
    invariant_covariance,
    invariant_error,
)

Array = NDArray[np.float64]


class Band(NamedTuple):
    """Interval in which an average lies with the stated probability."""

    low: float
    high: float


def normalised_squared_error(errors: Array, covariances: Array) -> Array:
    """Return eᵀ P⁻¹ e over any leading axes.

    Parameters
    ----------
    errors : ndarray, shape (..., n)
    covariances : ndarray, shape (..., n, n)

    Returns
    -------
    ndarray, shape (...)
        nan where a covariance is singular or anything is nan.

    Examples
    --------
    >>> normalised_squared_error(np.array([[2.0, 0.0]]), np.array([np.eye(2) * 4]))
    array([1.])
    """
    usable = np.asarray(np.isfinite(covariances).all(axis=(-2, -1)))
    safe = np.where(usable[..., None, None], covariances, np.eye(errors.shape[-1]))
    try:
        weighted = np.linalg.solve(safe, errors[..., None])[..., 0]
    except np.linalg.LinAlgError:
        weighted = (np.linalg.pinv(safe) @ errors[..., None])[..., 0]
        usable = usable & (np.linalg.matrix_rank(safe) == errors.shape[-1])
    return np.where(usable, (errors * weighted).sum(axis=-1), np.nan)


def pose_nees(
    true_poses: Array, poses: Array, covariances: Array, *, frame: ErrorFrame
) -> Array:
    """Return the NEES of poses in a named error frame, 3 degrees of freedom.

    Parameters
    ----------
    true_poses, poses : ndarray, shape (..., 3)
        True and estimated (x, y, θ) [m, m, rad].
    covariances : ndarray, shape (..., 3, 3)
        Claimed covariances of the additive error.
    frame : {"additive", "invariant"}
        Error coordinates.

    Returns
    -------
    ndarray, shape (...)
    """
    if frame == "invariant":
        errors = invariant_error(true_poses, poses)
        return normalised_squared_error(
            errors, invariant_covariance(poses, covariances)
        )
    return normalised_squared_error(additive_error(true_poses, poses), covariances)


def heading_nees(true_poses: Array, poses: Array, covariances: Array) -> Array:
    """Return the NEES of headings, 1 degree of freedom, the same in either frame.

    Parameters
    ----------
    true_poses, poses, covariances
        As in :func:`pose_nees`.
    """
    errors = additive_error(true_poses, poses)[..., 2]
    return np.asarray(errors**2 / covariances[..., 2, 2])


def average_band(
    runs: int, degrees_of_freedom: int, *, probability: float = 0.95
) -> Band:
    """Return the interval of the average of ``runs`` chi-squares, two-sided.

    Parameters
    ----------
    runs, degrees_of_freedom : int
        M and n: M times the average is chi-square with M n degrees of freedom.
    probability : float
        Of lying inside.

    Examples
    --------
    Bailey's 50 runs of a pose:

    >>> average_band(50, 3)
    Band(low=2.359..., high=3.716...)
    """
    tail = (1 - probability) / 2
    freedom = runs * degrees_of_freedom
    low, high = chi2.ppf([tail, 1 - tail], freedom) / runs
    return Band(float(low), float(high))
