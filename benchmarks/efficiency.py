"""Efficiency of the filters: the Cramér-Rao bound divided by the mean squared error.

    python benchmarks/efficiency.py --runs 200

For each world and filter: the efficiency of the position and of the heading over all
steps, and of the map about its centre at the end, each with its 95 % interval, in the
invariant error frame. A filter that reaches the bound has 1.

    python benchmarks/efficiency.py --runs 200 --times

prints the time of the bound divided by that of the filter `ekf`, on one core.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

from slamgym.experiments.monte_carlo_study import monte_carlo, summarise_monte_carlo
from slamgym.experiments.monte_carlo_study.filtered_runs import bound_runs, filter_runs
from slamgym.experiments.run_and_replay.filter_settings import settings_for_scenario
from slamgym.experiments.run_and_replay.simulated_runs import simulate_runs
from slamgym.sim_configs import load_scenario

WORLDS = (
    "six_landmarks",
    "anchored",
    "unknown_heading",
    "corridor",
    "loop",
    "coarse_loop",
)
FILTERS = (
    "ekf",
    "invariant",
    "invariant[iterations=1]",
    "first_estimates",
    "observability_constrained",
)


def cell(found: dict[str, float | list[float]] | None) -> str:
    """Write a value and half its interval."""
    if found is None:
        return "–"
    value, interval = found["value"], found["interval"]
    assert isinstance(value, float)
    assert isinstance(interval, list)
    return f"{value:.2f} ± {interval[1] - value:.2f}"


def least_time(call: Callable[[], object], repeats: int = 4) -> float:
    """Return the least CPU time of several calls, after one that compiles [s]."""
    call()
    times = []
    for _ in range(repeats):
        began = time.process_time()
        call()
        times.append(time.process_time() - began)
    return min(times)


def time_of_bound(world: str, runs: int, seed: int) -> str:
    """Write how long the bound takes, and how long the filter."""
    scenario = load_scenario(world)
    made = simulate_runs(scenario, runs, seed)
    settings = settings_for_scenario(scenario, estimator="ekf")
    bound = least_time(lambda: bound_runs(scenario, made))
    ekf = least_time(lambda: filter_runs(settings, made, threads=1))
    return f"{world}: bound {bound:.3f} s, ekf {ekf:.3f} s, {bound / ekf:.2f} times"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=200)
    parser.add_argument("--seed", type=int, default=500_000)
    parser.add_argument("--worlds", nargs="+", default=WORLDS)
    parser.add_argument("--times", action="store_true", help="of the bound")
    arguments = parser.parse_args()
    if arguments.times:
        for world in arguments.worlds:
            print(time_of_bound(world, arguments.runs, arguments.seed))
        return
    print("| world | filter | verdict | position | heading | map |")
    print("|---|---|---|---|---|---|")
    for world in arguments.worlds:
        results = monte_carlo(world, FILTERS, arguments.runs, arguments.seed)
        summary = summarise_monte_carlo(results)
        for name, entry in summary["estimators"].items():
            cells = [
                cell(entry["efficiency"][key]) for key in ("pose", "heading", "map")
            ]
            row = (world, f"`{name}`", entry["verdict"], *cells)
            print(f"| {' | '.join(row)} |")


if __name__ == "__main__":
    main()
