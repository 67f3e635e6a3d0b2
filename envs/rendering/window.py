"""A window of matplotlib that shows an episode."""

import logging
import time

from matplotlib import pyplot
from matplotlib.figure import Figure

from .artists import PlainTextFigure
from .blitting import BlittedFigure


class Window:
    """A figure on the screen with a limited number of frames per second.

    If matplotlib's backend has no windows, the log has a warning and nothing is shown.
    A window that the user has closed stays closed.
    """

    def __init__(self, fps: float) -> None:
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
        """Close the window and free the figure in pyplot."""
        pyplot.close(self.figure)
