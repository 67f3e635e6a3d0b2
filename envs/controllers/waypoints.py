"""Waypoint control: turn towards the next point, then drive to it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from ...arrays import Array
from ...sim_configs import Robot, Scenario
from ..angles import wrap_angle
from .interface import each, finite_pose, finite_poses, finite_rows, positive
from .planned_path import planned_path

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
    def for_scenario(cls, scenario: Scenario) -> Self:
        """Make the controller that follows the planned path of a scenario.

        A position counts as reached half a step before it.
        """
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
