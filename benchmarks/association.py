"""Associate readings without identity by several methods, and score the decisions.

    python benchmarks/association.py --runs 10
    python benchmarks/association.py --world hidden_identities --methods hypotheses \
        "a third of the density" "three times the density"
    python benchmarks/association.py --world coarse_loop --resolution 1 --runs 100 \
        --methods "1 hypothesis" hypotheses

For each world and method, the table lists the median error of the path with known and
with hidden identities, the bad runs (more than 1 m worse than with known identities),
the readings assigned to a wrong landmark, the landmarks mapped twice, the size of the
map, precision and recall, and the time of a step as a multiple of that of the first
method.  The lines below the table compare the share of bad runs of each method with
that of the first one over the same drives: they state the difference with its 95 %
interval (Agresti and Min, Statistics in Medicine 24, 2005).  With ``--resolution R``,
true landmarks that are connected by gaps smaller than R [m] count as one.
"""

from __future__ import annotations

import argparse
import time
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from slamgym.envs import LandmarkWorldEnv
from slamgym.estimator import (
    LandmarkPolicy,
    ScanDecisions,
    SlamEstimator,
    make_estimator,
)
from slamgym.estimator.association.scan_assignments import Noise, assign_scan
from slamgym.estimator.interface import MapView
from slamgym.estimator.models.bearing_range import predict_measurement
from slamgym.evaluation import AssociationScores, places_of, score_association
from slamgym.sim_configs import Scenario, action_sequence, load_scenario

METHODS: dict[str, dict[str, Any]] = {
    "nearest": {"association": "nearest", "backdate": False},
    "compatibility": {"association": "compatibility"},
    "joint": {"association": "joint"},
    "hypotheses": {"association": "hypotheses"},
}
COUNTS = {
    "1 hypothesis": {"association": "hypotheses", "hypotheses": 1},
    "3 hypotheses": {"association": "hypotheses", "hypotheses": 3},
    "30 hypotheses": {"association": "hypotheses", "hypotheses": 30},
}
WRONG_DENSITIES = {"a third of the density": 1 / 3, "three times the density": 3.0}
"""Hypotheses with an assumed density of clutter that is wrong by this factor."""
BAD_ERROR = 1.0  # [m]
NOISE = Noise(0.02, 0.1)  # [rad, m]


class Scan(NamedTuple):
    """The input of a filter in one step, and the truth."""

    odometry: np.ndarray[Any, Any]
    readings: np.ndarray[Any, Any]
    ids: np.ndarray[Any, Any]
    places: np.ndarray[Any, Any]
    pose: np.ndarray[Any, Any]


class Outcome(NamedTuple):
    """The result of one run."""

    error: float
    seconds: float
    scores: AssociationScores


def worlds() -> dict[str, Scenario]:
    """Return the worlds, all without identities."""
    slippery = load_scenario("hidden_identities").model_dump()
    slippery["landmarks"] |= {"count": 60, "min_distance": 1.0}
    slippery["motion"]["std"] = (0.05, 0.0, 0.06)
    loop = load_scenario("loop").model_dump()
    loop["sensor"] |= {"identities": False, "clutter": 0.5, "max_clutter": 4}
    corridor = load_scenario("corridor").model_dump()
    corridor["sensor"]["identities"] = False
    cluttered = load_scenario("hidden_identities").model_dump()
    cluttered["sensor"] |= {"clutter": 5.0, "max_clutter": 16}
    coarse = load_scenario("coarse_loop").model_dump()
    coarse["sensor"]["identities"] = False
    city = load_scenario("city").model_dump() | {"steps": 600}
    city["sensor"] |= {"identities": False, "clutter": 0.3, "max_clutter": 4}
    return {
        "hidden_identities": load_scenario("hidden_identities"),
        "clutter5": load_scenario(cluttered),
        "city": load_scenario(city),
        "corridor": load_scenario(corridor),
        "slip60": load_scenario(slippery),
        "loop, clutter": load_scenario(loop),
        "coarse_loop": load_scenario(coarse),
    }


def policy_of(method: str, world: Scenario) -> dict[str, Any]:
    """Return the policy of a method, or that of a wrong density of clutter."""
    known = METHODS | COUNTS
    if method in known:
        return known[method]
    sensor = world.sensor
    area = sensor.field_of_view * (sensor.max_range - sensor.min_range)
    density = WRONG_DENSITIES[method] * max(sensor.clutter, 0.05) / area
    return METHODS["hypotheses"] | {"density": density}


def drive(world: Scenario, seed: int, resolution: float = 0.0) -> list[Scan]:
    """Drive the world's own controls."""
    env = LandmarkWorldEnv(world)
    observation, info = env.reset(seed=seed)
    places = places_of(range(len(env.landmarks)), env.landmarks, resolution)
    scans = []
    for action in [*action_sequence(world), None]:
        mask = observation["mask"]
        ids = np.asarray(info["landmark_ids"])[: mask.sum()]
        readings = observation["landmarks"][mask]
        place = np.array([places.get(i, i) for i in ids.tolist()], dtype=np.int64)
        scans.append(Scan(observation["odometry"], readings, ids, place, info["pose"]))
        if action is not None:
            observation, *_, info = env.step(action)
    return scans


def make(world: Scenario, **options: Any) -> SlamEstimator:
    """Make the invariant filter of a world."""
    return make_estimator(
        "invariant",
        motion_std=world.motion.std,
        measurement_std=world.sensor.std,
        **world.models,
        initial_pose=world.start.pose,
        initial_pose_std=world.start.std,
        **options,
    )


def follow(slam: Any, scans: list[Scan], *, is_known: bool = False) -> Outcome:
    """Feed a drive to a filter and score it."""
    squared, seconds = [], 0.0
    for k, scan in enumerate(scans):
        begin = time.process_time()
        if k:
            slam.predict(scan.odometry)
        if is_known:
            real = scan.ids >= 0
            slam.update(scan.readings[real], scan.ids[real].tolist())
        else:
            slam.update(scan.readings)
        seconds += time.process_time() - begin
        squared.append(float(np.sum((slam.map_view().mean[:2] - scan.pose[:2]) ** 2)))
    decisions = [ScanDecisions(tuple(scan.ids.tolist())) for scan in scans]
    scores = score_association(
        decisions if is_known else slam.decisions, [scan.places for scan in scans]
    )
    return Outcome(float(np.sqrt(np.mean(squared))), seconds / len(scans), scores)


def crowded_scan() -> float:
    """Return the time of a joint assignment of 12 readings to 60 landmarks [ms]."""
    rng = np.random.default_rng(1)
    landmarks, truth = rng.uniform(-8, 8, (60, 2)), np.array([0.3, -0.2, 0.1])
    root = rng.normal(scale=0.02, size=(123, 123))
    mean = np.append(np.zeros(3), landmarks)
    view = MapView(mean, root @ root.T, tuple(range(60)))
    readings = predict_measurement(truth, landmarks[:12]).measurement
    policy, density = LandmarkPolicy(association="joint"), np.full(12, 0.01)
    times = []
    for _ in range(50):
        begin = time.perf_counter()
        assign_scan(policy, view, readings, NOISE, density)
        times.append(time.perf_counter() - begin)
    return 1e3 * float(np.median(times))


def difference(bad: NDArray[np.bool_], of_first: NDArray[np.bool_]) -> str:
    """Return how many more runs are bad than with the first method, in percent.

    The 95 % interval of this difference follows in brackets.
    """
    more, fewer = (bad & ~of_first).sum() + 0.5, (of_first & ~bad).sum() + 0.5
    runs = len(bad) + 2
    share = (more - fewer) / runs
    half = 1.96 * np.sqrt(more + fewer - (more - fewer) ** 2 / runs) / runs
    low, high = 100 * (share - half), 100 * (share + half)
    return f"{100 * (bad.mean() - of_first.mean()):.0f} ({low:.0f} to {high:.0f})"


def row_of(runs: list[Outcome], bad: NDArray[np.bool_], base: float) -> list[str]:
    """Return the entries of the table for one world and method."""
    errors = [run.error for run in runs]
    seconds = float(np.mean([run.seconds for run in runs]))
    scores = {
        name: float(np.mean([run.scores.as_dict()[name] for run in runs]))
        for name in ("wrong", "duplicate", "map_size", "precision", "recall")
    }
    return [
        f"{np.median(errors):.3f}",
        f"{bad.sum()} of {len(runs)}",
        f"{scores['wrong']:.1f}",
        f"{scores['duplicate']:.2f}",
        f"{scores['map_size']:.1f}",
        f"{scores['precision']:.3f}",
        f"{scores['recall']:.3f}",
        f"{1e3 * seconds:.2f}",
        f"{seconds / base:.1f}",
    ]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=10)
    parser.add_argument("--seed", type=int, default=5000)
    parser.add_argument("--world", action="append", choices=worlds())
    parser.add_argument("--resolution", type=float, default=0.0)
    names = [*METHODS, *COUNTS, *WRONG_DENSITIES]
    parser.add_argument("--methods", nargs="+", choices=names, default=list(METHODS))
    options = parser.parse_args()
    for method in options.methods:  # compile
        world = worlds()["corridor"]
        follow(make(world, management=policy_of(method, world)), drive(world, 0)[:30])
    print(f"12 readings against 60 landmarks, joint: {crowded_scan():.2f} ms\n")
    print(
        "| world | method | known ids [m] | error [m] | bad | wrong | duplicate "
        "| map | precision | recall | ms a step | of the first |"
    )
    print("|---" * 12 + "|")
    compared = []
    for name in options.world or worlds():
        world = worlds()[name]
        seeds = range(options.seed, options.seed + options.runs)
        scans = [drive(world, seed, options.resolution) for seed in seeds]
        known = [follow(make(world), s, is_known=True).error for s in scans]
        base, bad, median = 0.0, {}, f"{np.median(known):.3f}"
        for method in options.methods:
            policy = policy_of(method, world)
            runs = [follow(make(world, management=policy), s) for s in scans]
            base = base or float(np.mean([run.seconds for run in runs]))
            errors = np.array([run.error for run in runs])
            bad[method] = errors > np.array(known) + BAD_ERROR
            row = " | ".join([name, method, median, *row_of(runs, bad[method], base)])
            print(f"| {row} |", flush=True)
        first, *others = options.methods
        compared += [
            f"{name}: bad runs of {other} less those of {first} [%]: "
            f"{difference(bad[other], bad[first])}"
            for other in others
        ]
    print("", *compared, sep="\n")


if __name__ == "__main__":
    main()
