"""What commands do when they, or their workers, are told to end."""

import os
import signal
import time

import forked
import jobs_to_kill
import psutil
import pytest

from slamgym.experiments.command_line.errors import (
    TerminationError,
    interruptible,
    terminable,
)
from slamgym.experiments.command_line.output_folder import STAGING

pytestmark = pytest.mark.skipif(os.name == "nt", reason="signals are those of POSIX")

JOB = "monte-carlo six_landmarks -e ekf --runs 90000 --block-size 8 --jobs 2 --out out"
DATA_SET = "generate six_landmarks --episodes 90000 --shard 8 --out out"
GOES_ON = "the finished runs are in out, and the same command continues"


@pytest.fixture
def here(tmp_path):
    folder = tmp_path / "here"
    folder.mkdir()
    return folder


def begin(here, *arguments):
    return forked.start(jobs_to_kill.command, here, *arguments)


def message_at_the_end(child, here):
    """Wait for the end of a command, and return what it wrote."""
    child.join(60)
    return here.with_suffix(".messages").read_text()


def wait_until(happened):
    deadline = time.monotonic() + 120
    while not happened():
        assert time.monotonic() < deadline
        time.sleep(0.05)


def blocks_in(here):
    return len(list(here.glob("out/blocks/runs-*.npz")))


def many_runs(here):
    """Return a Monte Carlo on two workers that has results, and its processes."""
    child = begin(here, *JOB.split())
    wait_until(lambda: blocks_in(here) > 1)
    return child, psutil.Process(child.pid).children(recursive=True)


def workers_among(processes):
    names = {process: " ".join(process.cmdline()) for process in processes}
    return [p for p, name in names.items() if "popen_loky" in name]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)]
)
def test_an_ended_job_says_that_it_goes_on_and_leaves_no_process(here, number, code):
    child, processes = many_runs(here)
    assert len(workers_among(processes)) == 2
    os.kill(child.pid, number)
    message = message_at_the_end(child, here)
    assert child.exitcode == code
    assert f"slamgym: interrupted; {GOES_ON}\n" in message
    assert "Traceback" not in message
    _, alive = psutil.wait_procs(processes, timeout=10)
    assert alive == []


@pytest.mark.slow
@pytest.mark.parametrize(
    ("command", "made", "goes_on"),
    [
        (f"{DATA_SET} --jobs 2", "shard_*.npz", "whole shards stay in out"),
        (f"{JOB} --backend dask", "blocks/runs-*.npz", GOES_ON),
    ],
    ids=["generate", "dask"],
)
def test_a_scheduler_ends_workers_of_any_kind(here, command, made, goes_on):
    if "dask" in command:
        pytest.importorskip("distributed")
    child = begin(here, *command.split())
    wait_until(lambda: child.exitcode or len(list(here.glob(f"out/{made}"))) > 1)
    processes = psutil.Process(child.pid).children(recursive=True)
    child.terminate()
    message = message_at_the_end(child, here)
    assert child.exitcode == 143
    assert "slamgym: interrupted; " in message
    assert goes_on in message
    assert "Traceback" not in message
    _, alive = psutil.wait_procs(processes, timeout=10)
    assert alive == []


@pytest.mark.slow
def test_workers_end_when_the_process_that_engaged_them_is_killed(here):
    child, processes = many_runs(here)
    child.kill()
    child.join()
    _, alive = psutil.wait_procs(processes, timeout=20)
    assert alive == []


@pytest.mark.slow
def test_a_killed_worker_is_reported_with_how_to_go_on(here):
    child, processes = many_runs(here)
    first, second = workers_among(processes)
    first.terminate()  # in vain: the job ends its workers
    before = blocks_in(here)
    wait_until(lambda: blocks_in(here) > before + 8)  # both go on
    assert first.status() != psutil.STATUS_ZOMBIE
    second.kill()
    message = message_at_the_end(child, here)
    assert child.exitcode == 1
    assert "slamgym: a worker process was killed, perhaps for" in message
    assert f"{GOES_ON}\n" in message
    assert "Traceback" not in message


def time_of(folder):
    """Return the time of the last change in a folder; None if there is none."""
    return folder.stat().st_ctime_ns if folder.exists() else None


@pytest.mark.slow
def test_a_run_that_is_ended_leaves_nothing_and_a_killed_one_is_swept(here):
    unfinished = here / "out" / STAGING
    left = None
    for number, code in ((signal.SIGKILL, -9), (signal.SIGTERM, 143)):
        child = begin(here, *["run", "loop", "--steps", "200000", "--out", "out"])
        wait_until(lambda left=left: time_of(unfinished) not in (None, left))
        os.kill(child.pid, number)
        message = message_at_the_end(child, here)
        assert child.exitcode == code
        left = time_of(unfinished)
        assert (left is not None) == (number == signal.SIGKILL)
    assert message == "slamgym: interrupted; nothing was written\n"
    assert list(here.rglob("*")) == [here / "out"]


def test_only_the_first_sigterm_raises_and_the_usual_handler_comes_back():
    usual = signal.getsignal(signal.SIGTERM)

    def end_twice():
        with terminable():
            try:
                signal.raise_signal(signal.SIGTERM)
            finally:
                signal.raise_signal(signal.SIGTERM)

    for _ in range(2):
        with pytest.raises(TerminationError):
            end_twice()
        assert signal.getsignal(signal.SIGTERM) is usual


def test_an_ignored_sigterm_stays_ignored():
    usual = signal.signal(signal.SIGTERM, signal.SIG_IGN)
    try:
        with terminable(), interruptible("never"):
            signal.raise_signal(signal.SIGTERM)
    finally:
        signal.signal(signal.SIGTERM, usual)
