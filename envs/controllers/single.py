"""Drivers for the robot: from a pose to the next action.

A controller is anything with ``act(pose, step)``. The pose may be the true one, from
``info["pose"]``, or an estimated one, from a filter's belief: a controller cannot tell,
so the same one serves to generate data and to drive on an estimate. Headings may be
wrapped or not. Every action stays within the limits of the robot.
"""

import math
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...sim_configs import Robot, Scenario, action_sequence
from ...sim_configs.scenario_errors import closest
from .planned_path import planned_path

Array = NDArray[np.float64]

CONTROLLERS = ("open_loop", "waypoints", "random")
_ALIGNED = 0.3  # heading error below which the robot drives while it turns [rad]


class Controller(Protocol):
    """What drives a robot."""

    def act(self, pose: ArrayLike, step: int) -> Array:
        """Choose the next action.

        Parameters
        ----------
        pose : array_like, shape (3,)
            (x, y, θ) of the robot, true or estimated [m, m, rad].
        step : int
            Steps of the episode done so far. Step 0 starts a controller anew.

        Returns
        -------
        ndarray of float64, shape (2,)
            (v, ω) [m/s, rad/s], a fresh array.
        """
        ...


class OpenLoop:
    """Follow a sequence of actions, over and over, wherever the robot is.

    Parameters
    ----------
    actions : array_like, shape (K, 2)
        Rows (v, ω) [m/s, rad/s], for example from `action_sequence`.
    robot : Robot
        Whose limits hold; faster actions are clipped.

    Examples
    --------
    >>> from slamgym.sim_configs import load_scenario
    >>> scenario = load_scenario("loop")
    >>> driver = OpenLoop(action_sequence(scenario), scenario.robot)
    >>> driver.act((0.0, 0.0, 0.0), step=0).tolist()
    [0.25, 0.025]
    """

    def __init__(self, actions: ArrayLike, robot: Robot) -> None:
        limits = np.array([robot.max_speed, robot.max_turn_rate])
        self._actions = np.clip(_finite_rows(actions, "actions"), -limits, limits)

    def act(self, pose: ArrayLike, step: int) -> Array:
        """Give the action of this step; see `Controller.act`."""
        return np.array(self._actions[step % len(self._actions)])


class Waypoints:
    """Visit points in turn: turn towards the next one, then drive to it.

    A robot that looks away from its waypoint by more than 0.3 rad turns on the spot;
    otherwise it drives and turns in proportion to what is left. After the last
    waypoint it stands still, or begins again if it loops.

    Parameters
    ----------
    points : array_like, shape (K, 2)
        Positions to visit (x, y) [m].
    robot : Robot
        Whose limits hold.
    dt : float
        Duration of one step [s].
    tolerance : float
        Distance at which a waypoint counts as reached [m].
    loop : bool, optional
        Whether the first waypoint follows the last.

    Examples
    --------
    >>> driver = Waypoints([(5.0, 0.0)], Robot(), dt=0.5, tolerance=0.1)
    >>> driver.act((0.0, 0.0, 0.0), step=0).tolist()
    [1.0, 0.0]
    """

    def __init__(
        self,
        points: ArrayLike,
        robot: Robot,
        *,
        dt: float,
        tolerance: float,
        loop: bool = False,
    ) -> None:
        self._points = _finite_rows(points, "points")
        self._robot = robot
        self._dt = _positive(dt, "dt")
        self._tolerance = _positive(tolerance, "tolerance")
        self._loop = loop
        self._next = 0

    def act(self, pose: ArrayLike, step: int) -> Array:
        """Head for the next waypoint; see `Controller.act`."""
        if step == 0:
            self._next = 0
        x, y, heading = _pose(pose)
        self._pass_reached(x, y)
        if self._next >= len(self._points):
            return np.zeros(2)
        ahead, aside = self._points[self._next] - (x, y)
        error = _wrap(math.atan2(aside, ahead) - heading)
        distance = math.hypot(ahead, aside)
        speed = distance * math.cos(error) / self._dt if abs(error) < _ALIGNED else 0.0
        limit = self._robot.max_turn_rate
        turn_rate = min(max(error / self._dt, -limit), limit)
        return np.array([min(speed, self._robot.max_speed), turn_rate])

    def _pass_reached(self, x: float, y: float) -> None:
        """Advance past the waypoints within reach, at most once round the loop."""
        for _ in range(len(self._points)):
            if self._next >= len(self._points):
                break
            if math.dist(self._points[self._next], (x, y)) > self._tolerance:
                break
            self._next += 1
            if self._loop:
                self._next %= len(self._points)


class RandomSmooth:
    """Wander with a speed and a turn rate that drift slowly.

    Both follow an Ornstein-Uhlenbeck process s, sampled exactly at the steps::

        s' = ρ s + √(1 - ρ²) n,    ρ = exp(-dt / correlation_time),  n ~ N(0, 1)
        v = max_speed (1/2 + s_v / 4),      clipped to [0, max_speed]
        ω = max_turn_rate (s_ω / 3 + e),    clipped to ± max_turn_rate

    with e = 0 within reach of home, and the angle from the heading to home beyond it.

    Parameters
    ----------
    rng : numpy.random.Generator
        Where the wandering comes from.
    robot : Robot
        Whose limits hold.
    dt : float
        Duration of one step [s].
    correlation_time : float, optional
        Time over which the robot forgets what it did [s].
    home : (float, float), optional
        Where the robot turns to when it has gone too far (x, y) [m].
    reach : float, optional
        How far from home that is [m]; the default never is.

    Examples
    --------
    >>> driver = RandomSmooth(np.random.default_rng(1), Robot(), dt=0.1)
    >>> driver.act((0.0, 0.0, 0.0), step=0).round(3).tolist()
    [0.586, 0.274]
    """

    def __init__(
        self,
        rng: np.random.Generator,
        robot: Robot,
        *,
        dt: float,
        correlation_time: float = 5.0,
        home: tuple[float, float] = (0.0, 0.0),
        reach: float = math.inf,
    ) -> None:
        self._rng = rng
        self._robot = robot
        self._memory = math.exp(
            -_positive(dt, "dt") / _positive(correlation_time, "correlation_time")
        )
        self._home = home
        self._reach = reach
        self._state = np.zeros(2)

    def act(self, pose: ArrayLike, step: int) -> Array:
        """Drift on from the last action; see `Controller.act`."""
        memory = self._memory if step > 0 else 0.0
        noise = math.sqrt(1 - memory**2) * self._rng.standard_normal(2)
        self._state = memory * self._state + noise
        speed = 0.5 + self._state[0] / 4
        turn = self._state[1] / 3 + self._way_home(*_pose(pose))
        return np.array(
            [
                self._robot.max_speed * np.clip(speed, 0.0, 1.0),
                self._robot.max_turn_rate * np.clip(turn, -1.0, 1.0),
            ]
        )

    def _way_home(self, x: float, y: float, heading: float) -> float:
        ahead, aside = self._home[0] - x, self._home[1] - y
        if math.hypot(ahead, aside) <= self._reach:
            return 0.0
        return _wrap(math.atan2(aside, ahead) - heading)


def make_controller(
    name: str, scenario: Scenario, rng: np.random.Generator
) -> Controller:
    """Make a controller for a scenario by name.

    Parameters
    ----------
    name : {"open_loop", "waypoints", "random"}
        ``"open_loop"`` follows the scenario's controls, ``"waypoints"`` steers along
        the path they would take without noise, ``"random"`` wanders around there.
    scenario : Scenario
        Its controls, step and robot are used.
    rng : numpy.random.Generator
        Used by ``"random"`` only.

    Raises
    ------
    ValueError
        If there is no such controller.
    """
    match name:
        case "open_loop":
            return OpenLoop(action_sequence(scenario), scenario.robot)
        case "waypoints":
            return _follow_plan(scenario)
        case "random":
            return _wander_near_plan(scenario, rng)
    names, hint = ", ".join(CONTROLLERS), closest(name, CONTROLLERS)
    raise ValueError(f"name must be one of {names}, got {name!r}{hint}")


def _follow_plan(scenario: Scenario) -> Waypoints:
    """Visit the planned positions; one counts as reached half a step before it."""
    positions = planned_path(scenario)[:, :2]
    legs = np.hypot(*np.diff(positions, axis=0).T)
    return Waypoints(
        positions[1:],
        scenario.robot,
        dt=scenario.dt,
        tolerance=legs.max() / 2 if legs.any() else scenario.robot.radius,
    )


def _wander_near_plan(scenario: Scenario, rng: np.random.Generator) -> RandomSmooth:
    """Wander within the circle around the rectangle that holds the planned path."""
    positions = planned_path(scenario)[:, :2]
    low, high = positions.min(axis=0), positions.max(axis=0)
    x, y = (low + high) / 2
    reach = max(math.dist(low, high) / 2, scenario.robot.radius)
    return RandomSmooth(
        rng, scenario.robot, dt=scenario.dt, home=(float(x), float(y)), reach=reach
    )


def _wrap(angle: float) -> float:
    """Bring an angle to [-π, π)."""
    return (angle + math.pi) % (2 * math.pi) - math.pi


def _pose(pose: ArrayLike) -> Array:
    array = np.asarray(pose, dtype=np.float64)
    if array.shape != (3,) or not np.isfinite(array).all():
        raise ValueError(f"pose must be 3 finite numbers (x, y, θ), got {pose!r}")
    return array


def _finite_rows(rows: ArrayLike, name: str) -> Array:
    array = np.array(rows, dtype=np.float64)
    if array.ndim != 2 or array.shape[1] != 2 or not len(array):
        raise ValueError(f"{name} must have shape (K, 2), K >= 1, got {array.shape}")
    if not np.isfinite(array).all():
        raise ValueError(f"{name} must be finite, got {rows!r}")
    return array


def _positive(value: float, name: str) -> float:
    if not 0 < value < math.inf:
        raise ValueError(f"{name} must be finite and > 0, got {value}")
    return value
