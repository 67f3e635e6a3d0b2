"""The folder of a Monte Carlo: one writer, no rests of the killed, one job."""

import ast
import os
import re
import shutil
import subprocess
import sys
import textwrap
import threading
import time

import forked
import joblib
import jobs_to_kill
import pytest
import xarray as xr
from typer.testing import CliRunner

from slamgym.experiments import job_folders
from slamgym.experiments.command_line.app import main
from slamgym.experiments.command_line.commands import Reporter
from slamgym.experiments.command_line.run_files import warm_up
from slamgym.experiments.job_folders import MANIFEST, WRITER, replace_own
from slamgym.experiments.monte_carlo_study import merge_blocks, monte_carlo, results
from slamgym.experiments.run_and_replay.filter_settings import FilterSettings

RUNS = 12
JOB = {"scenario": "six_landmarks", "estimators": "ekf", "block_size": 4}
BLOCKS = [f"runs-{a:07d}-{b:07d}.npz" for a, b in ((0, 4), (4, 8), (8, 12))]

pytestmark = pytest.mark.skipif(
    os.name == "nt", reason="folders are not locked on Windows"
)


@pytest.fixture(scope="module")
def whole():
    return monte_carlo(**JOB, runs=RUNS)


def killed(folder, dies_at):
    """Let a writer die at some place, with rests left behind."""
    job = forked.start(jobs_to_kill.three_blocks, folder, dies_at)
    job.join()
    assert job.exitcode == forked.KILLED


@pytest.fixture(scope="module")
def at_work(tmp_path_factory):
    """Lend a folder that another process writes to, and that process."""
    folder = tmp_path_factory.mktemp("at work") / "out"
    began = forked.event()
    job = forked.start(jobs_to_kill.three_blocks, folder, "never", began)
    try:
        assert began.wait(timeout=120)
        yield folder, job
    finally:
        job.kill()
        job.join()


def tree(folder):
    """All files below a folder, hidden ones too, and what they hold."""
    files = (file for file in folder.rglob("*") if file.is_file())
    return {file.relative_to(folder).as_posix(): file.read_bytes() for file in files}


def names(folder):
    return sorted(tree(folder))


def finished():
    written = [MANIFEST, "job.json", "results.nc"]
    return sorted([*written, *(f"blocks/{name}" for name in BLOCKS)])


# one writer


def test_a_second_command_says_which_process_uses_the_folder(at_work):
    folder, child = at_work
    before = tree(folder)
    second = CliRunner().invoke(
        main,
        [
            *("monte-carlo", "six_landmarks", "-e", "ekf", "--block-size", "4"),
            *("--runs", str(RUNS), "--out", str(folder)),
        ],
    )
    assert second.exit_code == 2
    said = second.stderr.splitlines()[-1]
    assert f"another process is writing to {folder}: it is in use by" in said
    assert re.search(rf"by process {child.pid} on .*wait for its end", said)
    assert tree(folder) == before


def test_nothing_is_merged_into_a_folder_in_use_nor_removed_from_it(at_work, tmp_path):
    folder, child = at_work
    monte_carlo(**JOB, runs=8, out=tmp_path / "part").close()
    before = tree(folder)
    with pytest.raises(ValueError, match=rf"in use by process {child.pid} on"):
        merge_blocks([tmp_path / "part"], folder)
    with pytest.raises(ValueError, match=rf"in use by process {child.pid} on"):
        monte_carlo(**JOB, runs=RUNS, out=folder, fresh=True)
    assert tree(folder) == before


def test_a_folder_is_merged_from_while_it_is_written(at_work, tmp_path, whole):
    folder, _ = at_work
    merge_blocks([folder], tmp_path / "copy")
    with monte_carlo(**JOB, runs=4, out=tmp_path / "copy") as copied:
        xr.testing.assert_equal(copied.load(), whole.isel(run=slice(0, 4)))


def test_a_fresh_job_stopped_at_once_leaves_no_results_of_the_one_before(tmp_path):
    monte_carlo(**JOB, runs=4, out=tmp_path).close()

    def stop(done, runs):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        monte_carlo(
            **JOB | {"seed": 99}, runs=4, out=tmp_path, fresh=True, progress=stop
        )
    assert not (tmp_path / "results.nc").exists()


def test_the_same_process_does_not_write_twice_at_once(tmp_path, whole):
    told = []

    def again(done, runs):
        try:
            monte_carlo(**JOB, runs=RUNS, out=tmp_path)
        except ValueError as error:
            told.append(str(error))

    with monte_carlo(**JOB, runs=RUNS, out=tmp_path, progress=again) as results:
        xr.testing.assert_equal(results.load(), whole)
    assert len(told) == 1 + len(BLOCKS)
    assert all(f"in use by process {os.getpid()} on" in text for text in told)


def test_a_writer_that_fails_lets_the_next_one_in(tmp_path, whole):
    def fails(done, runs):
        raise RuntimeError("the bar broke")

    with pytest.raises(RuntimeError, match="the bar broke"):
        monte_carlo(**JOB, runs=RUNS, out=tmp_path, progress=fails)
    assert names(tmp_path) == ["job.json"]
    with monte_carlo(**JOB, runs=RUNS, out=tmp_path) as results:
        xr.testing.assert_equal(results.load(), whole)


@pytest.mark.slow
def test_a_child_forked_meanwhile_does_not_keep_the_folder(tmp_path):
    code = """
        import os, pathlib, signal, sys, time
        from slamgym.experiments.job_folders import locked_folder
        folder = pathlib.Path(sys.argv[1])
        with locked_folder(folder):
            child = os.fork()
            if child == 0:
                time.sleep(600)
                os._exit(0)
        try:
            with locked_folder(folder):
                print("again")
        finally:
            os.kill(child, signal.SIGKILL)
    """
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(code), str(tmp_path)],
        stdout=subprocess.PIPE,
        text=True,
        check=True,
    )
    assert done.stdout == "again\n"


# rests of the killed


@pytest.mark.parametrize(
    ("dies_at", "rest"),
    [
        ("job", r"\.job\.\d+@.+-[0-9a-f]{8}\.json"),
        ("block", r"blocks/\.runs-0000004-0000008\.\d+@.+-[0-9a-f]{8}\.npz"),
        ("results", r"\.results\.0123abcd\.nc"),
    ],
)
def test_what_a_killed_writer_left_is_gone_after_the_next_run(
    dies_at, rest, tmp_path, whole
):
    killed(tmp_path, dies_at)
    left = names(tmp_path)
    assert WRITER in left
    assert [name for name in left if re.fullmatch(rest, name)]
    with monte_carlo(**JOB, runs=RUNS, out=tmp_path) as resumed:
        xr.testing.assert_equal(resumed.load(), whole)
    assert names(tmp_path) == finished()


@pytest.mark.slow
def test_workers_that_outlive_a_killed_writer_do_not_keep_the_folder(tmp_path, whole):
    out = tmp_path / "out"
    killed(out, "workers")
    done = []
    with monte_carlo(
        **JOB, runs=RUNS, out=out, progress=lambda runs, of: done.append(runs)
    ) as resumed:
        xr.testing.assert_equal(resumed.load(), whole)
    assert done[0] > 0  # went on
    assert names(out) == finished()
    deadline = time.monotonic() + 20
    while list(tmp_path.iterdir()) != [out] and time.monotonic() < deadline:
        time.sleep(0.05)  # the workers end, and remove what they wrote for the writer
    assert list(tmp_path.iterdir()) == [out]


def test_only_what_slamgym_began_is_removed(tmp_path):
    monte_carlo(**JOB, runs=4, out=tmp_path).close()
    rests = [".job.0123abcd.json", "blocks/.runs-0000004-0000008.89abcdef.npz"]
    others = [
        ".thesis.0123abcd.tex",
        ".job.json",
        "blocks/.runs-0000004-0000008.89abcdef.npz.xK2a9Q",  # of a copy under way
        "blocks/runs-0000004-0000008.broken",
    ]
    for name in rests + others:
        (tmp_path / name).write_text("half")
    with pytest.raises(ValueError, match="seed 0, not of seed 3"):
        monte_carlo(**JOB, runs=4, seed=3, out=tmp_path)
    assert {*rests, *others} <= set(names(tmp_path))
    monte_carlo(**JOB, runs=4, out=tmp_path).close()
    assert set(others) <= set(names(tmp_path))
    assert not set(rests) & set(names(tmp_path))


@pytest.mark.parametrize("fresh", [False, True])
def test_what_was_changed_since_is_set_aside_and_not_lost(fresh, tmp_path, whole):
    first = f"blocks/{BLOCKS[0]}"
    monte_carlo(**JOB, runs=RUNS, out=tmp_path).close()
    mine = {}
    for name in (first, "results.nc"):
        mine[f"{name}.aside"] = b"m" * (tmp_path / name).stat().st_size
        (tmp_path / name).write_bytes(mine[f"{name}.aside"])
    for times in (1, 2):
        if times == 2:
            (tmp_path / "results.nc").write_text("mine again")
        with (
            pytest.warns(UserWarning, match=rf"to r\S*\.aside{'2' * (times - 1)}$"),
            monte_carlo(**JOB, runs=RUNS, out=tmp_path, fresh=fresh) as anew,
        ):
            xr.testing.assert_equal(anew.load(), whole)
    aside = {name: data for name, data in tree(tmp_path).items() if "aside" in name}
    assert aside == mine | {"results.nc.aside2": b"mine again"}
    assert names(tmp_path) == sorted([*finished(), *aside])


def test_a_fresh_job_removes_what_the_earlier_one_wrote_and_nothing_else(tmp_path):
    monte_carlo(**JOB, runs=4, out=tmp_path).close()
    with replace_own(tmp_path / "report.html") as partial:
        partial.write_text("of the earlier job")
    (tmp_path / "summary.json").write_text("mine")
    with pytest.warns(UserWarning, match=r"summary\.json is not as slamgym wrote it"):
        monte_carlo(**JOB, runs=4, seed=9, out=tmp_path, fresh=True).close()
    assert not (tmp_path / "report.html").exists()
    assert (tmp_path / "summary.json.aside").read_text() == "mine"


def test_a_folder_of_another_version_is_called_so_and_kept(tmp_path):
    monte_carlo(**JOB, runs=4, out=tmp_path).close()
    job = tmp_path / "job.json"
    job.write_text(re.sub(r"(slamgym monte carlo )\d+", r"\g<1>4", job.read_text()))
    before = tree(tmp_path)
    with pytest.raises(ValueError, match="written by another version of slamgym"):
        monte_carlo(**JOB, runs=4, out=tmp_path)
    assert tree(tmp_path) == before


def test_a_folder_with_something_else_stays_as_it_is(tmp_path):
    (tmp_path / ".job.0123abcd.json").write_text("{}")
    (tmp_path / "thesis.tex").write_text("years of work")
    before = tree(tmp_path)
    with pytest.raises(ValueError, match="holds no Monte Carlo"):
        monte_carlo(**JOB, runs=RUNS, out=tmp_path)
    assert tree(tmp_path) == before
    with pytest.raises(ValueError, match="out must be a folder, got the file"):
        monte_carlo(**JOB, runs=RUNS, out=tmp_path / "thesis.tex")


@pytest.mark.slow
def test_parts_of_two_machines_are_merged_without_their_rests(tmp_path, whole):
    one, two, both = (tmp_path / name for name in ("one", "two", "both"))
    killed(one, "block")
    with monte_carlo(**JOB, runs=RUNS, first_run=4, out=two) as part:
        xr.testing.assert_equal(part.load(), whole.isel(run=slice(4, None)))
    ignored = shutil.ignore_patterns("runs-*")
    shutil.copytree(one, both, ignore=ignored)  # but its rests
    merge_blocks([one, two], both)
    assert names(both) == sorted({*finished()} - {"results.nc", MANIFEST})
    done = []
    with monte_carlo(
        **JOB, runs=RUNS, out=both, progress=lambda runs, of: done.append(runs)
    ) as merged:
        xr.testing.assert_equal(merged.load(), whole)
    assert done == [RUNS]  # there was nothing left to do


def test_blocks_written_together_are_those_read_and_written_one_by_one(
    tmp_path, whole, monkeypatch
):
    job = JOB | {"estimators": "ekf,invariant", "runs": RUNS - 1}
    together = monte_carlo(**job, out=tmp_path / "together")
    monkeypatch.setattr(results, "_MOST_JOINED", 0)
    one_by_one = monte_carlo(**job, out=tmp_path / "one by one")
    xr.testing.assert_identical(together, one_by_one)
    first = together.sel(estimator=["ekf"], run=range(RUNS - 1))
    xr.testing.assert_equal(first, whole.isel(run=slice(RUNS - 1)))


def test_a_damaged_block_is_not_merged(tmp_path):
    monte_carlo(**JOB, runs=4, out=tmp_path / "one").close()
    (tmp_path / "one" / "blocks" / BLOCKS[0]).write_text("mine")
    with pytest.raises(ValueError, match=rf"{BLOCKS[0]} is truncated or damaged"):
        merge_blocks([tmp_path / "one"], tmp_path / "both")


def test_a_folder_that_is_still_written_to_is_removed_again_and_again(
    tmp_path, monkeypatch
):
    calls = []
    monkeypatch.setattr(job_folders, "_BETWEEN", 0.0)
    monkeypatch.setattr(
        job_folders.shutil, "rmtree", lambda *_, **named: calls.append(named)
    )
    job_folders.remove(tmp_path)
    assert calls == [{"ignore_errors": True}] * 20 + [{}]


@pytest.mark.parametrize(
    ("error", "message"),
    [
        (PermissionError(13, "No", "inner"), "out cannot be written: No; it is kept"),
        (OSError("a message of slamgym"), "a message of slamgym"),
        (RuntimeError("HDF error"), "out cannot be written: HDF error; it is kept"),
    ],
)
def test_what_cannot_be_written_is_named(error, message):
    with (
        pytest.raises(OSError, match=f"^{message}$"),
        job_folders.naming("out", "; it is kept", also=RuntimeError),
    ):
        raise error


# one job


@pytest.mark.parametrize(
    ("found", "asked", "name"),
    [
        ({"a": 1, "b": 2}, {"a": 1, "c": 3}, "b"),
        ({"a": 1}, {"a": 1, "c": 3}, "c"),
        ({"a": 1, "b": 2}, {"b": 3, "a": 2}, "a"),
        ({"a": 1, "b": 2}, {"b": 2, "a": 1}, None),
    ],
)
def test_the_first_difference_of_two_jobs_is_named(found, asked, name):
    assert job_folders.difference(found, asked) == name


def test_workers_are_engaged_as_many_as_asked():
    cores = joblib.cpu_count()
    for jobs, backend, at_once in (
        *((None, None, 1), (1, None, 1), (3, None, 3), (-1, None, cores)),
        *((1, "threading", 1), (3, "threading", 3), (None, "threading", cores)),
    ):
        assert job_folders.blocks_at_once(jobs, backend) == at_once
        workers = job_folders.engage_workers(jobs, backend)
        assert (workers is None) == (backend is None and at_once == 1)
        if backend:
            meeting = threading.Barrier(at_once, timeout=60)
            calls = [(meeting.wait, (), {})] * at_once
            assert sorted(workers(calls)) == list(range(at_once))


def test_workers_that_are_left_early_end_without_a_warning():
    calls = ((divmod, (7, k), {}) for k in range(1, 1000))
    results = job_folders.engage_workers(2, "threading")(calls)
    assert next(results)[0] > -1
    results.close()  # a warning would be an error


def test_a_temporary_folder_that_cannot_be_written_is_named(tmp_path):
    folder = tmp_path / "missing"
    with pytest.raises(OSError, match=f"the temporary folder {folder} cannot be writ"):
        job_folders._write_result(folder, (divmod, (7, 2), {}))
    with pytest.raises(FileNotFoundError, match="of the work"):  # it is not blamed
        job_folders._write_result(tmp_path, (fails, (), {}))


def fails():
    raise FileNotFoundError("of the work")


def test_a_temporary_folder_that_cannot_be_removed_spoils_no_results(monkeypatch):
    def refuse(folder):
        folder.rmdir()
        raise OSError("in use")

    monkeypatch.setattr(job_folders, "remove", refuse)
    calls = [(divmod, (7, k), {}) for k in (2, 3)]
    results = job_folders._through_files(lambda c: (f(*a) for f, a, _ in c), calls)
    assert list(results) == [(3, 1), (2, 1)]


def test_a_job_is_of_the_filter_that_it_began_with(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    source = tmp_path / "edited_filter.py"
    text = "from slamgym.estimator import EkfSlam\nclass Mine(EkfSlam):\n    pass\n"
    source.write_text(text)
    job = JOB | {"estimators": "edited_filter:Mine", "out": tmp_path / "out"}
    done = []

    def edits(runs, of):
        source.write_text(text + "# edited while the old one runs\n")

    monte_carlo(**job, runs=RUNS, progress=edits).close()
    source.write_text(text)
    monte_carlo(**job, runs=RUNS, progress=lambda runs, of: done.append(runs)).close()
    assert done == [RUNS]


# submaps on disk


def test_a_folder_of_submaps_is_refused_for_many_runs(tmp_path):
    on_disk = {"on disk": ("submaps", {"folder": str(tmp_path / "maps")})}
    with pytest.raises(ValueError, match="folder holds the submaps of one run: leave"):
        monte_carlo("six_landmarks", on_disk, 3, out=tmp_path / "out")
    assert list(tmp_path.iterdir()) == []
    assert not monte_carlo("six_landmarks", "submaps", 1).failed.any()


THREADS = """
from threadpoolctl import threadpool_info
from slamgym.experiments.run_and_replay.filter_settings import one_blas_thread
from slamgym.experiments.monte_carlo_study import monte_carlo


def threads():
    pools = [pool for pool in threadpool_info() if pool["user_api"] == "blas"]
    return [pool["num_threads"] for pool in pools]


if __name__ == "__main__":
    seen = []
    monte_carlo(
        "six_landmarks", "ekf", 2, progress=lambda done, runs: seen.append(threads())
    )
    print(seen[-1], threads())
"""


@pytest.mark.slow
def test_runs_use_one_blas_thread_and_leave_the_others_as_they_were():
    """Else the last bits would depend on how many workers share the cores."""
    done = subprocess.run(
        [sys.executable, "-c", THREADS],
        env=os.environ | {"OPENBLAS_NUM_THREADS": "2"},
        capture_output=True,
        text=True,
        check=True,
    )
    within, after = map(
        set, ast.literal_eval(f"[{done.stdout.replace('] [', '], [')}]")
    )
    assert (within, after) == ({1}, {2})


def submap_settings(folder, **options):
    return FilterSettings(
        "submaps", (0.2,) * 3, (0.1,) * 2, options={"folder": folder} | options
    )


def test_warming_up_leaves_a_folder_of_submaps_empty(tmp_path):
    settings = submap_settings(tmp_path / "maps", submap_size=1)
    for _ in range(2):
        warm_up(settings, Reporter(as_json=True))
        assert names(tmp_path) == []
    slam = settings.make((0.0, 0.0, 0.0))
    slam.predict((1.0, 0.0))
    slam.update([(0.0, 2.0)], [0])
    before = tree(tmp_path)
    with pytest.raises(ValueError, match="holds the submaps of another run"):
        warm_up(settings, Reporter(as_json=True))
    assert tree(tmp_path) == before


def test_a_warm_up_interrupted_leaves_a_folder_of_submaps_empty(tmp_path, monkeypatch):
    def interrupted(*_):
        assert names(tmp_path) == ["maps/submaps.txt"]
        raise KeyboardInterrupt

    settings = submap_settings(tmp_path / "maps")
    monkeypatch.setattr(
        "slamgym.estimator.large_maps.submaps.submap_slam.SubmapSlam.update",
        interrupted,
    )
    with pytest.raises(KeyboardInterrupt):
        warm_up(settings, Reporter(as_json=True))
    assert names(tmp_path) == []
