"""The noise study over many runs."""

import numpy as np
import pytest

from slamgym.experiments.filter_settings import SIGMAS
from slamgym.experiments.monte_carlo import monte_carlo
from slamgym.experiments.noise_effects import noise_effects
from slamgym.experiments.noise_effects_plots import noise_effects_figure
from slamgym.experiments.noise_study import scaled_scenario
from slamgym.sim_configs import load_scenario

RUNS = 30


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
    wide, right = (
        one(effects, "filter", "σr", 10.0),
        one(effects, "nothing", "none", 1.0),
    )
    assert wide.landmark_area > 2 * right.landmark_area


def test_the_figure_shows_a_panel_for_each_place(effects):
    figure = noise_effects_figure(effects)
    assert len(figure.axes) == 3
    for axes in figure.axes:
        marks = [line for line in axes.lines if line.get_marker() not in ("", "None")]
        assert len(marks) == 22  # (1 + 2 × 5) of two estimators
    names = [tick.get_text() for tick in figure.axes[0].get_yticklabels()]
    assert names == ["unchanged", *SIGMAS]


def test_another_place_is_refused():
    with pytest.raises(ValueError, match="did you mean 'filter'"):
        noise_effects("six_landmarks", "ekf", 2, changed=["filtre"])
