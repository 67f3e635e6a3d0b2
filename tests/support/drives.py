"""Noisy drives past landmarks, made with numpy alone, to feed filters with."""

import numpy as np

from slamgym.estimator.models.bearing_range import predict_measurement
from slamgym.estimator.models.motions import predict_pose

MOTION_STD = np.array([0.05, 0.02, 0.02])
MEASUREMENT_STD = np.array([0.02, 0.08])
NOISE = {"motion_std": MOTION_STD, "measurement_std": MEASUREMENT_STD}
SIX = np.array([[3, 6], [3, 12], [7, 8], [7, 14], [11, 6], [11, 12.0]])


def drive(seed, steps, *, landmarks=SIX, odometry=(0.5, 0.08), start_std=(0, 0, 0)):
    """Yield (odometry, readings (n, 2), true pose (3,)) of a circular drive."""
    rng = np.random.default_rng(seed)
    pose = np.asarray(start_std) * rng.standard_normal(3)
    for _ in range(steps):
        motion = predict_pose(pose, np.array(odometry))
        slip = MOTION_STD * rng.standard_normal(3)
        pose = motion.pose + motion.jacobian_noise @ slip
        readings = predict_measurement(pose, landmarks).measurement
        noise = MEASUREMENT_STD * rng.standard_normal(readings.shape)
        yield np.array(odometry), readings + noise, pose
