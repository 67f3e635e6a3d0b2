"""Baselines for active SLAM: policies that plan instead of learn.

=============  =====================================================================
``random``     actions uniform within the robot's limits
``coverage``   lanes up and down the floor, then across, independent of the belief
``frontier``   the nearest unseen cell; when all are mapped, as ``revisit``
``revisit``    the nearest goal; when uncertain, the best known landmark
``greedy``     the motion with the largest expected gain, see `belief_space_planner`
``mpc``        the same of tours from goal to goal
=============  =====================================================================

They use `AgentKnowledge` only, not the truth. They drive to their goals straight, or
on the shortest way around inner walls (`wall_routes`).
"""

import math
from collections.abc import Callable
from itertools import pairwise
from typing import Protocol

import numpy as np

from ..arrays import Array
from ..envs.controllers import Waypoints
from ..envs.robot import wrap_angle
from ..sim_configs import Robot, Scenario
from ..sim_configs.field_types import unknown_choice
from .belief_features import largest_variances, world_bounds
from .belief_space_planner import GREEDY, MPC, BeliefSpacePlanner
from .wall_routes import CLEARANCE, AgentKnowledge, CoverageGrid, as_points

#: The names that :func:`make_baseline` accepts.
BASELINES = ("random", "coverage", "frontier", "revisit", "greedy", "mpc")

_DOTS = 2.0  # distance of the points that a coverage around walls visits [m]
_ALIGNED = 0.4  # heading error below which a robot drives while it turns [rad]


class Baseline(Protocol):
    """Chooses actions from the knowledge of an agent."""

    def act(self, knowledge: AgentKnowledge) -> Array:
        """Choose (v, ω) [m/s, rad/s]; step 0 restarts the baseline."""
        ...


class RandomActions:
    """Draws every action uniformly within the limits.

    Parameters
    ----------
    rng : numpy.random.Generator
        Source of the random numbers.
    """

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng

    def act(self, knowledge: AgentKnowledge) -> Array:
        """Draw an action; see `Baseline.act`."""
        robot = knowledge.scenario.robot
        limits = np.array([robot.max_speed, robot.max_turn_rate])
        return self._rng.uniform(-limits, limits)


class Coverage:
    """Drives in lanes over the whole floor, up and down, then across, repeatedly.

    The fields of view of adjacent lanes just overlap. On a floor with inner walls the
    robot visits points on the lanes one after the other.

    Parameters
    ----------
    scenario : Scenario
        Source of floor, sensor and robot.
    """

    def __init__(self, scenario: Scenario) -> None:
        self._routes = CoverageGrid(scenario).routes
        points = coverage_lanes(scenario)
        if not self._routes.is_open:
            points = self._routes.kept_clear(_dotted(points))
        self._waypoints = Waypoints(
            points,
            scenario.robot,
            dt=scenario.dt,
            tolerance=0.5 * scenario.robot.max_speed * scenario.dt,
            loop=True,
        )

    def act(self, knowledge: AgentKnowledge) -> Array:
        """Drive on along the lanes; see `Baseline.act`."""
        pose = knowledge.belief.pose
        if self._routes.is_open:
            return self._waypoints.act(pose, knowledge.step)
        point = self._waypoints.next_point(pose[0], pose[1], knowledge.step)
        assert point is not None  # they loop
        return _steer_around(knowledge, point)


class Revisit:
    """Explores while the pose is certain, else returns to the best known landmark.

    The return starts when the worst standard deviation of the position exceeds 0.8 of
    the required accuracy. It ends below half of it. After 26 steps it ends in any case:
    then the robot explores for 26 steps, or until the deviation is below half of the
    accuracy. Exploration drives to the nearest goal.
    """

    def __init__(self) -> None:
        self._returning = 0

    def act(self, knowledge: AgentKnowledge) -> Array:
        """Drive to the next goal; see `Baseline.act`."""
        if knowledge.step == 0:
            self._returning = 0
        goal = self._anchor(knowledge) if self._is_uncertain(knowledge) else None
        if goal is None:
            goal = nearest_goal(knowledge)
        return _steer_around(knowledge, goal)

    def _is_uncertain(self, knowledge: AgentKnowledge) -> bool:
        std = math.sqrt(largest_variances(knowledge.belief.pose_covariance[:2, :2]))
        if std < 0.5 * knowledge.accuracy:
            self._returning = 0
        elif self._returning == _PATIENCE:
            self._returning = 1 - _PATIENCE
        elif std > 0.8 * knowledge.accuracy or self._returning != 0:
            self._returning += 1
        return self._returning > 0

    @staticmethod
    def _anchor(knowledge: AgentKnowledge) -> Array | None:
        belief = knowledge.belief
        if not len(belief.landmark_ids):
            return None
        columns = np.arange(3, len(belief.covariance)).reshape(-1, 2)
        blocks = belief.covariance[columns[:, :, None], columns[:, None]]
        return np.asarray(belief.landmarks[int(np.argmin(largest_variances(blocks)))])


class Frontier:
    """Drives to the nearest unseen cell; when all is mapped, does as `Revisit`."""

    def __init__(self) -> None:
        self._revisit = Revisit()

    def act(self, knowledge: AgentKnowledge) -> Array:
        """Drive to the next goal; see `Baseline.act`."""
        unseen = as_points(knowledge.grid.cells[knowledge.to_explore])
        otherwise = self._revisit.act(knowledge)
        if not knowledge.missing or not len(unseen):
            return otherwise
        return _steer_around(knowledge, _nearest(knowledge, unseen))


_PATIENCE = 26  # largest number of steps of a return, then steps of exploration


def make_baseline(name: str, scenario: Scenario, rng: np.random.Generator) -> Baseline:
    """Make the baseline of a name.

    Parameters
    ----------
    name : str
        One of `BASELINES`, see the module's docstring.
    scenario : Scenario
        The scenario of the task.
    rng : numpy.random.Generator
        Used by ``"random"`` only.

    Raises
    ------
    ValueError
        If there is no such baseline, or the scenario has no walls.
    """
    makers: dict[str, Callable[[], Baseline]] = {
        "random": lambda: RandomActions(rng),
        "coverage": lambda: Coverage(scenario),
        "frontier": Frontier,
        "revisit": Revisit,
        "greedy": lambda: BeliefSpacePlanner(GREEDY),
        "mpc": lambda: BeliefSpacePlanner(MPC),
    }
    if name not in makers:
        raise ValueError(unknown_choice("name", name, BASELINES))
    return makers[name]()


def coverage_lanes(scenario: Scenario) -> Array:
    """Return the corners of lanes up and down the floor, then across, (K, 2) [m].

    Examples
    --------
    >>> from slamgym.sim_configs import load_scenario
    >>> coverage_lanes(load_scenario("active_easy"))[:3].round(2).tolist()
    [[-3.48, -3.48], [-3.48, 3.48], [0.0, 3.48]]
    """
    sensor = scenario.sensor
    aside = math.sin(min(sensor.field_of_view / 2, math.pi / 2))
    left, bottom, right, top = world_bounds(scenario)
    reach = min(sensor.max_range, math.hypot(right - left, top - bottom)) * aside
    margin = max(CLEARANCE, 0.72 * reach)
    x = _spaced(left + margin, right - margin, 1.4 * reach)
    y = _spaced(bottom + margin, top - margin, 1.4 * reach)
    up = _zigzag(x, (y[0], y[-1]))
    return np.concatenate([up, _zigzag(y, (x[0], x[-1]))[:, ::-1]])


def nearest_goal(knowledge: AgentKnowledge) -> Array:
    """Return the nearest of `AgentKnowledge.goals`, (2,) [m].

    Without goals, every reachable cell is a goal, and every cell if none is reachable.
    """
    points, reachable = knowledge.goals(), knowledge.grid.routes.reachable
    if not len(points):
        points = as_points(knowledge.grid.cells[reachable | ~reachable.any()])
    return _nearest(knowledge, points)


def steer(pose: Array, goal: Array, robot: Robot, dt: float) -> Array:
    """Return the action (v, ω) that turns to a goal and drives when it is ahead."""
    dx, dy = goal - pose[:2]
    error = wrap_angle(math.atan2(dy, dx) - pose[2])
    turn = min(max(error / dt, -robot.max_turn_rate), robot.max_turn_rate)
    speed = math.hypot(dx, dy) / dt if abs(error) < _ALIGNED else 0.0
    return np.array([min(speed, robot.max_speed), turn])


def _nearest(knowledge: AgentKnowledge, points: Array) -> Array:
    """Return the point (2,) with the shortest way to it."""
    here = knowledge.belief.pose[None, :2]
    return np.asarray(points[np.argmin(knowledge.grid.routes.distances(here, points))])


def _steer_around(knowledge: AgentKnowledge, goal: Array) -> Array:
    """Return the action that drives to a goal, off the walls and around them."""
    pose, scenario = knowledge.belief.pose, knowledge.scenario
    routes = knowledge.grid.routes
    legs = routes.legs(pose[:2], routes.kept_clear(goal[None])[0])
    return steer(pose, legs[0], scenario.robot, scenario.dt)


def _dotted(lanes: Array) -> Array:
    """Return points on lanes (K, 2), at most `_DOTS` apart, (P, 2) [m]."""
    parts = [
        np.linspace(a, b, math.ceil(math.dist(a, b) / _DOTS), endpoint=False)
        for a, b in pairwise(lanes)
    ]
    return np.concatenate([*parts, lanes[-1:]])


def _spaced(first: float, last: float, gap: float) -> Array:
    if last <= first:
        return np.array([(first + last) / 2])
    return np.linspace(first, last, max(2, math.ceil((last - first) / gap - 1e-9) + 1))


def _zigzag(across: Array, ends: tuple[float, float]) -> Array:
    corners = [
        (place, ends[(k + turn) % 2])
        for k, place in enumerate(across.tolist())
        for turn in (0, 1)
    ]
    return np.array(corners)
