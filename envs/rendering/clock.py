"""A line of text that changes in every frame, drawn faster than `Text`."""

from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.colors import to_rgb
from matplotlib.font_manager import FontProperties, findfont
from matplotlib.transforms import Bbox
from PIL import ImageFont

_POINTS = 11.0


class Clock(Artist):
    """Right-aligned text in matplotlib's font.

    Matplotlib lays text out anew in every frame, which takes half of the time of a
    frame. Here FreeType draws the line at once, through Pillow.

    Parameters
    ----------
    right, baseline : float
        End of the text, and its baseline, as parts of the figure.
    colour : str
        Colour of the text.
    """

    def __init__(self, right: float, baseline: float, colour: str) -> None:
        super().__init__()
        self._place = right, baseline
        self._colour = np.multiply(to_rgb(colour), 255).round().astype(np.uint8)
        self._fonts: dict[float, Any] = {}
        self._text = ""

    def set_text(self, text: str) -> None:
        """Show another text."""
        self._text = text
        self.stale = True

    def get_text(self) -> str:
        """Return the text."""
        return self._text

    def get_window_extent(self, renderer: Any = None) -> Bbox:
        """Return the box of the text [pixels]."""
        left, top, right, bottom = self._font().getbbox(self._text, anchor="ls")
        x, y = np.multiply(self._place, self._figure().bbox.size).round()
        return Bbox([[x - right + left, y - bottom], [x, y - top]])

    def draw(self, renderer: Any) -> None:
        """Draw the text as an image."""
        if not self.get_visible() or not self._text:
            return
        mask = self._font().getmask(self._text, anchor="ls")
        image = np.empty((mask.size[1], mask.size[0], 4), dtype=np.uint8)
        image[..., :3] = self._colour
        image[..., 3] = np.asarray(mask, dtype=np.uint8).reshape(image.shape[:2])
        context = renderer.new_gc()
        corner = self.get_window_extent().min
        renderer.draw_image(context, *corner, image[::-1])
        context.restore()

    def _figure(self) -> Any:
        return self.get_figure()

    def _font(self) -> Any:
        """Return the font for the resolution of the figure."""
        pixels = _POINTS * self._figure().dpi / 72
        if pixels not in self._fonts:
            path = findfont(FontProperties())
            self._fonts = {pixels: ImageFont.truetype(path, pixels)}
        return self._fonts[pixels]
