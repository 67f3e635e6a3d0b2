"""The report as a web page: whole, safe, alone, and seen in a real browser."""

import ast
import html
import itertools
import json
import re
import tomllib
from html.parser import HTMLParser

import numpy as np
import pytest
import xarray as xr
from monte_carlo_dataset import typical, with_failures
from PIL import Image

from slamgym.experiments.monte_carlo_study import monte_carlo
from slamgym.experiments.monte_carlo_study import report as module
from slamgym.experiments.monte_carlo_study.report import (
    headline,
    html_report,
    write_html_report,
)
from slamgym.experiments.monte_carlo_study.summary import summarise_monte_carlo
from slamgym.experiments.noise_study import scaled_scenario
from slamgym.sim_configs import load_scenario

HOSTILE = "</title></pre><script>alert(\"1\")</script> & '$x$' 100 %"


class Outline(HTMLParser):
    """Elements of a page, its texts, and whether it is nested as it should be."""

    def __init__(self, page):
        super().__init__()
        self.open, self.elements, self.texts = [], [], []
        self.feed(page)

    def handle_starttag(self, tag, attributes):
        self.elements.append((tag, dict(attributes)))
        if tag not in {"meta", "link", "wbr"}:
            self.open.append(tag)

    def handle_startendtag(self, tag, attributes):
        self.elements.append((tag, dict(attributes)))

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, text):
        self.texts.append(text)

    def attributes(self, name):
        return [found[name] for _, found in self.elements if name in found]


def page_of(dataset):
    return html_report(dataset, summarise_monte_carlo(dataset))


def typical_results():
    return with_failures(typical(), [("ekf", 3, 12, "LinAlgError: <lost>")])


def hostile_results():
    failures = [("ekf", 3, 12, HOSTILE), ("ekf", 5, -1, "")]
    dataset = with_failures(typical(), failures)
    dataset = dataset.assign_coords(estimator=[HOSTILE, "_b<i>$\\frac$"])
    dataset.attrs |= {"scenario_name": HOSTILE, "command": HOSTILE}
    dataset.attrs["scenario"] = f"# {HOSTILE}\n" + dataset.attrs["scenario"]
    dataset.attrs["assumed"] = f"# assumed {HOSTILE}"
    dataset.attrs["versions"] = json.dumps({"a<b>": HOSTILE})
    return dataset


@pytest.fixture(scope="module")
def hostile_page():
    return page_of(hostile_results())


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    path = tmp_path_factory.mktemp("report") / "report.html"
    dataset = typical_results()
    write_html_report(dataset, summarise_monte_carlo(dataset), path)
    return path


@pytest.mark.slow
def test_the_page_says_verdicts_numbers_and_how_to_do_it_again(report):
    outline = Outline(report.read_text(encoding="utf-8"))
    text = " ".join(outline.texts).replace("\xa0", " ")
    assert not outline.open
    for words in (
        "six_landmarks: ekf not consistent; invariant consistent",
        "1 of 40 runs failed; of the others",
        "averaged over 40 runs",
        "LinAlgError: <lost>",
        "slamgym monte-carlo six_landmarks --estimators ekf,invariant --runs 40",
        'name = "six_landmarks"',
        "run i is the world of seed 0 + i",
    ):
        assert words in text
    assert outline.elements[0] == ("html", {"lang": "en"})
    assert [tag for tag, _ in outline.elements].count("h1") == 1
    assert outline.texts.index("ekf") < text.index("In numbers")


@pytest.mark.usefixtures("_no_figures_in_reports")
def test_numbers_on_the_page_are_those_of_the_summary():
    dataset = typical()
    page = page_of(dataset)
    rows = dict(re.findall(r'<tr><th scope="row">(.*?)</th>(.*?)</tr>', page))
    later = dataset["pose_nees_invariant"].isel(step=slice(1, None))
    nees = later.mean(("run", "step"))
    cells = re.findall(r"<td>(.*?)</td>", rows["NEES / 3, invariant frame"])
    assert [float(cell) for cell in cells] == pytest.approx(nees.values / 3, abs=0.005)
    std = np.sqrt((dataset["heading_std"].isel(step=-1) ** 2).mean("run"))
    cells = re.findall(r"<td>(.*?)°</td>", rows["heading at the end, claimed"])
    assert [float(c) for c in cells] == pytest.approx(np.degrees(std).values, abs=0.05)


@pytest.mark.slow
def test_every_figure_has_a_name_and_its_ids_are_its_own(report):
    outline = Outline(report.read_text(encoding="utf-8"))
    figures = [found for tag, found in outline.elements if tag == "svg"]
    assert len(figures) == 5
    assert all(found["role"] == "img" and found["aria-label"] for found in figures)
    ids = outline.attributes("id")
    assert len(ids) == len(set(ids))
    page = report.read_text(encoding="utf-8")
    assert set(re.findall(r'(?:url\(#|href="#)([^)"]+)', page)) == set(ids)


@pytest.mark.slow
def test_colours_and_fonts_of_figures_come_from_the_page(report):
    page = report.read_text(encoding="utf-8")
    drawn = "".join(re.findall(r"<svg.*?</svg>", page, re.DOTALL))
    assert not re.findall(r"#[0-9a-fA-F]{3,6}\b(?!-)", re.sub(r'"#[^"]*"', "", drawn))
    assert "font-family" not in drawn
    used = set(re.findall(r"var\((--\w+)\)", page))
    light, dark = page.split("prefers-color-scheme: dark")
    assert all(f"{name}:" in light for name in used)
    assert all(f"{name}:" in dark for name in used - {"--mono"})


@pytest.mark.slow
def test_the_page_asks_for_nothing_and_runs_nothing(report):
    page = report.read_text(encoding="utf-8")
    outline = Outline(page)
    asked = [*outline.attributes("src"), *outline.attributes("href")]
    assert all(where.startswith(("#", "data:")) for where in asked)
    assert all(where.startswith("#") for where in re.findall(r"url\(([^)]*)\)", page))
    assert "@import" not in page
    tags = {tag for tag, _ in outline.elements}
    assert not tags & {"script", "iframe", "object", "img", "form", "base"}
    (policy,) = (
        found["content"]
        for _, found in outline.elements
        if found.get("http-equiv") == "Content-Security-Policy"
    )
    assert policy.startswith("default-src 'none'")


@pytest.mark.slow
def test_whatever_names_and_messages_hold_is_shown_as_text(hostile_page):
    outline = Outline(hostile_page)
    assert not outline.open
    assert "script" not in {tag for tag, _ in outline.elements}
    shown = [text.replace("\xa0", " ") for text in outline.texts]
    assert sum(HOSTILE in text for text in shown) >= 8
    assert html.escape(HOSTILE).replace(" %", "&nbsp;%") in hostile_page
    drawn = re.findall(r"<text[^>]*>([^<]*)</text>", hostile_page)
    assert HOSTILE in map(html.unescape, drawn)


@pytest.mark.usefixtures("_no_figures_in_reports")
def test_the_scenario_can_be_taken_from_the_page():
    page = page_of(typical())
    (text,) = re.findall(r"toml</summary>\n<pre[^>]*><code>(.*?)</code>", page, re.S)
    assert tomllib.loads(html.unescape(text))["name"] == "six_landmarks"


@pytest.mark.slow
def test_runs_that_all_failed_leave_a_page_without_figures():
    pairs = itertools.product(("ekf", "invariant"), range(40))
    failures = [(*pair, 3, "boom") for pair in pairs]
    page = page_of(with_failures(typical(), failures))
    assert "<svg" not in page
    assert "nothing to draw" in page
    assert page.count("boom") == 80


def call_on(page, folder):
    """Follow the page: save the scenarios that it shows, and run its call there."""
    (code,) = re.findall(r'<pre class="command"[^>]*><code>(.*?)</code>', page, re.S)
    code = html.unescape(code)
    titled = r"<summary>[^<]*, (\w+\.toml)</summary>\n<pre[^>]*><code>(.*?)</code>"
    for name, text in re.findall(titled, page, re.S):
        if repr(name) in code:
            assert f"save {name!r}" in code or f"and {name!r}" in code
            (folder / name).write_text(html.unescape(text), encoding="utf-8")
    last = ast.parse(code).body.pop()
    names = {}
    exec(code.removesuffix(ast.get_source_segment(code, last)), names)
    return eval(ast.get_source_segment(code, last), names), code


@pytest.mark.usefixtures("_no_figures_in_reports")
@pytest.mark.parametrize(
    ("changes", "assumed", "estimators"),
    [
        ({}, False, "ekf,invariant"),
        ({"steps": 5}, True, "invariant[iterations=3]"),
        ({"name": "my_own"}, False, {"mine": ("ekf", {"gate_probability": 0.99})}),
        ({}, True, {"mine": ("ekf", {"gate_probability": 0.99})}),
    ],
)
def test_the_call_on_the_page_makes_the_same_results(
    changes, assumed, estimators, tmp_path, monkeypatch
):
    world = load_scenario("six_landmarks").with_changes(**changes)
    told = scaled_scenario(world, "σr", 10) if assumed else None
    done = monte_carlo(world, estimators, 3, 4, assumed=told, block_size=2)
    monkeypatch.chdir(tmp_path)
    again, code = call_on(page_of(done), tmp_path)
    xr.testing.assert_identical(again, done)
    assert ("toml" in code) == (bool(changes) or assumed)


@pytest.mark.usefixtures("_no_figures_in_reports")
def test_the_call_of_a_later_part_of_the_runs_makes_that_part(tmp_path):
    done = monte_carlo("six_landmarks", "ekf", 5, 4, block_size=2, first_run=2)
    again, _ = call_on(page_of(done), tmp_path)
    xr.testing.assert_identical(again, done)


def test_many_estimators_are_counted_in_the_headline():
    entries = {str(i): {"verdict": "consistent"} for i in range(4)}
    said = headline({"scenario": "loop", "estimators": entries})
    assert said == "loop: 4 of 4 estimators consistent"


@pytest.mark.slow
def test_the_same_results_give_the_same_bytes(report):
    assert page_of(typical_results()) == report.read_text(encoding="utf-8")


@pytest.mark.usefixtures("_no_figures_in_reports")
def test_a_failure_leaves_the_old_report(report, tmp_path, monkeypatch):
    path = tmp_path / "report.html"
    path.write_text("old")
    summary = summarise_monte_carlo(typical())

    def broken_disk(path):
        raise OSError("disk full")

    monkeypatch.setattr(module, "replace_when_written", broken_disk)
    with pytest.raises(OSError, match="full"):
        write_html_report(typical(), summary, path)
    assert path.read_text() == "old"
    assert [entry.name for entry in tmp_path.iterdir()] == ["report.html"]


@pytest.mark.slow
def test_long_runs_of_several_estimators_stay_below_2_megabytes():
    short = typical()
    rows = np.arange(1005) % 29 + 1
    long = short.isel(step=np.concatenate([[0], rows]), estimator=[0, 1, 0, 1])
    long = long.assign_coords(step=np.arange(1006), estimator=list("abcd"))
    long.attrs["estimators"] = "{}"
    assert len(page_of(long).encode()) < 2e6


@pytest.mark.slow
def test_chromium_has_nothing_to_complain_of(report, tmp_path, browser):
    browser.open(report)
    assert browser.messages == []
    broken = tmp_path / "broken.html"
    broken.write_text("<script>undefined_function()</script>")
    browser.open(broken)
    assert any("undefined_function" in message for message in browser.messages)


@pytest.mark.slow
def test_chromium_asks_the_network_for_nothing(report, tmp_path, browser):
    asking = tmp_path / "asking.html"
    asking.write_text('<img src="http://127.0.0.1:9/picture.png">')
    browser.open(report)
    assert browser.requests == []
    browser.open(asking)
    assert browser.requests == ["http://127.0.0.1:9/picture.png"]


@pytest.mark.slow
def test_chromium_runs_no_script_of_hostile_results(hostile_page, tmp_path, browser):
    path = tmp_path / "report.html"
    path.write_text(hostile_page, encoding="utf-8")
    browser.open(path)
    assert "<script" not in browser.evaluate("document.documentElement.outerHTML")
    assert browser.messages == []


@pytest.mark.slow
@pytest.mark.parametrize("dark", [False, True])
def test_chromium_shows_every_figure_in_light_and_dark(report, tmp_path, dark, browser):
    browser.open(report, dark=dark)
    boxes = figure_boxes(browser)
    assert len(boxes) == 5
    pixels = pixels_of(browser, tmp_path / "screen.png", "RGB")
    paper = pixels[2, 2]
    assert (paper.mean() < 60) == dark
    for left, top, wide, high in boxes:
        part = pixels[int(top) : int(top + high), int(left) : int(left + wide)]
        apart = abs(part - paper).max(axis=2)
        assert 0.005 < np.mean(apart > 60) < 0.5
        assert len(np.unique(part.reshape(-1, 3), axis=0)) > 30


@pytest.mark.slow
@pytest.mark.parametrize("width", [390, 1280])
def test_the_page_does_not_scroll_sideways(report, width, browser):
    browser.open(report, size=(width, 900))
    assert browser.evaluate("document.documentElement.scrollWidth") == width
    boxes = figure_boxes(browser)
    assert all(wide >= min(0.9 * (width - 32), 400) for _, _, wide, _ in boxes)


@pytest.mark.slow
@pytest.mark.usefixtures("_no_figures_in_reports")
def test_two_estimators_fit_a_telephone_and_more_of_them_show_that_they_scroll(
    report, tmp_path, browser
):
    path = page_of_several(list("abcd"), tmp_path)
    browser.open(report, size=(390, 900))
    assert hidden_width_of_the_table(browser) <= 0
    assert shade_beside_the_table(browser, tmp_path) < 20
    browser.open(path, size=(390, 900))
    assert hidden_width_of_the_table(browser) > 0
    assert shade_beside_the_table(browser, tmp_path) > 60


@pytest.mark.slow
@pytest.mark.usefixtures("_no_figures_in_reports")
def test_seven_estimators_fit_a_wide_screen(tmp_path, browser):
    names = "ekf invariant first_estimates observability_constrained iterated unscented"
    path = page_of_several([*names.split(), "robocentric"], tmp_path)
    browser.open(path, size=(1280, 900))
    assert hidden_width_of_the_table(browser) <= 0


def page_of_several(names, folder):
    which = [k % 2 for k in range(len(names))]
    several = typical().isel(estimator=which).assign_coords(estimator=names)
    several.attrs["estimators"] = "{}"
    path = folder / "several.html"
    path.write_text(page_of(several), encoding="utf-8")
    return path


TABLE = "document.querySelector('.wide')"


def hidden_width_of_the_table(browser):
    """How much wider the main table is than the room that it has [px]."""
    return browser.evaluate(f"{TABLE}.scrollWidth - {TABLE}.clientWidth")


def shade_beside_the_table(browser, folder):
    """How much darker than the paper the table's right end is, where it is empty."""
    place = f"{TABLE}.getBoundingClientRect()"
    top = int(browser.evaluate(f"{place}.top"))
    right = int(browser.evaluate(f"{place}.left + {TABLE}.clientWidth"))
    pixels = pixels_of(browser, folder / "table.png", "L")
    return pixels[2, 2] - np.median(pixels[top + 50 : top + 400, right - 3])


def figure_boxes(browser):
    """Place of every figure on the page: (left, top, width, height) [px]."""
    return browser.evaluate(
        "[...document.querySelectorAll('figure svg')]"
        ".map((svg) => svg.getBoundingClientRect())"
        ".map((box) => [box.left, box.top, box.width, box.height])"
    )


def pixels_of(browser, path, mode):
    browser.screenshot(path)
    with Image.open(path) as picture:
        return np.asarray(picture.convert(mode)).astype(float)
