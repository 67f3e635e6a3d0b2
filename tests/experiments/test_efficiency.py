"""The bound in a Monte Carlo: variables, summary, table and figure."""

import numpy as np
import pytest

from slamgym.experiments.monte_carlo_study import monte_carlo, summarise_monte_carlo
from slamgym.experiments.monte_carlo_study.report import (
    html_report,
    measures,
    monte_carlo_table,
)
from slamgym.experiments.monte_carlo_study.verdict import _heading_knowledge, scores_of
from slamgym.sim_configs import load_scenario

RUNS = 30
WORLD = load_scenario("six_landmarks")


@pytest.fixture(scope="module")
def results():
    return monte_carlo(WORLD, "ekf,invariant,smoother", RUNS, seed=7)


@pytest.fixture(scope="module")
def summary(results):
    return summarise_monte_carlo(results)


def test_efficiency_is_the_bound_by_the_mean_squared_error(results, summary):
    found = results.sel(estimator="invariant").isel(step=slice(1, None))
    for name, bound, error in (
        ("pose", found.position_bound, found.position_error_invariant),
        ("heading", found.heading_bound, found.heading_error),
        ("map", found.map_bound, found.map_error_centred),
    ):
        entry = summary["estimators"]["invariant"]["efficiency"][name]
        assert entry["value"] == pytest.approx(float(bound.mean() / (error**2).mean()))
        assert entry["interval"][0] < entry["value"] < entry["interval"][1]


def test_the_heading_is_compared_with_what_can_be_known(results):
    scores = scores_of(results, "invariant", "invariant")
    end = results.sel(estimator="invariant").isel(step=-1)
    expected = end.heading_std**2 / end.heading_bound
    np.testing.assert_allclose(_heading_knowledge(scores), expected)


def test_no_filter_is_significantly_better_than_the_bound(summary):
    for name in ("ekf", "invariant"):
        for found in summary["estimators"][name]["efficiency"].values():
            assert found["interval"][0] < 1


def test_a_smoother_is_bounded_in_its_map_only(summary):
    found = summary["estimators"]["smoother"]["efficiency"]
    assert found["pose"] is None
    assert found["heading"] is None
    assert 0.5 < found["map"]["value"] < 1.5


@pytest.mark.slow
def test_table_and_report_show_the_efficiency(results, summary):
    rows = {measure.name: measure.of for measure in measures(summary)}
    cell = rows["efficiency of the position"]
    value = summary["estimators"]["ekf"]["efficiency"]["pose"]["value"]
    assert cell(summary["estimators"]["ekf"]).startswith(f"{value:.2f} ± ")
    assert cell(summary["estimators"]["smoother"]) == "–"
    page = html_report(results, summary)
    assert "bound of any filter" in page
    reason = "An efficiency is – where no bound is known"
    assert reason in page
    assert reason in monte_carlo_table(summary).caption.plain
    del summary["estimators"]["smoother"]
    assert reason not in monte_carlo_table(summary).caption.plain


def test_the_table_states_why_a_sensor_has_no_efficiency():
    world = load_scenario("bearing").with_changes(steps=20)
    summary = summarise_monte_carlo(monte_carlo(world, "ekf", 2))
    assert set(summary["estimators"]["ekf"]["efficiency"].values()) == {None}
    caption = monte_carlo_table(summary).caption.plain
    assert "for sensors other than bearing_range and position" in caption


def test_results_without_bounds_have_no_efficiency(results):
    older = results.drop_vars("position_bound")
    entry = summarise_monte_carlo(older)["estimators"]["ekf"]
    assert entry["efficiency"] is None


def test_hidden_identities_do_not_change_the_bound():
    world = load_scenario("hidden_identities").with_changes(steps=30)
    hidden = monte_carlo(world, "invariant", 2, seed=3)
    assert np.isfinite(hidden.position_bound).all()
    assert (hidden.position_bound[0, :, -1] > 0).all()
