"""Faults of worlds, found by a Monte Carlo whose filters do not know them."""

import re
from dataclasses import replace

import numpy as np
import pytest

from slamgym.estimator import EkfSlam
from slamgym.experiments.monte_carlo_study import (
    load_results,
    monte_carlo,
    summarise_monte_carlo,
)
from slamgym.experiments.monte_carlo_study.filtered_runs import noise_of_runs
from slamgym.experiments.monte_carlo_study.report import escaped as escape
from slamgym.experiments.monte_carlo_study.report import html_report
from slamgym.experiments.monte_carlo_study.runner import (
    with_less_noise,
    with_noise_times,
)
from slamgym.experiments.monte_carlo_study.verdict import diagnosis_lines
from slamgym.experiments.run_and_replay.simulated_runs import simulate_runs
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
def test_runs_with_less_noise_are_those_of_a_world_with_less_noise():
    six = load_scenario("six_landmarks")

    def scaled(motion, factor):
        return six.with_changes(
            start={"std": [factor * std for std in six.start.std]},
            motion={"std": [factor * std for std in motion]},
            sensor={
                "std": [factor * std for std in six.sensor.std],
                "range_std_per_metre": factor * 0.01,
            },
        )

    def study(factor, last, **options):
        world, assumed = (
            scaled((0.25, 0.1, 0.1), factor),
            scaled((0.24, 0.1, 0.1), factor),
        )
        of_runs = {"block_size": 5, "first_run": 5, "assumed": assumed, **options}
        return monte_carlo(world, "ekf", last, SEED, **of_runs).isel(estimator=0)

    found = study(1.0, 35, small_noise=True)
    repeated = np.isfinite(found.small_noise_factor.values)
    (factor,) = np.unique(found.small_noise_factor[repeated])
    again = study(factor, 5 + repeated.sum())
    for frame in ("invariant", "additive"):
        nees = again[f"pose_nees_{frame}"][:, 1:].mean("step")
        np.testing.assert_allclose(found[f"small_noise_nees_{frame}"][repeated], nees)
    error = again.position_error[:, 1:].mean("step")
    np.testing.assert_allclose(found.small_noise_position_error[repeated], error)


def test_every_noise_is_multiplied_by_its_own_factor():
    world = WORLD.with_changes(
        sensor={"range_std_per_metre": 0.02}, gps={"std": 0.5}, compass={"std": 0.1}
    )
    apart = with_noise_times(world, 2.0, 3.0)
    np.testing.assert_allclose(apart.motion.std, 2 * np.array(world.motion.std))
    np.testing.assert_allclose(apart.sensor.std, 3 * np.array(world.sensor.std))
    assert apart.sensor.range_std_per_metre == pytest.approx(0.06)
    less = with_less_noise(world, 0.1)
    for table in ("motion", "sensor", "start", "gps", "compass"):
        before, after = (np.array(getattr(w, table).std) for w in (world, less))
        np.testing.assert_allclose(after, 0.1 * before)
    assert less.sensor.range_std_per_metre == pytest.approx(0.002)
    assert with_less_noise(WORLD, 0.1).gps is None


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


NUMBER = r"(\d[\d.]*(?:e[+-]\d+)?)"


def refutations(entry):
    """Read the figures of a cause, and list those that contradict it."""
    cause, text = entry["diagnosis"]["cause"], entry["diagnosis"]["sentence"]
    if cause in ("honest", "cannot tell"):
        return []
    is_unseen = "the errors do not show it" in text
    is_good = entry["verdict"] == "consistent"
    found = ["the verdict is consistent"] * (is_good and not is_unseen)
    before = float(re.search(rf"are {NUMBER} times what the cov", text)[1])
    chance = [float(p) for p in re.findall(rf"\(p [=<] {NUMBER}\)", text)]
    found += ["it may be chance"] * (min(chance) > 0.05)
    sizes = [float(size) for size in re.findall(rf"σ\w is {NUMBER} times", text)]
    if cause.endswith("too small"):
        found += ["the noise is smaller"] * (sizes[0] <= 1)
        found += ["the errors are smaller"] * (before < 0.9 and not is_unseen)
    if cause.endswith("too large"):
        found += ["the noise is larger"] * (sizes[0] >= 1)
        found += ["the errors are larger"] * (before > 1.1 and not is_unseen)
    if (less := re.search(rf"of the noise, .*? are {NUMBER} times", text)) is None:
        return found
    after, tenth = float(less[1]), re.search(rf"with a tenth {NUMBER} times", text)
    interval = re.search(rf"interval {NUMBER} to {NUMBER}\)", text)
    low, high = [after, after] if interval is None else map(float, interval.groups())
    if cause == "linearisation":
        found += ["an excess may remain"] * (not 0.5 < low < 1.25 or not high < 1.55)
        found += ["it does not shrink"] * (abs(after - 1) >= abs(before - 1))
    if cause == "wrong covariance":
        diverged = re.search(r"and (\d+) of \d+ runs diverged, ", text)
        found += ["nothing may remain"] * (low <= 1 <= high and diverged is None)
    if cause == "wrong model":
        former = before if tenth is None else float(tenth[1])
        found += ["it does not grow"] * (after <= 5 * former)
    return found


class Swapped(EkfSlam):
    """Assumes the deviations of the motion in another order."""

    def __init__(self, motion_std, **options):
        super().__init__(np.asarray(motion_std)[[1, 0, 2]], **options)

    def belief(self, landmark_ids=None):
        return super().belief(landmark_ids)


SMALL = {"motion": {"std": [0.1, 0.1, 0.08]}, "sensor": {"std": [0.03, 0.06]}}


@pytest.mark.parametrize(
    ("world", "assumed"),
    [
        ("six_landmarks", {}),
        ("anchored", {}),
        ("anchored", SMALL),
        ("unknown_heading", {}),
        ("slippery", {}),
    ],
)
def test_no_figure_of_a_cause_refutes_it(world, assumed):
    world = load_scenario(world)
    wrong = {"scaled": Scaled, "offset": Offset, "swapped": Swapped}
    chosen = {"ekf": "ekf", "invariant": "invariant", **wrong}
    found = summary_of(world, chosen, assumed=world.with_changes(**assumed), runs=40)
    refuted = {
        label: (reasons, entry["diagnosis"]["sentence"])
        for label, entry in found["estimators"].items()
        if (reasons := refutations(entry))
    }
    assert refuted == {}


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


class WithCovariance(EkfSlam):
    """Reports another covariance from the twelfth correction on."""

    steps = 0

    def update(self, measurements, landmark_ids=None):
        self.steps += 1
        return super().update(measurements, landmark_ids)

    def belief(self, landmark_ids=None):
        found = super().belief(landmark_ids)
        changed = found.covariance.copy()
        if self.steps >= 12:
            self.change(changed)
        return replace(found, covariance=changed)


class Correlated(WithCovariance):
    def change(self, P):
        P[0, 1] = P[1, 0] = 1.02 * np.sqrt(P[0, 0] * P[1, 1])


class Certain(WithCovariance):
    def change(self, P):
        P[:] = 0.0


class Negative(WithCovariance):
    def change(self, P):
        P[2, 2] *= -1.0


class Crossed(WithCovariance):
    """Errs first between the pose and a landmark, three steps later in the pose."""

    def change(self, P):
        P[0, 3] = P[3, 0] = 1.3 * np.sqrt(P[0, 0] * P[3, 3])
        if self.steps >= 15:
            P[0, 0] *= -1.0


@pytest.mark.parametrize(
    ("filter_class", "step", "text"),
    [
        (Correlated, 11, r"the pose has the correlation 1\.02 of x and y$"),
        (Certain, 11, "the pose is all zeros$"),
        (Negative, 11, r"the pose has the variance -[\d.e-]+ of θ$"),
        (
            Crossed,
            14,
            r"of the pose has the variance -.* of x; since step 11, the covariance of "
            r"the pose and landmark (\d) has the correlation -?1\.3 of x and x of \1$",
        ),
    ],
)
def test_a_run_without_nees_names_the_wrong_part_of_its_covariance(
    filter_class, step, text
):
    results = monte_carlo(WORLD.with_changes(steps=20), {"bad": filter_class}, 3, SEED)
    entry = summarise_monte_carlo(results)["estimators"]["bad"]
    (group,) = entry["failure_groups"]
    assert (group["count"], group["step"]) == (3, step)
    assert re.search(text, group["message"]), group["message"]


def test_only_a_consistent_filter_is_honest():
    entry = summary_of(WORLD, runs=20)["estimators"]["invariant"]
    is_honest = entry["diagnosis"]["cause"] == "honest"
    assert is_honest == (entry["verdict"] == "consistent")


@pytest.mark.parametrize("runs", [8, 20])
def test_an_honest_filter_that_needs_more_runs_gets_no_line_about_a_cause(runs):
    results = monte_carlo(WORLD, "invariant", runs, SEED + 1)
    summary = summarise_monte_carlo(results)
    entry = summary["estimators"]["invariant"]
    assert entry["verdict"] == "not shown"
    assert entry["diagnosis"]["cause"] == "cannot tell"
    assert not any("cause" in line for line in diagnosis_lines("invariant", entry))
    assert "Cause:" not in html_report(results, summary)


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
