"""Drivers for active SLAM that plan instead of learn, to compare agents with.

=============  =====================================================================
``random``     actions uniform within the robot's limits
``coverage``   up and down the floor in lanes, then across, whatever is seen
``greedy``     of a few motions, the one after which the estimator expects to know most
``revisit``    explore what is nearest; back to the best known landmark when unsure
=============  =====================================================================

None of them sees the truth: they read a `Situation`. They drive straight at what they
want, so they need a floor without inner walls.
"""

import math
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ..envs.controllers import Waypoints
from ..sim_configs import Robot, Scenario
from ..sim_configs.scenario_errors import closest
from .active_slam import Situation
from .belief_features import largest_variances, world_bounds
from .greedy_information import GreedyInformation

Array = NDArray[np.float64]

BASELINES = ("random", "coverage", "greedy", "revisit")

_ROOM = 1.0  # kept from the walls [m]
_ALIGNED = 0.4  # heading error below which a robot drives while it turns [rad]


class Driver(Protocol):
    """What chooses actions from what an agent may know."""

    def act(self, situation: Situation) -> Array:
        """Choose (v, ω) [m/s, rad/s]; step 0 of an episode starts a driver anew."""
        ...


class RandomActions:
    """Draw every action uniformly within the limits.

    Parameters
    ----------
    rng : numpy.random.Generator
        Where they come from.
    """

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng

    def act(self, situation: Situation) -> Array:
        """Draw an action; see `Driver.act`."""
        robot = situation.scenario.robot
        limits = np.array([robot.max_speed, robot.max_turn_rate])
        return self._rng.uniform(-limits, limits)


class Coverage:
    """Drive in lanes over the whole floor, up and down, then across, then again.

    The lanes are so far apart that their views just overlap.

    Parameters
    ----------
    scenario : Scenario
        Whose floor, sensor and robot are meant.
    """

    def __init__(self, scenario: Scenario) -> None:
        lanes = lanes_of(scenario)
        self._waypoints = Waypoints(
            lanes,
            scenario.robot,
            dt=scenario.dt,
            tolerance=0.5 * scenario.robot.max_speed * scenario.dt,
            loop=True,
        )

    def act(self, situation: Situation) -> Array:
        """Drive on along the lanes; see `Driver.act`."""
        return self._waypoints.act(situation.belief.pose, situation.step)


class Revisit:
    """Explore while sure of the pose, else return to what is known best.

    Unsure is a position whose worst standard deviation exceeds half the accuracy asked
    for; the robot then drives to the landmark known best until it is sure again, or
    until it has looked at it in vain. Sure, it drives to the nearest landmark that is
    mapped but not known, or cell not yet seen.
    """

    def __init__(self) -> None:
        self._returning = 0

    def act(self, situation: Situation) -> Array:
        """Drive to the next goal; see `Driver.act`."""
        if situation.step == 0:
            self._returning = 0
        goal = self._anchor(situation) if self._is_unsure(situation) else None
        if goal is None:
            goal = nearest_goal(situation)
        scenario = situation.scenario
        return steer(
            situation.belief.pose,
            _kept_inside(goal, scenario),
            scenario.robot,
            scenario.dt,
        )

    def _is_unsure(self, situation: Situation) -> bool:
        (xx, xy), (_, yy) = situation.belief.pose_covariance[:2, :2]
        std = math.sqrt(largest_variances(xx, xy, yy))
        if std < 0.5 * situation.accuracy or self._returning > _PATIENCE:
            self._returning = 0 if std < 0.5 * situation.accuracy else -_PATIENCE
        elif std > 0.8 * situation.accuracy or self._returning != 0:
            self._returning += 1
        return self._returning > 0

    @staticmethod
    def _anchor(situation: Situation) -> Array | None:
        belief = situation.belief
        if not len(belief.landmark_ids):
            return None
        best = int(np.argmin(_landmark_variances(situation)))
        return np.asarray(belief.landmarks[best])


_PATIENCE = 25  # steps on the way back, and then of exploring whatever the pose


def make_baseline(name: str, scenario: Scenario, rng: np.random.Generator) -> Driver:
    """Make a baseline by name.

    Parameters
    ----------
    name : {"random", "coverage", "greedy", "revisit"}
        See the module.
    scenario : Scenario
        The task's.
    rng : numpy.random.Generator
        Used by ``"random"`` only.

    Raises
    ------
    ValueError
        If there is no such baseline, or the floor has inner walls.
    """
    if name != "random":
        _check_open_floor(scenario)
    match name:
        case "random":
            return RandomActions(rng)
        case "coverage":
            return Coverage(scenario)
        case "greedy":
            return GreedyInformation()
        case "revisit":
            return Revisit()
    raise ValueError(
        f"name must be one of {', '.join(BASELINES)}, got {name!r}"
        f"{closest(name, BASELINES)}"
    )


def lanes_of(scenario: Scenario) -> Array:
    """Plan lanes up and down over the floor, then across; corners (K, 2) [m].

    Examples
    --------
    >>> from slamgym.sim_configs import load_scenario
    >>> lanes_of(load_scenario("active_easy"))[:3].round(2).tolist()
    [[-3.48, -3.48], [-3.48, 3.48], [0.0, 3.48]]
    """
    sensor = scenario.sensor
    aside = math.sin(min(sensor.field_of_view / 2, math.pi / 2))
    left, bottom, right, top = world_bounds(scenario)
    reach = min(sensor.max_range, math.hypot(right - left, top - bottom)) * aside
    margin = max(_ROOM, 0.72 * reach)
    x = _spaced(left + margin, right - margin, 1.4 * reach)
    y = _spaced(bottom + margin, top - margin, 1.4 * reach)
    up = _zigzag(x, (y[0], y[-1]))
    return np.concatenate([up, _zigzag(y, (x[0], x[-1]))[:, ::-1]])


def nearest_goal(situation: Situation) -> Array:
    """Find the nearest cell not yet seen or landmark not yet known [m], (2,).

    What is left to find is not looked for once all landmarks are mapped.
    """
    belief, plan = situation.belief, situation.plan
    known = situation.known[list(belief.landmark_ids)]
    goals = [belief.landmarks[~known]]
    if len(belief.landmark_ids) < len(situation.known):
        cells = plan.cells[~situation.explored]
        goals.append(np.column_stack([cells.real, cells.imag]))
    points = np.concatenate(goals)
    if not len(points):  # all seen, yet some not found: look everywhere again
        points = np.column_stack([plan.cells.real, plan.cells.imag])
    away = np.hypot(*(points - belief.pose[:2]).T)
    return np.asarray(points[np.argmin(away)])


def steer(pose: Array, goal: Array, robot: Robot, dt: float) -> Array:
    """Turn towards a goal, and drive when it is ahead; (v, ω)."""
    ahead, aside = goal - pose[:2]
    error = (math.atan2(aside, ahead) - pose[2] + math.pi) % (2 * math.pi) - math.pi
    turn = min(max(error / dt, -robot.max_turn_rate), robot.max_turn_rate)
    speed = math.hypot(ahead, aside) / dt if abs(error) < _ALIGNED else 0.0
    return np.array([min(speed, robot.max_speed), turn])


def _landmark_variances(situation: Situation) -> Array:
    """Worst variance of each mapped landmark, (n,) [m²]."""
    belief = situation.belief
    x = 3 + 2 * np.arange(len(belief.landmark_ids))
    cov = np.asarray(belief.covariance)
    return largest_variances(cov[x, x], cov[x, x + 1], cov[x + 1, x + 1])


def _kept_inside(goal: Array, scenario: Scenario) -> Array:
    left, bottom, right, top = world_bounds(scenario)
    low = np.array([left, bottom]) + _ROOM
    return np.clip(goal, low, np.array([right, top]) - _ROOM)


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


def _check_open_floor(scenario: Scenario) -> None:
    left, bottom, right, top = world_bounds(scenario)
    sides = {frozenset({left}), frozenset({right})}
    heights = {frozenset({bottom}), frozenset({top})}
    for index, (x0, y0, x1, y1) in enumerate(scenario.walls):
        if frozenset({x0, x1}) not in sides and frozenset({y0, y1}) not in heights:
            raise ValueError(
                f"the floor must be a rectangle without inner walls for a baseline, "
                f"got walls[{index}] = {(x0, y0, x1, y1)}"
            )
