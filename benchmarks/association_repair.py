"""Repair the association of drives with hidden identities by the whole drive.

    python benchmarks/association_repair.py --runs 10
    python benchmarks/association_repair.py --world "loop, clutter" --hypotheses 1

For each run: the error of the path of the filter, of the smoother with the filter's
associations repaired and of the smoother with known identities; the size of the map
before and after; the score before and after; the readings that even the true pose and
map would assign wrongly; and the CPU time of the repair.  A run is bad if its error is
more than 1 m above that with known identities, of the filter or the smoother.
"""

from __future__ import annotations

import argparse
import time
from typing import Any

import numpy as np
from association import BAD_ERROR, Scan, drive, follow, make, worlds

from slamgym.estimator.models.sensors import BEARING_RANGE, Sensor
from slamgym.estimator.smoother import Drive, reassociate, smooth
from slamgym.estimator.smoother.batch_smoother import smooth_repaired
from slamgym.evaluation import oracle_errors
from slamgym.sim_configs import Scenario, load_scenario

OWN = 10**6  # identities from here on are of readings without a landmark


def sensor_of(world: Scenario) -> Sensor:
    growth = world.sensor.range_std_per_metre
    return BEARING_RANGE.with_noise(range_std_per_metre=growth)


def recorded(world: Scenario, scans: list[Scan], ids: list[Any]) -> Drive:
    """Record a drive; readings of None get an identity of their own."""
    made = Drive(
        world.motion.std,
        world.sensor.std,
        sensor=sensor_of(world),
        initial_pose=world.start.pose,
        initial_pose_std=world.start.std,
    )
    own = OWN
    for k, (scan, row_ids) in enumerate(zip(scans, ids, strict=True)):
        if k:
            made.predict(scan.odometry)
        named = []
        for i in row_ids:
            own += i is None
            named.append(own if i is None else i)
        made.update(scan.readings, named)
    return made


def error_of(poses: Any, scans: list[Scan]) -> float:
    """Return the root mean square error of the path [m]."""
    gaps = np.asarray(poses)[:, :2] - np.array([scan.pose[:2] for scan in scans])
    return float(np.sqrt((gaps**2).sum(axis=1).mean()))


def row_of(world: Scenario, seed: int, hypotheses: int) -> list[float]:
    """Return the entries of one run."""
    scans = drive(world, seed)
    known = follow(make(world), scans, is_known=True).error
    slam: Any = make(world, management={"hypotheses": hypotheses})
    filtered = follow(slam, scans).error
    made = recorded(world, scans, [scan.row_ids for scan in slam.decisions])
    begin = time.process_time()
    found = reassociate(made)
    seconds = time.process_time() - begin
    repaired = error_of(smooth_repaired(found).poses, scans)
    real = [scan.ids >= 0 for scan in scans]
    clean = [
        s._replace(readings=s.readings[r]) for s, r in zip(scans, real, strict=True)
    ]
    truth = recorded(world, clean, [s.ids[r] for s, r in zip(scans, real, strict=True)])
    least = error_of(smooth(truth).poses, scans)
    landmarks = {int(i) for scan in scans for i in scan.ids if i >= 0}
    points = np.array(getattr(world.landmarks, "points", [])).reshape(-1, 2)
    oracle = oracle_errors(
        np.array([scan.pose for scan in scans]),
        [scan.readings for scan in scans],
        [scan.ids for scan in scans],
        np.arange(len(points)),
        points,
        world.sensor.std,
        sensor=sensor_of(world),
    )
    sizes = len(slam.landmark_ids), len(found.drive.landmark_ids), len(landmarks)
    scores = found.first_score, found.score
    return [filtered, known, repaired, least, *sizes, *scores, oracle, seconds]


def main() -> None:
    """Print the table."""
    known = dict(worlds())
    for name in ("lost_loop", "look_alike"):
        data = load_scenario(name).model_dump()
        data["sensor"]["identities"] = False
        known[name] = load_scenario(data)
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--world", choices=known, default="coarse_loop")
    parser.add_argument("--runs", type=int, default=10)
    parser.add_argument("--seed", type=int, default=7000)
    parser.add_argument("--hypotheses", type=int, default=10)
    options = parser.parse_args()
    print(
        "| seed | filter [m] | known ids | repaired and smoothed | known ids | map "
        "| repaired | true | J | repaired | oracle's errors | CPU [s] |"
    )
    print("|---" * 12 + "|")
    rows = []
    for seed in range(options.seed, options.seed + options.runs):
        rows.append(row_of(known[options.world], seed, options.hypotheses))
        entries = " | ".join(f"{value:.4g}" for value in rows[-1])
        print(f"| {seed} | {entries} |", flush=True)
    table = np.array(rows)
    before = int((table[:, 0] > table[:, 1] + BAD_ERROR).sum())
    after = int((table[:, 2] > table[:, 3] + BAD_ERROR).sum())
    print(f"\nbad: {before} of {len(rows)}, repaired {after} of {len(rows)}")


if __name__ == "__main__":
    main()
