"""Time of a step as the map grows: compressed, full, and iSAM2, in one process.

    python benchmarks/growing_maps.py                   # the table, about 2 minutes
    python benchmarks/growing_maps.py --markdown        # … for a document
    python benchmarks/growing_maps.py --largest 10000 \
        --figure docs/images/growing_maps.png           # the curves; takes 8 GB
    pip install "slamgym[benchmark]"                    # brings GTSAM
    python benchmarks/growing_maps.py --overview        # full, compressed, submaps,
                                                        # sparse; about 7 minutes

The robot drives 0.5 m per step in a square with one landmark per 25 m².  All landmarks
are in the map, and the robot sees the ten nearest in every step.  Times are CPU times
of one thread; the filters take turns.
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import time
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from pathlib import Path
from statistics import mean, median
from typing import Any

import matplotlib as mpl
import numpy as np
from growing_maps_overview import SIZES, SMALLEST, show_overview
from growing_maps_peers import FullWithDsyrk, Isam2
from growing_maps_timing import STRETCH, Costs, Reading, Step, least, measure, step_of
from interleaved import verdict
from matplotlib import pyplot as plt
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table
from scipy.linalg.blas import dsyrk

from slamgym.estimator import EkfSlam, SubmapSlam
from slamgym.estimator.large_maps.compressed.compressed_slam import CompressedEkfSlam
from slamgym.estimator.models.bearing_range import predict_measurement
from slamgym.estimator.models.motions import predict_pose

Array = NDArray[np.float64]

MOTION_STD, MEASUREMENT_STD = np.array([0.02, 0.01, 0.01]), np.array([0.01, 0.05])
NOISE = (MOTION_STD, MEASUREMENT_STD)
SEEN = 10
REPEATED = 1000  # landmarks up to which a drive is repeated
LARGEST_FULL = 3000  # landmarks up to which there are full filters
WITH_DSYRK = "ekf, half storage and dsyrk"
CONSOLE = Console(width=110)


def landmarks_of(count: int) -> tuple[Array, float]:
    """Positions, and half the side of their square [m]."""
    half = np.sqrt(25.0 * count) / 2
    return np.random.default_rng(0).uniform(-half, half, (count, 2)), half


def drive(count: int, steps: int, *, jumping: bool = False) -> Iterator[Reading]:
    """Drive from place to place; see the nearest landmarks, or any ten."""
    rng = np.random.default_rng(1)
    landmarks, half = landmarks_of(count)
    pose = np.zeros(3)
    for step in range(steps):
        if step % 120 == 0:
            goal = rng.uniform(-0.9 * half, 0.9 * half, 2)
        ahead = np.arctan2(*(goal - pose[:2])[::-1]) - pose[2]
        turn = float(np.clip((ahead + np.pi) % (2 * np.pi) - np.pi, -0.2, 0.2))
        motion = predict_pose(pose, np.array([0.5, turn]))
        slip = MOTION_STD * rng.standard_normal(3)
        pose = motion.pose + motion.jacobian_noise @ slip
        distances = ((landmarks - pose[:2]) ** 2).sum(axis=1)
        distances[distances < 1] = np.inf  # too close to have a bearing
        ids = np.argpartition(distances, SEEN)[:SEEN]
        if jumping:
            ids = rng.choice(count, SEEN, replace=False)
        exact = predict_measurement(pose, landmarks[ids]).measurement
        noise = MEASUREMENT_STD * rng.standard_normal(exact.shape)
        yield Reading((0.5, turn), exact + noise, ids.tolist())


def first_look(count: int) -> Iterator[tuple[Array, list[int]]]:
    """Read all landmarks from the start, fifty at a time."""
    landmarks, _ = landmarks_of(count)
    readings = predict_measurement(np.zeros(3), landmarks).measurement
    readings += MEASUREMENT_STD * np.random.default_rng(2).standard_normal((count, 2))
    for first in range(0, count, 50):
        last = min(first + 50, count)
        yield readings[first:last], list(range(first, last))


def mapped(slam: Any, count: int) -> Any:
    """Show the whole map to a filter."""
    for readings, ids in first_look(count):
        slam.update(readings, ids)
    return slam


def dsyrk_floor(count: int) -> Step:
    """Make the least work of any full filter: P ← P − Aᵀ A with A of 20 rows."""
    size = 3 + 2 * count
    covariance = np.asfortranarray(np.eye(size))
    rows = np.random.default_rng(0).standard_normal((2 * SEEN, size)) * 1e-6
    return lambda _: dsyrk(-1.0, rows, 1.0, covariance, trans=1, lower=1, overwrite_c=1)


def compare(count: int, steps: int, *, jumping: bool = False) -> dict[str, Costs]:
    """Measure every filter in a map with this number of landmarks."""
    drives = 1 if REPEATED < count <= LARGEST_FULL else 3
    return least(
        [
            compare_once(count, steps, jumping=jumping, backwards=k % 2 == 1)
            for k in range(drives)
        ]
    )


def compare_once(
    count: int, steps: int, *, jumping: bool, backwards: bool
) -> dict[str, Costs]:
    """Measure every filter on one drive."""
    data = list(drive(count, steps, jumping=jumping))
    few = steps if count <= 500 else 3 * STRETCH
    slam = mapped(CompressedEkfSlam(*NOISE), count)
    invariant = mapped(CompressedEkfSlam(*NOISE, base="invariant"), count)
    cases: dict[str, tuple[Step, int]] = {
        "compressed": (step_of(slam), steps),
        "compressed invariant": (step_of(invariant), steps),
    }
    if count <= LARGEST_FULL:
        cases["floor"] = (dsyrk_floor(count), few)
        full = mapped(EkfSlam(*NOISE), count)
        cases["ekf"] = (step_of(full), few)
        belief = full.belief()
        dense = FullWithDsyrk(belief.mean, belief.covariance, *NOISE)
        cases[WITH_DSYRK] = (step_of(dense), few)
        if find_spec("gtsam") and not jumping:
            isam = Isam2(*NOISE)
            for readings, ids in first_look(count):
                isam.update(readings, ids)
            cases["GTSAM iSAM2"] = (step_of(isam), steps)
    costs = measure(cases, data, backwards=backwards)
    for name, each in (("compressed", slam), ("compressed invariant", invariant)):
        costs[name] = Costs(costs[name].steps, each.nbytes)
    return costs


def row(name: str, costs: Costs) -> list[str]:
    """Median, mean, percentiles and worst step [µs], and memory."""
    percentiles = np.percentile(costs.steps, [99, 99.9]).tolist()
    figures = [median(costs.steps), mean(costs.steps), *percentiles, max(costs.steps)]
    megabytes = f"{costs.nbytes / 1e6:.0f}" if costs.nbytes else ""
    return [name, *(f"{1e6 * seconds:.0f}" for seconds in figures), megabytes]


def show(title: str, rows: list[list[str]], *, markdown: bool) -> None:
    """Print a table, for a terminal or for a document."""
    head = ["filter", "median µs", "mean µs", "99 %", "99.9 %", "worst µs", "MB"]
    if markdown:
        lines = [head, ["---"] + ["---:"] * 6, *rows]
        print(f"\n{title}\n\n" + "\n".join(f"| {' | '.join(r)} |" for r in lines))
        return
    table = Table(title=title)
    for name in head:
        table.add_column(name, justify="left" if name == "filter" else "right")
    for cells in rows:
        table.add_row(*cells)
    CONSOLE.print(table)


def judge(what: str, value: float, goal: float) -> None:
    """Print a ratio beside its goal."""
    said = verdict(value, goal, at_least=False)
    CONSOLE.print(f"  {what}: {value:.2f} (<= {goal}: {said})")


def judge_beliefs(count: int) -> None:
    """Print the time of the whole belief of submaps; the first call joins them."""
    slam = mapped(SubmapSlam(*NOISE), count)
    times = []
    for now in drive(count, 10):
        slam.predict(now.odometry)
        slam.update(now.readings, now.ids)
        began = time.thread_time()
        slam.belief()
        times.append(1e3 * (time.thread_time() - began))
    CONSOLE.print(f"  {count} landmarks, first belief() of submaps: {times[0]:.0f} ms")
    judge(f"{count} landmarks, further belief() of submaps in ms", median(times), 50)


def judge_worst(near: dict[int, dict[str, Costs]]) -> None:
    """Print the slowest steps in steps of the full filter.

    They are compared with its slowest step where both took the same number of steps.
    """
    for count, costs in near.items():
        if "ekf" not in costs:
            continue
        full, which = median(costs["ekf"].steps), "median"
        if len(costs["ekf"].steps) == len(costs["compressed"].steps):
            full, which = max(costs["ekf"].steps), "worst"
        for name in ("compressed", "compressed invariant"):
            ratio = max(costs[name].steps) / full
            judge(f"{count}, worst of {name} / {which} of ekf", ratio, 2)


def judge_all(near: dict[int, dict[str, Costs]], far: dict[str, Costs]) -> None:
    """Print the ratios with their goals."""
    for count, costs in near.items():
        if "floor" in costs and count >= 500:
            floor = median(costs["floor"].steps)
            for name in ("ekf", WITH_DSYRK):
                share = median(costs[name].steps) / floor
                judge(f"{count} landmarks, {name} / floor", share, 3)
    costs = near[1000]
    compressed, usual = costs["compressed"].steps, costs["ekf"].steps
    judge("1000, mean, compressed / ekf", mean(compressed) / mean(usual), 0.2)
    judge_worst(near)
    for full in ("ekf", WITH_DSYRK):
        jumps = median(far["compressed"].steps) / median(far[full].steps)
        judge(f"1000, jumping about, compressed / {full}", jumps, 1.3)
    if "GTSAM iSAM2" in near[1000]:
        isam = mean(near[1000]["GTSAM iSAM2"].steps)
        judge("1000, mean, compressed / iSAM2", mean(compressed) / isam, 0.5)
    largest = max(near)
    growth = median(near[largest]["compressed"].steps) / median(compressed)
    judge(f"median, {largest} landmarks / 1000", growth, 1.3)


def draw(near: dict[int, dict[str, Costs]], path: Path) -> None:
    """Draw cost per step and memory against the size of the map."""
    mpl.use("Agg")
    figure, (left, right) = plt.subplots(1, 2, figsize=(10, 4), layout="constrained")
    styles: list[tuple[str, str, Callable[[list[float]], float], str]] = [
        ("ekf", "ekf", median, "C3-o"),
        (WITH_DSYRK, WITH_DSYRK, median, "C1-o"),
        ("GTSAM iSAM2", "GTSAM iSAM2, mean", mean, "C2-o"),
        ("compressed", "compressed, worst step", max, "C0:"),
        ("compressed", "compressed, mean", mean, "C0-o"),
        ("compressed", "compressed, median", median, "C0--"),
    ]
    for name, label, of, style in styles:
        counts = [count for count, costs in near.items() if name in costs]
        if not counts:  # GTSAM is not installed
            continue
        values = [1e3 * of(near[count][name].steps) for count in counts]
        left.loglog(counts, values, style, label=label, markersize=3)
    left.set(xlabel="landmarks in the map", ylabel="CPU time per step [ms]")
    left.legend(fontsize=8)
    counts = list(near)
    stored = [near[count]["compressed"].nbytes / 1e6 for count in counts]
    square = [8 * (3 + 2 * count) ** 2 / 1e6 for count in counts]
    right.loglog(counts, square, "C3-", label="a full covariance")
    right.loglog(counts, stored, "C0-o", label="compressed", markersize=3)
    right.set(xlabel="landmarks in the map", ylabel="memory [MB]")
    right.legend(fontsize=8)
    figure.savefig(path, dpi=110)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--largest", type=int, default=4000, help="landmarks")
    parser.add_argument("--steps", type=int, default=420)
    parser.add_argument("--markdown", action="store_true")
    parser.add_argument("--figure", type=Path, help="where to draw the curves")
    parser.add_argument(
        "--overview", action="store_true", help="the filters for large maps, compared"
    )
    parser.add_argument(
        "--sizes", type=int, nargs="+", default=SIZES, help="of the overview"
    )
    chosen = parser.parse_args()
    if chosen.overview:
        if min(chosen.sizes) < SMALLEST:
            parser.error(f"--sizes must be >= {SMALLEST}, got {min(chosen.sizes)}")
        show_overview(chosen.sizes, markdown=chosen.markdown, figure=chosen.figure)
        return
    sizes = [
        n
        for n in (100, 200, 300, 500, 750, 1000, 2000, 3000, 4000)
        if n < chosen.largest
    ]
    near: dict[int, dict[str, Costs]] = {}
    for count in [*sizes, chosen.largest]:
        near[count] = compare(count, chosen.steps)
        rows = [row(name, costs) for name, costs in near[count].items()]
        show(f"{count} landmarks", rows, markdown=chosen.markdown)
    far = compare(1000, 6 * STRETCH, jumping=True)
    rows = [row(name, costs) for name, costs in far.items()]
    title = "1000 landmarks, ten of them anywhere seen in each step"
    show(title, rows, markdown=chosen.markdown)
    judge_all(near, far)
    judge_beliefs(REPEATED)
    if chosen.figure:
        draw(near, chosen.figure)


if __name__ == "__main__":
    main()
