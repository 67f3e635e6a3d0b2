"""PPO in one file, to read and to change: an agent learns to explore.

Nothing is hidden in a library for reinforcement learning: networks, advantages, losses
and the loop are below, in the style of CleanRL. 64 worlds of ``slamgym/ActiveSlam-v0``,
each with its filter, run side by side in one process. The example needs PyTorch::

    pip install torch==2.13.0

Run it::

    python examples/12_ppo_in_one_file.py               # about three minutes
    python examples/12_ppo_in_one_file.py --steps 100000

It prints the mean return of the episodes that ended, writes it into
``results/12_ppo_in_one_file/curve.csv``, and the policy into ``policy.pt`` beside it.
Equal seeds give equal files.

Source: Schulman et al., "Proximal policy optimization algorithms", arXiv 1707.06347.
"""

import argparse
import csv
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn
from torch.distributions import Normal

from slamgym.envs import FlattenBatch

FOLDER = Path("results/12_ppo_in_one_file")
ROLLOUT = 64  # steps of every world between two updates
EPOCHS, BATCH = 5, 1024
GAMMA, LAMBDA = 0.995, 0.95  # discount, and decay of the advantage's sum
CLIP = 0.2  # of the probability ratio
LEARNING_RATE = 5e-4  # falls to 0
VALUE_WEIGHT, LARGEST_GRADIENT = 0.5, 0.5


def network(inputs: int, outputs: int, gain: float) -> nn.Sequential:
    """Make two hidden layers, with orthogonal weights and a last layer of a gain."""
    sizes = [(inputs, 128, 2**0.5), (128, 128, 2**0.5), (128, outputs, gain)]
    layers: list[nn.Module] = []
    for before, after, scale in sizes:
        layer = nn.Linear(before, after)
        nn.init.orthogonal_(layer.weight, scale)
        nn.init.zeros_(layer.bias)
        layers += [layer, nn.Tanh()]
    return nn.Sequential(*layers[:-1])


class Agent(nn.Module):  # type: ignore[misc]
    """A Gaussian policy and a value function."""

    def __init__(self, inputs: int, actions: int) -> None:
        super().__init__()
        self.actor = network(inputs, actions, 0.01)
        self.critic = network(inputs, 1, 1.0)
        self.log_std = nn.Parameter(torch.full((actions,), -0.5))

    def policy(self, observations: torch.Tensor) -> Normal:
        """Return the distribution of actions."""
        return Normal(self.actor(observations), self.log_std.exp())

    def value(self, observations: torch.Tensor) -> torch.Tensor:
        """Return the expected discounted return."""
        return self.critic(observations).squeeze(-1)


class Rollout:
    """The last `ROLLOUT` steps of all worlds, as tensors with the steps first."""

    def __init__(self, worlds: int, inputs: int, actions: int) -> None:
        self.observations = torch.zeros(ROLLOUT, worlds, inputs)
        self.actions = torch.zeros(ROLLOUT, worlds, actions)
        self.log_probs = torch.zeros(ROLLOUT, worlds)
        self.values = torch.zeros(ROLLOUT, worlds)
        self.rewards = torch.zeros(ROLLOUT, worlds)
        self.ended = torch.zeros(ROLLOUT, worlds)

    def advantages(self, last_value: torch.Tensor) -> torch.Tensor:
        """Return the generalised advantage estimates (arXiv 1506.02438, eq. 16)."""
        out, sum_ahead, value = torch.zeros_like(self.rewards), 0.0, last_value
        for t in reversed(range(ROLLOUT)):
            goes_on = 1.0 - self.ended[t]
            delta = self.rewards[t] + GAMMA * goes_on * value - self.values[t]
            sum_ahead = delta + GAMMA * LAMBDA * goes_on * sum_ahead
            out[t], value = sum_ahead, self.values[t]
        return out


def tensor(array: Any) -> torch.Tensor:
    return torch.as_tensor(np.asarray(array), dtype=torch.float32)


def collect(
    envs: Any, agent: Agent, first: NDArray[np.float64], rollout: Rollout
) -> tuple[NDArray[np.float64], list[float]]:
    """Fill a rollout; return the next observations and the returns that ended."""
    observations, returns = first, []
    for t in range(ROLLOUT):
        seen = tensor(observations)
        policy = agent.policy(seen)
        action = policy.sample()
        limits = envs.action_space.low, envs.action_space.high
        observations, rewards, terminated, truncated, infos = envs.step(
            np.clip(action.numpy(), *limits)
        )
        rollout.observations[t], rollout.actions[t] = seen, action
        rollout.log_probs[t] = policy.log_prob(action).sum(-1)
        rollout.values[t] = agent.value(seen)
        rollout.rewards[t] = tensor(rewards)
        rollout.ended[t] = tensor(terminated | truncated)
        for world in np.flatnonzero(truncated):  # its value is not 0: time was up
            last = agent.value(tensor(infos["final_obs"][world]))
            rollout.rewards[t, world] += GAMMA * last
        if "episode" in infos:
            returns += infos["episode"]["r"][infos["_episode"]].tolist()
    return observations, returns


def update(agent: Agent, optimiser: Any, rollout: Rollout, last: torch.Tensor) -> None:
    """Take several epochs of steps on the clipped objective."""
    advantages = rollout.advantages(last)
    targets = (advantages + rollout.values).flatten()
    advantages = advantages.flatten()
    observations = rollout.observations.flatten(0, 1)
    actions, old = rollout.actions.flatten(0, 1), rollout.log_probs.flatten()
    for _ in range(EPOCHS):
        for rows in torch.randperm(len(old)).split(BATCH):
            ratio = (
                agent.policy(observations[rows]).log_prob(actions[rows]).sum(-1)
                - old[rows]
            ).exp()
            gain = advantages[rows]
            gain = (gain - gain.mean()) / (gain.std() + 1e-8)
            clipped = ratio.clamp(1.0 - CLIP, 1.0 + CLIP)
            policy_loss = -torch.minimum(ratio * gain, clipped * gain).mean()
            value_loss = (agent.value(observations[rows]) - targets[rows]).pow(2).mean()
            optimiser.zero_grad()
            (policy_loss + VALUE_WEIGHT * value_loss).backward()
            nn.utils.clip_grad_norm_(agent.parameters(), LARGEST_GRADIENT)
            optimiser.step()


def train(scenario: str, steps: int, worlds: int, seed: int) -> list[dict[str, float]]:
    """Train an agent, save it, and return the learning curve."""
    torch.manual_seed(seed)
    torch.set_num_threads(1)  # small networks: more threads wait for each other
    envs: Any = gym.make_vec(
        "slamgym:slamgym/ActiveSlam-v0",
        worlds,
        scenario=scenario,
        autoreset_mode="SameStep",
    )
    envs = FlattenBatch(gym.wrappers.vector.RecordEpisodeStatistics(envs))
    sizes = envs.single_observation_space.shape[0], envs.single_action_space.shape[0]
    agent, rollout = Agent(*sizes), Rollout(worlds, *sizes)
    optimiser = torch.optim.Adam(agent.parameters(), lr=LEARNING_RATE, eps=1e-5)
    observations, _ = envs.reset(seed=worlds * seed)
    curve: list[dict[str, float]] = []
    rounds = max(1, steps // (ROLLOUT * worlds))
    for k in range(rounds):
        optimiser.param_groups[0]["lr"] = LEARNING_RATE * (1 - k / rounds)
        with torch.no_grad():
            observations, returns = collect(envs, agent, observations, rollout)
            last = agent.value(tensor(observations))
        update(agent, optimiser, rollout, last)
        mean = float(np.mean(returns)) if returns else float("nan")
        curve.append({"steps": (k + 1) * ROLLOUT * worlds, "return": mean})
        if k % 10 == 0 or k + 1 == rounds:
            print("after {steps:8} steps: return {return:6.2f}".format(**curve[-1]))
    torch.save(agent.state_dict(), FOLDER / "policy.pt")
    return curve


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scenario", default="active_medium")
    parser.add_argument("--steps", type=int, default=1_000_000)
    parser.add_argument("--worlds", type=int, default=64)
    parser.add_argument("--seed", type=int, default=0)
    FOLDER.mkdir(parents=True, exist_ok=True)
    curve = train(**vars(parser.parse_args()))
    with (FOLDER / "curve.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, ["steps", "return"])
        writer.writeheader()
        writer.writerows(curve)


if __name__ == "__main__":
    main()
