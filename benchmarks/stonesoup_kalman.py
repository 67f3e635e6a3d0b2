"""Stone Soup's Kalman predictors and updaters over pose and map.

Stone Soup has no model of SLAM: it gets one of the motion and one of the readings over
the whole state, with their Jacobians, and bearings of its own type, which wrap.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, ClassVar

import numpy as np
from kalman_peer import SIGMA_ALPHA, SIGMA_BETA, KalmanPeer, Moments
from stonesoup.base import Property
from stonesoup.models.measurement.nonlinear import NonLinearGaussianMeasurement
from stonesoup.models.transition.nonlinear import GaussianTransitionModel
from stonesoup.predictor.kalman import ExtendedKalmanPredictor, UnscentedKalmanPredictor
from stonesoup.types.angle import Bearing
from stonesoup.types.array import CovarianceMatrix, StateVector, StateVectors
from stonesoup.types.detection import Detection
from stonesoup.types.hypothesis import SingleHypothesis
from stonesoup.types.state import GaussianState
from stonesoup.updater.kalman import ExtendedKalmanUpdater, UnscentedKalmanUpdater

from slamgym.arrays import Array, IntArray
from slamgym.estimator.peers.peer_slam import (
    Innovation,
    Readings,
    expected_readings,
    motion_covariance,
    moved_state,
)


class _Motion(GaussianTransitionModel):  # type: ignore[misc]
    """The unicycle over the whole state, for one odometry reading."""

    odometry: Array = Property(doc="(dx, dy, α) [m, m, rad]")
    noise: Array = Property(doc="covariance of the whole state")

    @property
    def ndim_state(self) -> int:
        return len(self.noise)

    def function(self, state: Any, *_: Any, **__: Any) -> Any:
        columns = np.asarray(state.state_vector, dtype=np.float64).T
        moved = [moved_state(column, self.odometry)[0] for column in columns]
        return (
            StateVectors(np.array(moved).T) if len(moved) > 1 else StateVector(*moved)
        )

    def jacobian(self, state: Any, **_: Any) -> Array:
        return moved_state(_column(state.state_vector), self.odometry)[1]

    def covar(self, **_: Any) -> Any:
        return CovarianceMatrix(self.noise)


class _Scan(NonLinearGaussianMeasurement):  # type: ignore[misc]
    """All readings of a scan in one vector (β1, r1, β2, r2, …)."""

    slots: IntArray = Property(doc="places of the landmarks in the map")

    @property
    def ndim_meas(self) -> int:
        return 2 * len(self.slots)

    def function(self, state: Any, *_: Any, **__: Any) -> Any:
        columns = np.asarray(state.state_vector, dtype=np.float64).T
        return _vectors([_typed(expected_readings(x, self.slots)[0]) for x in columns])

    def jacobian(self, state: Any, **_: Any) -> Array:
        return expected_readings(_column(state.state_vector), self.slots)[1]

    def rvs(self, *_: Any, **__: Any) -> Any:
        raise NotImplementedError

    def pdf(self, *_: Any, **__: Any) -> Any:
        raise NotImplementedError


class _StoneSoupSlam(KalmanPeer):
    """A predictor and an updater of Stone Soup over pose and map."""

    _predictor: ClassVar[Callable[..., Any]]
    _updater: ClassVar[Callable[..., Any]]

    def _predicted(self, state: Moments, odometry: Array, variance: Array) -> Moments:
        noise = motion_covariance(state.mean, variance)
        predictor = self._predictor(_Motion(odometry=odometry, noise=noise))
        return _moments(predictor.predict(_gaussian(state)))

    def _corrected(self, state: Moments, scan: Readings) -> tuple[Moments, Innovation]:
        n = len(state.mean)
        model = _Scan(
            ndim_state=n,
            mapping=tuple(range(n)),
            noise_covar=CovarianceMatrix(np.diag(scan.variances.ravel())),
            slots=scan.slots,
        )
        read = Detection(_typed(scan.measurements), measurement_model=model)
        found = self._updater(None).update(SingleHypothesis(_gaussian(state), read))
        expected = found.hypothesis.measurement_prediction
        nu = _column(read.state_vector - expected.state_vector).reshape(-1, 2)
        return _moments(found), Innovation(nu, np.asarray(expected.covar, np.float64))


class StoneSoupEkfSlam(_StoneSoupSlam):
    """Stone Soup's extended Kalman predictor and updater over pose and map.

    Jacobians are given.  Parameters are those of `PeerSlam`.
    """

    _predictor, _updater = ExtendedKalmanPredictor, ExtendedKalmanUpdater


class StoneSoupUkfSlam(_StoneSoupSlam):
    """Stone Soup's unscented Kalman predictor and updater over pose and map.

    Its defaults: α = 1/2, β = 2, κ = 3 − n; the motion noise is additive, at the mean
    heading.  Parameters are those of `PeerSlam`.
    """

    _options: ClassVar = {"alpha": SIGMA_ALPHA, "beta": SIGMA_BETA}
    _predictor = staticmethod(partial(UnscentedKalmanPredictor, **_options))
    _updater = staticmethod(partial(UnscentedKalmanUpdater, **_options))


def _gaussian(state: Moments) -> Any:
    return GaussianState(StateVector(state.mean), CovarianceMatrix(state.covariance))


def _moments(state: Any) -> Moments:
    return Moments(_column(state.mean), np.array(state.covar, dtype=np.float64))


def _vectors(columns: list[Any]) -> Any:
    """Return one state vector as it is, and several side by side."""
    return StateVectors(columns) if len(columns) > 1 else columns[0]


def _column(vector: Any) -> Array:
    return np.array(vector, dtype=np.float64).ravel()


def _typed(readings: Array) -> Any:
    """Return readings (m, 2) as a state vector with bearings that wrap."""
    return StateVector([value for b, r in readings for value in (Bearing(b), r)])
