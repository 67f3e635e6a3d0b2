"""Drives from place to place through a town of many landmarks, to feed filters with."""

import numpy as np
from drives import MEASUREMENT_STD

from slamgym.estimator.models.bearing_range import predict_measurement
from slamgym.estimator.models.motions import predict_pose

TOWN_MOTION_STD = (0.02, 0.01, 0.01)


def town(count, seed=0):
    """Landmarks, one to 25 m²; half the side of the square they stand in."""
    half = np.sqrt(25.0 * count) / 2
    return np.random.default_rng(seed).uniform(-half, half, (count, 2)), half


def wander(count, steps, *, seed=0, seen=10, jumping=False):
    """Yield (odometry, readings, ids) of a drive from place to place.

    The nearest landmarks are seen, or, ``jumping``, any.
    """
    rng = np.random.default_rng(seed + 1)
    landmarks, half = town(count, seed)
    pose = np.zeros(3)
    for step in range(steps):
        if step % 100 == 0:
            goal = rng.uniform(-0.9 * half, 0.9 * half, 2)
        ahead = np.arctan2(*(goal - pose[:2])[::-1]) - pose[2]
        turn = np.clip((ahead + np.pi) % (2 * np.pi) - np.pi, -0.3, 0.3)
        motion = predict_pose(pose, np.array([0.5, turn]))
        slip = TOWN_MOTION_STD * rng.standard_normal(3)
        pose = motion.pose + motion.jacobian_noise @ slip
        distances = ((landmarks - pose[:2]) ** 2).sum(axis=1)
        distances[distances < 1] = np.inf  # too close to have a bearing
        ids = np.argpartition(distances, seen)[:seen]
        if jumping:
            ids = rng.choice(count, seen, replace=False)
        readings = predict_measurement(pose, landmarks[ids]).measurement
        noise = MEASUREMENT_STD * rng.standard_normal(readings.shape)
        yield (0.5, float(turn)), readings + noise, ids


def map_all(slam, count):
    """Let a filter see everything from the origin, some at a time."""
    landmarks, _ = town(count)
    readings = predict_measurement(np.zeros(3), landmarks).measurement
    for first in range(0, count, 50):
        slam.update(readings[first : first + 50], range(count)[first : first + 50])
    return slam


def run(slam, drive):
    """Feed a filter with (odometry, readings, ids, …) of a drive; return it."""
    for odometry, readings, ids, *_ in drive:
        slam.predict(odometry)
        slam.update(readings, ids)
    return slam
