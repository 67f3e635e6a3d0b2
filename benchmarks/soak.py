"""Long runs: every filter, vector worlds, and a Monte Carlo whose workers are killed.

    python benchmarks/soak.py                                   # a minute
    python benchmarks/soak.py --steps 200000 --world-steps 10000000 --runs 10000
    python benchmarks/soak.py --parts filters --filters ekf submaps --steps 20000
    python benchmarks/soak.py --parts kills --runs 2000 --backends loky dask --every 3

Filters drive around a ring of landmarks and see those nearby; the ones behind are
removed, and come back with new identities in the next round, so that the size of the
map stays.  For each filter, the table lists the time per step and the memory of the
process after the first tenth and at the end, and whether all beliefs, looked at a
hundred times, were finite, symmetric and positive semidefinite.  Beside the time in the
last tenth stands that of a new filter in the same steps, since a shared machine is not
always equally fast.  A second run of the first tenth, saved and loaded half-way, must
end in the same digest.

The workers of a Monte Carlo are killed, one every few seconds; the same call then goes
on.  Its results must equal those of an undisturbed run, bit for bit.
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import hashlib
import multiprocessing
import sys
import tempfile
import time
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import psutil
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from slamgym.envs import LandmarkWorldVectorEnv
from slamgym.estimator import list_estimators, make_estimator
from slamgym.estimator.interface import restore
from slamgym.estimator.models.bearing_range import predict_measurement
from slamgym.estimator.models.motions import predict_pose
from slamgym.experiments.command_line.monte_carlo import connected
from slamgym.experiments.monte_carlo_study import monte_carlo
from slamgym.sim_configs import load_scenario

Array = NDArray[np.float64]
MOTION_STD, MEASUREMENT_STD = np.array([0.02, 0.01, 0.005]), np.array([0.01, 0.05])
RING, RADIUS, REACH, LEFT = 60, 30.0, 8.0, 45.0
SPEED, AHEAD = 0.5, 0.2  # [m] per step; the robot heads for a point ahead [rad]
LOOKS = 100
CONSOLE = Console(width=120)


class Step(NamedTuple):
    """Odometry, readings with their ids, the ids to remove, and the truth."""

    odometry: tuple[float, float]
    readings: Array
    ids: list[int]
    gone: list[int]
    pose: Array
    landmarks: dict[int, Array]


def drive(steps: int) -> Iterator[Step]:
    """Yield the steps of a drive around the ring."""
    rng = np.random.default_rng(1)
    at = 2 * np.pi * np.arange(RING) / RING
    ring = (RADIUS + 3 * np.cos(5 * at))[:, None] * np.stack(
        [np.cos(at), np.sin(at)], 1
    )
    pose, names, fresh = np.array([RADIUS, 0.0, np.pi / 2]), list(range(RING)), RING
    mapped: set[int] = set()
    for _ in range(steps):
        at_goal = np.arctan2(pose[1], pose[0]) + AHEAD
        way = RADIUS * np.array([np.cos(at_goal), np.sin(at_goal)]) - pose[:2]
        turn = (np.arctan2(way[1], way[0]) - pose[2] + np.pi) % (2 * np.pi) - np.pi
        odometry = SPEED, float(turn)
        motion = predict_pose(pose, np.array(odometry))
        pose = motion.pose + motion.jacobian_noise @ (MOTION_STD * rng.normal(size=3))
        away = np.hypot(*(ring - pose[:2]).T)
        near = np.flatnonzero(away < REACH)
        left = [int(i) for i in np.flatnonzero(away > LEFT) if names[i] in mapped]
        truth = dict(zip(names, ring, strict=True))
        gone = [names[i] for i in left]
        for i in left:
            names[i], fresh = fresh, fresh + 1
        ids = [names[i] for i in near]
        mapped = mapped.difference(gone).union(ids)
        readings = predict_measurement(pose, ring[near]).measurement
        readings = readings + MEASUREMENT_STD * rng.normal(size=readings.shape)
        yield Step(odometry, readings, ids, gone, pose, truth)


def timed(slam: Any, now: Step) -> float:
    """Let a filter do one step; return the seconds of it."""
    began = time.thread_time()
    advance(slam, now)
    return time.thread_time() - began


def advance(slam: Any, now: Step) -> None:
    """Let a filter do one step."""
    if hasattr(slam, "observe_truth"):
        slam.observe_truth(now.pose, now.landmarks)
    slam.predict(now.odometry)
    slam.update(now.readings, now.ids)
    if now.gone:
        slam.remove([i for i in now.gone if i in slam.landmark_ids])


def start(name: str, pose: Iterable[float] = (RADIUS, 0.0, np.pi / 2)) -> Any:
    """Make a filter, by default for the start of the drive."""
    return make_estimator(
        name,
        motion_std=MOTION_STD,
        measurement_std=MEASUREMENT_STD,
        initial_pose=tuple(pose),
    )


def digest(values: dict[str, Any]) -> str:
    """Return a digest of arrays by name."""
    whole = hashlib.sha256()
    for key in sorted(values):
        whole.update(key.encode() + np.asarray(values[key]).tobytes())
    return whole.hexdigest()[:12]


def memory() -> float:
    """Return the memory of this process [MB]."""
    return float(psutil.Process().memory_info().rss / 1e6)


def flaw_of(slam: Any) -> str:
    """Return what is wrong with a belief, if anything is."""
    belief = slam.belief()
    P = belief.covariance
    if not (np.isfinite(belief.mean).all() and np.isfinite(P).all()):
        return "not finite"
    if not np.array_equal(P, P.T):
        return f"asymmetric by {np.abs(P - P.T).max():.0e}"
    least = float(np.linalg.eigvalsh(P)[0])
    return f"eigenvalue {least:.0e}" if least < -1e-9 * np.trace(P) else ""


def soak_filter(name: str, steps: int) -> list[str]:
    """Drive one filter; return its row of the table."""
    slam, tenth, flaws = start(name), max(steps // 10, 1), set[str]()
    seconds, sizes = np.ones((2, steps)), np.ones(steps)  # ones: memory is used now
    early, first_memory, young = "", 0.0, None
    for k, now in enumerate(drive(steps)):
        if k >= steps - tenth:
            young = young or start(name, now.pose)
        if k % 2:  # the second of two filters finds the data in the processor's cache
            seconds[0, k] = timed(slam, now)
        seconds[1, k] = timed(young, now) if young else 0.0
        if not k % 2:
            seconds[0, k] = timed(slam, now)
        sizes[k] = len(slam.landmark_ids)
        if k % max(steps // LOOKS, 1) == 0:
            flaws.add(flaw_of(slam))
        if k + 1 == tenth:
            early, first_memory = digest(slam.state_dict()), memory()
    again = "equal" if early == resumed(name, tenth) else "DIFFERS"
    return [
        name,
        f"{steps:,}",
        f"{np.median(sizes):.0f}",
        f"{1e6 * np.median(seconds[0, tenth // 2 : tenth]):.0f}",
        f"{1e6 * np.median(seconds[0, -tenth // 2 :]):.0f}",
        f"{1e6 * np.median(seconds[1, -tenth // 2 :]):.0f}",
        f"{first_memory:.0f}",
        f"{100 * (memory() / first_memory - 1):+.1f} %",
        "; ".join(sorted(flaws - {""})) or "none",
        again,
    ]


def resumed(name: str, steps: int) -> str:
    """Drive again, saved and loaded half-way; return the digest."""
    slam = start(name)
    looks = max(10 * steps // LOOKS, 1)
    for k, now in enumerate(drive(steps)):
        if k == steps // 2:
            state, slam = slam.state_dict(), start(name)
            restore(slam, state)
        advance(slam, now)
        if k % looks == 0:
            slam.belief()
    return digest(slam.state_dict())


def soak_filters(names: list[str], steps: int) -> None:
    """Print the table of filters."""
    table = Table("filter", "steps", "size", "µs early", "late", "new", "MB early")
    for title in ("growth", "flaws", "resumed"):
        table.add_column(title)
    for name in names:
        table.add_row(*soak_filter(name, steps))
    CONSOLE.print(table)


def soak_worlds(total: int, worlds: int = 1000) -> None:
    """Step vector worlds; print time and memory of the first and last tenth."""
    env = LandmarkWorldVectorEnv(worlds, scenario="loop")
    env.reset(seed=0)
    actions = np.tile([0.5, 0.1], (worlds, 1))
    steps = max(total // worlds, 10)
    tenth, seconds, first, finite = steps // 10, np.zeros(steps), 0.0, True
    for k in range(steps):
        began = time.thread_time()
        env.step(actions)
        seconds[k] = time.thread_time() - began
        finite &= bool(np.isfinite(env.unwrapped.poses).all())
        if k + 1 == tenth:
            first = memory()
    early, late = (
        1e9 * np.median(s) / worlds for s in (seconds[:tenth], seconds[-tenth:])
    )
    CONSOLE.print(
        f"vector worlds: {steps * worlds:,} world-steps, {early:.0f} ns each in the "
        f"first tenth, {late:.0f} in the last; memory {first:.0f} MB "
        f"{100 * (memory() / first - 1):+.1f} %; {'finite' if finite else 'NOT FINITE'}"
    )


def soak_kills(backend: str, runs: int, every: float) -> None:
    """Kill a worker every few seconds; print how many, and whether results agree."""
    with tempfile.TemporaryDirectory() as folder:
        whole = digest_of_runs(Path(folder) / "whole", runs, jobs=None, backend=None)
        target, kills, calls = Path(folder) / "killed", 0, 0
        while True:
            calls += 1
            arguments = (target, runs, backend)
            job = multiprocessing.get_context("fork").Process(
                target=attempt, args=arguments
            )
            job.start()
            kills += kill_workers(job, target, every)
            if job.exitcode == 0:
                break
        found = digest_of_runs(target, runs, jobs=None, backend=None)
    same = "equal" if found == whole else "DIFFER"
    CONSOLE.print(
        f"{backend}: {runs:,} runs, {kills} workers killed, {calls} calls; results "
        f"{same} those of an undisturbed run ({found}, {whole})"
    )


def attempt(target: Path, runs: int, backend: str) -> None:
    """Compute what is missing, in a process of its own; exit with 1 if it fails."""
    with open(os.devnull, "w") as nowhere:
        sys.stderr = nowhere
        try:
            digest_of_runs(target, runs, jobs=2, backend=backend)
        except OSError:
            sys.exit(1)


def digest_of_runs(
    target: Path, runs: int, *, jobs: int | None, backend: str | None
) -> str:
    """Compute or load the runs of a Monte Carlo; return the digest of its results."""
    world = load_scenario("six_landmarks")
    options: dict[str, Any] = {"jobs": jobs, "backend": backend, "block_size": 8}
    with connected(backend, None, 2):
        results = monte_carlo(world, "ekf,invariant", runs, out=target, **options)
    with results:
        return digest({str(n): v.to_numpy() for n, v in results.data_vars.items()})


def kill_workers(job: Any, target: Path, every: float) -> int:
    """Kill a worker every few seconds, if a result is new; return how many."""
    kills, rng = 0, np.random.default_rng()
    while job.is_alive():
        stored = len(list(target.rglob("*.npz")))
        job.join(every * (0.5 + rng.random()))
        while job.is_alive() and len(list(target.rglob("*.npz"))) <= stored:
            job.join(0.1)
        try:
            children = psutil.Process(job.pid).children(recursive=True)
        except psutil.NoSuchProcess:
            break
        workers = [c for c in children if is_worker(c)]
        if job.is_alive() and workers:
            workers[rng.integers(len(workers))].kill()
            kills += 1
    job.join()
    return kills


def is_worker(process: psutil.Process) -> bool:
    """Whether a process computes runs: of loky or Dask."""
    try:
        line = " ".join(process.cmdline())
    except psutil.Error:
        return False
    if "resource_tracker" in line:  # it serves them
        return False
    return any(word in line for word in ("LokyProcess", "spawn_main"))


def main() -> None:
    """Run the parts asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parts = ("filters", "worlds", "kills")
    parser.add_argument("--parts", nargs="+", choices=parts, default=parts)
    parser.add_argument("--filters", nargs="+", default=list(list_estimators()))
    parser.add_argument("--steps", type=int, default=1000, help="of each filter")
    parser.add_argument("--world-steps", type=int, default=200_000)
    parser.add_argument("--runs", type=int, default=400, help="of the Monte Carlo")
    parser.add_argument("--every", type=float, default=3.0, help="seconds to a kill")
    parser.add_argument("--backends", nargs="+", default=["loky"])
    arguments = parser.parse_args()
    if "filters" in arguments.parts:
        soak_filters(arguments.filters, arguments.steps)
    if "worlds" in arguments.parts:
        soak_worlds(arguments.world_steps)
    for backend in arguments.backends if "kills" in arguments.parts else ():
        soak_kills(backend, arguments.runs, arguments.every)


if __name__ == "__main__":
    main()
