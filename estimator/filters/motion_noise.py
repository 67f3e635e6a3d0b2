"""The motion noise of a filter, which may depend on whether the robot moves."""

from __future__ import annotations

from typing import NamedTuple

from numpy.typing import ArrayLike

from ...arrays import Array
from ..support import argument_checks


class MotionNoise(NamedTuple):
    """Variances of the motion noise, and whether it acts on a robot at rest."""

    variance: Array
    """(σx², σy², σα²) per step of dt = 1, shape (3,) [m², m², rad²]."""
    at_rest: bool = True
    """False: odometry of exactly (0, 0) adds no noise."""

    @classmethod
    def checked(cls, motion_std: ArrayLike, noise_at_rest: bool) -> MotionNoise:
        """Return the noise of these standard deviations (3,), or refuse them."""
        std = argument_checks.standard_deviations("motion_std", motion_std, 3)
        at_rest = argument_checks.flag("noise_at_rest", noise_at_rest)
        return cls(std**2, at_rest)

    def over(self, distance: float, turn: float, dt: float) -> Array:
        """Return the variances (3,) of one odometry reading over dt steps.

        Raises
        ------
        ValueError
            If dt is no number, negative, or too large.
        """
        if type(dt) is float and dt == 1.0 and self.at_rest:
            return self.variance
        dt = argument_checks.duration(dt)
        if not (self.at_rest or distance or turn):
            return self.variance * 0.0
        return self.variance * dt
