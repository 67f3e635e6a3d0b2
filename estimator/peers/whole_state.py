"""The motion and the measurement model over pose and map as one vector."""

import numpy as np

from ...arrays import Array, IntArray
from ..models.bearing_range import predict_measurement, wrap_angle
from ..models.unicycle_motion import predict_pose


def moved_state(mean: Array, odometry: Array) -> tuple[Array, Array]:
    """Return g(x, u) of the whole state (n,), and G (n, n)."""
    pose, of_pose, _ = predict_pose(mean[:3], odometry)
    G = np.eye(len(mean))
    G[:3, :3] = of_pose
    return np.concatenate([pose, mean[3:]]), G


def motion_covariance(mean: Array, variance: Array) -> Array:
    """Return F R Fᵀ over the whole state, (n, n), for variances (3,) of the noise."""
    F = predict_pose(mean[:3], np.zeros(2)).jacobian_noise
    Q = np.zeros((len(mean), len(mean)))
    Q[:3, :3] = (F * variance) @ F.T
    return Q


def wrapped(difference: Array) -> Array:
    """Return a difference of readings β1, r1, β2, …, its bearings in [-π, π)."""
    result = np.array(difference, dtype=np.float64)
    result[0::2] = wrap_angle(result[0::2])
    return result


def expected_readings(mean: Array, slots: IntArray) -> tuple[Array, Array]:
    """Return the readings h (m, 2) expected at a mean (n,), and H (2m, n)."""
    landmarks = mean[3:].reshape(-1, 2)[slots]
    expected, of_pose, of_landmark = predict_measurement(mean[:3], landmarks)
    H = np.zeros((len(slots), 2, len(mean)))
    H[:, :, :3] = of_pose
    for axis in (0, 1):
        columns = 3 + 2 * slots + axis
        H[np.arange(len(slots)), :, columns] = of_landmark[:, :, axis]
    return expected, H.reshape(2 * len(slots), -1)
