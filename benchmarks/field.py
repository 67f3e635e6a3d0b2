"""Estimators of several libraries side by side, on the same drives: one table.

    python benchmarks/field.py --runs 100
    python benchmarks/field.py --checks     # what check_estimator finds, no table

For each world and estimator: the laboratory's verdict in the invariant frame; NEES of
the pose per degree of freedom in the invariant and in the additive frame, and NIS per
degree; efficiency against the bound of any filter, of the position, the heading and the
final map; path error and final map error [m], not aligned; CPU time of a step [µs]: of
predict and update, and with the belief, mean and covariance of pose and whole map.
Failed runs count in no other column.  Needs the extras ``peers`` and ``benchmark``;
estimators of missing libraries are left out and named.  filterpy and Stone Soup have no
SLAM: `filterpy_kalman.py` and `stonesoup_kalman.py` here make filters of them.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Mapping
from importlib.util import find_spec
from statistics import mean
from time import thread_time
from typing import Any

import numpy as np

from slamgym.estimator import list_peers, register_estimator
from slamgym.estimator.check_estimator import CHECKS, find_breaches
from slamgym.estimator.interface import SlamEstimator
from slamgym.estimator.registry import accepted_options, find_estimator
from slamgym.experiments.monte_carlo_study import monte_carlo, summarise_monte_carlo
from slamgym.experiments.run_and_replay.filter_settings import (
    EstimatorChoice,
    estimator_choices,
)
from slamgym.experiments.run_and_replay.simulated_runs import simulate_runs
from slamgym.sim_configs import Scenario, load_scenario

WORLDS = {"six_landmarks": 29, "loop": 260, "coarse_loop": 260}
"""Steps of the worlds: of the two loops somewhat more than the first lap."""
LONGEST = {"gtsam_batch": 100}
"""Steps above which an estimator is left out: its time of a step grows with them."""
OURS = ("ekf", "unscented", "invariant", "invariant[iterations=1]")
VARIANTS = ("gtsam_isam2[relinearize_threshold=0.001]", "gtsam_fixed_lag[lag=50]")
KALMAN_PEERS = {
    "filterpy_ekf": "filterpy_kalman:FilterpyEkfSlam",
    "filterpy_ukf": "filterpy_kalman:FilterpyUkfSlam",
    "stonesoup_ekf": "stonesoup_kalman:StoneSoupEkfSlam",
    "stonesoup_ukf": "stonesoup_kalman:StoneSoupUkfSlam",
}
COLUMNS = (
    "estimator",
    "verdict",
    "failed",
    "NEES invariant",
    "NEES additive",
    "NIS",
    "position",
    "heading",
    "map",
    "ATE",
    "map RMSE",
    "µs",
    "with belief",
)


def installed_peers() -> list[str]:
    """Return those of the installed libraries, registered; name the others."""
    libraries = {peer.name: peer.library for peer in list_peers()}
    libraries |= {name: name.partition("_")[0] for name in KALMAN_PEERS}
    missing = {name for name, library in libraries.items() if not find_spec(library)}
    for name in sorted(missing):
        print(f"left out: {name}, {libraries[name]} missing", file=sys.stderr)
    for name in KALMAN_PEERS.keys() - missing:
        register_estimator(name, find_estimator(KALMAN_PEERS[name]))
    return sorted(libraries.keys() - missing)


def estimators(installed: list[str]) -> tuple[str, ...]:
    """Return ours, and those of other libraries with their variants."""
    variants = [name for name in VARIANTS if name.partition("[")[0] in installed]
    return (*OURS, *sorted([*installed, *variants]))


def world_of(name: str) -> Scenario:
    """Return a world, shortened."""
    scenario = load_scenario(name)
    return load_scenario(scenario.model_dump() | {"steps": WORLDS[name]})


def rows_of(
    world: Scenario, names: tuple[str, ...], runs: int, seed: int
) -> Iterator[list[str]]:
    """Yield the row of each estimator in a world."""
    times = step_times(world, names, seed)
    for name in names:
        results = monte_carlo(world, name, runs, seed)
        entry = summarise_monte_carlo(results)["estimators"][name]
        both = (f"{1e6 * value:.0f}" for value in times[name])
        yield [f"`{name}`", *cells(entry), *both]


def cells(entry: Mapping[str, Any]) -> Iterator[str]:
    """Yield the entries of a summary about an estimator."""
    yield entry["verdict"]
    yield str(len(entry["failed_runs"]))
    yield number(entry["pose_nees"]["invariant"]["mean"])
    yield number(entry["pose_nees"]["additive"]["mean"])
    yield number(entry["nis"])
    for key in ("pose", "heading", "map"):
        found = (entry["efficiency"] or {}).get(key) or {}
        yield number(found.get("value"))
    yield number(entry["ate"]["raw"])
    yield number(entry["landmark_rmse"]["raw"])


def number(value: float | None) -> str:
    """Write three digits, or a dash if the value is unknown."""
    return "–" if value is None else f"{value:.3g}"


def step_times(
    world: Scenario, names: tuple[str, ...], seed: int
) -> dict[str, tuple[float, float]]:
    """Return the mean CPU time of a step [s], without and with the belief.

    All estimators take each step of one drive in turn, so that whatever else the
    machine does hits all alike.  A first drive of ten steps loads and compiles.
    """
    choices = estimator_choices(names)
    drive(world, choices, seed, steps=10, with_belief=True)
    plain = drive(world, choices, seed, steps=world.steps, with_belief=False)
    full = drive(world, choices, seed, steps=world.steps, with_belief=True)
    return {name: (mean(plain[name]), mean(full[name])) for name in names}


def drive(
    world: Scenario,
    choices: tuple[EstimatorChoice, ...],
    seed: int,
    *,
    steps: int,
    with_belief: bool,
) -> dict[str, list[float]]:
    """Return the CPU times of the steps of one drive [s], by estimator."""
    runs = simulate_runs(world, 1, seed)
    slams = {c.label: made(c, world, runs.initial_poses[0]) for c in choices}
    times: dict[str, list[float]] = {label: [] for label in slams}
    rng = np.random.default_rng(seed)  # of the order, for equally cold caches
    for step in range(steps + 1):
        seen = np.flatnonzero(runs.visible[0, step])
        readings, ids = runs.measurements[0, step, seen], seen.tolist()
        for label in rng.permutation(list(slams)).tolist():
            slam = slams[label]
            began = thread_time()
            if step:
                slam.predict(runs.odometry[0, step])
            slam.update(readings, ids)
            if with_belief:
                slam.belief()
            times[label].append(thread_time() - began)
    return times


def made(choice: EstimatorChoice, world: Scenario, pose: Any) -> SlamEstimator:
    """Make an estimator; graphs are made without innovations, which cost time."""
    silent = accepted_options(find_estimator(choice.name), {"innovations": False})
    wanted = silent if choice.name.startswith("gtsam") else {}
    options = {**wanted, **choice.options}
    return choice._replace(options=options).settings(world).make(pose)


def print_world(name: str, peers: list[str], runs: int, seed: int) -> None:
    """Print the table of one world."""
    world = world_of(name)
    names = tuple(
        each
        for each in estimators(peers)
        if LONGEST.get(each, world.steps) >= world.steps
    )
    print(f"**{name}, {world.steps} steps, {runs} runs, seed {seed}**\n")
    print(f"| {' | '.join(COLUMNS)} |")
    print("|---|---|" + "---:|" * (len(COLUMNS) - 2))
    for row in rows_of(world, names, runs, seed):
        print(f"| {' | '.join(row)} |", flush=True)
    print()


def print_checks(peers: list[str]) -> None:
    """Print the results of `check_estimator`, one row for each estimator."""
    print(f"| estimator | findings of {sum(map(len, CHECKS.values()))} checks |")
    print("|---|---|")
    for name in peers:
        findings = find_breaches(find_estimator(name))
        print(f"| `{name}` | {'; '.join(map(str, findings)) or 'none'} |")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=30)
    parser.add_argument("--seed", type=int, default=900_000)
    parser.add_argument("--worlds", nargs="+", default=list(WORLDS), choices=WORLDS)
    parser.add_argument("--checks", action="store_true")
    arguments = parser.parse_args()
    peers = installed_peers()
    if arguments.checks:
        print_checks(peers)
        return
    for name in arguments.worlds:
        print_world(name, peers, arguments.runs, arguments.seed)


if __name__ == "__main__":
    main()
