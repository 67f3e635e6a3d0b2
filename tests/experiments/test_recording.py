import gymnasium
import numpy as np
import pytest
from comparison import assert_same_bits
from recordings import recorded

import slamgym  # noqa: F401 (registers the environment)
from slamgym.envs.controllers import Waypoints, make_controller
from slamgym.estimator import make_estimator
from slamgym.experiments.logs.recording import record_episode
from slamgym.experiments.logs.slamlog import (
    OdometryRow,
    Scan,
    read_slamlog,
    write_slamlog,
)
from slamgym.experiments.run_and_replay.filter_settings import settings_for
from slamgym.experiments.run_and_replay.log_replay import replay
from slamgym.sim_configs import action_sequence, load_scenario


def in_the_loop(scenario, seed):
    """Filter while driving, as an agent would; return the beliefs after each step."""
    env = gymnasium.make("slamgym/LandmarkWorld-v0", scenario=scenario)
    observation, _ = env.reset(seed=seed)
    world = env.unwrapped
    noise = {"motion_std": scenario.motion.std, "measurement_std": scenario.sensor.std}
    start = {"initial_pose": world.start_estimate}
    start["initial_pose_std"] = scenario.start.std
    estimator = make_estimator("ekf", **noise, **start)
    beliefs = []
    for action in [None, *action_sequence(scenario)]:
        if action is not None:
            observation, *_ = env.step(action)
            estimator.predict(observation["odometry"])
        seen = np.flatnonzero(observation["mask"])
        estimator.update(observation["landmarks"][seen], seen.tolist())
        beliefs.append(estimator.belief())
    return beliefs


@pytest.mark.parametrize("preset", ["six_landmarks", "dropout"])
def test_recording_and_replay_equal_the_loop_of_an_agent_bit_for_bit(preset):
    scenario = load_scenario(preset).with_changes(steps=29)
    log = recorded(scenario)
    done = replay(log, settings_for(log, estimator="ekf").make(log.start))
    beliefs = in_the_loop(scenario, seed=3)
    np.testing.assert_array_equal(done.trace.poses, [b.pose for b in beliefs])
    assert_same_bits(done.belief, beliefs[-1])


def test_a_recorded_log_survives_the_disk_bit_for_bit(tmp_path):
    log = recorded("six_landmarks")
    write_slamlog(log, tmp_path / "log.csv")
    copy = read_slamlog(tmp_path / "log.csv")
    settings = settings_for(copy)
    assert settings == settings_for(log)
    first = replay(log, settings.make(log.start)).belief
    second = replay(copy, settings.make(copy.start)).belief
    np.testing.assert_array_equal(first.covariance, second.covariance)


def test_time_counts_steps_and_the_first_scan_is_at_zero():
    log = recorded("six_landmarks", steps=4)
    rows = [event for event in log.events if isinstance(event, OdometryRow)]
    scans = [event for event in log.events if isinstance(event, Scan)]
    assert [(row.t, row.dt) for row in rows] == [(float(k), 1.0) for k in (1, 2, 3, 4)]
    assert [scan.t for scan in scans] == [0.0, 1.0, 2.0, 3.0, 4.0]
    assert log.ground_truth[:, 0].tolist() == [0.0, 1.0, 2.0, 3.0, 4.0]


def test_a_moment_in_which_nothing_is_seen_makes_no_scan():
    log = recorded("six_landmarks", sensor={"max_range": 0.1}, steps=4)
    assert not [event for event in log.events if isinstance(event, Scan)]


def test_the_header_tells_the_noise_of_the_world():
    log = recorded(
        "six_landmarks", sensor={"range_std_per_metre": 0.02}, steps=2, seed=5
    )
    assert log.header["scenario"] == "six_landmarks"
    assert log.header["seed"] == "5"
    settings = settings_for(log)
    assert settings.motion_std == (0.25, 0.1, 0.1)
    assert settings.measurement_std == (0.01, 0.08)
    assert settings.initial_pose_std == (0.02, 0.02, 0.1)
    assert settings.options == {"range_std_per_metre": 0.02}


def test_a_world_at_rest_without_noise_makes_a_filter_without_it():
    log = recorded("six_landmarks", motion={"noise_at_rest": False}, steps=2)
    assert settings_for(log).options == {"noise_at_rest": False}


def test_hidden_identities_stay_hidden():
    log = recorded("hidden_identities", steps=3)
    scans = [event for event in log.events if isinstance(event, Scan)]
    assert scans
    assert all(scan.landmark_ids is None for scan in scans)


def test_the_truth_behind_hidden_readings_is_kept_beside_them():
    log = recorded("hidden_identities", steps=12)
    sensor = {"identities": True, "clutter": 0.0, "max_clutter": 0}
    told = recorded("hidden_identities", steps=12, sensor=sensor)
    known, clutter = [e for e in told.events if isinstance(e, Scan)], 0
    hidden = [e for e in log.events if isinstance(e, Scan)]
    for scan, other in zip(hidden, known, strict=True):
        real = scan.true_ids >= 0
        order = np.argsort(scan.true_ids[real])
        assert scan.true_ids[real][order].tolist() == other.landmark_ids.tolist()
        readings = scan.measurements[real][order]
        np.testing.assert_array_equal(readings, other.measurements)
        clutter += (~real).sum()
    assert clutter > 3


def test_a_filter_starts_where_the_world_says_and_not_at_the_truth():
    drawn = recorded("six_landmarks", start={"drawn": "estimate"}, steps=2)
    assert drawn.ground_truth[0, 1:].tolist() == [0.0, 0.0, 0.0]
    assert (drawn.start != 0).all()


def test_readings_show_the_landmarks_from_the_true_pose():
    log = recorded("six_landmarks", sensor={"std": [0.0, 0.0]}, steps=6)
    scans = [event for event in log.events if isinstance(event, Scan)]
    for scan, (_, x, y, heading) in zip(scans, log.ground_truth, strict=True):
        bearing, distance = scan.measurements.T
        angle = heading + bearing
        seen = distance[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        seen += x, y
        np.testing.assert_allclose(seen, log.landmarks[scan.landmark_ids], atol=1e-12)


def test_the_same_seed_gives_the_same_log_also_with_a_controller_that_looks():
    world = load_scenario("corridor").with_changes(steps=20)

    def drive(seed):
        points = [(12.0, 0.0), (12.0, 12.0)]
        driver = Waypoints(points, world.robot, dt=world.dt, tolerance=0.5)
        return record_episode(world, driver, seed).ground_truth

    np.testing.assert_array_equal(drive(1), drive(1))


def test_progress_is_told_after_every_step():
    told = []
    world = load_scenario("six_landmarks").with_changes(steps=3)
    driver = make_controller("random", world, np.random.default_rng(0))
    record_episode(world, driver, 0, progress=lambda *numbers: told.append(numbers))
    assert told == [(1, 3), (2, 3), (3, 3)]
