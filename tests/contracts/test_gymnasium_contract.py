"""Gymnasium's own checker and the traps that it does not see."""

import functools
import json
import math

import gymnasium as gym
import numpy as np
import pytest
from comparison import same
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils.env_checker import check_env
from presets import PRESETS

import slamgym  # noqa: F401 (registers the environments)
from slamgym.envs import LandmarkWorldEnv
from slamgym.estimator import EkfSlam
from slamgym.sim_configs import action_sequence, load_scenario, save_scenario

ID = "slamgym/LandmarkWorld-v0"
HIDDEN = {"scenario": "hidden_identities"}


@pytest.mark.parametrize("preset", ["hidden_identities", "active_rooms"])
def test_gymnasiums_checker_finds_nothing_to_warn_of(preset):
    env = gym.make(ID, scenario=preset).unwrapped
    check_env(env)  # pytest makes an error of a warning
    env.close()


@pytest.mark.parametrize("preset", PRESETS)
def test_every_observation_of_an_episode_lies_in_its_space(preset):
    env = LandmarkWorldEnv(preset)
    rng = np.random.default_rng(0)
    observation, _ = env.reset(seed=0)
    limits = env.action_space.high
    for action in action_sequence(env.scenario):
        assert observation in env.observation_space
        wild = rng.choice([-limits, limits]) * rng.integers(0, 2, 2)
        observation, *_ = env.step(wild if rng.random() < 0.3 else action)


def test_bounds_are_finite_and_hold_for_the_farthest_landmark():
    far = {"layout": "points", "points": [[-500.0, 0.0]]}
    env = LandmarkWorldEnv(landmarks=far, start={"std": [9.0, 0.0, 0.0]})
    observation, _ = env.reset(seed=0)
    for _ in range(env.scenario.steps):
        assert observation in env.observation_space
        observation, *_ = env.step([1.0, 0.0])
    assert all(np.isfinite(box.high).all() for box in env.observation_space.values())
    lowest, highest = (
        getattr(env.observation_space["landmarks"], end)[0] for end in ("low", "high")
    )
    assert lowest.tolist() == [-np.pi, 0.0]
    assert highest[0] == np.pi
    assert 500 + 10 * 9 + 29 * 3 < highest[1] < 1000


def test_an_id_with_the_package_in_front_makes_the_same_world():
    env, other = gym.make(ID), gym.make(f"slamgym:{ID}")
    same(env.reset(seed=0)[0], other.reset(seed=0)[0])


def no_json(constant):
    raise AssertionError(constant)  # NaN and Infinity, which Python alone reads


@pytest.mark.parametrize(
    "make", [gym.make, functools.partial(gym.make_vec, num_envs=2)]
)
@pytest.mark.parametrize("task", [ID, "slamgym/ActiveSlam-v0"])
def test_a_world_is_made_again_from_its_spec_in_json(task, make, tmp_path):
    path = tmp_path / "mine.toml"
    save_scenario(load_scenario("active_easy"), path)
    changes = {"steps": np.int64(9), "start": {"std": np.ones(3)}}
    endless = load_scenario("active_easy").with_changes(sensor={"max_range": math.inf})
    for scenario in (endless, path):
        world = make(task, scenario=scenario, **changes)
        written = world.spec.to_json()
        json.loads(written, parse_constant=no_json)
        assert EnvSpec.from_json(written) == world.spec
        again = make(EnvSpec.from_json(written))
        assert again.unwrapped.scenario == world.unwrapped.scenario
        assert again.spec.max_episode_steps == 9


@pytest.mark.parametrize("name", PRESETS)
def test_every_scenario_can_be_part_of_a_spec_in_json(name):
    spec = gym.make(ID, scenario=load_scenario(name)).spec
    assert EnvSpec.from_json(spec.to_json()) == spec
    (scenario,) = json.loads(spec.to_json(), parse_constant=no_json)["kwargs"].values()
    assert load_scenario(scenario) == load_scenario(name)


@pytest.mark.parametrize("mode", ["sync", "async"])
def test_worlds_in_gymnasiums_own_vectors_have_a_spec_in_json(mode):
    same_step = {"autoreset_mode": gym.vector.AutoresetMode.SAME_STEP}
    scenario = load_scenario("active_easy")
    make = functools.partial(gym.make_vec, vectorization_mode=mode)
    worlds = make(ID, 2, scenario=scenario, vector_kwargs=same_step)
    spec = EnvSpec.from_json(worlds.spec.to_json())
    again = gym.make_vec(spec)
    same(again.reset(seed=3), worlds.reset(seed=3))
    assert again.metadata["autoreset_mode"] == same_step["autoreset_mode"]
    for each in (again, worlds):
        each.close()


@pytest.mark.parametrize(
    "settings", [{"dtype": np.dtype("float32")}, {"estimator": EkfSlam}], ids=str
)
def test_types_among_the_keywords_can_be_part_of_a_spec_in_json(settings):
    spec = gym.make("slamgym/ActiveSlam-v0", **settings).spec
    assert gym.make(EnvSpec.from_json(spec.to_json())).spec == spec


def test_gymnasiums_time_limit_comes_on_top_of_the_worlds_own():
    env = gym.make(ID, max_episode_steps=3)
    env.reset(seed=0)
    assert [env.step([0.0, 0.0])[3] for _ in range(3)] == [False, False, True]


def test_single_batched_and_flat_observations_have_one_order():
    env = gym.make(ID, **HIDDEN)
    vector = gym.make_vec(ID, 2, vectorization_mode="sync", **HIDDEN)
    order = ["landmarks", "mask", "odometry"]
    assert list(env.observation_space) == order
    assert list(env.reset(seed=0)[0]) == order
    assert list(vector.observation_space) == order
    observation = env.step([0.5, 0.1])[0]
    flat = gym.spaces.flatten(env.observation_space, observation)
    expected = [np.ravel(observation[key]) for key in order]
    np.testing.assert_array_equal(flat, np.concatenate(expected))
    vector.close()


def test_the_mask_selects_rows():
    observation, _ = LandmarkWorldEnv("loop").reset(seed=0)
    selected = observation["landmarks"][observation["mask"]]
    assert observation["mask"].dtype == np.bool_
    assert 0 < len(selected) < len(observation["mask"])
    assert (selected[:, 1] > 0.0).all()


@pytest.mark.parametrize("changes", [{}, HIDDEN], ids=str)
def test_info_has_the_same_keys_shapes_and_types_in_reset_and_step(changes):
    env = gym.make(ID, **changes).unwrapped

    def form(info):
        return {k: (type(v), np.shape(v), np.asarray(v).dtype) for k, v in info.items()}

    first = form(env.reset(seed=0)[1])
    assert first["collision"][0] is bool
    for _ in range(20):
        assert form(env.step([1.0, 0.1])[4]) == first


@pytest.mark.parametrize("changes", [{}, HIDDEN], ids=str)
def test_nothing_handed_out_shares_memory_with_anything_else(changes):
    env = gym.make(ID, **changes).unwrapped
    moments = [env.reset(seed=0), *(env.step([1.0, 0.1])[::4] for _ in range(3))]
    moments.append(env.reset())
    arrays = [
        value
        for observation, info in moments
        for value in (*observation.values(), *info.values())
        if isinstance(value, np.ndarray)
    ]
    arrays += [env.landmarks, env.pose, env.start_estimate]
    for k, array in enumerate(arrays):
        assert not any(np.shares_memory(array, other) for other in arrays[:k])


def test_seeds_of_64_bits_are_accepted_and_an_absent_seed_does_not_reseed():
    env = gym.make(ID).unwrapped
    env.reset(seed=2**64 - 1)
    assert env.np_random_seed == 2**64 - 1
    rng = env.np_random
    env.reset()
    assert env.np_random is rng


def test_rendering_without_a_mode_warns_and_draws_nothing():
    env = LandmarkWorldEnv()
    env.reset(seed=0)
    with pytest.warns(UserWarning, match="render_mode"):
        assert env.render() is None
