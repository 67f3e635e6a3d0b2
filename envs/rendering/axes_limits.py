"""The limits of the axes: the part of the plane that a frame shows."""

import numpy as np

from ...arrays import Array
from ...sim_configs import Scenario
from ..controllers import planned_path
from .render_state import RenderState

_MARGIN = 0.06  # of the span, on every side
_EDGE = 0.02  # of the span; a robot this near to the border counts as outside
_GROWTH = 0.25  # of the span, beyond the robot
_NEAR = 3.0  # ranges of the sensor to every side of a robot that is followed
_LARGE = 3.0  # times what is near: a world that is too large to be shown as a whole
_AHEAD = 0.25  # of the span; a followed robot this near to the border is centred


class AxesLimits:
    """A rectangle that always contains the robot.

    The initial rectangle contains the landmarks, the walls, the start and the planned
    path. It grows in steps when the robot drives out of it. Every episode begins with
    the initial rectangle. In a world that is much larger than the range of the sensor,
    the rectangle shows the surroundings of the robot and moves with it, in steps.

    Parameters
    ----------
    scenario : Scenario
        Source of walls, start and planned path.
    landmarks : ndarray, shape (N, 2)
        True positions [m].
    aspect : float
        Width of the rectangle over its height.
    """

    def __init__(self, scenario: Scenario, landmarks: Array, aspect: float) -> None:
        self._aspect = aspect
        points = np.concatenate(
            [
                np.reshape(landmarks, (-1, 2)),
                np.reshape(scenario.walls, (-1, 2)),
                planned_path(scenario)[:, :2],
            ]
        )
        low, high = points.min(axis=0), points.max(axis=0)
        smallest = 8 * scenario.robot.radius
        room = np.maximum(_MARGIN * (high - low).max(), (smallest - (high - low)) / 2)
        self._initial = self._fit(low - room, high + room)
        self._near = _NEAR * scenario.sensor.max_range
        self._follows = bool((high - low).max() > 2 * _LARGE * self._near)
        if self._follows:
            self._initial = self._around(np.array(scenario.start.pose[:2]))
        self._box = self._initial

    @property
    def x(self) -> tuple[float, float]:
        """Left and right end [m]."""
        return float(self._box[0, 0]), float(self._box[1, 0])

    @property
    def y(self) -> tuple[float, float]:
        """Lower and upper end [m]."""
        return float(self._box[0, 1]), float(self._box[1, 1])

    def follow(self, state: RenderState) -> bool:
        """Extend or move the limits to the robot; return whether they changed."""
        before = self._box
        box = self._initial if state.step == 0 else before
        if self._follows:
            self._box = self._moved(box, state.pose[:2])
            return bool((self._box != before).any())
        track = np.concatenate([np.reshape(state.path, (-1, 2)), [state.pose[:2]]])
        low, high = track.min(axis=0), track.max(axis=0)
        span = (box[1] - box[0]).max()
        if (low < box[0] + _EDGE * span).any() or (high > box[1] - _EDGE * span).any():
            growth = _GROWTH * span
            box = self._fit(
                np.where(low < box[0] + _EDGE * span, low - growth, box[0]),
                np.where(high > box[1] - _EDGE * span, high + growth, box[1]),
            )
        self._box = box
        return bool((box != before).any())

    def _moved(self, box: Array, robot: Array) -> Array:
        """Centre a rectangle on a robot that is near its border."""
        edge = _AHEAD * (box[1] - box[0])
        inside = (robot > box[0] + edge).all() and (robot < box[1] - edge).all()
        return box if inside else self._around(robot)

    def _around(self, robot: Array) -> Array:
        return self._fit(robot - self._near, robot + self._near)

    def _fit(self, low: Array, high: Array) -> Array:
        """Widen a rectangle about its centre to the aspect ratio."""
        centre, (width, height) = (low + high) / 2, high - low
        width = max(width, height * self._aspect)
        half = np.array([width, width / self._aspect]) / 2
        return np.stack([centre - half, centre + half])
