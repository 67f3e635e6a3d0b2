"""Which part of the plane the live view shows."""

import numpy as np
from numpy.typing import NDArray

from ...sim_configs import Scenario
from ..controllers.planned_path import planned_path
from .render_state import WorldSnapshot

Array = NDArray[np.floating]

_MARGIN = 0.06  # of the span, on every side
_EDGE = 0.02  # of the span: nearer to the border counts as outside
_GROWTH = 0.25  # of the span, beyond a robot that has left the view


class ViewLimits:
    """A rectangle that holds the world at first, and the robot at any time.

    The first rectangle holds the landmarks, the walls, the start and the path that the
    scenario's controls plan; it grows in leaps when the robot drives out of it, and is
    as at first when an episode begins.

    Parameters
    ----------
    scenario : Scenario
        Gives walls, start and planned path.
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
        self._first = self._fit(low - room, high + room)
        self._box = self._first

    @property
    def x(self) -> tuple[float, float]:
        """Left and right end [m]."""
        return float(self._box[0, 0]), float(self._box[1, 0])

    @property
    def y(self) -> tuple[float, float]:
        """Lower and upper end [m]."""
        return float(self._box[0, 1]), float(self._box[1, 1])

    def follow(self, snapshot: WorldSnapshot) -> bool:
        """Make room for the path driven so far; return whether the limits changed."""
        before = self._box
        box = self._first if snapshot.step == 0 else before
        track = np.concatenate(
            [np.reshape(snapshot.path, (-1, 2)), [snapshot.pose[:2]]]
        )
        low, high = track.min(axis=0), track.max(axis=0)
        span = (box[1] - box[0]).max()
        if (low < box[0] + _EDGE * span).any() or (high > box[1] - _EDGE * span).any():
            leap = _GROWTH * span
            box = self._fit(
                np.where(low < box[0] + _EDGE * span, low - leap, box[0]),
                np.where(high > box[1] - _EDGE * span, high + leap, box[1]),
            )
        self._box = box
        return bool((box != before).any())

    def _fit(self, low: Array, high: Array) -> Array:
        """Widen a rectangle about its centre to the aspect."""
        centre, (width, height) = (low + high) / 2, high - low
        width = max(width, height * self._aspect)
        half = np.array([width, width / self._aspect]) / 2
        return np.stack([centre - half, centre + half])
