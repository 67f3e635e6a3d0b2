"""Tests that may be looked at after every run, with error rates that hold at all looks.

A test with a fixed number of runs loses its error rate if more runs are added until it
decides. An e-process does not. It is a product of likelihood ratios, at least 0 and 1
on average if the filter is consistent, so that it ever reaches 1/α with a probability
of at most α, however long one waits [1]_ [2]_ [3]_. :class:`EProcess` and
:class:`MeanEProcess` reject, and :class:`ConfidenceSequence` shows that a ratio is near
1; the latter is asymptotic [4]_ and must not reject.

References
----------
.. [1] J. Ville, Étude critique de la notion de collectif, 1939.
.. [2] S. R. Howard, A. Ramdas, J. McAuliffe, J. Sekhon, Time-uniform, nonparametric,
   nonasymptotic confidence sequences, Annals of Statistics 49(2), 2021.
.. [3] A. Ramdas, P. Grünwald, V. Vovk, G. Shafer, Game-theoretic statistics and safe
   anytime-valid inference, Statistical Science 38(4), 2023.
.. [4] I. Waudby-Smith, D. Arbour, R. Sinha, E. H. Kennedy, A. Ramdas, Time-uniform
   central limit theory and asymptotic confidence sequences, 2021 (arXiv:2103.06476).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import logsumexp

from ..arrays import Array

#: Factors c by which squared errors may differ, each of equal weight.
SCALES = np.delete(np.geomspace(0.3, 20.0, 43), 12)
#: Lengths m of mean errors, in standard deviations, and number of their directions.
MEANS, _DIRECTIONS = np.array([0.5, 1.0, 2.0, 4.0]), 8
#: Number of runs below which a confidence sequence shows nothing.
FEWEST_SHOWN = 30
#: Rate of both ends together. Each end then stays below 5 % also for the skewed
#: averages of NEES, for which the asymptotic rate is exceeded.
SHOWN_ERROR_RATE = 0.07
_LARGEST_LOG = 700.0
_SQUARED_RHO = 0.1  # narrowest after about 70 runs


class _Mixture:
    """Average of products of likelihood ratios, which is 1 before the first run."""

    def __init__(self) -> None:
        self._logs: Array | None = None

    def _multiplied(self, gains: Array) -> Array:
        """Multiply by likelihood ratios of M runs, and return log e after each of them.

        Parameters
        ----------
        gains : ndarray, shape (M, k, c)
            Their logarithms, for k sums of evidence and c alternatives; overwritten.
        """
        if self._logs is not None and len(gains):
            gains[0] += self._logs
        logs = np.cumsum(gains, axis=0, out=gains)
        if len(gains):
            self._logs = logs[-1].copy()  # a view would keep all of them
        flat = logs.reshape(len(gains), -1)
        top = flat.max(axis=1, initial=-np.inf)
        flat -= top[:, None]
        return np.asarray(top + np.log(np.exp(flat, out=flat).mean(axis=1)))


class EProcess(_Mixture):
    """Evidence against χ² distributed NEES at some steps, after each of many runs.

    ::

        eₖ(M) = mean over c of Πᵢ c^(−nᵢₖ/2) exp(−xᵢₖ (1/c − 1) / (2 r)),   i = 1 … M
        e(M)  = mean over k of eₖ(M)

    xᵢₖ is the NEES of run i at step k, with nᵢₖ degrees of freedom. Each factor is the
    ratio of the densities of r c χ²(n) and r χ²(n). Runs must be independent. Steps may
    be correlated in any way, because an average of e-processes is one.

    Parameters
    ----------
    margin : (float, float)
        Ratios that are no reason to reject: r is the larger one for c > 1, the smaller
        one for c < 1. The average of each factor is then at most 1 for all NEES that
        are distributed as χ² times a ratio inside the margin.
    """

    def __init__(self, margin: tuple[float, float] = (1.0, 1.0)) -> None:
        super().__init__()
        low, high = margin
        self._slopes = (1 / SCALES - 1) / np.where(SCALES > 1, high, low)

    def update(self, nees: ArrayLike, degrees_of_freedom: ArrayLike) -> Array:
        """Add runs, and return log e after each of them.

        Parameters
        ----------
        nees : array_like, shape (M, k)
            NEES of M runs at k steps that are chosen beforehand.
        degrees_of_freedom : array_like
            One number, one per run, shape (M,), or one per NEES, shape (M, k). A NEES
            with 0 degrees of freedom adds no evidence.

        Returns
        -------
        ndarray, shape (M,)
            The same, to the bit, whether runs are added at once or one by one.

        Examples
        --------
        >>> EProcess().update([[3.0], [30.0], [30.0]], 3).round(1)
        array([-0.7,  7.3, 17. ])
        """
        values = np.asarray(nees, dtype=np.float64)
        if values.ndim != 2 or not np.isfinite(values).all():
            raise ValueError(
                "nees must be finite numbers of shape (runs, steps), "
                f"got shape {values.shape}"
            )
        if self._logs is not None and values.shape[1] != len(self._logs):
            raise ValueError(
                f"nees must have the {len(self._logs)} steps of earlier runs, "
                f"got {values.shape[1]}"
            )
        freedom = np.asarray(degrees_of_freedom)
        if freedom.ndim < 2:
            freedom = np.broadcast_to(freedom, len(values))[:, None]
        gains = np.where(freedom > 0, values, 0.0)[:, :, None] * self._slopes
        gains += freedom[:, :, None] * np.log(SCALES)
        gains *= -0.5
        return self._multiplied(gains)


class MeanEProcess(_Mixture):
    """Evidence that mean errors are not about 0, after each of many runs.

    ::

        eₖ(M) = mean over u, m of Πᵢ exp(((m − δ) u·wᵢₖ − (m² − δ²) / 2) / v)
        e(M)  = mean over k of eₖ(M)

    wᵢₖ is the whitened error (2 numbers) of landmark k in run i. Each factor is the
    ratio of the densities of N(m, v) and N(δ, v) of an error in the direction u. Its
    average is at most 1 if the mean error is at most δ, and the variance at most v.

    Parameters
    ----------
    largest_mean : float
        δ, largest length of a mean error that is no reason to reject, in standard
        deviations.
    largest_variance : float
        v, largest variance of a whitened error that is no reason to reject.
    """

    def __init__(self, largest_mean: float, largest_variance: float) -> None:
        super().__init__()
        angles = 2 * np.pi * np.arange(_DIRECTIONS) / _DIRECTIONS
        toward = np.array([np.cos(angles), np.sin(angles)])  # (2, directions)
        over = (MEANS - largest_mean) / largest_variance
        self._slopes = (toward[:, :, None] * over).reshape(2, -1)
        offsets = (MEANS**2 - largest_mean**2) / (2 * largest_variance)
        self._offsets = np.tile(offsets, _DIRECTIONS)

    def update(self, errors: ArrayLike) -> Array:
        """Add runs, and return log e after each of them.

        Parameters
        ----------
        errors : array_like, shape (M, k, 2)
            Whitened errors of k landmarks in M runs; nan adds no evidence.

        Returns
        -------
        ndarray, shape (M,)

        Examples
        --------
        >>> errors = [[[1.0, 0.0]], [[np.nan, np.nan]], [[3.0, -0.5]]]
        >>> MeanEProcess(0.25, 1.25).update(errors).round(1)
        array([-0.7, -0.7,  0.1])
        """
        values = np.asarray(errors, dtype=np.float64)
        gains = values @ self._slopes - self._offsets
        return self._multiplied(np.where(np.isnan(gains), 0.0, gains))


def average_of(logs: Sequence[Array], weights: Sequence[float] | None = None) -> Array:
    """Average e-processes, which gives an e-process whatever their correlation.

    Parameters
    ----------
    logs : sequence of ndarray
        log e of each after every run, of one shape.
    weights : sequence of float, optional
        They sum to 1; equal by default.

    Examples
    --------
    >>> average_of([np.log([1.0, 4.0]), np.log([3.0, 2.0])]).round(3)
    array([0.693, 1.099])
    """
    shares = np.full(len(logs), 1 / len(logs)) if weights is None else weights
    return np.asarray(logsumexp(np.asarray(logs).T, axis=-1, b=np.asarray(shares)).T)


class ConfidenceSequence:
    """Intervals of the mean of positive numbers, which hold together after every run.

    ::

        μ exp(± h / μ),   h = σ √(2 (M ρ² + 1) / (M² ρ²) · log(√(M ρ² + 1) / α))

    with mean μ and deviation σ of M numbers; μ ± h is that of Waudby-Smith et al. On a
    log scale, both ends have the same error rate, because the deviation of NEES grows
    with its mean. The intervals hold asymptotically: below
    `FEWEST_SHOWN` runs they are [0, ∞].
    """

    def __init__(self, error_rate: float = SHOWN_ERROR_RATE) -> None:
        self._error_rate = error_rate
        self._sums = np.zeros((1, 3))

    def update(self, ratios: ArrayLike) -> tuple[Array, Array]:
        """Add one number of each of M runs, and return both ends after each of them.

        Parameters
        ----------
        ratios : array_like, shape (M,)
            For example time averages of NEES, divided by the degrees of freedom.

        Returns
        -------
        low, high : ndarray, shape (M,)
        """
        values = np.asarray(ratios, dtype=np.float64)
        if values.ndim != 1 or not np.all((values >= 0) & np.isfinite(values)):
            raise ValueError(
                "ratios must be finite numbers >= 0 of shape (runs,), "
                f"got shape {values.shape}"
            )
        powers = np.stack([np.ones_like(values), values, values**2], axis=1)
        sums = np.cumsum(np.concatenate([self._sums, powers]), axis=0)
        self._sums = sums[-1:].copy()
        runs, total, squares = sums[1:].T
        mean = total / runs
        variance = np.maximum(squares / runs - mean**2, 0.0)
        grown = runs * _SQUARED_RHO + 1
        spread = 2 * grown / (runs**2 * _SQUARED_RHO)
        spread *= np.log(np.sqrt(grown) / self._error_rate)
        low, high = np.zeros_like(mean), np.full_like(mean, np.inf)
        known = (runs >= FEWEST_SHOWN) & (mean > 0)
        half = np.sqrt(variance * spread)[known] / mean[known]
        low[known] = mean[known] * np.exp(-half)
        high[known] = mean[known] * np.exp(np.minimum(half, _LARGEST_LOG))
        return low, high
