"""What an environment shows while it runs: the path so far and the present moment."""

from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...sim_configs import Scenario
from .render_state import BeliefLike, WorldSnapshot

if TYPE_CHECKING:
    from .renderer import WorldRenderer

Array = NDArray[np.float64]
RenderMode = Literal["human", "rgb_array"]
RENDER_MODES: tuple[RenderMode, ...] = ("human", "rgb_array")


class Moment(NamedTuple):
    """What one step adds to the picture."""

    pose: Array
    """True (x, y, θ), shape (3,) [m, m, rad]."""
    measurements: Array
    """Readings of this step, rows (bearing, range), shape (m, 2) [rad, m]."""
    collision: bool
    """Whether a wall held the robot back."""


class LiveView:
    """Remembers the path of an episode, and draws its last moment.

    Matplotlib is loaded by the first frame. The renderer lasts from episode to episode
    while the map does.

    Parameters
    ----------
    scenario : Scenario
        What is shown.
    mode : {"human", "rgb_array"}
        Whether every moment goes to a window, or frames to the caller.
    fps : float
        At most so many frames per second appear in the window [1/s].
    """

    def __init__(self, scenario: Scenario, mode: str, fps: float) -> None:
        if mode not in RENDER_MODES:
            raise ValueError(
                f"render_mode must be None or one of {RENDER_MODES}, got {mode!r}"
            )
        self._scenario = scenario
        self._mode: RenderMode = mode
        self._fps = fps
        self._landmarks: Array = np.empty((0, 2))
        self._path: list[list[float]] = []
        self._moment: Moment | None = None
        self._belief: BeliefLike | None = None
        self._renderer: WorldRenderer | None = None

    def begin(self, landmarks: Array) -> None:
        """Forget the last episode; the next shows these landmarks, (N, 2) [m]."""
        if not np.array_equal(landmarks, self._landmarks):
            self.close()
        self._landmarks = landmarks
        self._path = []
        self._moment = None
        self._belief = None

    def add(self, moment: Moment) -> None:
        """Add a moment, and show it in the window if there is one."""
        self._path.append(moment.pose[:2].tolist())
        self._moment = moment
        if self._mode == "human":
            self.draw()

    def show_belief(self, belief: BeliefLike | None) -> None:
        """Draw a belief from now on, or none."""
        self._belief = belief
        if self._mode == "human" and self._path:
            self.draw()

    def draw(self) -> NDArray[np.uint8] | None:
        """Draw the last moment: a frame, or None in mode "human"."""
        if self._renderer is None:
            self._renderer = self._make_renderer()
        assert self._moment is not None
        pose, measurements, collision = self._moment
        step = len(self._path) - 1
        return self._renderer.render(
            WorldSnapshot(
                pose=pose,
                path=np.array(self._path),
                measurements=measurements,
                collision=collision,
                belief=self._belief,
                time=step * self._scenario.dt,
                step=step,
            )
        )

    def close(self) -> None:
        """Close the window and free the figure; may be repeated."""
        if self._renderer is not None:
            self._renderer.close()
        self._renderer = None

    def _make_renderer(self) -> "WorldRenderer":
        from .renderer import WorldRenderer  # noqa: PLC0415 (loads matplotlib)

        return WorldRenderer(self._scenario, self._landmarks, self._mode, fps=self._fps)
