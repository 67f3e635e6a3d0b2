"""Faults of worlds, found by a Monte Carlo whose filters do not know them."""

from dataclasses import replace

import numpy as np
import pytest

from slamgym.estimator import EkfSlam
from slamgym.experiments.monte_carlo import (
    load_results,
    monte_carlo,
    summarise_monte_carlo,
)
from slamgym.experiments.monte_carlo.filtered_runs import noise_of_runs
from slamgym.experiments.monte_carlo.report import escaped as escape
from slamgym.experiments.monte_carlo.report import html_report
from slamgym.experiments.runs.simulated_runs import simulate_runs
from slamgym.sim_configs import load_scenario

RUNS, SEED = 60, 4000
WORLD = load_scenario("anchored")
WALLED = WORLD.with_changes(walls=[[4.0, -9.0, 4.0, 9.0]])


def summary_of(world, estimators="invariant", assumed=None, runs=RUNS):
    results = monte_carlo(
        world, estimators, runs, SEED, assumed=assumed, small_noise=True
    )
    return summarise_monte_carlo(results)


def causes(summary):
    entries = summary["estimators"]
    return {label: entry["diagnosis"]["cause"] for label, entry in entries.items()}


@pytest.mark.parametrize(
    ("faults", "cause"),
    [
        ({}, "honest"),
        ({"odometry_scale": 0.03}, "odometry scale"),
        ({"odometry_turn": -0.03}, "odometry turn"),
        ({"bearing_bias": 0.004}, "bearing bias"),
        ({"range_bias": -0.03}, "range bias"),
        ({"motion_dof": 4}, "heavy tails"),
        ({"sensor_dof": 4}, "heavy tails"),
    ],
)
def test_a_fault_that_no_filter_knows_is_named(faults, cause):
    assert causes(summary_of(WORLD.with_changes(faults=faults))) == {"invariant": cause}


def test_a_wrong_assumption_is_named_by_its_direction():
    small = WORLD.with_changes(motion={"std": [0.2, 0.08, 0.08]})
    found = summary_of(WORLD, assumed=small)
    assert causes(found) == {"invariant": "motion noise too small"}
    found = summary_of(small, assumed=WORLD)
    assert causes(found) == {"invariant": "motion noise too large"}


@pytest.mark.usefixtures("_no_figures_in_reports")
def test_linearisation_is_the_fault_of_one_filter_and_not_of_the_other():
    found = summary_of("six_landmarks", "ekf,invariant", runs=100)
    assert causes(found) == {"ekf": "linearisation", "invariant": "honest"}
    page = html_report(monte_carlo("six_landmarks", "ekf,invariant", 20, SEED), found)
    assert escape(found["estimators"]["ekf"]["diagnosis"]["sentence"]) in page


class Scaled(EkfSlam):
    """Reports two thirds of its covariance."""

    def belief(self, landmark_ids=None):
        found = super().belief(landmark_ids)
        return replace(found, covariance=found.covariance / 1.5)


class Offset(EkfSlam):
    """Believes its bearings to be a hundredth of a radian larger than they are."""

    def update(self, measurements, landmark_ids=None):
        rows = np.array(measurements, float).reshape(-1, 2)
        return super().update(rows + np.array([0.01, 0.0]), landmark_ids)


def test_errors_in_the_code_of_a_filter_are_not_called_linearisation(tmp_path):
    wrong = {"scaled": Scaled, "offset": Offset}
    results = monte_carlo(WORLD, wrong, 40, SEED, out=tmp_path, small_noise=True)
    share = results.attrs["small_noise_share"]
    assert 0 < share < 1
    results.close()
    with load_results(tmp_path) as stored:
        found = summarise_monte_carlo(stored)
        few = np.isfinite(stored.small_noise_factor).sum("run").values
    assert causes(found) == {"scaled": "wrong covariance", "offset": "wrong model"}
    assert (few >= 10).all()
    without = summarise_monte_carlo(monte_carlo(WORLD, wrong, 40, SEED))
    assert causes(without) == dict.fromkeys(wrong, "cannot tell")


def test_only_a_consistent_filter_is_honest():
    entry = summary_of(WORLD, runs=20)["estimators"]["invariant"]
    is_honest = entry["diagnosis"]["cause"] == "honest"
    assert is_honest == (entry["verdict"] == "consistent")


def test_association_is_named_where_landmarks_are_confused_and_not_elsewhere():
    points = [[x + d, y] for x, y in WORLD.landmarks.points for d in (-0.15, 0.15)]
    apart = WORLD.with_changes(
        sensor={"identities": False}, motion={"std": [0.025, 0.01, 0.01]}
    )
    pairs = apart.with_changes(landmarks={"points": points})
    managed = {"association": "nearest", "confirm": [1, 1]}
    chosen = {"managed": ("invariant", {"management": managed})}
    confused = summary_of(pairs, chosen, runs=20)
    assert causes(confused) == {"managed": "association"}
    sentence = confused["estimators"]["managed"]["diagnosis"]["sentence"]
    assert "per degree with known identities" in sentence
    assert causes(summary_of(apart, chosen, runs=20)) == {"managed": "honest"}


def test_results_without_noise_have_no_diagnosis():
    results = monte_carlo(WORLD, "invariant", 2).drop_vars("noise_sums")
    summary = summarise_monte_carlo(results)
    assert summary["estimators"]["invariant"]["diagnosis"] is None


def test_few_runs_are_not_diagnosed():
    assert causes(summary_of(WORLD, runs=2)) == {"invariant": "cannot tell"}


def sizes(assumed, runs):
    """Standard scores of the mean squares of εx, εy and εα."""
    sums = noise_of_runs(assumed, assumed, runs)[:, :3].sum(axis=0)
    return (sums[:, 2] / sums[:, 0] - 1) / np.sqrt(2 / sums[:, 0])


def test_walls_that_shorten_displacements_are_no_smaller_noise():
    runs = simulate_runs(WALLED, 200, SEED)
    assert np.abs(sizes(WALLED, runs)).max() < 3
    assert sizes(WALLED.with_changes(walls=[]), runs)[:2].max() < -10
