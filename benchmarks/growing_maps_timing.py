"""Time filters on one drive: all filters take turns of several steps."""

import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

STRETCH = 20  # steps of one filter before the next one's turn


class Reading(NamedTuple):
    """The input of one step."""

    odometry: tuple[float, float]
    readings: Array
    ids: list[int]


class Costs(NamedTuple):
    """Seconds of every step of a filter, and the memory of its belief."""

    steps: list[float]
    nbytes: int = 0


Step = Callable[[Reading], object]


def step_of(slam: Any) -> Step:
    """One step of anything with predict and update."""

    def step(now: Reading) -> None:
        slam.predict(now.odometry)
        slam.update(now.readings, now.ids)

    return step


def measure(
    cases: dict[str, tuple[Step, int]],
    data: Sequence[Reading],
    *,
    backwards: bool = False,
) -> dict[str, Costs]:
    """Time stretches of steps of all cases in turn, each up to its number of steps.

    The first step of a stretch finds the processor's caches full of the case before,
    which is another one ``backwards``.
    """
    costs: dict[str, list[float]] = {name: [] for name in cases}
    order = [*cases.items()][:: -1 if backwards else 1]
    for first in range(0, len(data), STRETCH):
        for name, (step, most) in order:
            for now in data[first : first + STRETCH]:
                if len(costs[name]) < most:
                    began = time.thread_time()
                    step(now)
                    costs[name].append(time.thread_time() - began)
    # the first stretch warms up caches and compiles
    return {name: Costs(steps[STRETCH:]) for name, steps in costs.items()}


def least(drives: Sequence[dict[str, Costs]]) -> dict[str, Costs]:
    """Return the least time of each step over repetitions of one drive."""
    return {
        name: Costs(
            np.min([each[name].steps for each in drives], axis=0).tolist(), costs.nbytes
        )
        for name, costs in drives[0].items()
    }
