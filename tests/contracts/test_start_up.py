"""What each import loads and compiles."""

import os
import pickle
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from drives import MEASUREMENT_STD, MOTION_STD, drive

from slamgym.estimator import make_estimator

ROOT = Path(__file__).parents[2]
NOISE = {"motion_std": MOTION_STD, "measurement_std": MEASUREMENT_STD}


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
import slamgym.experiments.monte_carlo.runner
print(*sys.modules)
"""
    estimators, workers = map(str.split, run_python(code).splitlines())
    heavy = {"scipy.stats", "matplotlib", "xarray", "netCDF4", "slamgym.agents"}
    assert "numba" in estimators
    assert not (heavy | {"scipy.special", "pymunk"}) & set(estimators)
    assert not heavy & set(workers)


@pytest.mark.slow
def test_a_state_saved_here_continues_bit_for_bit_in_another_process(tmp_path):
    slam = make_estimator("invariant", **NOISE)
    for odometry, readings, _ in drive(0, 20):
        slam.predict(odometry)
        slam.update(readings, range(6))
    (tmp_path / "state.pickle").write_bytes(pickle.dumps(slam.state_dict()))
    np.savez(tmp_path / "state.npz", **slam.state_dict())
    code = """
import pickle, sys
import numpy as np
from slamgym.estimator import make_estimator

folder, std, sensor = sys.argv[1], eval(sys.argv[2]), eval(sys.argv[3])
beliefs = []
for load in (np.load, lambda path: pickle.loads(open(path, "rb").read())):
    kind = "npz" if load is np.load else "pickle"
    slam = make_estimator("invariant", motion_std=std, measurement_std=sensor)
    slam.load_state_dict(dict(load(f"{folder}/state.{kind}")))
    slam.predict((0.5, 0.08))
    slam.update([(0.3, 6.0), (1.0, 9.0)], [0, 3])
    beliefs.append(slam.belief())
    np.save(f"{folder}/{kind}.npy", np.column_stack([slam.belief().mean]))
    np.save(f"{folder}/{kind}_covariance.npy", slam.belief().covariance)
"""
    run_python(
        code, str(tmp_path), str(MOTION_STD.tolist()), str(MEASUREMENT_STD.tolist())
    )
    slam.predict((0.5, 0.08))
    slam.update([(0.3, 6.0), (1.0, 9.0)], [0, 3])
    for kind in ("npz", "pickle"):
        mean = np.load(tmp_path / f"{kind}.npy")[:, 0]
        covariance = np.load(tmp_path / f"{kind}_covariance.npy")
        np.testing.assert_array_equal(mean, slam.belief().mean)
        np.testing.assert_array_equal(covariance, slam.belief().covariance)


@pytest.mark.slow
def test_kernels_run_as_plain_python_for_a_debugger():
    code = """
from slamgym.estimator import make_estimator
slam = make_estimator("invariant", motion_std=(.1, .1, .1), measurement_std=(.1, .1))
for _ in range(3):
    slam.predict((1.0, 0.1))
    slam.update([(0.3, 6.0), (1.0, 9.0)], [0, 3])
"""
    show = "print(*slam.belief().mean.tolist())"
    plain = run_python(code + show, NUMBA_DISABLE_JIT="1").split()
    compiled = {}
    exec(code, compiled)
    np.testing.assert_allclose(
        np.array(plain, dtype=float), compiled["slam"].belief().mean, rtol=1e-12
    )


@pytest.mark.slow
def test_the_tests_of_the_filter_pass_in_plain_python():
    """By the command of CONTRIBUTING, but for what takes many thousand steps."""
    text = (ROOT / "CONTRIBUTING.md").read_text()
    (path,) = re.findall(r"`NUMBA_DISABLE_JIT=1 pytest (\S+)`", text)
    long = "nees_and_nis or over_1000_steps or keeps_its_share"
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
def test_kernels_compiled_and_kernels_loaded_give_the_same_bits(tmp_path):
    code = """
import sys
import numpy as np
from slamgym.estimator import make_estimator

noise = {"motion_std": (0.1, 0.05, 0.03), "measurement_std": (0.02, 0.1)}
rng = np.random.default_rng(0)
z = np.column_stack([rng.uniform(-3, 3, 13), rng.uniform(1, 9, 13)])
for name in ("ekf", "invariant"):
    slam = make_estimator(name, **noise)
    for _ in range(40):
        slam.predict(0.01 * rng.standard_normal(2))
        report = slam.update(z + 0.03 * rng.standard_normal(z.shape), range(13))
    belief = slam.belief()
    print(belief.mean.tobytes().hex(), belief.covariance.tobytes().hex())
    print(report.nis.hex())
"""
    compiling, loading = (
        run_python(code, NUMBA_CACHE_DIR=str(tmp_path)) for _ in range(2)
    )
    assert list(tmp_path.rglob("*.nbc"))
    assert compiling == loading
