"""The input of the renderer: plain arrays, without matplotlib."""

from typing import Literal, NamedTuple, Protocol

from ...arrays import Array, BoolArray

RenderMode = Literal["human", "rgb_array"]
RENDER_MODES: tuple[RenderMode, ...] = ("human", "rgb_array")
"""The values of ``render_mode``: a window, or arrays of pixels."""


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
        """Covariance of the additive error of the state, shape (3 + 2n, 3 + 2n)."""


class RenderState(NamedTuple):
    """The state of a world that one frame shows."""

    pose: Array
    """True (x, y, θ), shape (3,) [m, m, rad]."""
    path: Array
    """True positions up to the present one, shape (k, 2) [m]."""
    measurements: Array
    """Readings of this step, rows (bearing, range), shape (m, 2) [rad, m]."""
    collision: bool
    """Whether a wall stopped the robot in this step."""
    belief: BeliefLike | None
    """Belief of an estimator, or None."""
    time: float
    """Since the start of the episode [s]."""
    step: int
    """Steps since the start of the episode."""
    clutter: BoolArray | None = None
    """Which measurements are of no landmark, shape (m,); None for none of them."""
