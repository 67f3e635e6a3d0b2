"""The noise study over many runs."""

import csv
import json

import numpy as np
import pytest
from drawn import check_looks

from slamgym.experiments import monte_carlo_study as package
from slamgym.experiments.command_line.commands import Reporter
from slamgym.experiments.command_line.noise_study import (
    NoiseStudyOptions,
    effects_study,
    write_study,
)
from slamgym.experiments.monte_carlo_study import monte_carlo
from slamgym.experiments.monte_carlo_study.verdict import scores_of
from slamgym.experiments.noise_study import (
    noise_effects,
    noise_effects_figure,
    scaled_scenario,
)
from slamgym.experiments.run_and_replay.filter_settings import SIGMAS
from slamgym.sim_configs import load_scenario

RUNS = 30

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def effects():
    return noise_effects("six_landmarks", "ekf,invariant[iterations=3]", RUNS)


def one(effects, changed, sigma, factor, estimator="invariant[iterations=3]"):
    (found,) = (
        effect
        for effect in effects
        if (effect.changed, effect.sigma, effect.factor) == (changed, sigma, factor)
        and effect.estimator == estimator
    )
    return found


def test_every_noise_changes_in_world_and_filter_and_in_each_alone(effects):
    kinds = [effect[:3] for effect in effects if effect.estimator == "ekf"]
    assert kinds[0] == ("nothing", "none", 1.0)
    assert kinds[1:] == [
        (place, sigma, factor)
        for place in ("both", "world", "filter")
        for sigma in SIGMAS
        for factor in (10.0, 0.1)
    ]


def test_figures_are_those_of_a_monte_carlo_told_the_same(effects):
    world = load_scenario("six_landmarks")
    results = monte_carlo(
        world, "ekf", RUNS, assumed=scaled_scenario(world, "σβ", 10)
    ).isel(step=slice(1, None), estimator=0)
    found = one(effects, "filter", "σβ", 10.0, "ekf")
    nees = results.pose_nees_invariant.values / 3
    assert found.nees_per_degree == pytest.approx(nees.mean())
    assert found.nees_per_degree_median == pytest.approx(np.median(nees.mean(axis=1)))
    error = nees.mean(axis=1).std(ddof=1) / np.sqrt(RUNS)
    assert found.nees_per_degree_error == pytest.approx(error)
    assert found.pose_area == pytest.approx(float(results.pose_area.mean()))
    assert (found.runs, found.failed) == (RUNS, 0)


def test_a_filter_told_the_truth_stays_honest_and_one_told_too_little_does_not(effects):
    for sigma in ("σy", "σβ", "σr"):
        assert 0.7 < one(effects, "both", sigma, 0.1).nees_per_degree < 1.4
        assert one(effects, "filter", sigma, 0.1).nees_per_degree > 1.8
        assert one(effects, "world", sigma, 10.0).nees_per_degree > 1.8
    for place in ("world", "filter"):
        for sigma, factor in (("σβ", 10.0), ("σr", 10.0)):
            cautious = 1 / factor if place == "world" else factor
            assert one(effects, place, sigma, cautious).nis_per_degree < 0.7


def test_a_worse_sensor_in_the_filter_widens_its_ellipses(effects):
    wide = one(effects, "filter", "σr", 10.0)
    right = one(effects, "nothing", "none", 1.0)
    assert wide.landmark_area > 2 * right.landmark_area


def test_the_figure_shows_a_panel_for_each_place(effects):
    figure = noise_effects_figure(effects)
    assert len(figure.axes) == 3
    for axes in figure.axes:
        marks = [line for line in axes.lines if line.get_marker() not in ("", "None")]
        assert len(marks) == 22  # (1 + 2 × 5) of two estimators
    names = [tick.get_text() for tick in figure.axes[0].get_yticklabels()]
    assert names == ["unchanged", *SIGMAS]
    few = [e for e in effects if e.estimator == "ekf" and e.sigma in ("none", "σy")]
    check_looks(noise_effects_figure(few), "noise_effects_figure")


def test_bars_of_the_figure_are_a_standard_error_to_either_side(effects):
    figure = noise_effects_figure([e for e in effects if e.estimator == "ekf"])
    lines = figure.axes[0].lines
    bars = [line.get_xdata() for line in lines if line.get_marker() == "None"]
    shown = [e for e in effects if e.changed in ("nothing", "both")]
    for effect in (e for e in shown if e.estimator == "ekf"):
        mean, error = effect.nees_per_degree, effect.nees_per_degree_error
        assert any(np.allclose(bar, [mean - error, mean + error]) for bar in bars)
    assert "standard error" in figure.get_supxlabel()


def test_runs_have_failed_where_the_report_says_so(monkeypatch):
    results = monte_carlo("six_landmarks", "ekf", 4).load()
    results["nis"].loc[{"run": 1, "step": 7}] = np.nan
    results["pose_nees_invariant"].loc[{"run": 2, "step": 9}] = 1e200
    results["position_error"].loc[{"run": 3, "step": 9}] = 1e7  # far off, yet a number
    monkeypatch.setattr(package, "monte_carlo", lambda *_, **__: results)
    reference = noise_effects("six_landmarks", "ekf", 4)[0]
    scores = scores_of(results, "ekf", "invariant")
    assert reference.failed == len(scores.failures) == 2
    assert reference.runs == 2
    nees = results.pose_nees_invariant.values[0, [0, 3], 1:] / 3
    assert reference.nees_per_degree == pytest.approx(nees.mean())


@pytest.mark.parametrize("runs", [1, 2])
def test_table_csv_and_summary_show_the_error_where_there_is_one(
    runs, tmp_path, capsys
):
    world = load_scenario("six_landmarks")
    given = NoiseStudyOptions(
        estimator="ekf", option_texts=["min_range=2"], runs=runs, change="filter"
    )
    study = effects_study(world, given)
    write_study(study, tmp_path / "study", Reporter(as_json=True))
    with (tmp_path / "study" / "noise_study.csv").open(encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    told = json.loads((tmp_path / "study" / "summary.json").read_text("utf-8"))["rows"]
    for row, entry in zip(rows, told, strict=True):
        error = float(row["nees_per_degree_error"])
        assert np.isnan(error) == (entry["nees_per_degree_error"] is None)
        assert np.isnan(error) == (runs == 1)
        assert row["estimator"] == "ekf[min_range=2]"


def test_another_place_is_refused():
    with pytest.raises(ValueError, match="did you mean 'filter'"):
        noise_effects("six_landmarks", "ekf", 2, changed=["filtre"])
