"""Fast frames of a figure in which only some artists move."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.backend_bases import Event
from matplotlib.figure import Figure

from ...arrays import ImageArray


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
