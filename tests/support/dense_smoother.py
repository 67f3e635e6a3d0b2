"""The batch smoother as dense least squares with numeric Jacobians: the slow twin."""

import numpy as np
from numeric_jacobian import numeric_jacobian

from slamgym.estimator.models.bearing_range import wrap_angle
from slamgym.estimator.models.motions import predict_pose
from slamgym.estimator.models.sensors import BEARING_RANGE


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
        sensor=BEARING_RANGE,
    ):
        self.moves, self.scans, self.sensor = moves, scans, sensor
        lengths = [len(seen) for _, seen in scans]
        self.pose_of = np.repeat(np.arange(len(scans)), lengths)
        self.seen = np.concatenate([np.asarray(seen, dtype=int) for _, seen in scans])
        self.readings = np.vstack([np.reshape(z, (-1, 2)) for z, _ in scans])
        self.motion_std = motion_std
        self.reading_std = np.resize(measurement_std, self.readings.shape)
        if bearing_std_metres:
            self.reading_std[:, 0] += bearing_std_metres / self.readings[:, 1]
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
        x, y, turn = poses[self.pose_of].T
        dx, dy = landmarks[self.seen].T - (x, y)
        c, s = np.cos(turn), np.sin(turn)
        ahead = c * dx + s * dy
        left = c * dy - s * dx
        apart = self.sensor.difference(self.readings, self.sensor.read(ahead, left))
        parts.append((apart / self.reading_std)[:, : self.sensor.size].ravel())
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
