"""Submaps on a map with hidden identities: association, cost, NEES.

    python benchmarks/submaps_hidden.py                     # 1000 and 3000; a minute
    python benchmarks/submaps_hidden.py --largest 10000     # … minutes
    python benchmarks/submaps_hidden.py --markdown          # … for a document

The drives are those of ``submaps.py``, without identities; landmark management
associates the readings. The true identities are known to the benchmark. It counts the
readings that are associated with a wrong landmark, and the landmarks that are in the
map twice. Times are CPU times of one thread. NEES is given per degree of freedom, so 1
is expected.
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import time
from statistics import median
from typing import NamedTuple, cast

import numpy as np
from submaps import MEASUREMENT_STD, MOTION_STD, SIZES, drive, print_table

from slamgym.estimator.interface import marginal_without_joining
from slamgym.estimator.large_maps.submaps.submap_slam import SubmapSlam
from slamgym.estimator.map_management.managed_slam import ManagedSlam


class Row(NamedTuple):
    """The results for one size of the map, with readings without identity."""

    landmarks: int  # in the map
    distinct: int  # of the world, that these are
    wrong: int  # readings taken for another landmark than before
    readings: int
    submaps: int
    median: float  # ms per step
    mean: float  # … with all joins
    worst: float
    nees: float  # of the position per degree of freedom, over all steps
    joined: float  # … of the joined pose and 100 landmarks, at the end
    pose_error: float  # m, joined


def measure(count: int, size: int) -> Row:
    """Drive over a map of ``count`` landmarks with hidden identities."""
    half = np.sqrt(25.0 * count) / 2
    landmarks = np.random.default_rng(0).uniform(-half, half, (count, 2))
    start = np.array([-half, -half, 0.0])
    slam = ManagedSlam(
        SubmapSlam,
        MOTION_STD,
        MEASUREMENT_STD,
        initial_pose=start,
        submap_size=size,
        management={"confirm": (2, 5)},
    )
    times: list[float] = []
    nees: list[float] = []
    taken_for: dict[int, int] = {}
    wrong = readings = 0
    pose = start
    for step in drive(landmarks, half, start):
        began = time.thread_time()
        slam.predict(step.odometry)
        report = slam.update(step.readings)
        times.append(1e3 * (time.thread_time() - began))
        pose = step.pose
        for i, truth in zip(report.row_ids, step.ids.tolist(), strict=True):
            readings += 1
            wrong += i is not None and taken_for.setdefault(i, truth) != truth
        position = marginal_without_joining(slam, ())
        error = position.pose[:2] - pose[:2]
        P = position.pose_covariance[:2, :2]
        nees.append(float(error @ np.linalg.solve(P, error)) / 2)
    known = slam.landmark_ids
    some = np.random.default_rng(2).choice(np.array(known), 100, replace=False)
    belief = slam.belief(some.tolist())
    error = belief.error(pose, landmarks[[taken_for[i] for i in some.tolist()]])
    joined = error @ np.linalg.solve(belief.error_covariance(), error) / len(error)
    return Row(
        len(known),
        len({taken_for[i] for i in known}),
        wrong,
        readings,
        cast(SubmapSlam, slam.filter).closed_count,
        median(times),
        float(np.mean(times)),
        max(times),
        float(np.mean(nees)),
        float(joined),
        float(np.hypot(*(belief.pose - pose)[:2])),
    )


COLUMNS = (
    ("landmarks", "{:d}"),
    ("of the world", "{:d}"),
    ("taken for another", "{:d}"),
    ("of readings", "{:d}"),
    ("submaps", "{:d}"),
    ("median, ms", "{:.2f}"),
    ("mean, ms", "{:.1f}"),
    ("worst, ms", "{:.0f}"),
    ("NEES / 2, each step", "{:.2f}"),
    ("NEES / dof, joined", "{:.2f}"),
    ("joined, m", "{:.2f}"),
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--largest", type=int, default=3_000)
    parser.add_argument("--submap-size", type=int, default=50)
    parser.add_argument("--markdown", action="store_true")
    given = parser.parse_args()
    measure(300, given.submap_size)  # compiles what is not yet
    rows = [measure(n, given.submap_size) for n in SIZES if n <= given.largest]
    cells = [
        [form.format(value) for (_, form), value in zip(COLUMNS, row, strict=True)]
        for row in rows
    ]
    print_table([name for name, _ in COLUMNS], cells, markdown=given.markdown)


if __name__ == "__main__":
    main()
