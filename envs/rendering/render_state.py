"""What a picture of the world is made from: plain arrays, without matplotlib."""

from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating]


class BeliefLike(Protocol):
    """A Gaussian belief of any estimator over (x, y, θ, l1x, l1y, …)."""

    @property
    def pose(self) -> Array:
        """Mean of the pose, shape (3,) [m, m, rad]."""

    @property
    def pose_covariance(self) -> Array:
        """Covariance of the pose, shape (3, 3)."""

    @property
    def landmarks(self) -> Array:
        """Means of the n mapped landmarks, shape (n, 2) [m]."""

    @property
    def covariance(self) -> Array:
        """Covariance of the whole state, shape (3 + 2n, 3 + 2n)."""


class WorldSnapshot(NamedTuple):
    """The world at one moment, as the renderer draws it."""

    pose: Array
    """True (x, y, θ), shape (3,) [m, m, rad]."""
    path: Array
    """True positions so far, the present one included, shape (k, 2) [m]."""
    measurements: Array
    """Readings of this step, rows (bearing, range), shape (m, 2) [rad, m]."""
    collision: bool
    """Whether a wall stopped the robot in this step."""
    belief: BeliefLike | None
    """What an estimator believes, or None."""
    time: float
    """Since the episode began [s]."""
    step: int
    """Steps since the episode began."""
