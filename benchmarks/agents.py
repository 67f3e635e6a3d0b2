"""Time of a step of an agent's worlds, in units of a bare physics step.

    python benchmarks/agents.py

A bare step is `pymunk.Space.step` with one kinematic body. Times are per world and
step. The cases run interleaved in one process, in CPU time of this thread; a ratio is
the median over the rounds. Stable-Baselines3 and, as peers of a single world, ir-sim
and the Robotics Toolbox are timed where they are installed.

A second table lists the cost of observing beliefs, see `agents_beliefs`. The last line
is the rate of films, see `agents_frames`.
"""

import importlib.util
import sys
from collections.abc import Callable
from typing import Any, NamedTuple

import gymnasium
import numpy as np
from agents_beliefs import belief_table, imagine_line
from agents_frames import frames_line
from agents_peers import peer_calls
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.wrappers.vector import FlattenObservation
from interleaved import bare_steps, microseconds, ratio, time_interleaved, verdict
from rich.console import Console
from rich.table import Table

from slamgym.agents import ActiveSlamEnv
from slamgym.envs import LandmarkWorldEnv
from slamgym.envs.vector import FlattenBatch, to_stable_baselines

Call = Callable[[], object]
Worlds = VectorEnv[Any, Any, Any]
ID = "slamgym/LandmarkWorld-v0"
ACTIVE = "slamgym/ActiveSlam-v0"
BARE = "bare Space.step"
SINGLE = "single world"
BARE_STEPS = 200  # per call, so that the loop around them costs nothing
PEERS_SLOWER = 8.0
EPISODE = 1000  # steps, as learning has them
MANY = {"layout": "random", "bounds": [-10, -10, 10, 10], "seed": 0, "count": 100}


class Case(NamedTuple):
    """One alternative, and how it should compare with others."""

    call: Call
    """Takes `steps` steps of a single world each time."""
    steps: int
    at_most: float | None = None
    """Times the bare step."""
    faster_than: tuple[str, float] | None = None
    """Another case, and at least how many times faster than it."""
    slower_than: tuple[str, float] | None = None
    """Another case, and at least how many times slower than it."""


def steps_of(worlds: Any, **goals: Any) -> Case:
    """Step a vector environment repeatedly, with the same actions in all worlds."""
    worlds.reset(seed=0) if isinstance(worlds, VectorEnv) else worlds.reset()
    count = worlds.num_envs
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (count, 2))
    actions = actions.astype(np.float32)
    return Case(lambda: worlds.step(actions), count, **goals)


def active_cases() -> dict[str, Case]:
    """Active SLAM, resets included: many worlds, and a single one."""
    cases = {}
    for level, at_most in (("easy", 8.0), ("medium", 12.0), ("hard", 15.0)):
        for count in (64, 1024):
            name = f"ActiveSlam, {level}, {count}"
            worlds = gymnasium.make_vec(ACTIVE, count, scenario=f"active_{level}")
            cases[name] = steps_of(worlds, at_most=at_most)
        env = ActiveSlamEnv(f"active_{level}")
        cases[f"ActiveSlam, {level}, single"] = single_case(env, at_most=70.0)
    return cases


def native(count: int, mode: str = "NextStep", **changes: Any) -> Worlds:
    options = {"steps": EPISODE, "autoreset_mode": AutoresetMode(mode), **changes}
    return gymnasium.make_vec(ID, count, **options)


def sync(count: int) -> Worlds:
    return gymnasium.make_vec(ID, count, vectorization_mode="sync", steps=EPISODE)


def world_cases() -> dict[str, Case]:
    than_sync = ("SyncVectorEnv, 64 worlds", 20.0)
    return {
        than_sync[0]: steps_of(sync(64)),
        "vector world, 1": steps_of(native(1), at_most=41.0),
        "vector world, 64": steps_of(native(64), at_most=1.5, faster_than=than_sync),
        "vector world, 1024": steps_of(native(1024), at_most=0.8),
        "vector world, 1024, 100 landmarks": steps_of(
            native(1024, landmarks=MANY), at_most=8.0
        ),
    }


def reset_cases() -> dict[str, Case]:
    """Short episodes with their resets, and resets alone.

    A reset of a single world takes no physics step, so its goal is in steps of such a
    world: at most 2, and at most 2.5 where it draws a map.
    """
    cases = {}
    for count in (64, 1024):
        short = gymnasium.make_vec(ID, count)
        cases[f"six_landmarks with resets, {count}"] = steps_of(short, at_most=1.8)
        drawn = gymnasium.make_vec(ID, count, scenario="active_medium")
        drawn.reset(seed=0)
        name = f"reset, random layout, {count}"
        cases[name] = Case(drawn.reset, count, at_most=7.3)
    for scenario, most in (("six_landmarks", 2.0), ("active_medium", 2.5)):
        env = LandmarkWorldEnv(scenario)
        env.reset(seed=0)
        goal = SINGLE, 1.0 / most
        cases[f"reset, {scenario}, single"] = Case(env.reset, 1, faster_than=goal)
    return cases


def flat_cases() -> dict[str, Case]:
    gymnasiums = "flat by Gymnasium's wrapper, 64"
    ours = steps_of(FlattenBatch(native(64)), faster_than=(gymnasiums, 1.0))
    return {
        gymnasiums: steps_of(FlattenObservation(native(64))),
        "flat by FlattenBatch, 64": ours,
    }


def stable_baselines_cases() -> dict[str, Case]:
    if importlib.util.find_spec("stable_baselines3") is None:
        return {}
    vec_env = importlib.import_module("stable_baselines3.common.vec_env")
    dummy = vec_env.DummyVecEnv([lambda: gymnasium.make(ID, steps=EPISODE)] * 64)
    adapted = to_stable_baselines(native(64, mode="SameStep"))
    name = "Stable-Baselines3's DummyVecEnv, 64"
    return {
        name: steps_of(dummy),
        "to_stable_baselines, 64": steps_of(adapted, faster_than=(name, 15.0)),
    }


def single_case(env: LandmarkWorldEnv, **goals: Any) -> Case:
    """Step one world, unwrapped, as the peers are."""
    env.reset(seed=0)
    env.action_space.seed(0)
    actions = [env.action_space.sample() for _ in range(BARE_STEPS)]

    def call() -> None:
        for action in actions:
            _, _, terminated, truncated, _ = env.step(action)
            if terminated or truncated:
                env.reset()

    return Case(call, BARE_STEPS, **goals)


def main() -> int:
    peers = peer_calls()
    bare = Case(bare_steps(BARE_STEPS), BARE_STEPS)
    world = LandmarkWorldEnv("six_landmarks", steps=EPISODE)
    cases = {BARE: bare, SINGLE: single_case(world)}
    cases |= {
        name: Case(call, 1, slower_than=(SINGLE, PEERS_SLOWER))
        for name, call in peers.items()
        if call is not None
    }
    cases |= (
        world_cases()
        | reset_cases()
        | active_cases()
        | flat_cases()
        | stable_baselines_cases()
    )
    calls = {name: case.call for name, case in cases.items()}
    per_call = time_interleaved(calls, rounds=21)
    times = {
        name: [seconds / cases[name].steps for seconds in per_call[name]]
        for name in cases
    }
    table = Table(title="one step of one world")
    for column in ("case", "µs", "× bare", "goal", "", "than other", "goal", ""):
        table.add_column(column, justify="left" if column == "case" else "right")
    missed = 0
    for name, case in cases.items():
        row = [name, f"{microseconds(times, name):.2f}"]
        row += [*_against_bare(times, name, case), *_against_other(times, name, case)]
        missed += row.count("MISSED")
        table.add_row(*row)
    for name in (name for name, call in peers.items() if call is None):
        table.add_row(name, "not installed")
    beliefs, of_beliefs = belief_table()
    console = Console(width=120)
    console.print(table)
    console.print(beliefs)
    line, of_plans = imagine_line()
    console.print(line)
    line, of_frames = frames_line()
    console.print(line)
    return missed + of_beliefs + of_plans + of_frames


def _against_bare(times: dict[str, list[float]], name: str, case: Case) -> list[str]:
    value = ratio(times, name, BARE)
    if case.at_most is None:
        return [f"{value:.2f}", "", ""]
    word = verdict(value, case.at_most, at_least=False)
    return [f"{value:.2f}", f"<= {case.at_most}", word]


def _against_other(times: dict[str, list[float]], name: str, case: Case) -> list[str]:
    if case.faster_than is not None:
        other, goal = case.faster_than
        value, word = ratio(times, other, name), "faster"
    elif case.slower_than is not None:
        other, goal = case.slower_than
        value, word = ratio(times, name, other), "slower"
    else:
        return ["", "", ""]
    verdict_on = verdict(value, goal, at_least=True)
    return [f"{value:.1f} × {word}", f">= {goal:g}", verdict_on]


if __name__ == "__main__":
    sys.exit(main())
