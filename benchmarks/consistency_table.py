"""Every filter on every scenario, on the same data: NEES, heading deviation, NIS.

    python benchmarks/consistency_table.py --runs 200
    python benchmarks/consistency_table.py --runs 20 --slow   # unscented and so on

Columns: pose NEES per dimension in the invariant and in the additive frame, averaged
over runs and steps; share of the steps at which the invariant average over the runs
lies in its 95 % band; median over the runs of their time average, and share of runs
above 3; NEES of the heading; its deviation at the end in degrees; NIS per degree of
freedom; share of runs that diverged beyond all numbers, which the others leave out.
"""

import argparse
import sys
import time
from collections.abc import Iterable, Iterator
from typing import Any, NamedTuple

import numpy as np
from rich.console import Console
from rich.table import Table

from slamgym.estimator import BatchTrace, make_batch, make_estimator
from slamgym.estimator.consistency import average_band, heading_nees, pose_nees
from slamgym.experiments.simulated_runs import SimulatedRuns, simulate_runs
from slamgym.sim_configs import Scenario, load_scenario

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
Filters = dict[str, tuple[str, dict[str, Any]]]
FILTERS: Filters = {
    "ekf": ("ekf", {}),
    "ekf, independent": ("ekf", {"landmark_init": "independent"}),
    "iterated": ("iterated", {}),
    "first_estimates": ("first_estimates", {}),
    "observability_constrained": ("observability_constrained", {}),
    "invariant": ("invariant", {}),
    "invariant, iterated": ("invariant", {"iterations": 3}),
    "invariant, sequential": ("invariant", {"sequential": True}),
}
SLOW: Filters = {
    "unscented": ("unscented", {}),
    "robocentric": ("robocentric", {}),
}


class Row(NamedTuple):
    """What is said of one filter on one scenario."""

    invariant: float
    additive: float
    inside: float
    median: float
    above_3: float
    heading: float
    heading_std: float
    nis: float
    diverged: float


def settings_of(scenario: Scenario) -> dict[str, Any]:
    """Noise that a filter of this scenario is told: the true one."""
    return {
        "motion_std": scenario.motion.std,
        "measurement_std": scenario.sensor.std,
        "range_std_per_metre": scenario.sensor.range_std_per_metre,
        "noise_at_rest": scenario.motion.noise_at_rest,
        "initial_pose_std": scenario.start.std,
    }


def run_batch(
    name: str, scenario: Scenario, data: SimulatedRuns, options: dict[str, Any]
) -> BatchTrace:
    """All runs through a filter that can batch."""
    runs, _, landmarks = data.visible.shape
    batch = make_batch(
        name,
        runs=runs,
        landmarks=landmarks,
        initial_poses=data.initial_poses,
        **settings_of(scenario),
        **options,
    )
    return batch.run(data.odometry, data.measurements, data.visible, data.dt)


def run_singly(
    name: str, scenario: Scenario, data: SimulatedRuns, options: dict[str, Any]
) -> BatchTrace:
    """All runs through a filter one by one."""
    runs, steps, _ = data.visible.shape
    trace = BatchTrace(
        np.full((runs, steps, 3), np.nan),
        np.full((runs, steps, 3, 3), np.nan),
        np.zeros((runs, steps)),
        np.zeros((runs, steps), dtype=np.int64),
    )
    for run in range(runs):
        slam = make_estimator(
            name,
            initial_pose=data.initial_poses[run],
            **settings_of(scenario),
            **options,
        )
        for step in range(steps):
            seen = np.flatnonzero(data.visible[run, step])
            slam.predict(data.odometry[run, step], data.dt[step])
            report = slam.update(data.measurements[run, step, seen], seen.tolist())
            belief = slam.belief()
            trace.poses[run, step] = belief.pose
            trace.pose_covariances[run, step] = belief.pose_covariance
            trace.nis[run, step] = report.nis
            trace.degrees_of_freedom[run, step] = report.degrees_of_freedom
    return trace


def measure(data: SimulatedRuns, trace: BatchTrace) -> Row:
    """Sum a trace up, leaving out the first scan: before any motion."""
    steps = np.s_[:, 1:]
    poses, covariances = trace.poses[steps], trace.pose_covariances[steps]
    finite = (abs(poses) < 1e6).all(axis=(1, 2)) & np.isfinite(trace.nis).all(axis=1)
    after = data.true_poses[steps][finite], poses[finite], covariances[finite]
    invariant = pose_nees(*after, frame="invariant") / 3
    additive = pose_nees(*after, frame="additive") / 3
    low, high = np.array(average_band(len(invariant), 3)) / 3
    average = invariant.mean(axis=0)
    per_run = invariant.mean(axis=1)
    freedom = trace.degrees_of_freedom[finite].sum()
    return Row(
        float(average.mean()),
        float(additive.mean()),
        float(((average > low) & (average < high)).mean()),
        float(np.median(per_run)),
        float((per_run > 3).mean()),
        float(heading_nees(*after).mean()),
        float(np.rad2deg(np.sqrt(after[2][:, -1, 2, 2]).mean())),
        float(trace.nis[finite].sum() / max(freedom, 1)),
        float(1 - finite.mean()),
    )


def rows_of(
    name: str, runs: int, seed: int, filters: Filters
) -> Iterator[tuple[str, Row]]:
    """Run all filters on one scenario."""
    scenario = load_scenario(name)
    data = simulate_runs(scenario, runs, seed)
    for label, (estimator, options) in filters.items():
        run = run_singly if label in SLOW else run_batch
        yield label, measure(data, run(estimator, scenario, data, options))


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
    filters = FILTERS | (SLOW if arguments.slow else {})
    began = time.perf_counter()
    show = print_markdown if arguments.markdown else print_table
    for name in arguments.scenario or SCENARIOS:
        title = f"{name}, {arguments.runs} runs, seed {arguments.seed}"
        show(title, rows_of(name, arguments.runs, arguments.seed, filters))
    print(f"{time.perf_counter() - began:.0f} s", file=sys.stderr)


if __name__ == "__main__":
    main()
