"""Reference scores of active SLAM: all policies on the same maps, with 95 % intervals.

Run it::

    python benchmarks/active_slam.py --maps 100

Every baseline plays the episodes of the seeds from `HELD_OUT` on, at each difficulty.
These maps are for the final evaluation only; use ``--validation`` to choose between
policies. ``--policy SCENARIO=FILE`` adds a policy of ``benchmarks/learning.py`` or
``examples/09_train_active_slam.py``, and compares it with the others map by map. A mean
m of n episodes is given as m ± 1.96 s/√n.
"""

import argparse
import runpy
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from learning import load_actor

from slamgym.agents import ActiveSlamEnv
from slamgym.agents.active_slam_baselines import BASELINES, make_baseline
from slamgym.agents.active_slam_scores import (
    HELD_OUT,
    VALIDATION,
    Episode,
    Policy,
    baseline_policy,
    difference_lines,
    run_episodes,
    score_table,
)

LEVELS = (
    "active_easy",
    "active_medium",
    "active_hard",
    "active_uncertain",
    "active_rooms",
    "active_hidden",
)
TRAINING = Path(__file__).parents[1] / "examples" / "09_train_active_slam.py"


def load_policy(path: Path) -> Policy:
    """Read a policy of `learning`, or of the example that trains."""
    if path.suffix == ".npz":
        return load_actor(path)
    policy: Policy = runpy.run_path(str(TRAINING))["load_policy"](path)
    return policy


def score(
    scenario: str,
    seeds: range,
    names: Sequence[str],
    policy: str | None,
    estimator: str,
) -> dict[str, list[Episode]]:
    """Run the baselines and a policy on the maps of one difficulty."""
    env = ActiveSlamEnv(scenario, estimator=estimator)
    players: dict[str, Policy] = {}
    for name in names:
        baseline = make_baseline(name, env.scenario, np.random.default_rng(0))
        players[name] = baseline_policy(baseline)
    if policy is not None:
        players["ppo"] = load_policy(Path(policy))
    played = {}
    for name, player in players.items():
        began = time.thread_time()
        played[name] = run_episodes(env, player, seeds)
        steps = sum(episode.steps for episode in played[name])
        spent = 1e3 * (time.thread_time() - began) / steps
        print(f"{name}: {spent:.1f} ms a step, action and world", flush=True)
    return played


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--maps", type=int, default=100)
    parser.add_argument("--level", choices=LEVELS, action="append")
    parser.add_argument("--baseline", choices=BASELINES, action="append")
    parser.add_argument(
        "--estimator", action="append", help="filters inside (default: invariant)"
    )
    parser.add_argument(
        "--policy", metavar="SCENARIO=FILE", action="append", default=[]
    )
    parser.add_argument(
        "--validation", action="store_true", help="maps to choose by, not to judge by"
    )
    given = parser.parse_args()
    first = VALIDATION if given.validation else HELD_OUT
    seeds = range(first, first + given.maps)
    policies = dict(each.split("=", 1) for each in given.policy)
    for scenario in given.level or LEVELS:
        for estimator in given.estimator or ["invariant"]:
            began = time.perf_counter()
            names = given.baseline or BASELINES
            policy = policies.get(scenario)
            played = score(scenario, seeds, names, policy, estimator)
            took = time.perf_counter() - began
            print(f"{scenario}, {estimator}, {given.maps} maps ({took:.0f} s)")
            print(score_table(played))
            for name in ("mpc", "ppo"):
                if name in played:
                    print(f"{difference_lines(played, name)}\n")


if __name__ == "__main__":
    main()
