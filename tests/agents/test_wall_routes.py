"""Routes around walls against a search on a fine lattice."""

from itertools import pairwise

import numpy as np
import pytest
from scipy.sparse.csgraph import dijkstra

from slamgym.agents import ActiveSlamEnv
from slamgym.agents.active_slam_baselines import BASELINES, make_baseline, steer
from slamgym.agents.active_slam_scores import VALIDATION, baseline_policy, run_episode
from slamgym.agents.belief_space_planner import drive_routes
from slamgym.agents.wall_routes import CoverageGrid
from slamgym.envs.robot import wrap_angle
from slamgym.sim_configs import Robot, load_scenario

ROOMS = load_scenario("active_rooms")
MARGIN = 0.7


@pytest.fixture(scope="module")
def grid():
    return CoverageGrid(ROOMS)


def points(count, seed=0):
    return np.random.default_rng(seed).uniform(-7.2, 7.2, (count, 2))


def dense(legs, start):
    corners = np.concatenate([start[None], legs])
    ways = pairwise(corners)
    shares = np.linspace(0, 1, 200)[:, None]
    return np.concatenate([a + shares * (b - a) for a, b in ways])


def test_routes_keep_off_the_walls(grid):
    starts, goals = points(30), grid.routes.kept_clear(points(30, seed=1))
    for start, goal in zip(starts, goals, strict=True):
        kept = min(MARGIN, grid.clearance(start[None])[0])
        way = dense(grid.routes.legs(start, goal), start)
        assert grid.clearance(way).min() >= kept - 1e-4


def test_tours_follow_the_routes_to_one_goal_and_another(grid):
    start, goals = points(1, seed=2)[0], grid.routes.kept_clear(points(12, seed=1))
    goals[-2] = start  # a goal that is reached already
    pairs = np.stack([goals[::2], goals[1::2]], axis=1)
    pairs = np.concatenate([pairs, pairs[:, ::-1], pairs[:, [0, 0]]])
    tours, lengths = grid.routes.tours(start, pairs), set()
    for tour, (first, second) in zip(tours, pairs, strict=True):
        legs = grid.routes.legs(start, first), grid.routes.legs(first, second)
        way = np.concatenate(legs)
        np.testing.assert_array_equal(tour[: len(way)], way)
        assert (tour[len(way) :] == second).all()
        lengths.add(len(way))
    assert len(lengths) > 2


def test_distances_are_the_lengths_of_routes(grid):
    starts, goals = points(20), grid.routes.kept_clear(points(20, seed=1))
    lengths = grid.routes.distances(starts, goals)
    for i, start in enumerate(starts):
        for j, goal in enumerate(goals):
            corners = np.concatenate([start[None], grid.routes.legs(start, goal)])
            length = np.hypot(*np.diff(corners, axis=0).T).sum()
            assert lengths[i, j] == pytest.approx(length, rel=1e-12)


def test_no_route_is_longer_than_on_a_lattice(grid):
    """The lattice stays as far from walls as the routes' corners do."""
    axis = np.linspace(-7.2, 7.2, 37)
    lattice = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    lattice = lattice[grid.clearance(lattice) >= 1.0]
    gap = np.hypot(*(lattice[:, None] - lattice).transpose(2, 0, 1))
    lengths = dijkstra(np.where(gap < 1.0, gap, 0.0), indices=range(0, len(gap), 60))
    assert np.isfinite(lengths).all()
    routes = grid.routes.distances(lattice[::60], lattice)
    assert (routes <= lengths + 1e-9).all()
    assert (routes >= gap[::60] - 1e-9).all()
    assert routes.mean() > 0.85 * lengths.mean()  # and none goes through a wall


def test_only_goals_too_near_to_walls_are_moved(grid):
    goals = points(200, seed=3)
    moved = grid.routes.kept_clear(goals)
    stays = (moved == goals).all(axis=1)
    assert 20 < np.count_nonzero(~stays) < 150
    assert grid.clearance(goals[~stays]).max() < grid.clearance(moved).min() + 1e-9
    cells = np.column_stack([grid.cells.real, grid.cells.imag])
    free = cells[grid.routes.reachable & (grid.clearance(cells) >= MARGIN)]
    for goal, other in zip(goals[~stays], moved[~stays], strict=True):
        nearest = np.argmin(np.hypot(*(free - goal).T))
        np.testing.assert_array_equal(other, free[nearest])


def test_goals_outside_the_floor_are_moved_onto_it():
    """A floor of 10 m by 6 m with an inner wall."""
    x, y = (-4, 6, 6, -4, -4), (2, 2, 8, 8, 2)
    walls = [[x[k], y[k], x[k + 1], y[k + 1]] for k in range(4)] + [[0, 2, 0, 4]]
    start = {"pose": [4.0, 5.0, 0.0]}
    bounds = {"bounds": [-3, 3, 5, 7]}
    world = ROOMS.with_changes(walls=walls, start=start, landmarks=bounds)
    outside = [(-6.0, 5.0), (7.2, 5.0), (3.0, 0.0), (3.0, 10.0)]
    goals = np.array([*outside, (3.0, 5.0), (3.0, 7.2)])
    moved = CoverageGrid(world).routes.kept_clear(goals)
    assert (moved > (-4, 2)).all()
    assert (moved < (6, 8)).all()
    np.testing.assert_array_equal(moved[4:], goals[4:])
    plain = CoverageGrid(world.with_changes(walls=walls[:4])).routes
    corners = plain.kept_clear(np.array([(-99.0, -99.0), (99.0, 99.0)]))
    np.testing.assert_array_equal(corners, [(-3, 3), (5, 7)])


def test_ways_on_a_floor_without_inner_walls_are_straight():
    grid = CoverageGrid(load_scenario("active_easy"))
    start, goal = np.array([-3.0, 2.0]), np.array([[4.0, -1.0], [5.9, 6], [-5.9, -6]])
    np.testing.assert_array_equal(grid.routes.legs(start, goal[0]), goal[:1])
    expected = np.hypot(*(goal - start).T)
    np.testing.assert_allclose(grid.routes.distances(start[None], goal)[0], expected)
    kept = grid.routes.kept_clear(goal)
    np.testing.assert_array_equal(kept, [[4, -1], [5, 5], [-5, -5]])
    assert grid.routes.reachable.all()


def test_cells_behind_closed_walls_are_out_of_reach():
    grid = CoverageGrid(load_scenario("corridor"))
    inside = np.maximum(np.abs(grid.cells.real - 6), np.abs(grid.cells.imag - 6)) < 4.8
    assert not grid.routes.reachable[inside].any()
    assert grid.routes.reachable[~inside].all()


def test_coverage_acts_where_all_its_points_are_within_a_step():
    rooms = ROOMS.with_changes(dt=60.0)
    env = ActiveSlamEnv(rooms)
    env.reset(seed=0)
    baseline = make_baseline("coverage", rooms, np.random.default_rng(0))
    assert np.isfinite(baseline.act(env.knowledge)).all()


@pytest.mark.parametrize(
    ("name", "rooms", "steps"), [("coverage", 4, ROOMS.steps), ("mpc", 3, 60)]
)
@pytest.mark.slow
def test_baselines_find_their_way_through_doors(name, rooms, steps):
    world = ROOMS.with_changes(steps=steps)
    env = ActiveSlamEnv(world)
    baseline = make_baseline(name, world, np.random.default_rng(0))
    seed = VALIDATION + 2  # on one map in six, mpc touches a wall
    episode = run_episode(env, baseline_policy(baseline), seed)
    assert len(np.unique((episode.path > 0) @ [1, 2])) >= rooms
    assert not episode.crashed


@pytest.mark.parametrize("r", [0.7, 0.3])  # then no cell is reachable
@pytest.mark.parametrize("name", BASELINES)
def test_every_baseline_acts_where_walls_leave_no_room(name, r):
    box = [[-r, -r, r, -r], [r, -r, r, r], [r, r, -r, r], [-r, r, -r, -r]]
    easy = load_scenario("active_easy")
    scenario = easy.with_changes(walls=[*easy.walls, *box])
    env = ActiveSlamEnv(scenario)
    env.reset(seed=1)
    action = make_baseline(name, scenario, np.random.default_rng(0)).act(env.knowledge)
    assert env.knowledge.missing > 0
    assert env.action_space.contains(np.asarray(action, env.action_space.dtype))


def driven_in_numpy(pose, routes, longest, turning, steps):
    """Return the plans of `drive_routes`, step by step for all routes together."""
    x, y, heading = np.tile(pose, (len(routes), 1)).T
    each, leg = np.arange(len(routes)), np.zeros(len(routes), dtype=int)
    plans = np.empty((len(routes), steps, 2))
    for t in range(steps):
        goal = routes[each, np.minimum(leg, routes.shape[1] - 1)]
        dx, dy = goal[:, 0] - x, goal[:, 1] - y
        distance = np.hypot(dx, dy)
        arrived = distance < 0.5 * longest
        error = wrap_angle(np.arctan2(dy, dx) - heading)
        turn = np.where(arrived, turning, np.clip(error, -turning, turning))
        ahead = (np.abs(error) < 0.5) & ~arrived
        drive = np.where(ahead, np.minimum(distance, longest), 0.0)
        plans[:, t] = np.column_stack([drive, turn])
        x, y = x + drive * np.cos(heading), y + drive * np.sin(heading)
        heading, leg = heading + turn, leg + arrived
    return plans


@pytest.mark.parametrize("legs", [1, 2, 5])
def test_plans_along_routes_are_those_of_numpy(legs):
    routes, pose = points(200 * legs).reshape(200, legs, 2), np.array([1.0, -2.0, 9.0])
    routes[:20, 0] = pose[:2]  # there already
    plans, limits = np.empty((200, 60, 2)), (0.7, 0.6)
    drive_routes(pose, routes, *limits, plans)
    expected = driven_in_numpy(pose, routes, *limits, 60)
    np.testing.assert_allclose(plans, expected, rtol=0, atol=1e-12)
    assert (plans[:, :, 0] == 0.0).any()
    assert (plans[:, :, 0] == 0.7).any()


@pytest.mark.parametrize(("dt", "turn"), [(0.5, 0.4), (2.0, 0.1), (0.1, 1.0)])
def test_steering_turns_to_the_goal_within_a_step_and_the_limit(dt, turn):
    robot = Robot(max_speed=9.0, max_turn_rate=1.0)
    goal = np.array([1.0 + 3 * np.cos(0.5), 2.0 + 3 * np.sin(0.5)])
    found = steer(np.array([1.0, 2.0, 0.3]), goal, robot, dt)
    np.testing.assert_allclose(found, [min(3 / dt, 9.0), turn])
