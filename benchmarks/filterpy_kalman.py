"""filterpy's Kalman filters; a new filter object wherever the map has grown."""

from __future__ import annotations

import numpy as np
from filterpy.kalman import (
    ExtendedKalmanFilter,
    MerweScaledSigmaPoints,
    UnscentedKalmanFilter,
)
from kalman_peer import SIGMA_ALPHA, SIGMA_BETA, KalmanPeer, Moments

from slamgym.arrays import Array
from slamgym.estimator.models.bearing_range import wrap_angle
from slamgym.estimator.peers.peer_slam import (
    Innovation,
    Readings,
    expected_readings,
    motion_covariance,
    moved_state,
    wrapped,
)


class FilterpyEkfSlam(KalmanPeer):
    """filterpy's extended Kalman filter over pose and map.

    The motion moves the mean, as filterpy's class leaves it to its user; the readings
    of a scan are one vector.  filterpy corrects the covariance in Joseph's form.
    Parameters are those of `PeerSlam`.
    """

    def _predicted(self, state: Moments, odometry: Array, variance: Array) -> Moments:
        moved, G = moved_state(state.mean, odometry)
        peer = _ekf(state, readings=1)
        peer.F, peer.Q = G, motion_covariance(state.mean, variance)
        peer.predict()
        return Moments(moved, peer.P)

    def _corrected(self, state: Moments, scan: Readings) -> tuple[Moments, Innovation]:
        peer = _ekf(state, readings=len(scan.slots))
        peer.update(
            scan.measurements.ravel(),
            lambda mean: expected_readings(mean, scan.slots)[1],
            lambda mean: expected_readings(mean, scan.slots)[0].ravel(),
            R=np.diag(scan.variances.ravel()),
            residual=lambda z, expected: wrapped(z - expected),
        )
        return Moments(peer.x, peer.P), Innovation(peer.y.reshape(-1, 2), peer.S)


class FilterpyUkfSlam(KalmanPeer):
    """filterpy's unscented Kalman filter over pose and map.

    Van der Merwe's scaled points, α = 1/2, β = 2, κ = 3 − n; the motion noise is
    additive, at the mean heading.  Bearings are averaged about that of the central
    point.  Parameters are those of `PeerSlam`.
    """

    def _predicted(self, state: Moments, odometry: Array, variance: Array) -> Moments:
        peer = _ukf(state, readings=1)
        peer.Q = motion_covariance(state.mean, variance)
        peer.predict(fx=lambda mean, _: moved_state(mean, odometry)[0])
        return Moments(peer.x, peer.P)

    def _corrected(self, state: Moments, scan: Readings) -> tuple[Moments, Innovation]:
        peer = _ukf(state, readings=len(scan.slots))
        peer.sigmas_f = peer.points_fn.sigma_points(peer.x, peer.P)
        peer.update(
            scan.measurements.ravel(),
            R=np.diag(scan.variances.ravel()),
            hx=lambda mean: expected_readings(mean, scan.slots)[0].ravel(),
        )
        return Moments(peer.x, peer.P), Innovation(peer.y.reshape(-1, 2), peer.S)


def _ekf(state: Moments, readings: int) -> ExtendedKalmanFilter:
    peer = ExtendedKalmanFilter(dim_x=len(state.mean), dim_z=2 * readings)
    peer.x, peer.P = state
    return peer


def _ukf(state: Moments, readings: int) -> UnscentedKalmanFilter:
    n = len(state.mean)
    peer = UnscentedKalmanFilter(
        dim_x=n,
        dim_z=2 * readings,
        dt=1.0,
        hx=None,
        fx=None,
        points=MerweScaledSigmaPoints(n, SIGMA_ALPHA, SIGMA_BETA, 3 - n),
        z_mean_fn=_mean_reading,
        residual_z=lambda one, other: wrapped(one - other),
    )
    peer.x, peer.P = state
    return peer


def _mean_reading(points: Array, weights: Array) -> Array:
    """Return the weighted mean of readings (N, 2m), bearings about the first row's."""
    away = points - points[0]
    away[:, 0::2] = wrap_angle(away[:, 0::2])
    return np.asarray(points[0] + weights @ away)
