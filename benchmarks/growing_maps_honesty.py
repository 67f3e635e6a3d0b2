"""Are the filters for growing maps as consistent as the full ones?  NEES of each.

    python benchmarks/growing_maps_honesty.py --markdown
    python benchmarks/growing_maps_honesty.py --runs 10 --world city

Two worlds: the preset `loop`, four laps past 20 landmarks, and a corner of the preset
`city` with 4 x 3 blocks and 192 landmarks, where the robot drives around every block.
All filters get the same readings.  Columns: NEES of the pose per dimension in the
invariant frame, averaged over runs and steps, with its 90 % interval, then at the end;
NEES of the whole state and of the map seen from the robot at the end; NIS per degree of
freedom; whether the decisions accept the filter, and the verdict; the largest
difference of a pose NEES, over all runs and steps, from that of the corresponding full
filter; CPU time of a run.  The Monte Carlo requests the whole belief of every filter
after every step, so `submaps` joins its map in every step.
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import time
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import xarray as xr
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from slamgym.experiments.monte_carlo_study import (
    consistency_of,
    monte_carlo,
    summarise_monte_carlo,
)
from slamgym.sim_configs import Scenario, load_scenario

BLOCKS = {"columns": 4, "rows": 3}
ROUND_EVERY_BLOCK = 736  # steps
RUNS = {"loop": 200, "city": 50}
CONSTRAINED = (
    "sparse_information[base=observability_constrained,active_bound=8,dense_limit=0]"
)
FULL = {  # of each filter the one that it is to be, None where it is another
    "loop": {
        "ekf": None,
        "invariant": None,
        "compressed[local_size=8]": "ekf",
        "compressed[base=invariant,local_size=8]": "invariant",
        "submaps[submap_size=8]": None,
        "sparse_information[active_bound=8,dense_limit=0]": None,
        CONSTRAINED: None,
    },
    "city": {
        "ekf": None,
        "invariant": None,
        "compressed[local_size=40]": "ekf",
        "compressed[base=invariant,local_size=40]": "invariant",
        "submaps": None,
        "sparse_information": None,
        "sparse_information[base=observability_constrained]": None,
    },
}
COLUMNS = (
    "filter",
    "pose NEES / 3",
    "90 % interval",
    "at the end",
    "state",
    "relative map",
    "NIS",
    "accepted",
    "verdict",
    "off its base",
    "CPU s a run",
)


class Runs(NamedTuple):
    """One filter's runs."""

    label: str
    results: xr.Dataset
    seconds: float  # CPU time of a run


def world_of(name: str) -> Scenario:
    """Return the loop, or a corner of the city."""
    if name == "loop":
        return load_scenario("loop")
    return load_scenario("city").with_changes(
        steps=ROUND_EVERY_BLOCK, landmarks=BLOCKS, controls=BLOCKS
    )


def run_all(name: str, runs: int, seed: int) -> Iterator[Runs]:
    """Run every filter alone, so that its numbers do not depend on the others."""
    for label in FULL[name]:
        monte_carlo("six_landmarks", label, 1)  # compiles
        began = time.process_time()
        results = monte_carlo(world_of(name), label, runs, seed)
        yield Runs(label, results, (time.process_time() - began) / runs)


def row_of(done: Runs, full: xr.Dataset | None) -> tuple[str, ...]:
    """Write the results of a filter."""
    entry = summarise_monte_carlo(done.results)["estimators"][done.label]
    low, high = consistency_of(done.results, done.label).equivalence.interval
    at_end = entry["nees_end"]
    return (
        done.label,
        f"{entry['pose_nees']['invariant']['mean']:.3f}",
        f"{low:.2f} … {high:.2f}",
        f"{entry['pose_nees']['invariant']['end']:.3f}",
        f"{at_end['state']:.3f}",
        f"{at_end['relative_map']:.3f}",
        f"{entry['nis']:.3f}",
        "yes" if entry["accepted"] else "no",
        entry["verdict"],
        "" if full is None else f"{_largest_difference(done.results, full):.0e}",
        f"{done.seconds:.2f}",
    )


def _largest_difference(one: xr.Dataset, other: xr.Dataset) -> float:
    """Compare NEES of all runs and steps after the first scan, before any motion."""
    nees = [
        results.pose_nees_invariant.isel(step=slice(1, None)).values
        for results in (one, other)
    ]
    return float(np.abs(nees[0] - nees[1]).max())


def rows_of(name: str, runs: int, seed: int) -> Iterator[tuple[str, ...]]:
    """Run the filters on one world, and write a row of each."""
    results: dict[str | None, xr.Dataset] = {}
    for done in run_all(name, runs, seed):
        results[done.label] = done.results
        yield row_of(done, results.get(FULL[name][done.label]))


def print_table(title: str, rows: Iterator[tuple[str, ...]]) -> None:
    """Print one world's rows on a terminal."""
    table = Table(*COLUMNS, title=title)
    for row in rows:
        table.add_row(*(escape(cell) for cell in row))
    Console(width=160).print(table)


def print_markdown(title: str, rows: Iterator[tuple[str, ...]]) -> None:
    """Print one world's rows for a document, as they come."""
    print(f"**{title}**\n\n| {' | '.join(COLUMNS)} |")
    print("|---|" + "---:|" * (len(COLUMNS) - 1))
    for row in rows:
        print(f"| {' | '.join(row)} |", flush=True)
    print()


def main() -> None:
    """Print the tables that the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, help="default: 200 of loop, 50 of city")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--world", choices=tuple(FULL), action="append")
    parser.add_argument("--markdown", action="store_true", help="for a document")
    arguments = parser.parse_args()
    show = print_markdown if arguments.markdown else print_table
    for name in arguments.world or FULL:
        world, runs = world_of(name), arguments.runs or RUNS[name]
        title = (
            f"{name}, {world.landmarks.count} landmarks, {runs} runs of "
            f"{world.steps} steps"
        )
        show(title, rows_of(name, runs, arguments.seed))


if __name__ == "__main__":
    main()
