"""Jobs that tests kill on their way, as functions for `forked.start`."""

import os
import signal
import time
from functools import partial
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from slamgym.experiments.command_line.cluster import connected
from slamgym.experiments.monte_carlo import monte_carlo, runner
from slamgym.experiments.monte_carlo.store import job_folder
from slamgym.experiments.trajectories.generate import generate_trajectories
from slamgym.sim_configs import load_scenario


def two_filters(folder):
    """Run a Monte Carlo in blocks of one run."""
    monte_carlo("six_landmarks", "ekf,invariant", 20, block_size=1, out=folder)


def episodes(folder, format):
    """Generate 24 shards of trajectories."""
    generate_trajectories(
        load_scenario("loop").with_changes(steps=200),
        folder,
        episodes=120,
        episodes_per_shard=5,
        controller="waypoints",
        format=format,
    )


def episodes_by_workers(folder, backend, jobs=2):
    """Generate 16 shards of trajectories by workers, on a cluster of their own."""
    with connected(backend, None, jobs):
        generate_trajectories(
            load_scenario("loop").with_changes(steps=200),
            folder,
            episodes=160,
            episodes_per_shard=10,
            jobs=jobs,
            backend=backend,
        )


def three_blocks(folder, dies_at, began=None):
    """Run a Monte Carlo of three blocks, and die at some place on the way.

    At ``"never"`` it stays after the first block, and sets the event ``began``.
    """
    job: dict[str, Any] = {"estimators": "ekf", "runs": 12, "block_size": 4}
    if dies_at == "workers":
        job |= {"progress": _die_after_a_block, "jobs": 2, "backend": "loky"}
    elif dies_at == "never":
        job |= {"progress": partial(_stay_after_a_block, began)}
    else:
        DIE_AT[dies_at]()
    monte_carlo("six_landmarks", out=folder, **job)


def _die_at_the_second_block():
    write = np.savez

    def savez(file, **arrays):
        if "runs-0000004" in file.name:
            _die(file)
        write(file, **arrays)

    np.savez = savez


def _die_at_the_job():
    replace = job_folder.replace_when_written

    def replace_when_written(path):
        with replace(path) as file:
            _die(file)

    job_folder.replace_when_written = replace_when_written


def _die_at_the_results():
    runner.write_results = lambda path, *_: _die(path.with_name(".results.0123abcd.nc"))


DIE_AT = {
    "job": _die_at_the_job,
    "block": _die_at_the_second_block,
    "results": _die_at_the_results,
}


def _die_after_a_block(done, _):
    if done:
        _die()


def _stay_after_a_block(began, done, _):
    if done:
        began.set()
        time.sleep(600)


def _die(half_written: Path | None = None) -> NoReturn:
    if half_written is not None:
        half_written.write_bytes(b"half a file")
    os.kill(os.getpid(), signal.SIGKILL)
    raise AssertionError("unreachable")
