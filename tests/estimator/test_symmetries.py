"""A world that is turned, mirrored, or measured in other units has the same answers."""

from typing import NamedTuple

import numpy as np
import pytest
from drives import SIX, drive

from slamgym.estimator import make_estimator
from slamgym.estimator.smoother import Drive, smooth
from slamgym.evaluation import error_bound, nees
from slamgym.evaluation.noise_findings import noise_sums

START_STD = (0.05, 0.05, 0.02)
MOTION_STD, MEASUREMENT_STD = (0.05, 0.02, 0.02), (0.02, 0.08)


class World(NamedTuple):
    """Coordinates of a world: p' = scale R(turn) M p + shift, M = diag(1, side).

    A step lasts ``ticks`` units of time.
    """

    turn: float = 0.0
    side: float = 1.0
    scale: float = 1.0
    shift: tuple[float, float] = (0.0, 0.0)
    ticks: float = 1.0

    def matrix(self):
        c, s = np.cos(self.turn), np.sin(self.turn)
        return self.scale * np.array([[c, -s], [s, c]]) @ np.diag([1.0, self.side])

    def points(self, points):
        return points @ self.matrix().T + self.shift

    def poses(self, poses):
        headings = self.side * poses[..., 2:] + self.turn
        return np.concatenate([self.points(poses[..., :2]), headings], axis=-1)

    def polar(self, rows):
        """Return (distance, angle) from the robot."""
        return rows * (self.scale, self.side)

    def readings(self, rows):
        return rows * (self.side, self.scale)

    def covariance(self, P):
        whole = np.kron(np.eye(len(P) // 2), self.matrix())
        whole = np.insert(np.insert(whole, 2, 0.0, axis=0), 2, 0.0, axis=1)
        whole[2, 2] = self.side
        return whole @ P @ whole.T

    def noise(self):
        motion_std = np.multiply(MOTION_STD, (self.scale, self.scale, 1.0))
        return {
            "motion_std": motion_std / np.sqrt(self.ticks),
            "measurement_std": np.multiply(MEASUREMENT_STD, (1.0, self.scale)),
        }

    def start(self):
        start = self.poses(np.zeros((1, 3)))[0]
        std = np.multiply(START_STD, (self.scale, self.scale, 1.0))
        return {"initial_pose": start, "initial_pose_std": std}


MOVED = World(2.0, 1.0, 1.0, (30.0, -20.0))
MIRRORED = World(0.7, -1.0, 1.0, (-3.0, 8.0))
IN_FEET = World(scale=3.28084, ticks=4.0)
WORLDS = pytest.mark.parametrize(
    "world", [MOVED, MIRRORED, IN_FEET], ids=["moved", "mirrored", "in feet"]
)


def assert_follows(world, here, there):
    """Compare a belief in a world with the one in its own coordinates."""
    assert there.landmark_ids == here.landmark_ids
    apart = there.mean[2] - world.poses(here.pose)[2]
    assert np.cos(apart) == pytest.approx(1.0, abs=1e-12)
    np.testing.assert_allclose(there.pose[:2], world.points(here.pose[:2]), atol=1e-7)
    np.testing.assert_allclose(there.landmarks, world.points(here.landmarks), atol=1e-7)
    expected = world.covariance(here.covariance)
    np.testing.assert_allclose(there.covariance, expected, rtol=1e-5, atol=1e-9)


# The joint tests decide the readings of a scan from one side to the other, each given
# those before it: close to a gate, a mirrored scan may have another result.
DECISIONS = [
    *((MOVED, each) for each in ("nearest", "joint", "compatibility", "hypotheses")),
    *((MIRRORED, "nearest"), (IN_FEET, "nearest"), (IN_FEET, "compatibility")),
]


def slippery(noise):
    """Return the noise of a robot whose motion is uncertain."""
    return noise | {"motion_std": 5 * noise["motion_std"]}


@pytest.mark.parametrize(("world", "association"), DECISIONS)
def test_a_managed_filter_decides_alike_in_other_coordinates(world, association):
    policy = {"association": association, "confirm": (2, 3), "merge_within": None}
    here, there = (
        make_estimator(
            "invariant",
            **slippery(each.noise()),
            **each.start(),
            min_range=0.5 * each.scale,
            management=policy,
        )
        for each in (World(), world)
    )
    rng = np.random.default_rng(3)
    for odometry, readings, _ in drive(8, 40):
        seen = readings[readings[:, 1] < 8.0]
        clutter = np.column_stack([rng.uniform(-3, 3, 1), rng.uniform(1, 8, 1)])
        seen = np.vstack([seen, clutter])
        order = rng.permutation(len(seen))
        motion = odometry + rng.standard_normal(2) * (0.25, 0.1)
        here.predict(motion)
        there.predict(world.polar(motion), world.ticks)
        report, other = here.update(seen), there.update(world.readings(seen)[order])
        assert other.nis == pytest.approx(report.nis, rel=1e-6, abs=1e-9)
        assert [report.row_ids[row] for row in order] == [*other.row_ids]
    ids = sorted(here.landmark_ids)
    assert len(ids) > 4
    assert_follows(world, here.belief(ids), there.belief(ids))


@WORLDS
def test_a_smoothed_drive_is_the_same_in_other_coordinates(world):
    drives = [Drive(**each.noise(), **each.start()) for each in (World(), world)]
    for odometry, readings, _ in drive(5, 25):
        for each, to in zip(drives, (World(), world), strict=True):
            each.predict(to.polar(odometry), to.ticks)
            each.update(to.readings(readings), range(6))
    here, there = map(smooth, drives)
    assert there.cost == pytest.approx(here.cost, rel=1e-6)
    gaps = there.poses[:, :2] - world.points(here.poses[:, :2])
    np.testing.assert_allclose(gaps, 0.0, atol=1e-6)
    assert_follows(world, here.belief(), there.belief())


def runs_of(world):
    """Return true poses, landmarks, odometry and readings of three runs."""
    rows = [list(zip(*drive(seed, 20), strict=True)) for seed in (1, 2, 3)]
    odometry, readings, poses = (np.array([row[k] for row in rows]) for k in range(3))
    points = world.points(np.broadcast_to(SIX, (3, 6, 2)))
    return world.poses(poses), points, world.polar(odometry), world.readings(readings)


@WORLDS
def test_scores_and_bounds_are_the_same_in_other_coordinates(world):
    found = []
    for each in (World(), world):
        poses, points, odometry, readings = runs_of(each)
        visible = readings[..., 1] < 8.0 * each.scale
        bound = error_bound.posterior_bound(
            poses,
            points,
            visible,
            each.ticks * np.ones(20),
            start_std=each.start()["initial_pose_std"],
            origin=each.start()["initial_pose"][:2],
            **each.noise(),
        )
        scale = each.scale**2
        noise = each._replace(ticks=1.0).noise()
        sums = noise_sums(poses, points, odometry, readings, visible, **noise)
        even = sums[..., [0, 2, 4]]  # count, squares, fourth powers
        P = np.array([[4.0, 1.0, 0.3], [1.0, 2.0, -0.2], [0.3, -0.2, 0.5]])
        wrong = each.poses(runs_of(World())[0] + (0.3, -0.2, 0.1))
        claimed = np.broadcast_to(each.covariance(P), (3, 20, 3, 3))
        scores = [
            nees.pose_nees(poses, wrong, claimed, frame=frame)
            for frame in ("additive", "invariant")
        ]
        found.append(
            [
                bound.position / scale,
                bound.raw_position / scale,
                bound.heading,
                bound.map / scale,
                even,
                *scores,
            ]
        )
    for here, there in zip(*found, strict=True):
        np.testing.assert_allclose(there, here, rtol=1e-6, atol=1e-12)
