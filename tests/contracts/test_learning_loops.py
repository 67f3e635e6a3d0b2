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


@pytest.fixture(scope="module")
def torch():
    library = pytest.importorskip("torch", reason="needs torch")
    library.set_num_threads(1)
    return library


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


# --- CleanRL: a script of one file, here with the same calls ---


def native_worlds(each, count):
    return RecordStatisticsOfMany(flat_worlds(each, count))


def wrapped_worlds(each, count):
    def make():
        env = RecordEpisodeStatistics(flat(each))
        return NormalizeReward(NormalizeObservation(ClipAction(env)))

    return SyncVectorEnv([make] * count)


def make_agent(torch, worlds):
    inputs = int(np.prod(worlds.single_observation_space.shape))
    outputs = int(np.prod(worlds.single_action_space.shape))

    def network(size):
        return torch.nn.Sequential(
            torch.nn.Linear(inputs, 16), torch.nn.Tanh(), torch.nn.Linear(16, size)
        )

    log_std = torch.nn.Parameter(torch.zeros(outputs))
    agent = torch.nn.ModuleDict({"actor": network(outputs), "critic": network(1)})
    agent.register_parameter("log_std", log_std)
    return agent


def policy(torch, agent, observations):
    means = agent["actor"](observations)
    return torch.distributions.Normal(means, agent.log_std.exp())


def advantages_of(rewards, values, dones, last_value, gamma=0.99, decay=0.95):
    """Generalised advantage estimates; dones[t] says that t begins an episode."""
    advantages, running = np.zeros_like(rewards), 0.0
    following = [*values[1:], last_value]
    for t in reversed(range(len(rewards))):
        goes_on = 1.0 - dones[t + 1]
        error = rewards[t] + gamma * following[t] * goes_on - values[t]
        advantages[t] = running = error + gamma * decay * goes_on * running
    return advantages


def collect(torch, worlds, agent, state, length):
    """Act for some steps; return the rollout, where it stopped, and the returns."""
    observations, done = state
    rows = {key: [] for key in ("seen", "acted", "log_prob", "value", "reward")}
    dones, returns = [done], []
    for _ in range(length):
        seen = torch.as_tensor(observations, dtype=torch.float32)
        with torch.no_grad():
            distribution = policy(torch, agent, seen)
            acted = distribution.sample()
            value = agent["critic"](seen)[:, 0]
        observations, reward, terminated, truncated, infos = worlds.step(acted.numpy())
        done = (terminated | truncated).astype(np.float32)
        log_prob = distribution.log_prob(acted).sum(1)
        for key, item in zip(rows, (seen, acted, log_prob, value, reward), strict=True):
            rows[key].append(torch.as_tensor(item, dtype=torch.float32))
        dones.append(done)
        if "episode" in infos:
            ended = infos["_episode"]
            returns += list(infos["episode"]["l"][ended])
    rollout = {key: torch.stack(items) for key, items in rows.items()}
    return rollout, np.array(dones), (observations, done), returns


def learn(torch, agent, optimizer, rollout, advantages):
    """One step on the clipped objective of PPO and the squared error of the critic."""
    flatten = {key: items.flatten(0, 1) for key, items in rollout.items()}
    advantages = torch.as_tensor(advantages, dtype=torch.float32).flatten()
    targets = advantages + flatten["value"]
    distribution = policy(torch, agent, flatten["seen"])
    log_prob = distribution.log_prob(flatten["acted"]).sum(1)
    ratio = (log_prob - flatten["log_prob"]).exp()
    clipped = ratio.clamp(0.8, 1.2)
    gain = torch.minimum(ratio * advantages, clipped * advantages).mean()
    error = (agent["critic"](flatten["seen"])[:, 0] - targets).square().mean()
    loss = error - gain - 0.01 * distribution.entropy().mean()
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()
    return loss.item()


@pytest.mark.slow
@pytest.mark.parametrize("make_worlds", [native_worlds, wrapped_worlds])
@pytest.mark.parametrize("each", IDS)
def test_a_loop_as_cleanrl_writes_it_runs(torch, each, make_worlds):
    torch.manual_seed(0)
    worlds = make_worlds(each, 4)
    assert isinstance(worlds.single_action_space, gym.spaces.Box)
    agent = make_agent(torch, worlds)
    before = torch.nn.utils.parameters_to_vector(agent.parameters()).clone()
    optimizer = torch.optim.Adam(agent.parameters(), 1e-2)
    observations, _ = worlds.reset(seed=1)
    state, lengths = (observations, np.zeros(4, dtype=np.float32)), []
    for _ in range(3):
        rollout, dones, state, ended = collect(torch, worlds, agent, state, 2 * STEPS)
        with torch.no_grad():
            last = torch.as_tensor(state[0], dtype=torch.float32)
            last_value = agent["critic"](last)[:, 0].numpy()
        advantages = advantages_of(
            rollout["reward"].numpy(), rollout["value"].numpy(), dones, last_value
        )
        for _ in range(2):
            assert np.isfinite(learn(torch, agent, optimizer, rollout, advantages))
        lengths += ended
    worlds.close()
    after = torch.nn.utils.parameters_to_vector(agent.parameters())
    assert torch.isfinite(after).all()
    assert not torch.equal(after, before)
    assert len(lengths) >= 4 * 5
    assert max(lengths) == STEPS


# --- Stable-Baselines3 ---


@pytest.fixture(scope="module")
def sb3(torch):
    return pytest.importorskip("stable_baselines3", reason="needs Stable-Baselines3")


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
@pytest.mark.parametrize("side_by_side", [False, True], ids=["single", "vector"])
@pytest.mark.parametrize("algorithm", OPTIONS)
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
