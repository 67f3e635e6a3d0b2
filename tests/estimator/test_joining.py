"""Submaps are joined from any drive whose readings belong to one world."""

from itertools import pairwise

import numpy as np
import pytest

from slamgym.estimator import make_estimator
from slamgym.estimator.large_maps.submaps.joining import (
    FrameInitialisation,
    SubmapSummary,
)
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


def test_frames_begin_with_blocks_of_powers_of_two_that_common_landmarks_align():
    """Frames that are only composed drift; common landmarks correct whole blocks."""
    rng = np.random.default_rng(3)
    frames = np.cumsum(rng.uniform(-1, 1, (12, 3)), axis=0)
    frames -= frames[0]
    world = rng.uniform(-9, 9, (6, 2))

    def seen(origin, points):
        cos, sin = np.cos(origin[2]), np.sin(origin[2])
        return (points - origin[:2]) @ np.array([[cos, -sin], [sin, cos]])

    summaries, asked = [], []
    for before, after in pairwise(frames):
        slots = rng.permutation(6)
        pose = [*seen(before, after[:2]), after[2] - before[2]]
        mean = np.concatenate([pose, seen(before, world[slots]).ravel()])
        summaries.append(SubmapSummary(slots, mean, 0.04 * np.eye(3)))

    def refine(a, b, rough):
        asked.append((a, b))
        true = np.column_stack([seen(frames[a], frames[:, :2]), frames[:, 2]])[
            a : b + 1
        ]
        true[:, 2] -= true[0, 2]
        np.testing.assert_allclose(rough, true, atol=1e-9)
        return rough

    initial = FrameInitialisation()
    found = initial.frames(summaries, frames[:1], refine)
    np.testing.assert_allclose(found, frames, atol=1e-9)
    assert asked == [(0, 4), (4, 8), (0, 8), (8, 10), (10, 11)]
    assert {*initial.blocks} == {(0, 8), (8, 10), (10, 11)}
    more = FrameInitialisation(initial.blocks)
    asked.clear()
    more.frames(summaries, frames[:9], refine)
    assert asked == []
    sure = [each._replace(pose_covariance=1e-4 * np.eye(3)) for each in summaries]
    found = FrameInitialisation().frames(sure, frames[:1], refine)
    np.testing.assert_allclose(found, frames, atol=1e-9)
    assert asked == []  # the heading's deviation along 8 submaps is 0.03
    off = frames[:9].copy()
    off[8] += (0.3, -0.2, 0.1)  # the last one only: landmarks correct most of it
    found = more.frames(summaries, off, refine)
    assert np.abs(found[8:] - frames[8:]).max() < 0.15
    assert {*initial.blocks} == {*more.blocks}
