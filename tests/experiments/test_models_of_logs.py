"""Logs, trajectories and studies of worlds with other sensors and drives."""

import numpy as np
import pytest
from recordings import recorded

from slamgym.agents import ActiveSlamEnv, BeliefObservation
from slamgym.envs import LandmarkWorldEnv
from slamgym.estimator.registry import register_estimator
from slamgym.experiments import replay, settings_for
from slamgym.experiments.logs import read_slamlog, write_slamlog
from slamgym.experiments.logs.slamlog import LogError
from slamgym.experiments.monte_carlo_study.filtered_runs import (
    bound_runs,
    filter_runs,
    noise_of_runs,
)
from slamgym.experiments.run_and_replay.filter_settings import settings_for_scenario
from slamgym.experiments.run_and_replay.simulated_runs import simulate_runs
from slamgym.experiments.trajectories import drive_episodes
from slamgym.experiments.trajectories.formats import dead_reckoning, trajectory_format
from slamgym.sim_configs import load_scenario

NAMES = ["position", "differential", "bicycle"]


def short(name, steps=40):
    return load_scenario(name).with_changes(steps=steps)


@pytest.mark.parametrize("name", [*NAMES, "bearing", "range"])
def test_a_log_keeps_its_models_and_its_replay_those_of_the_runs(name, tmp_path):
    log = recorded(short(name))
    write_slamlog(log, tmp_path / "log.csv")
    again = read_slamlog(tmp_path / "log.csv")
    assert (again.motion, again.header) == (log.motion, log.header)
    settings = settings_for(again, estimator="ekf")
    assert settings == settings_for_scenario(short(name), estimator="ekf")
    runs = simulate_runs(short(name), 1, seed=3)
    alone = replay(again, settings.make(again.start)).trace.poses
    many = filter_runs(settings, runs).trace.poses[0]
    np.testing.assert_allclose(alone, many, atol=1e-9)


def test_a_log_names_the_columns_of_its_models():
    assert recorded(short("position")).header["measurement_columns"] == "x,y"
    assert recorded(short("bicycle")).header["odometry_columns"] == "d,steering"
    assert "measurement_columns" not in recorded(short("bicycle")).header


def test_a_log_of_an_unknown_drive_is_refused(tmp_path):
    log = recorded(short("differential"))
    write_slamlog(log, tmp_path / "log.csv")
    text = (tmp_path / "log.csv").read_text().replace("differential[", "tracked[")
    (tmp_path / "log.csv").write_text(text)
    with pytest.raises(LogError, match=r"line 3.*turn-last, midpoint or a drive"):
        read_slamlog(tmp_path / "log.csv")


@pytest.mark.parametrize("format", ["npz", "slamlog", "parquet", "minari"])
@pytest.mark.parametrize("name", [*NAMES, "bearing"])
def test_a_trajectory_reads_back_bit_for_bit(name, format, tmp_path):
    pytest.importorskip({"parquet": "pyarrow", "minari": "minari"}.get(format, "numpy"))
    layout = trajectory_format(format)
    drives = drive_episodes(short(name, 12), "open_loop", [4, 5])
    shard = tmp_path / f"some-v0{layout.ENDING}"
    layout.write(drives, shard)
    for before, after in zip(drives, layout.read(shard), strict=True):
        assert after.scenario == before.scenario
        np.testing.assert_array_equal(after.odometry, before.odometry)
        np.testing.assert_array_equal(after.measurements, before.measurements)
        np.testing.assert_array_equal(after.mask, before.mask)


def test_parquet_names_the_columns_of_the_models(tmp_path):
    pq = pytest.importorskip("pyarrow.parquet")
    scenario = short("bearing", 12).with_changes(robot=load_scenario("bicycle").robot)
    drives = drive_episodes(scenario, "open_loop", [4])
    trajectory_format("parquet").write(drives, tmp_path / "shard")
    found = {
        name
        for path in (tmp_path / "shard").rglob("*.parquet")
        for name in pq.read_schema(path).names
    }
    assert {"odometry_d", "odometry_steering", "reading_bearing"} <= found
    assert not {"odometry_turn", "ranges"} & found


def test_dead_reckoning_without_noise_gives_the_path():
    scenario = short("bicycle").with_changes(
        motion={"std": (0, 0, 0)}, start={"std": (0, 0, 0)}
    )
    (drive,) = drive_episodes(scenario, "open_loop", [1])
    motion = settings_for_scenario(scenario, estimator="ekf").make(np.zeros(3)).motion
    path = dead_reckoning(drive.start_estimate, drive.odometry, motion)
    np.testing.assert_allclose(path, drive.poses, atol=1e-9)


@pytest.mark.parametrize(
    ("format", "name", "message"),
    [
        ("g2o", "position", "format 'g2o' accepts only sensor = 'bearing_range'"),
        ("g2o", "bicycle", "format 'g2o' accepts only motion = 'unicycle'"),
        ("tum", "differential", "the format 'tum' takes the odometry of a unicycle"),
    ],
)
def test_a_format_refuses_models_that_it_cannot_hold(format, name, message):
    with pytest.raises(ValueError, match=message):
        trajectory_format(format).check(load_scenario(name))


def test_active_slam_refuses_other_models():
    with pytest.raises(
        ValueError, match="active SLAM accepts only motion = 'unicycle'"
    ):
        ActiveSlamEnv("bicycle")


@pytest.mark.usefixtures("own_registry")
def test_an_estimator_without_the_sensor_is_refused():
    class Own:
        def __init__(self, motion_std, measurement_std, initial_pose, initial_pose_std):
            """Take the noise alone."""

    register_estimator("own_without_models", Own)
    with pytest.raises(ValueError, match="does not accept sensor = 'position'"):
        settings_for_scenario(load_scenario("position"), estimator="own_without_models")


@pytest.mark.parametrize("name", NAMES)
def test_an_agent_follows_the_world_with_its_models(name):
    env = BeliefObservation(LandmarkWorldEnv(short(name)), "invariant")
    env.reset(seed=1)
    for _ in range(40):
        *_, info = env.step(np.array([0.5, 0.1]))
    estimate = env.belief.pose
    assert np.hypot(*(estimate - info["pose"])[:2]) < 0.3


def test_the_actual_noise_is_that_of_the_scenario_for_other_drives():
    scenario = short("bicycle", 100)
    runs = simulate_runs(scenario, 20, seed=0)
    count, total, squares = (
        noise_of_runs(scenario, scenario, runs)[:, :3, :3].sum(axis=0).T
    )
    np.testing.assert_array_equal(count, 2000)
    np.testing.assert_allclose(total / count, 0.0, atol=0.1)
    np.testing.assert_allclose(squares / count, 1.0, atol=0.12)


def test_the_bound_of_positions_is_that_of_a_filter_at_the_truth():
    scenario = short("position").with_changes(
        motion={"std": (1e-9, 1e-9, 1e-9)},
        sensor={"std": (0.1, 0.2), "max_range": 99.0},
    )
    runs = simulate_runs(scenario, 1, seed=0)
    bound = bound_runs(scenario, runs)
    slam = filter_runs(settings_for_scenario(scenario, estimator="invariant"), runs)
    found = np.trace(slam.trace.pose_covariances[0, -1, :2, :2])
    assert bound.raw_position[0, -1] == pytest.approx(found, rel=0.01)
