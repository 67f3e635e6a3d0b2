"""Other libraries' estimators: the same numbers as ours where they must be the same."""

import sys
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from slamgym.estimator import (
    check_estimator,
    list_estimators,
    list_peers,
    make_batch,
    make_estimator,
    smooth,
)
from slamgym.estimator.models.bearing_range import predict_measurement
from slamgym.estimator.models.motions import predict_pose
from slamgym.estimator.registry import find_estimator
from slamgym.estimator.smoother import RecordedSlam
from slamgym.experiments.monte_carlo_study import monte_carlo
from slamgym.sim_configs import load_scenario

sys.path.append(str(Path(__file__).parents[2] / "benchmarks"))

from field import KALMAN_PEERS

PEERS = {peer.name: peer for peer in list_peers()}
NOISE = {"motion_std": (0.1, 0.05, 0.03), "measurement_std": (0.02, 0.1)}
START = {"initial_pose": (1.0, 2.0, 0.7), "initial_pose_std": (0.1, 0.3, 0.2)}
LANDMARKS = np.array([[4.0, 1.0], [2.0, -3.0], [-1.0, 4.0], [6.0, 5.0], [3.0, 9.0]])


def peer(name, **settings):
    """Make an estimator of another library, or skip the test."""
    library = name.partition("_")[0]
    pytest.importorskip(library, reason=f"needs {library}, see extras peers, interop")
    found = KALMAN_PEERS.get(name, name)
    return make_estimator(found, **{**NOISE, **START, **settings})


def drive(*estimators, steps=12, scale=1.0, seed=3):
    """Follow one arc with all estimators; three landmarks come in late."""
    rng = np.random.default_rng(seed)
    truth, u = np.array(START["initial_pose"]), np.array([0.8, 0.35])
    for step in range(steps):
        noise = scale * rng.standard_normal(3) * NOISE["motion_std"]
        moved = predict_pose(truth, u)
        truth = moved.pose + moved.jacobian_noise @ noise
        ids = np.arange(2 if step < 4 else 5)
        z = predict_measurement(truth, LANDMARKS[ids]).measurement
        z += scale * rng.standard_normal(z.shape) * NOISE["measurement_std"]
        for estimator in estimators:
            estimator.predict(u)
            estimator.update(z, ids)
    return [estimator.belief() for estimator in estimators]


def assert_same(one, other, **tolerance):
    assert one.landmark_ids == other.landmark_ids
    assert_allclose(one.mean, other.mean, **tolerance)
    assert_allclose(one.covariance, other.covariance, **tolerance)


def test_gtsams_are_listed_apart_from_ours():
    assert len(PEERS) >= 3
    assert not set(PEERS) & set(list_estimators())


@pytest.mark.parametrize("name", [*PEERS, *KALMAN_PEERS])
def test_a_peer_passes_the_checks_of_every_estimator(name):
    peer(name)
    assert check_estimator(find_estimator(KALMAN_PEERS.get(name, name))) == ()


@pytest.mark.parametrize("name", PEERS)
def test_a_missing_library_is_named_with_how_to_install_it(name, monkeypatch):
    library = PEERS[name].library
    monkeypatch.setitem(sys.modules, library, None)
    assert not PEERS[name].installed
    with pytest.raises(
        ValueError, match=f"'{name}' needs {library}.*pip install 'slam"
    ):
        make_estimator(name, **NOISE)
    with pytest.raises(ValueError, match=f"needs {library}"):
        monte_carlo("six_landmarks", f"ekf,{name}", runs=1)


def test_a_misspelt_peer_is_suggested():
    with pytest.raises(ValueError, match="did you mean 'gtsam_isam2'"):
        make_estimator("gtsam_isam", **NOISE)


@pytest.mark.parametrize("name", ["filterpy_ekf", "stonesoup_ekf"])
@pytest.mark.parametrize(
    "options", [{}, {"range_std_per_metre": 0.1, "noise_at_rest": False}], ids=str
)
def test_their_extended_filters_are_our_ekf(name, options):
    theirs, ours = (
        peer(name, **options),
        make_estimator("ekf", **NOISE, **START, **options),
    )
    for estimator in (theirs, ours):
        estimator.predict((0.0, 0.0))
    assert_same(*drive(theirs, ours), rtol=0, atol=1e-9)


def test_their_reports_are_those_of_our_ekf():
    theirs = [peer("filterpy_ekf"), peer("stonesoup_ekf")]
    ours = make_estimator("ekf", **NOISE, **START)
    drive(ours, *theirs, steps=4)
    scan = [(0.2, 3.0), (0.1, 5.0), (1.0, 1e-6), (-2.0, 4.0)]
    expected = ours.update(scan, [0, 8, 9, 1])
    for estimator in theirs:
        report = estimator.update(scan, [0, 8, 9, 1])
        assert report.associated_ids == expected.associated_ids == (0, 1)
        assert report.added_ids == expected.added_ids == (8,)
        assert report.skipped_ids == expected.skipped_ids == (9,)
        assert report.nis == pytest.approx(expected.nis, rel=1e-9)
        assert_allclose(report.innovation, expected.innovation, atol=1e-9)
        assert_allclose(
            report.innovation_covariance, expected.innovation_covariance, atol=1e-9
        )


@pytest.mark.parametrize("name", ["filterpy_ukf", "stonesoup_ukf"])
def test_their_unscented_filters_approach_the_ekf_where_noise_is_small(name):
    small = {key: np.array(value) / 100 for key, value in NOISE.items()}
    small["initial_pose_std"] = np.array(START["initial_pose_std"]) / 100
    theirs = peer(name, **small)
    ours = make_estimator("ekf", **{**NOISE, **START, **small})
    one, other = drive(theirs, ours, scale=0.01)
    assert_allclose(one.mean, other.mean, atol=1e-3)
    assert_allclose(one.covariance, other.covariance, rtol=0, atol=1e-7)


def test_the_unscented_filters_agree_with_each_other():
    one, other = drive(peer("filterpy_ukf"), peer("stonesoup_ukf"))
    assert_allclose(one.mean, other.mean, atol=1e-2)
    assert_allclose(one.covariance, other.covariance, rtol=0.05, atol=1e-3)


@pytest.mark.parametrize("name", PEERS)
def test_a_graph_has_the_prior_and_the_motion_noise_of_our_frames(name):
    theirs, ours = peer(name), make_estimator("ekf", **NOISE, **START)
    for estimator in (theirs, ours):
        estimator.predict((1.5, 0.6))
        estimator.predict((1.0, -0.9), dt=2.0)
    assert_same(theirs.belief(), ours.belief(), rtol=0, atol=1e-7)


@pytest.mark.parametrize("name", PEERS)
def test_the_innovations_of_a_graph_are_those_of_the_ekf_before_it_is_nonlinear(name):
    theirs, ours = peer(name), make_estimator("ekf", **NOISE, **START)
    for estimator in (theirs, ours):
        estimator.update([(0.2, 3.0), (-1.0, 5.0)], [0, 1])
        estimator.predict((1.5, 0.6))
    report, expected = (e.update([(0.1, 2.2)], [0]) for e in (theirs, ours))
    assert report.nis == pytest.approx(expected.nis, rel=1e-6)
    assert_allclose(
        report.innovation_covariance, expected.innovation_covariance, rtol=1e-6
    )


def test_the_batch_of_gtsam_is_our_smoother():
    follower = RecordedSlam(make_estimator("ekf", **NOISE, **START), **NOISE, **START)
    theirs, _ = drive(peer("gtsam_batch"), follower)
    ours = smooth(follower.recorded()).belief()
    assert theirs.landmark_ids == ours.landmark_ids
    assert_allclose(theirs.mean, ours.mean, atol=2e-3)
    assert_allclose(theirs.covariance, ours.covariance, rtol=0.03, atol=1e-4)


@pytest.mark.parametrize("name", ["gtsam_isam2", "gtsam_fixed_lag"])
def test_the_marginal_of_isam2_is_about_its_linearisation_point(name):
    start = {"initial_pose": (0, 0, 0), "initial_pose_std": (0.02, 0.02, 0.1)}
    noise = {"motion_std": (0.1, 0.1, 0.3), "measurement_std": (0.01, 0.1)}
    both = [peer(each, **start, **noise) for each in (name, "gtsam_batch")]
    for pose in ((0, 0, 0), (10, 0, 0.5)):  # turned by more than the odometry says
        for estimator in both:
            if pose[0]:
                estimator.predict((10, 0))
            z = predict_measurement(np.array(pose), LANDMARKS).measurement
            estimator.update(z, range(5))
    theirs, batch = (estimator.belief().pose_covariance for estimator in both)
    assert_allclose(theirs, batch, rtol=0.02, atol=0.01)


def test_a_long_fixed_lag_changes_nothing_and_the_usual_one_is_10():
    lags = ({"lag": 2}, {"lag": 100}, {"lag": 10}, {})
    fixed = (peer("gtsam_fixed_lag", **lag) for lag in lags)
    short, long, ten, usual, isam2 = drive(*fixed, peer("gtsam_isam2"), steps=15)
    assert_same(ten, usual, rtol=0)
    assert_allclose(long.mean, isam2.mean, atol=1e-6)
    assert np.abs(short.mean - isam2.mean).max() > 1e-5


@pytest.mark.parametrize("name", PEERS)
def test_without_innovations_a_graph_reports_none(name):
    plain, silent = peer(name), peer(name, innovations=False)
    drive(plain, silent)
    assert plain.update([(0.1, 2.2)], [0]).degrees_of_freedom == 2
    report = silent.update([(0.1, 2.2)], [0])
    assert (report.nis, report.degrees_of_freedom) == (0.0, 0)
    assert_same(plain.belief(), silent.belief(), rtol=0, atol=1e-12)


def test_options_are_refused_by_name():
    with pytest.raises(ValueError, match="lag must be a whole number >= 1"):
        peer("gtsam_fixed_lag", lag=0)
    with pytest.raises(ValueError, match="relinearize_threshold must be"):
        peer("gtsam_isam2", relinearize_threshold=-1.0)
    with pytest.raises(ValueError, match="cannot run in batches"):
        make_batch("gtsam_isam2", runs=1, landmarks=1, **NOISE)
    with pytest.raises(ValueError, match="of GtsamIsam2Slam, not of GtsamBatchSlam"):
        peer("gtsam_batch").load_state_dict(peer("gtsam_isam2").state_dict())


def test_a_monte_carlo_compares_a_peer_with_our_filter():
    peer("gtsam_isam2")
    before = list_estimators()
    results = monte_carlo("six_landmarks", "invariant,gtsam_isam2", runs=2)
    assert not results.failed.any()
    errors = results.ate.values
    assert_allclose(errors[0], errors[1], rtol=0.2)
    assert list_estimators() == before


def test_a_robot_without_noise_sideways_is_no_indeterminate_system():
    peer("gtsam_isam2")
    world = load_scenario(load_scenario("loop").model_dump() | {"steps": 40})
    names = "invariant,gtsam_isam2,gtsam_fixed_lag,gtsam_batch"
    results = monte_carlo(world, names, runs=1)
    assert not results.failed.any(), results.message.values
    areas = results.pose_area.values[:, 0]
    assert_allclose(areas[1:], areas[0], rtol=0.1)


@pytest.mark.slow
def test_a_peer_runs_in_worker_processes():
    peer("gtsam_isam2")
    job = ("six_landmarks", "gtsam_isam2")
    alone = monte_carlo(*job, runs=4, block_size=2)
    shared = monte_carlo(*job, runs=4, block_size=2, jobs=2)
    assert_allclose(alone.ate.values, shared.ate.values, rtol=0)
