"""Time of a step of the landmark world, in units of a bare physics step.

    python benchmarks/environment_speed.py

A bare step is `pymunk.Space.step` with one kinematic body, which every step of the
world contains once. The cases run interleaved in one process, in CPU time of this
thread; a ratio is the median over the rounds.
"""

import math
import sys
from collections.abc import Callable
from typing import Any

import gymnasium
from interleaved import bare_steps, microseconds, ratio, time_interleaved, verdict
from rich.console import Console
from rich.table import Table

from slamgym.envs import LandmarkWorldEnv

Call = Callable[[], object]
STEPS = 200  # steps per call, so that the loop around them costs nothing
BARE = "bare Space.step"
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
    Console(width=100).print(table)
    return missed


if __name__ == "__main__":
    sys.exit(main())
