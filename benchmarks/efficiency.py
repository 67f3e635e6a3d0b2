"""Efficiency of the filters: the Cramér-Rao bound divided by the mean squared error.

    python benchmarks/efficiency.py --runs 200

For each world and filter: the efficiency of the position and of the heading over all
steps, and of the map about its centre at the end, each with its 95 % interval, in the
invariant error frame. A filter that reaches the bound has 1.
"""

from __future__ import annotations

import argparse

from slamgym.experiments.monte_carlo import monte_carlo, summarise_monte_carlo

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
    "invariant[iterations=3]",
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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=200)
    parser.add_argument("--seed", type=int, default=500_000)
    parser.add_argument("--worlds", nargs="+", default=WORLDS)
    arguments = parser.parse_args()
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
