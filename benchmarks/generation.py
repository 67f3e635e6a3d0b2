"""How fast are trajectories generated, in units of a bare physics step.

    python benchmarks/generation.py             # a million steps to npz
    python benchmarks/generation.py --quick     # a tenth of it, and the other formats
    python benchmarks/generation.py --jobs      # what a second job gains

A bare step is `pymunk.Space.step` with one kinematic body. It is timed before, between
and after the cases, in CPU time of this process, which generates in one thread.

``--jobs`` compares, in wall time, ``slamgym generate loop --episodes 2000`` with one
and with two jobs, whose bytes must be equal, and with two processes that write half of
the episodes each and share nothing: no way to use two cores gains more than these.
"""

import os
import resource
import shutil
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from statistics import median

from interleaved import bare_steps
from rich.console import Console
from rich.table import Table
from second_core import two_processes

from slamgym.experiments.trajectories.formats import FORMATS, trajectory_format
from slamgym.experiments.trajectories.generate import generate_trajectories
from slamgym.experiments.trajectories.manifest import Manifest
from slamgym.sim_configs import Scenario, load_scenario

EPISODES = 2000  # of `loop`, for two jobs
ROUNDS = 3
GAIN = 1.7  # of two jobs, where two processes gain that
#: Bare steps per step: 150,000 and 100,000 steps/s where a bare step takes 1 / 1.5 M s.
GOALS = {"npz": 10.0, "slamlog": 15.0, "g2o": 15.0}
STEPS = 1000
BARE_STEPS = 300_000


def world() -> Scenario:
    layout = {"layout": "random", "count": 20, "bounds": [-10.0, -10.0, 10.0, 10.0]}
    return load_scenario("loop").with_changes(steps=STEPS, landmarks=layout)


def cpu_seconds(call: Callable[[], object]) -> float:
    began = time.process_time()
    call()
    return time.process_time() - began


def bare() -> float:
    """Measure the seconds of a bare step."""
    return cpu_seconds(bare_steps(BARE_STEPS)) / BARE_STEPS


def is_installed(name: str) -> bool:
    try:
        trajectory_format(name)
    except ImportError:
        return False
    return True


def cases(quick: bool) -> list[tuple[str, str, int, Scenario]]:
    """List (format, controller, episodes, scenario)."""
    plain, some = world(), 100
    ranges = {"motion_std": [0.5, 2.0], "start_x": [-1.0, 1.0]}
    if not quick:
        return [("npz", "waypoints", 1000, plain)]
    formats = [name for name in FORMATS if is_installed(name)]
    return [
        *[("npz", name, some, plain) for name in ("waypoints", "random", "open_loop")],
        ("npz", "waypoints", 10, plain.with_changes(randomise=ranges)),
        *[(name, "waypoints", some, plain) for name in formats if name != "npz"],
    ]


def half_of_the_episodes() -> Callable[[], object]:
    """Return the work of one of two processes that share nothing."""
    folder = tempfile.mkdtemp()

    def write() -> None:
        generate_trajectories("loop", folder, episodes=EPISODES // 2)
        shutil.rmtree(folder)

    return write


def seconds_with(jobs: int) -> tuple[float, Manifest]:
    """Generate with this many jobs, and return the wall time and the checksums."""
    with tempfile.TemporaryDirectory() as folder:
        began = time.perf_counter()
        manifest = generate_trajectories(
            "loop", folder, episodes=EPISODES, jobs=jobs if jobs > 1 else None
        )
        return time.perf_counter() - began, manifest


def compare_jobs() -> int:
    """Print what two jobs gain; return 1 if less than they could."""
    of_jobs, of_processes = [], []
    with two_processes(half_of_the_episodes) as both:
        for _ in range(ROUNDS):
            one, alone = seconds_with(1)
            two, shared = seconds_with(2)
            if alone != shared:
                raise SystemExit("two jobs wrote other bytes than one")
            of_jobs.append(one / two)
            of_processes.append(one / both())
    gain, possible = median(of_jobs), median(of_processes)
    missed = gain < GAIN <= possible
    word = "MISSED" if missed else "ok" if gain >= GAIN else "too busy to judge"
    print(
        f"loop, {EPISODES} episodes, equal bytes: two jobs gain {gain:.2f} × "
        f"(>= {GAIN} where two processes do: {word}); two processes that share nothing "
        f"gain {possible:.2f} ×; load {os.getloadavg()[0]:.1f}"
    )
    return int(missed)


def main() -> int:
    if "--jobs" in sys.argv:
        return compare_jobs()
    table = Table(title="generation of trajectories, 20 landmarks, 1000 steps each")
    for column in ("case", "steps", "µs", "× bare", "goal", "", "memory"):
        table.add_column(column, justify="left" if column == "case" else "right")
    missed = 0
    bares = [bare()]
    for name, controller, episodes, scenario in cases("--quick" in sys.argv):
        with tempfile.TemporaryDirectory() as folder:
            call = partial(
                generate_trajectories,
                scenario,
                folder,
                episodes=episodes,
                controller=controller,
                format=name,
            )
            seconds = cpu_seconds(call)
        bares.append(bare())
        per_step = seconds / (episodes * scenario.steps)
        times_bare = per_step / median(bares[-2:])
        goal = GOALS.get(name) if scenario.randomise is None else None
        word = ("ok" if times_bare <= goal else "MISSED") if goal else ""
        missed += word == "MISSED"
        memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
        ranges = ", ranges" if scenario.randomise else ""
        table.add_row(
            f"{name}, {controller}{ranges}",
            f"{episodes * scenario.steps:,}",
            f"{1e6 * per_step:.2f}",
            f"{times_bare:.1f}",
            f"<= {goal:.0f}" if goal else "",
            word,
            f"{memory:.0f} MB",
        )
    Console(width=100).print(table)
    return missed


if __name__ == "__main__":
    sys.exit(main())
