"""The cost of the belief wrapper of many worlds, relative to its filters' kernels.

For B worlds, in the same round and on the same scans::

    added / kernels = (wrapped step - plain step - kernels) / kernels

    wrapped step    `BeliefObservationVector.step` with ``ekf``
    plain step      `step` of the same worlds, seeds and actions without the wrapper
    kernels         time of `step_runs` within the wrapped steps: one predict and one
                    update with six readings in each world

"Added" is therefore all Python and numpy code between the scans and the observed
features.
"""

import time
from collections.abc import Callable
from statistics import median
from typing import Any, NamedTuple
from unittest import mock

import gymnasium
import numpy as np
from interleaved import verdict
from rich.table import Table

from slamgym.agents import ActiveSlamEnv, BeliefObservationVector
from slamgym.estimator import imagine
from slamgym.estimator.filters import batch
from slamgym.estimator.kernels.batch import step_runs

ID = "slamgym/LandmarkWorld-v0"
GOAL = 3.0
IMAGINE_GOAL = 4.0  # [ms]
TWELVE = {"layout": "ring", "count": 12, "radius": 4.0}
ROUNDS = 21
STEPS = {20: 30, 64: 30, 1024: 4}  # worlds: steps of each in a round
EPISODE = 10_000  # steps: none ends meanwhile


class Round(NamedTuple):
    """CPU seconds of one step of all worlds."""

    plain: float
    wrapped: float
    kernels: float

    @property
    def added(self) -> float:
        """Time that is spent neither in the worlds nor in the kernels."""
        return self.wrapped - self.plain - self.kernels


class Stopwatch:
    """Calls a function, and adds up its CPU time."""

    def __init__(self, function: Callable[..., object]) -> None:
        self._function = function
        self.seconds = 0.0

    def __call__(self, *arguments: object) -> None:
        """Call the function and measure its time."""
        began = time.thread_time()
        self._function(*arguments)
        self.seconds += time.thread_time() - began


def belief_rounds(count: int, steps: int, rounds: int = ROUNDS) -> list[Round]:
    """Step worlds with and without beliefs in turns."""
    plain, bare = (gymnasium.make_vec(ID, count, steps=EPISODE) for _ in range(2))
    wrapped = BeliefObservationVector(bare, estimator="ekf")
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (count, 2))
    watch = Stopwatch(step_runs)
    with mock.patch.object(batch, "step_runs", watch):
        for worlds in (plain, wrapped):
            worlds.reset(seed=0)
            _time(worlds, actions, steps)  # warm, and every landmark mapped
        return [_round(plain, wrapped, watch, actions, steps) for _ in range(rounds)]


def belief_table() -> tuple[Table, int]:
    """Measure every number of worlds; return the table and the number of misses."""
    table = Table(title="one step of all worlds with an ekf each, 6 landmarks [µs]")
    columns = ("worlds", "plain step", "kernels", "added by the wrapper")
    for column in (*columns, "added / kernels", "goal", ""):
        table.add_column(column, justify="right")
    missed = 0
    for count, steps in STEPS.items():
        rounds = belief_rounds(count, steps)
        value = median(each.added / each.kernels for each in rounds)
        word = verdict(value, GOAL, at_least=False)
        missed += word == "MISSED"
        times = [
            f"{1e6 * median(getattr(each, name) for each in rounds):.0f}"
            for name in ("plain", "kernels", "added")
        ]
        table.add_row(str(count), *times, f"{value:.2f}", f"<= {GOAL:g}", word)
    return table, missed


def imagine_line() -> tuple[str, int]:
    """Time 256 plans of 10 steps from a map of 12 landmarks; goal at most 4 ms."""
    env = ActiveSlamEnv("active_medium", landmarks=TWELVE, crash_cost=0.0)
    env.reset(seed=0)
    for _ in range(7):  # once around, until all are mapped
        env.step([0.0, 1.0])
    plans = np.random.default_rng(0).uniform([0.0, -1.0], [1.0, 1.0], (256, 10, 2))
    slam: Any = env.knowledge.estimator
    sensor, best = env.scenario.sensor, np.inf
    for _ in range(50):
        began = time.thread_time()
        imagine(slam, plans, sensor)
        best = min(best, 1e3 * (time.thread_time() - began))
    word = verdict(best, IMAGINE_GOAL, at_least=False)
    mapped = len(slam.belief().landmark_ids)
    what = f"imagine, 256 plans x 10 steps, {mapped} landmarks: {best:.2f} ms"
    return f"{what}, goal <= {IMAGINE_GOAL:g}: {word}", int(word == "MISSED")


def _round(
    plain: Any, wrapped: Any, watch: Stopwatch, actions: Any, steps: int
) -> Round:
    alone = _time(plain, actions, steps)
    watch.seconds = 0.0
    together = _time(wrapped, actions, steps)
    return Round(alone, together, watch.seconds / steps)


def _time(worlds: Any, actions: Any, steps: int) -> float:
    began = time.thread_time()
    for _ in range(steps):
        worlds.step(actions)
    return (time.thread_time() - began) / steps
