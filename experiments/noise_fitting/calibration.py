"""Calibrate the noise of a sensor by the true path."""

from __future__ import annotations

import numpy as np

from ...arrays import Array
from ...estimator.error_frames import ErrorFrame
from ...evaluation.nees import pose_nees
from ..logs.ground_truth import true_poses_of
from ..logs.slamlog import SlamLog
from .likelihood import LogLikelihood
from .noise_vector import BEARING

FACTORS = np.geomspace(0.25, 16.0, 19)


def calibrate(
    likelihood: LogLikelihood, log: SlamLog, times: Array, noise: Array
) -> float | None:
    """Return the factor of the sensor's noise at which NEES is as it should be.

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
    float or None
        Where the mean NEES of the pose is 1 per degree of freedom; the nearest factor
        that was tried where there is none.  None where the true poses are unknown.
    """
    truth = true_poses_of(log, times)
    if truth is None or not np.isfinite(truth).all(axis=1).any():
        return None
    noises = np.tile(noise, (len(FACTORS), 1))
    noises[:, BEARING:] *= FACTORS[:, None]
    record = likelihood.record(noises)
    ratios = np.array(
        [
            _nees_per_degree(truth, poses, covariances, likelihood.filter.frame)
            for poses, covariances in zip(
                record.poses, record.pose_covariances, strict=True
            )
        ]
    )
    usable = np.isfinite(ratios) & (ratios > 0)
    if not usable.any():
        return None
    return _crossing(np.log(FACTORS[usable]), np.log(ratios[usable]))


def _nees_per_degree(
    truth: Array, poses: Array, covariances: Array, frame: ErrorFrame
) -> float:
    with np.errstate(invalid="ignore", divide="ignore"):
        values = pose_nees(truth, poses, covariances, frame=frame)
    values = values[np.isfinite(values)]
    return float(values.mean()) / 3 if len(values) else np.nan


def _crossing(factors: Array, ratios: Array) -> float:
    """Return the factor, of logarithms, at which falling ratios first reach 1."""
    below = np.flatnonzero(ratios <= 0)
    if not len(below):
        return float(np.exp(factors[-1]))
    k = int(below[0])
    if k == 0:
        return float(np.exp(factors[0]))
    share = ratios[k - 1] / (ratios[k - 1] - ratios[k])
    return float(np.exp(factors[k - 1] + share * (factors[k] - factors[k - 1])))
