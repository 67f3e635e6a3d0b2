"""Rendering of a landmark world with matplotlib.

The first frame draws everything, later ones only the moving artists (blitting).
"""

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from ...arrays import Array, ImageArray
from ...sim_configs import Scenario
from .artists import PlainTextFigure
from .blitting import BlittedFigure
from .render_state import RENDER_MODES, RenderMode, RenderState
from .scene import Scene

if TYPE_CHECKING:
    from .window import Window


_INCHES = 6.0  # side of the figure; its pixels come from the resolution


class _Drawing(NamedTuple):
    """The objects that exist from the first frame until `close`."""

    scene: Scene
    blitted: BlittedFigure
    window: "Window | None"


class WorldRenderer:
    """Draws the states of one world, to arrays or to a window.

    The first `render` creates the figure. Copies and pickles of the renderer do not
    contain it; they create their own.

    Parameters
    ----------
    scenario : Scenario
        Source of walls, robot, sensor, and planned path.
    landmarks : ndarray, shape (N, 2)
        True positions [m].
    mode : {"rgb_array", "human"}
        Whether `render` returns frames or shows them in a window of matplotlib.
    size_px : int, default 600
        Side of the square frame [pixels].
    fps : float, default 30
        Largest number of frames per second in the window [1/s].

    Examples
    --------
    >>> from slamgym.sim_configs import load_scenario
    >>> renderer = WorldRenderer(
    ...     load_scenario("six_landmarks"), np.ones((1, 2)), "rgb_array", size_px=200
    ... )
    >>> start = RenderState(
    ...     np.zeros(3), np.zeros((1, 2)), np.empty((0, 2)), False, None, 0.0, 0
    ... )
    >>> renderer.render(start).shape
    (200, 200, 3)
    >>> renderer.close()
    """

    def __init__(
        self,
        scenario: Scenario,
        landmarks: Array,
        mode: RenderMode,
        size_px: int = 600,
        *,
        fps: float = 30.0,
    ) -> None:
        if mode not in RENDER_MODES:
            raise ValueError(f"mode must be 'rgb_array' or 'human', got {mode!r}")
        if size_px < 100:
            raise ValueError(f"size_px must be >= 100, got {size_px}")
        if not 0 < fps < np.inf:
            raise ValueError(f"fps must be a finite number > 0, got {fps}")
        self._scenario = scenario
        self._landmarks = np.array(landmarks, dtype=float).reshape(-1, 2)
        self._mode = mode
        self._size_px = size_px
        self._fps = fps
        self._drawing: _Drawing | None = None

    def render(self, state: RenderState) -> ImageArray | None:
        """Draw one state.

        Returns
        -------
        ndarray of uint8, shape (size_px, size_px, 3), or None
            A new array in mode "rgb_array". None in mode "human", which waits until
            the next frame is due.
        """
        if self._drawing is None:
            self._drawing = self._make_drawing()
        scene, blitted, window = self._drawing
        if scene.show(state):
            blitted.outdate()
        if window is None:
            return blitted.frame()
        window.refresh(blitted)
        return None

    def close(self) -> None:
        """Close the window and free the figure. Further calls have no effect."""
        if self._drawing is not None and self._drawing.window is not None:
            self._drawing.window.close()
        self._drawing = None

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_drawing": None}

    def _make_drawing(self) -> _Drawing:
        figure: Figure = PlainTextFigure()
        window = None
        if self._mode == "human":
            from .window import Window  # noqa: PLC0415 (pyplot, for windows only)

            window = Window(self._fps)
            figure = window.figure
        else:
            FigureCanvasAgg(figure)
        figure.set_dpi((self._size_px + 0.01) / _INCHES)  # never one pixel less
        figure.set_size_inches(_INCHES, _INCHES)
        scene = Scene(figure, self._scenario, self._landmarks)
        return _Drawing(scene, BlittedFigure(figure, scene.moving), window)
