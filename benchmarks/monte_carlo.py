"""Time of a whole Monte Carlo, of its filter alone, and of a plain loop.

    python benchmarks/monte_carlo.py
    python benchmarks/monte_carlo.py --parts [--earlier FOLDER]    # a former checkout

``--parts`` compares bound and measures with the two filters of a study, in CPU time.
A second table shows time and memory of whole studies and of log files at growing sizes,
with exponents of the growth.

One core, one process, interleaved rounds; ratios are medians over the rounds. The world
has 20 landmarks around a circle, about half of them in view, and 1000 steps.
"""

import argparse
import math
import os
import tempfile
import tracemalloc
from collections.abc import Callable
from functools import partial
from importlib import import_module
from pathlib import Path
from statistics import median
from time import perf_counter
from typing import Any

import gymnasium
import numpy as np
from estimators import EARLIER, load_earlier
from interleaved import ratio, time_interleaved, verdict
from peers import StackedDense
from rich.console import Console
from rich.table import Table

import slamgym
from slamgym.estimator import BatchSlam, EkfSlam
from slamgym.experiments.monte_carlo_study import monte_carlo
from slamgym.experiments.run_and_replay.simulated_runs import simulate_runs
from slamgym.sim_configs import Scenario, action_sequence, load_scenario

LANDMARKS = 20


def world(steps: int) -> Scenario:
    """Make a robot that circles among landmarks and sees what is before it."""
    angles = np.arange(LANDMARKS) * 2 * np.pi / LANDMARKS
    points = 12 * np.column_stack([np.cos(angles), np.sin(angles)]) + [0, 8]
    return load_scenario("loop").with_changes(
        name="circle",
        steps=steps,
        landmarks={"layout": "points", "points": points.tolist()},
        sensor={"field_of_view": np.pi, "min_range": 0.05, "max_range": 100.0},
    )


def filter_alone(scenario: Scenario, runs: int) -> Callable[[], object]:
    """Return a function that runs the batched kernels on prepared drives."""
    drives = simulate_runs(scenario, runs, 0)
    print(f"{drives.visible.mean():.0%} of the landmarks in view")

    def kernels() -> object:
        slam = EkfSlam(scenario.motion.std, scenario.sensor.std)
        batch = BatchSlam(
            slam,
            runs,
            LANDMARKS,
            initial_poses=drives.initial_poses,
            initial_pose_std=scenario.start.std,
            threads=1,
        )
        return batch.run(
            drives.odometry, drives.measurements, drives.visible, drives.dt
        )

    return kernels


def plain_loop(scenario: Scenario, runs: int) -> Callable[[], object]:
    """Return a function that runs single environments with the dense numpy filter.

    It initialises all landmarks at the start from the truth, and computes no measures.
    """
    env = gymnasium.make("slamgym/LandmarkWorld-v0", scenario=scenario)
    actions = action_sequence(scenario)
    variances = np.diag(np.square(scenario.motion.std)), np.square(scenario.sensor.std)

    def loop() -> None:
        for run in range(runs):
            observation, info = env.reset(seed=run)
            landmarks = env.unwrapped.landmarks  # type: ignore[attr-defined]
            mean = np.concatenate([info["pose"], landmarks.ravel()])
            slam = StackedDense(mean, 0.01 * np.eye(len(mean)), *variances)
            for action in actions:
                observation, *_ = env.step(action)
                seen = np.flatnonzero(observation["mask"])
                readings = observation["landmarks"][seen].ravel()
                slam.step(observation["odometry"], readings, seen)

    return loop


def seconds(work: Callable[[], object]) -> float:
    """Time one call."""
    began = perf_counter()
    work()
    return perf_counter() - began


def compare(runs: int, steps: int, rounds: int) -> None:
    """Print times and ratios."""
    scenario = world(steps)
    kernels, loop = filter_alone(scenario, runs), plain_loop(scenario, 1)
    times: dict[str, list[float]] = {"whole": [], "kernels": [], "loop": []}
    monte_carlo(scenario, "ekf", 1), kernels()  # compile
    for _ in range(rounds):
        times["whole"].append(seconds(lambda: monte_carlo(scenario, "ekf", runs)))
        times["kernels"].append(seconds(kernels))
        times["loop"].append(runs * seconds(loop))  # of one run, times their number
    whole, alone = times["whole"], times["kernels"]
    to_kernels = median(a / b for a, b in zip(whole, alone, strict=True))
    to_loop = median(a / b for a, b in zip(times["loop"], whole, strict=True))
    print(f"{runs} runs of {steps} steps, {LANDMARKS} landmarks, ekf, one core:")
    print(f"  batched kernels alone                 {median(alone):7.2f} s")
    print(f"  world + filter + measures             {median(whole):7.2f} s")
    print(f"  plain loop: environment, dense filter {median(times['loop']):7.1f} s")
    print(f"  whole / kernels  {to_kernels:5.2f}  goal <= 3  ", end="")
    print(verdict(to_kernels, 3, at_least=False))
    print(f"  loop / whole     {to_loop:5.1f}  goal >= 15 ", end="")
    print(verdict(to_loop, 15, at_least=True))


def compare_memory(steps: int) -> None:
    """Print the peak of numpy's memory against the number of runs."""
    scenario, peaks = world(steps), []
    for runs in (64, 256):
        with tempfile.TemporaryDirectory() as folder:
            tracemalloc.start()
            monte_carlo(scenario, "ekf", runs, out=Path(folder) / "out").close()
            peaks.append(tracemalloc.get_traced_memory()[1] / 2**20)
            tracemalloc.stop()
    print(f"  peak memory for 64 and 256 runs: {peaks[0]:.0f} and {peaks[1]:.0f} MiB")


#: Worlds of `compare_parts` with the number of runs, and the least gain of a study.
WORLDS = {
    "six_landmarks": (256, 3.5),
    "loop": (16, 1.8),
    "corridor": (16, None),
    "dense": (4, None),
}
FILTERS = "ekf", "invariant"
PARTS = "filters", "bound", "measures", "study"
SHARE = 0.5  # of bound and measures, of the time of the filters


def parts_of(package: str, name: str, runs: int) -> dict[str, Callable[[], object]]:
    """Return the parts of a study of a package, slamgym or an earlier one."""

    def module(path: str) -> Any:
        return import_module(f"{package}.{path}")

    study = module("experiments.monte_carlo_study.filtered_runs")
    settings_of = module("experiments.run_and_replay.filter_settings")
    measures = module("experiments.monte_carlo_study.run_measures")
    scenario = module("sim_configs").load_scenario(name)
    simulated = module("experiments.run_and_replay.simulated_runs")
    drives = simulated.simulate_runs(scenario, runs, 0, only_read=True)
    settings = [
        settings_of.settings_for_scenario(scenario, estimator=each) for each in FILTERS
    ]
    filtered = [study.filter_runs(each, drives) for each in settings]
    bound = study.bound_runs(scenario, drives)
    noise = study.noise_of_runs(scenario, scenario, drives)
    whole = module("experiments.monte_carlo_study").monte_carlo
    return {
        "filters": lambda: [study.filter_runs(each, drives) for each in settings],
        "bound": lambda: study.bound_runs(scenario, drives),
        "measures": lambda: [
            measures.measure_runs(drives, each, bound, noise) for each in filtered
        ],
        "study": lambda: whole(name, list(FILTERS), runs),
    }


def peak_of(package: str, runs: int) -> float:
    """Measure the peak memory of a study in a folder, with its summary [MB].

    The memory is that of Python and numpy, without libraries and kernels.
    """
    study = import_module(f"{package}.experiments.monte_carlo_study")
    loop = import_module(f"{package}.sim_configs").load_scenario("loop")
    world = loop.with_changes(steps=200)
    study.monte_carlo(world, list(FILTERS), 1)  # compiles
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "out"
        tracemalloc.start()
        with study.monte_carlo(world, list(FILTERS), runs, out=out) as results:
            study.summarise_monte_carlo(results)
        peak = tracemalloc.get_traced_memory()[1] / 1e6
        tracemalloc.stop()
    return peak


def study_of(package: str, runs: int) -> Callable[[], object]:
    """Return a function that runs a study of two filters in memory."""
    study = import_module(f"{package}.experiments.monte_carlo_study")
    return lambda: study.monte_carlo("six_landmarks", list(FILTERS), runs)


def files_of(
    package: str, episodes: int, *, form: str, what: str, folder: Path
) -> Callable[[], object]:
    """Return a function that writes or reads some episodes of 1,005 steps."""
    module = import_module(f"{package}.experiments.trajectories.driven_episodes")
    formats = import_module(f"{package}.experiments.trajectories.formats")
    world = import_module(f"{package}.sim_configs").load_scenario("loop")
    some = module.drive_episodes(world, "waypoints", range(episodes))
    chosen, path = formats.trajectory_format(form), Path(tempfile.mkdtemp(dir=folder))
    chosen.write(some, path / "shard")

    def write() -> None:
        chosen.write(some, Path(tempfile.mkdtemp(dir=folder)) / "shard")

    return write if what == "write" else lambda: list(chosen.read(path / "shard"))


Costs = dict[str, list[float]]  # before and now, at the sizes


def costs_of(
    make: Callable[[str, int], Callable[[], object]],
    packages: dict[str, str],
    sizes: tuple[int, int],
) -> Costs:
    """Return the CPU seconds of something at two sizes, before and now."""
    cases = {f"{w} {n}": make(p, n) for w, p in packages.items() for n in sizes}
    times = time_interleaved(cases, rounds=3)
    return {w: [median(times[f"{w} {n}"]) for n in sizes] for w in packages}


def growth_row(
    title: str, sizes: tuple[int, int], costs: Costs, most: float, limit: str
) -> list[str]:
    """Write the costs at the larger size with the exponents of their growth."""

    def written(cost: list[float]) -> str:
        power = math.log(cost[1] / cost[0]) / math.log(sizes[1] / sizes[0])
        return f"{cost[1]:.3g}, n^{power:.2f}"

    before, now = costs.get("before"), costs["now"]
    found = [title, str(sizes), written(before) if before else "", written(now)]
    return [*found, f"<= {most:g}", verdict(now[1], most, at_least=False), limit]


def compare_growth(packages: dict[str, str], folder: Path) -> None:
    """Print time and memory at two sizes, before and now, with goals and limits."""
    table = Table(title="At the larger size, and how the cost grows with the size n")
    for column in ("what", "sizes", "before", "now", "goal", "", "limit"):
        table.add_column(column)
    some = np.random.default_rng(0).standard_normal(10_000).tolist()
    text = 1e2 * median(time_interleaved({"": lambda: [*map(repr, some)]})[""])
    runs, episodes = (64, 256), (2, 8)
    peaks = {when: [peak_of(p, n) for n in runs] for when, p in packages.items()}
    limit = "a block of 64 runs"
    table.add_row(*growth_row("loop, 200 steps [MB]", runs, peaks, 40, limit))
    costs = costs_of(study_of, packages, runs)
    goal = 8 * runs[1] / 10_000  # 8 s for 10,000 runs
    table.add_row(*growth_row("six_landmarks, seconds", runs, costs, goal, ""))
    for form, numbers in (("slamlog", 14), ("g2o", 25)):
        for what, limit in (
            ("write", f"{numbers * text:.1f}: {numbers} × repr"),
            ("read", ""),
        ):
            make = partial(files_of, form=form, what=what, folder=folder)
            seconds = costs_of(make, packages, episodes)
            steps = load_scenario("loop").steps
            costs = {
                when: [
                    1e6 * s / n / steps for s, n in zip(found, episodes, strict=True)
                ]
                for when, found in seconds.items()
            }
            title = f"{form}, {what} [µs / step]"
            table.add_row(*growth_row(title, episodes, costs, 10, limit))
    Console(width=110).print(table)


def compare_parts(earlier: Path | None) -> None:
    """Print the time of each part of a study, before and now, and the goals."""
    packages = {"now": "slamgym"}
    if earlier is not None:
        load_earlier(earlier)
        packages["before"] = EARLIER
    table = Table(title=f"µs a run-step of {', '.join(FILTERS)} together, one core")
    for column in ("world", "part", "before", "now", "gain", "goal", ""):
        table.add_column(column, justify="left" if column in "world part" else "right")
    for name, (runs, least) in WORLDS.items():
        cases = {
            f"{part} {when}": work
            for when, package in packages.items()
            for part, work in parts_of(package, name, runs).items()
        }
        times = time_interleaved(cases, rounds=3)
        each = 1e6 / (runs * (load_scenario(name).steps + 1))
        now = {part: median(times[f"{part} now"]) for part in PARTS}
        for part, value in now.items():
            row = [name, part, "", f"{each * value:.2f}", "", "", ""]
            if earlier is not None:
                before = f"{each * median(times[f'{part} before']):.2f}"
                gain = ratio(times, f"{part} before", f"{part} now")
                row[2], row[4] = before, f"{gain:.1f}"
                if part == "study" and least:
                    row[5:] = f">= {least}", verdict(gain, least, at_least=True)
            table.add_row(*row)
        share = (now["bound"] + now["measures"]) / now["filters"]
        table.add_row(
            *(name, "(bound + measures) / filters", "", f"{share:.2f}", ""),
            *(f"<= {SHARE}", verdict(share, SHARE, at_least=False)),
            end_section=True,
        )
    Console(width=100).print(table)
    with tempfile.TemporaryDirectory() as folder:
        compare_growth(packages, Path(folder))


def main() -> None:
    """Print what the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=256)
    parser.add_argument("--steps", type=int, default=1000)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--parts", action="store_true")
    parser.add_argument("--earlier", type=Path, help="a checkout of an earlier commit")
    arguments = parser.parse_args()
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    print(f"slamgym {slamgym.__version__}")
    if arguments.parts:
        compare_parts(arguments.earlier)
        return
    compare(arguments.runs, arguments.steps, arguments.rounds)
    compare_memory(arguments.steps)


if __name__ == "__main__":
    main()
