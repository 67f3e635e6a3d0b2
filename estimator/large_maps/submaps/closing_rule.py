"""The limits at which a submap is closed."""

from math import hypot
from typing import NamedTuple

import numpy as np

from ...support import argument_checks
from .active_submap import ActiveSubmap


class ClosingRule(NamedTuple):
    """Limits of a submap; infinite ones have no effect."""

    size: int
    """Number of landmarks."""
    heading: float
    """Standard deviation of the heading in the frame of the submap [rad]."""
    extent: float
    """Distance of the robot from the origin of the frame [m]."""

    @classmethod
    def checked(
        cls, size: int, heading: float | None, extent: float | None
    ) -> "ClosingRule":
        """Return the rule of the options of :class:`SubmapSlam`, which it checks."""
        least = argument_checks.whole("submap_size", size, 1)
        limits = (("heading_limit", heading), ("extent_limit", extent))
        heading_limit, extent_limit = (
            np.inf if value is None else argument_checks.above(name, value, 0.0)
            for name, value in limits
        )
        return cls(least, heading_limit, extent_limit)

    def closes(self, active: ActiveSubmap) -> bool:
        """Return whether the submap has reached a limit."""
        x, y, _ = active.pose.tolist()
        return (
            len(active) >= self.size
            or active.heading_variance > self.heading**2
            or hypot(x, y) > self.extent
        )
