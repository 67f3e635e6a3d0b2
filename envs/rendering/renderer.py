"""Rendering of a landmark world with matplotlib.

The first frame draws everything, later ones only the moving artists (blitting).
"""

from __future__ import annotations

import logging
import time
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.artist import Artist
from matplotlib.backend_bases import Event
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from ...arrays import Array, ImageArray
from ...sim_configs import Scenario
from .render_state import RENDER_MODES, RenderMode, RenderState
from .scene import PlainTextFigure, Scene

_INCHES = 6.0  # side of the figure; its pixels come from the resolution


class _Drawing(NamedTuple):
    """The objects that exist from the first frame until `close`."""

    scene: Scene
    blitted: BlittedFigure
    window: Window | None


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
            window = Window(self._fps)
            figure = window.figure
        else:
            FigureCanvasAgg(figure)
        figure.set_dpi((self._size_px + 0.01) / _INCHES)  # never one pixel less
        figure.set_size_inches(_INCHES, _INCHES)
        scene = Scene(figure, self._scenario, self._landmarks)
        return _Drawing(scene, BlittedFigure(figure, scene.moving), window)


class BlittedFigure:
    """Draws a figure once, then only its moving artists over a copy of the rest.

    Parameters
    ----------
    figure : Figure
        With an Agg canvas, possibly that of a window. On other canvases every frame
        redraws everything.
    moving : sequence of Artist
        Artists that change between frames, drawn in this order above all others.
    """

    def __init__(self, figure: Figure, moving: Sequence[Artist]) -> None:
        self._figure = figure
        self._canvas: Any = figure.canvas  # matplotlib leaves Agg's methods untyped
        self._moving = tuple(moving)
        self._still: Any = None
        self._blits = bool(figure.canvas.supports_blit)
        for artist in self._moving:
            artist.set_animated(self._blits)
        if self._blits:
            self._canvas.mpl_connect("draw_event", self._keep_still_part)

    def draw(self) -> None:
        """Draw the present frame, and the still part too if it is outdated."""
        if self._still is None:
            self._canvas.draw()  # ends in _keep_still_part
        else:
            self._canvas.restore_region(self._still)
            self._draw_moving()

    def frame(self) -> ImageArray:
        """Draw and copy the present frame, uint8 (H, W, 3)."""
        self.draw()
        pixels = np.asarray(self._canvas.buffer_rgba())
        copy = np.empty((*pixels.shape[:2], 3), dtype=np.uint8)
        for colour in range(3):  # six times faster than slicing the three at once
            copy[..., colour] = pixels[..., colour]
        return copy

    def outdate(self) -> None:
        """Redraw the still part in the next frame: a limit or a legend has changed."""
        self._still = None

    def _keep_still_part(self, event: Event) -> None:
        ours = event.canvas is self._canvas  # not the canvas of a saved file
        if ours:
            self._still = self._canvas.copy_from_bbox(self._figure.bbox)
            self._draw_moving()

    def _draw_moving(self) -> None:
        for artist in self._moving:
            self._figure.draw_artist(artist)


class Window:
    """A figure on the screen with a limited number of frames per second.

    If matplotlib's backend has no windows, the log has a warning and nothing is shown.
    A window that the user has closed stays closed.
    """

    def __init__(self, fps: float) -> None:
        from matplotlib import pyplot  # noqa: PLC0415 (slow; for windows only)

        self._pyplot = pyplot
        with pyplot.rc_context({"figure.max_open_warning": 0}):  # one for each world
            self.figure: Figure = pyplot.figure(FigureClass=PlainTextFigure)
        self._seconds_per_frame = 1 / fps
        self._due = time.monotonic()
        self._has_screen = bool(self.figure.canvas.required_interactive_framework)
        if self._has_screen:
            self.figure.show()
        else:
            logging.getLogger(__name__).warning(
                "matplotlib's backend %r has no windows: mode 'human' shows nothing",
                pyplot.get_backend(),
            )

    def refresh(self, blitted: BlittedFigure) -> None:
        """Show the present frame, then run the event loop until the next one is due."""
        if not self._pyplot.fignum_exists(self.figure.number):
            return
        blitted.draw()
        if not self._has_screen:
            return
        canvas = self.figure.canvas
        canvas.blit(self.figure.bbox)
        now = time.monotonic()
        self._due = max(self._due + self._seconds_per_frame, now)
        canvas.start_event_loop(max(self._due - now, 0.001))

    def close(self) -> None:
        """Close the window and free the figure in pyplot."""
        self._pyplot.close(self.figure)
