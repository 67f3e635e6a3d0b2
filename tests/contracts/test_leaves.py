"""The core works without its leaves, without one of them or without all."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import forked
import pytest
from import_graph import FILES, ROOT, code_lines, graph

import slamgym
from slamgym import jit
from slamgym.leaves import LEAVES

ALL = [place for places in LEAVES.values() for place in places]
#: Tests of the core, which pass without any leaf.
CORE_TESTS = (
    "sim_configs",
    "envs/test_landmark_world.py",
    "estimator/test_ekf_slam.py",
    "estimator/test_error_frames.py",
    "evaluation/test_nees.py",
    "experiments/test_slamlog.py",
)
COMMANDS = """
from pathlib import Path
from slamgym.experiments.command_line.app import main

def slamgym(line):
    try:
        main(line.split())
    except SystemExit as end:
        assert not end.code, line

slamgym("run six_landmarks --steps 2 --no-every-step --out run")
slamgym("replay run/log.csv -e ekf --no-every-step --out replay")
slamgym("generate six_landmarks --episodes 2 --steps 2 --out data")
slamgym("estimators")
for file in ("run/map.png", "replay/summary.json", "data"):
    assert Path(file).exists(), file

import slamgym as package
for part in (package, package.estimator, package.experiments, package.agents):
    for name in part.__all__:
        getattr(part, name)
"""

#: A forked process then loads the copy in its folder, and no library again.  Rendering
#: takes most of the time of the commands, and loads no module.
PREPARED = f"""{forked.WITHOUT_SLAMGYM}
from slamgym.experiments.figures import style
assert style.__file__.startswith(sys.path[0])
style.draw_file = lambda figure, path, *_: path.touch()
"""
MANY_RUNS = """
slamgym("monte-carlo six_landmarks -e ekf,invariant --runs 2 --steps 2 --out many")
assert Path("many/report.html").exists()
"""


def is_in(module, places):
    return any(module == place or module.startswith(f"{place}.") for place in places)


def with_those_that_need(name):
    """Return the name of a leaf, and those of all leaves that need it."""
    gone = {name}
    while True:
        places = [place for each in gone for place in LEAVES[each]]
        needing = {m for m, used in graph().items() for t in used if is_in(t, places)}
        more = {n for n, own in LEAVES.items() if any(is_in(m, own) for m in needing)}
        if more <= gone:
            return gone
        gone |= more


def copy_without(site, leaves):
    """Copy the package, with its bytecode, without some leaves."""
    target = site / "slamgym"
    shutil.copytree(Path(slamgym.__file__).parent, target)
    for place in [place for name in leaves for place in LEAVES[name]]:
        path = target.joinpath(*place.split("."))
        shutil.rmtree(path) if path.is_dir() else path.with_suffix(".py").unlink()
    # No kernel of the core reads a leaf: those of the whole package are these, too.
    file = target / "jit.py"
    before, found, after = file.read_text().partition("_DIGEST = digest_of_sources()")
    assert found
    file.write_text(f"{before}_DIGEST = {jit._DIGEST!r}{after}")


def test_the_core_imports_no_leaf():
    core = [module for module in FILES if not is_in(module, ALL)]
    importing = [
        module for module in core if any(is_in(t, ALL) for t in graph()[module])
    ]
    assert importing == []


def test_every_leaf_exists_and_has_one_name():
    assert len(ALL) == len(set(ALL))
    assert all(any(is_in(module, [place]) for module in FILES) for place in ALL)
    lines = sum(code_lines(module) for module in FILES if is_in(module, ALL))
    assert lines > 10_000


@pytest.mark.slow
@pytest.mark.parametrize("name", LEAVES)
def test_the_commands_of_the_core_work_without_a_leaf(name, tmp_path):
    copy_without(tmp_path, with_those_that_need(name))
    code = PREPARED + COMMANDS
    forked.run(code, tmp_path, NUMBA_DISABLE_JIT="1")


@pytest.mark.slow
def test_the_core_works_without_any_leaf(tmp_path):
    copy_without(tmp_path, LEAVES)
    forked.run(PREPARED + COMMANDS + MANY_RUNS, tmp_path)
    for name in ("tests", "pyproject.toml"):
        source, target = ROOT / name, tmp_path / name
        (shutil.copytree if source.is_dir() else shutil.copy)(source, target)
    tests = [f"tests/{name}" for name in CORE_TESTS]
    options = ["-q", "-p", "no:cacheprovider", "-n", "0", "-m", "not slow"]
    done = subprocess.run(
        [sys.executable, "-m", "pytest", *options, *tests],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(tmp_path)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
