"""Reference scores of active SLAM: everybody on the same maps, with 95 % intervals.

Run it::

    python benchmarks/active_slam.py --maps 100

Every baseline plays the episodes of the seeds 1,000,000 and up at each difficulty.  A
policy saved by ``examples/09_train_active_slam.py`` plays too where
``--policy SCENARIO=FILE`` names it.  A mean m of n episodes is given as m ± 1.96 s/√n.
"""

import argparse
import runpy
import time
from pathlib import Path

import numpy as np

from slamgym.agents import ActiveSlamEnv
from slamgym.agents.active_slam_baselines import BASELINES, make_baseline
from slamgym.agents.active_slam_scores import (
    HELD_OUT,
    Episode,
    Policy,
    driven_by,
    play_all,
    score_table,
)

LEVELS = ("active_easy", "active_medium", "active_hard")
TRAINING = Path(__file__).parents[1] / "examples" / "09_train_active_slam.py"


def score(scenario: str, maps: int, policy: str | None) -> dict[str, list[Episode]]:
    """Let everybody play the maps of one difficulty."""
    env = ActiveSlamEnv(scenario)
    players: dict[str, Policy] = {}
    for name in BASELINES:
        driver = make_baseline(name, env.scenario, np.random.default_rng(0))
        players[name] = driven_by(driver)
    if policy is not None:
        load_policy = runpy.run_path(str(TRAINING))["load_policy"]
        players["ppo"] = load_policy(Path(policy))
    seeds = range(HELD_OUT, HELD_OUT + maps)
    return {name: play_all(env, player, seeds) for name, player in players.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--maps", type=int, default=100)
    parser.add_argument("--level", choices=LEVELS, action="append")
    parser.add_argument(
        "--policy", metavar="SCENARIO=FILE", action="append", default=[]
    )
    given = parser.parse_args()
    policies = dict(each.split("=", 1) for each in given.policy)
    for scenario in given.level or LEVELS:
        began = time.perf_counter()
        played = score(scenario, given.maps, policies.get(scenario))
        took = time.perf_counter() - began
        print(f"{scenario}, {given.maps} maps ({took:.0f} s)\n{score_table(played)}\n")


if __name__ == "__main__":
    main()
