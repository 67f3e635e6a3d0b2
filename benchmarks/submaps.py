"""Submaps on maps that grow to 100,000 landmarks: time, memory, error, NEES.

    python benchmarks/submaps.py                          # to 10,000; half a minute
    python benchmarks/submaps.py --largest 100000         # … and to 100,000; minutes
    python benchmarks/submaps.py --folder /tmp/submaps    # closed submaps on disk
    python benchmarks/submaps.py --markdown               # … for a document
    python benchmarks/submaps.py --nees 30                # consistency, over 30 runs

The robot drives 2 m per step, row by row, over a square with one landmark per 25 m²,
and sees the ten nearest in every step.  Each row sees landmarks of the row before.  At
the end, the map is joined and compared with the truth: NEES per degree of freedom (1 is
expected) of a hundred landmarks and the pose.  Times are CPU times of one thread;
memory is that of the filter, and the largest of the process so far.
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import math
import resource
import sys
import time
from collections.abc import Callable, Iterator
from copy import deepcopy
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

import numpy as np
from interleaved import verdict
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table
from scipy.spatial import KDTree

from slamgym.estimator.large_maps.submaps.submap_slam import SubmapSlam
from slamgym.estimator.models.bearing_range import predict_measurement
from slamgym.estimator.models.motions import predict_pose
from slamgym.experiments.monte_carlo_study import monte_carlo

Array = NDArray[np.float64]
Int = NDArray[np.int64]

MOTION_STD, MEASUREMENT_STD = np.array([0.04, 0.02, 0.01]), np.array([0.01, 0.05])
SEEN, STEP, ROWS_APART = 10, 2.0, 14.0
SIZES = (1_000, 2_000, 3_000, 10_000, 30_000, 100_000)
GOALS = {1_000: 50.0, 2_000: 200.0}  # ms, of the first belief of all landmarks
GROWTH = 2.0  # exponent of its time
CONSOLE = Console(width=140)


class Reading(NamedTuple):
    """The input of one step, and the position of the robot after it."""

    odometry: tuple[float, float]
    readings: Array
    ids: Int
    pose: Array


class Row(NamedTuple):
    """The results for one size of the map."""

    landmarks: int
    steps: int
    submaps: int
    median_first: float  # µs per step, in the first tenth of the drive
    median_last: float  # … in the last
    close: float  # ms: the 99.9 % slowest step, which closes a submap
    local: float  # ms: local_belief()
    join: float  # s: the first belief of a few landmarks, which joins
    again: float  # ms: another
    first: float  # ms: the first belief of all landmarks, which joins
    whole: float  # ms: the belief of all landmarks, after the join
    filter_mb: float
    process_mb: float
    chain_error: float  # m, of the pose before joining
    pose_error: float  # m, joined
    landmark_rmse: float  # m, joined
    nees: float  # per degree of freedom, of the joined pose and 100 landmarks


def goals(half: float) -> Iterator[Array]:
    """Yield the ends of the rows, from the lower left corner upwards."""
    sign = 1.0
    for y in np.arange(-half, half, ROWS_APART):
        yield np.array([-sign * half, y])
        yield np.array([sign * half, y])
        sign = -sign


def drive(
    landmarks: Array, half: float, start: Array, *, seed: int = 1
) -> Iterator[Reading]:
    """Drive row by row; see the nearest landmarks."""
    rng, tree = np.random.default_rng(seed), KDTree(landmarks)
    pose = start.copy()
    for goal in goals(half):
        while np.hypot(*(goal - pose[:2])) > STEP:
            ahead = np.arctan2(*(goal - pose[:2])[::-1]) - pose[2]
            turn = np.clip((ahead + np.pi) % (2 * np.pi) - np.pi, -0.7, 0.7)
            motion = predict_pose(
                pose, np.array([STEP if abs(turn) < 0.3 else 0.5, turn])
            )
            slip = MOTION_STD * rng.standard_normal(3)
            odometry = (STEP if abs(turn) < 0.3 else 0.5, float(turn))
            pose = motion.pose + motion.jacobian_noise @ slip
            ids = np.asarray(tree.query(pose[:2], SEEN)[1])
            readings = predict_measurement(pose, landmarks[ids]).measurement
            readings += MEASUREMENT_STD * rng.standard_normal(readings.shape)
            usable = readings[:, 1] > 0.5
            yield Reading(odometry, readings[usable], ids[usable], pose)


def measure(count: int, size: int, folder: Path | None) -> Row:
    """Drive over a map of ``count`` landmarks."""
    half = np.sqrt(25.0 * count) / 2
    landmarks = np.random.default_rng(0).uniform(-half, half, (count, 2))
    start = np.array([-half, -half, 0.0])
    slam = SubmapSlam(
        MOTION_STD,
        MEASUREMENT_STD,
        initial_pose=start,
        submap_size=size,
        folder=None if folder is None else folder / str(count),
    )
    times, pose = [], start
    for step in drive(landmarks, half, start):
        began = time.thread_time()
        slam.predict(step.odometry)
        slam.update(step.readings, step.ids)
        times.append(time.thread_time() - began)
        pose = step.pose
    return _row(slam, times, pose, landmarks)


def _row(slam: SubmapSlam, times: list[float], pose: Array, landmarks: Array) -> Row:
    began = time.thread_time()
    local = slam.local_belief()
    at_once = time.thread_time() - began
    known = np.array(slam.landmark_ids)
    some = np.random.default_rng(2).choice(known, 100, replace=False)
    first = whole = np.nan
    if len(known) <= slam.belief_limit:
        # A copy has joined nothing; the first one also compiles, and takes new memory.
        first = median([seconds(deepcopy(slam).belief) for _ in range(3)])
    began = time.thread_time()
    belief = slam.belief(some)
    joining = time.thread_time() - began
    again = seconds(lambda: slam.belief(some))
    if len(known) <= slam.belief_limit:
        whole = seconds(slam.belief)
    error = belief.error(pose, landmarks[some])
    nees = error @ np.linalg.solve(belief.error_covariance(), error) / len(error)
    nbytes = slam.nbytes
    tenth = len(times) // 10
    return Row(
        len(known),
        len(times),
        slam.closed_count,
        1e6 * median(times[:tenth]),
        1e6 * median(times[-tenth:]),
        1e3 * float(np.quantile(times, 0.999)),
        1e3 * at_once,
        joining,
        1e3 * again,
        1e3 * first,
        1e3 * whole,
        nbytes / 1e6,
        _largest_memory(),
        float(np.hypot(*(local.pose - pose)[:2])),
        float(np.hypot(*(belief.pose - pose)[:2])),
        float(np.sqrt(((belief.landmarks - landmarks[some]) ** 2).sum(1).mean())),
        float(nees),
    )


def seconds(call: Callable[[], object]) -> float:
    """Return the CPU time of a call."""
    began = time.thread_time()
    call()
    return time.thread_time() - began


def judge(rows: list[Row]) -> None:
    """Print the times of the first belief beside their goals."""
    found = {n: row.first for n in GOALS for row in rows if abs(row.landmarks - n) < 50}
    for size, most in GOALS.items():
        if size in found:
            said = verdict(found[size], most, at_least=False)
            print(f"{size}, first belief(): {found[size]:.0f} ms (<= {most:g}: {said})")
    if len(found) > 1:
        small, large = GOALS
        power = math.log(found[large] / found[small]) / math.log(large / small)
        said = verdict(power, GROWTH, at_least=False)
        print(f"growth with the size: n^{power:.2f} (<= {GROWTH:g}: {said})")


def _largest_memory() -> float:
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e6


FILTERS: dict[str, tuple[Any, dict[str, Any]]] = {
    "ekf": ("ekf", {}),
    "invariant": ("invariant", {}),
    "submaps of 8": (SubmapSlam, {"submap_size": 8}),
    "submaps to 0.1 rad": (SubmapSlam, {"heading_limit": 0.1}),
    "submaps of 8, ekf": (SubmapSlam, {"submap_size": 8, "base": "ekf"}),
}
COLUMNS = (
    ("landmarks", "{:d}"),
    ("steps", "{:d}"),
    ("submaps", "{:d}"),
    ("first steps, µs", "{:.0f}"),
    ("last steps, µs", "{:.0f}"),
    ("99.9 %, ms", "{:.1f}"),
    ("local belief, ms", "{:.2f}"),
    ("join, s", "{:.2f}"),
    ("again, ms", "{:.0f}"),
    ("first all, ms", "{:.0f}"),
    ("all, ms", "{:.0f}"),
    ("filter, MB", "{:.0f}"),
    ("process, MB", "{:.0f}"),
    ("chain's error, m", "{:.2f}"),
    ("joined, m", "{:.2f}"),
    ("landmarks, m", "{:.2f}"),
    ("NEES / dof", "{:.2f}"),
)


def show(rows: list[Row], *, markdown: bool) -> None:
    """Print the table of costs."""
    cells = [
        [form.format(value) for (_, form), value in zip(COLUMNS, row, strict=True)]
        for row in rows
    ]
    print_table([name for name, _ in COLUMNS], cells, markdown=markdown)


def show_honesty(runs: int, *, markdown: bool) -> None:
    """Print the NEES of submaps and of the full filters, on the same drives."""
    cells = []
    for scenario in ("loop", "six_landmarks"):
        results = monte_carlo(scenario, FILTERS, runs)
        for name in FILTERS:
            one = results.sel(estimator=name)
            pose = one.pose_nees_invariant.isel(step=slice(1, None)).mean("step") / 3
            position = one.position_error.isel(step=slice(1, None))
            measures = (
                pose.mean(),
                pose.median(),
                (one.state_nees_invariant / one.state_dof).mean(),
                (one.relative_map_nees / one.relative_map_dof).mean(),
                (position**2).mean() ** 0.5,
            )
            cells.append([scenario, name, *(f"{float(m):.2f}" for m in measures)])
    names = ["scenario", "filter", "pose", "median", "map", "relative map", "error, m"]
    print_table(names, cells, markdown=markdown)


def print_table(names: list[str], cells: list[list[str]], *, markdown: bool) -> None:
    """Print for a terminal, or for a document."""
    if markdown:
        for line in (names, ["---:"] * len(names), *cells):
            print("| " + " | ".join(line) + " |")
        return
    table = Table(*names)
    for line in cells:
        table.add_row(*line)
    CONSOLE.print(table)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--largest", type=int, default=10_000)
    parser.add_argument("--smallest", type=int, default=1_000)
    parser.add_argument("--submap-size", type=int, default=50)
    parser.add_argument("--folder", type=Path)
    parser.add_argument("--markdown", action="store_true")
    parser.add_argument("--nees", type=int, metavar="RUNS")
    given = parser.parse_args()
    if given.nees:
        show_honesty(given.nees, markdown=given.markdown)
        return
    sizes = [n for n in SIZES if given.smallest <= n <= given.largest]
    rows = [measure(n, given.submap_size, given.folder) for n in sizes]
    show(rows, markdown=given.markdown)
    judge(rows)


if __name__ == "__main__":
    main()
