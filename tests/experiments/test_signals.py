"""What commands do when they, or their workers, are told to end."""

import os
import signal
import time
from itertools import cycle

import forked
import jobs_to_kill
import psutil
import pytest

from slamgym.experiments.command_line.commands import (
    TerminationError,
    interruptible,
    terminable,
)
from slamgym.experiments.command_line.options import Options
from slamgym.experiments.command_line.output_folder import STAGING
from slamgym.experiments.logs.slamlog import write_slamlog
from slamgym.sim_configs import load_scenario

pytestmark = pytest.mark.skipif(os.name == "nt", reason="signals are those of POSIX")

JOB = "monte-carlo six_landmarks -e ekf --runs 90000 --block-size 8 --jobs 2 --out out"
DATA_SET = "generate six_landmarks --episodes 90000 --shard 8 --out out"
CODES = {signal.SIGINT: 130, signal.SIGTERM: 143}
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


def many_runs(here, *options):
    """Return a Monte Carlo on two workers that has results, and its processes."""
    child = begin(here, *JOB.split(), *options)
    wait_until(lambda: blocks_in(here) > 1)
    return child, psutil.Process(child.pid).children(recursive=True)


def workers_among(processes):
    names = {process: " ".join(process.cmdline()) for process in processes}
    return [p for p, name in names.items() if "popen_loky" in name]


IMPORTS = 1.5  # [s] more than a forked command takes to load what it lacks
LONG = (  # those that the next test ends in a filter are not among them
    "replay ../city.csv --out out",
    "judge ../path.tum --truth ../city.csv --out out",
    "smooth ../city.csv --out out",
    "fit-noise ../city.csv --out out",
    "noise-study city --runs 4 --out out",
)


@pytest.fixture(scope="module")
def city_log(tmp_path_factory):
    """Return a log, and a path beside it, that keep every command busy for long."""
    world = load_scenario("city").with_changes(steps=4000)
    log = Options().record(world, lambda *_: None)
    file = tmp_path_factory.mktemp("logs") / "city.csv"
    write_slamlog(log, file)
    poses = (f"{t} 0 0 0 0 0 0 1 1 0 0 1 0 1\n" for t in range(1_500_000))
    file.with_name("path.tum").write_text("".join(poses))
    return file


def seconds_until(happened, limit):
    """Return how long it takes, by a clock that stands while this process has to wait.

    On a busy machine, a process waits for a core as long as another one.
    """
    begin = time.process_time()
    while not happened() and time.process_time() - begin < limit:
        pass  # computes, and so gets the share of a core that the command gets
    return time.process_time() - begin


def assert_ends_in_time(child, number, here, message):
    """Send a signal, and check all that a user sees of the end."""
    processes = psutil.Process(child.pid).children(recursive=True)
    os.kill(child.pid, number)
    lasted = seconds_until(lambda: not child.is_alive(), 30)
    said = message_at_the_end(child, here)
    assert lasted < 2
    assert child.exitcode == CODES[number]
    other = ("note: ", "compiling ")  # the kernels of a command may be new
    lines = [line for line in said.splitlines() if not line.startswith(other)]
    assert lines == [f"slamgym: interrupted; {message}"]
    assert_all_is_gone(processes, here)


def assert_all_is_gone(processes, here):
    _, alive = psutil.wait_procs(processes, timeout=10)
    assert alive == []
    assert list(here.glob("slamgym-*")) == []


def message_of(command):
    if command.startswith("monte-carlo"):
        return GOES_ON
    if command.startswith("generate"):
        return "whole shards stay in out, the same command continues"
    return "nothing was written"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("command", "number"),
    list(zip(LONG, cycle([signal.SIGTERM, signal.SIGINT]), strict=False)),
)
def test_a_command_that_computes_ends_in_time(here, city_log, command, number):
    for file in city_log.parent.iterdir():
        here.with_name(file.name).symlink_to(file)
    child = begin(here, *command.split())
    of_child = psutil.Process(child.pid)

    def computed():
        assert child.is_alive()
        return of_child.cpu_times().user > IMPORTS

    wait_until(computed)
    assert_ends_in_time(child, number, here, message_of(command))
    assert list(here.glob(".*")) == []


@pytest.mark.slow
@pytest.mark.parametrize(
    ("command", "made", "number"),
    [
        (f"{DATA_SET} --jobs 2", "shard_*.npz", signal.SIGTERM),
        (JOB, "blocks/runs-*.npz", signal.SIGINT),
        (f"{JOB} --backend dask", "blocks/runs-*.npz", signal.SIGTERM),
    ],
    ids=["generate", "monte-carlo", "dask"],
)
def test_workers_of_any_kind_end_with_their_job(here, command, made, number):
    if "dask" in command:
        pytest.importorskip("distributed")
    child = begin(here, *command.split())
    wait_until(lambda: child.exitcode or len(list(here.glob(f"out/{made}"))) > 1)
    assert_ends_in_time(child, number, here, message_of(command))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("command", "number"),
    [
        ("run six_landmarks -e ekf --out out", signal.SIGINT),
        ("run six_landmarks -e ekf --out out", signal.SIGTERM),
        ("render six_landmarks -e ekf --out out.gif", signal.SIGINT),
        ("generate six_landmarks --episodes 9 -e ekf --out out", signal.SIGTERM),
        ("noise-study six_landmarks --out out", signal.SIGINT),
        ("monte-carlo hidden_identities --out out", signal.SIGTERM),
    ],
)
def test_a_call_that_python_cannot_interrupt_delays_no_end(here, command, number):
    child = forked.start(jobs_to_kill.command_in_a_kernel, here, *command.split())
    wait_until((here / "began").exists)
    compiles = command.startswith("monte-carlo")  # its job has not begun
    message = "nothing was written" if compiles else message_of(command)
    assert_ends_in_time(child, number, here, message)
    assert list(here.glob(".*")) == []


@pytest.mark.slow
def test_workers_end_when_the_process_that_engaged_them_is_killed(here):
    child, processes = many_runs(here)
    child.kill()
    child.join()
    assert_all_is_gone(processes, here)


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


@pytest.mark.slow
def test_workers_that_are_killed_amid_a_result_block_no_job(here):
    child, processes = many_runs(here, "--block-size", "64")  # > 64 KiB, a pipe's room
    job, workers = psutil.Process(child.pid), workers_among(processes)
    job.suspend()  # if whole results went through the pipe, it would now be full
    wait_until(lambda: all(w.status() == psutil.STATUS_SLEEPING for w in workers))
    for worker in workers:
        worker.kill()
    job.resume()
    assert "slamgym: a worker process was killed" in message_at_the_end(child, here)
    assert child.exitcode == 1


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
