"""What a managed filter remembers of its decisions about readings."""

import numpy as np
import pytest

from slamgym.envs import LandmarkWorldEnv
from slamgym.estimator import make_estimator
from slamgym.sim_configs import action_sequence, load_scenario

NOISE = {"motion_std": (0.1, 0.1, 0.05), "measurement_std": (0.02, 0.1)}
AHEAD = [(0.0, 5.0)]


def managed(**policy):
    return make_estimator("invariant", **NOISE, management=policy or True)


@pytest.fixture(scope="module")
def slippery():
    """Readings among sixty landmarks a metre apart, of a robot that slips."""
    fields = load_scenario("hidden_identities").model_dump()
    fields["landmarks"] |= {"count": 60, "min_distance": 1.0}
    fields["motion"]["std"] = (0.05, 0.0, 0.06)
    world = load_scenario(fields)
    env = LandmarkWorldEnv(world)
    observation, _ = env.reset(seed=4)
    scans = []
    for action in action_sequence(world)[:50]:
        readings = observation["landmarks"][observation["mask"]]
        scans.append((observation["odometry"], readings))
        observation, *_ = env.step(action)
    noise = {"motion_std": world.motion.std, "measurement_std": world.sensor.std}
    return noise, scans


def test_only_an_estimator_that_associates_lists_decisions():
    assert hasattr(managed(), "decisions")
    assert hasattr(managed(association="hypotheses"), "decisions")
    assert not hasattr(make_estimator("invariant", **NOISE), "decisions")


@pytest.mark.parametrize("backdate", [False, True])
def test_the_confirming_scan_adds_a_landmark_and_may_revise_the_earlier_ones(backdate):
    slam = managed(backdate=backdate, confirm=(3, 8))
    reports = [slam.update(AHEAD) for _ in range(4)]
    assert [made.added for made in slam.decisions] == [(), (), (0,), ()]
    assert [report.confirmed_ids for report in reports] == [(), (), (0,), ()]
    first = 0 if backdate else None
    assert [made.row_ids[0] for made in slam.decisions] == [first, first, 0, 0]


def test_what_management_does_to_the_map_is_part_of_the_decisions():
    slam = managed(confirm=(1, 1))
    slam.update([(0.0, 5.0), (1.0, 5.0), (2.0, 5.0)])
    slam.remove([1])
    slam.merge(0, 2)
    (made,) = slam.decisions
    assert (made.added, made.removed, made.merged) == ((0, 1, 2), (1,), ((0, 2),))


def test_a_rejected_reading_is_given_to_no_landmark():
    options = {"gate_probability": 0.5, "management": {"confirm": (1, 1)}}
    slam = make_estimator("ekf", **NOISE, **options)
    slam.update(AHEAD)
    report = slam.update([(0.03, 5.2)])
    assert report.row_ids == report.rejected_ids == (0,)
    assert slam.decisions[-1].row_ids == (None,)


def test_a_reading_too_near_to_use_is_given_to_no_landmark():
    slam = managed()
    slam.update(AHEAD, [7])
    report = slam.update([(0.0, 1e-4), (0.5, 5.0)], [7, 8])
    assert (report.skipped_ids, report.row_ids) == ((7,), (7, 8))
    assert slam.decisions[-1].row_ids == (None, 8)
    assert slam.update([(0.0, 1e-4)], [7]).skipped_ids == (7,)  # nothing is new
    assert slam.decisions[-1].row_ids == (None,)
    slam = managed(trust_ids=False, confirm=(2, 3))
    slam.update(AHEAD, [7])
    assert slam.update([(0.0, 1e-4)], [7]).skipped_ids == (7,)  # would confirm it
    assert (slam.decisions[-1].row_ids, slam.decisions[-1].added) == ((None,), ())


@pytest.mark.parametrize("backdate", [False, True])
@pytest.mark.parametrize("method", ["joint", "hypotheses"])
def test_a_filter_told_the_decisions_has_the_same_belief(method, backdate, slippery):
    """Those at the end: hypotheses and confirmed landmarks revise earlier ones."""
    noise, scans = slippery
    policy = {"association": method, "backdate": backdate}
    slam = make_estimator("invariant", **noise, management=policy)
    told = make_estimator("invariant", **noise)
    durations = [1.0 + k % 2 for k in range(len(scans))]
    for dt, (odometry, readings) in zip(durations, scans, strict=True):
        slam.predict(odometry, dt)
        slam.update(readings)
    made_of = zip(durations, scans, slam.decisions, strict=True)
    for dt, (odometry, readings), made in made_of:
        told.predict(odometry, dt)
        rows = [row for row, i in enumerate(made.row_ids) if i is not None]
        told.update(readings[rows], [made.row_ids[row] for row in rows])
    expected = told.belief(slam.landmark_ids)
    np.testing.assert_allclose(slam.belief().mean, expected.mean, atol=1e-9)
    np.testing.assert_allclose(slam.belief().covariance, expected.covariance, atol=1e-9)


def test_all_that_happened_between_sightings_happens_again_in_its_order():
    """Two landmarks are confirmed one after the other, so scans are repeated twice."""
    world = {1: (6, 3), 2: (8, -4), 3: (8.9, -4), 4: (9, 1), "N": (5, 8), "M": (4, -9)}
    world["C"] = (-5, -5)

    def rows(x, names):
        east, north = np.array([world[name] for name in names], dtype=float).T
        return np.column_stack((np.arctan2(north, east - x), np.hypot(east - x, north)))

    def tell(slam, ids):
        slam.update(rows(0.0, [1, 2, 3, 4]), [1, 2, 3, 4])
        reports = []
        for k in range(5):
            slam.observe_pose([0.5 * k, 0.0], np.eye(2, 3), 0.01 * np.eye(2))
            slam.predict((0.5, 0.0), abs(k - 1) / 2)
            shown = [4, "N", *["M"][:k], *["C"][: k // 4 * (ids is None)]]
            readings = rows(0.52 + 0.5 * k, shown)
            reports.append(slam.update(readings, ids and [ids[name] for name in shown]))
            readings[:] = np.nan  # as if the caller reused the array
            if k == 0:
                slam.remove([1])
            if k == 1:
                slam.merge(2, 3)
        return reports

    policy = {"association": "joint", "confirm": (3, 8)}
    slam = managed(**policy)
    slam.predict((0.0, 0.0))
    reports = tell(slam, None)
    assert [report.confirmed_ids for report in reports] == [(), (), (5,), (6,), ()]
    told = make_estimator("invariant", **NOISE)
    told.predict((0.0, 0.0))
    expected = tell(told, {4: 4, "N": 5, "M": 6})
    assert [made.row_ids for made in slam.decisions][2:5] == [(4, 5, 6)] * 3
    assert slam.landmark_ids == told.landmark_ids == (2, 4, 5, 6)
    np.testing.assert_allclose(slam.belief().mean, told.belief().mean, atol=1e-9)
    for key in ("nis", "innovation"):
        values = getattr(reports[3], key), getattr(expected[3], key)
        np.testing.assert_allclose(*values, atol=1e-9)
