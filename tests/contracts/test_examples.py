"""Every example runs, and ends in the figure or the number it promises."""

import os
import re
import runpy
import subprocess
import sys
from pathlib import Path

import pytest
from PIL import Image

from slamgym.sim_configs import load_scenario

EXAMPLES = Path(__file__).parents[2] / "examples"


@pytest.fixture
def run(tmp_path, monkeypatch, capsys):
    """Return a function that runs an example in an empty folder: what it prints."""

    def run_example(name, *arguments):
        path = EXAMPLES / f"{name}.py"
        monkeypatch.chdir(tmp_path)
        monkeypatch.setattr(sys, "argv", [str(path), *arguments])
        runpy.run_path(str(path), run_name="__main__")
        return capsys.readouterr().out

    return run_example


def assert_picture(path):
    """Check that a picture shows something: many colours, not one."""
    with Image.open(path) as picture:
        assert min(picture.size) > 300
        assert len(picture.convert("RGB").getcolors(1 << 24)) > 20


def test_examples_are_numbered_and_say_how_to_run_them():
    names = sorted(path.name for path in EXAMPLES.glob("*.py"))
    assert [int(name[:2]) for name in names] == list(range(1, len(names) + 1))
    for name in names:
        assert f"python examples/{name}" in (EXAMPLES / name).read_text()


def test_01_goes_round_the_corridor_without_a_bump(run):
    printed = run("01_drive_the_world")
    assert " 0 bumps" in printed
    assert_picture("results/01_drive_the_world.png")


@pytest.mark.slow
def test_02_shows_that_the_ekf_says_less_than_half_of_its_heading_error(run):
    pattern = r"(\w+): θ off by (\S+) rad rms, says σθ = (\S+) rad"
    ends = re.findall(pattern, run("02_filter_step_by_step"))
    ratio = {name: float(said) / float(error) for name, error, said in ends}
    assert ratio["ekf"] < 0.5
    assert 0.9 < ratio["invariant"] < 1.15


@pytest.mark.slow
def test_03_replays_a_drive_of_its_own(run):
    printed = run("03_replay_the_course_log")
    assert printed.count("off by") == 2 * 6
    assert_picture("results/03_map.png")


@pytest.mark.slow
def test_03_reproduces_the_published_distances(run, public_logs):
    printed = run(
        "03_replay_the_course_log", str(public_logs / "raw" / "cmu16833" / "data.txt")
    )
    independent, full = printed.split("'full'")
    assert "off by 0.0024197 m = 0.05452 σ" in independent
    assert "off by 0.0042047 m" in full


def test_03_refuses_what_is_no_log_in_one_line(run, tmp_path):
    (tmp_path / "noise.txt").write_text("nothing of the kind\n")
    with pytest.raises(SystemExit, match=r"error: noise\.txt, line 1: expected a log"):
        run("03_replay_the_course_log", "noise.txt")


@pytest.mark.slow
def test_04_shows_modesty_and_pride(run):
    rows = run("04_noise_study").splitlines()
    nis = {row[:6].strip(): float(row.split()[-2]) for row in rows[1:-1]}
    assert len(nis) == 11
    assert nis["σr × 1"] < nis["unchan"] < nis["σr ÷ 1"]
    assert_picture("results/04_noise_study.png")


def test_05_keeps_the_contract_and_shows_a_breach(run):
    printed = run("05_your_own_estimator")
    assert "TextbookEkf keeps the contract" in printed
    assert "TurnsFirst computes wrong beliefs:\n- predict(): it turns before" in printed


@pytest.mark.slow
def test_06_says_that_it_needs_a_screen(tmp_path):
    done = subprocess.run(
        [sys.executable, EXAMPLES / "06_keyboard.py"],
        cwd=tmp_path,
        env={**os.environ, "MPLBACKEND": "agg"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 1
    assert done.stderr == (
        "this example needs a screen: matplotlib's backend 'agg' opens no windows\n"
    )


def test_06_turns_held_arrows_into_actions():
    from matplotlib.backend_bases import FigureCanvasBase, KeyEvent
    from matplotlib.figure import Figure

    module = runpy.run_path(str(EXAMPLES / "06_keyboard.py"))
    canvas = FigureCanvasBase(Figure())
    keys = module["HeldKeys"](canvas.figure)
    scenario = load_scenario("corridor")

    def happens(name, key):
        canvas.callbacks.process(name, KeyEvent(name, canvas, key))
        return keys.action(scenario).tolist()

    limits = scenario.robot.max_speed, scenario.robot.max_turn_rate
    assert happens("key_press_event", "up") == [limits[0], 0]
    assert happens("key_press_event", "right") == [limits[0], -limits[1]]
    assert happens("key_release_event", "up") == [0, -limits[1]]
    assert happens("key_press_event", "escape") == [0, -limits[1]]
    assert "escape" in keys


@pytest.mark.slow
def test_07_draws_the_picture_of_the_readme(run):
    printed = run("07_honest_ellipses", "--every", "500")
    assert "standard EKF: 0 of 20" in printed
    assert "invariant EKF: 20 of 20" in printed
    assert_picture("results/07_honest_ellipses.png")
    images = EXAMPLES.parent / "docs" / "images"
    for kind in ("png", "gif"):
        made, shown = f"results/07_honest_ellipses.{kind}", f"honest_ellipses.{kind}"
        with Image.open(made) as new, Image.open(images / shown) as old:
            assert new.size == old.size


@pytest.mark.parametrize("arguments", [["--bogus"], ["more"]])
@pytest.mark.parametrize("name", ["08_belief_in_the_loop", "09_train_active_slam"])
def test_08_and_09_refuse_what_they_do_not_know(name, arguments, run, capsys):
    with pytest.raises(SystemExit) as end:
        run(name, *arguments)
    assert end.value.code == 2
    said = capsys.readouterr().err.splitlines()[-1]
    assert said == f"{name}.py: error: unrecognized arguments: {arguments[0]}"


@pytest.mark.parametrize("name", ["08_belief_in_the_loop", "09_train_active_slam"])
def test_08_and_09_explain_themselves(name, run, capsys):
    with pytest.raises(SystemExit) as end:
        run(name, "--help")
    assert end.value.code == 0
    assert f"usage: {name}.py" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("option", "value", "message"),
    [
        ("--steps", "0", "must be >= 1, got 0"),
        ("--steps", "many", "invalid int value: 'many'"),
        ("--worlds", "-16", "must be >= 16, got -16"),
        ("--worlds", "24", "must be a multiple of 16, got 24"),
        ("--maps", "0", "must be >= 1, got 0"),
        ("--scenario", "nope", "scenario must be a preset (active_easy, "),
        ("--scenario", "nope.toml", "cannot read the scenario 'nope.toml'"),
        ("--scenario", "loop", "scenario must have walls around its floor, got none"),
    ],
)
def test_09_refuses_what_cannot_be_before_it_trains(
    option, value, message, run, capsys
):
    with pytest.raises(SystemExit) as end:
        run("09_train_active_slam", option, value)
    assert end.value.code == 2
    said = capsys.readouterr().err.splitlines()[-1]
    start = f"09_train_active_slam.py: error: argument {option}: "
    assert said.startswith(start + message)
    assert not Path("results").exists()


@pytest.mark.slow
def test_11_gives_every_reading_to_its_landmark_by_default(run):
    rows = [line.split() for line in run("11_who_is_who").splitlines()[1:]]
    nearest, default = ([float(value) for value in row[1:]] for row in rows)
    assert [row[0] for row in rows] == ["nearest", "default"]
    assert default[0] < nearest[0]
    assert default[2:4] == [0, 0]
    assert default[4] < nearest[4]


def test_15_maps_a_rock_with_a_sensor_of_its_own_and_a_compass(run):
    assert "position of the rock: [8. 3.]" in run("15_your_own_sensor")
