"""Which landmark a reading is of, in the map and outside it."""

import numpy as np
import pytest
from numeric_jacobian import numeric_jacobian
from scipy.stats import multivariate_normal

from slamgym.envs import LandmarkWorldEnv
from slamgym.estimator import make_estimator
from slamgym.estimator.association.scan_assignments import (
    AMBIGUOUS,
    NEW,
    AssociationPolicy,
    Distances,
    Noise,
    innovation_distances,
    nearest_neighbours,
)
from slamgym.estimator.association.tentative_landmarks import (
    TentativeLandmarks,
    UnexplainedDensity,
)
from slamgym.estimator.guards.saved_states import is_semidefinite
from slamgym.estimator.interface import MapView
from slamgym.estimator.kernels import scan_update as screening
from slamgym.estimator.kernels.scan_update import (
    ADDED,
    FIRST,
    JACOBIAN,
    LEDGER_HEIGHT,
    META_WIDTH,
    NEAR,
    OUTCOME,
    SLOT,
    USED,
    VARIANCE,
    BeliefArrays,
    Rules,
)
from slamgym.estimator.models.bearing_range import predict_measurement, wrap_angle
from slamgym.evaluation import score_association
from slamgym.sim_configs import action_sequence, load_scenario

NOISE = Noise(0.02, 0.1, 0.01, 0.05)
SHARP = (0.01, 0.05, 0.0)


def random_belief(seed, landmarks=12):
    rng = np.random.default_rng(seed)
    size = 3 + 2 * landmarks
    root = rng.standard_normal((size, size)) * rng.uniform(0.01, 0.2, size)
    mean = rng.uniform(-10, 10, size)
    return mean, root @ root.T


def sensor_noise(noise, distance):
    bearing_std, range_std, per_metre, metres = noise
    return (
        np.diag([bearing_std + metres / distance, range_std + per_metre * distance])
        ** 2
    )


def dense_distance(mean, P, slot, reading, noise):
    """νᵀ S⁻¹ ν and ln det S from the model's own Jacobians, stacked over the state."""
    landmark = mean[3 + 2 * slot : 5 + 2 * slot]
    expected = predict_measurement(mean[:3], landmark[None])
    H = np.zeros((2, len(mean)))
    H[:, :3] = expected.jacobian_pose[0]
    H[:, 3 + 2 * slot : 5 + 2 * slot] = expected.jacobian_landmark[0]
    C, h = H @ P @ H.T, expected.measurement[0, 1]
    share = C[1, 1] / (C[1, 1] + sensor_noise(noise, h)[1, 1])
    S = C + sensor_noise(noise, h + share * (reading[1] - h))
    nu = reading - expected.measurement[0]
    nu[0] = wrap_angle(nu[0])
    return nu @ np.linalg.solve(S, nu), np.linalg.slogdet(S).logabsdet


def noisy_readings(mean, slots, rng, spread):
    landmarks = mean[3:].reshape(-1, 2)[slots]
    exact = predict_measurement(mean[:3], landmarks).measurement
    return exact + spread * rng.standard_normal(exact.shape)


@pytest.mark.parametrize("seed", range(5))
def test_distances_are_those_of_the_dense_model_and_none_is_forgotten(seed):
    mean, P = random_belief(seed)
    rng, noise = np.random.default_rng(seed), Noise(0.02, 0.1, seed / 9, 0.05)
    readings = noisy_readings(mean, np.arange(12), rng, (0.3, 1.0))
    readings[3, 0] += 4 * np.pi
    room = np.zeros((40, 40))
    room[:27, :27] = P
    view = MapView(np.append(mean, np.zeros(13)), room, range(12))
    fit = innovation_distances(view, readings, noise, 25.0)
    within = 0
    for k in range(12):
        for j in range(12):
            squared, log_det = dense_distance(mean, P, j, readings[k], noise)
            if squared <= 25.0:
                within += 1
                assert fit.squared[k, j] == pytest.approx(squared, rel=1e-9)
                assert fit.unlikelihood[k, j] == pytest.approx(
                    squared + log_det, rel=1e-9
                )
            else:
                assert fit.squared[k, j] == fit.unlikelihood[k, j] == np.inf
    assert within > 12


def fit_of(squared, log_det=0.0):
    squared = np.array(squared, dtype=float)
    return Distances(squared, squared + np.asarray(log_det))


FAR = np.inf


@pytest.mark.parametrize(
    ("squared", "log_det", "ambiguity", "expected"),
    [
        ([[1, FAR], [FAR, 2]], 0, 0, [0, 1]),
        ([[FAR, FAR]], 0, 0, [NEW]),
        ([[12, FAR]], 40, 0, [AMBIGUOUS]),  # neither near enough nor far enough
        ([[1, FAR], [4, FAR]], 0, 0, [0, AMBIGUOUS]),  # a landmark is seen but once
        ([[1, 2]], 0, 0, [0]),
        ([[1, 2]], 0, 3, [AMBIGUOUS]),
        ([[1, 5]], 0, 3, [0]),
        ([[2, 1]], [[0, 4]], 0, [0]),  # the likelier one, not the one fewer σ away
        ([[1, 8], [2, 9]], 0, 0, [0, AMBIGUOUS]),
        ([[], []], np.empty((2, 0)), 0, [NEW, NEW]),
    ],
)
def test_every_reading_gets_one_landmark_or_none(squared, log_det, ambiguity, expected):
    fit = fit_of(squared, log_det)
    slots = nearest_neighbours(fit, AssociationPolicy(ambiguity=ambiguity))
    assert slots.tolist() == expected


# --- tentative landmarks ---


def tracked(readings):
    rows, labels = np.array(readings, dtype=float), np.arange(len(readings))
    return TentativeLandmarks().with_new(rows, NOISE, labels, share=0.2)


def sighting(slot, reading, density):
    return np.array([slot]), np.array([reading]), NOISE, np.array([density])


def test_a_tentative_landmark_starts_where_it_was_read():
    reading = np.array([0.7, 6.0])
    one = tracked([reading])

    def place(z):
        return z[1] * np.array([np.cos(z[0]), np.sin(z[0])])

    J = numeric_jacobian(place, reading)
    Q = sensor_noise(NOISE, 6.0)
    np.testing.assert_allclose(one.places[0], place(reading))
    np.testing.assert_allclose(one.covariance[3:, 3:], J @ Q @ J.T, rtol=1e-6)


def moved_and_seen_again(motion_std):
    """Two tentative landmarks, whose errors depend on those of the motion."""
    both = tracked([(0.7, 6.0), (-0.2, 3.0)])
    for _ in range(2):
        both = both.moved((0.5, 0.0, 0.4), np.square(motion_std))
    return both.with_sightings(*sighting(0, (-0.1, 5.4), 0.1))


def test_tentative_landmarks_are_settled_in_the_frame_of_the_robot():
    def in_robot_frame(state):
        c, s = np.cos(state[2]), np.sin(state[2])
        return ((state[3:].reshape(-1, 2) - state[:2]) @ [[c, -s], [s, c]]).ravel()

    both = moved_and_seen_again((0.3, 0.2, 0.1))
    J, settled = numeric_jacobian(in_robot_frame, both.mean), both.after_scan(8)
    for found in (both.places, settled.places, settled.mean[3:].reshape(-1, 2)):
        np.testing.assert_allclose(found.ravel(), in_robot_frame(both.mean), atol=1e-12)
    expected = J @ both.covariance @ J.T
    np.testing.assert_allclose(settled.covariance[3:, 3:], expected, rtol=1e-6)
    np.testing.assert_array_equal(settled.mean[:3], 0.0)
    np.testing.assert_array_equal(settled.covariance[:3], 0.0)


def test_tentative_landmarks_keep_their_frame_while_the_heading_is_certain():
    both = moved_and_seen_again((0.3, 0.2, 0.02))
    settled = both.after_scan(8)
    np.testing.assert_array_equal(settled.mean, both.mean)
    np.testing.assert_array_equal(settled.covariance, both.covariance)


def test_the_frame_begins_anew_when_no_tentative_landmark_is_left():
    moved = tracked([(0.0, 5.0)]).moved((1.0, 0.0, 0.2), np.full(3, 0.01))
    for left in (moved, moved.chosen(np.zeros(1, bool))):
        gone = left.after_scan(1)
        assert not gone.mean.any()
        assert gone.covariance.tolist() == np.zeros((3, 3)).tolist()


def test_a_tentative_landmark_that_is_dropped_leaves_the_others_as_they_are():
    both = moved_and_seen_again((0.3, 0.2, 0.1))
    one, kept = both.chosen(np.array([True, False])), np.ix_(range(5), range(5))
    np.testing.assert_array_equal(one.mean, both.mean[:5])
    np.testing.assert_array_equal(one.covariance, both.covariance[kept])


@pytest.mark.parametrize(("share", "prior"), [(0.0, 0.01), (0.2, 0.2), (1.0, 0.5)])
def test_a_new_reading_is_surely_neither_clutter_nor_a_landmark(share, prior):
    new = TentativeLandmarks().with_new(np.ones((1, 2)), NOISE, np.zeros(1, int), share)
    np.testing.assert_allclose(new.odds, np.log(prior / (1 - prior)))


def test_sightings_correct_tentative_landmarks_like_any_filter():
    first, again = [(0.7, 6.0), (-0.2, 3.0), (2.0, 4.0)], [(1.6, 6.2), (0.7, 3.1)]
    motion_std, (bearing_std, range_std, growth, metres) = (0.2, 0.1, 0.9), NOISE
    growths = {"range_std_per_metre": growth, "bearing_std_metres": metres}
    oracle = make_estimator(
        "ekf", motion_std=motion_std, measurement_std=(bearing_std, range_std),
        **growths, range_noise_at="reading",
    )  # fmt: skip
    oracle.update(first, [0, 1, 2])
    oracle.predict((1.0, 0.2))
    report = oracle.update(again, [0, 1])
    moved = tracked(first).moved((1.0, 0.0, 0.2), np.square(motion_std))
    seen = moved.with_sightings(np.arange(2), np.array(again), NOISE, np.full(2, 0.03))
    np.testing.assert_allclose(seen.mean, oracle.belief().mean, rtol=1e-9)
    np.testing.assert_allclose(seen.covariance, oracle.belief().covariance, atol=1e-12)
    for k in range(2):  # p(one | other) = p(both) / p(other)
        S, rows = report.innovation_covariance, [2 - 2 * k, 3 - 2 * k]
        both = multivariate_normal(cov=S).pdf(report.innovation.ravel())
        other = multivariate_normal(cov=S[np.ix_(rows, rows)])
        odds = 0.25 / 0.03 * both / other.pdf(report.innovation.ravel()[rows])
        np.testing.assert_allclose(seen.odds[k], np.log(odds), rtol=1e-9)


@pytest.mark.parametrize("std", [(0.0, 0.1), (0.05, 0.0), (0.05, 1e-9)])
@pytest.mark.parametrize("distance", [6.0, 1e9])
def test_tentative_landmarks_stay_sound_without_noise(std, distance):
    noise, slots = Noise(*std), np.arange(3)
    scan = np.array([(0.7, distance), (-0.2, 3.0), (2.0, 4.0)])
    held = TentativeLandmarks().with_new(scan, noise, slots, share=0.2)
    for _ in range(3):
        scan[:, 0] -= 0.2
        held = held.moved((0.0, 0.0, 0.2), np.array([0.0, 0.0, 0.04]))
        held = held.with_sightings(slots, scan, noise, np.full(3, 0.03)).after_scan(8)
        assert np.isfinite(held.odds).all()
        assert is_semidefinite(held.covariance)


def test_sightings_count_as_long_as_they_are_recent():
    landmark = tracked([(0.0, 5.0)])
    counts = []
    for seen in (True, False, False, True, False, False, False, False):
        landmark = landmark.after_scan(4)
        if seen:
            landmark = landmark.with_sightings(*sighting(0, (0.0, 5.0), 1.0))
        counts += landmark.sightings.tolist()
    assert counts == [2, 2, 2, 2, 1, 1, 1]  # and at last it is forgotten


def test_a_miss_counts_against_a_tentative_landmark():
    both = tracked([(0.0, 5.0), (1.0, 5.0)]).after_scan(8)
    one = both.with_sightings(*sighting(0, (0.0, 5.0), density=0.1))
    missed = one.with_misses(np.array([0.3, 0.05]))
    np.testing.assert_allclose(missed.odds - one.odds, [0.0, np.log(0.05)])


# --- all of it ---


@pytest.mark.parametrize("seed", range(3, 6))
def test_landmarks_are_found_by_a_robot_whose_heading_slips_by_a_radian(seed):
    world = load_scenario("slippery").with_changes(sensor={"identities": False})
    noise = {"motion_std": world.motion.std, "measurement_std": world.sensor.std}
    start = {"initial_pose": world.start.pose, "initial_pose_std": world.start.std}
    known, hidden = (
        make_estimator("invariant", **noise, **start, **options)
        for options in ({}, {"management": True})
    )
    env = LandmarkWorldEnv(world)
    observation, info = env.reset(seed=seed)
    for action in [*action_sequence(world), None]:
        known.update(observation["landmarks"], info["landmark_ids"])
        hidden.update(observation["landmarks"])
        if action is not None:
            observation, *_, info = env.step(action)
            for slam in (known, hidden):
                slam.predict(observation["odometry"])
    assert len(hidden.landmark_ids) == 6
    gap = hidden.belief().pose - known.belief().pose
    assert np.hypot(*gap[:2]) < 0.5


@pytest.mark.slow
def test_clutter_between_misses_makes_few_landmarks():
    settings = load_scenario("loop").model_dump()
    settings["sensor"] |= {"identities": False, "clutter": 1.0, "max_clutter": 5}
    world, ghosts = load_scenario(settings), 0
    for seed in range(6):
        env = LandmarkWorldEnv(world)
        observation, info = env.reset(seed=seed)
        true_ids = []
        slam = make_estimator(
            "invariant",
            motion_std=world.motion.std,
            measurement_std=world.sensor.std,
            initial_pose=world.start.pose,
            initial_pose_std=world.start.std,
            management={"association": "joint"},
        )
        for action in action_sequence(world)[:150]:
            seen = observation["mask"]
            slam.update(observation["landmarks"][seen])
            true_ids.append(info["landmark_ids"][seen])
            observation, *_, info = env.step(action)
            slam.predict(observation["odometry"])
        scores = score_association(slam.decisions, true_ids)
        ghosts += scores.ghost
        assert scores.new_correct == 14
    assert ghosts <= 2  # five, if sightings alone counted


@pytest.mark.parametrize("association", ["joint", "hypotheses"])
def test_an_outlier_that_began_a_landmark_does_not_delay_it(association):
    slam = make_estimator(
        "invariant",
        motion_std=(0.01, 0.01, 0.01),
        measurement_std=(0.05, 0.1),
        management={"association": association, "confirm": (3, 8)},
    )
    slam.update([(0.3, 4.6)])
    for _ in range(3):
        slam.predict((0.0, 0.0))
        slam.update([(0.3, 4.0)])
    np.testing.assert_allclose(np.hypot(*slam.belief().landmarks[0]), 4.0, atol=0.1)


@pytest.mark.parametrize("association", ["joint", "hypotheses"])
def test_two_landmarks_less_apart_than_the_noise_are_both_confirmed(association):
    rng = np.random.default_rng(5)
    true = predict_measurement(np.zeros(3), np.array([(4.0, -0.25), (4.0, 0.25)]))
    sizes = []
    for _ in range(10):
        slam = make_estimator(
            "invariant",
            motion_std=(0.01, 0.01, 0.01),
            measurement_std=(0.1, 0.1),
            management={"association": association, "confirm": (3, 3)},
        )
        for _ in range(3):
            noise = rng.normal(scale=(0.05, 0.05), size=(2, 2))
            slam.update(rng.permutation(true.measurement + noise))
        sizes.append(len(slam.landmark_ids))
    assert sizes == [2] * 10


def test_the_density_is_large_where_new_readings_appear():
    rng = np.random.default_rng(3)
    density = UnexplainedDensity()
    for _ in range(400):
        near = (rng.uniform(-np.pi, np.pi), rng.uniform(0.5, 5.0))  # clutter
        ahead = (rng.uniform(-0.7, 0.7), rng.uniform(7.0, 8.0))  # new landmarks
        known = (2.0, 2.0)
        readings = np.array([near, ahead, known])
        density = density.after(readings, [0, 1])
    bearing, distance = (rng.uniform(low, 1.0, 20_000) for low in (-1.0, 0.0))
    readings = np.column_stack([np.pi * bearing, density.longest * distance])
    total = density.at(readings).mean() * 2 * np.pi * density.longest
    np.testing.assert_allclose(total, 2.0, rtol=0.05)
    ahead, behind, middle = density.at(np.array([(0, 7.5), (3, 7.5), (0, 2.0)]))
    assert ahead > 3 * behind
    assert ahead > 3 * middle


def test_the_share_of_landmarks_is_that_of_the_readings_which_prove_to_be_one():
    density, scan = UnexplainedDensity(), np.ones((4, 2))
    for _ in range(500):
        density = density.after(scan, range(4), landmarks=1)
    assert density.landmark_share == pytest.approx(0.25)
    assert density.after(scan, [], landmarks=999).landmark_share == 1.0


@pytest.mark.parametrize("row", [0, 1])
def test_readings_of_tentative_landmarks_do_not_count_as_unexplained(row):
    management = {"association": "nearest", "confirm": (3, 3)}
    std = {"motion_std": (0.01,) * 3, "measurement_std": (0.05, 0.1)}
    slam = make_estimator("ekf", **std, management=management)
    scan, sums = np.array([(0.3, 4.6), (-0.5, 5.0)]), []
    for readings in (scan, scan[[row]]):
        slam.update(readings)
        sums.append(slam.state_dict()["0.tentative.density"][:2])
    (count, scans), (later, more) = sums
    assert later / count == pytest.approx((more - 1) / scans)  # both fade alike


def test_bearings_of_many_turns_count_in_their_sector():
    far = np.array([[1e200, 2.0], [-1e200, 2.0]])
    within = np.column_stack([wrap_angle(far[:, 0]), far[:, 1]])
    counts = [UnexplainedDensity().after(z, [0, 1]).cells for z in (far, within)]
    np.testing.assert_array_equal(*counts)


@pytest.mark.parametrize(("density", "size"), [(None, 1), (1e-3, 1), (1e6, 0)])
def test_a_given_density_counts_for_tentative_landmarks_too(density, size):
    slam = make_estimator(
        "ekf",
        motion_std=(0.1, 0.1, 0.1),
        measurement_std=(0.1, 0.1),
        management={"association": "joint", "confirm": (3, 3), "density": density},
    )
    for _ in range(3):
        slam.update([(0.3, 4.0)])
    assert len(slam.landmark_ids) == size


@pytest.mark.slow
def test_hidden_identities_are_found_out():
    world = load_scenario("hidden_identities")
    wrong = right = 0
    for seed in range(3):
        env = LandmarkWorldEnv(world)
        observation, info = env.reset(seed=seed)
        noise = {"motion_std": world.motion.std, "measurement_std": world.sensor.std}
        slam = make_estimator("invariant", **noise, management=True)
        true_ids = {}
        for action in [*action_sequence(world), None]:
            seen = observation["mask"]
            report = slam.update(observation["landmarks"][seen])
            for own, true in zip(
                report.row_ids, info["landmark_ids"][seen].tolist(), strict=True
            ):
                if own is None:
                    continue
                is_right = true_ids.setdefault(own, true) == true >= 0
                right, wrong = right + is_right, wrong + (not is_right)
            if action is None:
                break
            observation, *_, info = env.step(action)
            slam.predict(observation["odometry"])
        belief = slam.belief()
        assert sorted(true_ids.values()) == list(range(20))
        places = env.landmarks[[true_ids[i] for i in belief.landmark_ids]]
        assert np.abs(belief.landmarks - places).max() < 0.5
    assert right > 5000
    assert wrong < 0.002 * right


@pytest.mark.parametrize("column", [3, 5, 7])
def test_the_covariance_of_one_reading_is_that_of_its_jacobian(column):
    rng = np.random.default_rng(column)
    root = rng.standard_normal((9, 9))
    P, H = root @ root.T, np.zeros((2, 9))
    h = rng.standard_normal((2, 5))
    H[:, :3], H[:, column : column + 2] = h[:, :3], h[:, 3:]
    system = np.zeros((2, 9 + META_WIDTH))
    system[:, JACOBIAN : JACOBIAN + 5] = h
    system[:, VARIANCE] = 0.3, 0.7
    S = H @ P @ H.T + np.diag([0.3, 0.7])
    found = plain(screening.own_covariance)(P, system, 0, column)
    assert found == pytest.approx((S[0, 0], S[1, 0], S[1, 1]))


def plain(kernel):
    """Return the Python function of a kernel that only kernels call."""
    return getattr(kernel, "py_func", kernel)


@pytest.mark.parametrize("share", [0.98, 1.02])
@pytest.mark.parametrize("seed", range(5))
def test_a_landmark_is_near_within_ten_standard_deviations(seed, share):
    rng, column = np.random.default_rng(seed), 5
    root = rng.standard_normal((7, 7))
    P, mean = root @ root.T, np.zeros(7)
    angle = rng.uniform(-np.pi, np.pi)
    ahead = np.array([np.cos(angle), np.sin(angle)])
    delta = 3.0 * ahead  # the error in the robot's frame is e_l - e_p - J δ e_θ
    B = np.zeros((2, 7))
    B[:, :2], B[:, column:] = -np.eye(2), np.eye(2)
    B[:, 2] = delta[1], -delta[0]
    widest = np.linalg.eigvalsh(B @ P @ B.T)[-1]
    P *= (3.0 / (10 * share)) ** 2 / widest
    mean[:2] = rng.standard_normal(2)
    mean[column:] = mean[:2] + delta
    assert plain(screening.is_near)(mean, P, column) == (share < 1)


def test_a_reading_is_screened_at_the_expected_distance(monkeypatch):
    for name in ("usable", "is_near", "variances"):
        monkeypatch.setattr(screening, name, plain(getattr(screening, name)))
    rules = Rules(first_std=0.1, second_std=0.2, std_per_metre=0.1, std_metres=0.3)
    mean = np.array([1.0, 2.0, 0.5, 9.0, 9.0, 4.0, 6.0])  # 5 m from the second landmark
    belief = BeliefArrays(mean, 1e-4 * np.eye(7), np.zeros(7))
    rows = np.zeros((FIRST + 4, 7 + META_WIDTH))
    ledger = np.full((LEDGER_HEIGHT, 2), 7)
    ledger[SLOT] = 1, -1
    readings = np.array([(0.2, 4.0), (0.1, 3.0)])
    assert (
        plain(screening.screen)(belief, readings, 2, rules, np.inf, rows, ledger) == 1
    )
    found = rows[FIRST : FIRST + 2, VARIANCE]
    np.testing.assert_allclose(found, ((0.1 + 0.3 / 5) ** 2, (0.2 + 0.1 * 5) ** 2))
    assert ledger[OUTCOME].tolist() == [USED, ADDED]
    assert ledger[NEAR].tolist() == [0, 0]
