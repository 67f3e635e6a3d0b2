"""Ranges in a scenario: what is drawn from them, and what is refused."""

import math

import numpy as np
import pytest

from slamgym.sim_configs import (
    ScenarioError,
    drawn_scenario,
    load_scenario,
    place_landmarks,
    save_scenario,
)
from slamgym.sim_configs.scenario import RANGES, Randomise
from slamgym.sim_configs.scenario_files import copied_draw, widest_scenario

BASE = load_scenario("dropout")  # a random layout with a seed of its own, finite range
FACTORS = {
    "motion_std": lambda s: s.motion.std[0] / BASE.motion.std[0],
    "measurement_std": lambda s: s.sensor.std[1] / BASE.sensor.std[1],
    "start_std": lambda s: s.start.std[2] / 0.3,
}
VALUES = {
    "dropout": lambda s: s.sensor.dropout,
    "max_range": lambda s: s.sensor.max_range,
    "field_of_view": lambda s: s.sensor.field_of_view,
    "start_x": lambda s: s.start.pose[0],
    "start_y": lambda s: s.start.pose[1],
    "start_heading": lambda s: s.start.pose[2],
}


def draws(ranges, count=400, base=BASE):
    scenario = base.with_changes(randomise=ranges)
    return [drawn_scenario(scenario, np.random.default_rng(k)) for k in range(count)]


def test_a_draw_depends_on_its_generator_alone():
    scenario = BASE.with_changes(randomise={"max_range": [2.0, 6.0]})
    first, again = (drawn_scenario(scenario, np.random.default_rng(3)) for _ in "ab")
    other = drawn_scenario(scenario, np.random.default_rng(4))
    assert first == again != other
    assert first.randomise is None
    assert drawn_scenario(BASE, np.random.default_rng(0)) is BASE


@pytest.mark.parametrize("name", FACTORS)
def test_factors_are_uniform_in_their_logarithm(name):
    base = BASE.with_changes(start={"std": [0.1, 0.2, 0.3]})
    drawn = draws({name: [0.25, 4.0]}, base=base)
    exponents = np.array([math.log(FACTORS[name](each), 4) for each in drawn])
    assert exponents.min() >= -1.0
    assert exponents.max() <= 1.0
    assert abs(exponents.mean()) < 4 * (2 / math.sqrt(12)) / math.sqrt(400)
    assert abs((exponents**2).mean() - 1 / 3) < 4 * 0.3 / math.sqrt(400)


def test_one_factor_holds_for_all_noise_of_a_kind():
    base = BASE.with_changes(sensor={"range_std_per_metre": 0.02})
    (drawn,) = draws({"measurement_std": [3.0, 3.0]}, count=1, base=base)
    assert drawn.sensor.std == tuple(3.0 * std for std in base.sensor.std)
    assert drawn.sensor.range_std_per_metre == 3.0 * 0.02
    assert drawn.motion == base.motion


def test_what_has_no_range_stays():
    (drawn,) = draws({"start_x": [1.0, 2.0]}, count=1)
    pose = (drawn.start.pose[0], *BASE.start.pose[1:])
    assert drawn == BASE.with_changes(start={"pose": pose})


def test_a_range_changes_nothing_of_what_others_give():
    alone = draws({"max_range": [2.0, 6.0]}, count=5)
    shift = {"landmark_shift": 0.5, "motion_std": [0.5, 2.0]}
    among = draws({"max_range": [2.0, 6.0], **shift}, count=5)
    assert [a.sensor for a in alone] == [b.sensor for b in among]


def positions(scenario):
    return place_landmarks(scenario.landmarks, np.random.default_rng(0))


def test_landmarks_shift_by_up_to_the_bound_and_fill_it():
    before = positions(BASE)
    shifts = [positions(each) - before for each in draws({"landmark_shift": 0.5}, 50)]
    assert np.abs(shifts).max() <= 0.5 + 1e-12
    assert abs(np.mean(shifts)) < 0.03
    assert np.std(shifts) == pytest.approx(0.5 / math.sqrt(3), rel=0.05)
    assert np.std([shift[0] for shift in shifts]) > 0.2  # anew in every episode


def test_a_stretched_map_keeps_its_mean_and_its_angles():
    before, after = positions(BASE), positions(draws({"map_scale": [2.0, 2.0]}, 1)[0])
    middle = before.mean(axis=0)
    assert after.mean(axis=0) == pytest.approx(middle)
    assert after - middle == pytest.approx(2.0 * (before - middle))


def test_a_map_that_is_new_in_every_episode_is_stretched_and_stays_so():
    layout = {"layout": "random", "count": 5, "bounds": [0.0, 0.0, 2.0, 4.0]}
    base = BASE.with_changes(landmarks={**layout, "min_distance": 0.1})
    (drawn,) = draws({"map_scale": [3.0, 3.0]}, 1, base=base)
    assert drawn.landmarks.bounds == (-2.0, -4.0, 4.0, 8.0)
    assert drawn.landmarks.min_distance == pytest.approx(0.3)
    assert drawn.landmarks.seed is None


@pytest.mark.parametrize("preset", ["six_landmarks", "corridor", "hidden_identities"])
def test_no_draw_changes_the_number_of_landmarks(preset):
    base = load_scenario(preset)
    ranges = {"map_scale": [0.5, 2.0], "max_range": [3.0, 6.0]}
    for each in draws(ranges, count=10, base=base):
        assert each.landmarks.count == base.landmarks.count


def test_ranges_survive_a_file(tmp_path):
    ranges = {"motion_std": [0.5, 2.0], "start_x": [-1, 1], "landmark_shift": 0.1}
    scenario = BASE.with_changes(randomise=ranges)
    save_scenario(scenario, tmp_path / "ranges.toml")
    assert load_scenario(tmp_path / "ranges.toml") == scenario
    assert hash(load_scenario(tmp_path / "ranges.toml")) == hash(scenario)


def test_ranges_are_a_table_of_a_scenario_file(tmp_path):
    save_scenario(BASE, tmp_path / "base.toml")
    text = (
        tmp_path / "base.toml"
    ).read_text() + "\n[randomise]\nmax_range = [2, 6.5]\n"
    (tmp_path / "ranges.toml").write_text(text)
    ranges = load_scenario(tmp_path / "ranges.toml").randomise
    assert ranges == Randomise(max_range=(2.0, 6.5))


@pytest.mark.parametrize(
    ("ranges", "message"),
    [
        ({"motion_sd": [1, 2]}, r"unknown key 'motion_sd'.*did you mean 'motion_std'"),
        ({"motion_std": [0, 2]}, "randomise.motion_std must be 2 finite factors > 0"),
        ({"motion_std": 2.0}, "randomise.motion_std must be 2 finite factors > 0"),
        ({"start_x": [0, math.inf]}, "randomise.start_x must be 2 finite numbers"),
        ({"start_x": [2, 1]}, r"randomise.start_x must have low <= high, got \(2"),
        ({"dropout": [0.5, 1.5]}, "at the high ends sensor.dropout must be a number"),
        ({"dropout": [-0.5, 0.5]}, "at the low ends sensor.dropout must be a number"),
        ({"max_range": [0.01, 5]}, "at the low ends sensor.min_range must be < max_ra"),
        ({"clutter": [0, 1]}, "at the high ends sensor.clutter must be 0 unless"),
        ({"landmark_shift": -1}, "randomise.landmark_shift must be a finite number >="),
    ],
)
def test_ranges_that_cannot_be_are_refused_with_a_reason(ranges, message):
    with pytest.raises(ScenarioError, match=message):
        BASE.with_changes(randomise=ranges)


def test_a_shift_of_landmarks_that_are_new_anyway_is_refused():
    layout = {"layout": "random", "count": 5, "bounds": [0.0, 0.0, 2.0, 4.0]}
    with pytest.raises(ScenarioError, match="landmark_shift must be 0 where every"):
        BASE.with_changes(landmarks=layout, randomise={"landmark_shift": 1.0})


@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_a_draw_is_that_of_its_formula_at_a_share_of_the_ranges(share):
    ranges = {name: [0.3, 0.9] for name in (*FACTORS, *VALUES)}
    fixed = {"start": {"std": [0.1, 0.2, 0.3]}, "sensor": {"min_range": 0.1}}
    scenario = BASE.with_changes(randomise=ranges, **fixed)
    drawn = scenario.at_share(share)
    for name, factor in FACTORS.items():
        assert factor(drawn) == pytest.approx(0.3 * 3.0**share), name
    for name, value in VALUES.items():
        assert value(drawn) == pytest.approx(0.3 + 0.6 * share), name
        assert share < 1 or value(drawn) == 0.9, name  # not but for rounding
    unmoved = np.zeros((BASE.landmarks.count, 2))
    assert copied_draw(scenario, dict.fromkeys(RANGES, share), unmoved) == drawn
    assert (widest_scenario(scenario) == drawn) == (share == 1)
    assert widest_scenario(BASE) is BASE
    scaled = BASE.with_changes(randomise={"map_scale": [0.5, 2.0]})
    points = place_landmarks(BASE.landmarks, np.random.default_rng(0))
    for moved in (unmoved, unmoved + 0.3):
        shares = dict.fromkeys(RANGES, share)
        map_of = copied_draw(scaled, shares, moved).landmarks
        middle = points.mean(axis=0)
        expected = middle + 0.5 * 4**share * (points - middle)
        np.testing.assert_allclose(map_of.points, expected)
