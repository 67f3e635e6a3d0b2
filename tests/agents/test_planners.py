"""Compare planners and baselines with their formulas, plan by plan, goal by goal."""

import math
from itertools import pairwise

import numpy as np
import pytest

from slamgym.agents import ActiveSlamEnv
from slamgym.agents import belief_space_planner as planning
from slamgym.agents.active_slam_baselines import (
    coverage_lanes,
    make_baseline,
    nearest_goal,
    steer,
)
from slamgym.agents.belief_space_planner import GREEDY, MPC, BeliefSpacePlanner
from slamgym.agents.wall_routes import CoverageGrid
from slamgym.estimator import imagine
from slamgym.sim_configs import Robot, load_scenario

ROBOT = Robot(radius=0.2, max_speed=0.8, max_turn_rate=1.2)
TURNS = (-1.0, -0.5, -0.2, 0.0, 0.2, 0.5, 1.0)


@pytest.fixture(scope="module")
def knowledge():
    """Return what a robot in rooms knows of known, mapped and missing landmarks."""
    robot = {"radius": 0.2, "max_speed": 0.8, "max_turn_rate": 1.2}
    env = ActiveSlamEnv("active_rooms", accuracy=0.049, dt=0.5, robot=robot)
    env.reset(seed=3)
    for _ in range(14):
        env.step([0.5, 0.7])
    now = env.knowledge
    assert 0 < now.known.sum() < len(now.belief.landmark_ids) < len(now.known)
    assert now.missing == len(now.known) - len(now.belief.landmark_ids)
    return now


def points_of(numbers):
    return np.column_stack([numbers.real, numbers.imag])


def some_chance(now):
    """Return how likely a missing landmark is in each cell: in some not at all."""
    rng = np.random.default_rng(0)
    cells = len(now.explored)
    return rng.uniform(size=cells) ** 3 * rng.choice([0.0, 0.01, 1.0], cells)


def value_of(now, plan, chance, settings):
    """Return the expected gain of one plan, term by term."""
    belief, sensor, size = now.belief, now.scenario.sensor, len(now.known)
    counts = now.missing * chance / max(chance.sum(), 1e-300)
    likely = counts > 0.02 * counts.max()
    unmapped = points_of(now.grid.cells)[likely], counts[likely]
    value, steps, bonus = 0.0, len(plan), settings.known_bonus
    for part in (steps // 4, steps // 2, steps):
        walls = now.scenario.walls
        given = {"walls": walls, "density": unmapped}
        after = imagine(now.estimator, plan[None, :part], sensor, **given)
        gain = np.linalg.slogdet(belief.covariance[3:, 3:])[1] - after.log_det[0, 0]
        known = after.worst_variances[0, 0] <= now.accuracy**2
        value += (gain / (2 * size) + bonus * known.sum()) / 3
    poses, covariances = after.poses[0, 0], after.pose_covariances[0, 0]
    distance, found = 0.6 * min(sensor.max_range, now.grid.diagonal), 0.0
    for t, (P, until) in enumerate(
        zip(covariances, after.new_landmarks[0, 0], strict=True)
    ):
        place = np.linalg.eigvalsh(P[:2, :2])[-1] + sensor.std[1] ** 2
        std = math.sqrt(place + distance**2 * (P[2, 2] + sensor.std[0] ** 2))
        worth = sum(math.log(prior / std) for prior in now.prior_std) / size
        worth += bonus / (1 + (std / now.accuracy) ** 8)
        value += settings.discount**t * worth * (until - found)
        found = until
    left = [math.dist(at, poses[-1, :2]) for at in belief.landmarks[~known]]
    if now.missing:
        seen = now.explored | now.grid.visible_from(poses).any(axis=0)
        here = np.argmin(np.abs(now.grid.cells - poses[-1, :2] @ [1, 1j]))
        cells = points_of(now.grid.cells)
        left += now.grid.routes.distances(cells[[here]], cells)[0][~seen].tolist()
    value -= settings.attraction * min((d for d in left if d < np.inf), default=0.0)
    places = np.vstack([poses[:, :2], (poses[1:, :2] + poses[:-1, :2]) / 2])
    here = now.grid.clearance(belief.pose[:2])
    is_free = now.grid.clearance(places).min() >= min(0.2 + 0.5, here - 1e-9)
    return value if is_free else -math.inf


@pytest.mark.parametrize(
    ("is_complete", "accuracy"), [(False, 0.049), (True, 0.049), (True, 9.0)]
)
def test_the_value_of_a_plan_is_its_expected_gain(knowledge, is_complete, accuracy):
    now, chance = knowledge._replace(accuracy=accuracy), some_chance(knowledge)
    if is_complete:  # no landmark is missing, and no cell can hold one
        known = knowledge.known[list(now.belief.landmark_ids)]
        now, chance = now._replace(known=known), 0.0 * chance
    settings = GREEDY._replace(known_bonus=2.0, attraction=0.7, discount=0.8)
    plans = planning._arcs(ROBOT, 0.5, settings)[::5]
    found = planning.plan_values(now, plans, chance, settings)
    expected = [value_of(now, plan, chance, settings) for plan in plans]
    assert 2 < np.isfinite(expected).sum() < len(plans)
    np.testing.assert_allclose(found, expected, rtol=1e-9)


@pytest.mark.parametrize("settings", [GREEDY, MPC])
def test_plans_turn_then_drive_straight_on_then_look_around(settings):
    plans, robot, dt = [], ROBOT, 0.5
    longest, turning, horizon = 0.8 * dt, 1.2 * dt, settings.horizon
    around = [(0.0, turning)] * horizon
    for speed, steps in ((longest, 1), (longest, 4), (0.0, 3)):
        for straight in settings.straight:
            ahead = [(longest, 0.0)] * straight
            plans += [
                ([(speed, turn * turning)] * steps + ahead + around)[:horizon]
                for turn in TURNS
            ]
    plans += [[(0.0, turn * turning)] * horizon for turn in TURNS]
    np.testing.assert_array_equal(planning._arcs(robot, dt, settings), plans)


def test_a_landmark_is_less_likely_where_the_robot_has_looked(knowledge):
    planner, grid = BeliefSpacePlanner(MPC), knowledge.grid
    planner._look(knowledge)  # its first step
    expected = np.where(knowledge.explored, 0.3, 1.0) * grid.routes.reachable
    np.testing.assert_array_equal(planner._chance, expected)
    seen = grid.visible_from(knowledge.belief.pose[None])[0]
    planner._look(knowledge)
    np.testing.assert_array_equal(planner._chance, np.where(seen, 0.3, 1) * expected)
    planner._tour = np.zeros((2, 2))
    planner._look(knowledge._replace(step=0))
    np.testing.assert_array_equal(planner._chance, expected)
    assert planner._tour is None


def test_tours_lead_to_a_goal_and_then_to_a_second_one(knowledge):
    belief, chance = knowledge.belief, 0.8 * (some_chance(knowledge) > 0.3)
    position = belief.pose[:2]
    unknown = belief.landmarks[~knowledge.known[list(belief.landmark_ids)]]
    traces = [np.trace(block) for block in belief.landmark_covariances]
    best = belief.landmarks[np.argmin(traces)]
    cells = points_of(knowledge.grid.cells[chance == chance.max()]).tolist()
    spread = [min(cells, key=lambda cell: math.dist(cell, position))]
    while len(spread) < 4:
        spread.append(
            max(cells, key=lambda cell: min(math.dist(cell, each) for each in spread))
        )
    near = min(unknown.tolist(), key=lambda place: math.dist(place, position))
    starts, ends = [*unknown, best, *spread], [position, best, near, spread[0]]
    pairs = np.array([(start, end) for start in starts for end in ends])
    expected = knowledge.grid.routes.kept_clear(pairs.reshape(-1, 2)).reshape(-1, 2, 2)
    np.testing.assert_array_equal(planning._tours(knowledge, chance, 4), expected)


@pytest.mark.parametrize(
    ("ahead", "left"),
    [((0.21, 3.0), [0, 1]), ((0.19, 3.0), [1, 1]), ((0.19, 0.19), None)],
)
def test_a_goal_within_half_a_step_is_reached(knowledge, ahead, left):
    x, y, _ = knowledge.belief.pose
    tour = np.array([(x, y + gap) for gap in ahead])  # a step is at most 0.4 m
    expected = np.empty((0, 2, 2)) if left is None else tour[None, left]
    np.testing.assert_array_equal(planning._rest(knowledge, tour), expected)
    assert planning._rest(knowledge, None).shape == (0, 2, 2)


@pytest.mark.parametrize(("persistence", "goes_on"), [(0.3, True), (0.1, False)])
def test_the_rest_of_a_tour_is_preferred_to_a_plan_worth_little_more(
    knowledge, monkeypatch, persistence, goes_on
):
    given, worth = [], {10: 1.0}

    def values(_, plans, *__):
        given.append(plans)
        return np.array([worth.get(k, 0.0) for k in range(len(plans))])

    monkeypatch.setattr(planning, "plan_values", values)
    planner = BeliefSpacePlanner(MPC._replace(persistence=persistence))
    arcs = len(planning._arcs(ROBOT, 0.5, MPC))
    first = planner.act(knowledge)
    assert planner._tour is None  # an arc has no tour
    np.testing.assert_array_equal(first, given[0][10, 0] / 0.5)
    worth = {arcs + 3: 1.0}
    planner.act(knowledge)
    tour = planning._tours(knowledge, planner._chance, 6)[3]
    np.testing.assert_array_equal(planner._tour, tour)
    worth = {5: 0.2}
    action = planner.act(knowledge)
    assert len(given[2]) == len(given[1]) + 1
    best = -1 if goes_on else 5
    np.testing.assert_array_equal(action, given[2][best, 0] / 0.5)
    assert (planner._tour is not None) == goes_on


def test_a_planner_without_goals_considers_arcs_alone(knowledge, monkeypatch):
    sizes = []

    def values(_, plans, *__):
        sizes.append(len(plans))
        return np.zeros(len(plans))

    monkeypatch.setattr(planning, "plan_values", values)
    BeliefSpacePlanner(GREEDY).act(knowledge)
    assert sizes == [len(planning._arcs(ROBOT, 0.5, GREEDY))]


def test_plans_to_goals_keep_to_the_limits_of_the_robot(knowledge):
    tours = planning._tours(knowledge, some_chance(knowledge), 4)
    plans, pose = np.empty((len(tours), 30, 2)), knowledge.belief.pose
    routes = knowledge.grid.routes.tours(pose[:2], tours)
    planning.drive_routes(pose.copy(), routes, 0.8 * 0.5, 1.2 * 0.5, plans)
    np.testing.assert_array_equal(planning._driven(knowledge, tours, 30), plans)


# --- the floor and the baselines ---


def floor(left, bottom, right, top, **changes):
    """Return a scenario on a floor without inner walls."""
    x, y = (left, right, right, left, left), (bottom, bottom, top, top, bottom)
    walls = [[x[k], y[k], x[k + 1], y[k + 1]] for k in range(4)]
    start = {"pose": [left + 1.5, bottom + 1.5, 0.0]}
    return load_scenario("active_easy").with_changes(
        walls=walls, start=start, landmarks={"bounds": [left, bottom, right, top]},
        **changes,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("right", "top", "columns", "rows"), [(26.0, 14.0, 24, 10), (0.0, 7.0, 5, 7)]
)
def test_cells_fill_the_floor_row_by_row(right, top, columns, rows):
    grid = CoverageGrid(floor(-4.0, 2.0, right, top))
    wide, high = (right + 4.0) / columns, (top - 2.0) / rows
    expected = [
        complex(-4.0 + (i + 0.5) * wide, 2.0 + (j + 0.5) * high)
        for j in range(rows)
        for i in range(columns)
    ]
    np.testing.assert_allclose(grid.cells, expected, atol=1e-12)
    assert grid.bounds == (-4.0, 2.0, right, top)
    assert grid.diagonal == pytest.approx(math.hypot(right + 4, top - 2))
    assert grid.cell_size == (1.25 if columns == 24 else 0.75)


def test_lanes_run_up_and_down_then_across():
    """The sensor sees 2 m to each side, and lanes are at most 2.8 m apart."""
    narrow = {"max_range": 4.0, "field_of_view": np.pi / 3}
    lanes = coverage_lanes(floor(-4.0, 2.0, 6.0, 8.0, sensor=narrow))
    x, y = np.linspace(-2.56, 4.56, 4), np.linspace(3.44, 6.56, 3)
    up = [(x[k], y[-1 * ((k + end) % 2)]) for k in range(4) for end in (0, 1)]
    across = [(x[-1 * ((k + end) % 2)], y[k]) for k in range(3) for end in (0, 1)]
    np.testing.assert_allclose(lanes, [*up, *across])
    for left, bottom, right, top in ((-4, 2, 16, 18), (-10, 3, 10, 5), (3, -10, 5, 10)):
        far = coverage_lanes(floor(left, bottom, right, top, sensor={"max_range": 99}))
        middle = np.array([[(left + right) / 2, (bottom + top) / 2]])
        # from there, all of the floor is in view
        np.testing.assert_allclose(far, middle.repeat(len(far), axis=0), atol=1e-12)


def test_around_inner_walls_coverage_visits_points_of_its_lanes(knowledge):
    points, lanes = [], coverage_lanes(knowledge.scenario)
    for start, end in pairwise(lanes):
        count = math.ceil(math.dist(start, end) / 2.0)  # at most 2 m apart
        points += [start + k / count * (end - start) for k in range(count)]
    expected = knowledge.grid.routes.kept_clear(np.array([*points, lanes[-1]]))
    baseline = make_baseline("coverage", knowledge.scenario, np.random.default_rng(0))
    np.testing.assert_allclose(baseline._waypoints.points, expected, atol=1e-12)


@pytest.mark.parametrize("heading", [0.0, 3.1, -3.1])
@pytest.mark.parametrize(
    ("aside", "far", "speed", "turn"),
    [(0.39, 5, 0.8, 0.78), (-0.41, 5, 0, -0.82), (3, 5, 0, 1.2), (0, 0.2, 0.4, 0)],
)
def test_a_robot_drives_to_what_is_ahead_and_turns_to_the_rest(
    heading, aside, far, speed, turn
):
    way = far * np.array([math.cos(heading + aside), math.sin(heading + aside)])
    here = np.array([2.0, -1.0, heading])
    action = steer(here, here[:2] + way, ROBOT, 0.5)
    np.testing.assert_allclose(action, (speed, turn), atol=1e-12)


def test_frontier_drives_to_the_nearest_unseen_cell_while_landmarks_are_missing(
    knowledge,
):
    now, routes, pose = knowledge, knowledge.grid.routes, knowledge.belief.pose
    frontier, revisit = (
        make_baseline(name, now.scenario, np.random.default_rng(0))
        for name in ("frontier", "revisit")
    )
    unseen = points_of(now.grid.cells)[~now.explored & routes.reachable]
    goal = unseen[routes.distances(pose[None, :2], unseen)[0].argmin()]
    legs = routes.legs(pose[:2], routes.kept_clear(goal[None])[0])
    expected = steer(pose, legs[0], ROBOT, 0.5)
    np.testing.assert_array_equal(frontier.act(now), expected)
    complete = now._replace(known=now.known[list(now.belief.landmark_ids)])
    np.testing.assert_array_equal(frontier.act(complete), revisit.act(complete))


def test_the_coverage_baseline_leaves_a_lane_half_a_step_before_its_end():
    scenario = floor(-4.0, 2.0, 6.0, 8.0, dt=0.5, robot={"max_speed": 3.0})
    baseline = make_baseline("coverage", scenario, np.random.default_rng(0))
    assert baseline._waypoints.tolerance == 0.5 * 3.0 * 0.5


def test_random_actions_are_uniform_within_both_limits(knowledge):
    baseline = make_baseline("random", knowledge.scenario, np.random.default_rng(4))
    drawn = np.array([baseline.act(knowledge) for _ in range(400)])
    expected = np.random.default_rng(4).uniform((-0.8, -1.2), (0.8, 1.2), (400, 2))
    np.testing.assert_array_equal(drawn, expected)


def test_the_nearest_goal_is_the_one_with_the_shortest_path(knowledge):
    here, routes = knowledge.belief.pose[None, :2], knowledge.grid.routes
    cells = points_of(knowledge.grid.cells)
    unknown = knowledge.belief.landmarks[~knowledge.known_in_map]
    unseen = cells[~knowledge.explored & routes.reachable]
    goals = np.vstack([unknown, unseen])
    np.testing.assert_array_equal(knowledge.goals(), goals)
    nearest = goals[routes.distances(here, goals)[0].argmin()]
    np.testing.assert_array_equal(nearest_goal(knowledge), nearest)
