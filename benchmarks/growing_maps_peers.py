"""References for the compressed filter: a full filter by dsyrk, and iSAM2."""

from collections.abc import Sequence
from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.blas import dsyrk
from scipy.linalg.lapack import dpotrf, dtrtrs

Array = NDArray[np.float64]


class FullWithDsyrk:
    """Full EKF-SLAM in a known map: half of P stored, downdated in place by dsyrk.

    The fastest arrangement known on one core; ids are places in the map.
    """

    def __init__(
        self, mean: Array, covariance: Array, motion_std: Array, sensor_std: Array
    ) -> None:
        self.mean = mean.copy()
        self.covariance = np.asfortranarray(covariance)  # the lower half of it counts
        if self.covariance is covariance or not self.covariance.flags.writeable:
            self.covariance = covariance.copy(order="F")
        self.motion_variance, self.variance = motion_std**2, sensor_std**2

    def predict(self, odometry: tuple[float, float]) -> None:
        """P ← G P Gᵀ + F R Fᵀ in the first three columns."""
        distance, turn = odometry
        cos, sin = np.cos(self.mean[2]), np.sin(self.mean[2])
        self.mean[:3] += distance * cos, distance * sin, turn
        P = self.covariance
        G, F = np.eye(3), np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1.0]])
        G[:2, 2] = -distance * sin, distance * cos
        pose = np.tril(P[:3, :3]) + np.tril(P[:3, :3], -1).T
        P[:3, :3] = G @ pose @ G.T + (F * self.motion_variance) @ F.T
        P[3:, 0] += G[0, 2] * P[3:, 2]
        P[3:, 1] += G[1, 2] * P[3:, 2]

    def update(self, readings: Array, ids: Sequence[int]) -> None:
        """S = H P Hᵀ + Q = L Lᵀ, A = L⁻¹ H P, x ← x + Aᵀ L⁻¹ ν, P ← P − Aᵀ A."""
        places = 3 + 2 * np.asarray(ids)
        columns = np.r_[0:3, np.stack([places, places + 1], axis=1).ravel()]
        P, x = self.covariance, self.mean
        offset = np.stack([x[places], x[places + 1]], axis=1) - x[:2]
        squared = (offset**2).sum(axis=1)
        distance = np.sqrt(squared)
        m = len(places)
        H, nu = np.zeros((m, 2, 3 + 2 * m)), np.empty((m, 2))
        bearing = readings[:, 0] - np.arctan2(offset[:, 1], offset[:, 0]) + x[2]
        nu[:, 0] = (bearing + np.pi) % (2 * np.pi) - np.pi
        nu[:, 1] = readings[:, 1] - distance
        lm = np.arange(m)
        turned = np.stack([-offset[:, 1], offset[:, 0]], axis=1) / squared[:, None]
        along = offset / distance[:, None]
        H[:, 0, :2], H[:, 0, 2], H[:, 1, :2] = -turned, -1.0, -along
        for axis in (0, 1):
            H[lm, 0, 3 + 2 * lm + axis] = turned[:, axis]
            H[lm, 1, 3 + 2 * lm + axis] = along[:, axis]
        flat = H.reshape(2 * m, -1)
        rows = np.empty((len(columns), len(x)))
        for k, c in enumerate(columns):
            rows[k, c:] = P[c:, c]
            rows[k, :c] = P[c, :c]
        gains = flat @ rows
        S = gains[:, columns] @ flat.T + np.diag(np.tile(self.variance, m))
        L, _ = dpotrf(S, lower=1)
        white, _ = dtrtrs(L, np.column_stack([nu.ravel(), gains]), lower=1)
        x += white[:, 0] @ white[:, 1:]
        dsyrk(-1.0, white[:, 1:], 1.0, P, trans=1, lower=1, overwrite_c=1)


class Isam2:
    """GTSAM's incremental smoother, asked for the pose after every step."""

    def __init__(self, motion_std: Array, sensor_std: Array) -> None:
        gtsam: Any = import_module("gtsam")

        self.gtsam = gtsam
        parameters = gtsam.ISAM2Params()
        parameters.setRelinearizeThreshold(0.1)
        parameters.relinearizeSkip = 1
        self.isam = gtsam.ISAM2(parameters)
        noise = gtsam.noiseModel.Diagonal.Sigmas
        self.motion_noise, self.sensor_noise = noise(motion_std), noise(sensor_std)
        self.graph, self.guess = gtsam.NonlinearFactorGraph(), gtsam.Values()
        self.steps, self.mapped, self.pose = 0, set[int](), gtsam.Pose2()
        prior = noise(np.full(3, 1e-6))
        self.graph.add(gtsam.PriorFactorPose2(self._at(0), self.pose, prior))
        self.guess.insert(self._at(0), self.pose)

    def _at(self, step: int) -> int:
        key: int = self.gtsam.symbol("x", step)
        return key

    def predict(self, odometry: tuple[float, float]) -> None:
        """Add a pose and the motion to it."""
        motion = self.gtsam.Pose2(odometry[0], 0.0, odometry[1])
        before, now = self._at(self.steps), self._at(self.steps + 1)
        self.graph.add(
            self.gtsam.BetweenFactorPose2(before, now, motion, self.motion_noise)
        )
        self.pose = self.pose.compose(motion)
        self.guess.insert(now, self.pose)
        self.steps += 1

    def update(self, readings: Array, ids: Sequence[int]) -> None:
        """Add the readings, update, and ask for the pose."""
        gtsam, pose = self.gtsam, self.pose
        for (bearing, distance), i in zip(readings.tolist(), ids, strict=True):
            key = gtsam.symbol("l", i)
            direction = gtsam.Rot2(bearing)
            if i not in self.mapped:
                angle = pose.theta() + bearing
                place = (
                    pose.x() + distance * np.cos(angle),
                    pose.y() + distance * np.sin(angle),
                )
                self.guess.insert(key, np.array(place))
                self.mapped.add(i)
            self.graph.add(
                gtsam.BearingRangeFactor2D(
                    self._at(self.steps), key, direction, distance, self.sensor_noise
                )
            )
        self.isam.update(self.graph, self.guess)
        self.graph.resize(0)
        self.guess.clear()
        self.pose = self.isam.calculateEstimatePose2(self._at(self.steps))
