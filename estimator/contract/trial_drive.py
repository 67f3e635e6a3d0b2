"""A small known world, and a drive through it, to try an estimator on."""

from collections.abc import Callable
from typing import Any

import numpy as np

from ...arrays import Array
from ..interface import Belief, SlamEstimator
from ..models.bearing_range import predict_measurement
from ..models.unicycle_motion import predict_pose

Factory = Callable[..., SlamEstimator]

LANDMARKS = np.array([[4.0, 1.0], [2.0, -3.0], [-1.0, 4.0], [6.0, 5.0]])
NOISE = {"motion_std": (0.05, 0.02, 0.02), "measurement_std": (0.02, 0.05)}


class EstimatorContractError(AssertionError):
    """An estimator breaks the contract; the message says where and how."""


def expect(condition: bool, message: str) -> None:
    """Raise an :class:`EstimatorContractError` unless the condition holds."""
    if not condition:
        raise EstimatorContractError(message)


def make(factory: Factory, **changes: Any) -> SlamEstimator:
    """Make an estimator, or report which keywords its factory must accept."""
    try:
        return factory(**NOISE, **changes)
    except TypeError as error:
        raise EstimatorContractError(
            "the factory must accept the keywords motion_std, measurement_std, "
            f"initial_pose and initial_pose_std: {error}"
        ) from error


def scan(pose: Array, rng: np.random.Generator | None = None) -> Array:
    """Read all landmarks, (n, 2), with noise when an rng is given."""
    readings = predict_measurement(pose, LANDMARKS).measurement
    if rng is not None:
        readings += rng.standard_normal(readings.shape) * NOISE["measurement_std"]
    return readings


def drive(estimator: SlamEstimator, steps: int, seed: int = 0) -> Array:
    """Drive a noisy arc; return the true pose at its end."""
    rng = np.random.default_rng(seed)
    pose = np.zeros(3)
    ids = list(range(len(LANDMARKS)))
    for _ in range(steps):
        odometry = np.array([0.3, 0.1]) + rng.standard_normal(2) * (0.05, 0.02)
        pose = predict_pose(pose, odometry).pose
        estimator.predict((0.3, 0.1))
        estimator.update(scan(pose, rng), ids)
    return pose


def checked_belief(estimator: SlamEstimator) -> Belief:
    """Return the belief, checked to be finite, symmetric and semidefinite."""
    belief = estimator.belief()
    expect(
        isinstance(belief, Belief),
        f"belief() must return a Belief, got {type(belief).__name__}",
    )
    P = belief.covariance
    expect(bool(np.isfinite(P).all()), "belief().covariance must be finite")
    expect(
        np.allclose(P, P.T, rtol=0, atol=1e-9), "belief().covariance must be symmetric"
    )
    expect(
        bool(np.linalg.eigvalsh(P).min() > -1e-9),
        "belief().covariance must be positive semidefinite",
    )
    return belief


def same_beliefs(one: Belief, other: Belief) -> bool:
    """Return whether two beliefs are equal to the bit."""
    return (
        one.landmark_ids == other.landmark_ids
        and np.array_equal(one.mean, other.mean)
        and np.array_equal(one.covariance, other.covariance)
    )
