"""Submaps are joined from any drive whose readings belong to one world."""

import numpy as np
import pytest

from slamgym.estimator import make_estimator
from slamgym.estimator.models.bearing_range import wrap_angle


def drive_around(seed):
    """Drive at random among few landmarks, with noise from fine to coarse."""
    rng = np.random.default_rng(seed)
    motion, sensor = 10 ** rng.uniform(-2.5, -0.5, 3), 10 ** rng.uniform(-2.5, -0.7, 2)
    size, base = int(rng.integers(2, 9)), str(rng.choice(["ekf", "invariant"]))
    noise = {"motion_std": motion, "measurement_std": sensor}
    slam = make_estimator("submaps", **noise, submap_size=size, base=base)
    landmarks = rng.uniform(-10, 10, (int(rng.integers(3, 15)), 2))
    x, y, heading = np.zeros(3)
    rng.integers(3)
    for step in range(int(rng.integers(10, 60))):
        u = rng.uniform(0, 2), rng.uniform(-1, 1)
        along, across, turned = rng.normal(0, motion)
        cos, sin = np.cos(heading), np.sin(heading)
        x += (u[0] + along) * cos - across * sin
        y += (u[0] + along) * sin + across * cos
        heading += u[1] + turned
        slam.predict(u)
        ids = rng.permutation(len(landmarks))[: rng.integers(1, size + 1)].tolist()
        dx, dy = (landmarks[ids] - (x, y)).T
        readings = np.column_stack([np.arctan2(dy, dx) - heading, np.hypot(dx, dy)])
        readings += rng.normal(0, 1, readings.shape) * sensor
        rng.random(len(ids))
        readings[:, 0] = wrap_angle(readings[:, 0])
        readings[:, 1] = np.abs(readings[:, 1]) + 1e-2
        slam.update(readings, ids)
        if step % 8 == 7:
            yield slam.belief()


@pytest.mark.parametrize(
    "seed",
    [10000041, pytest.param(10000005, marks=pytest.mark.slow)],  # the first found
)
def test_submaps_with_large_errors_are_joined(seed):
    for belief in drive_around(seed):
        assert np.isfinite(belief.mean).all()
        assert np.linalg.eigvalsh(belief.covariance).min() > -1e-9
