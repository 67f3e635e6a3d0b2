"""The textbook EKF-SLAM, dense and slow: the oracle of the compiled one.

Stacked H over the whole state, K = P Hᵀ S⁻¹, P ← (I - K H) P, symmetrised; written
from the equations alone, sharing no code with the kernels.
"""

import numpy as np

from slamgym.estimator.models.bearing_range import (
    locate_landmark,
    predict_measurement,
    wrap_angle,
)
from slamgym.estimator.models.motions import predict_pose


class DenseEkf:
    sensor = None  # another than bearing and range

    def __init__(self, motion_std, measurement_std, initial_pose_std=(0, 0, 0)):
        self.R = np.diag(np.square(motion_std))
        self.Q = np.diag(np.square(np.ravel(measurement_std)))
        self.mean = np.zeros(3)
        self.P = np.diag(np.square(np.asarray(initial_pose_std, dtype=float)))
        self.ids = []

    def predict(self, odometry, dt=1.0):
        motion = predict_pose(self.mean[:3], np.asarray(odometry, dtype=float))
        G = np.eye(len(self.mean))
        G[:3, :3] = motion.jacobian_pose
        self.P = G @ self.P @ G.T
        F = motion.jacobian_noise
        self.P[:3, :3] += F @ self.R @ F.T * dt
        self.mean[:3] = motion.pose

    def linearise(self, readings, ids):
        """Return stacked ν (2m,) and H (2m, n) at the mean."""
        slots = [self.ids.index(i) for i in ids]
        landmarks = self.mean[3:].reshape(-1, 2)[slots]
        expected = self.predict_readings(self.mean[:3], landmarks)
        H = np.zeros((2 * len(ids), len(self.mean)))
        for k, slot in enumerate(slots):
            H[2 * k : 2 * k + 2, :3] = expected.jacobian_pose[k]
            H[2 * k : 2 * k + 2, 3 + 2 * slot : 5 + 2 * slot] = (
                expected.jacobian_landmark[k]
            )
        innovation = self.difference(np.asarray(readings), expected.measurement)
        rows = np.flatnonzero(np.arange(2 * len(ids)) % 2 < len(self.Q))
        return innovation.ravel()[rows], H[rows]  # without void numbers

    def predict_readings(self, pose, landmarks):
        if self.sensor is None:
            return predict_measurement(pose, landmarks)
        return self.sensor.predict(pose, landmarks)

    def difference(self, readings, expected):
        if self.sensor is not None:
            return self.sensor.difference(readings, expected)
        innovation = readings - expected
        innovation[..., 0] = wrap_angle(innovation[..., 0])
        return innovation

    def locate(self, reading):
        where = locate_landmark if self.sensor is None else self.sensor.locate
        return where(self.mean[:3], reading[None])

    def update(self, readings, ids):
        readings = np.asarray(readings, dtype=float)
        known = np.array([i in self.ids for i in ids], dtype=bool)
        nis = 0.0
        if known.any():
            nis = self.correct(readings[known], [i for i in ids if i in self.ids])
        for reading, i in zip(readings[~known], np.array(ids)[~known], strict=True):
            self.add(reading, int(i))
        return nis

    def correct(self, readings, ids):
        nu, H = self.linearise(readings, ids)
        return self.condition(nu, H, np.kron(np.eye(len(ids)), self.Q))

    def observe_pose(self, z, H, R):
        """Take in z = H (x, y, θ) + w; rows of the heading alone are angles."""
        columns = np.zeros((len(H), len(self.mean)))
        columns[:, :3] = H
        return self.condition(self.off(z, H, self.mean[:3]), columns, R)

    @staticmethod
    def off(z, H, pose):
        nu = np.asarray(z) - H @ pose
        angles = (H[:, :2] == 0).all(axis=1)
        nu[angles] = wrap_angle(nu[angles])
        return nu

    def condition(self, nu, H, R):
        S = H @ self.P @ H.T + R
        K = np.linalg.solve(S, H @ self.P).T
        self.mean = self.mean + K @ nu
        self.P = (np.eye(len(self.mean)) - K @ H) @ self.P
        self.P = (self.P + self.P.T) / 2
        return float(nu @ np.linalg.solve(S, nu))

    def add(self, reading, landmark_id):
        located = self.locate(reading)
        n = len(self.mean)
        extend = np.zeros((n + 2, n))
        extend[:n] = np.eye(n)
        extend[n:, :3] = located.jacobian_pose[0]
        Fz = located.jacobian_measurement[0]
        self.P = extend @ self.P @ extend.T
        self.P[n:, n:] += Fz @ self.Q @ Fz.T
        self.mean = np.concatenate([self.mean, located.position[0]])
        self.ids.append(landmark_id)
