"""Drives of the robot other than the unicycle: differential and bicycle.

Commands stay (d, α), the distance of the axle and the turn, so that every controller
drives every robot. The robot follows the arc of length d and angle α. The same numpy
functions serve one robot and many, so both give the same bits.

The filters' drives are separate code in `estimator`, which `envs` does not import.
"""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol

import numpy as np

from ..sim_configs import Robot
from ..sim_configs.scenario import largest_curvature


class RobotDrive(Protocol):
    """How a robot executes a command, and what its odometry reports."""

    def feasible(self, distance: Any, turn: Any) -> tuple[Any, Any]:
        """Return the command (d, α) that the robot executes; numbers or arrays."""
        ...

    def path(self, distance: Any, turn: Any) -> tuple[Any, Any]:
        """Return the displacement (forward, sideways) in the frame of the start [m]."""
        ...

    def reading(self, distance: Any, turn: Any) -> tuple[Any, Any]:
        """Return what the encoders report of a step (d, α)."""
        ...


def drive_of(robot: Robot) -> RobotDrive | None:
    """Return the drive of a robot, None for a unicycle."""
    match robot.drive:
        case "differential":
            assert robot.track_width is not None
            return DifferentialDrive(robot.track_width)
        case "bicycle":
            assert robot.wheelbase is not None
            curvature, ahead = largest_curvature(robot), robot.reference or (0.0, 0.0)
            return BicycleDrive(robot.wheelbase, curvature, ahead)
    return None


class DifferentialDrive(NamedTuple):
    """Two wheels on one axle; the odometry reports (left, right), their travel [m].

    ::

        left = d - α w / 2,    right = d + α w / 2

    Examples
    --------
    >>> left, right = DifferentialDrive(track_width=0.5).reading(1.0, 0.2)
    >>> round(left, 9), round(right, 9)
    (0.95, 1.05)
    """

    track_width: float  # w [m]

    def feasible(self, distance: Any, turn: Any) -> tuple[Any, Any]:
        """Return the command: every one is possible."""
        return distance, turn

    def path(self, distance: Any, turn: Any) -> tuple[Any, Any]:
        """Return the chord of the arc."""
        return arc(distance, turn)

    def reading(self, distance: Any, turn: Any) -> tuple[Any, Any]:
        """Return the travel of the wheels."""
        half = turn * (self.track_width / 2)
        return distance - half, distance + half


class BicycleDrive(NamedTuple):
    """A car; the odometry reports (d, φ), distance and steering angle [m, rad].

    With the wheelbase L, its rear axle follows an arc of the curvature tan φ / L, which
    the largest steering angle limits. At rest it cannot turn and reports φ = 0. The
    pose is that of the reference point.

    Examples
    --------
    >>> car = BicycleDrive(2.0, largest_curvature=0.5, reference=(1.0, 0.0))
    >>> car.feasible(1.0, 0.8)
    (1.0, np.float64(0.5))
    """

    wheelbase: float  # L [m]
    largest_curvature: float  # [1/m]
    reference: tuple[float, float]  # ahead and to the left of the rear axle [m]

    def feasible(self, distance: Any, turn: Any) -> tuple[Any, Any]:
        """Return the command with the turn within the steering."""
        most = abs(distance) * self.largest_curvature
        return distance, np.minimum(np.maximum(turn, -most), most)

    def path(self, distance: Any, turn: Any) -> tuple[Any, Any]:
        """Return the displacement of the reference point, which turns with the car."""
        (forward, sideways), (ahead, left) = arc(distance, turn), self.reference
        sin, versed = np.sin(turn), 2 * np.sin(turn / 2) ** 2
        return (
            forward - versed * ahead - sin * left,
            sideways + sin * ahead - versed * left,
        )

    def reading(self, distance: Any, turn: Any) -> tuple[Any, Any]:
        """Return distance and steering angle."""
        moves = distance != 0.0
        ratio = self.wheelbase * turn / np.where(moves, distance, 1.0)
        return distance, np.where(moves, np.arctan(ratio), 0.0)


def arc(distance: Any, turn: Any) -> tuple[Any, Any]:
    """Return the chord (forward, sideways) of an arc, in the frame of its start [m].

    ::

        d sin(α/2) / (α/2) (cos(α/2), sin(α/2))

    Examples
    --------
    >>> forward, left = arc(np.pi, np.pi)
    >>> round(float(forward), 9), round(float(left), 9)
    (0.0, 2.0)
    """
    half = turn / 2
    chord = distance * np.sinc(half / np.pi)
    return chord * np.cos(half), chord * np.sin(half)
