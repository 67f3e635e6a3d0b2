"""The page with sliders for the noise: its numbers, its size, and in Chromium."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.linalg import eigvalsh
from scipy.stats import chi2

from slamgym.envs.controllers import make_controller
from slamgym.experiments import monte_carlo, noise_explorer, summarise_monte_carlo
from slamgym.experiments.command_line.app import main
from slamgym.experiments.command_line.commands import BadInputError
from slamgym.experiments.logs.recording import record_episode
from slamgym.experiments.noise_explorer import explore_noise, write_explorer
from slamgym.experiments.run_and_replay import replay
from slamgym.experiments.run_and_replay.filter_settings import (
    estimator_choices,
    settings_for_scenario,
)
from slamgym.sim_configs import load_scenario

WORLD = load_scenario("six_landmarks")
LOUD = WORLD.with_changes(
    motion={"std": [2 * std for std in WORLD.motion.std]},
    sensor={"std": [0.5 * std for std in WORLD.sensor.std]},
)


@pytest.mark.parametrize(
    ("change", "actual", "assumed"),
    [("filter", WORLD, LOUD), ("world", LOUD, WORLD), ("both", LOUD, LOUD)],
)
def test_a_cell_holds_what_monte_carlo_finds(change, actual, assumed, monkeypatch):
    monkeypatch.setattr(noise_explorer, "FACTORS", (0.5, 1.0, 2.0))
    told = []
    facts = explore_noise(
        *(WORLD, "ekf,invariant", 8, 5),
        change=change,
        progress=lambda *numbers: told.append(numbers),
    )
    assert told == [(8 * done, 80) for done in range(1, 11)]
    head = {key: facts[key] for key in list(facts)[:11] if key != "typical"}
    assert head == {
        **{"world": "six_landmarks", "runs": 8, "steps": WORLD.steps, "change": change},
        **{"factors": (0.5, 1.0, 2.0), "units": ("rad", "m")},
        **{"motion": WORLD.motion.std, "measurement": WORLD.sensor.std},
        **{"filters": ["ekf", "invariant"]},
        "band": (chi2.ppf([0.025, 0.975], 24) / 24).round(4).tolist(),
    }
    results = monte_carlo(actual, "ekf,invariant", 8, 5, assumed=assumed)
    expected = summarise_monte_carlo(results)["estimators"]
    cell = facts["cells"][2]  # measurement × 0.5, motion × 2
    for label, found in zip(("ekf", "invariant"), cell["filters"], strict=True):
        entry = expected[label]
        assert (found["word"], found["reason"]) == (entry["verdict"], entry["reason"])
        mean = entry["pose_nees"]["invariant"]["mean"]
        assert found["nees"] == pytest.approx(mean, rel=5e-3)
        nees = results.sel(estimator=label).pose_nees_invariant.values[:, 1:] / 3
        curve = 10 ** (np.array(found["curve"]) / 100)
        np.testing.assert_allclose(curve[[0, -1]], nees.mean(0)[[0, -1]], rtol=0.012)
    averages = monte_carlo(WORLD, "ekf", 8, 5).pose_nees_invariant.mean("step")
    order = averages.values[0].argsort()
    assert facts["typical"] == 5 + order[4]


def test_ellipses_and_paths_are_those_of_the_typical_run(monkeypatch):
    monkeypatch.setattr(noise_explorer, "FACTORS", (1.0, 2.0))
    facts = explore_noise(WORLD, "ekf", 4, 5)
    driver = make_controller("open_loop", WORLD, np.random.default_rng())
    log = record_episode(WORLD, driver, facts["typical"])
    settings = settings_for_scenario(WORLD, estimator="ekf")
    trace = replay(log, settings.make(log.start)).trace
    one = facts["cells"][0]["filters"][0]
    marks = np.array(one["map"]).reshape(-1, 5)
    true = np.array(facts["landmarks"]).reshape(-1, 2)
    size = np.linalg.norm(trace.true_landmarks[0] - trace.true_landmarks[1])
    metres = size / np.linalg.norm(true[0] - true[1])  # of one code
    shift = trace.landmarks - trace.true_landmarks
    np.testing.assert_allclose((marks[:, :2] - true) * metres, shift, atol=2 * metres)
    axes = 3 * np.sqrt(eigvalsh(trace.landmark_covariances))[:, ::-1]
    np.testing.assert_allclose(marks[:, 2:4] * metres, axes, atol=2 * metres)
    path = np.array(one["path"]).reshape(-1, 2)
    ends = path[[0, -1]] - true[0]
    expected = trace.poses[[0, -1], :2] - trace.true_landmarks[0]
    np.testing.assert_allclose(ends * metres, expected, atol=2 * metres)
    ovals = np.array(one["poses"]).reshape(-1, 5)
    rows = noise_explorer._evenly(len(trace.poses), len(ovals))
    axes = 3 * np.sqrt(eigvalsh(trace.pose_covariances[rows, :2, :2]))[:, ::-1]
    np.testing.assert_allclose(ovals[:, 2:4] * metres, axes, atol=2 * metres)
    wider = np.array(facts["cells"][3]["filters"][0]["map"]).reshape(-1, 5)
    assert (wider[:, 2] > marks[:, 2]).all()


FRAGILE = """
from slamgym.estimator import EkfSlam

class Fragile(EkfSlam):
    def __init__(self, motion_std, measurement_std, **options):
        super().__init__(motion_std, measurement_std, **options)
        self.most = 9 if measurement_std[1] > 0.15 else 99

    def predict(self, odometry, dt=1.0):
        if self.steps > self.most:
            raise ValueError("the noise is too large")
        super().predict(odometry, dt)
"""


def test_a_filter_that_fails_with_some_noise_is_drawn_with_the_other(
    tmp_path, monkeypatch
):
    (tmp_path / "fragile.py").write_text(FRAGILE)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(noise_explorer, "FACTORS", (1.0, 2.0))
    facts = explore_noise(WORLD, "ekf,fragile:Fragile", 2, 5)
    drawn = [len(one["path"]) > 0 for cell in facts["cells"] for one in cell["filters"]]
    assert drawn == [True, True] * 2 + [True, False] * 2
    failed = facts["cells"][-1]["filters"][1]
    assert failed["curve"] == failed["poses"] == failed["map"] == []
    assert failed["nees"] is None
    assert facts["cells"][-1]["truth"]


def test_angles_of_ellipses_are_those_of_their_longer_axis():
    frame = noise_explorer._MapCodes(np.zeros(2), 100.0, np.zeros((0, 2)))
    for degrees in (0, 30, 100, 179):
        c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
        along = np.array([[c, -s], [s, c]])
        covariance = along @ np.diag([9.0, 1.0]) @ along.T
        found = frame.ellipses(np.array([[10.0, 20.0]]), covariance[None])
        assert found == [200, 400, 180, 60, degrees]


@pytest.mark.parametrize(("true_x", "low", "size"), [(-10.0, -10, 26), (None, 0, 13)])
def test_the_map_shows_truth_estimate_and_landmarks_with_a_margin(true_x, low, size):
    true_poses = None if true_x is None else np.array([[true_x, 1.0, 9.0]])
    trace = SimpleNamespace(poses=np.array([[0.0, 0.0, 9.0]]), true_poses=true_poses)
    frame = noise_explorer._MapCodes.around(trace, np.array([[10.0, 4.0]]))
    corners = np.array([[low, 0.0], [10.0, 4.0]])
    middle = corners.mean(axis=0)
    expected = 1000 + (corners - middle) / size * 2000
    assert frame.codes(corners) == expected.round().ravel().tolist()


@pytest.mark.parametrize("names", ["ekf", "ekf,invariant", "ekf,invariant,iterated"])
def test_the_numbers_of_a_page_are_shared_out(names):
    choices = estimator_choices(names)
    study = noise_explorer._Exploration(WORLD, names, choices, 2, 0, "filter")
    curve, path, poses, marks = study._counts()
    each = len(choices) * (curve + 2 * path + 5 * poses + 5 * marks) + 2 * path
    assert 27_000 < 49 * each <= 30_000
    factors = np.array(noise_explorer.FACTORS)
    np.testing.assert_allclose(factors * factors[::-1], 1.0)


def test_the_command_replaces_only_its_own_pages(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(noise_explorer, "FACTORS", (1.0, 2.0))
    page = tmp_path / "page.html"
    given = ["explore", "six_landmarks", "-e", "ekf", "--runs", "2", "--out", str(page)]
    page.write_text("mine")
    with pytest.raises(BadInputError, match="explore has not written it"):
        main(given, standalone_mode=False)
    page.unlink()
    for _ in range(2):
        main([*given, "--json"], standalone_mode=False)
    assert json.loads(capsys.readouterr().out.splitlines()[0])["out"] == str(page)
    for wrong in (str(tmp_path / "x.png"), str(tmp_path / "no" / "x.html")):
        with pytest.raises(BadInputError, match=r"be an \.html file in a folder"):
            main([*given[:-1], wrong], standalone_mode=False)
    with pytest.raises(BadInputError, match="did you mean 'filter'"):
        main([*given, "--change", "filtr"], standalone_mode=False)


# --------------------------------------------------------------------------------------
# In the browser.


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    path = tmp_path_factory.mktemp("page") / "explore.html"
    world = load_scenario("loop").with_changes(steps=60)
    facts = explore_noise(world, "ekf,invariant,iterated", 2)
    write_explorer(path, facts)
    return path, facts


@pytest.fixture
def page(browser, file):
    browser.open(file[0])
    yield browser
    assert browser.messages == []
    assert browser.requests == []


def row(page, number):
    script = "[...document.querySelectorAll('#values tbody tr')[%d].children]"
    return page.evaluate(f"{script % number}.map(cell => cell.textContent)")


def shown(page):
    return page.evaluate("explorer.sliders.map(slider => +slider.value)")


@pytest.mark.slow
def test_a_page_of_three_filters_is_smaller_than_100_kb(file):
    assert file[0].stat().st_size <= 100_000


@pytest.mark.slow
def test_the_page_begins_with_the_unchanged_noise(page, file):
    assert shown(page) == [3, 3]
    unchanged = file[1]["cells"][3 * 7 + 3]["filters"]
    for number, one in enumerate(unchanged):
        found = row(page, number)
        assert found[0] == ("ekf", "invariant", "iterated")[number]
        assert float(found[1]) == pytest.approx(one["nees"], rel=0.05)
        assert found[2:] == [one["word"], one["reason"]]
    assert page.text("#motion-value") == "unchanged: 0.00884, 0 m, 0.0354 rad"


@pytest.mark.slow
def test_dragging_a_slider_changes_numbers_and_pictures(page, file):
    picture = "document.querySelector('#maps canvas').toDataURL()"
    before = page.evaluate(picture)
    left, top, width, height = page.box("#measurement")
    page.click(left + width - 10, top + height / 2)
    assert shown(page) == [3, 6]
    assert row(page, 0)[3] == file[1]["cells"][6 * 7 + 3]["filters"][0]["reason"]
    assert "×10" in page.text("#measurement-value")
    assert page.evaluate(picture) != before


@pytest.mark.slow
def test_keys_and_cells_change_the_noise(page):
    for key, expected in (
        *(("ArrowRight", [4, 3]), ("ArrowUp", [4, 4]), ("ArrowLeft", [3, 4])),
        *(("ArrowDown", [3, 3]), ("ArrowDown", [3, 2]), ("0", [3, 3])),
    ):
        page.press(key)
        assert shown(page) == expected
    for _ in range(9):
        page.press("ArrowRight")
    assert shown(page) == [6, 3]
    page.evaluate("document.querySelector('#motion').focus()")
    page.press("ArrowLeft", code=37)
    assert shown(page) == [5, 3]
    page.click_on(".grid button")  # the upper left
    assert shown(page) == [0, 6]
    pressed = "[...document.querySelectorAll('.grid [aria-pressed=true]')].length"
    assert page.evaluate(pressed) == 3
    page.click_on("#reset")
    assert shown(page) == [3, 3]


@pytest.mark.slow
@pytest.mark.parametrize("dark", [False, True])
@pytest.mark.parametrize("width", [390, 1280])
def test_the_page_fits_every_screen(browser, file, width, dark):
    browser.open(file[0], size=(width, 844), dark=dark, touch=width < 500)
    assert browser.evaluate("document.documentElement.scrollWidth") == width
    paper = browser.evaluate("getComputedStyle(document.body).backgroundColor")
    assert (paper == "rgb(20, 23, 27)") == dark
    for canvas in ("#maps canvas", "#charts canvas"):
        assert browser.box(canvas)[2] > 300
    assert browser.messages == []
