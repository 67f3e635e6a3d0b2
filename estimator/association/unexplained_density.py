"""How many readings come from no landmark of the map, by the scans so far."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

MEMORY = 0.98
"""Weight of a scan relative to the one after it, in running averages."""


class UnexplainedDensity(NamedTuple):
    """A running average of the readings that belong to no landmark of the map.

    Examples
    --------
    >>> density = UnexplainedDensity()
    >>> for _ in range(500):
    ...     density = density.after(2, longest=8.0)
    >>> round(density.value * 2 * np.pi * 8.0, 2)
    2.0
    """

    readings: float = 1.0
    scans: float = 2.0
    longest: float = 1.0
    """Longest range read so far [m]."""
    landmarks: float = 1.0
    """How many landmarks were confirmed."""

    @property
    def value(self) -> float:
        """Readings per scan and [rad m]."""
        return self.readings / (self.scans * 2 * np.pi * self.longest)

    @property
    def landmark_share(self) -> float:
        """Probability that such a reading is of a landmark."""
        return min(self.landmarks / self.readings, 1.0)

    def after(
        self, readings: int, longest: float, landmarks: int = 0
    ) -> UnexplainedDensity:
        """Count one more scan, with the landmarks that it has confirmed."""
        return UnexplainedDensity(
            MEMORY * self.readings + readings,
            MEMORY * self.scans + 1,
            max(self.longest, longest),
            MEMORY * self.landmarks + landmarks,
        )
