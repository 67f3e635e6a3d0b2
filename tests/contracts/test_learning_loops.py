"""Every environment in the loops of those who learn: Stable-Baselines3, CleanRL."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers import (
    ClipAction,
    FlattenObservation,
    NormalizeObservation,
    NormalizeReward,
    RecordEpisodeStatistics,
)
from gymnasium.wrappers.vector import RecordEpisodeStatistics as RecordStatisticsOfMany

import slamgym  # noqa: F401 (registers the environments)
from slamgym.envs.vector import FlattenBatch, to_stable_baselines

IDS = sorted(each for each in gym.registry if each.startswith("slamgym/"))
STEPS = 12
CHANGES = {"scenario": "active_easy", "steps": STEPS}  # every environment accepts it

pytestmark = pytest.mark.filterwarnings("default::DeprecationWarning")


def flat(each):
    return FlattenObservation(gym.make(each, **CHANGES))


def flat_worlds(each, count, mode=AutoresetMode.NEXT_STEP):
    return FlattenBatch(gym.make_vec(each, count, autoreset_mode=mode, **CHANGES))


# --- replay buffers, as off-policy learners fill them ---


def step_all(worlds, actions):
    """Yield per step: before, action, reward, terminated, after, whether it counts.

    A learner that keeps transitions must not take the beginning of the next episode
    for what the last action led to: that is in ``final_obs`` where an episode begins
    anew in the same step; else the step that only resets must be left out.
    """
    observations, _ = worlds.reset(seed=7)
    same_step = worlds.metadata["autoreset_mode"] == AutoresetMode.SAME_STEP
    counts = np.ones(worlds.num_envs, dtype=bool)
    for action in actions:
        after, rewards, terminated, truncated, infos = worlds.step(action)
        ended, led_to = terminated | truncated, after.copy()
        if same_step:
            for world in np.flatnonzero(ended):
                led_to[world] = infos["final_obs"][world]
        yield observations, action, rewards, terminated, led_to, counts
        observations = after
        if not same_step:
            counts = ~ended


def episodes_one_by_one(each, seed, transitions):
    """Repeat transitions in a single world, which must agree at every step."""
    env = flat(each)
    observation, _ = env.reset(seed=seed)
    episodes = 0
    for before, action, reward, terminated, led_to in transitions:
        np.testing.assert_array_equal(before, observation)
        observation, its_reward, its_terminated, truncated, _ = env.step(action)
        assert reward == its_reward
        assert terminated == its_terminated
        np.testing.assert_array_equal(led_to, observation)
        if terminated or truncated:
            observation, _ = env.reset()
            episodes += 1
    return episodes


@pytest.mark.slow
@pytest.mark.parametrize("mode", [AutoresetMode.SAME_STEP, AutoresetMode.NEXT_STEP])
@pytest.mark.parametrize("each", IDS)
def test_a_replay_buffer_holds_what_the_actions_led_to(each, mode):
    rng = np.random.default_rng(0)
    actions = rng.uniform(-1, 1, (3 * STEPS, 3, 2)).astype(np.float32)
    stored = list(step_all(flat_worlds(each, 3, mode), actions))
    for world in range(3):
        kept = [
            tuple(column[world] for column in columns)
            for *columns, counts in stored
            if counts[world]
        ]
        assert episodes_one_by_one(each, 7 + world, kept) >= 2


# --- CleanRL: a script of one file ---


def native_worlds(each, count):
    return RecordStatisticsOfMany(flat_worlds(each, count))


def wrapped_worlds(each, count):
    def make():
        env = RecordEpisodeStatistics(flat(each))
        return NormalizeReward(NormalizeObservation(ClipAction(env)))

    return SyncVectorEnv([make] * count)


@pytest.mark.parametrize("make_worlds", [native_worlds, wrapped_worlds])
@pytest.mark.parametrize("each", IDS)
def test_worlds_wrapped_as_cleanrl_does_give_what_its_loop_keeps(each, make_worlds):
    worlds, rng, lengths = make_worlds(each, 4), np.random.default_rng(0), []
    assert isinstance(worlds.single_action_space, gym.spaces.Box)
    rows = 4, np.prod(worlds.single_observation_space.shape)
    observations, _ = worlds.reset(seed=1)
    for _ in range(6 * STEPS):
        assert np.shape(observations) == rows
        assert np.isfinite(observations).all()
        action = rng.uniform(-1, 1, (4, 2)).astype(np.float32)
        observations, reward, terminated, truncated, infos = worlds.step(action)
        assert np.isfinite(reward).all()
        assert np.shape(reward) == np.shape(terminated) == np.shape(truncated) == (4,)
        if "episode" in infos:
            lengths += list(infos["episode"]["l"][infos["_episode"]])
    worlds.close()
    assert len(lengths) >= 4 * 5
    assert max(lengths) == STEPS


# --- Stable-Baselines3 ---


@pytest.mark.slow
@pytest.mark.parametrize("each", IDS)
def test_the_checker_of_stable_baselines_is_silent_on_the_flat_world(sb3, each):
    checker = pytest.importorskip("stable_baselines3.common.env_checker")
    checker.check_env(flat(each))  # pytest makes an error of a warning


OPTIONS = {
    "PPO": {"n_steps": 32, "batch_size": 32, "n_epochs": 1},
    "SAC": {"learning_starts": 64, "buffer_size": 500, "batch_size": 32},
}


@pytest.mark.slow
@pytest.mark.parametrize(("algorithm", "side_by_side"), [("SAC", False), ("PPO", True)])
@pytest.mark.parametrize("each", IDS)
def test_stable_baselines_learns(sb3, torch, each, algorithm, side_by_side, tmp_path):
    count = 4 if side_by_side else 1
    env = flat(each)
    if side_by_side:
        env = to_stable_baselines(flat_worlds(each, 4, AutoresetMode.SAME_STEP))
        env = sb3.common.vec_env.VecMonitor(env)
    learner = getattr(sb3, algorithm)
    model = learner("MlpPolicy", env, seed=0, device="cpu", **OPTIONS[algorithm])
    before = torch.nn.utils.parameters_to_vector(model.policy.parameters()).clone()
    model.learn(256)
    after = torch.nn.utils.parameters_to_vector(model.policy.parameters())
    assert model.num_timesteps == 256
    assert torch.isfinite(after).all()
    assert not torch.equal(after, before)
    assert len(model.ep_info_buffer) >= 256 // STEPS - count
    assert max(episode["l"] for episode in model.ep_info_buffer) == STEPS

    model.save(tmp_path / "policy")
    loaded = learner.load(tmp_path / "policy", device="cpu")
    observation, _ = flat(each).reset(seed=3)
    action, _ = model.predict(observation, deterministic=True)
    assert action in model.action_space
    np.testing.assert_array_equal(
        loaded.predict(observation, deterministic=True)[0], action
    )
