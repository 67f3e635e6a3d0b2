"""Close loops after long drift, with and without constellations, scored by the truth.

    python benchmarks/loop_closure.py --runs 10 --seed 7000

For each world and policy: the runs whose number of landmarks is within 5 % of those
that could be confirmed, the runs whose aligned path error is at most twice that with
known identities, and the runs with both; the mean size of the map, the median of the
ratio of path errors, the runs in which two different landmarks were merged, and the
time of a step.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator
from typing import Any, NamedTuple

import numpy as np
from association import Scan, drive, worlds

from slamgym.estimator import SlamEstimator, make_estimator
from slamgym.evaluation.trajectory_error import position_accuracy
from slamgym.sim_configs import Scenario, load_scenario

METHODS: dict[str, dict[str, Any]] = {
    "default": {},
    "nearest": {"association": "nearest", "constellations": False},
    "joint": {"association": "joint", "constellations": False},
    "nearest, constellations": {"association": "nearest", "constellations": True},
    "joint, constellations": {
        "association": "joint",
        "backdate": True,
        "constellations": True,
    },
}
CONFIRM = (3, 8)
OPTIONS: dict[str, dict[str, Any]] = {
    "compressed": {"base": "invariant"},
    "submaps": {"submap_size": 30},
}


class Outcome(NamedTuple):
    """The result of one run."""

    error: float
    """Root mean square error of the path after alignment [m]."""
    landmarks: int
    false_merges: int
    seconds: float


def scenarios() -> dict[str, Scenario]:
    """Return the worlds, all without identities."""
    coarse = load_scenario("coarse_loop").model_dump()
    coarse["sensor"]["identities"] = False
    others = worlds()
    return {
        "lost_loop": load_scenario("lost_loop"),
        "look_alike": load_scenario("look_alike"),
        **others,
        "coarse_loop": load_scenario(coarse),
    }


def make(world: Scenario, estimator: str, **options: Any) -> SlamEstimator:
    """Make a filter of a world."""
    return make_estimator(
        estimator,
        motion_std=world.motion.std,
        measurement_std=world.sensor.std,
        **world.models,
        initial_pose=world.start.pose,
        initial_pose_std=world.start.std,
        **OPTIONS.get(estimator, {}),
        **options,
    )


def confirmable(scans: Iterable[Scan]) -> int:
    """Count the landmarks that enough successive scans have shown."""
    needed, window = CONFIRM
    sightings = defaultdict[int, list[int]](list)
    found = set()
    for k, scan in enumerate(scans):
        for i in scan.ids[scan.ids >= 0].tolist():
            sightings[i] = [*(s for s in sightings[i] if s > k - window), k]
            if len(sightings[i]) >= needed:
                found.add(i)
    return len(found)


def known(slam: SlamEstimator, scans: list[Scan]) -> Iterator[tuple[Any, int]]:
    """Feed a drive to a filter, with identities; yield positions and false merges."""
    for k, scan in enumerate(scans):
        if k:
            slam.predict(scan.odometry)
        real = scan.ids >= 0
        slam.update(scan.readings[real], scan.ids[real].tolist())
        yield slam.belief([]).pose[:2], 0  # type: ignore[call-arg]


def hidden(slam: SlamEstimator, scans: list[Scan]) -> Iterator[tuple[Any, int]]:
    """Feed a drive to a filter, without identities.

    A landmark is the true one that most of its readings are of.
    """
    owners = defaultdict[int, Counter[int]](Counter)
    for k, scan in enumerate(scans):
        if k:
            slam.predict(scan.odometry)
        report = slam.update(scan.readings)
        for true, i in zip(scan.ids.tolist(), report.row_ids, strict=True):
            if i is not None:
                owners[i][true] += 1
        pairs = [[majority(owners[i]) for i in pair] for pair in report.merged_ids]
        yield slam.belief([]).pose[:2], sum(a != b for a, b in pairs)  # type: ignore[call-arg]


def majority(readings: Counter[int]) -> int | None:
    """Return the true landmark of most readings, None without any."""
    return readings.most_common(1)[0][0] if readings else None


def score(
    slam: SlamEstimator, scans: list[Scan], steps: Iterator[tuple[Any, int]]
) -> Outcome:
    """Score a run."""
    begin = time.process_time()
    positions, false = zip(*steps, strict=True)
    seconds = (time.process_time() - begin) / len(scans)
    true = [scan.pose[:2] for scan in scans]
    error = position_accuracy(np.array(positions), np.array(true)).aligned_rmse
    return Outcome(error, len(slam.belief().landmark_ids), sum(false), seconds)


def row(outcomes: list[Outcome], best: list[Outcome], true: list[int]) -> list[str]:
    """Return the cells of the table for one world and policy."""
    error, size, false, seconds = np.array(outcomes).T
    ratio = error / np.array([outcome.error for outcome in best])
    sized = np.abs(size - true) <= 0.05 * np.array(true)
    near = ratio <= 2
    shares = [f"{100 * np.mean(good):.0f} %" for good in (sized, near, sized & near)]
    merged = f"{int((false > 0).sum())} of {len(outcomes)}"
    sizes = f"{size.mean():.1f} of {np.mean(true):.1f}"
    milliseconds = f"{1e3 * np.median(seconds):.2f}"
    return [*shares, sizes, f"{np.median(ratio):.2f}", merged, milliseconds]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=10)
    parser.add_argument("--seed", type=int, default=7000)
    parser.add_argument("--estimator", default="invariant")
    parser.add_argument("--world", action="append", choices=list(scenarios()))
    parser.add_argument("--method", action="append", choices=list(METHODS))
    options = parser.parse_args()
    print("world | method | map | path | both | landmarks | ratio | false | ms a step")
    for name in options.world or ["lost_loop", "look_alike"]:
        world = scenarios()[name]
        drives = [drive(world, options.seed + i) for i in range(options.runs)]
        true = [confirmable(scans) for scans in drives]
        best = [
            score(slam, scans, known(slam, scans))
            for scans in drives
            for slam in [make(world, options.estimator)]
        ]
        for method in options.method or METHODS:
            policy = METHODS[method]
            outcomes = [
                score(slam, scans, hidden(slam, scans))
                for scans in drives
                for slam in [make(world, options.estimator, management=policy)]
            ]
            print(" | ".join([name, method, *row(outcomes, best, true)]), flush=True)


if __name__ == "__main__":
    main()
