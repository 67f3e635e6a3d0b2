"""The cost of the belief wrapper of many worlds, relative to its filters' kernels.

For B worlds, in the same round and on the same scans::

    added / kernels = (wrapped step - plain step - kernels) / kernels

    wrapped step    `BeliefObservationVector.step` with ``ekf``
    plain step      `step` of the same worlds, seeds and actions without the wrapper
    kernels         time of `drive_runs` within the wrapped steps: one predict and one
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
from slamgym.estimator.filters.batch import BatchBeliefs, BatchSlam
from slamgym.estimator.filters.imagine import SensorLimits
from slamgym.estimator.kernels.batch import drive_runs

ID = "slamgym/LandmarkWorld-v0"
GOAL = 3.0
IMAGINE_GOAL = 1.15  # times the kernel of a batch
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
    watch = Stopwatch(drive_runs)
    with mock.patch.object(batch, "drive_runs", watch):
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
    """Compare plans from a map of 12 landmarks with a batch that takes their scans.

    The scans are those that `imagine` expects, so both have the same beliefs.  In a
    round, all of `imagine` and the kernel of the batch are timed.
    """
    env = ActiveSlamEnv("active_medium", landmarks=TWELVE, crash_cost=0.0)
    env.reset(seed=0)
    for _ in range(7):  # once around, until all are mapped
        env.step([0.0, 1.0])
    plans = np.random.default_rng(0).uniform([0.0, -1.0], [1.0, 1.0], (256, 10, 2))
    slam: Any = env.knowledge.estimator
    sensor, belief = env.scenario.sensor, slam.belief()
    poses = imagine(slam, plans, sensor).poses[0]
    places = BatchBeliefs.of([belief] * len(plans), len(belief.landmark_ids))
    scans = _expected_scans(poses, places.landmarks[:, None], sensor)
    runs, watch = (
        BatchSlam(slam, *places.mapped.shape, threads=1),
        Stopwatch(drive_runs),
    )
    times, ratios = [], []
    for _ in range(ROUNDS):
        began = time.thread_time()
        imagined = imagine(slam, plans, sensor)
        times.append(time.thread_time() - began)
        runs.load(places)
        watch.seconds = 0.0
        with mock.patch.object(batch, "drive_runs", watch):
            trace = runs.run(plans, *scans)
        ratios.append(times[-1] / watch.seconds)
        np.testing.assert_allclose(
            trace.pose_covariances, imagined.pose_covariances[0], rtol=1e-9
        )
    value = median(ratios)
    word = verdict(value, IMAGINE_GOAL, at_least=False)
    what = f"imagine, 256 plans x 10 steps, {places.mapped.shape[1]} landmarks: "
    what += f"{1e3 * median(times):.1f} ms, {value:.2f} x the kernel of a batch"
    return f"{what}, goal <= {IMAGINE_GOAL:g}: {word}", int(word == "MISSED")


def _expected_scans(
    poses: Any, landmarks: Any, sensor: SensorLimits
) -> tuple[Any, Any]:
    """Return exact readings of landmarks from poses (B, T, 3), and which are seen."""
    x, y, heading = np.moveaxis(poses[:, :, None], -1, 0)
    dx, dy = landmarks[..., 0] - x, landmarks[..., 1] - y
    ranges, bearings = np.hypot(dx, dy), np.arctan2(dy, dx) - heading
    in_view = (sensor.min_range < ranges) & (ranges <= sensor.max_range)
    in_view &= np.cos(bearings) >= np.cos(sensor.field_of_view / 2)
    return np.stack([bearings, ranges], axis=-1), in_view


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
