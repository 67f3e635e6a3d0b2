import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from slamgym.sim_configs import ScenarioError, load_scenario, place_landmarks
from slamgym.sim_configs.landmarks_and_controls import (
    CorridorLayout,
    GridLayout,
    PointsLayout,
    RandomLayout,
    RingLayout,
)

LAYOUTS = [
    PointsLayout(points=((1.0, 2.0), (3.0, 4.0))),
    GridLayout(rows=2, columns=3, spacing=2.0, origin=(10.0, 20.0)),
    RingLayout(count=7, radius=3.0, centre=(1.0, 2.0)),
    CorridorLayout(count=5, length=8.0, width=2.0, origin=(1.0, 3.0)),
    RandomLayout(count=9, bounds=(0.0, 0.0, 5.0, 5.0), min_distance=0.5),
]


def rng(seed=0):
    return np.random.default_rng(seed)


def nearest_gap(positions):
    gaps = np.linalg.norm(positions[:, None] - positions, axis=2)
    return gaps[~np.eye(len(positions), dtype=bool)].min()


@pytest.mark.parametrize("layout", LAYOUTS, ids=lambda layout: layout.layout)
def test_count_is_the_number_of_positions(layout):
    positions = place_landmarks(layout, rng())
    assert positions.shape == (layout.count, 2)
    assert positions.dtype == np.float64


@pytest.mark.parametrize("layout", LAYOUTS[:4], ids=lambda layout: layout.layout)
def test_fixed_layouts_draw_nothing(layout):
    generator = rng()
    before = generator.bit_generator.state
    place_landmarks(layout, generator)
    assert generator.bit_generator.state == before


def test_points_stand_where_they_are_told():
    assert place_landmarks(LAYOUTS[0], rng()).tolist() == [[1.0, 2.0], [3.0, 4.0]]


def test_a_grid_goes_along_x_first():
    assert place_landmarks(LAYOUTS[1], rng()).tolist() == [
        [10.0, 20.0],
        [12.0, 20.0],
        [14.0, 20.0],
        [10.0, 22.0],
        [12.0, 22.0],
        [14.0, 22.0],
    ]


def test_a_ring_goes_round_its_centre_from_plus_x():
    offsets = place_landmarks(LAYOUTS[2], rng()) - (1.0, 2.0)
    angles = np.unwrap(np.arctan2(offsets[:, 1], offsets[:, 0]))
    assert np.allclose(np.hypot(*offsets.T), 3.0)
    assert np.allclose(angles, 2 * np.pi / 7 * np.arange(7))


def test_a_corridor_changes_sides_from_the_left_on():
    assert place_landmarks(LAYOUTS[3], rng()).tolist() == [
        [1.0, 4.0],
        [3.0, 2.0],
        [5.0, 4.0],
        [7.0, 2.0],
        [9.0, 4.0],
    ]


@settings(max_examples=25)
@given(
    count=st.integers(1, 30),
    corner=st.tuples(st.floats(-50, 50), st.floats(-50, 50)),
    seed=st.integers(0, 2**32),
)
def test_random_landmarks_keep_their_bounds_and_distance(count, corner, seed):
    x, y = corner
    bounds = (x, y, x + 20.0, y + 10.0)
    layout = RandomLayout(count=count, bounds=bounds, min_distance=1.3)
    positions = place_landmarks(layout, rng(seed))
    assert (positions >= bounds[:2]).all()
    assert (positions <= bounds[2:]).all()
    assert count == 1 or nearest_gap(positions) >= 1.3


def test_random_landmarks_fill_their_bounds_evenly():
    layout = RandomLayout(count=4000, bounds=(-2.0, 0.0, 2.0, 10.0))
    quarters = place_landmarks(layout, rng()) > (0.0, 5.0)
    assert np.allclose(quarters.mean(axis=0), 0.5, atol=4 * 0.5 / np.sqrt(4000))


@pytest.mark.parametrize("seed", [0, 5, None])
def test_the_generator_decides_only_without_a_seed(seed):
    layout = RandomLayout(count=5, bounds=(0.0, 0.0, 9.0, 9.0), seed=seed)
    generator = rng(1)
    before = generator.bit_generator.state
    first = place_landmarks(layout, generator)
    assert (generator.bit_generator.state == before) == (seed is not None)
    assert np.array_equal(first, place_landmarks(layout, rng(1)))
    same = np.array_equal(first, place_landmarks(layout, rng(2)))
    assert same == (seed is not None)


def test_landmarks_that_do_not_fit_are_refused():
    layout = RandomLayout(count=50, bounds=(0.0, 0.0, 3.0, 3.0), min_distance=1.0)
    with pytest.raises(ScenarioError, match=r"min_distance must leave room for 50 .*"):
        place_landmarks(layout, rng())


@pytest.mark.parametrize("bounds", [[1, 0, 1, 2], [0, 2, 1, 1]])
def test_empty_bounds_are_refused(bounds):
    with pytest.raises(ScenarioError, match=r"landmarks\.bounds must have xmin < xmax"):
        load_scenario("dense").with_changes(landmarks={"bounds": bounds})


def test_the_dense_preset_has_200_landmarks_apart():
    layout = load_scenario("dense").landmarks
    positions = place_landmarks(layout, rng())
    assert len(positions) == 200
    assert nearest_gap(positions) >= layout.min_distance > 0
