"""The wheel holds all it needs, and works away from the checkout."""

import os
import subprocess
import sys
import sysconfig
import tomllib
import zipfile
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[2]
TOP = {file.name for file in (ROOT / "src" / "slamgym").iterdir() if file.is_file()}
PARTS = ("agents", "envs", "estimator", "evaluation", "experiments", "sim_configs")


def call(*command, cwd):
    """Run a command; return what it prints, and fail with it."""
    clean = {key: os.environ[key] for key in os.environ if key != "PYTHONPATH"}
    done = subprocess.run(
        command, cwd=cwd, env=clean, capture_output=True, text=True, check=False
    )
    if "hatchling" in done.stderr and "No matching distribution" in done.stderr:
        pytest.skip("hatchling cannot be fetched here")
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """Build the wheel."""
    folder = tmp_path_factory.mktemp("wheel")
    pip = (sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps")
    call(*pip, "--wheel-dir", str(folder), str(ROOT), cwd=folder)
    (built,) = folder.glob("slamgym-*.whl")
    return built


@pytest.fixture(scope="module")
def machine(wheel, tmp_path_factory):
    """Return the programs of an environment with the wheel and what it depends on."""
    folder = tmp_path_factory.mktemp("machine")
    call(sys.executable, "-m", "venv", "--without-pip", str(folder), cwd=folder)
    programs = folder / "bin"
    python = str(programs / "python")
    find_site = "import sysconfig; print(sysconfig.get_path('purelib'))"
    site = Path(call(python, "-c", find_site, cwd=folder).strip())
    # The dependencies come from here: as a line of a .pth file, which leaves out
    # the editable installation of this checkout.
    (site / "dependencies.pth").write_text(sysconfig.get_path("purelib"))
    pip = (sys.executable, "-m", "pip", "--python", python, "install", "--quiet")
    call(*pip, "--no-deps", "--no-index", "--no-compile", str(wheel), cwd=folder)
    return programs


@pytest.mark.slow
def test_the_wheel_holds_every_module_and_the_data(wheel):
    inside = set(zipfile.ZipFile(wheel).namelist())
    sources = {
        f"slamgym/{file.relative_to(ROOT)}"
        for part in PARTS
        for suffix in ("py", "toml", "json", "html", "css", "js")
        for file in (ROOT / part).rglob(f"*.{suffix}")
    }
    assert sources | {f"slamgym/{name}" for name in TOP} <= inside
    assert "slamgym/sim_configs/presets/six_landmarks.toml" in inside


@pytest.mark.slow
def test_the_wheel_holds_nothing_else(wheel):
    inside = zipfile.ZipFile(wheel).namelist()
    homes = tuple(f"slamgym/{part}/" for part in PARTS)
    strangers = [
        name
        for name in inside
        if not name.startswith(homes)
        and name.removeprefix("slamgym/") not in TOP
        and not name.split("/")[0].endswith(".dist-info")
    ]
    assert strangers == []
    assert not [name for name in inside if "__pycache__" in name]


@pytest.mark.slow
def test_the_installed_wheel_runs_a_world_and_a_filter(machine, tmp_path):
    program = (
        "import gymnasium, numpy, slamgym; from slamgym.estimator import EkfSlam; "
        "env = gymnasium.make('slamgym/LandmarkWorld-v0', scenario='loop'); "
        "observation, _ = env.reset(seed=0); "
        "seen = numpy.flatnonzero(observation['mask']); "
        "slam = EkfSlam((.1, .1, .1), (.1, .1)); "
        "report = slam.update(observation['landmarks'][seen], seen); "
        "print(len(report.added_ids), slamgym.__file__)"
    )
    count, place = call(machine / "python", "-c", program, cwd=tmp_path).split()
    assert int(count) > 0
    assert Path(place).is_relative_to(machine.parent)


@pytest.mark.slow
def test_the_installed_command_answers(machine, tmp_path):
    assert "slamgym run six_landmarks" in call(
        machine / "slamgym", "--help", cwd=tmp_path
    )
    assert "loop" in call(machine / "slamgym", "scenarios", cwd=tmp_path)


def test_the_versions_of_the_checks_satisfy_every_minimum():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    checked = ("test", "agents", "trajectories", "interop", "peers")
    wanted = [*project["dependencies"], *(line for x in checked for line in extras[x])]
    lines = (ROOT / ".ci" / "constraints.txt").read_text().splitlines()
    pinned = {}
    for pin in map(Requirement, (line for line in lines if not line.startswith("#"))):
        (version,) = pin.specifier
        pinned.setdefault(canonicalize_name(pin.name), set()).add(version.version)
    for need in map(Requirement, wanted):
        versions = pinned[canonicalize_name(need.name)]
        assert all(map(need.specifier.contains, versions)), need
