"""The batch smoother against dense least squares, RTS, GTSAM, and its own promises."""

from dataclasses import replace
from inspect import signature
from itertools import permutations
from types import SimpleNamespace

import numpy as np
import pytest
from dense_smoother import DenseSmoother
from drives import MEASUREMENT_STD, MOTION_STD, NOISE, SIX, drive
from far_origins import far_origins, rounding, shifted
from numeric_jacobian import numeric_jacobian
from own_noise import OWN_NOISE, SHIPPED_NOISE

from slamgym.estimator import EkfSlam, UpdateReport, make_estimator
from slamgym.estimator.map_management import ManagedSlam
from slamgym.estimator.models.bearing_range import wrap_angle
from slamgym.estimator.models.motions import MotionNoise, predict_pose
from slamgym.estimator.models.rigid_motion import pose_rotation
from slamgym.estimator.models.sensors import (
    BEARING,
    BEARING_RANGE,
    POSITION,
    SENSORS,
    from_bearing_range,
)
from slamgym.estimator.smoother import (
    Drive,
    RecordedSlam,
    SmoothingSlam,
    batch_smoother,
    reassociate,
    smooth,
)
from slamgym.estimator.smoother.drive import Sightings, landmark_order, path_between
from slamgym.estimator.smoother.elimination import PART
from slamgym.estimator.smoother.optimiser import (
    Estimate,
    Optimiser,
    _Iterate,
    filter_options,
    start_of,
)

START_STD = (0.1, 0.2, 0.05)
RANGE = 7.0  # of the sensor [m]
IDS = list(range(len(SIX)))


def recorded(seed=3, steps=12, start_std=START_STD, **settings):
    """Return a drive, and its moves and scans as plain lists."""
    result = Drive(**NOISE | settings, initial_pose_std=start_std)
    result.end_motion()
    moves, scans = [], [(np.empty((0, 2)), np.empty(0, dtype=int))]
    for odometry, readings, _ in drive(seed, steps):
        seen = np.flatnonzero(readings[:, 1] < RANGE)
        result.predict(odometry)
        result.update(readings[seen], seen)
        moves.append(odometry)
        scans.append((readings[seen], seen))
    return result, moves, scans


def dense_twin(made, moves, scans, **noise):
    """Return the dense twin and its state of a smoothed drive."""
    noise = {"measurement_std": MEASUREMENT_STD, "start_std": START_STD} | noise
    places = dict(zip(made.landmark_ids, made.landmarks, strict=True))
    order = sorted(places)
    slots = {i: slot for slot, i in enumerate(order)}
    indexed = [(z, [slots[i] for i in ids]) for z, ids in scans]
    state = np.concatenate([made.poses.ravel(), *(places[i] for i in order)])
    return DenseSmoother(moves, indexed, MOTION_STD, **noise), state, order


@pytest.fixture(scope="module")
def example():
    result, moves, scans = recorded()
    return smooth(result), moves, scans


@far_origins
@pytest.mark.parametrize("kind", ["bearing_range", "bearing"])
def test_a_drive_far_from_the_origin_has_the_same_solution(kind, far):
    found = []
    for origin in ((0.0, 0.0), far):
        given = {"initial_pose": (*origin, 0.0), "initial_pose_std": START_STD}
        made = Drive(**NOISE, **given, sensor=kind)
        for odometry, readings, truth in drive(3, 30):
            made.predict(odometry)
            made.update(readings if kind == "bearing_range" else readings[:, :1], IDS)
            made.observe_pose(shifted(truth, origin)[:2], np.eye(3)[:2], np.eye(2))
        found.append(smooth(made, robust="cauchy"))
    near, there = found
    slack, mean = rounding(far, 30), near.belief().mean
    np.testing.assert_allclose(there.poses, shifted(near.poses, far), atol=slack)
    np.testing.assert_allclose(there.belief().mean, shifted(mean, far), atol=slack)
    assert there.cost == pytest.approx(near.cost, rel=12 * rounding(far))
    P, Q = near.belief().covariance, there.belief().covariance
    np.testing.assert_allclose(Q, P, rtol=0, atol=P.max() * 12 * rounding(far))


@pytest.mark.parametrize("robust", [None, "huber", "cauchy"])
def test_steps_that_are_only_rounding_have_found_the_solution(robust):
    made = recorded(seed=24)[0]
    exact = smooth(made, robust=robust, tolerance=1e-17)
    found = smooth(made, robust=robust)
    np.testing.assert_allclose(exact.poses, found.poses, atol=1e-8)


@far_origins
def test_a_start_far_from_the_origin_leads_to_the_same_solution(example, far):
    made, _ = recorded(initial_pose=(*far, 0.0))[:2]
    near = example[0]
    starts = [shifted(near.poses, far), replaced_mean(near.belief(), far)]
    for start in starts:
        there = smooth(made, start=start)
        slack = rounding(far, 12)
        np.testing.assert_allclose(there.poses, shifted(near.poses, far), atol=slack)


def replaced_mean(belief, far):
    """Return a belief about the world at another place."""
    return replace(belief, mean=shifted(belief.mean, far))


def test_solution_cost_and_covariances_are_those_of_dense_least_squares(example):
    made, moves, scans = example
    twin, state, order = dense_twin(made, moves, scans)
    rng = np.random.default_rng(0)
    found, _ = twin.solve(state + 0.01 * rng.standard_normal(len(state)))
    assert found == pytest.approx(state, abs=1e-7)  # differences are good to that
    assert made.cost == pytest.approx((twin.residual(state) ** 2).sum() / 2)
    assert made.cost < made.first_cost
    _, expected = twin.solve(state, iterations=1)
    joint = made.covariance(range(len(made.poses)), order)
    assert joint == pytest.approx(expected, rel=1e-6, abs=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("sensor", "std"),
    [
        (OWN_NOISE.with_noise(range_std_per_metre=0.0), MEASUREMENT_STD),
        (POSITION, (0.1, 0.2)),
        (BEARING, (0.03,)),
        (SENSORS["range"], (0.1,)),
    ],
    ids=lambda value: getattr(value, "name", None),
)
def test_other_sensors_are_smoothed_as_by_dense_least_squares(sensor, std):
    noise = {"measurement_std": std, "sensor": sensor}
    slam = SmoothingSlam(MOTION_STD, initial_pose_std=START_STD, **noise)
    slam.update(np.empty((0, 2)), [])
    moves, scans = [], [(np.empty((0, 2)), [])]
    for odometry, readings, _ in drive(3, 30):
        seen = np.arange(len(readings))
        moves.append(odometry)
        scans.append((sensor.read(*from_bearing_range(*readings.T)), seen))
        slam.predict(odometry)
        slam.update(scans[-1][0][:, : sensor.size], seen)
    made = slam.smoothed()
    known = set(made.landmark_ids)
    assert len(known) >= 3
    scans = [(z[[i in known for i in ids]], [i for i in ids if i in known])
             for z, ids in scans]  # fmt: skip
    twin, state, order = dense_twin(made, moves, scans, **noise)
    assert made.cost == pytest.approx((twin.residual(state) ** 2).sum() / 2)
    found, expected = twin.solve(state + 1e-4, iterations=6)
    assert found == pytest.approx(state, abs=1e-6)
    joint = made.covariance(range(len(made.poses)), order)
    assert joint == pytest.approx(expected, rel=1e-4, abs=1e-7)
    freedom = sensor.size * made.readings - 2 * len(made.landmarks)
    assert made.cost_per_degree == pytest.approx(2 * made.cost / freedom)
    with pytest.raises(ValueError, match="an association accepts only sensor"):
        reassociate(slam.recorded())
    with pytest.raises(ValueError, match=r"start must be finite poses \(31, 3\)"):
        smooth(slam.recorded(), start=made.poses[1:])


def test_scans_without_a_motion_between_them_are_those_of_one_pose():
    rng, slam = np.random.default_rng(8), SmoothingSlam(**NOISE)
    slam.reset((0.0, 0.0, 0.0), START_STD)
    moves, scans = [], [(np.empty((0, 2)), np.empty(0, dtype=int))]
    slam.update(*scans[0])
    for odometry, readings, _ in drive(3, 12):
        slam.predict(odometry)
        again = readings + 0.01 * rng.standard_normal(readings.shape)
        slam.update(readings, range(6))
        slam.update(again, range(6))
        moves.append(odometry)
        scans.append((np.vstack([readings, again]), np.tile(np.arange(6), 2)))
    made = slam.smoothed()
    twin, state, order = dense_twin(made, moves, scans)
    found, expected = twin.solve(state + 0.01 * rng.standard_normal(len(state)))
    assert found == pytest.approx(state, abs=1e-7)
    assert made.cost == pytest.approx((twin.residual(state) ** 2).sum() / 2)
    joint = made.covariance(range(len(made.poses)), order)
    assert joint == pytest.approx(expected, rel=1e-6, abs=1e-9)


def test_landmarks_of_one_scan_that_were_merged_are_smoothed():
    slam = SmoothingSlam(**NOISE)
    for _ in range(3):
        slam.update([(0.1, 2.0), (0.12, 2.05), (1.0, 4.0)], [0, 1, 2])
        slam.predict((0.0, 0.0))
    slam.merge(0, 1)
    assert slam.smoothed().landmark_ids == (0, 2)


def test_readings_of_poses_are_those_of_dense_least_squares():
    """Compass and GPS, one of them turned by 2π, and several at one pose."""
    result, fixes = Drive(**NOISE, initial_pose_std=START_STD), []
    result.end_motion()
    moves, scans = [], [(np.empty((0, 2)), np.empty(0, dtype=int))]
    rng = np.random.default_rng(8)
    for k, (odometry, readings, pose) in enumerate(drive(3, 12), start=1):
        result.predict(odometry)
        result.update(readings, range(6))
        moves.append(odometry)
        scans.append((readings, np.arange(6)))
        for H in ((np.eye(3)[2:], np.eye(3)[:2]), (np.eye(3) + 0.1,), ())[k % 3]:
            z, R = H @ pose + 0.05 * rng.standard_normal(len(H)), 0.01 * np.eye(len(H))
            R[0, -1] += 0.002 * (len(H) > 1)
            R = (R + R.T) / 2
            z = z + 2 * np.pi * (len(H) == 1)
            result.observe_pose(z, H, R)
            fixes.append((k, z, H, R))
    made = smooth(result)
    twin, state, order = dense_twin(made, moves, scans)
    twin.fixes = fixes
    found, expected = twin.solve(state + 0.01 * rng.standard_normal(len(state)))
    assert found == pytest.approx(state, abs=1e-7)
    assert made.cost == pytest.approx((twin.residual(state) ** 2).sum() / 2)
    joint = made.covariance(range(len(made.poses)), order)
    assert joint == pytest.approx(expected, rel=1e-6, abs=1e-9)
    components = sum(len(H) for _, _, H, _ in fixes)
    freedom = 2 * 6 * 12 - 2 * 6 + components
    assert made.cost_per_degree == pytest.approx(2 * made.cost / freedom)


def test_a_robust_kernel_weighs_a_pose_reading_by_all_its_numbers():
    for axis in range(3):
        made = Drive(**NOISE, initial_pose_std=(0.1, 0.1, 0.1))
        made.update([(0.0, 2.0)], [0])  # of a new landmark, so it says nothing
        made.observe_pose(0.6 * np.eye(3)[axis], np.eye(3), 0.01 * np.eye(3))
        found, x = smooth(made, robust="cauchy"), np.linspace(0, 0.6, 60001)
        tail = np.log1p(((x - 0.6) / 0.1 / 2.3849) ** 2)
        cost = (x / 0.1) ** 2 / 2 + 2.3849**2 / 2 * tail
        assert found.poses[0, axis] == pytest.approx(x[cost.argmin()], abs=1e-4)
        assert found.cost == pytest.approx(cost.min())


def test_only_the_heading_of_a_pose_reading_is_wrapped_in_any_order_of_components():
    costs = []
    for order in permutations(range(3)):
        result, *_ = recorded()
        H = np.eye(3)[[*order]]
        z = H @ smooth(result).poses[-1] + H @ (20.0, -20.0, 2 * np.pi)
        result.observe_pose(z, H, H @ np.diag((100.0, 100.0, 0.01)) @ H.T)
        costs.append(smooth(result).cost)
    assert costs[0] > 1
    assert costs == pytest.approx([costs[0]] * len(costs), rel=1e-9)


def test_a_recorded_filter_smooths_its_readings_of_poses():
    slam = SmoothingSlam(**NOISE, initial_pose_std=START_STD, gate_probability=0.99)
    direct = Drive(**NOISE, initial_pose_std=START_STD)
    for odometry, readings, pose in drive(3, 12):
        for each in (slam, direct):
            each.predict(odometry)
            each.update(readings, range(6))
            each.observe_pose(pose[2], [0, 0, 1], 1e-4)
        report = slam.observe_pose(pose[2] + 1, [0, 0, 1], 1e-4)  # the gate rejects it
        assert report.degrees_of_freedom == 0
    found, expected = slam.smoothed(), smooth(direct)
    assert found.poses == pytest.approx(expected.poses, abs=1e-8)
    assert (found.pose_covariances[1:, 2, 2] < 1e-4).all()


def test_marginals_are_parts_of_the_joint_covariance(example):
    made, *_ = example
    first, last = made.pose_covariances[0], made.pose_covariances[-1]
    pair = made.covariance([-1, 0], [])
    assert pair[:3, :3] == pytest.approx(last)
    assert pair[3:, 3:] == pytest.approx(first)
    belief = made.belief(landmark_ids=[4, 0])
    places = dict(zip(made.landmark_ids, made.landmarks, strict=True))
    covariances = dict(zip(made.landmark_ids, made.landmark_covariances, strict=True))
    assert belief.landmarks.tolist() == [places[4].tolist(), places[0].tolist()]
    assert belief.landmark_covariances[1] == pytest.approx(covariances[0])
    assert belief.pose_covariance == pytest.approx(last)
    assert belief.pose.tolist() == made.poses[-1].tolist()


@pytest.mark.parametrize("steps", [15, 2 * PART, 2 * PART + 90])
def test_a_linear_drive_is_smoothed_as_rauch_tung_and_striebel_do(steps):
    rng = np.random.default_rng(1)
    motion_std, range_std, places = 0.3, 0.1, np.array([40.0, 50.0])
    made = Drive((motion_std, 0, 0), (0.1, range_std), initial_pose_std=(0.5, 0, 0))
    x, readings, moves = 0.5 * rng.standard_normal(), [], rng.uniform(0.2, 1.0, steps)
    moves[1::2] *= -1
    for k in range(steps):
        if k:
            x += moves[k] + motion_std * rng.standard_normal()
            made.predict((moves[k], 0.0))
        seen = [0] if k % 3 or k > 0.6 * steps else [0, 1]
        ranges = places[seen] - x + range_std * rng.standard_normal(len(seen))
        made.update(np.column_stack([np.zeros(len(seen)), ranges]), seen)
        readings.append((seen, ranges))
    smoothed = smooth(made)
    means, covariances = rauch_tung_striebel(
        readings, moves, 0.5, motion_std, range_std
    )
    assert smoothed.poses[:, 0] == pytest.approx(means[:, 0], abs=1e-11)
    assert smoothed.landmarks[:, 0] == pytest.approx(means[-1, 1:], abs=1e-11)
    every = rng.permutation(steps)
    for k in every[:100]:
        part = smoothed.covariance([k])[np.ix_([0, 3, 5], [0, 3, 5])]
        assert part == pytest.approx(covariances[k], rel=1e-11, abs=1e-12)
    assert not smoothed.poses[:, 1:].any()
    found, expected = smoothed.pose_covariances, np.array(covariances)
    assert found[:, 0, 0] == pytest.approx(expected[:, 0, 0], rel=1e-11)
    assert smoothed.covariances_of(every) == pytest.approx(found[every], rel=1e-11)
    assert smoothed.covariances_of([-1])[0].tolist() == found[-1].tolist()


def rauch_tung_striebel(readings, moves, start_std, motion_std, range_std):
    """Filter (x, l0, l1) forwards from the first scan, then smooth backwards."""
    mean = np.array([0.0, *readings[0][1]])
    P = np.full((3, 3), start_std**2) + np.diag([0, 1, 1]) * range_std**2
    Q = np.diag([motion_std**2, 0, 0])
    filtered_, predicted = [(mean, P)], [(mean, P)]
    for move, (seen, ranges) in zip(moves[1:], readings[1:], strict=True):
        mean = mean + np.array([move, 0, 0])
        P = P + Q
        predicted.append((mean, P))
        for i, z in zip(seen, ranges, strict=True):
            H = np.array([-1.0, *(np.arange(2) == i)])
            K = P @ H / (H @ P @ H + range_std**2)
            mean = mean + K * (z - H @ mean)
            T = np.eye(3) - np.outer(K, H)
            P = T @ P @ T.T + np.outer(K, K) * range_std**2
        filtered_.append((mean, P))
    means, covariances = [mean], [P]
    for (m, P), (m1, P1) in zip(filtered_[-2::-1], predicted[:0:-1], strict=True):
        G = np.linalg.solve(P1, P).T
        means.insert(0, m + G @ (means[0] - m1))
        covariances.insert(0, P + G @ (covariances[0] - P1) @ G.T)
    return np.array(means), covariances


def test_gtsam_finds_the_same_poses_landmarks_and_marginals():
    gtsam = pytest.importorskip("gtsam", reason="solves the same graph")
    import gtsam_batch

    made, moves, scans = recorded(seed=4, steps=60)
    smoothed, (poses, places) = smooth(made), start_of(made)
    settings = (MOTION_STD, MEASUREMENT_STD, START_STD)
    graph = gtsam_batch.graph_of(moves, scans, *settings)
    solution = gtsam_batch.solve(graph, gtsam_batch.values_of(poses, places))
    assert graph.error(solution) == pytest.approx(smoothed.cost, rel=1e-12)
    marginals = gtsam.Marginals(graph, solution)
    for k in range(made.poses):
        gap = gtsam_batch.pose_of(solution, k) - smoothed.poses[k]
        assert np.append(gap[:2], wrap_angle(gap[2])) == pytest.approx(0, abs=1e-8)
        theirs = gtsam_batch.world_covariance(marginals, solution, k)
        ours = smoothed.pose_covariances[k]
        assert theirs == pytest.approx(ours, rel=1e-6, abs=1e-6 * abs(ours).max())
    for i, ours in enumerate(smoothed.landmark_covariances):
        key = gtsam_batch.L(smoothed.landmark_ids[i])
        assert solution.atPoint2(key) == pytest.approx(smoothed.landmarks[i], abs=1e-8)
        theirs = marginals.marginalCovariance(key)
        assert theirs == pytest.approx(ours, rel=1e-6, abs=1e-6 * abs(ours).max())


def test_a_motion_without_noise_in_a_direction_is_kept_exactly():
    made, moves, _ = recorded(motion_std=(0.05, 0.0, 0.02))
    poses = smooth(made).poses
    cos, sin = np.cos(poses[:-1, 2]), np.sin(poses[:-1, 2])
    dx, dy = np.diff(poses[:, :2], axis=0).T
    assert cos * dy - sin * dx == pytest.approx(0, abs=1e-12)
    assert np.hypot(dx, dy) != pytest.approx([d for d, _ in moves], abs=1e-3)


def test_noise_that_vanishes_tends_to_a_motion_without_noise():
    exact, nearly = (
        smooth(recorded(motion_std=(0.05, std, 0.02))[0]) for std in (0.0, 1e-5)
    )
    assert nearly.poses == pytest.approx(exact.poses, abs=1e-6)
    assert nearly.pose_covariances == pytest.approx(exact.pose_covariances, rel=1e-4)


def test_a_known_start_does_not_move():
    made, *_ = recorded(start_std=(0, 0, 0))
    smoothed = smooth(made)
    assert smoothed.poses[0].tolist() == [0, 0, 0]
    assert not smoothed.pose_covariances[0].any()


def test_composed_odometry_is_one_motion():
    parts, whole = (Drive((0.1, 0.1, 0.05), (0.02, 0.1)) for _ in range(2))
    for made in (parts, whole):
        made.update([(0.3, 5.0), (-0.8, 4.0)], [0, 1])
    parts.predict((0.0, 0.2), 0.0)  # a turn without noise, then a drive
    parts.predict((1.0, 0.2), 1.0)
    turned = np.array([np.cos(0.2), np.sin(0.2), 0.4])
    assert parts.poses == 1
    for made in (parts, whole):
        if made is whole:
            made.predict((1.0, 0.4))
        made.update([(-0.2, 4.2), (-1.4, 4.1)], [0, 1])
    assert parts.motions[1].increment == pytest.approx(turned)
    spread = np.diag([0.01, 0.01, 0.0025])
    assert parts.motions[1].covariance == pytest.approx(spread)
    assert smooth(parts).cost != pytest.approx(smooth(whole).cost)


def test_odometry_over_several_readings_has_the_noise_of_a_filter():
    made = Drive((0.1, 0.05, 0.03), (0.02, 0.1), initial_pose=(1.0, 2.0, 0.5))
    noise = {"motion_std": (0.1, 0.05, 0.03), "measurement_std": (0.02, 0.1)}
    slam = make_estimator("ekf", **noise, initial_pose=(1.0, 2.0, 0.5))
    for odometry, dt in (((1.0, 0.3), 1.0), ((0.5, -0.6), 2.0), ((2.0, 0.1), 0.5)):
        made.predict(odometry, dt)
        slam.predict(odometry, dt)
    made.update([(0.3, 5.0), (1.0, 3.0)], [0, 1])
    smoothed = smooth(made)
    assert smoothed.poses[-1] == pytest.approx(slam.belief().pose)
    assert smoothed.pose_covariances[-1] == pytest.approx(slam.belief().pose_covariance)


@pytest.mark.parametrize("robust", ["huber", "cauchy"])
def test_a_robust_kernel_finds_a_minimum_and_discounts_an_outlier(robust):
    made, moves, scans = recorded()
    readings, _ = scans[5]
    readings[0] += (0.4, -1.5)
    plain, robustly = (
        smooth(spoiled(moves, scans), robust=kernel) for kernel in (None, robust)
    )
    clean = smooth(made)
    assert (
        abs(robustly.poses - clean.poses).max()
        < abs(plain.poses - clean.poses).max() / 3
    )
    scale = {"huber": 1.345, "cauchy": 2.3849}[robust]
    twin, state, _ = dense_twin(robustly, moves, scans)

    def cost(state):
        residual = twin.residual(state)
        rows = 3 * len(scans)
        e = np.hypot(*residual[rows:].reshape(-1, 2).T)
        tail = {
            "huber": np.where(e < scale, e**2 / 2, scale * e - scale**2 / 2),
            "cauchy": scale**2 / 2 * np.log1p((e / scale) ** 2),
        }
        return (residual[:rows] ** 2).sum() / 2 + tail[robust].sum()

    assert cost(state) == pytest.approx(robustly.cost)
    gradient = [
        cost(state + 1e-6 * e) - cost(state - 1e-6 * e) for e in np.eye(len(state))
    ]
    assert np.array(gradient) / 2e-6 == pytest.approx(0, abs=1e-4)


def spoiled(moves, scans):
    made = Drive(MOTION_STD, MEASUREMENT_STD, initial_pose_std=START_STD)
    made.end_motion()
    for move, (readings, seen) in zip(moves, scans[1:], strict=True):
        made.predict(move)
        made.update(readings, seen)
    return made


def test_noise_that_grows_with_the_range_is_that_of_the_expected_range():
    sensor = BEARING_RANGE.with_noise(range_std_per_metre=0.02)
    made, *_ = recorded(measurement_std=(0.02, 0.0), sensor=sensor)
    smoothed = smooth(made)
    fixed, *_ = recorded(measurement_std=(0.02, 0.1))
    assert smoothed.cost != pytest.approx(smooth(fixed).cost, rel=1e-2)
    sensor = sensor.with_noise(range_noise_at="reading")
    read, *_ = recorded(measurement_std=(0.02, 0.0), sensor=sensor)
    assert not np.allclose(smooth(read).poses, smoothed.poses, atol=1e-4)


@pytest.mark.slow
def test_noise_that_grows_by_a_function_of_ones_own_is_taken_at_the_solution():
    noise = {"measurement_std": (0.02, 0.02)}
    one, other = (
        smooth(recorded(sensor=sensor, **noise)[0])
        for sensor in (OWN_NOISE, SHIPPED_NOISE)
    )
    assert one.poses == pytest.approx(other.poses, abs=1e-12)


def test_a_sensor_of_positions_is_smoothed_as_dense_least_squares():
    std, sensor = (0.005, 0.1), BEARING_RANGE.with_noise(bearing_std_metres=0.1)
    as_read = sensor.with_noise(range_noise_at="reading")
    drive_, moves, scans = recorded(measurement_std=std, sensor=as_read)
    made = smooth(drive_)
    twin, state, order = dense_twin(
        made, moves, scans, measurement_std=std, bearing_std_metres=0.1
    )
    assert made.cost == pytest.approx((twin.residual(state) ** 2).sum() / 2)
    found, expected = twin.solve(state + 0.001)
    assert found == pytest.approx(state, abs=1e-7)
    joint = made.covariance(range(len(made.poses)), order)
    assert joint == pytest.approx(expected, rel=1e-6, abs=1e-9)
    of_expected, *_ = recorded(measurement_std=std, sensor=sensor)
    assert not np.allclose(smooth(of_expected).poses, made.poses, atol=1e-5)


def test_the_smoother_takes_the_noise_of_its_filter():
    sensor = BEARING_RANGE.with_noise(bearing_std_metres=0.1)
    noise = {"measurement_std": (0.0, 0.1), "sensor": sensor}
    slam = SmoothingSlam(MOTION_STD, initial_pose_std=START_STD, **noise)
    made, moves, scans = recorded(**noise)
    for move, (readings, seen) in zip(moves, scans[1:], strict=True):
        slam.predict(move)
        slam.update(readings, seen)
    assert smooth(made).poses[-1] == pytest.approx(slam.smoothed().poses[-1], abs=1e-5)


def test_a_landmark_on_the_wrong_side_of_the_path_is_moved():
    made, *_ = recorded(steps=40, start_std=(0, 0, 0))
    found = smooth(made)
    places = dict(zip(found.landmark_ids, found.landmarks, strict=True))
    mirrored = places | {0: places[0] * (1, -1)}
    again = smooth(made, start=found.poses, landmarks=mirrored)
    assert again.landmarks == pytest.approx(found.landmarks, abs=1e-7)


def test_the_start_does_not_change_the_solution():
    made, *_ = recorded(steps=30)
    found = smooth(made)
    poses = found.poses + 0.05 * np.random.default_rng(0).standard_normal((31, 3))
    again = smooth(made, start=poses)
    spoilt = smooth(made, landmarks={0: found.landmarks[0] + 0.5})
    assert spoilt.first_cost > found.first_cost + 1.0
    assert spoilt.landmarks == pytest.approx(found.landmarks, abs=1e-8)
    made.predict((1.0, 0.0))  # what is smoothed does not follow the drive
    made.end_motion()
    assert len(found.path) == 31
    assert again.poses == pytest.approx(found.poses, abs=1e-8)
    assert again.landmarks == pytest.approx(found.landmarks, abs=1e-8)


def test_every_option_reaches_the_smoothing_of_a_repaired_drive(monkeypatch):
    calls, (made, *_) = [], recorded(steps=2)

    def smoothing(drive, **options):
        calls.append(options)
        if len(calls) == 1:
            raise np.linalg.LinAlgError

    def repaired(drive, start):
        return SimpleNamespace(drive=drive, poses=start)

    monkeypatch.setattr(batch_smoother, "smooth", smoothing)
    monkeypatch.setattr(batch_smoother, "reassociate", repaired)
    options = {"robust": "huber", "robust_scale": 2.0, "tolerance": 1e-5}
    options |= {"iterations": 7}
    smooth(made, start="poses", associate=True, **options)
    assert calls == [{"start": "poses", **options}, options]


def test_what_cannot_be_smoothed_is_refused(monkeypatch):
    made, *_ = recorded()
    with pytest.raises(np.linalg.LinAlgError, match="did not converge in 1 iteration"):
        smooth(made, iterations=1)
    with pytest.raises(ValueError, match="landmark 77 has no reading in the drive"):
        smooth(made, landmarks={77: (1.0, 2.0)})
    with pytest.raises(ValueError, match="landmark 77 has no reading in the drive"):
        smooth(made).belief(landmark_ids=[77])
    blind = Drive(**NOISE)
    blind.predict((1.0, 0.0))
    with pytest.raises(ValueError, match="must hold readings of landmarks, got none"):
        smooth(blind)
    with pytest.raises(ValueError, match=r"measurement_std must be > 0 to smooth"):
        Drive(MOTION_STD, (0.1, 0.0))

    def damped(_, state):
        state.moved, state.is_damped = 1e-9, True

    monkeypatch.setattr(Optimiser, "_descend", damped)
    with pytest.raises(np.linalg.LinAlgError, match="did not converge in 2 iterations"):
        smooth(made, iterations=2)


def test_a_cost_that_no_longer_falls_significantly_is_a_solution():
    made, *_ = recorded()
    exact, enough = smooth(made), smooth(made, iterations=3)
    assert exact.iterations > enough.iterations == 3
    assert exact.cost < enough.cost < exact.cost + 0.02
    gaps = enough.landmarks - exact.landmarks
    stds = np.sqrt(np.diagonal(exact.landmark_covariances, axis1=1, axis2=2))
    assert (abs(gaps) < 0.2 * stds).all()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"start": np.zeros((2, 3))}, r"start must be finite poses \(13, 3\), got"),
        ({"robust": "tukey"}, "robust must be 'huber' or 'cauchy', got 'tukey'"),
        ({"robust": "huber", "robust_scale": 0}, "robust_scale must be .* > 0, got 0"),
        ({"tolerance": 0}, "tolerance must be a finite number > 0, got 0"),
        ({"iterations": 0}, "iterations must be a whole number >= 1, got 0"),
        ({"landmarks": {0: (1, np.nan)}}, r"landmarks\[0\] must be 2 finite numbers"),
    ],
)
def test_wrong_arguments_are_named(arguments, message):
    made, *_ = recorded()
    with pytest.raises(ValueError, match=message):
        smooth(made, **arguments)


@pytest.mark.parametrize(
    ("scan", "ids"),
    [([(0.0, np.nan)], [0]), ([(0.0, 1.0)], [0, 1]), ([(0, 1), (0, 2)], [3, 3])],
)
def test_a_refused_scan_leaves_the_drive_as_it_was(scan, ids):
    made, *_ = recorded(steps=2)
    made.predict((1.0, 0.0))
    before = repr(made)
    with pytest.raises(ValueError, match=r"measurements|landmark_ids"):
        made.update(scan, ids)
    assert repr(made) == before
    assert made.poses == 3


def test_readings_below_the_minimum_range_are_skipped():
    made = Drive(MOTION_STD, MEASUREMENT_STD, min_range=1.0)
    made.update([(0.0, 0.99), (0.1, 2.0), (0.2, 1.0)], [0, 9, 2])
    assert made.landmark_ids == (9, 2)  # in the order of the readings


def test_a_reading_of_a_pose_without_a_scan_has_a_pose_of_its_own():
    made = Drive(**NOISE)
    made.update([(0.0, 2.0)], [3])
    made.predict((1.0, 0.0))
    made.observe_pose(0.1, [0, 0, 1], 0.01)
    assert made.poses == 2
    assert [len(made.pose_readings(k)) for k in range(2)] == [0, 1]
    other = made.with_scans([made.sightings(0)._replace(ids=np.array([8]))])
    assert (made.landmark_ids, other.landmark_ids) == ((3,), (8,))
    made.predict((1.0, 0.0))
    other = made.with_scans(made.scans)
    for each in (other, made):  # each has its own motions and readings
        each.observe_pose(0.1, [0, 0, 1], 0.01)
        each.observe_pose([1.0, 2.0], np.eye(2, 3), np.eye(2))
        assert (each.poses, each.pose_components) == (3, 4)


def test_a_path_between_scans_is_its_mean_given_both_of_its_ends():
    """The noise of all readings, conditioned on the last pose, to first order."""
    noise = MotionNoise.checked((0.2, 0.1, 0.15), noise_at_rest=True)
    steps = [(1.0, 0.5, 1.0), (0.7, -0.9, 2.0), (1.2, 0.4, 0.5)]

    def path(slips):
        pose, found = np.zeros(3), []
        for (*odometry, _), slip in zip(steps, slips.reshape(-1, 3), strict=True):
            moved = predict_pose(pose, odometry)
            pose = moved.pose + moved.jacobian_noise @ slip
            found.append(pose)
        return np.concatenate(found)

    made = Drive((0.2, 0.1, 0.15), MEASUREMENT_STD)
    made.update([(0.0, 3.0)], [1])
    for *odometry, dt in steps:
        made.predict(odometry, dt)
    made.update([(0.0, 3.0)], [1])
    nominal, J = path(np.zeros(9)), numeric_jacobian(path, np.zeros(9))
    variances = np.concatenate([noise.variance * dt for *_, dt in steps])
    P = J @ np.diag(variances) @ J.T
    gap, first = np.array([0.1, -0.2, 0.05]), np.array([1.0, 2.0, 0.6])
    inside = (nominal + P[:, 6:] @ np.linalg.solve(P[6:, 6:], gap)).reshape(3, 3)
    turn = pose_rotation(0.6)
    ends = np.array([first, first + turn @ inside[-1]])
    expected = [first, *(first + turn @ pose for pose in inside)]
    found = path_between(ends, made.motions, noise)
    np.testing.assert_allclose(found, expected, atol=1e-8)


def test_a_drive_assumes_by_default_what_filters_assume():
    kinds = Drive, SmoothingSlam, EkfSlam
    defaults = [
        {name: each.default for name, each in signature(kind).parameters.items()}
        for kind in kinds
    ]
    shared = set.intersection(*map(set, defaults))
    assert {"min_range", "noise_at_rest", "motion", "initial_pose_std"} <= shared
    for name in shared:
        ours, smoothers, theirs = (each[name] for each in defaults)
        assert ours == smoothers == theirs, name


def test_scans_that_repeat_landmarks_are_split_where_they_repeat():
    ids = np.array([3, 5, 3, 3, 9, 5])
    parts = list(Sightings(np.arange(12.0).reshape(6, 2), ids).distinct())
    assert [part.ids.tolist() for part in parts] == [[3, 5, 9], [3, 5], [3]]
    rows = [(part.measurements[:, 0] / 2).tolist() for part in parts]
    assert rows == [[0, 1, 4], [2, 5], [3]]
    assert not list(Sightings(np.empty((0, 2)), ids[:0]).distinct())


def test_a_drive_is_made_again_from_the_options_of_its_filter():
    settings = {"initial_pose": (1.0, 2.0, 0.5), "noise_at_rest": False}
    settings |= {"min_range": 0.3, "motion": "differential[track_width=0.4]"}
    made = Drive((0.1, 0.2, 0.3), (0.4, 0.5), initial_pose_std=START_STD, **settings)
    again = Drive(**filter_options(made))
    for name in ("initial_pose", "initial_pose_std", "rules", "sensor"):
        np.testing.assert_array_equal(getattr(again, name), getattr(made, name))
    one, other = again.motion_noise, made.motion_noise
    assert (one.motion, one.at_rest) == (other.motion, other.at_rest)
    np.testing.assert_allclose(one.variance, other.variance)


def test_landmarks_are_ordered_by_their_last_reading_and_counted_backwards():
    rng = np.random.default_rng(2)
    ids, firsts = rng.integers(0, 9, 40), np.sort(rng.integers(0, 41, 12))
    firsts[[0, -1]] = 0, 40
    order, widths = landmark_order(ids, firsts)
    last = {i: k for k, i in enumerate(ids.tolist())}
    assert order.tolist() == sorted(last, key=last.get, reverse=True)
    later = [len({*ids[first:].tolist()}) for first in firsts[:-1]]
    assert widths.tolist() == [2 * count for count in later]


def test_an_iterate_expects_its_steps_to_shrink_as_the_last_one_did():
    def at(x):
        return Estimate(np.array([[0.0, x, 1.0]]), np.zeros(2))

    state = _Iterate(at(0.0), np.ones((1, 2)))
    state.cost, found = 100.0, []
    for x, cost in ((1.0, 60.0), (1.25, 50.0), (1.45, 44.0), (1.3, 44.0)):
        state.move(at(x), cost)
        found.append((state.moved, state.error, state.remaining, state.cost))
    quarter = 0.25 / (1 - 0.25)
    expected = [(1.0, 1.0, np.inf, 60.0), (0.25, 0.25 * quarter, 10 * quarter, 50.0)]
    expected += [(0.2, 0.2, 6 * 0.6 / 0.4, 44.0), (0.15, 0.15, 0.0, 44.0)]
    np.testing.assert_allclose(found, expected)
    state.damping, found = 1e-2, []
    for x in (1.0, 2.0, 3.0, 4.0):
        state.move(at(x), 44.0)
        found.append((state.damping, state.is_damped))
    assert [damped for _, damped in found] == [True, True, True, False]
    np.testing.assert_allclose([d for d, _ in found], [1e-3, 1e-4, 0, 0], rtol=1e-9)
    turned = Estimate(np.array([[0.0, 4.0, 1.0 - 2 * np.pi]]), np.zeros(2))
    state.move(turned, 44.0)
    assert state.moved == pytest.approx(0.0, abs=1e-12)


def test_a_cost_is_plausible_up_to_its_mean_and_six_deviations(example):
    made = example[0]
    freedom = 2 * made.readings - 2 * len(made.landmarks)
    expected = 0.6 * freedom + 6 * np.sqrt(freedom / 2) + 1
    assert made._optimiser.plausible_cost == pytest.approx(expected)
    drive_ = recorded()[0]
    drive_.observe_pose((1.0, 2.0), np.eye(2, 3), np.eye(2))
    optimiser = smooth(drive_)._optimiser
    expected = 0.6 * (freedom + 2) + 6 * np.sqrt((freedom + 2) / 2) + 1
    assert optimiser.plausible_cost == pytest.approx(expected)


def test_readings_that_a_filter_skips_are_not_in_its_drive():
    slam = RecordedSlam(make_estimator("ekf", min_range=1.0, **NOISE), **NOISE)
    slam.update([(0.0, 0.5), (0.1, 2.0)], [0, 1])
    assert slam.recorded().landmark_ids == slam.landmark_ids == (1,)


@pytest.mark.parametrize("backdate", [False, True])
def test_management_gives_its_associations_to_the_drive(backdate):
    policy = {"confirm": [3, 5], "backdate": backdate}
    slam = ManagedSlam(SmoothingSlam, management=policy, **NOISE)
    plain = Drive(**NOISE)
    for odometry, readings, _ in drive(5, 40, landmarks=SIX):
        slam.predict(odometry)
        slam.update(readings)
        plain.predict(odometry)
        plain.update(readings, range(6))
    smoothed, expected = slam.filter.smoothed(), smooth(plain)
    gaps = np.linalg.norm(smoothed.landmarks[:, None] - expected.landmarks, axis=2)
    assert sorted(gaps.argmin(axis=1)) == [0, 1, 2, 3, 4, 5]
    made = slam.filter.recorded()
    assert made.poses == 41
    assert (made.readings > 6 * 38) == backdate  # confirmed at the third sight
    if backdate:
        assert smoothed.poses == pytest.approx(expected.poses, abs=0.05)


def test_merged_and_removed_landmarks_leave_the_drive():
    slam = SmoothingSlam(**NOISE)
    slam.update([(0.1, 2.0), (0.4, 3.0)], [0, 1])
    slam.predict((0.5, 0.0))
    slam.update([(0.15, 1.6), (1.0, 2.0)], [2, 3])
    slam.merge(0, 2)
    gone = [3]
    slam.remove(gone)
    gone.clear()
    assert slam.landmark_ids == slam.smoothed().landmark_ids == (0, 1)
    inside = make_estimator("ekf", management={"merge_within": 1.0}, **NOISE)
    slam = RecordedSlam(inside, **NOISE)
    for k in range(40):
        slam.update([(0.1, 2.0), (1.0, 3.0)], [k % 2, 9])
        slam.predict((0.0, 0.0), 3.0)
    assert slam.landmark_ids == slam.recorded().landmark_ids == (0, 9)
    assert slam.recorded().motions[1].steps == ((0.0, 0.0, 3.0),)


def test_a_filter_that_goes_back_takes_its_drive_back():
    slam = SmoothingSlam(**NOISE)
    slam.update([(0.1, 2.0)], [0])
    before, expected = slam.state_dict(), slam.smoothed()
    slam.predict((0.5, 0.0))
    slam.update([(0.15, 1.6), (1.0, 2.0)], [0, 3])
    slam.load_state_dict(before)
    assert repr(slam.smoothed()) == repr(expected)
    with pytest.raises(ValueError, match="state must hold 'recorded_events'"):
        slam.load_state_dict(make_estimator("invariant", **NOISE).state_dict())
    start, std = np.array([1.0, 0.0, 4.0]), np.zeros(3)
    slam.reset(start, std)
    start[:], std[:] = 9.0, 9.0  # the recorder has copies
    slam.update([(0.1, 2.0)], [0])
    poses = [[1.0, 0.0, 4.0 - 2 * np.pi]]
    assert slam.smoothed().poses == pytest.approx(np.array(poses))
    assert slam.smoothed().belief().frame == "invariant"
    other = SmoothingSlam(**NOISE)
    other.load_state_dict(slam.state_dict())
    assert other.smoothed().poses == pytest.approx(np.array(poses))
    for load in (slam.load_state_dict, slam.restore):
        load(before)
        assert repr(slam.smoothed()) == repr(expected)
        assert slam.report() == UpdateReport()
        slam.predict((0.5, 0.0))


def test_recording_does_not_change_the_filter():
    alone, slam = make_estimator("invariant", **NOISE), SmoothingSlam(**NOISE)
    for odometry, readings, _ in drive(6, 5):
        for each in (alone, slam):
            each.predict(odometry)
            each.update(readings, list(range(6)))
    assert slam.belief().mean.tolist() == alone.belief().mean.tolist()
    assert slam.recorded().readings == 30
    assert slam.landmark_ids == alone.landmark_ids


def test_the_smoother_follows_any_filter_and_refuses_what_it_cannot_take():
    gated = SmoothingSlam(follow="ekf", gate_probability=0.99, **NOISE)
    gated.update([(0.1, 2.0)], [0])
    for reading in ((0.1, 2.0), (0.1, 9.0)):
        gated.update([reading], [0])
    assert gated.recorded().readings == 2
    keywords = {"min_range": 0.1, "gate_probability": 0.9, "robust": "huber"}
    name = "ekf[min_range=2.0, gate_probability=0.5]"  # its options come first
    slam = SmoothingSlam(follow=name, robust_scale=3.0, **keywords, **NOISE)
    slam.update([(0.1, 1.5), (0.4, 3.0)], [0, 1])
    assert slam.recorded().landmark_ids == (1,)
    assert slam.inside.rules.gate == pytest.approx(-2 * np.log(0.5))
    assert slam.kernel == {"robust": "huber", "robust_scale": 3.0}
    with pytest.raises(TypeError, match="gate_probabilty"):
        SmoothingSlam(gate_probabilty=0.99, **NOISE)
    with pytest.raises(ValueError, match="robust must be"):
        SmoothingSlam(robust="tukey", **NOISE)
