"""Published results, repeated with few runs by benchmarks/published.py."""

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.append(str(Path(__file__).parents[2] / "benchmarks"))
import published
from published import SOURCES, compare, filtered, root, world

RUNS = {"symmetries": 5, "castellanos": 10}  # the robocentric filter runs alone


@pytest.mark.slow
@pytest.mark.parametrize("name", [n for n in SOURCES if n not in published.NEED_DATA])
def test_our_numbers_agree_with_the_published_ones(name):
    rows = list(SOURCES[name].rows(RUNS.get(name, 30)))
    assert len(rows) >= 4
    assert not [row for row in rows if not row.agrees]


def test_one_more_scan_at_the_start_is_another_world_than_the_published_one():
    start = {"pose": (0.0, 0.0, 0.0), "std": (0.0, 0.0, 0.0)}
    other = world("ukfm").with_changes(start=start, steps=1000)
    row = compare("", 3.01, filtered(other, "ekf", 30).heading_error(), root)
    assert not row.agrees
    assert row.ours == pytest.approx(1.5, abs=0.4)


def test_the_interval_holds_95_percent_of_the_studies_with_as_many_runs():
    rng = np.random.default_rng(1)
    theirs, ours = rng.gamma(2.0, size=(200, 20)), rng.gamma(2.0, size=(200, 40))
    inside = [
        compare("", pair[0].mean(), pair[1], published_runs=20).agrees
        for pair in zip(theirs, ours, strict=True)
    ]
    assert 0.9 < np.mean(inside) < 0.99


@pytest.mark.parametrize(
    "path", sorted(published.WORLDS.iterdir()), ids=lambda p: p.stem
)
def test_a_world_names_its_source_in_its_first_line(path):
    assert world(path.stem).name == path.stem
    assert path.read_text().startswith("# ")
