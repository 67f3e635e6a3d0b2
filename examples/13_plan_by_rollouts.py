"""Plan in the world itself: try actions, return to the state before, take the best.

``env.restore(state)`` returns exactly to ``env.state()``, within microseconds. The
generator is part of the state, so these plans know the noise to come: the returns show
what planning can reach at most. An agent that must not know it plans in its belief, as
in ``slamgym.agents.imagine``.

Run it::

    python examples/13_plan_by_rollouts.py

It prints return, steps and success of some episodes.
"""

import argparse

import numpy as np

from slamgym.agents import ActiveSlamEnv

PLANS, LENGTH = 24, 6  # plans of a decision; steps that a plan keeps its action


def value_of(env: ActiveSlamEnv, action: np.ndarray) -> float:
    """Return the reward of keeping an action, and leave the world as it is."""
    now, value = env.state(), 0.0
    for _ in range(LENGTH):
        _, reward, terminated, truncated, _ = env.step(action)
        value += reward
        if terminated or truncated:
            break
    env.restore(now)
    return value


def play(env: ActiveSlamEnv, seed: int) -> str:
    """Play an episode, and describe it."""
    rng = np.random.default_rng(seed)
    low, high = env.action_space.low, env.action_space.high  # type: ignore[attr-defined]
    env.reset(seed=seed)
    total, steps, over = 0.0, 0, False
    while not over:
        plans = rng.uniform(low, high, (PLANS, 2))
        best = plans[np.argmax([value_of(env, action) for action in plans])]
        for _ in range(LENGTH // 2):
            _, reward, terminated, truncated, info = env.step(best)
            total, steps, over = total + reward, steps + 1, terminated or truncated
            if over:
                break
    outcome = "success" if info["success"] else "no success"
    return f"return {total:.1f} in {steps} steps, {outcome}"


def main() -> None:
    """Play some episodes."""
    parser = argparse.ArgumentParser(description="Plan by rollouts in the world.")
    parser.add_argument("--scenario", default="active_easy")
    parser.add_argument("--episodes", type=int, default=5)
    arguments = parser.parse_args()
    env = ActiveSlamEnv(arguments.scenario)
    for seed in range(arguments.episodes):
        print(f"episode {seed}: {play(env, seed)}")


if __name__ == "__main__":
    main()
