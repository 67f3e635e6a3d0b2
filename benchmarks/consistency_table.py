"""Every filter on every scenario, on the same data: NEES, heading deviation, NIS.

    python benchmarks/consistency_table.py --runs 200
    python benchmarks/consistency_table.py --runs 20 --slow   # unscented and so on

Columns: pose NEES per dimension in the invariant and in the additive frame, averaged
over runs and steps; share of the steps in which the invariant average over the runs
lies in its 95 % band; median over the runs of their time average, and share of runs
above 3; NEES of the heading; its deviation at the end in degrees; NIS per degree of
freedom; share of runs that diverged to numbers that are not finite, which the other
columns omit.
"""

import argparse
import sys
import time
from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np
import xarray as xr
from rich.console import Console
from rich.table import Table

from slamgym.evaluation.hypothesis_tests import average_band
from slamgym.experiments.monte_carlo_study import monte_carlo

SCENARIOS = (
    "loop",
    "coarse_loop",
    "six_landmarks",
    "anchored",
    "unknown_heading",
    "loop_unknown_heading",
    "slippery",
    "standing",
)
FILTERS = (
    "ekf",
    "ekf[landmark_init=independent]",
    "iterated",
    "first_estimates",
    "observability_constrained",
    "invariant",
    "invariant[iterations=1]",
)
SLOW = ("unscented", "robocentric")


class Row(NamedTuple):
    """The results of one filter on one scenario."""

    invariant: float
    additive: float
    inside: float
    median: float
    above_3: float
    heading: float
    heading_std: float
    nis: float
    diverged: float


def measure(results: xr.Dataset) -> Row:
    """Summarise the runs of one filter, without the first scan, before any motion."""
    later = results.isel(step=slice(1, None))
    finite = (later.position_error < 1e6).all("step") & ~later.failed
    sound = later.isel(run=np.flatnonzero(finite))
    invariant = sound.pose_nees_invariant.values / 3
    low, high = np.array(average_band(len(invariant), 3)) / 3
    average, per_run = invariant.mean(axis=0), invariant.mean(axis=1)
    return Row(
        float(average.mean()),
        float(sound.pose_nees_additive.mean()) / 3,
        float(((average > low) & (average < high)).mean()),
        float(np.median(per_run)),
        float((per_run > 3).mean()),
        float(sound.heading_nees.mean()),
        float(np.rad2deg(sound.heading_std.isel(step=-1).mean())),
        float(sound.nis.sum() / max(int(sound.nis_dof.sum()), 1)),
        float(1 - finite.mean()),
    )


def rows_of(
    name: str, runs: int, seed: int, filters: Iterable[str]
) -> Iterator[tuple[str, Row]]:
    """Run all filters on one scenario."""
    results = monte_carlo(name, filters, runs, seed)
    for label in results.estimator.values.tolist():
        yield label, measure(results.sel(estimator=label))


def print_table(title: str, rows: Iterable[tuple[str, Row]]) -> None:
    """Print one scenario's rows on a terminal."""
    table = Table(title=title)
    table.add_column("filter")
    for column in Row._fields:
        table.add_column(column.replace("_", " "), justify="right")
    for label, row in rows:
        table.add_row(label, *(format_number(value) for value in row))
    Console(width=132).print(table)


def print_markdown(title: str, rows: Iterable[tuple[str, Row]]) -> None:
    """Print one scenario's rows for a document."""
    names = [name.replace("_", " ") for name in Row._fields]
    print(f"**{title}**\n\n| filter | {' | '.join(names)} |")
    print("|---|" + "---:|" * len(names))
    for label, row in rows:
        print(f"| {label} | {' | '.join(format_number(value) for value in row)} |")
    print()


def format_number(value: float) -> str:
    """Three digits, and no more noise than that."""
    return f"{value:.3g}" if abs(value) < 1000 else f"{value:.0f}"


def main() -> None:
    """Print the tables that the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--scenario", choices=SCENARIOS, action="append")
    parser.add_argument("--slow", action="store_true", help="the slow filters too")
    parser.add_argument("--markdown", action="store_true", help="for a document")
    arguments = parser.parse_args()
    filters = FILTERS + (SLOW if arguments.slow else ())
    began = time.perf_counter()
    show = print_markdown if arguments.markdown else print_table
    for name in arguments.scenario or SCENARIOS:
        title = f"{name}, {arguments.runs} runs, seed {arguments.seed}"
        show(title, rows_of(name, arguments.runs, arguments.seed, filters))
    print(f"{time.perf_counter() - began:.0f} s", file=sys.stderr)


if __name__ == "__main__":
    main()
