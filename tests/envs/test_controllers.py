import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from presets import PRESETS
from scipy.spatial import KDTree

from slamgym.envs.controllers import (
    CONTROLLERS,
    OpenLoop,
    RandomWalk,
    Waypoints,
    make_controller,
    planned_path,
)
from slamgym.sim_configs import Robot, load_scenario

ORIGIN = (0.0, 0.0, 0.0)
ROBOT = Robot(max_speed=0.5, max_turn_rate=0.8)


def rng(seed=0):
    return np.random.default_rng(seed)


def drive(controller, steps, *, dt, pose=ORIGIN, noise=None):
    """Let a controller drive the turn-last model, which may slip."""
    x, y, heading = pose
    path = [(x, y, heading)]
    for step in range(steps):
        speed, turn_rate = controller.act(path[-1], step)
        slip = np.zeros(3) if noise is None else noise.normal(0.0, [0.02, 0.02, 0.05])
        x += (speed * dt + slip[0]) * math.cos(heading) - slip[1] * math.sin(heading)
        y += (speed * dt + slip[0]) * math.sin(heading) + slip[1] * math.cos(heading)
        heading += turn_rate * dt + slip[2]
        path.append((x, y, heading))
    return np.array(path)


@pytest.mark.parametrize("name", CONTROLLERS)
@settings(deadline=None, max_examples=40)
@given(
    pose=st.tuples(*[st.floats(-1e3, 1e3)] * 3),
    step=st.integers(0, 10_000),
    seed=st.integers(0, 1000),
)
def test_every_action_is_within_the_limits(name, pose, step, seed):
    scenario = load_scenario("corridor")
    controller = make_controller(name, scenario, rng(seed))
    action = controller.act(pose, step)
    assert action.shape == (2,)
    assert action.dtype == np.float64
    assert abs(action[0]) <= scenario.robot.max_speed
    assert abs(action[1]) <= scenario.robot.max_turn_rate


@pytest.mark.parametrize("name", CONTROLLERS)
def test_an_action_may_be_changed_by_its_receiver(name):
    first, second = (
        make_controller(name, load_scenario("loop"), rng()) for _ in range(2)
    )
    first.act(ORIGIN, 0)[:] = 7.0
    second.act(ORIGIN, 0)
    assert np.array_equal(first.act(ORIGIN, 1005), second.act(ORIGIN, 1005))


@pytest.mark.parametrize("name", CONTROLLERS)
def test_the_same_seed_drives_the_same_way(name):
    first, second = (
        drive(make_controller(name, scenario, rng(3)), 50, dt=1.0)
        for scenario in (load_scenario("loop"), "loop")
    )
    assert np.array_equal(first, second)


def test_an_unknown_controller_is_refused_with_a_suggestion():
    with pytest.raises(ValueError, match=r"got 'waypoint'; did you mean 'waypoints'"):
        make_controller("waypoint", load_scenario("loop"), rng())


def test_open_loop_gives_the_actions_in_order_and_again():
    actions = [[0.1, 0.2], [0.3, -0.4], [0.5, 0.0]]
    driver = OpenLoop(actions, ROBOT)
    assert [driver.act(ORIGIN, step).tolist() for step in range(5)] == (
        actions + actions[:2]
    )


def test_open_loop_clips_to_the_limits():
    driver = OpenLoop([[-9.0, 9.0]], ROBOT)
    assert driver.act(ORIGIN, 0).tolist() == [-0.5, 0.8]


@pytest.mark.parametrize("name", PRESETS)
def test_open_loop_drives_the_planned_path(name):
    scenario = load_scenario(name)
    controller = make_controller("open_loop", scenario, rng())
    path = drive(controller, scenario.steps, dt=scenario.dt, pose=scenario.start.pose)
    assert np.allclose(path, planned_path(scenario), atol=1e-9)


def test_the_planned_path_starts_at_the_start():
    scenario = load_scenario("loop").with_changes(start={"pose": [1.0, 2.0, 0.5]})
    straight, moved = planned_path(load_scenario("loop")), planned_path(scenario)
    turn = np.array([[math.cos(0.5), math.sin(0.5)], [-math.sin(0.5), math.cos(0.5)]])
    assert np.allclose(moved[:, :2], straight[:, :2] @ turn + (1.0, 2.0))
    assert np.allclose(moved[:, 2], straight[:, 2] + 0.5)


@settings(max_examples=20, deadline=None)
@given(
    points=st.lists(
        st.tuples(st.floats(-5, 5), st.floats(-5, 5)), min_size=1, max_size=4
    ),
    heading=st.floats(-20, 20),
    seed=st.integers(0, 1000),
)
def test_waypoints_are_all_visited_in_order_despite_slip(points, heading, seed):
    dt, tolerance = 0.5, 0.2
    driver = Waypoints(points, ROBOT, dt=dt, tolerance=tolerance)
    path = drive(driver, 600, dt=dt, pose=(0.0, 0.0, heading), noise=rng(seed))
    step = 0
    for point in points:
        gaps = np.linalg.norm(path[step:, :2] - point, axis=1)
        assert gaps.min() <= tolerance
        step += int(np.argmax(gaps <= tolerance))


def test_a_robot_that_looks_away_turns_on_the_spot_the_shorter_way():
    driver = Waypoints([(-5.0, 0.5)], ROBOT, dt=0.5, tolerance=0.1)
    assert driver.act(ORIGIN, 0).tolist() == [0.0, 0.8]
    driver = Waypoints([(-5.0, -0.5)], ROBOT, dt=0.5, tolerance=0.1)
    assert driver.act(ORIGIN, 0).tolist() == [0.0, -0.8]


@pytest.mark.parametrize("turns", [-3, -1, 1, 2])
def test_full_turns_in_the_heading_do_not_matter(turns):
    driver = Waypoints([(5.0, 2.0)], ROBOT, dt=0.5, tolerance=0.1)
    wound = driver.act((0.0, 0.0, 0.3 + 2 * math.pi * turns), 0)
    assert np.allclose(wound, driver.act((0.0, 0.0, 0.3), 0))


def test_the_last_bit_is_driven_without_overshoot():
    driver = Waypoints([(0.15, 0.0)], ROBOT, dt=0.5, tolerance=0.1)
    assert driver.act(ORIGIN, 0).tolist() == pytest.approx([0.3, 0.0])


def test_after_the_last_waypoint_the_robot_stands_still():
    driver = Waypoints([(1.0, 0.0)], ROBOT, dt=0.5, tolerance=0.1)
    driver.act(ORIGIN, 0)
    assert driver.act((1.05, 0.0, 0.0), 1).tolist() == [0.0, 0.0]
    assert driver.act((9.0, 0.0, 0.0), 2).tolist() == [0.0, 0.0]


def test_a_loop_of_waypoints_begins_again():
    square = [(2.0, 0.0), (2.0, 2.0), (0.0, 2.0), (0.0, 0.0)]
    driver = Waypoints(square, ROBOT, dt=0.5, tolerance=0.1, loop=True)
    path = drive(driver, 300, dt=0.5)
    assert np.linalg.norm(np.diff(path[-40:, :2], axis=0), axis=1).sum() > 2.0
    near_first = np.linalg.norm(path[:, :2] - square[0], axis=1) <= 0.1
    assert (np.diff(near_first.astype(int)) == 1).sum() >= 3


def test_a_loop_whose_waypoints_are_all_reached_stands_still():
    points = [(0.0, 0.0), (0.05, 0.0)]
    driver = Waypoints(points, ROBOT, dt=0.5, tolerance=0.1, loop=True)
    assert driver.act(ORIGIN, 0).tolist() == [0.0, 0.0]


def test_step_zero_begins_with_the_first_waypoint_again():
    driver = Waypoints([(1.0, 0.0), (1.0, 5.0)], ROBOT, dt=0.5, tolerance=0.1)
    first = driver.act(ORIGIN, 0)
    driver.act((1.0, 0.0, 0.0), 1)
    assert np.array_equal(driver.act(ORIGIN, 0), first)


@pytest.mark.parametrize("name", PRESETS)
def test_waypoints_keep_near_the_planned_path_of_a_preset(name):
    scenario = load_scenario(name)
    controller = make_controller("waypoints", scenario, rng())
    path = drive(controller, scenario.steps, dt=scenario.dt, pose=scenario.start.pose)
    plan = planned_path(scenario)[:, :2]
    gaps, _ = KDTree(plan).query(path[:, :2])
    longest = np.linalg.norm(np.diff(plan, axis=0), axis=1).max()
    assert gaps.max() <= longest == pytest.approx(2 * controller.tolerance)


def test_a_plan_that_stays_put_is_followed_by_standing_still():
    scenario = load_scenario("loop").with_changes(
        controls={"commands": [[0.0, 0.0, 1]]}
    )
    controller = make_controller("waypoints", scenario, rng())
    assert controller.act(ORIGIN, 0).tolist() == [0.0, 0.0]


def wander(*, steps, dt, correlation_time=5.0, seed=0):
    driver = RandomWalk(rng(seed), ROBOT, dt=dt, correlation_time=correlation_time)
    return np.array([driver.act(ORIGIN, step) for step in range(steps)])


@pytest.mark.slow
@pytest.mark.parametrize("dt", [0.5, 5.0])
def test_wandering_has_the_documented_means_and_spreads(dt):
    actions = wander(steps=20_000, dt=dt, correlation_time=1.0)
    assert actions.mean(axis=0) == pytest.approx([0.25, 0.0], abs=0.01)
    spread = np.minimum(np.abs(rng(1).standard_normal(100_000)), 2.0)
    assert actions[:, 0].std() == pytest.approx(
        np.sqrt((spread**2).mean()) / 8, rel=0.03
    )
    assert actions[:, 1].std() == pytest.approx(0.8 / 3, rel=0.03)


@pytest.mark.slow
@pytest.mark.parametrize("dt", [0.5, 2.0])
def test_wandering_forgets_within_the_correlation_time(dt):
    turns = wander(steps=int(8000 / dt), dt=dt, correlation_time=5.0)[:, 1]
    lag = math.ceil(5.0 / dt)
    correlation = np.corrcoef(turns[:-lag], turns[lag:])[0, 1]
    assert correlation == pytest.approx(math.exp(-lag * dt / 5.0), abs=0.06)


def test_wandering_goes_forwards_only():
    assert wander(steps=5000, dt=0.5)[:, 0].min() >= 0.0


def test_wandering_starts_anew_at_step_zero():
    driver = RandomWalk(rng(), ROBOT, dt=0.01, correlation_time=100.0)
    starts = np.array([driver.act(ORIGIN, 0)[1] for _ in range(500)])
    assert abs(np.corrcoef(starts[:-1], starts[1:])[0, 1]) < 0.15


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_beyond_its_reach_a_wanderer_turns_home(side):
    driver = RandomWalk(rng(), ROBOT, dt=0.5, home=(5.0, 0.0), reach=2.0)
    pose = (5.0, 3.0 * side, 0.0)
    turns = np.array([driver.act(pose, step)[1] for step in range(200)])
    assert (turns * side < 0).all()


@given(seed=st.integers(0, 1000))
@settings(max_examples=10, deadline=None)
def test_a_wanderer_stays_near_its_home(seed):
    driver = RandomWalk(rng(seed), ROBOT, dt=0.5, home=(3.0, 4.0), reach=5.0)
    path = drive(driver, 1000, dt=0.5)
    assert np.linalg.norm(path[:, :2] - (3.0, 4.0), axis=1).max() < 5.0 + 3.0


def test_a_wanderer_has_its_home_amid_the_planned_path_and_reaches_its_corners():
    path = planned_path(load_scenario("corridor"))[:, :2]
    driver = RandomWalk.for_scenario("corridor", rng())
    low, high = path.min(axis=0), path.max(axis=0)
    assert driver.home == tuple((low + high) / 2)
    assert driver.reach == pytest.approx(np.linalg.norm(low - driver.home))


def test_within_its_reach_a_wanderer_is_free():
    free, bound = (
        RandomWalk(rng(), ROBOT, dt=0.5, reach=reach) for reach in (math.inf, 9.0)
    )
    for step in range(20):
        pose = (8.0, 0.0, 0.1)
        assert np.array_equal(free.act(pose, step), bound.act(pose, step))


@pytest.mark.parametrize("pose", [(0.0, 0.0), (0.0, 0.0, math.nan), [[0.0] * 3]])
def test_a_bad_pose_is_refused(pose):
    driver = Waypoints([(1.0, 0.0)], ROBOT, dt=0.5, tolerance=0.1)
    with pytest.raises(ValueError, match="pose must be 3 finite numbers"):
        driver.act(pose, 0)


@pytest.mark.parametrize("rows", [[], [1.0, 2.0], [[1.0, 2.0, 3.0]], [[1.0, math.inf]]])
def test_bad_rows_are_refused(rows):
    with pytest.raises(ValueError, match="points must"):
        Waypoints(rows, ROBOT, dt=0.5, tolerance=0.1)
    with pytest.raises(ValueError, match="actions must"):
        OpenLoop(rows, ROBOT)


@pytest.mark.parametrize("bad", [0.0, -1.0, math.nan, math.inf])
def test_bad_settings_are_refused(bad):
    with pytest.raises(ValueError, match="dt must be finite and > 0"):
        Waypoints([(1.0, 0.0)], ROBOT, dt=bad, tolerance=0.1)
    with pytest.raises(ValueError, match="tolerance must be finite and > 0"):
        Waypoints([(1.0, 0.0)], ROBOT, dt=0.5, tolerance=bad)
    with pytest.raises(ValueError, match="correlation_time must be finite and > 0"):
        RandomWalk(rng(), ROBOT, dt=0.5, correlation_time=bad)
