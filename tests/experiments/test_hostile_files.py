"""Files and folders that no honest program writes end in one line."""

import contextlib
import errno
import io
import json
import os
import re
import shutil
import threading
import zipfile
from pathlib import Path

import forked
import jobs_to_kill
import matplotlib as mpl
import numpy as np
import pytest
from comparison import tree
from typer.testing import CliRunner

from slamgym.envs.rendering.scene import add_axes
from slamgym.estimator import make_estimator
from slamgym.experiments.command_line.app import main
from slamgym.experiments.command_line.commands import BadInputError
from slamgym.experiments.command_line.output_folder import (
    STAGING,
    output_folder,
    write_summary,
)
from slamgym.experiments.figures.style import lay_out, new_figure
from slamgym.experiments.job_folders import MANIFEST as OWN_FILES
from slamgym.experiments.job_folders import files_below, sha256_of
from slamgym.experiments.logs.importers import read_log
from slamgym.experiments.logs.importers.utias import read_utias
from slamgym.experiments.monte_carlo_study import monte_carlo
from slamgym.experiments.trajectories import generate_trajectories, load_trajectories
from slamgym.experiments.trajectories.manifest import MANIFEST, read_manifest
from slamgym.sim_configs import load_scenario
from slamgym.sim_configs.field_types import ScenarioError
from slamgym.sim_configs.scenario_files import replace_when_written, scenario_text

DEEP = 100_000
NOISE = {"motion_std": (0.1, 0.1, 0.1), "measurement_std": (0.1, 0.1)}


@pytest.mark.parametrize(
    "text", [f"name = {'[' * DEEP}{']' * DEEP}", "a." * DEEP + "b = 1"]
)
def test_a_scenario_nested_too_deeply_is_refused_at_once_by_name(text, tmp_path):
    file = tmp_path / "deep.toml"
    file.write_text(text)
    with pytest.raises(ScenarioError, match=r"deep\.toml must nest tables at most 2"):
        load_scenario(file)


def test_a_manifest_nested_too_deeply_is_refused_by_name(tmp_path):
    (tmp_path / MANIFEST).write_text("[" * DEEP + "]" * DEEP)
    with pytest.raises(ValueError, match="must be a manifest of"):
        read_manifest(tmp_path)


@pytest.mark.parametrize("name", ["../other.npz", "/etc/passwd", "", ".."])
def test_a_shard_outside_the_folder_is_refused(name, tmp_path):
    shard = {"name": name, "first_episode": 0, "episodes": 1, "sha256": ""}
    table = {"kind": "slamgym trajectories 1", "shards": [shard]}
    (tmp_path / MANIFEST).write_text(json.dumps(table))
    with pytest.raises(ValueError, match="a shard must be named without a folder"):
        read_manifest(tmp_path)


@pytest.mark.parametrize(
    ("name", "value"),
    [("scenario", None), ("episodes_per_shard", 0), ("seed", 1.5), ("format", [])],
)
def test_a_manifest_of_an_impossible_job_is_refused(name, value, tmp_path):
    job = {"seed": 0, "episodes": 1, "episodes_per_shard": 1, "controller": "random"}
    job |= {"scenario": scenario_text(load_scenario("loop")), "format": "npz"}
    table = {"kind": "slamgym trajectories 1", "versions": {}, "shards": []}
    (tmp_path / MANIFEST).write_text(json.dumps(table | {"job": job | {name: value}}))
    with pytest.raises(ValueError, match=f"{name} must be"):
        read_manifest(tmp_path)


def hostile_shard(path, kind):
    with np.load(path) as archive:
        columns = dict(archive)
    if kind == "objects":
        columns["poses"] = np.array([path], dtype=object)
    elif kind == "missing":
        del columns["poses"]
    np.savez(path, **columns)
    if kind == "huge":  # the header of one array promises 16 TB
        head = io.BytesIO()
        shape = {"descr": "<f8", "fortran_order": False, "shape": (2 << 40,)}
        np.lib.format.write_array_header_1_0(head, shape)
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("poses.npy", head.getvalue())


@pytest.mark.parametrize("kind", ["objects", "missing", "huge"])
def test_a_shard_of_anything_else_is_refused_by_name(kind, tmp_path):
    generate_trajectories("six_landmarks", tmp_path, episodes=1)
    shard = tmp_path / "shard_00000.npz"
    hostile_shard(shard, kind)
    table = json.loads((tmp_path / MANIFEST).read_text())
    table["shards"][0]["sha256"] = sha256_of(shard)
    (tmp_path / MANIFEST).write_text(json.dumps(table))
    with pytest.raises(ValueError, match=r"shard_00000\.npz is no shard \("):
        list(load_trajectories(tmp_path))
    with pytest.warns(UserWarning, match="is no shard"):
        assert not list(load_trajectories(tmp_path, damaged="skip"))


def test_a_number_of_too_many_digits_is_refused_by_file_and_name(tmp_path):
    file, digits = tmp_path / "digits.toml", "9" * 5000
    file.write_text(f"steps = {digits}")
    with pytest.raises(ScenarioError, match=r"digits\.toml: Exceeds the limit"):
        load_scenario(file)
    done = CliRunner().invoke(main, ["run", "loop", "--set", f"steps={digits}"])
    assert "steps must be an integer >= 2, got '999" in done.output


@pytest.mark.parametrize("path", ["..:x", ":x", ".:x"])
def test_an_import_path_that_is_none_is_refused_by_name(path):
    with pytest.raises(ValueError, match="cannot import estimator"):
        make_estimator(path, **NOISE)


def test_a_name_with_broken_mathematics_is_drawn():
    figure = mpl.figure.Figure()
    add_axes(figure, r"$\frac{$")
    figure.canvas.draw()


def write_output(out, files):
    with output_folder(out) as folder:
        for name, text in files.items():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_text(text)


def test_a_link_as_out_stays_a_link(tmp_path):
    target, link = tmp_path / "target", tmp_path / "link"
    target.mkdir()
    link.symlink_to(target)
    write_output(link, {"result.txt": "new"})
    assert link.is_symlink()
    assert (target / "result.txt").read_text() == "new"
    assert sorted(os.listdir(tmp_path)) == ["link", "target"]


@pytest.mark.parametrize("name", ["log.csv", "steps", "other", ".slamgym_partial"])
@pytest.mark.parametrize("kind", ["file", "folder"])
def test_a_link_in_an_output_leads_to_no_change_elsewhere(name, kind, tmp_path):
    out, elsewhere = tmp_path / "out", tmp_path / "elsewhere"
    files = {"log.csv": "a log", "steps/0.png": "a picture"}
    write_output(out, files)
    shutil.copytree(out, elsewhere)
    if name == "steps":
        shutil.rmtree(out / name)
    else:
        (out / name).unlink(missing_ok=True)
    target = {"file": elsewhere / "log.csv", "folder": elsewhere}[kind]
    (out / name).symlink_to(target)
    with pytest.raises(BadInputError, match=f"holds {re.escape(name)}, which"):
        write_output(out, files)
    assert (out / name).is_symlink()
    assert (elsewhere / "log.csv").read_text() == "a log"
    assert (elsewhere / "steps" / "0.png").read_text() == "a picture"


OLD = {"same": "1", "changed": "2", "gone/a": "3", "gone/b": "4"}
NEW = {"same": "1", "changed": "20", "added/a": "5", "b": "6"}


@pytest.mark.skipif(os.name == "nt", reason="signals are those of POSIX")
@pytest.mark.parametrize("calls", range(12))
def test_an_output_killed_at_any_move_is_complete_the_next_time(calls, tmp_path):
    out = tmp_path / "out"
    write_output(out, OLD)
    child = forked.start(jobs_to_kill.output_of, out, NEW, calls)
    child.join()
    assert child.exitcode == (forked.KILLED if calls < 10 else 0)
    with contextlib.suppress(KeyboardInterrupt), output_folder(out):
        before = digest_of_files(out)
        raise KeyboardInterrupt
    assert before == (OLD if calls < 1 else NEW)
    write_output(out, {"last": "7"})
    assert digest_of_files(out) == {"last": "7"}
    assert sorted(os.listdir(out)) == [OWN_FILES, "last"]


def digest_of_files(folder):
    return {name: (folder / name).read_text() for name in files_below(folder)}


@pytest.mark.parametrize("name", ["log.csv", "new.csv", "other.txt"])
def test_a_file_that_appears_meanwhile_is_kept_and_so_are_the_new_ones(name, tmp_path):
    out = tmp_path / "out"
    write_output(out, {"log.csv": "old"})
    foreign = f"../{name}"
    with pytest.raises(BadInputError, match=rf"{name}, which .* stay in .*_partial$"):
        write_output(out, {"new.csv": "new", foreign: "mine"})
    with pytest.raises(BadInputError, match=f"{name}, which .*: move it away"):
        write_output(out, {})
    assert (out / ".slamgym_partial" / "new.csv").read_text() == "new"
    (out / name).rename(tmp_path / "mine")
    with contextlib.suppress(KeyboardInterrupt), output_folder(out):
        raise KeyboardInterrupt
    assert digest_of_files(out) == {"new.csv": "new"}
    assert (tmp_path / "mine").read_text() == "mine"


def test_a_manifest_that_is_damaged_proves_nothing(tmp_path):
    for text in ("", "[" * DEEP, "[]", '{"files": [3]}', '{"files": [{"name": "a"}]}'):
        write_output(tmp_path / "out", {"a": "1"})
        (tmp_path / "out" / OWN_FILES).write_text(text)
        with pytest.raises(BadInputError, match="which slamgym did not write there"):
            write_output(tmp_path / "out", {"a": "2"})
        (tmp_path / "out" / "a").unlink()


def test_a_second_command_into_the_same_folder_is_refused(tmp_path):
    with (
        output_folder(tmp_path / "out") as folder,
        pytest.raises(ValueError, match="another process is writing to"),
    ):
        write_output(tmp_path / "out", {})
    assert folder.parent == tmp_path / "out"


def test_a_full_disk_names_the_folder_and_leaves_what_was_there(tmp_path):
    out = tmp_path / "out"
    full = pytest.raises(OSError, match=r"out cannot be written: No space left")
    with full, output_folder(out):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("error", [PermissionError("no"), KeyboardInterrupt()])
def test_a_file_that_cannot_be_replaced_is_kept(error, tmp_path, monkeypatch):
    out, replace = tmp_path / "out", Path.replace

    def write(text):
        with output_folder(out) as folder:
            (folder / "result.txt").write_text(text)
            write_summary(folder, {})

    def refuse(source, target):
        if source.parent.name == STAGING and target.parent == out:
            raise error
        return replace(source, target)

    write("old")
    with monkeypatch.context() as patch:
        patch.setattr(Path, "replace", refuse)
        with pytest.raises(type(error)):
            write("new")
    assert (out / "result.txt").read_text() == "old"
    assert os.listdir(tmp_path) == ["out"]
    write("new")
    assert (out / "result.txt").read_text() == "new"
    assert os.listdir(tmp_path) == ["out"]


def small_data_set(out, progress=None):
    return generate_trajectories(
        "six_landmarks", out, episodes=6, episodes_per_shard=2, progress=progress
    )


@pytest.mark.skipif(os.name == "nt", reason="limits are those of POSIX")
def test_a_data_set_that_may_not_grow_names_its_folder_and_goes_on(tmp_path):
    import resource

    small_data_set(tmp_path / "whole")
    largest = max(file.stat().st_size for file in (tmp_path / "whole").iterdir())
    usual = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (largest // 2, usual[1]))
    try:
        with pytest.raises(OSError, match="out cannot be written: File too large; who"):
            small_data_set(tmp_path / "out")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, usual)
    assert [file.name for file in (tmp_path / "out").iterdir()] == [MANIFEST]
    small_data_set(tmp_path / "out")
    assert tree(tmp_path / "whole") == tree(tmp_path / "out")


def test_a_folder_that_vanishes_under_a_job_is_named(tmp_path):
    out = tmp_path / "out"

    def vanish(*_):
        shutil.rmtree(out, ignore_errors=True)

    with pytest.raises(OSError, match="out cannot be written: No such file"):
        small_data_set(out, vanish)
    world = load_scenario("six_landmarks")
    with pytest.raises(OSError, match=r"out.* cannot be written: .*does not exist"):
        monte_carlo(world, "ekf", 6, out=out, block_size=2, progress=vanish)


def utias_folder(folder, *, last="1.0", landmarks="6 1 1 0 0\n7 2 2 0 0\n"):
    files = {
        "Robot1_Odometry.dat": f"0.0 0.1 0.0\n{last} 0.1 0.0\n",
        "Robot1_Measurement.dat": "0.5 63 1.0 0.1\n",
        "Barcodes.dat": "6 63\n7 25\n",
        "Landmark_Groundtruth.dat": landmarks,
    }
    for name, text in files.items():
        (folder / name).write_text(text)
    return folder


def test_a_damaged_time_stamp_is_refused_before_it_fills_the_memory(tmp_path):
    folder = utias_folder(tmp_path, last="9e12")
    with pytest.raises(ValueError, match=r"within 1e\+06 s of its start, got 9e\+12 s"):
        read_utias(folder)


def test_a_landmark_given_twice_is_refused_with_its_line(tmp_path):
    folder = utias_folder(tmp_path, landmarks="6 1 1 0 0\n7 2 2 0 0\n6 3 3 0 0\n")
    with pytest.raises(ValueError, match=r"Landmark_Groundtruth\.dat.*3.*once"):
        read_utias(folder)


def test_a_size_limit_names_the_file_in_its_final_folder(tmp_path):
    out, limit = tmp_path / "out", (errno.EFBIG, os.strerror(errno.EFBIG))
    limited = pytest.raises(OSError, match="File too large")
    with (
        limited as caught,
        output_folder(out) as partial,
        replace_when_written(partial / "map.png"),
    ):
        raise OSError(*limit)
    assert caught.value.filename == str(out / "map.png")
    other = pytest.raises(OSError, match="File too large: 'other'")
    with other, replace_when_written(tmp_path / "map.png"):
        raise OSError(*limit, "other")
    unnamed = pytest.raises(OSError, match="out cannot be written: File too large")
    with unnamed, output_folder(out):
        raise OSError(*limit)


@pytest.mark.skipif(os.name == "nt", reason="there are no such pipes")
def test_a_log_is_read_from_a_pipe(tmp_path):
    pipe, text = tmp_path / "log", "# format: slamlog 1\nodometry,1,1,0,1\n"
    os.mkfifo(pipe)
    writer = threading.Thread(target=pipe.write_text, args=(text,))
    writer.start()
    log = read_log(pipe)
    writer.join()
    assert len(log.events) == 1


def test_figures_need_no_latex(monkeypatch):
    monkeypatch.setitem(mpl.rcParams, "text.usetex", True)
    figure = new_figure(3, 2)
    axes = figure.add_subplot(title="3σ [m²]")
    lay_out(figure, 100)
    assert figure._repr_png_().startswith(b"\x89PNG")  # as a notebook shows it
    assert not any(text.get_usetex() for text in figure.findobj(mpl.text.Text))
    assert axes.get_title()
    assert mpl.rcParams["text.usetex"]
