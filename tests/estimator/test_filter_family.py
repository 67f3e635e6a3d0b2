"""Deterministic properties of every filter of the family."""

import tracemalloc
from itertools import product

import numpy as np
import pytest
from comparison import assert_close_beliefs, assert_same_bits, digest
from dense_ekf import DenseEkf
from dense_family import TWINS, DenseAdaptiveInvariant, belief_of
from dense_family import tell_truth as tell
from drives import MEASUREMENT_STD, MOTION_STD, NOISE, SIX, drive
from far_origins import far_origins, rounding, shifted

from slamgym.estimator import (
    EkfSlam,
    list_estimators,
    make_batch,
    make_estimator,
    register_estimator,
)
from slamgym.estimator.smoother.recorded_slam import RecordedSlam

IDS = list(range(6))
TRUE_MAP = dict(enumerate(SIX))
START_STD = (0.05, 0.05, 0.02)


FAMILY = {
    **TWINS,
    "submaps": DenseAdaptiveInvariant,
    "sparse_information": DenseEkf,  # where all landmarks may be linked
}
BLIND_TO_A_TURN = [
    "invariant",
    "invariant[iterations=1]",
    "invariant[iterations=2]",
    "first_estimates",
    "observability_constrained",
    "robocentric",
    "ideal",
    "compressed[base=invariant]",
    "submaps",
]


def make(case, **changes):
    exact = {"active_bound": None, "dense_limit": 0}
    more = exact if case == "sparse_information" else {}
    return make_estimator(case, **{**NOISE, **more, **changes})


def tell_truth(slam, pose, landmarks=TRUE_MAP):
    tell(slam, pose, landmarks)


def drive_all(seed, steps, *slams):
    for odometry, readings, truth in drive(seed, steps):
        for slam in slams:
            tell_truth(slam, truth)
            slam.predict(odometry)
            slam.update(readings, IDS)


def test_every_registered_estimator_is_in_the_family():
    assert {case.partition("[")[0] for case in FAMILY} == set(list_estimators())


@pytest.mark.parametrize("steps", [60, pytest.param(400, marks=pytest.mark.slow)])
@pytest.mark.parametrize("case", FAMILY)
def test_equals_its_slow_dense_twin(case, steps):
    steps = min(steps, 150) if case == "unscented" else steps
    twin = FAMILY[case](MOTION_STD, MEASUREMENT_STD, START_STD)
    fast = make(case, initial_pose_std=START_STD)
    rng, nis = np.random.default_rng(1), []
    for each in (fast, twin):
        tell_truth(each, np.zeros(3))
    for odometry, readings, truth in drive(4, steps):
        seen = np.flatnonzero(rng.random(6) < 0.6)
        for each in (fast, twin):
            tell_truth(each, truth)
            each.predict(odometry)
        report = fast.update(readings[seen], seen)
        nis.append((report.nis, twin.update(readings[seen], seen.tolist())))
    np.testing.assert_allclose(*np.transpose(nis), rtol=1e-6, atol=1e-9)
    mean, covariance = belief_of(twin)
    belief = fast.belief()
    assert list(belief.landmark_ids) == twin.ids
    np.testing.assert_allclose(belief.mean, mean, rtol=0, atol=1e-10)
    np.testing.assert_allclose(belief.covariance, covariance, rtol=0, atol=1e-10)


ROUGH = {"motion_std": (0.1, 0.05, 0.3), "measurement_std": (0.1, 0.05)}


def rough_drive(seed, steps):
    """A coarse sensor, and a heading that jumps by half a radian now and then."""
    rng = np.random.default_rng(seed)
    for step, (odometry, exact, _) in enumerate(drive(seed, steps)):
        noise = rng.standard_normal((6, 2)) * (0.1, 0.15)
        readings = exact + noise * np.column_stack([np.ones(6), exact[:, 1]])
        readings[:, 0] += 0.5 * (step % 7 == 0)  # odometry tells nothing of this turn
        seen = np.flatnonzero(readings[:, 1] > 1)
        yield odometry, readings[seen], seen


@pytest.mark.parametrize(
    "case", ["invariant", "invariant[iterations=2]", "compressed[base=invariant]"]
)
def test_relinearises_as_its_slow_dense_twin(case):
    options = {**ROUGH, "range_std_per_metre": 0.1}
    twin = FAMILY[case](*ROUGH.values(), START_STD)
    twin.range_std_per_metre = 0.1
    fast = make(case, **options, initial_pose_std=START_STD)
    once = make("invariant", **options, initial_pose_std=START_STD, iterations=1)
    for odometry, readings, ids in rough_drive(4, 80):
        for each in (fast, once, twin):
            each.predict(odometry)
        report = fast.update(readings, ids)
        assert report.nis == pytest.approx(twin.update(readings, ids.tolist()))
        once.update(readings, ids)
    belief, (mean, covariance) = fast.belief(), belief_of(twin)
    np.testing.assert_allclose(belief.mean, mean, rtol=0, atol=1e-9)
    np.testing.assert_allclose(belief.covariance, covariance, rtol=0, atol=1e-9)
    assert np.abs(once.belief().mean - belief.mean).max() > 0.1


def test_relinearises_alike_in_a_batch_and_alone():
    slam = make("invariant", **ROUGH)
    batch = make_batch("invariant", runs=1, landmarks=6, **ROUGH)
    for odometry, readings, ids in rough_drive(5, 60):
        slam.predict(odometry)
        slam.update(readings, ids)
        scan, visible = np.zeros((1, 6, 2)), np.zeros((1, 6), dtype=bool)
        scan[0, ids], visible[0, ids] = readings, True
        batch.step(odometry[None], scan, visible, np.ones(1))
    alone, together = slam.belief(), batch.belief(0)
    order = [together.landmark_ids.index(i) for i in alone.landmark_ids]
    assert order == list(range(6))
    assert_same_bits(alone, together)


def test_scans_that_relinearise_do_not_depend_on_the_order_of_readings():
    one, other = make("invariant", **ROUGH), make("invariant", **ROUGH)
    rng = np.random.default_rng(0)
    for step, (odometry, readings, ids) in enumerate(rough_drive(6, 40)):
        order = rng.permutation(len(ids)) if step else np.arange(len(ids))
        for each, rows in ((one, np.arange(len(ids))), (other, order)):
            each.predict(odometry)
            each.update(readings[rows], ids[rows])
    landmarks = [each.belief(IDS).landmarks for each in (one, other)]
    np.testing.assert_allclose(*landmarks, rtol=0, atol=1e-9)


@pytest.mark.parametrize("case", FAMILY)
def test_the_order_of_readings_does_not_matter(case):
    one, other = make(case), make(case)
    rng = np.random.default_rng(0)
    landmarks = rng.uniform(-12, 12, (13, 2))  # several blocks of readings
    true_map = dict(enumerate(landmarks))
    drives = drive(1, 60, landmarks=landmarks)
    for step, (odometry, readings, truth) in enumerate(drives):
        order = rng.permutation(13) if step else np.arange(13)
        for each, rows in ((one, np.arange(13)), (other, order)):
            tell_truth(each, truth, true_map)
            each.predict(odometry)
            each.update(readings[rows], rows)
    one, other = one.belief(), other.belief()
    assert_close_beliefs(one, other, 1e-12)


@pytest.mark.parametrize("case", FAMILY)
def test_before_any_correction_the_belief_is_the_ekfs(case):
    certain_heading = case == "unscented"  # whose points feel the curvature otherwise
    motion = (0.05, 0.02, 0.0) if certain_heading else MOTION_STD
    start = (0.05, 0.05, 0.0) if certain_heading else START_STD
    settings = {"motion_std": motion, "initial_pose_std": start}
    slam, ekf = make(case, **settings), make("ekf", **settings)
    pose, told = np.zeros(3), {}
    tell_truth(slam, pose, told)
    for k in range(12):
        # The truth told to `ideal` is this noise-free drive, so it linearises there.
        pose = pose + np.array([0.5 * np.cos(pose[2]), 0.5 * np.sin(pose[2]), 0.2])
        reading = np.array([[0.3 * k - 1.0, 2.0 + k]])
        where = pose[:2] + reading[0, 1] * np.array(
            [np.cos(pose[2] + reading[0, 0]), np.sin(pose[2] + reading[0, 0])]
        )
        told[k] = where
        tell_truth(slam, pose, dict(told))
        for each in (slam, ekf):
            each.predict((0.5, 0.2))
            each.update(reading, [k])
    slam, ekf = slam.belief(), ekf.belief()
    assert_close_beliefs(slam, ekf, 1e-12)


def standing_robot(case, steps=500):
    """Julier and Uhlmann: a robot that stands and looks at one landmark."""
    rng = np.random.default_rng(0)
    sensor = np.array([np.deg2rad(2.0), 0.1])
    noise = {"motion_std": (0, 0, 0), "measurement_std": sensor}
    slam = make(case, **noise, initial_pose_std=(0.1, 0.1, 0.3))
    tell_truth(slam, np.zeros(3), {0: (4.0, 3.0)})
    for _ in range(steps):
        reading = np.array([np.arctan2(3, 4), 5.0]) + sensor * rng.standard_normal(2)
        slam.predict((0.0, 0.0))
        slam.update(reading[None], [0])
    return np.rad2deg(np.sqrt(slam.belief().pose_covariance[2, 2]))


@pytest.mark.parametrize("case", BLIND_TO_A_TURN)
def test_a_standing_robot_learns_nothing_of_its_heading(case):
    assert standing_robot(case) == pytest.approx(np.rad2deg(0.3), abs=1e-9)


@pytest.mark.parametrize("case", ["ekf", "iterated", "unscented"])
def test_a_standing_robot_seems_to_learn_its_heading(case):
    assert standing_robot(case) < 10.0


def unobservable_directions(case, steps=150):
    """Nullity of the observability Gramian along a loop, read off the filter itself.

    A copy of the filter whose covariance is set to I is stepped without motion noise:
    what it makes of I tells G, and Hᵀ Q⁻¹ H as the information it gains.
    """
    slam = make(case)
    copy = make(case, motion_std=(0, 0, 0))
    n = 3 + 2 * len(SIX)
    gramian, way = np.zeros((n, n)), np.eye(n)
    for step, (odometry, readings, truth) in enumerate(drive(7, steps)):
        for each in (slam, copy):
            tell_truth(each, truth)
        if step:
            copy.load_state_dict({**slam.state_dict(), "covariance": np.eye(n)})
            copy.predict(odometry)
            G = np.eye(n)
            G[:2, 2] = copy.belief().covariance[:2, 2]
            way = G @ way
        slam.predict(odometry)
        if step:
            copy.load_state_dict({**slam.state_dict(), "covariance": np.eye(n)})
            copy.update(readings, IDS)
            T = transport_between(slam.belief(), copy.belief())
            back = np.linalg.inv(T)
            posterior = back @ copy.belief().covariance @ back.T
            gramian += way.T @ (np.linalg.inv(posterior) - np.eye(n)) @ way
        before = slam.belief()
        slam.update(readings, IDS)
        if step:
            way = transport_between(before, slam.belief()) @ way
    values = np.linalg.eigvalsh(gramian)
    return int((values < 1e-9 * values[-1]).sum()), values / values[-1]


def transport_between(before, after):
    T = np.eye(len(before.mean))
    if before.frame == "invariant":
        moved = (after.mean - before.mean)[np.r_[0:2, 3 : len(before.mean)]]
        v = (moved.reshape(-1, 2) @ np.array([[0.0, 1.0], [-1.0, 0.0]])).ravel()
        T[np.r_[0:2, 3 : len(before.mean)], 2] = v
    return T


@pytest.mark.parametrize(
    ("case", "nullity"),
    [
        ("ekf", 2),
        ("iterated", 2),
        ("ideal", 3),
        ("first_estimates", 3),
        ("observability_constrained", 3),
        ("invariant", 3),
    ],
)
def test_nullity_of_the_observability_matrix_along_a_loop(case, nullity):
    found, values = unobservable_directions(case)
    assert found == nullity, values[:5]


@pytest.mark.parametrize("iterations", [1, 3])
@pytest.mark.parametrize("name", ["iterated", "invariant"])
def test_a_scalar_linear_problem_keeps_its_answer_at_any_number_of_iterations(
    name, iterations
):
    # Along a line, heading known: prior and reading equally sure, so the mean halves
    # the difference and the variance.
    noise = {"motion_std": (0.1, 0.0, 0.0), "measurement_std": (1e-3, 0.1)}
    slam = make_estimator(name, **noise, iterations=iterations)
    slam.update([(0.0, 5.0)], [0])
    precise = slam.state_dict()
    precise["covariance"][:] = 0.0
    slam.load_state_dict(precise)
    slam.predict((1.0, 0.0))
    slam.update([(0.0, 3.9)], [0])
    assert slam.belief().pose[0] == pytest.approx(1.05, abs=1e-12)
    assert slam.belief().pose_covariance[0, 0] == pytest.approx(0.005, abs=1e-12)


def test_near_its_predictions_the_invariant_filter_linearises_once():
    once, free = make("invariant", iterations=1), make("invariant")
    for odometry, readings, _ in drive(2, 30):
        for each in (once, free):
            each.predict(odometry)
            each.update(readings, IDS)
    np.testing.assert_array_equal(once.belief().mean, free.belief().mean)


@pytest.mark.usefixtures("own_registry")
def test_an_error_of_a_constructor_is_its_own():
    def broken(**options):
        raise TypeError("one of its own")

    register_estimator("broken", broken)
    with pytest.raises(TypeError, match=r"^one of its own$"):
        make("broken")


def test_options_in_brackets_count_before_keywords():
    slam = make("ekf[min_range=3.0]", min_range=0.1)
    assert slam.update([(0.0, 2.0)], [5]).skipped_ids == (5,)


@pytest.mark.parametrize("case", FAMILY)
def test_reset_equals_a_new_filter(case):
    noise = {name: np.array(std) for name, std in NOISE.items()}
    slam, fresh = make(case, **noise), make(case)
    for std in noise.values():
        std[:] = 9.0  # a filter keeps no array of its caller
    tell_truth(slam, np.ones(3))
    drive_all(3, 5, slam)
    slam.reset((0, 0, 0), (0, 0, 0))
    assert digest(slam) == digest(fresh)
    drive_all(9, 15, slam, fresh)
    assert_same_bits(slam.belief(), fresh.belief())


def at_origin(case, far, steps, with_fixes):
    """Return the belief at the end of a drive and the NIS of its scans."""
    start = {"initial_pose": (*far, 0), "initial_pose_std": (0.1, 0.1, 0.1)}
    slam, nis, rng = make(case, **start), [], np.random.default_rng(5)
    for odometry, readings, truth in drive(7, steps, start_std=(0.1, 0.1, 0.1)):
        tell_truth(slam, shifted(truth, far), dict(enumerate(SIX + far)))
        slam.predict(odometry)
        nis.append(slam.update(readings, IDS).nis)
        if with_fixes:
            z = shifted(truth, far)[:2] + 0.3 * rng.standard_normal(2)
            nis.append(slam.observe_pose(z, np.eye(3)[:2], 0.09 * np.eye(2)).nis)
    return slam.belief(), np.array(nis)


@far_origins
@pytest.mark.parametrize("with_fixes", [False, True])
@pytest.mark.parametrize("case", FAMILY)
def test_a_world_far_from_the_origin_gives_the_same_belief(case, with_fixes, far):
    if with_fixes and not hasattr(make(case), "observe_pose"):
        pytest.skip("it takes no readings of the pose")
    steps = 40
    (near, nis), (there, nis_there) = (
        at_origin(case, origin, steps, with_fixes) for origin in ((0, 0), far)
    )
    slack = rounding(far, steps)
    np.testing.assert_allclose(there.mean, shifted(near.mean, far), atol=slack, rtol=0)
    # Readings notice a rounding by their noise: 2 cm is that of a bearing at 1 m.
    std = np.sqrt(near.covariance.diagonal())
    change = (there.covariance - near.covariance) / np.outer(std, std)
    assert np.abs(change).max() < slack / MEASUREMENT_STD.min()
    np.testing.assert_allclose(
        np.sqrt(nis_there), np.sqrt(nis), atol=12 * slack / MEASUREMENT_STD.min()
    )


@pytest.mark.parametrize("case", FAMILY)
def test_the_report_agrees_with_itself(case):
    slam = make(case)
    for odometry, readings, truth in drive(3, 10):
        tell_truth(slam, truth)
        slam.predict(odometry)
        report = slam.update(readings, IDS)
    white = np.linalg.solve(report.innovation_factor, report.innovation.ravel())
    assert white @ white == pytest.approx(report.nis, rel=1e-9)
    np.testing.assert_allclose(
        report.innovation_covariance,
        report.innovation_factor @ report.innovation_factor.T,
    )


@pytest.mark.parametrize(
    "case",
    [case for case in FAMILY if case != "sparse_information"],  # refuses such a sensor
)
def test_a_scan_that_cannot_be_solved_is_refused_or_harmless(case):
    """Without sensor noise rounding decides; nothing absurd may come of either."""
    refused = 0
    for seed in range(20):
        rng = np.random.default_rng(seed)
        slam = make(case, motion_std=(0.1, 0.1, 0.1), measurement_std=(0, 0))
        scan = np.stack([rng.uniform(-3, 3, 9), rng.uniform(2, 9, 9)], axis=1)
        tell_truth(slam, np.zeros(3), {i: (1.0 + i, 2.0) for i in range(9)})
        slam.update(scan, range(9))
        slam.predict((0.3, 0.1))
        before = slam.belief()
        try:
            outcome = slam.update(scan[:8] + 0.01, range(8)).nis
        except np.linalg.LinAlgError as error:
            outcome = str(error)
        if isinstance(outcome, str):
            refused += 1
            assert "at the reading of landmark" in outcome
            assert_same_bits(slam.belief(), before)
        else:
            assert np.isfinite(slam.belief().covariance).all()
            assert outcome < 1e9
    assert refused > 10


def test_an_update_that_fails_at_a_later_iterate_leaves_the_belief_as_it_was():
    """The range is across the motion there, and reads nothing of it."""
    refused = 0
    for std, iterations in product((0.2, 0.25, 0.5, 1.0, 2.0, 3.0), (1, 2)):
        noise = {"motion_std": (std, 0.0, 1.0), "measurement_std": (0.0, 0.0)}
        slam = make_estimator("iterated", **noise, iterations=iterations)
        slam.update([(np.arctan2(6, 8), 10.0)], [7])
        slam.predict((0.0, 0.0))
        before = slam.belief()
        try:
            slam.update([(1.0, 3.6)], [7])
        except np.linalg.LinAlgError:
            refused += 1
            assert iterations == 2
            assert_same_bits(slam.belief(), before)
    assert refused


@pytest.mark.parametrize("case", FAMILY)
def test_a_reading_at_an_expected_range_below_the_minimum_is_skipped(case):
    slam = make(case, min_range=0.5)
    tell_truth(slam, np.zeros(3), {0: (2.0, 0.0), 1: (0.0, 4.0), 2: (0.4, 0.0)})
    slam.update([(0.0, 2.0), (np.pi / 2, 4.0)], [0, 1])
    tell_truth(slam, (1.7, 0.0, 0.0), {0: (2.0, 0.0), 1: (0.0, 4.0), 2: (2.1, 0.0)})
    slam.predict((1.7, 0.0))
    report = slam.update([(0.0, 0.6), (2.0, 4.3), (0.0, 0.4)], [0, 1, 2])
    assert set(report.skipped_ids) == {0, 2}
    assert report.associated_ids == (1,)


@pytest.mark.parametrize("case", FAMILY)
@pytest.mark.parametrize("at", ["expected", "reading"])
@pytest.mark.parametrize(
    ("noise", "row", "least"),
    [
        ({"range_std_per_metre": 0.5}, 1, {"expected": 12.0, "reading": 2.0}),
        ({"bearing_std_metres": 3.0}, 0, {"expected": 0.35, "reading": 1.0}),
    ],
)
def test_noise_that_depends_on_the_range_reaches_every_filter(
    case, at, noise, row, least
):
    variances = []  # of the landmark and of the reading together
    for options in ({}, noise):
        slam = make(case, range_noise_at=at, **options)
        tell_truth(slam, np.zeros(3))
        slam.update(np.array([(0.3, 6.0), (1.0, 9.0)]), [0, 1])
        slam.predict((0.0, 0.0))
        scan = np.array([(0.3, 3.0), (1.0, 4.5)])
        S = slam.update(scan, [0, 1]).innovation_covariance
        variances.append(S[row, row])
    assert variances[1] > variances[0] + least[at]


@pytest.mark.parametrize("case", FAMILY)
def test_a_landmark_at_the_robot_is_reported_as_near(case):
    slam = make(case)
    true_map = {0: (0.9, 0.0), 1: (2.0, 3.0)}
    tell_truth(slam, np.zeros(3), true_map)
    slam.update([(0.0, 0.9), (np.arctan2(3, 2), 13**0.5)], [0, 1])
    tell_truth(slam, (0.5, 0.0, 0.0), true_map)
    slam.predict((0.5, 0.0))
    assert slam.update([(0.0, 0.4)], [0]).near_ids == (0,)


def test_the_first_truth_is_that_of_the_start():
    slam = make("ideal", initial_pose_std=(0.0, 0.0, 0.1))
    tell_truth(slam, np.array([3.0, 1.0, 0.5]), {})
    tell_truth(slam, np.array([3.0 + np.cos(0.5), 1.0 + np.sin(0.5), 0.5]), {})
    slam.predict((1.0, 0.0))
    covariances = slam.belief().covariance[:2, 2]
    expected = 0.01 * np.array([-np.sin(0.5), np.cos(0.5)])
    np.testing.assert_allclose(covariances, expected, atol=1e-12)


def test_the_ideal_filter_asks_for_the_truth_of_all_it_sees():
    slam = make("ideal")
    slam.observe_truth((0, 0, 0), {0: (1.0, 2.0)})
    with pytest.raises(ValueError, match="got none of landmark 5"):
        slam.update([(0.3, 2.0)], [5])
    slam.update([(1.1, 2.2)], [0])
    with pytest.raises(ValueError, match="got none of landmark 0"):
        slam.observe_truth((0, 0, 0), {7: (1.0, 2.0)})


@pytest.mark.parametrize("case", FAMILY)
def test_gate_rejects_an_outlier_in_every_filter(case):
    slam, plain = make(case, gate_probability=0.9999), make(case)
    drive_all(0, 10, slam, plain)
    *_, (_, readings, _) = drive(0, 10)
    wrong, others = readings.copy(), [0, 1, 2, 4, 5]
    wrong[3] += (0.5, 4.0)
    report = slam.update(wrong, IDS)
    assert report.rejected_ids == (3,)
    assert sorted(report.associated_ids) == others
    plain.update(readings[others], others)
    assert_close_beliefs(slam.belief(), plain.belief(), 1e-12)


def test_the_unscented_filter_gates_and_reports_as_its_slow_dense_twin():
    landmarks = np.random.default_rng(8).uniform(-12, 12, (13, 2))
    rng, rejected, counts = np.random.default_rng(3), 0, set()
    twin = FAMILY["unscented"](MOTION_STD, MEASUREMENT_STD, START_STD)
    twin.gate = -2 * np.log(1 - 0.8)
    fast = make("unscented", initial_pose_std=START_STD, gate_probability=0.8)
    for odometry, readings, _ in drive(2, 40, landmarks=landmarks):
        seen = rng.permutation(13)[: rng.integers(6)]
        mapped = [k for k, i in enumerate(seen) if i in twin.ids]
        for each in (fast, twin):
            each.predict(odometry)
        report, nis = (
            fast.update(readings[seen], seen),
            twin.update(readings[seen], seen.tolist()),
        )
        counts.add(len(mapped))
        if mapped:
            assert report.rejected_ids == twin.rejected
            found = report.innovation.ravel(), report.innovation_covariance
            np.testing.assert_allclose(found[0], twin.nu, rtol=0, atol=1e-9)
            np.testing.assert_allclose(found[1], twin.S, rtol=0, atol=1e-9)
            assert report.nis == pytest.approx(nis, rel=1e-6, abs=1e-9)
        rejected += len(report.rejected_ids)
    assert rejected > 5
    assert counts >= {0, 1, 2, 3}
    mean, covariance = belief_of(twin)
    np.testing.assert_allclose(fast.belief().mean, mean, rtol=0, atol=1e-10)
    np.testing.assert_allclose(fast.belief().covariance, covariance, rtol=0, atol=1e-10)


@pytest.mark.parametrize("value", [0, 1.5, -2])
def test_iterations_must_be_a_positive_whole_number(value):
    with pytest.raises(ValueError, match="iterations must be a whole number >= 1"):
        make("iterated", iterations=value)


def test_beliefs_name_the_frame_of_their_error():
    frames = {case: make(case).belief().frame for case in FAMILY}
    assert {c for c, frame in frames.items() if frame == "invariant"} == {
        "invariant",
        "invariant[iterations=1]",
        "invariant[iterations=2]",
        "compressed[base=invariant]",
        "submaps",
    }
    assert isinstance(make("ekf"), EkfSlam)


@pytest.mark.parametrize(
    ("name", "policy"),
    [
        ("ekf", {"association": "nearest"}),
        ("ekf", {"association": "hypotheses"}),
        ("compressed", None),
        ("submaps", None),
        ("smoother", None),
        ("smoother", {"association": "nearest"}),
    ],
)
def test_an_update_makes_no_copy_of_the_covariance(name, policy):
    options = {"submap_size": 400} if name == "submaps" else {}
    if name == "smoother":
        inside = make_estimator("ekf", **NOISE, management=policy)
        slam = RecordedSlam(inside, **NOISE)
    else:
        slam = make_estimator(name, **NOISE, management=policy, **options)
    around = np.linspace(-3, 3, 200)
    scans = [[(b, 4.0 + 0.1 * k) for k, b in enumerate(around)], range(200)]
    for _ in range(4):
        slam.update(*scans)
    few = scans[0][:3], range(3)
    slam.update(*few)
    tracemalloc.start()
    slam.predict((0.01, 0.0))
    slam.update(*few)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 8 * 403**2 / 2


@pytest.mark.parametrize("name", [-(2**63), 1 - 2**63])
def test_a_robocentric_map_refuses_the_identities_of_its_own_places(name):
    slam = make_estimator(
        "robocentric", motion_std=(0.1, 0.1, 0.05), measurement_std=(0.02, 0.1)
    )
    slam.update([(0.0, 3.0), (1.0, 2.0)], [1, 2 - 2**63])
    before = slam.state_dict()
    with pytest.raises(ValueError, match=f"landmark_ids must be above {1 - 2**63}"):
        slam.update([(0.1, 3.0), (0.2, 2.0)], [1, name])
    for key, value in slam.state_dict().items():
        np.testing.assert_array_equal(value, before[key])


def test_the_unscented_filter_has_no_variance_below_zero():
    noise = {"motion_std": (0.1, 0.1, 0.05), "measurement_std": (0.05, 0.1)}
    slam = make_estimator("unscented", **noise)
    slam.reset((0.0, 0.0, 0.0), (0.0, 1.0, 0.0))
    slam.update([(0.0, 1.0), (0.0, 1.0)], [0, 1])
    slam.update([(0.0, 1.0)], [0])
    assert slam.belief().covariance.diagonal().min() >= 0.0
