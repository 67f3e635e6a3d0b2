"""The page of a run in Chromium: played, scrubbed, pointed at, touched."""

import re
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from recordings import recorded

from slamgym.estimator import make_estimator
from slamgym.experiments.run_and_replay import replay
from slamgym.experiments.viewers import RunFrames, ViewedRun, write_run_page
from slamgym.sim_configs import load_scenario

pytestmark = pytest.mark.slow
STEPS = 120
HOSTILE = "<script>document.title = 'taken'</script><img src='http://127.0.0.1:9/'>"


def written_page(path, preset="loop", filters=("ekf", "invariant"), **options):
    world, runs = load_scenario(preset), []
    log = recorded(world, 0, steps=STEPS)
    for name in filters:
        frames = RunFrames(log)
        label = "invariant" if name == HOSTILE else name
        noise = {"motion_std": world.motion.std, "measurement_std": world.sensor.std}
        slam = make_estimator(label, **noise, initial_pose=log.start, **options)
        trace = replay(log, slam, name=name, watch=frames.watch).trace
        runs.append(ViewedRun(trace, frames))
    write_run_page(path, log, runs, walls=world.walls)
    return runs


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    path = tmp_path_factory.mktemp("page") / "run.html"
    return path, written_page(path)


@pytest.fixture
def page(browser, file):
    browser.open(file[0])
    yield browser
    assert browser.messages == []
    assert browser.requests == []


def test_a_page_of_one_filter_shows_no_empty_chart_and_the_charts_beside_the_map(
    browser, tmp_path
):
    world = load_scenario("loop")
    log = recorded(world, 0, steps=STEPS)
    without = {"landmark_ids": (), "landmarks": np.empty((0, 2))}
    blind = replace(log, **without, ground_truth=np.empty((0, 4)))
    frames = RunFrames(blind)
    noise = {"motion_std": world.motion.std, "measurement_std": world.sensor.std}
    slam = make_estimator("ekf", **noise, initial_pose=log.start)
    trace = replay(blind, slam, name="ekf", watch=frames.watch).trace
    write_run_page(tmp_path / "run.html", blind, [ViewedRun(trace, frames)])
    browser.open(tmp_path / "run.html")
    titles = "[...document.querySelectorAll('#charts h2')].map(h => h.textContent)"
    assert browser.evaluate(titles) == ["NIS by degree of freedom"]
    left, top, width, height = browser.box("#maps canvas")
    beside, middle, *_ = browser.box("#charts canvas")
    assert beside > left + width
    assert top < middle < top + height


def step_of(page):
    return int(re.match(r"step (\d+) of 120", page.text("#clock"))[1])


def place_of(page, run, step, what):
    """Where the map of a run shows a point [px], by the whole map's own scale."""
    left, top, width, height = page.box("#maps canvas")
    script = "(() => {const v = player.views[0]; return [v.px(%r), v.py(%r)]})()"
    x, y = page.evaluate(script % tuple(map(float, what)))
    assert 0 < x < width
    assert 0 < y < height
    return left + x, top + y


def mahalanobis(error, covariance):
    return np.sqrt(error @ np.linalg.solve(covariance, error))


def test_the_page_opens_at_the_first_step_without_a_word(page):
    assert step_of(page) == 0
    assert page.evaluate("document.title") == "loop: ekf, invariant – slamgym run"
    assert page.evaluate("document.querySelectorAll('#maps canvas').length") == 2
    assert page.evaluate("document.querySelectorAll('#charts canvas').length") == 2


def test_dragging_the_slider_scrubs(page):
    left, top, width, height = page.box("#slider")
    y = top + height / 2
    page.point(left + 8, y, "mousePressed")
    for share in (0.25, 0.5, 0.75):
        page.point(left + share * width, y, buttons=1)
    page.point(left + 0.75 * width, y, "mouseReleased")
    assert step_of(page) == pytest.approx(90, abs=4)


def test_the_table_follows_the_step(page, file):
    trace = file[1][0].trace
    for step in (0, 1, 77):
        page.evaluate(f"player.go({step})")
        row = page.evaluate(
            "[...document.querySelector('#values tbody tr').children]"
            ".map(cell => cell.textContent)"
        )
        gap = np.linalg.norm(trace.poses[step, :2] - trace.true_poses[step, :2])
        assert row[:2] == ["ekf", f"{gap:.3f}"]
        assert row[-1] == str(len(trace.map_at(step).ids))


def test_play_runs_to_the_end_and_pause_stops(page):
    page.evaluate("document.querySelector('#speed').value = 4")
    page.click_on("#play")
    page.wait_for("player.place > 5")
    assert page.evaluate("document.querySelector('#play').ariaLabel") == "Pause"
    page.click_on("#play")
    stopped = step_of(page)
    page.evaluate("new Promise(r => setTimeout(r, 200))")
    assert 5 < step_of(page) == stopped < STEPS
    page.evaluate("player.show(110)")
    page.click_on("#play")
    page.wait_for("player.place === 120")
    page.wait_for("!player.isPlaying")
    assert page.evaluate("document.querySelector('#play').ariaLabel") == "Play"


def test_keys_step_jump_and_play(page):
    keys = {"ArrowRight": 1, "End": 120, "ArrowLeft": 119, "Home": 0}
    for key, expected in (*keys.items(), ("ArrowLeft", 0)):
        page.press(key)
        assert step_of(page) == expected
    page.press(" ", text=" ")
    page.wait_for("player.isPlaying")
    page.press(" ", text=" ")
    page.wait_for("!player.isPlaying")


def test_a_key_on_the_slider_moves_one_step_only(page):
    page.evaluate("document.querySelector('#slider').focus()")
    page.press("ArrowRight", code=39)
    assert step_of(page) == 1


def test_pointing_at_a_landmark_shows_its_values(page, file):
    trace = file[1][0].trace
    page.evaluate("player.go(120)")
    ids, means, covariances = trace.map_at(120)
    page.point(*place_of(page, trace, 120, means[0]))
    page.wait_for("!hint.hidden")
    text = page.text("#hint")
    assert f"landmark {ids[0]}\n" in text
    shown = [float(x) for x in re.findall(r"-?\d+\.\d+", text)]
    error = means[0] - trace.true_landmarks[0]
    distances = np.linalg.norm(error), mahalanobis(error, covariances[0])
    std = np.sqrt(np.diagonal(covariances[0]))
    expected = [means[0, 0], std[0], means[0, 1], std[1], *distances]
    np.testing.assert_allclose(shown[:5], expected[:5], atol=1.1e-3)
    assert shown[5] == pytest.approx(expected[5], abs=0.06)
    page.point(2, 2)
    page.wait_for("hint.hidden")


def test_clicking_a_landmark_shows_its_correlations(page, file):
    trace, frames = file[1][0]
    page.evaluate("player.go(120)")
    ids, means, _ = trace.map_at(120)
    page.click(*place_of(page, trace, 120, means[1]))
    frame = frames.correlations[120]
    n = len(ids)
    matrix = np.zeros((n + 1, n + 1))
    matrix[np.tril_indices(n + 1, -1)] = frame.values
    row = (matrix + matrix.T)[2]
    others = np.delete(row, [0, 2])
    said = page.text("#chosen")
    assert f"Correlation of landmark {ids[1]}. ekf: " in said
    found = [float(x) for x in re.findall(r"[01]\.\d\d", said.split(";")[0])]
    expected = [row[0], others.min(), others.max()]
    np.testing.assert_allclose(found, expected, atol=8e-3)
    page.press("Escape")
    assert page.text("#chosen").startswith("Click a landmark")


def test_a_filter_can_be_hidden_and_shown(page):
    page.click_on("#filters button:nth-child(1)")
    assert page.evaluate("player.shown.map(f => f.name)") == ["invariant"]
    assert page.text("#values tbody").startswith("invariant")
    page.click_on("#filters button:nth-child(2)")
    assert page.evaluate("player.shown.length") == 1
    page.click_on("#filters button:nth-child(1)")
    assert page.evaluate("document.querySelectorAll('#maps canvas').length") == 2


def test_a_chart_moves_the_cursor_and_shows_values(page, file):
    left, top, width, height = page.box("#charts canvas")
    page.click(left + width / 2, top + height / 2)
    step = step_of(page)
    assert step == pytest.approx(60, abs=6)
    text = page.text("#hint")
    assert f"step {step} of 120" in text
    shown = float(re.search(r"ekf: NEES / 3 ([\d.]+)", text)[1])
    value = page.evaluate(f"player.run.filters[0].array('nees')[{step}]")
    assert shown == pytest.approx(value, rel=5e-3)
    assert "95 % band 0.0719 … 3.12" in text


def test_zoom_drag_and_follow_move_the_map(page, file):
    scale = page.evaluate("player.views[0].scale")
    page.click_on("#closer")
    assert page.evaluate("player.views[0].scale") == pytest.approx(1.5 * scale)
    left, top, width, height = page.box("#maps canvas")
    x, y = left + width / 2, top + height / 2
    before = page.evaluate("player.camera.x")
    page.point(x, y, "mousePressed")
    page.point(x + 30, y, buttons=1)
    page.point(x + 60, y, "mouseReleased")
    moved = before - page.evaluate("player.camera.x")
    assert moved == pytest.approx(30 / (1.5 * scale), rel=0.01)
    page.click_on("#whole")
    assert page.evaluate("player.views[0].scale") == pytest.approx(scale)
    page.evaluate("player.go(50)")
    page.click_on("#follow")
    pose = file[1][0].trace.poses[50]
    found = page.evaluate(f"player.views[0].px({pose[0]})")
    assert found == pytest.approx(
        page.evaluate("player.views[0].canvas.clientWidth") / 2, abs=0.1
    )


def test_a_finger_on_a_phone_chooses_and_shows(browser, file):
    browser.open(file[0], size=(390, 844), touch=True)
    trace = file[1][0].trace
    browser.evaluate("player.go(120)")
    browser.tap(*place_of(browser, trace, 120, trace.landmarks[0]))
    browser.wait_for("!hint.hidden")
    assert f"landmark {trace.landmark_ids[0]}" in browser.text("#hint")
    assert browser.text("#chosen").startswith("Correlation of landmark")
    assert browser.messages == browser.requests == []


@pytest.mark.parametrize("size", [(1280, 900), (390, 844), (320, 600)])
def test_nothing_is_wider_than_the_window(browser, file, size):
    browser.open(file[0], size=size)
    browser.evaluate("player.go(60)")
    assert browser.evaluate("document.documentElement.scrollWidth") == size[0]


@pytest.mark.parametrize("dark", [False, True])
def test_the_page_follows_the_colours_of_the_reader(browser, file, dark, tmp_path):
    browser.open(file[0], dark=dark)
    browser.evaluate("player.go(60)")
    browser.screenshot(tmp_path / "page.png")
    with Image.open(tmp_path / "page.png") as picture:
        shown = np.asarray(picture.convert("RGB"), dtype=int)
    paper = (20, 23, 27) if dark else (255, 255, 255)
    assert (shown == paper).all(axis=-1).mean() > 0.6
    blue = (92, 179, 236) if dark else (0, 114, 178)
    orange = (240, 176, 64) if dark else (185, 122, 0)
    for colour in (blue, orange):
        assert (abs(shown - colour).max(axis=-1) < 12).sum() > 300


def test_hidden_identities_mark_clutter_and_walls_are_drawn(browser, tmp_path):
    path = tmp_path / "run.html"
    runs = written_page(path, "hidden_identities", ("invariant",), management=True)
    browser.open(path)
    legend = browser.text("#legend")
    assert "tentative" in legend
    assert "clutter, in truth" in legend
    assert len(runs[0].frames.maps) == STEPS + 1
    assert browser.messages == browser.requests == []


def test_the_whole_map_holds_every_true_landmark_as_the_picture_does(page, file):
    trace = file[1][0].trace
    assert len(trace.world_landmarks) == 20 > len(trace.landmarks)
    box = page.evaluate("player.camera.box")
    (left, low), (right, high) = (
        extreme(trace.world_landmarks, axis=0) for extreme in (np.min, np.max)
    )
    assert box["left"] <= left + 1e-4 < right <= box["right"] + 1e-4
    assert box["low"] <= low + 1e-4 < high <= box["high"] + 1e-4


def test_a_hostile_name_is_only_text(browser, tmp_path):
    written_page(tmp_path / "run.html", filters=("ekf", HOSTILE))
    browser.open(tmp_path / "run.html")
    assert browser.evaluate("document.title") == f"loop: ekf, {HOSTILE} – slamgym run"
    assert browser.text("#filters button:nth-child(2)") == HOSTILE
    browser.evaluate("player.go(60)")
    assert browser.messages == browser.requests == []


def test_the_policy_of_the_page_runs_no_other_script(browser, file, tmp_path):
    text = file[0].read_text(encoding="utf-8")
    added = text.replace("</main>", "<script>document.title = 'taken'</script></main>")
    (tmp_path / "run.html").write_text(added, encoding="utf-8")
    browser.open(tmp_path / "run.html")
    assert browser.evaluate("document.title") == "loop: ekf, invariant – slamgym run"
    assert any("Content Security Policy" in said for said in browser.messages)


def test_a_broken_page_says_so(browser, file, tmp_path):
    text = file[0].read_text(encoding="utf-8")
    start = text.index('id="arrays">') + len('id="arrays">')
    (tmp_path / "run.html").write_text(text[:start] + "AAAA" + text[start:])
    browser.open(tmp_path / "run.html")
    assert "The run cannot be shown" in browser.text("#failure")


def test_the_test_itself_sees_messages_and_requests(browser, tmp_path):
    path = tmp_path / "asking.html"
    path.write_text(
        '<script>undefined_function()</script><img src="http://127.0.0.1:9/">'
    )
    browser.open(path)
    assert any("undefined_function" in said for said in browser.messages)
    assert browser.requests == ["http://127.0.0.1:9/"]
