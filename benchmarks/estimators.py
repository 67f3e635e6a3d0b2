"""Time of a filter step and of a batch of runs: ratios in one process.

    python benchmarks/estimators.py     # with filterpy and Stone Soup if installed
    pip install "slamgym[benchmark]"    # installs them
    python benchmarks/estimators.py --earlier FOLDER    # a checkout to compare with
    python benchmarks/estimators.py --hidden    # readings without identities alone

Every case takes the same step: predict, then all readings. "kernels" are the compiled
functions alone; "public" are ``predict`` and ``update`` with all checks and the report.
"""

import math
import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import sys
import warnings
from argparse import ArgumentParser
from collections.abc import Callable
from importlib import import_module
from importlib.util import find_spec, module_from_spec, spec_from_file_location
from itertools import cycle
from pathlib import Path
from time import perf_counter, thread_time
from typing import Any

import numpy as np
from interleaved import microseconds, ratio, time_interleaved, verdict
from numpy.typing import NDArray
from peers import StackedDense, filterpy_step, stonesoup_step
from rich.console import Console
from rich.table import Table
from second_core import two_processes

from slamgym.estimator import EkfSlam, make_batch, make_estimator
from slamgym.estimator.filters.gaussian_map import move_pose, update_map

MOTION_STD, MEASUREMENT_STD = np.array([0.05, 0.02, 0.02]), np.array([0.02, 0.08])
NOISE: dict[str, Any] = {"motion_std": MOTION_STD, "measurement_std": MEASUREMENT_STD}
ODOMETRY = np.array([0.0, 0.0])  # the robot stands, its noise does not
CONSOLE = Console(width=100)


def scene(landmarks: int) -> NDArray[np.float64]:
    """Exact readings of landmarks spread around the origin."""
    rng = np.random.default_rng(0)
    x, y = rng.uniform(-10, 10, (2, landmarks))
    return np.stack([np.arctan2(y, x), np.hypot(x, y)], axis=1)


def prepared(
    name: str,
    readings: NDArray[np.float64],
    make: Callable[..., Any] = make_estimator,
    steps: int = 3,
    *,
    hidden: bool = False,
    **options: Any,
) -> Any:
    """Make a filter that has all landmarks in its map, with or without identities."""
    slam, ids = make(name, **NOISE, **options), np.arange(len(readings))
    for _ in range(steps):
        slam.predict(ODOMETRY)
        slam.update(readings, None if hidden else ids)
    return slam


def public_step(
    slam: Any, readings: NDArray[np.float64], ids: Any
) -> Callable[[], object]:
    """One step by the public methods."""

    def step() -> None:
        slam.predict(ODOMETRY)
        slam.update(readings, ids)

    return step


def kernel_step(slam: EkfSlam, readings: NDArray[np.float64]) -> Callable[[], object]:
    """One step by the compiled functions alone, in the memory of a filter."""
    block, ids = slam.map.block, np.arange(len(readings))

    def step() -> None:
        move_pose(block, 0.0, 0.0, 0.0, 1.0)
        update_map(block, readings, ids)

    return step


EARLIER = "slamgym_earlier"


def load_earlier(folder: Path) -> None:
    """Import slamgym from a checkout of an earlier commit, under another name."""
    package = folder / "src" / "slamgym"
    found = spec_from_file_location(
        EARLIER, package / "__init__.py", submodule_search_locations=[str(package)]
    )
    assert found is not None
    assert found.loader is not None
    sys.modules[EARLIER] = module = module_from_spec(found)
    found.loader.exec_module(module)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # both register the environments
        import_module(f"{EARLIER}.estimator")


def both(
    name: str, readings: NDArray[np.float64], *, hidden: bool = False, **options: Any
) -> dict[str, Any]:
    """Return the public step of a filter, and of the same filter at an earlier commit.

    Both beliefs must be equal after the same steps.  Those of ``unscented``, which
    multiplies dense matrices, must be equal up to rounding.
    """
    makers = {"": make_estimator}
    if EARLIER in sys.modules:
        makers[", earlier"] = sys.modules[f"{EARLIER}.estimator"].make_estimator
    slams = {
        key: prepared(name, readings, make, 600, hidden=hidden, **options)
        for key, make in makers.items()
    }
    beliefs = [slam.belief() for slam in slams.values()]
    for belief in beliefs[1:]:
        atol = 1e-9 if name == "unscented" else 0.0
        np.testing.assert_allclose(belief.mean, beliefs[0].mean, 0, atol)
        np.testing.assert_allclose(belief.covariance, beliefs[0].covariance, 0, atol)
    managed = ", managed, identities " + ("hidden" if hidden else "given")
    what = f"{name}{managed if options else ''} public"
    ids = None if hidden else np.arange(len(readings))
    return {
        f"{what}{key}": public_step(slam, readings, ids) for key, slam in slams.items()
    }


def single_cases(landmarks: int) -> dict[str, Callable[[], object]]:
    """All ways to take one step with this many landmarks, all observed."""
    readings = scene(landmarks)
    ekf = prepared("ekf", readings)
    belief = ekf.belief()
    noise = (np.diag(MOTION_STD**2), MEASUREMENT_STD**2)
    slots = np.arange(landmarks)
    dense = StackedDense(belief.mean, belief.covariance, *noise)
    data = (ODOMETRY, readings.ravel(), slots)
    cases: dict[str, Callable[[], object]] = {
        "stacked dense numpy": lambda: dense.step(*data),
        "ekf kernels": kernel_step(prepared("ekf", readings), readings),
        **both("ekf", readings),
        **both("invariant", readings),
        **both("first_estimates", readings),
        **both("observability_constrained", readings),
        **both("robocentric", readings),
        **both("unscented", readings),
        **both("ekf", readings, management=True),
        **both("ekf", readings, management=True, hidden=True),
        "invariant kernels": kernel_step(prepared("invariant", readings), readings),
        "iterated (3) kernels": kernel_step(
            prepared("iterated", readings, iterations=3), readings
        ),
    }
    start = (belief.mean, belief.covariance, noise, data)
    if find_spec("filterpy"):
        cases["filterpy"] = filterpy_step(*start)
    if find_spec("stonesoup"):
        cases["Stone Soup"] = stonesoup_step(*start)
    return cases


#: Least gain in speed of a public step, by number of landmarks, over the commit before
#: a filter kept its arrays in one block of memory.
GAINS = {6: 2.2, 20: 1.6}
GOALS: dict[
    int, dict[tuple[str, str], float]
] = {  # (slow, fast): at least, or (slow, fast): at most with a minus sign
    6: {
        ("stacked dense numpy", "ekf kernels"): 20,
        ("stacked dense numpy", "ekf public"): 9,
        ("filterpy", "ekf public"): 5,
    },
    20: {
        ("stacked dense numpy", "ekf kernels"): 15,
        ("stacked dense numpy", "ekf public"): 12,
        ("filterpy", "ekf public"): 5,
    },
    50: {("stacked dense numpy", "ekf kernels"): 15},
}
COMMON_GOALS = {
    ("invariant kernels", "ekf kernels"): -1.3,
    ("iterated (3) kernels", "ekf kernels"): -4,
}


def compare_single(landmarks: int) -> None:
    """Print times and ratios of one step."""
    times = time_interleaved(single_cases(landmarks))
    table = Table(title=f"one step, {landmarks} landmarks, all observed")
    table.add_column("case")
    table.add_column("CPU µs per step", justify="right")
    for name in times:
        table.add_row(name, f"{microseconds(times, name):.1f}")
    CONSOLE.print(table)
    goals = GOALS[landmarks] | COMMON_GOALS
    if landmarks in GAINS:
        goals |= {(f"{name}, earlier", name): GAINS[landmarks] for name in times}
    for (slow, fast), goal in goals.items():
        if slow in times:
            found = ratio(times, slow, fast)
            sign = ">=" if goal > 0 else "<="
            said = f"{sign} {abs(goal)}: {verdict(found, abs(goal), at_least=goal > 0)}"
            CONSOLE.print(f"  {slow} / {fast}: {found:.1f} ({said})")


#: Landmarks seen and mapped, and the largest ratios to a filter with given identities:
#: of a managed filter with hidden ones, and of one with given ones.
HIDDEN = {
    (6, 6): (5, 2),
    (20, 20): (5, 2),
    (50, 50): (8, 2),
    (10, 200): (2, 2),
    (10, 500): (2, 2),
}


def compare_hidden(seen: int, mapped: int) -> None:
    """Print the time of a scan without identities, beside one with identities.

    Each landmark stands in a square of 5 m, at least 3 m from all others.  The robot,
    at a corner of four squares, sees those that are nearest.  All scans are taken once
    before: the first ones learn how many readings belong to none.  A scan is ambiguous
    if it leaves several hypotheses, as one with a reading so far from its landmark that
    it may be of a new one.  The goal is that of all others.
    """
    rng, half = np.random.default_rng(1), math.ceil(mapped**0.5 / 2)
    corners = np.indices((2 * half, 2 * half)).reshape(2, -1) - half
    x, y = 5 * (corners + rng.uniform(0.3, 0.7, corners.shape))
    readings = np.stack([np.arctan2(y, x), np.hypot(x, y)], axis=1)
    readings = readings[np.argsort(readings[:, 1])[:mapped]]
    ids = np.arange(seen)
    near, goals = readings[ids], HIDDEN[seen, mapped]
    scans = [
        near + rng.standard_normal(near.shape) * MEASUREMENT_STD for _ in range(97)
    ]
    packages = {"": make_estimator}
    if EARLIER in sys.modules:
        packages = {", earlier": sys.modules[f"{EARLIER}.estimator"].make_estimator}
        packages[""] = make_estimator
    cases: dict[str, Callable[[], object]] = {}
    slams: dict[str, Any] = {}
    managed = {"management": True}
    clear = clear_scans(learnt(make_estimator, readings, scans, None, managed), scans)
    for key, make in packages.items():
        for name, given, options, taken in (
            ("identities given", ids, {}, scans),
            ("identities given, managed", ids, managed, scans),
            ("identities hidden", None, managed, clear),
            ("identities hidden, ambiguous scans too", None, managed, scans),
        ):
            slams[name + key] = learnt(make, readings, taken, given, options)
            cases[name + key] = drive_step(slams[name + key], taken, given)
    times = time_interleaved(cases)
    left_out = len(scans) - len(clear)
    CONSOLE.print(f"one step, {seen} seen of {mapped} landmarks, {left_out} ambiguous")
    for name in times:
        found = ratio(times, name, "identities given")
        goal = {"identities hidden": goals[0], "identities given, managed": goals[1]}
        said = ""
        if name in goal:
            said = f" (<= {goal[name]}: {verdict(found, goal[name], at_least=False)})"
        if "hidden" in name:
            said += f", hypotheses: {len(slams[name].hypotheses)}"
        CONSOLE.print(
            f"  {name}: {microseconds(times, name):.1f} µs, {found:.1f} ×{said}"
        )


def learnt(
    make: Callable[..., Any],
    readings: NDArray[np.float64],
    scans: list[NDArray[np.float64]],
    ids: Any,
    options: dict[str, Any],
) -> Any:
    """Make a filter that has mapped all landmarks, and taken all scans once."""
    slam = make("invariant", **NOISE, **options)
    slam.update(readings, list(range(len(readings))))
    step = drive_step(slam, scans, ids)
    for _ in scans:
        step()
    return slam


def clear_scans(
    slam: Any, scans: list[NDArray[np.float64]]
) -> list[NDArray[np.float64]]:
    """Return the scans that leave one hypothesis."""
    step, clear = drive_step(slam, scans, None), []
    for scan in scans:
        step()
        if len(slam.hypotheses) == 1:
            clear.append(scan)
    return clear


def drive_step(
    slam: Any, scans: list[NDArray[np.float64]], ids: Any
) -> Callable[[], object]:
    """Take one scan after the other, and begin anew after the last one."""
    rest = cycle(scans)

    def step() -> None:
        slam.predict(ODOMETRY)
        slam.update(next(rest), ids)

    return step


def batch_data(
    runs: int, steps: int, landmarks: int
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
    """Odometry, noisy readings and visibility (about half) of standing robots."""
    rng = np.random.default_rng(1)
    shape = (runs, steps, landmarks)
    readings = scene(landmarks) + rng.standard_normal((*shape, 2)) * MEASUREMENT_STD
    return np.zeros((runs, steps, 2)), readings, rng.random(shape) < 0.48


RUNS, STEPS, LANDMARKS = 256, 100, 20  # of the batch


def batch_run(runs: int, threads: int) -> Callable[[], object]:
    """Prepare a batch and its data; return a function that runs it."""
    data = batch_data(runs, STEPS, LANDMARKS)

    def run() -> None:
        batch = make_batch(
            "ekf", runs=runs, landmarks=LANDMARKS, threads=threads, **NOISE
        )
        batch.run(*data)

    return run


def half_of_the_runs() -> Callable[[], object]:
    """Prepare the share of the batch that one of two processes computes."""
    return batch_run(RUNS // 2, threads=1)


def compare_batch() -> None:
    """Print the time of a batch, and of a loop over the stacked dense filter."""
    data = batch_data(RUNS, STEPS, LANDMARKS)
    one_thread = batch_run(RUNS, threads=1)

    def dense(run: int) -> float:
        ekf = prepared("ekf", scene(LANDMARKS)).belief()
        peer = StackedDense(
            ekf.mean, ekf.covariance, np.diag(MOTION_STD**2), MEASUREMENT_STD**2
        )
        began = thread_time()
        for step in range(STEPS):
            seen = np.flatnonzero(data[2][run, step])
            peer.step(ODOMETRY, data[1][run, step, seen].ravel(), seen)
        return thread_time() - began

    one_thread()
    per_dense, per_batch = [], []
    for round_ in range(9):
        per_dense.append(dense(round_) / STEPS)
        began = thread_time()
        one_thread()
        per_batch.append((thread_time() - began) / (RUNS * STEPS))
    gain = float(np.median(np.divide(per_dense, per_batch)))
    CONSOLE.print(
        f"\nbatch of {RUNS} runs, {LANDMARKS} landmarks half visible, one thread: "
        f"{1e6 * np.median(per_batch):.1f} µs per run-step, "
        f"stacked dense {1e6 * np.median(per_dense):.0f} µs"
    )
    CONSOLE.print(
        f"  stacked dense / batch: {gain:.1f} "
        f"(>= 25: {verdict(gain, 25, at_least=True)})"
    )
    slam = make_batch("ekf", runs=RUNS, landmarks=LANDMARKS, **NOISE)
    size = 3 + 2 * LANDMARKS
    memory = slam.nbytes / (RUNS * size * size * 8)
    CONSOLE.print(
        f"  memory / covariances: {memory:.2f} "
        f"(<= 1.2: {verdict(memory, 1.2, at_least=False)})"
    )


def compare_threads() -> None:
    """Print the gain of a second thread, and that of a second process."""
    one_thread, two_threads = batch_run(RUNS, threads=1), batch_run(RUNS, threads=2)
    by_threads, by_processes = [], []
    with two_processes(half_of_the_runs) as in_two_processes:
        for _ in range(15):
            one = wall_time(one_thread)
            by_threads.append(one / wall_time(two_threads))
            by_processes.append(one / in_two_processes())
    threads, processes = np.median(by_threads), np.median(by_processes)
    CONSOLE.print(
        f"  two threads / one, wall time: {threads:.2f} "
        f"(>= 1.7: {verdict(float(threads), 1.7, at_least=True)})"
    )
    CONSOLE.print(
        f"  two independent processes / one, at the same time: {processes:.2f}; where "
        "this is below 1.7,\n  others use the second core; of it the threads reach "
        f"{threads / processes:.2f}"
    )


def wall_time(call: Callable[[], object]) -> float:
    """Seconds of one call."""
    began = perf_counter()
    call()
    return perf_counter() - began


if __name__ == "__main__":
    parser = ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--earlier", type=Path, help="a checkout of an earlier commit")
    parser.add_argument("--hidden", action="store_true", help="these cases alone")
    chosen = parser.parse_args()
    if chosen.earlier is not None:
        load_earlier(chosen.earlier)
    for case in HIDDEN:
        compare_hidden(*case)
    if chosen.hidden:
        sys.exit()
    for count in (6, 20, 50):
        compare_single(count)
    compare_batch()
    compare_threads()
