"""Time steps, `state` and `restore` of worlds, in units of a bare physics step.

    python benchmarks/environment_speed.py

A bare step is `pymunk.Space.step` with one kinematic body, which every step of the
world contains once. The cases run interleaved in one process, in CPU time of this
thread; a ratio is the median over the rounds.
"""

import math
import sys
from collections.abc import Callable
from functools import partial
from typing import Any

import gymnasium
import numpy as np
from interleaved import bare_steps, microseconds, ratio, time_interleaved, verdict
from rich.console import Console
from rich.table import Table

from slamgym.agents import ActiveSlamEnv, ActiveSlamVectorEnv
from slamgym.envs import LandmarkWorldEnv
from slamgym.envs.vector import LandmarkWorldVectorEnv
from slamgym.sim_configs import list_presets

Call = Callable[[], object]
STEPS = 200  # steps per call, so that the loop around them costs nothing
BARE = "bare Space.step"
WORLDS = 16  # in a vector environment
HALF_VIEW = {"max_range": 8.0, "field_of_view": math.pi}
WALLS = [[x, -9.0, x + 1.0, -8.0] for x in range(-5, 5)]
CASES: dict[str, tuple[dict[str, Any], float | None]] = {
    # name: (changes to the preset six_landmarks, goal)
    "6 landmarks": ({}, 22.0),
    "6 landmarks, 8 m, 180°": ({"sensor": HALF_VIEW}, 22.0),
    "100 landmarks": ({"landmarks": 100}, 29.0),
    "100 landmarks, 8 m, 180°": ({"landmarks": 100, "sensor": HALF_VIEW}, 29.0),
    "6 landmarks, hidden identities": ({"sensor": {"identities": False}}, None),
    "6 landmarks, 10 walls": ({"walls": WALLS}, None),
    "6 landmarks, 10 walls that hide": (
        {"walls": WALLS, "sensor": {"occlusion": True}},
        None,
    ),
}


def world(changes: dict[str, Any]) -> Call:
    landmarks = changes.get("landmarks")
    if landmarks is not None:
        bounds = [-10.0, -10.0, 10.0, 10.0]
        layout = {"layout": "random", "bounds": bounds, "seed": 0, "count": landmarks}
        changes = {**changes, "landmarks": layout}
    env = LandmarkWorldEnv("six_landmarks", **changes)
    env.reset(seed=0)
    env.action_space.seed(0)
    actions = [env.action_space.sample() for _ in range(STEPS)]

    def call() -> None:
        for action in actions:
            env.step(action)

    return call


def cartpole() -> Call:
    """Gymnasium's own measure of a small environment, reset at every episode's end."""
    env = gymnasium.make("CartPole-v1").unwrapped
    env.reset(seed=0)

    def call() -> None:
        for step in range(STEPS):
            if env.step(step % 2)[2]:
                env.reset()

    return call


def main() -> int:
    cases = {BARE: bare_steps(STEPS), "CartPole-v1": cartpole()}
    cases |= {name: world(changes) for name, (changes, _) in CASES.items()}
    times = time_interleaved(cases, rounds=41)
    table = Table(title="one step of slamgym/LandmarkWorld-v0, unwrapped")
    for column in ("case", "µs", "× bare", "goal", ""):
        table.add_column(column, justify="left" if column == "case" else "right")
    missed = 0
    for name in cases:
        times_bare, goal = ratio(times, name, BARE), CASES.get(name, ({}, None))[1]
        word = "" if goal is None else verdict(times_bare, goal, at_least=False)
        missed += word == "MISSED"
        cost = f"{microseconds(times, name) / STEPS:.2f}"
        limit = "" if goal is None else f"<= {goal:.0f}"
        table.add_row(name, cost, f"{times_bare:.1f}", limit, word)
    Console(width=100).print(table, states_table())
    return missed


def states_table() -> Table:
    """Time `state` and `restore` of every preset, for one world and for several."""
    table = Table(title="µs per world; in brackets: in units of a bare Space.step")
    for column in ("preset", "state", "restore", f"of {WORLDS}: state", "restore"):
        table.add_column(column, justify="left" if column == "preset" else "right")
    for name in list_presets():
        row = []
        active = name.startswith("active_")
        single = (ActiveSlamEnv if active else LandmarkWorldEnv)(name)
        many = (ActiveSlamVectorEnv if active else LandmarkWorldVectorEnv)(WORLDS, name)
        for env, worlds in ((single, 1), (many, WORLDS)):
            env.reset(seed=0)
            env.action_space.seed(0)
            for _ in range(20):
                env.step(env.action_space.sample() * np.float32(0.3))
            state = env.state()
            cases: dict[str, Callable[[], object]] = {
                "state": env.state,
                "restore": partial(env.restore, state),
            }
            times = time_interleaved({BARE: bare_steps(100), **cases}, rounds=7)
            for case in cases:
                bare = 100 * ratio(times, case, BARE) / worlds
                row.append(f"{microseconds(times, case) / worlds:.1f} ({bare:.0f})")
        table.add_row(name, *row)
    return table


if __name__ == "__main__":
    sys.exit(main())
