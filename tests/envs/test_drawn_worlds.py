"""Worlds that draw their settings anew in every episode, single and side by side.

`test_world_batch` compares the two forms bit by bit.
"""

import gymnasium as gym
import numpy as np
import pytest
from worlds import RANGED

from slamgym.envs import LandmarkWorldEnv
from slamgym.envs.random_numbers import drawn_scenarios, episode_keys
from slamgym.envs.vector import LandmarkWorldVectorEnv
from slamgym.experiments.logs import record_episode
from slamgym.experiments.run_and_replay.simulated_runs import simulate_runs
from slamgym.sim_configs import ScenarioError, load_scenario
from slamgym.sim_configs.scenario import RANGES
from slamgym.sim_configs.scenario_files import copied_draw

FAMILY = load_scenario("active_easy").with_changes(randomise=RANGED)


def drawn_by(scenario, seeds):
    keys = episode_keys([np.random.default_rng(seed) for seed in seeds])
    return drawn_scenarios(scenario, keys)


@pytest.mark.parametrize("preset", ["active_easy", "loop", "hidden_identities"])
def test_a_quick_draw_equals_the_checked_one(preset):
    ranges = {**RANGED, "start_std": [0.5, 2.0], "map_scale": [0.9, 1.1]}
    scenario = load_scenario(preset).with_changes(randomise=ranges)
    rng = np.random.default_rng(0)
    for _ in range(5):
        shares = dict(zip(RANGES, rng.random(len(RANGES)).tolist(), strict=True))
        directions = rng.uniform(-1.0, 1.0, (scenario.landmarks.count, 2))
        quick = copied_draw(scenario, shares, directions)
        assert quick == scenario.drawn_at(shares, directions)
        assert quick.model_dump() == scenario.drawn_at(shares, directions).model_dump()
        assert hash(quick) == hash(scenario.drawn_at(shares, directions))


def test_draws_fill_their_ranges_independently():
    drawn = drawn_by(FAMILY, range(300))
    nominal = load_scenario("active_easy")
    of = {
        "motion": [np.log2(s.motion.std[0] / nominal.motion.std[0]) for s in drawn],
        "sensor": [np.log(s.sensor.std[1] / nominal.sensor.std[1]) for s in drawn],
        "range": [s.sensor.max_range for s in drawn],
        "x": [s.start.pose[0] for s in drawn],
        "heading": [s.start.pose[2] for s in drawn],
    }
    ends = {"motion": 1.0, "sensor": np.log(4), "range": 2.0, "x": 2.0, "heading": 3.0}
    table = np.array(list(of.values()))
    table[2] -= 4.0
    for row, end in zip(table, ends.values(), strict=True):
        assert np.abs(row).max() <= end
        assert abs(row.mean()) < 4 * end / np.sqrt(3 * 300)
        assert abs((row**2).mean() - end**2 / 3) < 4 * 0.3 * end**2 / np.sqrt(300)
    correlations = np.corrcoef(table) - np.eye(5)
    assert np.abs(correlations).max() < 0.25
    assert all(scenario.randomise is None for scenario in drawn)


def test_every_episode_draws_and_a_seed_repeats_all_of_them():
    env = LandmarkWorldEnv(FAMILY)
    episodes = []
    for seed in (5, None, None, 5, None):
        env.reset(seed=seed)
        episodes.append((env.drawn_scenario, env.landmarks.tolist()))
    assert episodes[0] == episodes[3]
    assert episodes[1] == episodes[4]
    assert len({each[0].motion.std for each in episodes[:3]}) == 3
    several = LandmarkWorldVectorEnv(num_envs=2, scenario=FAMILY)
    several.reset(seed=4)
    assert several.drawn_scenarios[1] == episodes[0][0]
    with pytest.raises(ScenarioError, match="did you mean 'num_envs'"):
        LandmarkWorldVectorEnv(num_env=2, scenario=FAMILY)


def test_the_world_has_the_noise_start_and_range_that_it_drew():
    scenario = load_scenario("six_landmarks").with_changes(
        randomise={"motion_std": [8.0, 8.0], "max_range": [4.0, 4.0], "start_x": [3, 3]}
    )
    drawn, plain = LandmarkWorldEnv(scenario), LandmarkWorldEnv("six_landmarks")
    slips, starts = [], []
    for env in (drawn, plain):
        observation, info = env.reset(seed=2)
        starts.append(info["pose"])
        if env is drawn:
            ranges = np.hypot(*(env.landmarks - info["pose"][:2]).T)
            np.testing.assert_array_equal(observation["mask"], ranges <= 4.0)
        slips.append(env.step([0.0, 0.0])[4]["pose"] - starts[-1])
    np.testing.assert_allclose(starts[0] - starts[1], (3.0, 0.0, 0.0), atol=1e-12)
    np.testing.assert_allclose(slips[0], 8.0 * slips[1], rtol=1e-9)


def test_without_ranges_the_scenario_is_its_own_draw():
    env = LandmarkWorldEnv("loop")
    env.reset(seed=0)
    assert env.drawn_scenario is env.scenario


@pytest.mark.parametrize("max_range", [None, [2.0, 6.0]])
def test_observations_of_all_draws_are_in_one_space(max_range):
    ranges = {"motion_std": [0.1, 20.0], "measurement_std": [0.1, 30.0]}
    ranges |= {"start_x": [-60.0, 40.0], "landmark_shift": 3.0, "max_range": max_range}
    world = {"scenario": "six_landmarks", "randomise": ranges}
    worlds = gym.make_vec("slamgym/LandmarkWorld-v0", 40, **world)
    assert isinstance(worlds.unwrapped, LandmarkWorldVectorEnv)
    observations, _ = worlds.reset(seed=0)
    for _ in range(40):
        assert observations in worlds.observation_space
        observations, *_ = worlds.step(worlds.action_space.sample())
    env = LandmarkWorldEnv("six_landmarks", randomise=ranges)
    assert env.observation_space == worlds.single_observation_space


def test_logs_and_runs_of_one_noise_refuse_ranges():
    from slamgym.envs.controllers import make_controller

    world = load_scenario("six_landmarks").with_changes(
        randomise={"motion_std": [0.5, 2.0]}
    )
    with pytest.raises(ScenarioError, match="has ranges"):
        simulate_runs(world, 2, seed=0)
    driver = make_controller("open_loop", world, np.random.default_rng(0))
    with pytest.raises(ScenarioError, match="has ranges"):
        record_episode(world, driver, seed=0)
