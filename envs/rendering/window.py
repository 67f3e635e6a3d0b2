"""Matplotlib's own window, for watching an episode."""

import logging
import time

from matplotlib import pyplot
from matplotlib.figure import Figure

from .blitting import BlittedFigure


class Window:
    """A figure on the screen that shows a limited number of frames per second.

    Says so in the log when matplotlib has no backend with windows: then nothing can be
    seen. A window that its user has closed stays closed.
    """

    def __init__(self, fps: float) -> None:
        self.figure: Figure = pyplot.figure()
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
        """Show the present frame, then serve the window until the next is due."""
        if not pyplot.fignum_exists(self.figure.number):
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
        """Take the figure off the screen and out of pyplot's memory."""
        pyplot.close(self.figure)
