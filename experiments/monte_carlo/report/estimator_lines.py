"""Colours, dashes and markers of the estimators in a figure, and thinned lines."""

import math
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from ....arrays import AnyArray, Array
from ...figures.style import ALARM, BLUE, INK, ORANGE, TEAL

PURPLE, SKY = "#cc79a7", "#56b4e9"  # Okabe, Ito
_COLOURS = (BLUE, ORANGE, TEAL, PURPLE, SKY, ALARM)
_DASHES: tuple[Any, ...] = (
    "-",
    (0, (5, 1.6)),
    (0, (7, 1.5, 1.5, 1.5)),
    (0, (1.4, 1.4)),
    (0, (10, 2.5)),
    (0, (4, 1.3, 1.3, 1.3, 1.3, 1.3)),
)
_MARKERS = ("o", "s", "^", "D", "v", "P")
_MOST_POINTS = 400
_LETTERS = 52  # in a row of a legend
_KEY = 6  # width of a key in letters
_ROW = 0.19  # height of a row of a legend [inch]


class EstimatorLook(NamedTuple):
    """Colour, dashes and marker, distinct even without colour."""

    colour: str
    dashes: Any
    marker: str

    def line(self, label: str | None = None) -> dict[str, Any]:
        """Return the arguments of a matplotlib line."""
        return {"color": self.colour, "ls": self.dashes, "lw": 1.5, "label": label}


def look_of(place: int) -> EstimatorLook:
    """Return the look of the estimator with an index in the results, from 0."""
    dashes = (place + place // len(_COLOURS)) % len(_DASHES)  # shifts per cycle
    return EstimatorLook(
        _COLOURS[place % len(_COLOURS)],
        _DASHES[dashes],
        _MARKERS[place % len(_MARKERS)],
    )


def thinned(
    x: AnyArray, y: Array, *, most: int = _MOST_POINTS
) -> tuple[AnyArray, Array]:
    """Leave out points of a line that would not be visible, but no peak.

    The line is cut into pieces; each keeps its lowest and its highest point.

    Parameters
    ----------
    x, y : ndarray, shape (n,)
        The line.
    most : int
        Approximate number of points that remain.

    Examples
    --------
    >>> x, y = thinned(np.arange(1000.0), np.arange(1000.0) == 637, most=20)
    >>> len(x), int(y.sum())
    (20, 1)
    """
    if len(x) <= most:
        return x, y
    pieces = np.array_split(np.arange(len(x)), most // 2)
    lowest = [piece[y[piece].argmin()] for piece in pieces]
    highest = [piece[::-1][y[piece][::-1].argmax()] for piece in pieces]
    rows = np.unique([0, *lowest, *highest, len(x) - 1])
    return x[rows], y[rows]


def plain(label: str) -> str:
    r"""Protect a label from being parsed as mathematics or hidden by matplotlib.

    Examples
    --------
    >>> plain("$a$"), plain("_mine")
    ('\\$a\\$', ' _mine')
    """
    shown = label.replace("$", r"\$")
    return f" {shown}" if shown.startswith("_") else shown


def log_ticks(axes: Axes, which: str) -> None:
    """Make an axis logarithmic, with ticks such as 0.5, 1, 2, 5, 10."""
    getattr(axes, f"set_{which}scale")("log")
    axis = getattr(axes, f"{which}axis")
    low, high = axis.get_view_interval()
    wide = high > 100 * low
    axis.set_major_locator(LogLocator(subs=(1, 3) if wide else (1, 2, 5), numticks=12))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())


def legend_above(figure: Figure, axes: Axes) -> None:
    """Put the legend above the axes in as many columns as fit; the figure grows."""
    handles, labels = axes.get_legend_handles_labels()
    longest = max((len(label) for label in labels), default=0) + _KEY
    columns = max(1, min(len(labels), _LETTERS // longest))
    rows = math.ceil(len(labels) / columns)
    figure.set_figheight(figure.get_figheight() + _ROW * rows)
    figure.legend(
        handles,
        labels,
        loc="outside upper left",
        ncols=columns,
        frameon=False,
        fontsize=9.5,
        labelcolor=INK,
        borderaxespad=0.1,
        borderpad=0.0,
        handlelength=2.4,
        columnspacing=1.4,
    )
