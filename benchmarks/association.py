"""Associate readings without identity by several methods, and score them by the truth.

    python benchmarks/association.py --runs 10

For each world and method: the median error of the path with known and with hidden
identities, the lost runs (more than 1 m worse than with known identities), readings
given to a wrong landmark, landmarks mapped twice, the size of the map, and the time of
a step as a multiple of that of nearest neighbours.
"""

from __future__ import annotations

import argparse
import time
from typing import Any, NamedTuple

import numpy as np

from slamgym.envs import LandmarkWorldEnv
from slamgym.estimator import SlamEstimator, make_estimator
from slamgym.sim_configs import Scenario, action_sequence, load_scenario

METHODS: dict[str, dict[str, Any]] = {
    "nearest": {"association": "nearest"},
    "joint": {"association": "joint", "backdate": True},
    "hypotheses": {"association": "hypotheses", "backdate": True},
}
LOST = 1.0  # [m]


class Scan(NamedTuple):
    """What a filter gets in one step, and the truth."""

    odometry: np.ndarray[Any, Any]
    readings: np.ndarray[Any, Any]
    ids: np.ndarray[Any, Any]
    pose: np.ndarray[Any, Any]


class Outcome(NamedTuple):
    """What came of one run."""

    error: float
    wrong: int
    duplicates: int
    landmarks: int
    seconds: float


def worlds() -> dict[str, Scenario]:
    """Return the worlds, all without identities."""
    slippery = load_scenario("hidden_identities").model_dump()
    slippery["landmarks"] |= {"count": 60, "min_distance": 1.0}
    slippery["motion"]["std"] = (0.05, 0.0, 0.06)
    loop = load_scenario("loop").model_dump()
    loop["sensor"] |= {"identities": False, "clutter": 0.5, "max_clutter": 4}
    corridor = load_scenario("corridor").model_dump()
    corridor["sensor"]["identities"] = False
    return {
        "hidden_identities": load_scenario("hidden_identities"),
        "corridor": load_scenario(corridor),
        "slip60": load_scenario(slippery),
        "loop, clutter": load_scenario(loop),
    }


def drive(world: Scenario, seed: int) -> list[Scan]:
    """Drive the world's own controls."""
    env = LandmarkWorldEnv(world)
    observation, info = env.reset(seed=seed)
    scans = []
    for action in [*action_sequence(world), None]:
        mask = observation["mask"]
        ids = np.asarray(info["landmark_ids"])[: mask.sum()]
        readings = observation["landmarks"][mask]
        scans.append(Scan(observation["odometry"], readings, ids, info["pose"]))
        if action is not None:
            observation, *_, info = env.step(action)
    return scans


def make(world: Scenario, **options: Any) -> SlamEstimator:
    """Make the invariant filter of a world."""
    return make_estimator(
        "invariant",
        motion_std=world.motion.std,
        measurement_std=world.sensor.std,
        range_std_per_metre=world.sensor.range_std_per_metre,
        initial_pose=world.start.pose,
        initial_pose_std=world.start.std,
        **options,
    )


def follow(slam: SlamEstimator, scans: list[Scan], *, is_known: bool) -> Outcome:
    """Feed a drive to a filter and score it."""
    squared, owners = [], dict[int, int]()
    wrong = duplicates = 0
    seconds = 0.0
    for k, scan in enumerate(scans):
        begin = time.process_time()
        if k:
            slam.predict(scan.odometry)
        if is_known:
            real = scan.ids >= 0
            slam.update(scan.readings[real], scan.ids[real].tolist())
        else:
            row_ids = slam.update(scan.readings).row_ids
            for true, i in zip(scan.ids.tolist(), row_ids, strict=True):
                if i is not None and i not in owners:
                    duplicates += true >= 0 and true in owners.values()
                    owners[i] = true
                wrong += i is not None and owners[i] != true
        seconds += time.process_time() - begin
        squared.append(float(np.sum((slam.belief().pose - scan.pose)[:2] ** 2)))
    size = len(slam.belief().landmark_ids)
    error = float(np.sqrt(np.mean(squared)))
    return Outcome(error, wrong, duplicates, size, seconds / len(scans))


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=10)
    parser.add_argument("--seed", type=int, default=5000)
    options = parser.parse_args()
    for policy in METHODS.values():  # compile
        world = worlds()["corridor"]
        follow(make(world, management=policy), drive(world, 0)[:30], is_known=False)
    print(
        "world | method | known [m] | hidden [m] | lost | wrong | double | map | cost"
    )
    for name, world in worlds().items():
        scans = [drive(world, options.seed + i) for i in range(options.runs)]
        known = [follow(make(world), s, is_known=True).error for s in scans]
        base = 0.0
        for method, policy in METHODS.items():
            runs = [
                follow(make(world, management=policy), s, is_known=False) for s in scans
            ]
            error, wrong, double, size, seconds = np.array(runs).T
            base = base or float(seconds.mean())
            lost = int((error > np.array(known) + LOST).sum())
            row = [name, method, f"{np.median(known):.3f}", f"{np.median(error):.3f}"]
            row += [f"{lost} of {len(runs)}", f"{wrong.mean():.1f}"]
            row += [f"{double.mean():.2f}", f"{size.mean():.1f}"]
            print(" | ".join([*row, f"{seconds.mean() / base:.1f}"]), flush=True)


if __name__ == "__main__":
    main()
