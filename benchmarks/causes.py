"""How often `diagnose` names the right cause: a table of worlds and answers.

    python benchmarks/causes.py --repetitions 20

Every row is a world, without a fault or with one fault that its filter does not know.
In the last row, the filter reports 1 / 1.3 of its covariance.
Each fault changes the NEES by a factor of about 1.3. Each answer is based on the 100
runs of one Monte Carlo. The seeds differ from those with which the rules were
developed.
"""

from __future__ import annotations

import argparse
import dataclasses
from collections import Counter
from collections.abc import Mapping
from typing import Any, NamedTuple

import xarray as xr

from slamgym.argument_checks import LandmarkIds
from slamgym.estimator import Belief, InvariantEkfSlam
from slamgym.experiments.monte_carlo_study import monte_carlo, summarise_monte_carlo
from slamgym.sim_configs import Scenario, load_scenario

HONEST = "honest"


class ScaledInvariant(InvariantEkfSlam):
    """An invariant filter that reports 1 / 1.3 of its covariance."""

    def belief(self, landmark_ids: LandmarkIds | None = None) -> Belief:
        """Return the belief with a scaled covariance."""
        found = super().belief(landmark_ids)
        return dataclasses.replace(found, covariance=found.covariance / 1.3)


class World(NamedTuple):
    """A world, the assumptions of its filter, and the right answer."""

    cause: str
    scenario: str
    faults: Mapping[str, float] = {}
    assumed: Mapping[str, float] = {}
    """Factors on the deviations that the filter assumes: motion, bearing, range."""
    estimator: str = "invariant"
    changes: Mapping[str, Any] = {}
    title: str = ""
    """Of the world; its scenario where not given."""

    def scenarios(self) -> tuple[Scenario, Scenario]:
        """Return the world, and the world that the filter assumes."""
        nominal = load_scenario(self.scenario).with_changes(**self.changes)
        motion, bearing, distance = (
            self.assumed.get(key, 1.0) for key in ("motion", "bearing", "range")
        )
        bearing_std, range_std = nominal.sensor.std
        assumed = nominal.with_changes(
            motion={"std": [motion * std for std in nominal.motion.std]},
            sensor={"std": [bearing * bearing_std, distance * range_std]},
        )
        return nominal.with_changes(faults=dict(self.faults)), assumed


def hidden(scenario: str, gap: float = 0.0) -> dict[str, Any]:
    """Return the changes that hide identities, with pairs of landmarks if gap > 0 [m].

    The odometry is ten times as accurate.  In the middle of a pair, the readings of its
    landmarks are alike.
    """
    world = load_scenario(scenario)
    points = [
        [x + side * gap / 2, y]
        for x, y in world.model_dump()["landmarks"]["points"]
        for side in ((-1, 1) if gap else (0,))
    ]
    return {
        "sensor": {"identities": False},
        "motion": {"std": [std / 10 for std in world.motion.std]},
        "landmarks": {"points": points},
    }


NEAREST = 'invariant[management={association="nearest",confirm=[1,1]}]'
SHORT = {"steps": 250}
UNSURE = {"start": {"std": [0.02, 0.02, 0.05]}}
WORLDS = (
    World(HONEST, "six_landmarks"),
    World(HONEST, "anchored"),
    World(HONEST, "anchored", estimator="ekf"),
    World(HONEST, "dropout", changes={"steps": 100}),
    World(HONEST, "corridor", changes={"steps": 100}),
    World(HONEST, "loop", changes=SHORT),
    World("motion noise too small", "loop", assumed={"motion": 0.75}, changes=SHORT),
    World("motion noise too large", "loop", assumed={"motion": 1.35}, changes=SHORT),
    World("bearing noise too small", "anchored", assumed={"bearing": 0.8}),
    World("bearing noise too large", "anchored", assumed={"bearing": 1.3}),
    World("range noise too small", "anchored", assumed={"range": 0.75}),
    World("range noise too large", "anchored", assumed={"range": 1.5}),
    World("odometry scale", "anchored", {"odometry_scale": 0.15}),
    World("odometry turn", "loop", {"odometry_turn": 0.014}, changes=SHORT),
    World("bearing bias", "anchored", {"bearing_bias": 0.003}),
    World("range bias", "anchored", {"range_bias": 0.03}),
    World("heavy tails", "anchored", {"motion_dof": 3.5}),
    World("heavy tails", "anchored", {"sensor_dof": 8}),
    World("linearisation", "six_landmarks", estimator="ekf", changes=UNSURE),
    World("linearisation", "unknown_heading", estimator="ekf"),
    World(
        HONEST,
        "anchored",
        estimator=NEAREST,
        changes=hidden("anchored"),
        title="anchored, hidden",
    ),
    World(
        "association",
        "anchored",
        estimator=NEAREST,
        changes=hidden("anchored", 0.55),
        title="anchored, hidden, in pairs",
    ),
    World(
        "association",
        "six_landmarks",
        estimator=NEAREST,
        changes=hidden("six_landmarks", 0.5),
        title="six_landmarks, hidden, in pairs",
    ),
    World(
        "range noise too small",
        "anchored",
        assumed={"range": 0.75},
        estimator=NEAREST,
        changes=hidden("anchored"),
        title="anchored, hidden",
    ),
    World(
        "linearisation",
        "unknown_heading",
        estimator=NEAREST.replace("invariant", "ekf"),
        changes=hidden("unknown_heading"),
        title="unknown_heading, hidden",
    ),
    World(
        "wrong covariance",
        "anchored",
        estimator="causes:ScaledInvariant",
        title="anchored, scaled covariance",
    ),
)


def answers(
    world: World, runs: int, repetitions: int, seed: int
) -> tuple[Counter[str], float]:
    """Count the causes named in repeated Monte Carlos of a world; average NEES / 3."""
    scenario, assumed = world.scenarios()
    counts: Counter[str] = Counter()
    ratios = []
    for repetition in range(repetitions):
        first = seed + runs * repetition
        with monte_carlo(
            scenario, world.estimator, runs, first, assumed=assumed, small_noise=True
        ) as results:
            counts[cause_of(results)] += 1
            ratios.append(float(results.pose_nees_invariant[:, :, 1:].mean() / 3))
    return counts, sum(ratios) / len(ratios)


def cause_of(results: xr.Dataset) -> str:
    """Name the cause for the only estimator of a Monte Carlo."""
    (entry,) = summarise_monte_carlo(results)["estimators"].values()
    return str(entry["diagnosis"]["cause"])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=100)
    parser.add_argument("--repetitions", type=int, default=20)
    parser.add_argument("--seed", type=int, default=3_000_000)
    parser.add_argument("--causes", nargs="+", default=())
    arguments = parser.parse_args()
    print("| cause | world | filter | NEES / 3 | right | other answers |")
    print("|---|---|---|---|---|---|")
    for world in WORLDS:
        if arguments.causes and world.cause not in arguments.causes:
            continue
        counts, ratio = answers(
            world, arguments.runs, arguments.repetitions, arguments.seed
        )
        right = counts.pop(world.cause, 0)
        others = ", ".join(f"{cause} {n}" for cause, n in counts.most_common())
        share = f"{right} of {arguments.repetitions}"
        name = world.estimator.partition("[")[0].rpartition(":")[2]
        row = (world.cause, world.title or world.scenario, f"`{name}`", f"{ratio:.2f}")
        print(f"| {' | '.join((*row, share, others or '–'))} |", flush=True)


if __name__ == "__main__":
    main()
