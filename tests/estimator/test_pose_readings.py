"""Readings of the pose: compass, GPS, and other linear functions of (x, y, θ)."""

import numpy as np
import pytest
from comparison import assert_close_beliefs, assert_same_bits, digest
from dense_family import TWINS, DenseAdaptiveInvariant, DenseInvariant, belief_of
from dense_family import tell_truth as tell
from drives import MEASUREMENT_STD, MOTION_STD, NOISE, SIX, drive
from interrupts import found_after_interrupts, is_interrupted, lines_of

from slamgym.estimator import make_batch, make_estimator
from slamgym.estimator.filters import pose_readings
from slamgym.estimator.filters.pose_readings import PoseReading, gate_of
from slamgym.estimator.models.bearing_range import predict_measurement, wrap_angle
from slamgym.estimator.smoother import Drive

START_STD = (0.3, 0.3, 0.4)
COMPASS = np.array([[0.0, 0.0, 1.0]])
GPS = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
MIXED = np.array([[1.0, 0.5, 2.0], [0.0, 0.0, 1.0], [0.0, 1.0, 0.0]])
FAMILY = TWINS | {"compressed[base=invariant,local_size=3]": DenseAdaptiveInvariant}


def pose_reading(step, pose, rng):
    """Return z, H and R of the reading after a step."""
    H = (COMPASS, GPS, MIXED)[step % 3]
    root = np.tril(rng.normal(0.0, 0.1, (len(H), len(H)))) + 0.2 * np.eye(len(H))
    z = H @ pose + root @ rng.standard_normal(len(H))
    if step % 3 == 0:
        z = z + 2 * np.pi * rng.integers(-2, 3)  # a compass has no whole turns
    return z, H, root @ root.T


def tell_truth(slam, pose):
    tell(slam, pose, dict(enumerate(SIX)))


def make(label, **changes):
    return make_estimator(label, **{**NOISE, "initial_pose_std": START_STD, **changes})


def steps_of(seed, steps):
    """Yield odometry, rows and ids of a scan, the truth, and a reading of the pose."""
    rng = np.random.default_rng(seed)
    for step, (odometry, readings, pose) in enumerate(drive(seed, steps)):
        seen = rng.permutation(6)[: rng.integers(4)]
        yield odometry, readings[seen], seen, pose, pose_reading(step, pose, rng)


def feed(slam, steps):
    for odometry, readings, seen, pose, given in steps:
        tell_truth(slam, pose)
        slam.predict(odometry)
        slam.update(readings, seen.tolist())
        slam.observe_pose(*given)


@pytest.mark.parametrize("label", FAMILY)
def test_equals_the_dense_twin(label):
    fast, twin = make(label), FAMILY[label](MOTION_STD, MEASUREMENT_STD, START_STD)
    for slam in (fast, twin):
        tell_truth(slam, np.zeros(3))
    for odometry, readings, seen, pose, given in steps_of(4, 40):
        for slam in (fast, twin):
            tell_truth(slam, pose)
            slam.predict(odometry)
        report = fast.observe_pose(*given)
        z, H, R = given
        np.testing.assert_allclose(report.nis, twin.observe_pose(z, H, R), rtol=1e-6)
        assert report.degrees_of_freedom == len(z) == len(report.innovation)
        for slam in (fast, twin):
            slam.update(readings, seen.tolist())
    mean, covariance = belief_of(twin)
    belief = fast.belief()
    np.testing.assert_allclose(belief.mean, mean, rtol=0, atol=1e-9)
    np.testing.assert_allclose(belief.covariance, covariance, rtol=0, atol=1e-9)


def test_report_has_the_innovation_and_its_covariance():
    slam = make("invariant")
    report = slam.observe_pose([0.4, -0.1], GPS, np.diag([0.04, 0.09]))
    np.testing.assert_allclose(report.innovation, [0.4, -0.1])
    np.testing.assert_allclose(report.innovation_covariance, np.diag([0.13, 0.18]))
    np.testing.assert_allclose(report.nis, 0.16 / 0.13 + 0.01 / 0.18)


def test_a_compass_reading_is_wrapped():
    slam = make("ekf", initial_pose=(0, 0, 3.0), initial_pose_std=(0, 0, 0.1))
    slam.observe_pose(-3.0, [0, 0, 1], 0.01)
    halfway = 3.0 + (2 * np.pi - 6.0) / 2
    np.testing.assert_allclose(slam.belief().pose[2], wrap_angle(halfway))


def test_an_exact_position_is_reached_however_far_the_heading_turns():
    """The correction of the invariant frame is iterated."""
    slam = make("invariant", initial_pose_std=(0.0, 0.0, 1.0))
    for _ in range(10):
        slam.predict((1.0, 0.0))
    slam.observe_pose([4.0, 9.0], GPS, 1e-6 * np.eye(2))
    np.testing.assert_allclose(slam.belief().pose[:2], [4.0, 9.0], atol=1e-3)


@pytest.mark.parametrize("label", FAMILY)
def test_a_saved_state_continues_bit_for_bit(label):
    steps = list(steps_of(1, 12))
    first, second = make(label), make(label)
    feed(first, steps[:6])
    second.load_state_dict(first.state_dict())
    for slam in (first, second):
        feed(slam, steps[6:])
    assert_same_bits(first.belief(), second.belief())


BAD = {
    "reading": ([np.nan], COMPASS, [[1.0]]),
    "reading shape": ([1.0, 2.0], COMPASS, [[1.0]]),
    "matrix": ([1.0], [[0.0, 1.0]], [[1.0]]),
    "matrix empty": ([], np.zeros((0, 3)), np.zeros((0, 0))),
    "covariance": ([1.0], COMPASS, [[0.0]]),
    "covariance negative": ([1.0, 1.0], GPS, [[1.0, 2.0], [2.0, 1.0]]),
    "covariance skew": ([1.0, 1.0], GPS, [[1.0, 0.5], [0.0, 1.0]]),
    "covariance infinite": ([1.0, 1.0], GPS, np.diag([1.0, np.inf])),
    "reading large": ([1e300], COMPASS, [[1.0]]),
}


@pytest.mark.parametrize("case", BAD)
@pytest.mark.parametrize("management", [None, True, {"association": "hypotheses"}])
def test_a_refused_reading_changes_nothing(case, management):
    slam = make("invariant", management=management)
    for _ in range(3):
        slam.update([(0.5, 4.0)]) if management else slam.update([(0.5, 4.0)], [0])
    before = digest(slam)
    with pytest.raises(ValueError, match=case.split()[0]):
        slam.observe_pose(*BAD[case])
    assert digest(slam) == before


@pytest.mark.parametrize("label", ["submaps", "sparse_information"])
def test_other_filters_refuse_in_one_sentence(label):
    slam = make(label, management=True)
    with pytest.raises(ValueError, match="does not accept readings of the pose"):
        slam.observe_pose(0.0, [0, 0, 1], 1.0)


def test_the_gate_rejects_what_is_outside_its_region():
    slam = make("invariant", gate_probability=0.99, initial_pose_std=(1, 1, 1))
    before = slam.belief()
    assert slam.observe_pose([0.0, 6.0], GPS, np.eye(2)).degrees_of_freedom == 0
    assert np.array_equal(slam.belief().mean, before.mean)
    assert slam.observe_pose([0.0, 4.0], GPS, np.eye(2)).degrees_of_freedom == 2


@pytest.mark.parametrize("sensor", ["bearing_range", "bearing"])
def test_the_gate_has_the_same_probability_in_any_dimension(sensor):
    rng = np.random.default_rng(0)
    rules = make("ekf", gate_probability=0.95, sensor=sensor).rules
    for size in (1, 2, 3):
        inside = (rng.standard_normal((200_000, size)) ** 2).sum(axis=1)
        share = (inside <= gate_of(rules, size)).mean()
        np.testing.assert_allclose(share, 0.95, atol=0.003)
    np.testing.assert_allclose(gate_of(rules, rules.numbers), rules.gate)
    assert gate_of(make("ekf").rules, 1) == np.inf


@pytest.mark.parametrize("label", ["ekf", "invariant", "first_estimates"])
def test_a_batch_equals_single_filters(label):
    runs = [list(steps_of(seed, 15)) for seed in range(3)]
    settings = {**NOISE, "initial_pose_std": START_STD, "gate_probability": 0.9}
    batch = make_batch(label, runs=3, landmarks=6, **settings)
    singles = [make(label, **settings) for _ in runs]
    for step in range(15):
        now = [run[step] for run in runs]
        _, H, R = now[0][4]
        chosen = np.array([True, step % 2 == 0, True])
        readings, seen = np.zeros((3, 6, 2)), np.zeros((3, 6), dtype=bool)
        for k, (_, rows, ids, *_) in enumerate(now):
            readings[k, ids], seen[k, ids] = rows, True
        batch.step(np.array([each[0] for each in now]), readings, seen, np.ones(3))
        z = np.array([each[4][0] for each in now])
        z[1] *= np.nan if step % 2 else 1.0
        nis, freedom = batch.observe_pose(z, H, R, runs=chosen)
        for k, slam in enumerate(singles):
            slam.predict(now[k][0])
            slam.update(now[k][1], now[k][2].tolist())
            if chosen[k]:
                report = slam.observe_pose(z[k], H, R)
                np.testing.assert_allclose(nis[k], report.nis, rtol=1e-9)
                assert freedom[k] == report.degrees_of_freedom
            else:
                assert (nis[k], freedom[k]) == (0.0, 0)
    assert (freedom == 0).sum() < 3
    for k, slam in enumerate(singles):
        mine, own = batch.belief(k), slam.belief(batch.belief(k).landmark_ids)
        assert_close_beliefs(mine, own, 1e-11, 1e-12)


def test_a_reading_survives_as_rows():
    for H in (COMPASS, GPS, MIXED):
        size = len(H)
        R = np.eye(size) + 0.1
        given = PoseReading.checked(np.arange(size), H, R)
        first, *rest = given.rows()
        assert len(rest) == 1 - 2 * first[2]
        for part, again in zip(given, PoseReading.of_rows(rest), strict=True):
            assert np.array_equal(part, again)


@pytest.mark.parametrize(
    "options", [{}, {"sensor": "range"}, {"management": True}], ids=str
)
def test_an_interrupt_leaves_a_reading_with_its_report_or_none(options):
    slam, steps = make("invariant", **options), list(steps_of(4, 5))
    for odometry, readings, seen, *_ in steps:
        slam.predict(odometry)
        slam.update(readings[:, 1:] if "sensor" in options else readings, seen.tolist())
    found = found_after_interrupts(slam, lambda s: s.observe_pose(*steps[-1][-1]))
    assert found == {"before", "marked" if "management" in options else "after"}


def test_a_filter_returns_the_report_of_a_reading_until_the_next_scan():
    slam = make("ekf")
    for odometry, readings, seen, _, given in steps_of(4, 5):
        slam.predict(odometry)
        first = slam.update(readings, seen.tolist())
        before, report = slam.snapshot(), slam.observe_pose(*given)
        slam.predict(odometry)
        assert slam.report() is report
        slam.resume(before)
        assert slam.report() == first


def test_a_reading_keeps_its_report_where_a_later_step_changes_nothing():
    slam, ((odometry, readings, seen, _, given), *_) = make("ekf"), steps_of(4, 5)
    slam.predict(odometry)
    slam.update(readings, seen.tolist())
    report = slam.observe_pose(*given)
    with pytest.raises(ValueError, match="landmark_ids"):
        slam.update([(0.5, 4.0)] * 2, [0, 0])
    assert slam.report() is report
    for line in range(lines_of(lambda: slam.observe_pose(*given))):
        report, steps = slam.observe_pose(*given), slam.steps
        assert is_interrupted(lambda: slam.observe_pose(*given), line)
        assert (slam.report() is report) == (slam.steps == steps)


@pytest.mark.parametrize("association", ["nearest", "hypotheses"])
def test_a_managed_filter_repeats_readings_of_the_pose_too(association):
    """With backdating, a landmark seen thrice has the belief of known identities."""
    policy = {"association": association, "confirm": (3, 5), "backdate": True}
    managed, known = make("invariant", management=policy), make("invariant")
    for odometry, _, _, pose, given in steps_of(2, 3):
        for slam in (managed, known):
            slam.predict(odometry)
            slam.observe_pose(*given)
        saved = managed.state_dict()
        managed.load_state_dict(saved)
        managed.update(two_landmarks(pose))
        known.update(two_landmarks(pose), [0, 1])
    assert_close_beliefs(managed.belief(), known.belief())


def two_landmarks(pose):
    """Two landmarks far from each other, read without noise."""
    return predict_measurement(pose, SIX[[0, 5]]).measurement


def test_slopes_equal_central_differences_in_the_invariant_frame():
    """∂(H p)/∂ξ at the corrected pose, with ξ in the coordinates of the prior."""
    H, prior, at = MIXED, np.array([3.0, -2.0, 0.7]), np.array([5.0, 1.0, 0.2])

    def pose(xi):
        centre, turn = DenseInvariant.exponential(xi, at), xi[2]
        return H @ [centre[0], centre[1], at[2] + turn]

    numeric = [(pose(e) - pose(-e)) / 2e-6 for e in 1e-6 * np.eye(3)]
    by_xi = np.transpose(numeric)
    to_xi = np.eye(3)
    to_xi[:2, 2] = prior[1], -prior[0]  # ξ = δ − (J p̂) δθ
    slopes = pose_readings.slopes_at(H, at[:2] - prior[:2])
    np.testing.assert_allclose(slopes, by_xi @ to_xi, atol=1e-8)


def test_a_robot_at_rest_does_not_observe_its_heading_by_gps():
    rng, R = np.random.default_rng(0), np.eye(2) / 100
    slam = make("invariant", initial_pose_std=(9, 9, 0.1))
    for _ in range(100):
        slam.observe_pose([5.0, 3.0] + 0.1 * rng.standard_normal(2), GPS, R)
    std = np.sqrt(slam.belief().pose_covariance.diagonal())
    np.testing.assert_allclose(std, [0.01, 0.01, 0.1], rtol=0.02)


def test_observe_conditions_on_any_first_components():
    mean, P = np.arange(5.0), np.diag([1.0, 2.0, 3.0, 4.0, 5.0])
    H, R = np.array([[0.0, 0.0, 1.0, 1.0]]), np.eye(1)
    found = pose_readings.observe(mean, P, H, R, np.array([9.0]) - H @ mean[:4])
    K = P[:, 2:4].sum(axis=1) / 8
    np.testing.assert_allclose(found.mean, mean + K * 4)
    np.testing.assert_allclose(found.covariance, P - 8 * np.outer(K, K))


def test_a_batch_refuses_readings_of_another_number_of_runs():
    batch = make_batch("ekf", runs=3, landmarks=2, **NOISE)
    with pytest.raises(ValueError, match="a row for each of 3 runs"):
        batch.observe_pose(np.zeros((2, 1)), [0, 0, 1], 1.0)


def test_a_drive_with_other_readings_has_its_own_odometry_and_readings_of_the_pose():
    made = Drive(MOTION_STD, MEASUREMENT_STD)
    made.observe_pose(0.1, [0, 0, 1], 1.0)
    made.predict((1.0, 0.0))
    other = made.with_scans([])
    other.predict((2.0, 0.0))
    other.observe_pose(0.2, [0, 0, 1], 1.0)
    made.end_motion()
    assert (made.pose_components, other.pose_components) == (1, 2)
    assert [each.motions[1].increment[0] for each in (made, other)] == [1.0, 3.0]


def test_a_drive_keeps_a_reading_of_the_pose_whose_arrays_the_caller_fills_again():
    made = Drive(MOTION_STD, MEASUREMENT_STD)
    z, H = np.array([1.0, 2.0]), GPS.copy()
    made.predict((1.0, 0.0))
    made.observe_pose(z, H, np.eye(2))
    z[:], H[:] = 9.0, 0.0
    kept = made.pose_readings(1)[0]
    assert kept.value.tolist() == [1.0, 2.0]
    assert np.array_equal(kept.matrix, GPS)
