"""Active SLAM without identities: managed filters, and their scores."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from slamgym.agents import ActiveSlamEnv, ActiveSlamVectorEnv
from slamgym.agents.active_slam import matched_rmse
from slamgym.agents.active_slam_baselines import make_baseline
from slamgym.agents.active_slam_scores import VALIDATION
from slamgym.estimator.filters.batch import BatchStorage

SCORES = [
    f"association_{name}" for name in ("precision", "recall", "duplicate", "ghost")
]


def test_gymnasiums_checker_takes_hidden_identities():
    check_env(gym.make("slamgym/ActiveSlam-v0", scenario="active_hidden").unwrapped)


def test_scores_of_association_come_at_the_end_of_an_episode():
    env = ActiveSlamEnv("active_hidden", steps=12)
    _, info = env.reset(seed=VALIDATION)
    truncated = False
    while not truncated:
        assert all(info[name] == -1 for name in SCORES)
        *_, truncated, info = env.step([0.2, 0.4])
    assert 0.9 < info["association_precision"] <= 1.0
    assert 0.9 < info["association_recall"] <= 1.0
    assert info["association_ghost"] == 0


def test_an_agent_without_identities_maps_every_landmark_once():
    env = ActiveSlamEnv("active_hidden", sensor={"clutter": 0.0})
    baseline = make_baseline("coverage", env.scenario, np.random.default_rng(0))
    env.reset(seed=VALIDATION + 1)
    ended = False
    while not ended:
        *_, terminated, truncated, info = env.step(baseline.act(env.knowledge))
        ended = terminated or truncated
    assert info["honest_success"]
    assert info["known"] == 8
    assert info["association_duplicate"] == 0


@pytest.mark.parametrize("name", ["mpc", "greedy", "frontier", "revisit"])
def test_baselines_act_on_managed_maps(name):
    env = ActiveSlamEnv("active_hidden")
    baseline = make_baseline(name, env.scenario, np.random.default_rng(0))
    env.reset(seed=0)
    for _ in range(8):
        env.step(baseline.act(env.knowledge))
    assert env.knowledge.known_in_map.shape == (len(env.knowledge.belief.landmarks),)


def test_a_duplicate_is_compared_with_another_landmark():
    """Two landmarks of the map stand at the first of two true ones, 4 m apart."""
    means = np.array([[0, 0, 0, 1.0, 1.0, 1.0, 1.0]])
    beliefs = BatchStorage.of(means, np.zeros((1, 7, 7)), np.array([[0, 1]]))
    truth = np.array([[1 + 1j, 5 + 1j]])
    np.testing.assert_allclose(matched_rmse(beliefs, truth), [8**0.5])
    alone = beliefs._replace(slots=np.array([[0, -1]]))
    np.testing.assert_allclose(matched_rmse(alone, truth), [0.0])


def compare(batch, infos, singles):
    for k, (observation, info) in enumerate(singles):
        for rows, values in ((batch, observation), (infos, info)):
            for key, value in values.items():
                np.testing.assert_array_equal(rows[key][k], value)


@pytest.mark.parametrize("mode", ["NextStep", "SameStep", "Disabled"])
@pytest.mark.parametrize("form", [{}, {"observation": "set"}])
def test_many_worlds_without_identities_are_the_single_ones(mode, form):
    settings = {"scenario": "active_hidden", "steps": 5, **form}
    worlds = ActiveSlamVectorEnv(3, autoreset_mode=mode, **settings)
    envs = [ActiveSlamEnv(**settings) for _ in range(3)]
    batch, infos = worlds.reset(seed=4)
    singles = [env.reset(seed=4 + k) for k, env in enumerate(envs)]
    ended = np.zeros(3, dtype=bool)
    for action in np.random.default_rng(0).uniform(-1, 1, (13, 3, 2)):
        compare(batch, infos, singles)
        if mode == "Disabled" and ended.any():
            batch, infos = worlds.reset(options={"reset_mask": ended})
            for k in np.flatnonzero(ended):
                singles[k] = envs[k].reset()
        batch, _, terminated, truncated, infos = worlds.step(action)
        for k, env in enumerate(envs):
            if ended[k] and mode == "NextStep":
                singles[k] = env.reset()
                continue
            observation, *_, info = env.step(action[k])
            singles[k] = observation, info
            if mode == "SameStep" and (terminated | truncated)[k]:
                last = infos["final_info"]["association_ghost"][k]
                assert last == info["association_ghost"]
                singles[k] = env.reset()
        ended = terminated | truncated
