"""The batch smoother as dense least squares with numeric Jacobians: the slow twin."""

import numpy as np
from numeric_jacobian import numeric_jacobian

from slamgym.estimator.models.bearing_range import predict_measurement, wrap_angle
from slamgym.estimator.models.motions import predict_pose


class DenseSmoother:
    """Poses 0 … K and landmarks as one vector (x0, y0, θ0, x1, …, l0x, l0y, …).

    moves are odometry (d, α) to poses 1 … K, scans [(readings, landmark indices)].
    """

    def __init__(
        self,
        moves,
        scans,
        motion_std,
        measurement_std,
        start_std,
        *,
        bearing_std_metres=0,
        sensor=None,
    ):
        self.moves, self.scans, self.sensor = moves, scans, sensor
        self.motion_std, self.measurement_std = motion_std, measurement_std
        self.bearing_std_metres = bearing_std_metres
        self.start_std = np.asarray(start_std, dtype=float)
        self.fixes = []  # (pose, z, H, R) with z = H pose + noise of covariance R

    def residual(self, state):
        """Whitened residuals of the prior, the motions and the readings."""
        poses = state[: 3 * len(self.scans)].reshape(-1, 3)
        landmarks = state[3 * len(self.scans) :].reshape(-1, 2)
        parts = [poses[0] / self.start_std]
        for k, odometry in enumerate(self.moves):
            motion = predict_pose(poses[k], np.asarray(odometry))
            slip = poses[k + 1] - motion.pose
            slip[2] = wrap_angle(slip[2])
            parts.append(motion.jacobian_noise.T @ slip / self.motion_std)
        for pose, (readings, seen) in zip(poses, self.scans, strict=True):
            if self.sensor is not None:
                expected = self.sensor.predict(pose, landmarks[seen]).measurement
                apart = self.sensor.difference(readings, expected)
                of_numbers = np.arange(self.sensor.size)
                parts.append((apart[:, of_numbers] / self.measurement_std).ravel())
                continue
            expected = predict_measurement(pose, landmarks[seen]).measurement
            innovation = np.asarray(readings).reshape(-1, 2) - expected
            innovation[:, 0] = wrap_angle(innovation[:, 0])
            std = np.tile(self.measurement_std, (len(innovation), 1))
            std[:, 0] += self.bearing_std_metres / np.asarray(readings)[..., 1]
            parts.append((innovation / std).ravel())
        for k, z, H, R in self.fixes:
            off = np.asarray(z) - H @ poses[k]
            angles = (H[:, :2] == 0).all(axis=1)
            off[angles] = wrap_angle(off[angles])
            parts.append(np.linalg.solve(np.linalg.cholesky(R), off))
        return np.concatenate(parts)

    def solve(self, state, iterations=8):
        """Gauss-Newton; return the state and its covariance."""
        for _ in range(iterations):
            J = numeric_jacobian(self.residual, state)
            state = state - np.linalg.lstsq(J, self.residual(state), rcond=None)[0]
        J = numeric_jacobian(self.residual, state)
        return state, np.linalg.inv(J.T @ J)
