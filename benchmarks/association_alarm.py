"""Count the lost runs that the alarm finds, and its false alarms.

    python benchmarks/association_alarm.py --runs 10
    python benchmarks/association_alarm.py --world coarse_loop --how nearest

Readings have no identity.  Where lost runs are rare, they are provoked: by a simpler
association, by odometry that misses 25 steps (kidnapped), by a motion noise three times
that of the filter and by gaps without scans.  A run is lost if its path error is more
than 1 m above that with known identities and NEES / 3 of its pose is above 3 on
average; it is sound if neither holds.  A run that meets both conditions is turned, not
lost, if the error of its path after the best rigid motion is at most 0.5 m above that
with known identities, also after its best rigid motion.  The first scans have then
rotated path and map together, and all later readings agree with both.  The intervals
are Wilson's 95 % intervals.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import numpy as np
from association import BAD_ERROR, METHODS, Scan, drive, make, worlds

from slamgym.evaluation import pose_nees, position_accuracy
from slamgym.sim_configs import Scenario, load_scenario

PRESETS = (
    "lost_loop look_alike active_hidden loop active_easy active_medium "
    "active_hard active_rooms active_uncertain dropout dense six_landmarks slippery "
    "unknown_heading fault_odometry_turn"
)
AWAY, GAP = 25, 60  # steps
OVERCONFIDENT = 3.0  # NEES / 3
TURNED_BY = 0.5  # m
SOUND, BETWEEN, BAD, TURNED = range(4)


def all_worlds() -> dict[str, Scenario]:
    """Return all worlds, without identities."""
    presets = {
        name: load_scenario(name).with_changes(sensor={"identities": False})
        for name in PRESETS.split()
    }
    return presets | worlds()


def noisier(world: Scenario, factor: float) -> Scenario:
    std = [factor * sigma for sigma in world.motion.std]
    return world.with_changes(motion={"std": std})


def without(scans: list[Scan], begin: float, steps: int, **gone: Any) -> list[Scan]:
    """Replace a part of the scans from a share of the drive on."""
    first = int(begin * len(scans))
    part = [scan._replace(**gone) for scan in scans[first : first + steps]]
    return scans[:first] + part + scans[first + steps :]


def kidnapped(scans: list[Scan]) -> list[Scan]:
    return without(scans, 0.6, AWAY, odometry=np.zeros(2))


def with_gaps(scans: list[Scan]) -> list[Scan]:
    once = without(scans, 0.3, GAP, readings=None)
    return without(once, 0.6, GAP, readings=None)


def same(scans: list[Scan]) -> list[Scan]:
    return scans


#: Method, factors of the noise of the world and of the filter, and what befalls scans.
HOW: dict[str, tuple[str, float, float, Callable[[list[Scan]], list[Scan]]]] = {
    "default": ("hypotheses", 1, 1, same),
    "nearest": ("nearest", 1, 1, same),
    "joint": ("joint", 1, 1, same),
    "kidnapped": ("hypotheses", 1, 1, kidnapped),
    "gaps": ("hypotheses", 2, 2, with_gaps),
    "more noise": ("hypotheses", 4, 4, same),
    "wrong noise": ("hypotheses", 3, 1, same),
}
#: The worlds of each, without --world and --how; "default" takes all.
PROVOKED = {
    "nearest": ("coarse_loop", "loop, clutter", "slip60", "clutter5"),
    "joint": ("coarse_loop", "loop, clutter"),
    "kidnapped": ("hidden_identities", "corridor", "loop", "slip60", "active_hidden"),
    "gaps": ("hidden_identities", "corridor", "loop, clutter", "active_hidden"),
    "more noise": ("hidden_identities", "corridor", "active_hidden"),
    "wrong noise": ("hidden_identities", "corridor", "loop"),
}


class Followed(NamedTuple):
    """The result of one filter."""

    error: float  # of the path [m]
    aligned: float  # after the rigid motion that fits the path best [m]
    nees: float  # NEES / 3 of the pose


def follow(slam: Any, scans: list[Scan], *, known: bool) -> Followed:
    """Follow a drive, and compare the path with the true one."""
    beliefs = []
    for k, scan in enumerate(scans):
        if k:
            slam.predict(scan.odometry)
        if scan.readings is not None:
            real = scan.ids >= 0
            given = (scan.readings[real], scan.ids[real]) if known else (scan.readings,)
            slam.update(*given)
        beliefs.append(slam.belief(()))
    poses = np.array([belief.pose for belief in beliefs])
    truth = np.array([scan.pose for scan in scans])
    covariances = np.array([belief.pose_covariance for belief in beliefs])
    with np.errstate(all="ignore"):
        nees = pose_nees(truth, poses, covariances, frame=beliefs[0].frame)
    path = position_accuracy(poses[:, :2], truth[:, :2])
    return Followed(path.raw_rmse, path.aligned_rmse, float(np.nanmean(nees)) / 3)


def outcome(world: Scenario, how: str, seed: int) -> tuple[int, bool]:
    """Run a filter once; return what became of the run, and whether it is alarmed."""
    method, real, assumed, befalls = HOW[how]
    scans = befalls(drive(noisier(world, real), seed))
    assumed_world = noisier(world, assumed)
    known = follow(make(assumed_world), scans, known=True)
    slam: Any = make(assumed_world, management=METHODS[method])
    found = follow(slam, scans, known=False)
    is_worse = found.error > known.error + BAD_ERROR
    is_overconfident = not found.nees <= OVERCONFIDENT
    kind = BETWEEN if is_worse != is_overconfident else BAD if is_worse else SOUND
    if kind == BAD and found.aligned <= known.aligned + TURNED_BY:
        kind = TURNED
    numbers = f"{known.error:.2f} {found.error:.2f} m, aligned {known.aligned:.2f} "
    numbers += f"{found.aligned:.2f} m, {found.nees:.1f}, {slam.lost_score:.1f}"
    print(f"{seed} {world.name} {how}: {numbers}", file=sys.stderr)
    return kind, slam.probably_lost


def wilson(count: int, of: int, z: float = 1.96) -> str:
    """Write a share with its interval [%]."""
    if not of:
        return "–"
    share, spread = count / of, z**2 / of
    centre = (share + spread / 2) / (1 + spread)
    half = z / (1 + spread) * np.sqrt(share * (1 - share) / of + spread / of / 4)
    low, high = 100 * max(centre - half, 0.0), 100 * min(centre + half, 1.0)
    return f"{100 * share:.1f} ({low:.1f} to {high:.1f})"


def row(name: str, how: str, runs: Iterable[tuple[int, bool]]) -> str:
    kinds = BAD, SOUND, TURNED, BETWEEN
    found = [[a for kind, a in runs if kind == k] for k in kinds]
    cells = [f"{sum(alarms)} of {len(alarms)}" for alarms in found]
    return f"| {' | '.join([name, how, *cells])} |"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=10)
    parser.add_argument("--seed", type=int, default=5000)
    parser.add_argument("--world", nargs="+", choices=all_worlds())
    parser.add_argument("--how", nargs="+", choices=HOW)
    options = parser.parse_args()
    known = all_worlds()
    print("| world | how | alarms of lost runs | of sound | of turned | of others |")
    print("|---" * 6 + "|")
    every = []
    for how in options.how or HOW:
        for name in options.world or PROVOKED.get(how, known):
            seeds = range(options.seed, options.seed + options.runs)
            runs = [outcome(known[name], how, seed) for seed in seeds]
            every += runs
            print(row(name, how, runs), flush=True)
    print(row("all", "all", every))
    for title, kinds in {
        "lost runs found": (BAD,),
        "lost or turned runs found": (BAD, TURNED),
        "false alarms": (SOUND,),
    }.items():
        alarms = [alarm for kind, alarm in every if kind in kinds]
        count = f"{sum(alarms)} of {len(alarms)}"
        print(f"{title}: {count}, {wilson(sum(alarms), len(alarms))} %")


if __name__ == "__main__":
    main()
