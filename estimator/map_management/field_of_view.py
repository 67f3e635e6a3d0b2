"""Landmarks that a scan should show: those in the field of view of the sensor."""

from collections.abc import Callable
from dataclasses import dataclass
from math import inf, pi

import numpy as np

from ...arrays import Array, BoolArray
from ..models.bearing_range import wrap_angle
from ..support import argument_checks

Visibility = Callable[[Array, Array], BoolArray]


@dataclass(frozen=True)
class FieldOfView:
    """The field of view of a sensor, and what may hide a landmark in it.

    A scan is expected to show a landmark that lies inside the limits by a margin, is
    not hidden, and is not behind another reading.

    Raises
    ------
    ValueError
        If a limit is not a number, or the field of view is empty.

    Examples
    --------
    >>> ahead = FieldOfView(max_range=8.0, angle=np.pi)
    >>> landmarks = np.array([[5.0, 1.0], [-5.0, 1.0], [9.0, 0.0]])
    >>> ahead.expects(np.zeros(3), landmarks, np.empty((0, 2))).tolist()
    [True, False, False]
    """

    max_range: float
    """Largest range [m]."""
    min_range: float = 0.0
    """Smallest range [m]."""
    angle: float = 2 * pi
    """Full angle, centred on the heading [rad]."""
    range_margin: float = 0.5
    """Landmarks nearer than this to a range limit are not expected [m]."""
    bearing_margin: float = 0.05
    """Landmarks nearer than this to an edge of the angle are not expected [rad]."""
    shadow: float = 0.0
    """A landmark within this angle of a nearer reading may be hidden by it [rad]."""
    visible: Visibility | None = None
    """Function of a pose (3,) and landmarks (n, 2): True, shape (n,), if not hidden."""

    def __post_init__(self) -> None:
        for name in ("min_range", "range_margin", "bearing_margin", "shadow"):
            argument_checks.at_least(name, getattr(self, name), 0.0)
        if self.max_range != inf:
            argument_checks.above("max_range", self.max_range, self.min_range)
        argument_checks.above("angle", self.angle, 0.0)
        if self.angle > 2 * pi:
            raise ValueError(f"angle must be at most 2π, got {self.angle!r}")
        if self.visible is not None and not callable(self.visible):
            raise ValueError(f"visible must be callable or None, got {self.visible!r}")

    def expects(self, pose: Array, landmarks: Array, readings: Array) -> BoolArray:
        """Return which landmarks a scan should show.

        Parameters
        ----------
        pose : ndarray, shape (3,)
            Pose (x, y, θ) of the scan [m, m, rad].
        landmarks : ndarray, shape (n, 2)
            Estimated positions [m].
        readings : ndarray, shape (m, 2)
            The scan, rows (β, r) [rad, m], which may hide landmarks behind them.

        Returns
        -------
        ndarray of bool, shape (n,)
        """
        dx, dy = (landmarks - pose[:2]).T
        distance = np.hypot(dx, dy)
        bearing = wrap_angle(np.arctan2(dy, dx) - pose[2])
        expected = distance <= self.max_range - self.range_margin
        if self.min_range > 0:
            expected &= distance >= self.min_range + self.range_margin
        if self.angle < 2 * pi:
            expected &= np.abs(bearing) <= self.angle / 2 - self.bearing_margin
        if self.shadow > 0 and len(readings):
            aside = np.abs(wrap_angle(bearing[:, None] - readings[:, 0]))
            in_front = readings[:, 1] < distance[:, None]
            expected &= ~((aside <= self.shadow) & in_front).any(axis=1)
        if self.visible is not None and expected.any():
            expected[expected] = _checked_answer(
                self.visible, pose, landmarks[expected]
            )
        return np.asarray(expected)


def _checked_answer(visible: Visibility, pose: Array, landmarks: Array) -> BoolArray:
    answer = np.asarray(visible(pose.copy(), landmarks.copy()))
    if answer.shape != (len(landmarks),) or answer.dtype != np.bool_:
        raise ValueError(
            f"visible must return {len(landmarks)} booleans, one per landmark, "
            f"got {answer.dtype} of shape {answer.shape}"
        )
    return answer
