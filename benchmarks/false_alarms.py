"""How often decisions reject a filter that is exactly consistent; nominal 5 %.

    python benchmarks/false_alarms.py

Two linear Kalman filters, 50 runs. One forgets its errors within a few steps. The other
estimates three constants and never forgets. All figures are shares of 2000 repetitions,
with a statistical error of half a percentage point.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from slamgym.evaluation.hypothesis_tests import (
    average_band,
    bootstrap_test,
    family_test,
    final_step_test,
    nis_test,
    time_average_test,
    whiteness_test,
)

Array = NDArray[np.float64]
Accepts = Callable[[Array, Array], bool]
REPETITIONS, RUNS, STEPS, DOF = 2000, 50, 60, 3
GRID = np.arange(STEPS // 10, STEPS + 1, STEPS // 10) - 1
ONES = np.ones((RUNS, STEPS), dtype=np.int64)
BAND = average_band(RUNS, DOF)


def scores(rng: np.random.Generator, noise: float) -> tuple[Array, Array]:
    """NEES and NIS of three random walks, read in turn: (REPETITIONS, RUNS, STEPS)."""
    runs = REPETITIONS * RUNS
    variance = np.ones(3)
    error = rng.standard_normal((runs, 3))
    nees, nis = np.empty((runs, STEPS)), np.empty((runs, STEPS))
    for step in range(STEPS):
        read = step % 3
        error += np.sqrt(noise) * rng.standard_normal((runs, 3))
        variance += noise
        total = variance[read] + 1.0
        innovation = error[:, read] + rng.standard_normal(runs)
        nis[:, step] = innovation**2 / total
        error[:, read] -= variance[read] / total * innovation
        variance[read] /= total
        nees[:, step] = (error**2 / variance).sum(axis=1)
    shape = (REPETITIONS, RUNS, STEPS)
    return nees.reshape(shape), nis.reshape(shape)


def inside(nees: Array) -> float:
    averages = nees.mean(axis=0)
    return float(np.mean((averages >= BAND.low) & (averages <= BAND.high)))


def bootstrap(nees: Array, _: Array) -> bool:
    averages, rng = nees.mean(axis=1), np.random.default_rng(0)
    return bootstrap_test(averages, DOF, rng=rng, resamples=399).accepted


DECISIONS: dict[str, Accepts] = {
    "final step, χ²": lambda x, _: final_step_test(x[:, -1], DOF).accepted,
    "time averages, t": lambda x, _: time_average_test(x.mean(axis=1), DOF).accepted,
    "time averages, bootstrap": bootstrap,
    "grid of 10 steps, Holm": lambda x, _: family_test(x[:, GRID], DOF).accepted,
    "NIS pooled, χ²": lambda _, y: nis_test(y, ONES).accepted,
    "NIS whiteness, Ljung-Box": lambda _, y: whiteness_test(y, ONES).accepted,
    "not offered: NEES pooled over time": lambda x, _: (
        final_step_test(x.ravel(), DOF).accepted
    ),
    "not offered: 95 % of steps inside the band": lambda x, _: inside(x) >= 0.95,
    "not offered: all steps inside the band": lambda x, _: inside(x) == 1.0,
}


def main() -> None:
    rng = np.random.default_rng(1)
    worlds = {"forgets": scores(rng, 1.0), "never forgets": scores(rng, 0.0)}
    print("| decision | " + " | ".join(worlds) + " |")
    print("|---|" + "---|" * len(worlds))
    for name, accepts in DECISIONS.items():
        rates = [
            1 - np.mean([accepts(x, y) for x, y in zip(nees, nis, strict=True)])
            for nees, nis in worlds.values()
        ]
        print(f"| {name} | " + " | ".join(f"{rate:.1%}" for rate in rates) + " |")


if __name__ == "__main__":
    main()
