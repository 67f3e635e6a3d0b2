import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from slamgym.envs.controllers import planned_path
from slamgym.sim_configs import (
    ScenarioError,
    action_sequence,
    list_presets,
    load_scenario,
)
from slamgym.sim_configs.landmarks_and_controls import (
    BlocksSequence,
    CircleSequence,
    CommandSequence,
    FigureEightSequence,
    SpiralSequence,
    SquareSequence,
)

CLOSED = [
    SquareSequence(side=5.0, speed=0.7, turn_steps=3),
    CircleSequence(radius=4.0, speed=0.7),
    FigureEightSequence(radius=4.0, speed=0.7),
]


def drive(commands):
    """Go straight, then turn, one command after the other."""
    x = y = heading = 0.0
    path = [(x, y, heading)]
    for distance, turn in commands:
        x += distance * math.cos(heading)
        y += distance * math.sin(heading)
        heading += turn
        path.append((x, y, heading))
    return np.array(path)


def distance_of_segments(point, walls):
    start, end = walls[:, :2], walls[:, 2:]
    along = end - start
    share = ((point - start) * along).sum(axis=1) / (along**2).sum(axis=1)
    foot = start + np.clip(share, 0.0, 1.0)[:, None] * along
    return np.linalg.norm(foot - point, axis=1).min()


def test_commands_are_repeated_in_order():
    controls = CommandSequence(commands=((3.0, 0.0, 2), (1.0, -0.5, 1)))
    assert controls.cycle(1.0).tolist() == [[3, 0], [3, 0], [1, -0.5]]


@pytest.mark.parametrize("controls", CLOSED, ids=lambda controls: controls.sequence)
@pytest.mark.parametrize("dt", [0.1, 0.5, 1.0])
def test_closed_sequences_come_home(controls, dt):
    end = drive(controls.cycle(dt))[-1]
    assert np.allclose(end[:2], 0.0, atol=1e-9)
    assert math.remainder(end[2], 2 * math.pi) == pytest.approx(0.0, abs=1e-9)


@given(
    length=st.floats(0.1, 50), speed=st.floats(0.1, 2), dt=st.sampled_from([0.1, 1.0])
)
def test_no_step_is_longer_than_the_speed_allows(length, speed, dt):
    for controls in (
        SquareSequence(side=length, speed=speed, turn_steps=2),
        CircleSequence(radius=length, speed=speed),
        FigureEightSequence(radius=length, speed=speed),
        BlocksSequence(columns=2, rows=2, side=length, speed=speed, turn_steps=2),
    ):
        assert controls.cycle(dt)[:, 0].max() <= speed * dt * (1 + 1e-9)


def test_a_square_has_sides_of_its_length_and_goes_left():
    path = drive(CLOSED[0].cycle(1.0))
    corners = path[[0, 11, 22, 33, 44], :2]
    assert np.allclose(corners, [[0, 0], [5, 0], [5, 5], [0, 5], [0, 0]])


def test_a_side_of_whole_steps_takes_no_step_more():
    controls = SquareSequence(side=2.1, speed=0.3, turn_steps=1)
    assert 2.1 / 0.3 > 7
    assert len(controls.cycle(1.0)) == 4 * (7 + 1)


def test_a_circle_keeps_its_radius_to_the_left():
    path = drive(CLOSED[1].cycle(0.5))
    centre = path[:-1, :2].mean(axis=0)
    assert np.allclose(np.hypot(*(path[:, :2] - centre).T), 4.0)
    assert centre[1] > 0


def test_a_figure_eight_goes_left_then_right():
    path = drive(CLOSED[2].cycle(0.5))
    half = len(path) // 2
    assert path[: half + 1, 1].min() > -1.0
    assert path[half:, 1].max() < 1.0
    assert np.ptp(path[:, 1]) == pytest.approx(16.0, abs=0.1)


def test_a_spiral_widens_from_its_inner_to_its_outer_radius():
    controls = SpiralSequence(inner_radius=1.0, outer_radius=5.0, turns=2.0, speed=0.2)
    distances, turns = controls.cycle(0.5).T
    radii = distances / turns
    assert np.allclose(distances, 0.1)
    assert radii[0] == pytest.approx(1.0)
    assert radii[-1] == pytest.approx(5.0, rel=0.01)
    assert (np.diff(radii) > 0).all()
    assert 4 * math.pi <= turns.sum() < 4 * math.pi + turns[0]


def test_a_spiral_grows_evenly_with_the_angle():
    controls = SpiralSequence(inner_radius=1.0, outer_radius=5.0, turns=2.0, speed=0.2)
    distances, turns = controls.cycle(0.5).T
    turned = np.concatenate([[0.0], np.cumsum(turns)[:-1]])
    assert np.allclose(distances / turns, 1.0 + turned / math.pi)


def test_a_spiral_inwards_is_refused():
    spiral = {"sequence": "spiral", "turns": 1.0, "speed": 0.1}
    with pytest.raises(ScenarioError, match=r"controls\.outer_radius must be >= "):
        load_scenario("six_landmarks").with_changes(
            controls={**spiral, "inner_radius": 3.0, "outer_radius": 2.0}
        )


@pytest.mark.parametrize(
    "controls",
    [
        {"commands": [[0.0, 0.0, 10**12]]},
        {"sequence": "circle", "radius": 1e9, "speed": 1e-3},
        {"sequence": "blocks", "columns": 10**9, "rows": 2, "side": 1.0, "speed": 0.1,
         "turn_steps": 2},
        {"sequence": "square", "side": 1.0, "speed": 0.1, "turn_steps": 10**12},
        {"sequence": "spiral", "inner_radius": 1.0, "outer_radius": 2.0,
         "turns": 1e9, "speed": 0.5},
    ],
)  # fmt: skip
def test_an_endless_sequence_is_refused_at_once(controls):
    with pytest.raises(ScenarioError, match="controls must come to at most 1000000"):
        load_scenario("six_landmarks").with_changes(controls=controls)


def test_actions_are_commands_over_dt_and_start_again():
    scenario = load_scenario("six_landmarks").with_changes(
        dt=2.0, steps=5, controls={"commands": [[1.0, 0.5, 2], [2.0, 0.0, 1]]}
    )
    assert action_sequence(scenario).tolist() == [
        [0.5, 0.25], [0.5, 0.25], [1.0, 0.0], [0.5, 0.25], [0.5, 0.25],
    ]  # fmt: skip


@pytest.mark.parametrize("name", list_presets())
def test_presets_stay_within_the_limits_of_their_robot(name):
    scenario = load_scenario(name)
    fastest = np.abs(action_sequence(scenario)).max(axis=0)
    assert action_sequence(scenario).shape == (scenario.steps, 2)
    assert fastest[0] <= scenario.robot.max_speed
    assert fastest[1] <= scenario.robot.max_turn_rate


def test_six_landmarks_drives_the_five_sides_of_the_homework():
    scenario = load_scenario("six_landmarks")
    side, corner = [[3.0, 0.0]] * 5, [[1.0, 1.2566]]
    commands = (side + corner) * 4 + side
    assert scenario.steps == 29
    assert np.allclose(action_sequence(scenario) * scenario.dt, commands, rtol=1e-15)


def test_loop_drives_four_laps_of_ten_metres_radius():
    path = planned_path(load_scenario("loop"))
    assert path[-1, 2] / (2 * math.pi) == pytest.approx(4.0, rel=1e-3)
    assert np.ptp(path[:, 1]) / 2 == pytest.approx(10.0, abs=0.01)


@pytest.mark.parametrize("name", ["corridor", "hidden_identities"])
def test_laps_end_where_they_began(name):
    assert np.allclose(planned_path(load_scenario(name))[-1, :2], 0.0, atol=1e-9)


def test_the_corridors_own_controls_touch_no_wall():
    scenario = load_scenario("corridor")
    walls = np.array(scenario.walls)
    path = planned_path(scenario)[:, :2]
    between = np.concatenate([path, (path[1:] + path[:-1]) / 2])
    gap = min(distance_of_segments(point, walls) for point in between)
    assert gap > scenario.robot.radius + 0.5
