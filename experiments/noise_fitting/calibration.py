"""Calibrate the noise of a sensor with the true path."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ...arrays import Array
from ...estimator.models.rigid_motion import ErrorFrame
from ...evaluation.hypothesis_tests import chi_square_quantile
from ...evaluation.nees import pose_nees
from ..logs.ground_truth import true_poses_of
from ..logs.slamlog import SlamLog
from .inflation import positive_sum
from .likelihood import LogLikelihood
from .noise_vector import BEARING

TAILS = (0.025, 0.975)
FACTORS = np.geomspace(0.25, 16.0, 19)


class Calibration(NamedTuple):
    """The factor of the sensor's noise at which the pose NEES is as expected."""

    factor: float
    low: float
    """Of its 95 % interval."""
    high: float


def calibrate(
    likelihood: LogLikelihood, log: SlamLog, times: Array, noise: Array
) -> Calibration | None:
    """Return the factor of the sensor's noise at which NEES has its expected value.

    The mean NEES of one drive has a large variance, because successive steps are
    correlated. The interval holds the factors whose mean NEES is within `nees_bounds`.

    Parameters
    ----------
    likelihood : LogLikelihood
        Of the log.
    log : SlamLog
        With its truth, if that is known.
    times : ndarray, shape (S,)
        Of the steps.
    noise : ndarray, shape (7,)
        The noise whose sensor part is multiplied.

    Returns
    -------
    Calibration or None
        Where the mean NEES of the pose is 1 per degree of freedom; the nearest factor
        that was tried where there is none.  None where the true poses are unknown.
    """
    truth = true_poses_of(log, times)
    if truth is None or not np.isfinite(truth).all(axis=1).any():
        return None
    noises = np.tile(noise, (len(FACTORS), 1))
    noises[:, BEARING:] *= FACTORS[:, None]
    whole = replace(likelihood, most_landmarks=len(likelihood.events.readings))
    record = whole.record(noises)
    frame = likelihood.filter.frame
    nees = [
        _known_nees(truth, poses, covariances, frame)
        for poses, covariances in zip(
            record.poses, record.pose_covariances, strict=True
        )
    ]
    usable = [k for k, values in enumerate(nees) if values.sum() > 0]
    if not usable:
        return None
    ratios = np.array([nees[k].mean() / 3 for k in usable])
    bounds = np.array([nees_bounds(nees[k]) for k in usable])
    factors = np.log(FACTORS[usable])
    return Calibration(
        _crossing(factors, np.log(ratios)),
        _crossing(factors, np.log(ratios / bounds[:, 1])),
        _crossing(factors, np.log(ratios / bounds[:, 0])),
    )


def _known_nees(
    truth: Array, poses: Array, covariances: Array, frame: ErrorFrame
) -> Array:
    with np.errstate(invalid="ignore", divide="ignore"):
        values = pose_nees(truth, poses, covariances, frame=frame)
    return values[np.isfinite(values)]


def nees_bounds(nees: Array) -> tuple[float, float]:
    """Return the 95 % interval of the mean NEES per degree if the noise is right.

    It is that of χ²(ν)/ν, with ν ≥ 3 and the autocorrelations about the expected mean
    and variance of the NEES of a pose, 3 and 6::

        ν = 3N / (1 + 2 Σ ρ_k),    ρ_k = Σ_t (ε_t − 3)(ε_{t+k} − 3) / 6N

    About its own mean, a constant series would look white.

    Parameters
    ----------
    nees : ndarray, shape (N,)
        Of one drive, step after step.
    """
    excess = nees - 3
    spectrum = np.abs(np.fft.rfft(excess, 2 * len(nees))) ** 2
    products = np.fft.irfft(spectrum, 2 * len(nees))[1 : len(nees) // 2]
    together = 1 + 2 * positive_sum(products / (6 * len(nees)))
    degrees = max(3.0, 3 * len(nees) / together)
    low, high = chi_square_quantile(TAILS, degrees) / degrees
    return float(low), float(high)


def _crossing(factors: Array, ratios: Array) -> float:
    """Return the factor at which decreasing ratios first reach 1, from logarithms."""
    below = np.flatnonzero(ratios <= 0)
    if not len(below):
        return float(np.exp(factors[-1]))
    k = int(below[0])
    if k == 0:
        return float(np.exp(factors[0]))
    share = ratios[k - 1] / (ratios[k - 1] - ratios[k])
    return float(np.exp(factors[k - 1] + share * (factors[k] - factors[k - 1])))
