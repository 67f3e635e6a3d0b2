"""The smoother as a row of a Monte Carlo: judged as a filter is, but without NIS."""

import numpy as np
import pytest

from slamgym.estimator.smoother import Drive, smooth
from slamgym.experiments.monte_carlo_study import monte_carlo
from slamgym.experiments.monte_carlo_study.report import write_html_report
from slamgym.experiments.monte_carlo_study.summary import (
    consistency_of,
    summarise_monte_carlo,
)
from slamgym.experiments.run_and_replay.simulated_runs import simulate_runs
from slamgym.sim_configs import load_scenario

RUNS = 24
WORLD = load_scenario("six_landmarks")

pytestmark = pytest.mark.slow  # two processes smooth


@pytest.fixture(scope="module")
def results():
    return monte_carlo(WORLD, "invariant,smoother", RUNS, seed=70)


def test_its_poses_are_those_of_the_whole_drive(results):
    runs = simulate_runs(WORLD, 1, 70)
    drive = Drive(
        WORLD.motion.std,
        WORLD.sensor.std,
        initial_pose=runs.initial_poses[0],
        initial_pose_std=WORLD.start.std,
    )
    for step in range(30):
        if step:
            drive.predict(runs.odometry[0, step])
        seen = np.flatnonzero(runs.visible[0, step])
        drive.update(runs.measurements[0, step, seen], seen)
    smoothed, run = smooth(drive), results.sel(estimator="smoother", run=0)
    errors = np.linalg.norm((smoothed.poses - runs.true_poses[0])[:, :2], axis=1)
    assert run.position_error.values == pytest.approx(errors, abs=1e-7)
    stds = np.sqrt(smoothed.pose_covariances[:, 2, 2])
    assert run.heading_std.values == pytest.approx(stds, rel=1e-6)


def test_it_is_judged_by_its_errors_and_has_no_nis(results):
    report = consistency_of(results, "smoother")
    assert report.accepted
    assert not any("NIS" in sentence for sentence in report.sentences())
    assert any("NIS" in s for s in consistency_of(results, "invariant").sentences())
    entry = summarise_monte_carlo(results)["estimators"]["smoother"]
    assert entry["nis"] is None
    assert entry["decisions"]["nis"]["p_value"] is None
    assert 0.8 < entry["nees_end"]["state"] < 1.2


def test_it_is_more_accurate_than_the_filter_on_the_way(results):
    filtered, smoothed = (
        results.sel(estimator=label).ate_aligned.mean() for label in results.estimator
    )
    assert smoothed < filtered


@pytest.mark.usefixtures("_figures_in_reports_are_blank")
def test_the_report_draws_the_nis_of_filters_only(results, tmp_path):
    both, alone = tmp_path / "both.html", tmp_path / "alone.html"
    write_html_report(results, summarise_monte_carlo(results), both)
    smoother = results.sel(estimator=["smoother"])
    write_html_report(smoother, summarise_monte_carlo(smoother), alone)
    question = "Are the innovations as large as claimed, and white?"
    assert question in both.read_text()
    assert question not in alone.read_text()


def test_it_takes_a_robust_kernel_and_refuses_what_is_none():
    robust = monte_carlo(WORLD, "smoother[robust=cauchy]", 2, seed=70)
    assert not robust.failed.any()
    with pytest.raises(ValueError, match="robust must be 'huber' or 'cauchy'"):
        monte_carlo(WORLD, "smoother[robust=tukey]", 2)


def test_worlds_that_hide_identities_are_smoothed_with_the_associations_decided():
    world = load_scenario("hidden_identities")
    world = world.model_copy(update={"steps": 60})
    results = monte_carlo(world, "invariant,smoother", 2, seed=3)
    filtered, smoothed = (results.sel(estimator=name) for name in results.estimator)
    assert not results.failed.any()
    assert not (smoothed.nis_dof > 0).any()
    assert smoothed.position_std.mean() < filtered.position_std.mean()
    assert (smoothed.ate < 1.2 * filtered.ate).all()


def test_of_several_hypotheses_the_most_probable_one_is_smoothed():
    world = load_scenario("hidden_identities").with_changes(steps=40)
    options = {"management": {"association": "hypotheses"}}
    pair = {"filter": ("invariant", options), "smoother": ("smoother", options)}
    results = monte_carlo(world, pair, 1, seed=3)
    assert not results.failed.any()
    filtered, smoothed = (results.sel(estimator=name, run=0) for name in pair)
    assert smoothed.state_dof == filtered.state_dof
    assert smoothed.position_std.mean() < filtered.position_std.mean()
