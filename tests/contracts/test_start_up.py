"""What each import loads and compiles."""

import os
import re
import subprocess
import sys
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from numba import njit

from slamgym import jit
from slamgym.jit import fma

ROOT = Path(__file__).parents[2]


def run_python(code, *arguments, **environment):
    return subprocess.run(
        [sys.executable, "-c", code, *arguments],
        env={**os.environ, **environment},
        check=True,
        capture_output=True,
        text=True,
    ).stdout


def test_importing_slamgym_loads_nothing_heavy():
    code = "import sys, slamgym; print(*sys.modules)"
    loaded = set(run_python(code).split())
    heavy = {"numba", "scipy", "matplotlib", "pymunk", "pydantic", "typer", "rich"}
    assert "gymnasium" in loaded
    assert not heavy & loaded


def test_the_program_begins_without_the_libraries_of_its_commands():
    code = "import sys, slamgym.experiments.command_line.app; print(*sys.modules)"
    heavy = {"numba", "scipy", "matplotlib", "pymunk", "xarray", "joblib"}
    assert not heavy & set(run_python(code).split())


@pytest.mark.slow
def test_importing_slamgym_takes_hardly_longer_than_importing_gymnasium():
    code = """
import time
times = [time.process_time()]
import gymnasium
times.append(time.process_time())
import slamgym
times.append(time.process_time())
print((times[2] - times[1]) / (times[1] - times[0]))
"""
    assert min(float(run_python(code)) for _ in range(3)) < 0.1


@pytest.mark.slow
def test_importing_the_estimators_and_workers_loads_little():
    code = """
import sys
from slamgym import EkfSlam
print(*sys.modules)
import slamgym.experiments.monte_carlo_study.runner
print(*sys.modules)
"""
    estimators, workers = map(str.split, run_python(code).splitlines())
    heavy = {"scipy.stats", "matplotlib", "xarray", "netCDF4", "slamgym.agents"}
    assert "numba" in estimators
    others = {"scipy.special", "pymunk", "slamgym.envs", "slamgym.experiments"}
    assert not (heavy | others) & set(estimators)
    assert not heavy & set(workers)


@pytest.mark.slow
def test_kernels_that_are_loaded_import_no_compiler():
    code = """
import sys
from slamgym import EkfSlam
from slamgym.estimator.filters.gaussian_map import move_pose
EkfSlam((0.1, 0.05, 0.03), (0.02, 0.1)).predict((0.1, 0.2))
print(sum(move_pose.stats.cache_hits.values()), *sys.modules)
"""
    _, loading = (run_python(code).split() for _ in range(2))
    assert loading[0] == "1"
    assert not {"numba.np.linalg", "numba.np.npyimpl"} & set(loading)


@pytest.mark.slow
def test_commands_load_optimisation_and_spatial_trees_only_to_match_landmarks():
    code = """
import sys
import slamgym.experiments.command_line.run_files
import slamgym.experiments.monte_carlo_study.report
print(*sys.modules)
from slamgym.evaluation import gospa
gospa([(0.0, 0.0)], [(0.0, 0.0)])
print(*sys.modules)
"""
    imported, matching = map(str.split, run_python(code).splitlines())
    heavy = {"scipy.optimize", "scipy.spatial.distance"}
    assert "scipy.special" in imported
    assert not heavy & set(imported)
    assert heavy <= set(matching)


@pytest.mark.slow
def test_only_the_first_command_freezes_and_it_hardly_looks_for_garbage():
    code = """
import contextlib, gc
from slamgym.experiments.command_line.app import main
looks, found = [], []
gc.callbacks.append(lambda phase, _: looks.append(gc.get_threshold()[0]))
for _ in range(2):
    with contextlib.suppress(SystemExit):
        main(["estimators", "--json"])
    found += looks[-1], gc.get_freeze_count()
print(*found)
"""
    last, kept, _, later = map(int, run_python(code).splitlines()[-1].split())
    assert last > 10_000  # threshold of the last search
    assert kept > 10_000
    assert later <= kept


@pytest.mark.slow
def test_the_tests_of_the_filter_pass_in_plain_python():
    """By the command in docs/kernels.md, without the tests that take many steps."""
    text = (ROOT / "docs" / "kernels.md").read_text()
    (path,) = re.findall(r"`NUMBA_DISABLE_JIT=1 pytest (\S+)`", text)
    long = "nees_and_nis or over_1000_steps or keeps_its_share or of_its_own_prior"
    options = ["-p", "no:cacheprovider", "-k", f"not ({long})"]
    done = subprocess.run(
        [sys.executable, "-m", "pytest", path, *options],
        cwd=ROOT,
        env={**os.environ, "NUMBA_DISABLE_JIT": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout


@pytest.mark.slow
def test_compiled_kernels_need_no_symbols_of_the_running_program():
    """``CDLL(None)``, which finds them, fails on Windows."""
    code = """
import ctypes
class Library(ctypes.CDLL):
    def __init__(self, name, *args, **keywords):
        if name is None:
            raise TypeError
        super().__init__(name, *args, **keywords)
ctypes.CDLL = Library
import slamgym.jit
"""
    run_python(code)


@njit
def multiply_add_jit(a, b, c):
    return fma(a, b, c)


@pytest.mark.parametrize("compiled", [True, False])
def test_a_multiply_add_rounds_once(compiled):
    numbers = np.random.default_rng(0).normal(size=(1000, 3))
    numbers[:, 2] -= numbers[:, 0] * numbers[:, 1]  # some digits cancel
    multiply_add = multiply_add_jit if compiled else jit._fma
    for a, b, c in numbers.tolist():
        exact = Fraction(a) * Fraction(b) + Fraction(c)
        assert multiply_add(a, b, c) == float(exact)


@pytest.mark.slow
@pytest.mark.parametrize("method", ["joint", "compatibility", "hypotheses"])
def test_a_first_scan_without_identities_is_associated_in_plain_python(method):
    """Plain Python refuses an index out of bounds, which a kernel does not notice."""
    code = (
        "import sys; from slamgym import make_estimator;"
        "noise = {'motion_std': (0.1, 0.1, 0.05), 'measurement_std': (0.02, 0.1)};"
        "policy = {'association': sys.argv[1]};"
        "slam = make_estimator('ekf', management=policy, **noise);"
        "print(slam.update([(0.1, 3.0), (0.5, 4.0)]).tentative_rows)"
    )
    assert run_python(code, method, NUMBA_DISABLE_JIT="1") == "(0, 1)\n"


@pytest.mark.slow
def test_kernels_compiled_and_kernels_loaded_give_the_same_bits(tmp_path):
    """Those of the motion, which are compiled in little time."""
    code = """
import numpy as np
from slamgym.estimator import make_estimator

noise = {"motion_std": (0.1, 0.05, 0.03), "measurement_std": (0.02, 0.1)}
rng = np.random.default_rng(0)
for name in ("ekf", "invariant"):
    slam = make_estimator(name, initial_pose_std=(0.1, 0.2, 0.3), **noise)
    for _ in range(40):
        slam.predict(rng.uniform(-1, 1, 2))
    belief = slam.belief()
    print(belief.mean.tobytes().hex(), belief.covariance.tobytes().hex())
"""
    compiling, loading = (
        run_python(code, NUMBA_CACHE_DIR=str(tmp_path)) for _ in range(2)
    )
    assert list(tmp_path.rglob("*.nbc"))
    assert compiling == loading
