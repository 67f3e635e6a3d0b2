import numpy as np
import pytest
from comparison import assert_close_beliefs, assert_same_bits
from dense_ekf import DenseEkf
from drives import MEASUREMENT_STD, MOTION_STD, NOISE, drive
from numba import config
from numeric_jacobian import numeric_jacobian
from scipy.stats import chi2

from slamgym.estimator import EkfSlam, list_estimators, make_estimator
from slamgym.estimator.models.bearing_range import predict_measurement, wrap_angle
from slamgym.estimator.models.sensors import BEARING_RANGE

IDS = list(range(6))


def make(**options):
    return EkfSlam(MOTION_STD, MEASUREMENT_STD, **options)


def run(steps, seed=0, **options):
    slam = make(**options)
    for odometry, readings, _ in drive(seed, steps):
        slam.predict(odometry)
        slam.update(readings, IDS)
    return slam


def test_equals_the_dense_textbook_filter_over_1000_steps():
    fast = make(initial_pose_std=(0.1, 0.1, 0.05))
    slow = DenseEkf(MOTION_STD, MEASUREMENT_STD, (0.1, 0.1, 0.05))
    rng = np.random.default_rng(5)
    for odometry, readings, _ in drive(3, 1000, start_std=(0.1, 0.1, 0.05)):
        seen = np.flatnonzero(rng.random(6) < 0.5)
        fast.predict(odometry, dt=0.5)
        slow.predict(odometry, dt=0.5)
        report = fast.update(readings[seen], seen)
        nis = slow.update(readings[seen], seen.tolist())
        np.testing.assert_allclose(report.nis, nis, rtol=1e-8, atol=1e-10)
    belief = fast.belief()
    assert list(belief.landmark_ids) == slow.ids
    mean = slow.mean.copy()
    mean[2] = wrap_angle(mean[2])
    np.testing.assert_allclose(belief.mean, mean, rtol=0, atol=1e-10)
    np.testing.assert_allclose(belief.covariance, slow.P, rtol=0, atol=1e-10)


def test_covariance_is_symmetric_to_the_last_bit_and_positive():
    P = run(300).belief().covariance
    np.testing.assert_array_equal(P, P.T)
    assert np.linalg.eigvalsh(P).min() > 0


def test_map_grows_far_beyond_the_first_allocation():
    rng = np.random.default_rng(0)
    landmarks = rng.uniform(-50, 50, (70, 2))
    fast, slow = make(), DenseEkf(MOTION_STD, MEASUREMENT_STD)
    for step, (odometry, readings, _) in enumerate(drive(2, 12, landmarks=landmarks)):
        seen = np.arange(step, 70, 7)
        fast.predict(odometry)
        slow.predict(odometry)
        fast.update(readings[seen], seen)
        slow.update(readings[seen], seen.tolist())
    assert len(fast.belief().landmark_ids) == 70
    np.testing.assert_allclose(fast.belief().covariance, slow.P, atol=1e-10)
    np.testing.assert_allclose(fast.belief().mean[3:], slow.mean[3:], atol=1e-9)


def test_new_landmark_is_fully_correlated_unless_told_otherwise():
    readings = [(0.3, 2.0), (1.0, 4.0)]
    full = make(initial_pose_std=(0.1, 0.1, 0.1))
    full.update(readings, [5, 6])
    assert (abs(full.belief().covariance[:3, 3:]).max(axis=0) > 1e-3).all()
    apart = make(initial_pose_std=(0.1, 0.1, 0.1), landmark_init="independent")
    apart.update(readings, [5, 6])
    P = apart.belief().covariance
    assert not P[:3, 3:].any()
    assert not P[3:5, 5:].any()
    blocks = full.belief().landmark_covariances
    np.testing.assert_array_equal(apart.belief().landmark_covariances, blocks)


def test_bearing_innovation_is_wrapped_across_the_seam():
    slam = make()
    slam.update([(np.pi - 0.001, 5.0)], [0])
    report = slam.update([(-np.pi + 0.001, 5.0)], [0])
    assert report.innovation[0, 0] == pytest.approx(0.002, abs=1e-9)


def test_noise_counts_the_square_root_of_dt():
    once, split = make(), make()
    once.predict((0.0, 0.0), dt=3.0)
    for dt in (1.0, 0.5, 1.5, 0.0):
        split.predict((0.0, 0.0), dt=dt)
    assert_close_beliefs(once.belief(), split.belief(), 1e-15)


def test_no_noise_at_rest_where_asked():
    slam = make(noise_at_rest=False)
    slam.predict((0.0, 0.0))
    assert not slam.belief().covariance.any()
    slam.predict((0.0, 0.1))
    assert slam.belief().covariance[0, 0] > 0


RANGE_AND_BEARING = [  # of 0.1 m per metre, and of 0.3 m across
    ({"range_std_per_metre": 0.1}, 1, 1.0, (1.0, 0.5)),
    ({"bearing_std_metres": 0.3}, 0, 10.0, (0.03, 0.06)),
]


@pytest.mark.parametrize(("noise", "row", "lever", "added"), RANGE_AND_BEARING)
def test_noise_is_that_of_the_expected_range_or_of_the_one_read(
    noise, row, lever, added
):
    for at, more in zip(("expected", "reading"), added, strict=True):
        slam = make(sensor=BEARING_RANGE.with_noise(**noise, range_noise_at=at))
        slam.update([(0.0, 10.0)], [0])
        prior = slam.belief().covariance[4 - row, 4 - row] / lever**2
        assert prior == pytest.approx((MEASUREMENT_STD[row] + added[0]) ** 2)
        S = slam.update([(0.0, 5.0)], [0]).innovation_covariance
        variance = S[row, row] - prior
        assert variance == pytest.approx((MEASUREMENT_STD[row] + more) ** 2)


def test_noise_of_positions_has_the_same_size_in_all_directions():
    sensor = BEARING_RANGE.with_noise(bearing_std_metres=0.3)
    slam = EkfSlam((0.1, 0.1, 0.1), (0.0, 0.3), sensor=sensor)
    slam.update([(0.7, 10.0), (-2.0, 0.5)], [0, 1])
    expected = 0.09 * np.eye(4)
    np.testing.assert_allclose(slam.belief().covariance[3:, 3:], expected, atol=1e-12)


def test_gate_keeps_its_share_of_good_readings():
    kept = total = 0
    for seed in range(20):
        slam = make(gate_probability=0.9)
        for odometry, readings, _ in drive(seed, 30):
            slam.predict(odometry)
            report = slam.update(readings, IDS)
            kept += len(report.associated_ids)
            total += len(report.associated_ids) + len(report.rejected_ids)
    assert kept / total == pytest.approx(0.9, abs=0.03)


@pytest.mark.parametrize("distance", [0.0, -0.035, 1e-4])
def test_reading_below_the_minimum_range_is_skipped_and_reported(distance):
    slam = run(3)
    before = slam.belief()
    report = slam.update([(0.1, distance), (0.3, distance)], [0, 99])
    assert report.skipped_ids == (0, 99)
    assert_same_bits(before, slam.belief())


def test_a_doubt_about_the_heading_alone_makes_no_landmark_near():
    slam = EkfSlam((0, 0, 0), (0.001, 0.001), initial_pose_std=(1.0, 1.0, 0.5))
    slam.update([(0.3, 5.0)], [0])
    assert slam.update([(0.3, 5.0)], [0]).near_ids == ()


def place_in_robot_frame(state):
    c, s = np.cos(state[2]), np.sin(state[2])
    return np.array([[c, s], [-s, c]]) @ (state[3:5] - state[:2])


def test_near_means_ten_deviations_of_the_place_in_the_robots_frame():
    rng = np.random.default_rng(0)
    both = set()
    for seed in range(40):
        slam = run(5, seed=seed)
        state = slam.state_dict()
        root = rng.standard_normal((15, 15)) * 10 ** rng.uniform(-3, -1)
        state["covariance"] = root @ root.T
        slam.load_state_dict(state)
        H = numeric_jacobian(place_in_robot_frame, state["mean"])
        sigma = np.sqrt(np.linalg.eigvalsh(H @ state["covariance"] @ H.T)[-1])
        expected = np.hypot(*place_in_robot_frame(state["mean"])) < 10 * sigma
        report = slam.update([(0.0, 3.0)], [slam.belief().landmark_ids[0]])
        assert bool(report.near_ids) == expected
        both.add(bool(expected))
    assert both == {True, False}


def test_degenerate_innovation_names_the_landmark_and_changes_nothing():
    slam = EkfSlam((0, 0, 0), (0, 0))
    slam.update([(0.0, 2.0), (1.0, 2.0)], [4, 7])
    before = slam.belief()
    too_near = [(2.0, 1e-9)], [9]
    for near, name in (([], []), too_near):
        with pytest.raises(np.linalg.LinAlgError, match="landmark 7"):
            slam.update([*near, (1.0, 2.0), (0.0, 2.0)], [*name, 7, 4])
        assert_same_bits(before, slam.belief())


@pytest.mark.parametrize(
    "landmarks",
    [((3, 1), (-4, -1)), ((1, 4), (2, -3)), ((-2, 3), (4, -2)), ((-4, -1), (4, -2)),
     ((5, 2), (-3, 5)), ((-3, 5), (1, 4)), ((4, -2), (3, 1))],
)  # fmt: skip
def test_a_covariance_that_only_rounding_keeps_positive_is_refused(landmarks):
    """Two exact readings of known landmarks have 4 rows, and the pose 3 unknowns."""
    slam = EkfSlam((0, 0, 0), (0, 0))
    mean = np.concatenate([np.zeros(3), np.ravel(landmarks)])
    covariance = np.diag([0.01, 0.01, 0.01, 0, 0, 0, 0])
    state = {"mean": mean, "reference": mean, "covariance": covariance}
    slam.load_state_dict({**slam.state_dict(), **state, "landmark_ids": [4, 7]})
    readings = predict_measurement(mean[:3], np.array(landmarks)).measurement
    with pytest.raises(np.linalg.LinAlgError, match="landmark 7"):
        slam.update(readings, [4, 7])


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda s: s.predict((np.nan, 0)), "odometry must be 2 finite numbers"),
        (lambda s: s.predict((1, 2, 3)), "odometry must be 2 finite numbers"),
        (lambda s: s.predict("go"), "odometry must be 2 finite numbers"),
        (lambda s: s.predict((1, 0), dt=-1), "dt must be a finite number >= 0"),
        (lambda s: s.update([(0, 1), (np.nan, 2)], [0, 8]),
         r"measurements must be finite, got \[nan, 2.0\] in row 1 \(landmark 8\)"),
        (lambda s: s.update([(0, 1), (0, 1e200)], [0, 8]),
         r"measurements must not exceed 1e\+12, got \[0.0, 1e\+200\] in row 1"),
        (lambda s: s.predict((-1e200, 0)), r"odometry must not exceed 1e\+12"),
        (lambda s: s.update(np.ma.masked_array([(0.0, 1.0)], [(False, True)]), [0]),
         "measurements must be an array without a mask"),
        (lambda s: s.update(np.array([(0, 1j)]), [0]), "must be real numbers"),
        (lambda s: s.predict(np.array([1j, 0])), "odometry must be real numbers"),
        (lambda s: s.update([(0, 1, 2)], [0]), r"shape \(m, 2\).*got shape \(1, 3\)"),
        (lambda s: s.update([(0, 1)], [0, 1]), "one entry per row .*, 1, got 2"),
        (lambda s: s.update([(0, 1), (1, 1)], [3, 3]), "must not repeat.*got 3 twice"),
        (lambda s: s.update([(0, 1)], [0.5]), "must be a list of int64"),
        (lambda s: s.update([(0, 1)], [[1]]), "must be a list of int64"),
        (lambda s: s.update([(0, 1)], np.array(5)), "must be a list of int64"),
        (lambda s: s.update([(0, 1)], np.array([2**63])), "must fit 64 bits"),
        (lambda s: s.update([(0, 1)], [2**70]), "must be a list of int64"),
        (lambda s: s.predict((10**400, 0)), "odometry must be 2 finite numbers"),
        (lambda s: s.update([(0, 1)]), "landmark_ids must be given"),
        (lambda s: s.update("rubbish", [0]), "measurements must be numbers"),
        (lambda s: s.reset((0, 0), (0, 0, 0)), "pose must be 3 finite numbers"),
        (lambda s: s.reset((0, 0, 0), (0, 0, -1)), "pose_std must be 3 finite numbers"),
    ],
)  # fmt: skip
def test_bad_input_is_refused_by_name_and_changes_nothing(call, message):
    slam = run(3)
    before = slam.belief()
    with pytest.raises(ValueError, match=message):
        call(slam)
    assert_same_bits(before, slam.belief())


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"motion_std": (1, 2)}, "motion_std must be 3 finite numbers >= 0"),
        ({"measurement_std": (-1, 0.1)}, "measurement_std must be 2 finite"),
        ({"initial_pose_std": (0, np.nan, 0)}, "pose_std must be 3 finite"),
        ({"landmark_init": "none"}, "landmark_init must be 'full' or 'independent'"),
        ({"gate_probability": 1.5}, "gate_probability must lie between 0 and 1"),
        ({"noise_at_rest": "no"}, "noise_at_rest must be True or False"),
        ({"gate_probability": "high"}, "gate_probability must lie between 0 and 1"),
        ({"min_range": 0.0}, "min_range must be a finite number > 0"),
    ],
)
def test_bad_settings_are_refused_by_name(options, message):
    with pytest.raises(ValueError, match=message):
        EkfSlam(**{**NOISE, **options})


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"mean": np.zeros(4)}, r"state\['mean'\] must have shape \(15,\)"),
        ({"covariance": np.full((15, 15), np.nan)}, "covariance'] must be finite"),
        ({"estimator": "OtherFilter"}, "state is of OtherFilter, not of EkfSlam"),
        ({"landmark_ids": None}, "state must hold 'landmark_ids'"),
        ({"landmark_ids": [3] * 6}, r"landmark_ids'\] must not repeat"),
        ({"landmark_ids": [0.5] * 6}, "must be whole numbers"),
        ({"covariance": np.triu(np.ones((15, 15)))}, "must be symmetric"),
    ],
)
def test_a_broken_state_is_refused_and_changes_nothing(change, message):
    slam = run(3)
    before = slam.belief()
    state = {**slam.state_dict(), **change}
    if state["landmark_ids"] is None:
        del state["landmark_ids"]
    with pytest.raises(ValueError, match=message):
        slam.load_state_dict(state)
    assert_same_bits(before, slam.belief())


def test_nees_and_nis_are_those_of_a_consistent_filter():
    nees, nis, dof = [], 0.0, 0
    for seed in range(100):
        slam = make()
        for odometry, readings, truth in drive(seed, 40):
            slam.predict(odometry)
            report = slam.update(readings, IDS)
            nis += report.nis
            dof += report.degrees_of_freedom
            last_pose = truth
        error = slam.belief().pose - last_pose
        error[2] = wrap_angle(error[2])
        nees.append(error @ np.linalg.solve(slam.belief().pose_covariance, error))
    low, high = chi2.ppf([0.005, 0.995], 3 * len(nees))
    assert low < sum(nees) < high
    low, high = chi2.ppf([0.005, 0.995], dof)
    assert low < nis < high


@pytest.mark.skipif(config.DISABLE_JIT, reason="nothing is compiled")
def test_read_only_readings_are_taken_without_compiling_anew():
    slam = make()
    readings = np.array([(0.1, 4.0)])
    readings.flags.writeable = False
    ids = np.array([0])
    ids.flags.writeable = False
    slam.update(readings, ids)
    slam.update(np.array([(0.1, 4.0)]), [0])
    from slamgym.estimator.filters.gaussian_map import update_map

    signatures = getattr(update_map, "signatures", [None])  # plain without JIT
    assert len(signatures) == 1


@pytest.mark.parametrize("name", list_estimators())
def test_the_largest_readings_leave_the_belief_finite(name):
    slam = make_estimator(name, **NOISE)
    slam.predict((1.0, 0.1))
    slam.update([(0.3, 1e12), (0.1, 5.0)], [0, 1])
    slam.predict((1.0, 0.1))
    assert np.isfinite(slam.belief().mean).all()
    assert np.isfinite(slam.belief().covariance).all()
    with pytest.raises(ValueError, match="measurements must not exceed"):
        slam.update([(0.3, 1e200)], [2])


@pytest.mark.parametrize("name", ["ekf", "iterated"])
@pytest.mark.parametrize("seen", [[7, 31, 4], list(range(40))])
def test_a_report_keeps_the_innovation_covariance_of_its_own_prior(name, seen):
    """For a few readings in a large map, and for all; also after later updates."""
    rng = np.random.default_rng(0)
    landmarks = rng.uniform(-15, 15, (40, 2))
    slam = make_estimator(name, **NOISE)
    steps = list(drive(0, 5, landmarks=landmarks))
    for odometry, readings, _ in steps[:-1]:
        slam.predict(odometry)
        slam.update(readings, range(40))
    slam.predict(steps[-1][0])
    prior = slam.belief()
    model = predict_measurement(prior.pose, prior.landmarks[seen])
    H = np.zeros((2 * len(seen), len(prior.mean)))
    for k, landmark in enumerate(seen):
        H[2 * k : 2 * k + 2, :3] = model.jacobian_pose[k]
        c = 3 + 2 * landmark
        H[2 * k : 2 * k + 2, c : c + 2] = model.jacobian_landmark[k]
    noise = np.tile(np.square(MEASUREMENT_STD), len(seen))
    S = H @ prior.covariance @ H.T + np.diag(noise)
    expected = steps[-1][1][seen] - model.measurement
    expected[:, 0] = wrap_angle(expected[:, 0])
    report = slam.update(steps[-1][1][seen], seen)
    assert report.associated_ids == tuple(seen)
    slam.update(steps[-1][1], range(40))
    np.testing.assert_allclose(report.innovation, expected, rtol=0, atol=1e-12)
    np.testing.assert_allclose(report.innovation_covariance, S, rtol=0, atol=1e-12)


def test_an_update_that_fails_in_a_later_block_of_readings_is_taken_back():
    slam = EkfSlam((0.1, 0.1, 0.1), (0.02, 0.1))
    readings = np.column_stack([np.linspace(-2, 2, 9), np.full(9, 3.0)])
    slam.update(readings, range(9))
    slam.predict((0.1, 0.1))
    slam.map.covariance[19:21, 19:21] = -5 * np.eye(2)  # of the last landmark
    mean, covariance = slam.map.mean.copy(), slam.map.covariance.copy()
    with pytest.raises(np.linalg.LinAlgError):
        slam.update(readings, range(9))
    np.testing.assert_array_equal(slam.map.mean, mean)
    np.testing.assert_array_equal(slam.map.covariance, covariance)
