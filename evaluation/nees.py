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
from scipy.linalg.lapack import dpotrf, dtrtrs
from scipy.stats import chi2

from ..estimator.error_frames import (
    ErrorFrame,
    additive_error,
    invariant_covariance,
    invariant_error,
)

Array = NDArray[np.float64]

SINGULAR = 1e-10
"""A variance, given the entries before it, that counts as zero beside its own."""

_FEW = 4  # so small covariances are factored side by side


class LjungBox(NamedTuple):
    """Test of whiteness."""

    statistic: float
    p_value: float


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
    std = np.sqrt(np.maximum(np.diagonal(covariances, axis1=-2, axis2=-1), 0.0))
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        scaled = errors / std
        correlations = covariances / std[..., :, None] / std[..., None, :]
        whiten = _whiten_few if errors.shape[-1] <= _FEW else _whiten_each
        white = whiten(scaled, correlations)
        return np.asarray((white**2).sum(axis=-1))


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
    return normalised_squared_error(*_in_frame(true_poses, poses, covariances, frame))


def heading_nees(true_poses: Array, poses: Array, covariances: Array) -> Array:
    """Return the NEES of headings, 1 degree of freedom, the same in either frame.

    Parameters
    ----------
    true_poses, poses, covariances
        As in :func:`pose_nees`.
    """
    errors = additive_error(true_poses, poses)[..., 2]
    return np.asarray(errors**2 / covariances[..., 2, 2])


def position_nees(
    true_poses: Array, poses: Array, covariances: Array, *, frame: ErrorFrame
) -> Array:
    """Return the NEES of robot positions, 2 degrees of freedom.

    Parameters
    ----------
    true_poses, poses, covariances, frame
        As in :func:`pose_nees`.
    """
    errors, claimed = _in_frame(true_poses, poses, covariances, frame)
    return normalised_squared_error(errors[..., :2], claimed[..., :2, :2])


def state_nees(
    true_states: Array, means: Array, covariances: Array, *, frame: ErrorFrame
) -> Array:
    """Return the NEES of whole states, 3 + 2n degrees of freedom.

    Parameters
    ----------
    true_states, means : ndarray, shape (..., 3 + 2n)
        True and estimated (x, y, θ, l1x, l1y, …) [m, rad].
    covariances : ndarray, shape (..., 3 + 2n, 3 + 2n)
        Claimed covariances of the additive error.
    frame : {"additive", "invariant"}
        Error coordinates.

    Returns
    -------
    ndarray, shape (...)
    """
    errors, claimed = _in_frame(true_states, means, covariances, frame)
    return normalised_squared_error(errors, claimed)


def landmark_nees(
    true_states: Array, means: Array, covariances: Array, *, frame: ErrorFrame
) -> Array:
    """Return the NEES of each landmark, 2 degrees of freedom.

    Parameters
    ----------
    true_states, means, covariances, frame
        As in :func:`state_nees`.

    Returns
    -------
    ndarray, shape (..., n)
    """
    errors, claimed = _in_frame(true_states, means, covariances, frame)
    rows = np.arange(3, errors.shape[-1]).reshape(-1, 2)
    blocks = claimed[..., rows[:, :, None], rows[:, None, :]]
    return normalised_squared_error(errors[..., rows], blocks)


def relative_map_nees(true_states: Array, means: Array, covariances: Array) -> Array:
    """Return the NEES of the map as the robot sees it, 2n degrees of freedom.

    ::

        m = R(θ)ᵀ (l − p),   ∂m/∂θ = −J m,   J = [0 −1; 1 0]

    The frame is the robot's own, which no turn or shift of the whole world changes.

    Parameters
    ----------
    true_states, means, covariances
        As in :func:`state_nees`.

    Returns
    -------
    ndarray, shape (...)
    """
    seen = _seen_from_robot(means)
    errors = _seen_from_robot(true_states) - seen
    n = errors.shape[-1] // 2
    cos, sin = np.cos(means[..., 2]), np.sin(means[..., 2])
    turn = np.stack([cos, sin, -sin, cos], axis=-1).reshape(*cos.shape, 2, 2)
    jacobian = np.zeros((*cos.shape, 2 * n, 3 + 2 * n))
    for row in range(0, 2 * n, 2):
        jacobian[..., row : row + 2, :2] = -turn
        jacobian[..., row : row + 2, 3 + row : 5 + row] = turn
    jacobian[..., 0::2, 2] = seen[..., 1::2]
    jacobian[..., 1::2, 2] = -seen[..., 0::2]
    claimed = jacobian @ covariances @ np.swapaxes(jacobian, -1, -2)
    return normalised_squared_error(errors, claimed)


def autocorrelation(series: Array, *, lags: int) -> tuple[Array, Array]:
    """Return the autocorrelations of several runs together, and their pairs.

    Parameters
    ----------
    series : ndarray, shape (runs, steps)
        One standardised number per step, nan where there is none.
    lags : int
        Largest lag, < steps.

    Returns
    -------
    correlations, pairs : ndarray, shape (lags,)
        At lags 1 … ``lags``, and the number of pairs each is made of.
    """
    known = np.isfinite(series)
    centred = np.where(known, series - np.mean(series[known]), 0.0)
    power = (centred**2).sum() / known.sum()
    pairs = np.array(
        [(known[:, k:] & known[:, :-k]).sum() for k in range(1, lags + 1)], dtype=float
    )
    sums = np.array(
        [(centred[:, k:] * centred[:, :-k]).sum() for k in range(1, lags + 1)]
    )
    return sums / np.maximum(pairs, 1) / power, pairs


def ljung_box(series: Array, *, lags: int = 10) -> LjungBox:
    """Test whether several runs of a standardised series are white.

    ::

        Q = Σₖ Nₖ rₖ²,   rₖ the autocorrelation at lag k of Nₖ pairs:  χ²(lags)

    Parameters
    ----------
    series : ndarray, shape (runs, steps)
        One standardised number per step, nan where there is none.
    lags : int
        Largest lag, in [1, steps).

    Returns
    -------
    LjungBox

    Raises
    ------
    ValueError
        Where there are fewer steps than lags.
    """
    if not 1 <= lags < series.shape[-1]:
        raise ValueError(f"lags must be in [1, {series.shape[-1]}), got {lags}")
    correlations, pairs = autocorrelation(series, lags=lags)
    statistic = float((pairs * correlations**2).sum())
    return LjungBox(statistic, float(chi2.sf(statistic, lags)))


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


def _whiten_few(errors: Array, correlations: Array) -> Array:
    """Solve L w = e, C = L Lᵀ, entry by entry over all leading axes at once.

    Each entry costs a few operations on whole arrays, which have the same bits whatever
    stands beside it.
    """
    n = errors.shape[-1]
    white = np.empty(errors.shape)
    factor = np.empty(correlations.shape)
    for j in range(n):
        left = correlations[..., j, j].copy()
        rest = errors[..., j].copy()
        for k in range(j):
            left -= factor[..., j, k] ** 2
            rest -= factor[..., j, k] * white[..., k]
        pivot = np.sqrt(np.where(left > SINGULAR, left, np.nan))
        white[..., j] = rest / pivot
        for i in range(j + 1, n):
            entry = correlations[..., i, j].copy()
            for k in range(j):
                entry -= factor[..., i, k] * factor[..., j, k]
            factor[..., i, j] = entry / pivot
    return white


def _whiten_each(errors: Array, correlations: Array) -> Array:
    """Solve L w = e, C = L Lᵀ, one after the other; nan where C is singular."""
    n = errors.shape[-1]
    white = np.full((errors[..., 0].size, n), np.nan)
    pairs = zip(errors.reshape(-1, n), correlations.reshape(-1, n, n), strict=True)
    for index, (error, correlation) in enumerate(pairs):
        if np.isfinite(correlation).all() and np.isfinite(error).all():
            factor, failed = dpotrf(correlation, lower=1)
            if not failed and (np.diagonal(factor) ** 2 > SINGULAR).all():
                white[index] = dtrtrs(factor, error, lower=1)[0]
    return white.reshape(errors.shape)


def _in_frame(
    true_states: Array, means: Array, covariances: Array, frame: ErrorFrame
) -> tuple[Array, Array]:
    """Errors and their claimed covariances in a named frame."""
    if frame == "invariant":
        errors = invariant_error(true_states, means)
        return errors, invariant_covariance(means, covariances)
    return additive_error(true_states, means), covariances


def _seen_from_robot(states: Array) -> Array:
    """Landmarks in the robot's frame, shape (..., 2n)."""
    dx, dy = states[..., 3::2] - states[..., :1], states[..., 4::2] - states[..., 1:2]
    cos, sin = np.cos(states[..., 2:3]), np.sin(states[..., 2:3])
    pairs = np.stack([cos * dx + sin * dy, cos * dy - sin * dx], axis=-1)
    return np.asarray(pairs.reshape(*dx.shape[:-1], -1))
