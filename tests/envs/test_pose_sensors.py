"""Compass and GPS of a world."""

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import slamgym  # noqa: F401 (registers the environments)
from slamgym.envs.noise_streams import PoseSensors
from slamgym.envs.vector import WorldBatch
from slamgym.sim_configs import load_scenario
from slamgym.sim_configs.field_types import ScenarioError

WORLD = "slamgym/LandmarkWorld-v0"
BOTH = {"compass": {"std": 0.05, "every": 2}, "gps": {"std": 0.5, "every": 3}}


def scenario(**changes):
    return load_scenario("loop").with_changes(steps=30, **changes)


def test_single_and_vector_worlds_read_the_same_bits_when_due():
    single = gymnasium.make(WORLD, scenario=scenario(**BOTH))
    several = gymnasium.make_vec(WORLD, num_envs=3, scenario=scenario(**BOTH))
    _, info = single.reset(seed=5)
    _, infos = several.reset(seed=3)
    for step in range(12):
        for key in ("gps", "gps_mask", "compass", "compass_mask"):
            assert np.array_equal(info[key], infos[key][2])
        assert info["compass_mask"] == (info["compass"] != 0) == (step % 2 == 0)
        assert info["gps_mask"] == info["gps"].all() == (step % 3 == 0)
        assert len(set(infos["compass"][:2])) == 2 or step % 2
        action = np.array([0.5, 0.3])
        *_, info = single.step(action)
        *_, infos = several.step(np.tile(action, (3, 1)))


def test_a_world_without_them_has_no_such_readings():
    _, info = gymnasium.make(WORLD, scenario=scenario()).reset(seed=0)
    assert not {"gps", "compass"} & info.keys()
    _, info = gymnasium.make(WORLD, scenario=scenario(gps={"std": 1.0})).reset(seed=0)
    assert "gps" in info
    assert "compass" not in info
    _, info = gymnasium.make(WORLD, scenario=scenario(compass={"std": 0.1})).reset()
    assert {"compass", "compass_mask"} == info.keys() - {"pose", "collision"}


@pytest.mark.parametrize("task", [WORLD, "slamgym/ActiveSlam-v0"])
def test_worlds_whose_sensors_do_not_read_at_every_step_pass_the_check(task):
    world = gymnasium.make(task, scenario=load_scenario("active_easy"), **BOTH)
    check_env(world.unwrapped, skip_render_check=True)


def test_they_change_no_other_noise():
    observations = []
    for changes in ({}, BOTH):
        world = gymnasium.make(WORLD, scenario=scenario(**changes))
        world.reset(seed=1)
        observations.append([world.step([0.5, 0.1])[0] for _ in range(5)])
    for one, other in zip(*observations, strict=True):
        assert all(np.array_equal(one[key], other[key]) for key in one)


def test_errors_are_normal_with_the_given_deviations():
    alone = PoseSensors(scenario(gps={"std": 0.5}))
    one = np.zeros((1, 2), np.uint64), np.zeros(1, np.int64), np.zeros((1, 3))
    assert np.isnan(alone.read(*one)[0]).tolist() == [False, False, True]
    sensors = PoseSensors(scenario(compass={"std": 0.05}, gps={"std": 0.5}))
    keys = np.random.default_rng(0).integers(0, 2**63, (4000, 2)).astype(np.uint64)
    poses = np.tile([3.0, -2.0, 3.1], (4000, 1))
    readings = sensors.read(keys, np.full(4000, 7), poses)
    assert (np.abs(readings[:, 2]) <= np.pi).all()
    errors = readings - poses
    errors[:, 2] = (errors[:, 2] + np.pi) % (2 * np.pi) - np.pi
    np.testing.assert_allclose(errors.std(axis=0), [0.5, 0.5, 0.05], rtol=0.04)
    assert (np.abs(errors.mean(axis=0)) < 4 * np.array([0.5, 0.5, 0.05]) / 63).all()
    correlation = np.corrcoef(errors.T) - np.eye(3)
    assert np.abs(correlation).max() < 0.07
    again = sensors.read(keys, np.full(4000, 8), poses)
    assert abs(np.corrcoef(again[:, 0], readings[:, 0])[0, 1]) < 0.07


def test_a_partial_reset_leaves_the_readings_of_other_worlds():
    worlds = WorldBatch(scenario(**BOTH), 2)
    generators = [np.random.default_rng(seed) for seed in (0, 1)]
    worlds.reset(generators)
    worlds.step(np.full((2, 2), 0.3))
    worlds.step(np.full((2, 2), 0.3))
    before = worlds.pose_readings.copy()
    worlds.reset(generators, np.array([False, True]))
    assert np.array_equal(worlds.pose_readings[0], before[0], equal_nan=True)
    assert np.isfinite(worlds.pose_readings[1]).all()  # step 0


@pytest.mark.parametrize(
    "change", [{"std": 0.0}, {"std": 1.0, "every": 0}, {"every": 2}, {"sdt": 1.0}]
)
def test_wrong_settings_are_refused(change):
    with pytest.raises(ScenarioError, match="gps"):
        scenario(gps=change)
