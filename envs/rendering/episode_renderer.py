"""Rendering of an environment while it runs: the path of an episode, and its frames."""

from typing import TYPE_CHECKING, Any

import numpy as np

from ...arrays import Array, BoolArray, ImageArray
from ...restorable import Restorable, State
from ...sim_configs import Scenario
from .render_state import (
    RENDER_MODES,
    BeliefLike,
    RenderMode,
    RenderState,
    drawn_readings,
)

if TYPE_CHECKING:
    from .renderer import WorldRenderer


class EpisodeRenderer(Restorable):
    """Records the path of an episode and renders its present state.

    The first frame loads matplotlib. The figure is kept for the following episodes
    until the map changes.

    Parameters
    ----------
    scenario : Scenario
        The rendered world.
    mode : {"human", "rgb_array"}
        "human" shows every step in a window, "rgb_array" returns frames.
    fps : float
        Largest number of frames per second in the window [1/s].
    """

    changing = ("_landmarks", "_path", "_present", "_belief", "_scenario")

    def __init__(self, scenario: Scenario, mode: str, fps: float) -> None:
        if mode not in RENDER_MODES:
            raise ValueError(
                f"render_mode must be None or one of {RENDER_MODES}, got {mode!r}"
            )
        self._scenario = scenario
        self._mode: RenderMode = mode
        self._fps = fps
        self._renderer: WorldRenderer | None = None
        self._landmarks: Array = np.empty((0, 2))
        self.begin(self._landmarks, scenario)

    def begin(self, landmarks: Array, scenario: Scenario) -> None:
        """Start an episode in a world with these landmarks, (N, 2) [m]."""
        self._close_unless((landmarks, scenario))
        self._landmarks, self._scenario = landmarks, scenario
        self._path: list[list[float]] = []
        self._present: dict[str, Any] = {}
        self._belief: BeliefLike | None = None

    def restore(self, state: State) -> None:
        """Return to an earlier step, perhaps of another episode."""
        shown = self._landmarks, self._scenario
        super().restore(state)
        self._close_unless(shown)

    def _close_unless(self, shown: tuple[Array, Scenario]) -> None:
        """Close the figure, unless it shows this map of this world."""
        landmarks, scenario = shown
        is_same = scenario is self._scenario or scenario == self._scenario
        if not (is_same and np.array_equal(landmarks, self._landmarks)):
            self.close()

    def add(
        self,
        pose: Array,
        measurements: Array,
        collision: bool,
        clutter: BoolArray | None = None,
    ) -> None:
        """Add a step, see `RenderState`, and show it if there is a window."""
        self._path.append(pose[:2].tolist())
        self._present = {
            "pose": pose,
            "measurements": drawn_readings(self._scenario.sensor.kind, measurements),
            "collision": collision,
            "clutter": clutter,
        }
        if self._mode == "human":
            self.draw()

    def show_belief(self, belief: BeliefLike | None) -> None:
        """Show a belief in the following frames; None hides it."""
        self._belief = belief
        if self._mode == "human" and self._path:
            self.draw()

    def draw(self) -> ImageArray | None:
        """Draw the present state: return a frame, or None in mode "human"."""
        if self._renderer is None:
            from .renderer import WorldRenderer  # noqa: PLC0415 (loads matplotlib)

            self._renderer = WorldRenderer(
                self._scenario, self._landmarks, self._mode, fps=self._fps
            )
        step = len(self._path) - 1
        return self._renderer.render(
            RenderState(
                **self._present,
                path=np.array(self._path),
                belief=self._belief,
                time=step * self._scenario.dt,
                step=step,
            )
        )

    def close(self) -> None:
        """Close the window and free the figure. Further calls have no effect."""
        if self._renderer is not None:
            self._renderer.close()
        self._renderer = None
