"""A city: streets like a grid, landmarks on the fronts, a drive round every block."""

import numpy as np

from slamgym.envs.controllers import planned_path
from slamgym.sim_configs import load_scenario, place_landmarks
from slamgym.sim_configs.landmarks_and_controls import BlocksSequence, StreetsLayout

CITY = StreetsLayout(
    columns=3, rows=2, side=10.0, width=4.0, per_front=2, origin=(100.0, 50.0)
)
DRIVE = BlocksSequence(columns=3, rows=2, side=10.0, speed=0.8, turn_steps=2)


def positions(layout=CITY):
    return place_landmarks(layout, np.random.default_rng(0))


def crossings():
    """Where the drive is after each of its sides."""
    x = y = heading = 0.0
    path = [(0.0, 0.0)]
    for distance, turn in DRIVE.cycle(1.0):
        x, y = x + distance * np.cos(heading), y + distance * np.sin(heading)
        heading += turn
        path.append((x, y))
    path = np.array(path)
    near = np.abs(path / 10 - np.round(path / 10)).max(axis=1) < 1e-9
    places = np.round(path[near] / 10).astype(int)
    return places[np.r_[True, np.abs(np.diff(places, axis=0)).sum(axis=1) > 0]]


def test_the_first_block_is_gone_round_from_its_lower_left():
    assert (positions()[:8] - (100, 50)).tolist() == [
        [3.5, 2], [6.5, 2], [8, 3.5], [8, 6.5], [6.5, 8], [3.5, 8], [2, 6.5], [2, 3.5],
    ]  # fmt: skip


def test_every_block_is_a_copy_of_the_first_in_rows_along_x():
    blocks = positions().reshape(6, 8, 2) - positions()[:8]
    corners = [[0, 0], [10, 0], [20, 0], [0, 10], [10, 10], [20, 10]]
    assert len(positions()) == CITY.count == 48
    assert np.allclose(blocks, np.array(corners)[:, None])


def test_the_drive_goes_round_every_block_and_closes_its_loop():
    places = crossings().tolist()
    assert places[:6] == [[0, 0], [1, 0], [1, 1], [0, 1], [0, 0], [1, 0]]
    loops = set()
    for first in range(len(places) - 4):
        if places[first] == places[first + 4]:
            loops.add(tuple(np.mean(places[first : first + 4], axis=0)))
    blocks = {(i + 0.5, j + 0.5) for i in range(3) for j in range(2)}
    assert blocks <= loops


def test_the_drive_stays_on_the_streets_of_its_city():
    path = planned_path(load_scenario("city").with_changes(steps=33_000))[:, :2]
    off = np.abs(path - 10 * np.round(path / 10)).min(axis=1)
    assert off.max() < 1e-6
    assert path.min() > -1e-6
    assert path[:31_000].max() < 250 + 1e-6


def test_the_preset_has_10000_landmarks_and_a_dozen_in_view():
    city = load_scenario("city")
    landmarks = positions(city.landmarks)
    assert len(landmarks) == 10_000
    path = planned_path(city)[::50, :2]
    distances = np.linalg.norm(landmarks - path[:, None], axis=2)
    seen = (distances < city.sensor.max_range).sum(axis=1)
    assert seen.min() >= 4
    assert 8 <= np.median(seen) <= 20
    assert distances.min() > 1.0
