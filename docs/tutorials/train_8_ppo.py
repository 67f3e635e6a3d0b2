"""
An agent that learns
====================

PPO of Stable-Baselines3 learns to explore. The agent observes the belief of a filter, never the truth. The build of this
site does not run this tutorial, because it needs ``pip install torch==2.13.0 stable-baselines3`` and two minutes of CPU time.
"""

# sphinx_gallery_thumbnail_path = 'images/active_slam_learning_curve.png'  # noqa: ERA001
# %%
# Worlds side by side
# -------------------
# Each of the 64 worlds has its own map and its own filter. The belief, the walls and the explored cells form one array.

import gymnasium as gym
import numpy as np
from gymnasium.spaces import flatten
from stable_baselines3 import PPO

from slamgym.agents import ActiveSlamEnv, active_slam_scores, make_baseline
from slamgym.envs import FlattenBatch, to_stable_baselines

worlds = gym.make_vec(
    "slamgym:slamgym/ActiveSlam-v0",
    64,
    scenario="active_medium",
    autoreset_mode="SameStep",
)

# %%
# Training
# --------

model = PPO(
    "MlpPolicy",
    to_stable_baselines(FlattenBatch(worlds)),
    n_steps=64,
    batch_size=1024,
    n_epochs=5,
    gamma=0.995,
    learning_rate=lambda left: 5e-4 * left,
    policy_kwargs={"net_arch": [128, 128], "log_std_init": -0.5},
    seed=0,
)
model.learn(500_000)

# %%
# New maps
# --------
# A policy is a function of the observation and the environment. Both policies run on the same maps.

env = ActiveSlamEnv("active_medium")


def trained(observation, env):
    """Return the action of the trained policy, without noise."""
    flat = flatten(env.observation_space, observation)
    return model.predict(flat, deterministic=True)[0]


coverage = make_baseline("coverage", env.scenario, np.random.default_rng(0))
policies = {
    "trained": trained,
    "coverage": active_slam_scores.baseline_policy(coverage),
}
seeds = range(active_slam_scores.VALIDATION, active_slam_scores.VALIDATION + 20)
played = {
    name: active_slam_scores.run_episodes(env, policy, seeds)
    for name, policy in policies.items()
}
print(active_slam_scores.score_table(played))

# %%
# The returns are 12.6 ± 2.1 for the trained policy and 13.2 ± 1.8 for coverage: after half a million steps, 20 maps do not show
# a difference. :doc:`/active_slam_scores` compares five seeds on 100 maps, and :doc:`/reinforcement_learning` lists other
# libraries.
