"""Jobs that tests kill on their way, as functions for `forked.start`."""

import atexit
import hashlib
import itertools
import os
import signal
import tempfile
import time
from functools import partial
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import psutil

from slamgym.estimator.filters.ekf import EkfSlam
from slamgym.experiments.command_line.app import main
from slamgym.experiments.command_line.monte_carlo import connected
from slamgym.experiments.command_line.output_folder import output_folder
from slamgym.experiments.monte_carlo_study import monte_carlo, runner
from slamgym.experiments.monte_carlo_study import results as job_folder
from slamgym.experiments.trajectories.generate import generate_trajectories
from slamgym.sim_configs import load_scenario


def command(folder, *arguments):
    """Run a command in a folder, with its messages in the file ``messages`` beside.

    Its temporary files, such as results of workers, lie in the folder too.
    """
    os.chdir(folder)
    tempfile.tempdir = str(folder)
    messages = os.open(f"{folder}.messages", os.O_CREAT | os.O_WRONLY | os.O_TRUNC)
    for stream in (1, 2):
        os.dup2(messages, stream)
    # Of a parent in the background a child inherits that interrupts are ignored.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        main(arguments)
    finally:
        atexit._run_exitfuncs()  # as at the end of Python; a forked process has none


def command_in_a_kernel(folder, *arguments):
    """Run a command in a folder whose filters compute, at once and in one call.

    The call stands for a kernel or a large decomposition: it lasts for an hour, and
    Python cannot interrupt it. It begins when the file ``began`` appears.
    """
    EkfSlam.update = _compute_in_one_call
    command(folder, *arguments)


def _compute_in_one_call(*_):
    Path("began").touch()
    hashlib.pbkdf2_hmac("sha256", b"", b"", 2**31 - 1)
    raise AssertionError("unreachable")


def command_that_loses_a_worker(folder, *arguments):
    """Run a Monte Carlo in a folder; when its first block is there, a worker dies."""

    def savez(file, **arrays):
        np.savez = write
        (victim, *_) = (
            child
            for child in psutil.Process().children(recursive=True)
            if "spawn_main" in " ".join(child.cmdline())
        )
        victim.kill()
        Path(f"{folder}.victim").write_text(str(victim.pid))
        write(file, **arrays)

    # Only this job needs the module, and it loads matplotlib.
    from slamgym.experiments.monte_carlo_study import report as html_report

    write, np.savez = np.savez, savez
    html_report.report_figures = lambda *_: {}
    command(folder, *arguments)


def output_of(folder, files, calls):
    """Write an output folder, and die after some moves and removals of files."""
    done = itertools.count()

    def counted(call):
        def instead(*arguments, **options):
            if next(done) == calls:
                _die()
            return call(*arguments, **options)

        return instead

    with output_folder(folder) as staging:
        for name, text in files.items():
            (staging / name).parent.mkdir(exist_ok=True)
            (staging / name).write_text(text)
        for name in ("replace", "unlink"):
            setattr(Path, name, counted(getattr(Path, name)))


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
    tempfile.tempdir = str(Path(folder).parent)
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
