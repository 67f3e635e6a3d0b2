"""Controllers: from a pose to the next action, for one robot or for many.

A controller has a method ``act(pose, step)``. The pose is the true one, from
``info["pose"]``, or an estimate from a filter's belief, so the same controller can
generate data and drive on an estimate. Headings need not be wrapped. Every action stays
within the limits of the robot.

The vector form of a controller gives robot i the actions of a single controller to the
bit.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, Protocol, Self

import numpy as np
from numpy.typing import ArrayLike

from ..arrays import Array
from ..sim_configs import Robot, Scenario, action_sequence, load_scenario
from ..sim_configs.field_types import unknown_choice
from .drives import drive_of
from .robot import displacement, wrap_angle

__all__ = [
    "CONTROLLERS",
    "Controller",
    "OpenLoop",
    "RandomWalk",
    "VectorController",
    "VectorOpenLoop",
    "VectorRandomWalk",
    "VectorWaypoints",
    "Waypoints",
    "make_controller",
    "make_vector_controller",
    "planned_path",
]
__dir__ = __all__.copy

#: The names that :func:`make_controller` accepts.
CONTROLLERS = ("open_loop", "waypoints", "random")


def make_controller(
    name: str, scenario: Scenario | str, rng: np.random.Generator
) -> Controller:
    """Make the controller of a name for a scenario.

    Parameters
    ----------
    name : {"open_loop", "waypoints", "random"}
        ``"open_loop"`` executes the scenario's controls. ``"waypoints"`` steers along
        the path that they take without noise. ``"random"`` is a random walk near that
        path.
    scenario : Scenario or str
        Source of the controls, the step and the robot; a str as in `load_scenario`.
    rng : numpy.random.Generator
        Used by ``"random"`` only.

    Raises
    ------
    ValueError
        If there is no such controller, or the robot cannot drive as it demands.
    """
    match name:
        case "open_loop":
            return OpenLoop.for_scenario(scenario)
        case "waypoints":
            return Waypoints.for_scenario(scenario)
        case "random":
            return RandomWalk.for_scenario(scenario, rng)
    raise ValueError(unknown_choice("name", name, CONTROLLERS))


def make_vector_controller(
    name: str, scenarios: Sequence[Scenario], generators: Sequence[np.random.Generator]
) -> VectorController:
    """Return the named controller for the robots of several worlds.

    Parameters
    ----------
    name : {"open_loop", "waypoints", "random"}
        As in `make_controller`.
    scenarios : sequence of Scenario, length B
        The world of each robot; all have equally many steps.
    generators : sequence of numpy.random.Generator, length B
        Used by ``"random"`` only, which draws ahead from them.

    Raises
    ------
    ValueError
        If there is no such controller, or the lengths differ.

    Examples
    --------
    >>> from slamgym.sim_configs import load_scenario
    >>> rngs = [np.random.default_rng(seed) for seed in (0, 1)]
    >>> scenarios = [load_scenario("loop")] * 2
    >>> controller = make_vector_controller("open_loop", scenarios, rngs)
    >>> controller.act(np.zeros((2, 3)), step=0).tolist()
    [[0.25, 0.025], [0.25, 0.025]]
    """
    if not scenarios or len(scenarios) != len(generators):
        raise ValueError(
            "scenarios and generators must be equally many, at least 1, "
            f"got {len(scenarios)} and {len(generators)}"
        )
    made: dict[int, Any] = {}  # one for all worlds of the same scenario object
    for scenario, rng in zip(scenarios, generators, strict=True):
        if id(scenario) not in made:
            made[id(scenario)] = make_controller(name, scenario, rng)
    singles = [made[id(scenario)] for scenario in scenarios]
    match name:
        case "open_loop":
            return VectorOpenLoop(singles)
        case "waypoints":
            return VectorWaypoints(singles)
    return VectorRandomWalk(singles, generators)


class Controller(Protocol):
    """Chooses the actions of one robot."""

    def act(self, pose: ArrayLike, step: int) -> Array:
        """Choose the next action.

        Parameters
        ----------
        pose : array_like, shape (3,)
            (x, y, θ) of the robot, true or estimated [m, m, rad].
        step : int
            Steps of the episode so far. Step 0 restarts the controller.

        Returns
        -------
        ndarray of float64, shape (2,)
            (v, ω) [m/s, rad/s], a new array.
        """
        ...


class VectorController(Protocol):
    """Chooses the actions of B robots."""

    def act(self, poses: ArrayLike, step: int) -> Array:
        """Choose the next action of every robot.

        Parameters
        ----------
        poses : array_like, shape (B, 3)
            (x, y, θ) of the robots, true or estimated [m, m, rad].
        step : int
            Steps of the episode so far, the same for all. Step 0 restarts them.

        Returns
        -------
        ndarray of float64, shape (B, 2)
            (v, ω) [m/s, rad/s], a new array.
        """
        ...


def each(function: Callable[..., float], *arguments: Array) -> Array:
    """Apply a function of `math` to every element.

    The sines and roots of numpy differ from those of `math` in the last bit.
    """
    numbers = [argument.tolist() for argument in arguments]
    return np.fromiter(map(function, *numbers), np.float64, len(numbers[0]))


def finite_pose(pose: ArrayLike) -> Array:
    """Return one pose as an array, or raise a `ValueError`."""
    array = np.asarray(pose, dtype=np.float64)
    if array.shape != (3,) or not np.isfinite(array).all():
        raise ValueError(f"pose must be 3 finite numbers (x, y, θ), got {pose!r}")
    return array


def finite_poses(poses: ArrayLike, count: int) -> Array:
    """Return the poses of some robots as an array, or raise a `ValueError`."""
    array = np.asarray(poses, dtype=np.float64)
    if array.shape != (count, 3) or not np.isfinite(array).all():
        raise ValueError(
            f"poses must be finite, one row (x, y, θ) for each of {count} robots, "
            f"got {poses!r}"
        )
    return array


def finite_rows(rows: ArrayLike, name: str) -> Array:
    """Return rows of two numbers as a new array, or raise a `ValueError`."""
    array = np.array(rows, dtype=np.float64)
    if array.ndim != 2 or array.shape[1] != 2 or not len(array):
        raise ValueError(f"{name} must have shape (K, 2), K >= 1, got {array.shape}")
    if not np.isfinite(array).all():
        raise ValueError(f"{name} must be finite, got {rows!r}")
    return array


def positive(value: float, name: str) -> float:
    """Return a number, or raise a `ValueError` if it is not finite and positive."""
    if not 0 < value < math.inf:
        raise ValueError(f"{name} must be finite and > 0, got {value}")
    return value


class OpenLoop:
    """Repeats a sequence of actions.

    Parameters
    ----------
    actions : array_like, shape (K, 2)
        Rows (v, ω) [m/s, rad/s], for example from `action_sequence`.
    robot : Robot
        Source of the limits; faster actions are clipped.

    Examples
    --------
    >>> from slamgym.sim_configs import load_scenario
    >>> scenario = load_scenario("loop")
    >>> controller = OpenLoop(action_sequence(scenario), scenario.robot)
    >>> controller.act((0.0, 0.0, 0.0), step=0).tolist()
    [0.25, 0.025]
    """

    def __init__(self, actions: ArrayLike, robot: Robot) -> None:
        limits = np.array([robot.max_speed, robot.max_turn_rate])
        self.actions = np.clip(finite_rows(actions, "actions"), -limits, limits)

    @classmethod
    def for_scenario(cls, scenario: Scenario | str) -> Self:
        """Make the controller that executes a scenario's controls."""
        scenario = load_scenario(scenario)
        return cls(action_sequence(scenario), scenario.robot)

    def act(self, pose: ArrayLike, step: int) -> Array:
        """Return the action of this step; see `Controller.act`."""
        return np.array(self.actions[step % len(self.actions)])


class VectorOpenLoop:
    """Repeats one sequence of actions per robot; the vector form of `OpenLoop`.

    Parameters
    ----------
    controllers : sequence of OpenLoop, length B
        One per robot, all with equally many actions.
    """

    def __init__(self, controllers: Sequence[OpenLoop]) -> None:
        self._actions = np.array([each.actions for each in controllers])

    def act(self, poses: ArrayLike, step: int) -> Array:
        """Return the actions of this step; see `VectorController.act`."""
        finite_poses(poses, len(self._actions))
        return np.array(self._actions[:, step % self._actions.shape[1]])


_BLOCK = 128  # steps of noise drawn ahead


class RandomWalk:
    """Drives with a speed and a turn rate that drift slowly.

    Both follow an Ornstein-Uhlenbeck process s, sampled exactly at the steps::

        s' = ρ s + √(1 - ρ²) n,    ρ = exp(-dt / correlation_time),  n ~ N(0, 1)
        v = max_speed (1/2 + s_v / 4),      clipped to [0, max_speed]
        ω = max_turn_rate (s_ω / 3 + e),    clipped to ± max_turn_rate

    with e = 0 within `reach` of `home`, else the angle from the heading to `home`.

    Parameters
    ----------
    rng : numpy.random.Generator
        Source of the random numbers.
    robot : Robot
        Source of the limits.
    dt : float
        Duration of one step [s].
    correlation_time : float, optional
        Time constant of the process [s].
    home : (float, float), optional
        Position to which the robot turns when it is too far away (x, y) [m].
    reach : float, optional
        Distance from `home` beyond which it turns [m]; by default infinite.

    Examples
    --------
    >>> controller = RandomWalk(np.random.default_rng(1), Robot(), dt=0.1)
    >>> controller.act((0.0, 0.0, 0.0), step=0).round(3).tolist()
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
        self.robot = robot
        self.correlation = math.exp(
            -positive(dt, "dt") / positive(correlation_time, "correlation_time")
        )
        self.home = home
        self.reach = reach
        self._state = np.zeros(2)

    @classmethod
    def for_scenario(cls, scenario: Scenario | str, rng: np.random.Generator) -> Self:
        """Make a random walk within the circle around a scenario's planned path."""
        scenario = load_scenario(scenario)
        positions = planned_path(scenario)[:, :2]
        low, high = positions.min(axis=0), positions.max(axis=0)
        x, y = (low + high) / 2
        reach = max(math.dist(low, high) / 2, scenario.robot.radius)
        home = float(x), float(y)
        return cls(rng, scenario.robot, dt=scenario.dt, home=home, reach=reach)

    def act(self, pose: ArrayLike, step: int) -> Array:
        """Continue the walk; see `Controller.act`."""
        correlation = self.correlation if step > 0 else 0.0
        noise = math.sqrt(1 - correlation**2) * self._rng.standard_normal(2)
        self._state = correlation * self._state + noise
        speed = 0.5 + self._state[0] / 4
        turn = self._state[1] / 3 + self._angle_to_home(*finite_pose(pose))
        return np.array(
            [
                self.robot.max_speed * np.clip(speed, 0.0, 1.0),
                self.robot.max_turn_rate * np.clip(turn, -1.0, 1.0),
            ]
        )

    def _angle_to_home(self, x: float, y: float, heading: float) -> float:
        dx, dy = self.home[0] - x, self.home[1] - y
        if math.hypot(dx, dy) <= self.reach:
            return 0.0
        return wrap_angle(math.atan2(dy, dx) - heading)


class VectorRandomWalk:
    """Drives every robot on its own random walk; the vector form of `RandomWalk`.

    Parameters
    ----------
    controllers : sequence of RandomWalk, length B
        Source of the limits, correlations and homes; their generators are not used.
    generators : sequence of numpy.random.Generator, length B
        Source of the random numbers of each robot. The walk draws ahead from them.
    """

    def __init__(
        self,
        controllers: Sequence[RandomWalk],
        generators: Sequence[np.random.Generator],
    ) -> None:
        self._generators = generators
        self._limits = np.array(
            [(one.robot.max_speed, one.robot.max_turn_rate) for one in controllers]
        )
        self._correlation = np.array([[one.correlation] for one in controllers])
        self._noise_std = np.sqrt(1 - self._correlation**2)
        self._homes = np.array([one.home for one in controllers])
        self._reach = np.array([one.reach for one in controllers])
        self._state = np.zeros((len(controllers), 2))
        self._noise: list[Array] = []  # (B, 2) of the steps to come, the next one last

    def act(self, poses: ArrayLike, step: int) -> Array:
        """Continue the walks; see `VectorController.act`."""
        array = finite_poses(poses, len(self._state))
        kept, std = (self._correlation, self._noise_std) if step > 0 else (0.0, 1.0)
        self._state = kept * self._state + std * self._next_noise()
        speed = np.clip(0.5 + self._state[:, 0] / 4, 0.0, 1.0)
        turn = np.clip(self._state[:, 1] / 3 + self._angles_to_home(array), -1.0, 1.0)
        return self._limits * np.column_stack([speed, turn])

    def _next_noise(self) -> Array:
        if not self._noise:
            drawn = [rng.standard_normal((_BLOCK, 2)) for rng in self._generators]
            self._noise = list(np.stack(drawn, axis=1))[::-1]
        return self._noise.pop()

    def _angles_to_home(self, poses: Array) -> Array:
        """Return the angles from the headings to the homes, 0 within reach of them."""
        dx, dy = (self._homes - poses[:, :2]).T
        angles = wrap_angle(each(math.atan2, dy, dx) - poses[:, 2])
        angles[each(math.hypot, dx, dy) <= self._reach] = 0.0
        return angles


_ALIGNED = 0.3  # heading error below which the robot drives while it turns [rad]


class Waypoints:
    """Visits points in turn.

    With e the wrapped angle from the heading to the waypoint, and r its distance::

        v = r cos(e) / dt  if |e| < 0.3 rad, else 0,    at most max_speed
        ω = e / dt,                                     clipped to ± max_turn_rate

    After the last waypoint the robot stands still, or starts again if it loops.

    Parameters
    ----------
    points : array_like, shape (K, 2)
        Positions to visit (x, y) [m].
    robot : Robot
        Source of the limits.
    dt : float
        Duration of one step [s].
    tolerance : float
        Distance at which a waypoint counts as reached [m].
    loop : bool, optional
        Whether the first waypoint follows the last.

    Examples
    --------
    >>> controller = Waypoints([(5.0, 0.0)], Robot(), dt=0.5, tolerance=0.1)
    >>> controller.act((0.0, 0.0, 0.0), step=0).tolist()
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
        self.points = finite_rows(points, "points")
        self.robot = robot
        self.dt = positive(dt, "dt")
        self.tolerance = positive(tolerance, "tolerance")
        self.loop = loop
        self._next = 0

    @classmethod
    def for_scenario(cls, scenario: Scenario | str) -> Self:
        """Make the controller that follows the planned path of a scenario.

        A position counts as reached half a step before it.
        """
        scenario = load_scenario(scenario)
        if scenario.robot.drive == "bicycle":
            raise ValueError(
                "controller 'waypoints' turns the robot at rest, but a robot with "
                "drive = 'bicycle' cannot do this: use 'open_loop' or 'random'"
            )
        positions = planned_path(scenario)[:, :2]
        legs = np.hypot(*np.diff(positions, axis=0).T)
        return cls(
            positions[1:],
            scenario.robot,
            dt=scenario.dt,
            tolerance=legs.max() / 2 if legs.any() else scenario.robot.radius,
        )

    def act(self, pose: ArrayLike, step: int) -> Array:
        """Drive towards the next waypoint; see `Controller.act`."""
        x, y, heading = finite_pose(pose)
        point = self.next_point(x, y, step)
        if point is None:
            return np.zeros(2)
        dx, dy = point - (x, y)
        error = wrap_angle(math.atan2(dy, dx) - heading)
        speed = 0.0
        if abs(error) < _ALIGNED:
            speed = math.hypot(dx, dy) * math.cos(error) / self.dt
        limit = self.robot.max_turn_rate
        turn_rate = min(max(error / self.dt, -limit), limit)
        return np.array([min(speed, self.robot.max_speed), turn_rate])

    def next_point(self, x: float, y: float, step: int) -> Array | None:
        """Return the next waypoint of a robot at (x, y), (2,) [m]; None after the last.

        Skips the waypoints within the tolerance, at most once round the loop. Step 0
        starts again.
        """
        if step == 0:
            self._next = 0
        for _ in range(len(self.points)):
            if self._next >= len(self.points):
                break
            if math.dist(self.points[self._next], (x, y)) > self.tolerance:
                break
            self._next += 1
            if self.loop:
                self._next %= len(self.points)
        return self.points[self._next] if self._next < len(self.points) else None


class VectorWaypoints:
    """Visits the points of each robot in turn; the vector form of `Waypoints`.

    Parameters
    ----------
    controllers : sequence of Waypoints, length B
        One per robot, all with equally many points.
    """

    def __init__(self, controllers: Sequence[Waypoints]) -> None:
        self._robots = np.arange(len(controllers))
        self._points = np.array([one.points for one in controllers])
        self._max_speed, self._max_turn_rate, self._dt, self._tolerance = np.array(
            [
                (one.robot.max_speed, one.robot.max_turn_rate, one.dt, one.tolerance)
                for one in controllers
            ]
        ).T
        self._loops = np.array([one.loop for one in controllers])
        self._next = np.zeros(len(controllers), dtype=np.intp)

    def act(self, poses: ArrayLike, step: int) -> Array:
        """Drive towards the next waypoints; see `VectorController.act`."""
        array = finite_poses(poses, len(self._robots))
        if step == 0:
            self._next[:] = 0
        dx, dy, distance = self._pass_reached(array[:, :2])
        error = wrap_angle(each(math.atan2, dy, dx) - array[:, 2])
        speed = distance * each(math.cos, error) / self._dt
        speed[~(np.abs(error) < _ALIGNED)] = 0.0
        turn_rate = np.minimum(
            np.maximum(error / self._dt, -self._max_turn_rate), self._max_turn_rate
        )
        actions = np.column_stack([np.minimum(speed, self._max_speed), turn_rate])
        actions[self._next >= self._points.shape[1]] = 0.0
        return actions

    def _pass_reached(self, positions: Array) -> tuple[Array, Array, Array]:
        """Skip the waypoints within the tolerance.

        Returns the vectors to the next ones, dx and dy, and their lengths.
        """
        count = self._points.shape[1]
        for _ in range(count):
            dx, dy, distance = self._vectors_to_next(positions)
            passed = (distance <= self._tolerance) & (self._next < count)
            if not passed.any():
                return dx, dy, distance
            self._next += passed
            self._next[self._loops] %= count
        return self._vectors_to_next(positions)

    def _vectors_to_next(self, positions: Array) -> tuple[Array, Array, Array]:
        places = np.minimum(self._next, self._points.shape[1] - 1)
        dx, dy = (self._points[self._robots, places] - positions).T
        return dx, dy, each(math.hypot, dx, dy)


def planned_path(scenario: Scenario) -> Array:
    """Compute the poses of the scenario's controls, without noise and walls.

    Returns
    -------
    ndarray of float64, shape (steps + 1, 3)
        Poses (x, y, θ) [m, m, rad] from the start on; headings are not wrapped.

    Examples
    --------
    >>> from slamgym.sim_configs import load_scenario
    >>> planned_path(load_scenario("six_landmarks"))[5].tolist()
    [15.0, 0.0, 0.0]
    """
    distances, turns = (action_sequence(scenario) * scenario.dt).T
    x, y, heading = scenario.start.pose
    headings = np.cumsum([heading, *turns])
    cos, sin = np.cos(headings[:-1]), np.sin(headings[:-1])
    drive = drive_of(scenario.robot)
    path = (distances, np.zeros(len(distances)))
    if drive is not None:
        path = drive.path(distances, turns)
    dx, dy = displacement(*path, cos, sin)
    return np.column_stack([np.cumsum([x, *dx]), np.cumsum([y, *dy]), headings])
