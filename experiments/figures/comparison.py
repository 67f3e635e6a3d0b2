"""Figure of the final maps of several filters side by side."""

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from ...arrays import Array
from ..runs.trace import RunTrace
from . import style
from .accuracy import distances_from_truth, draw_against_truth, truth_limits
from .walls import Walls, draw_walls

_COLUMNS = 2
_LONGEST = 52  # characters of a title


def comparison_figure(traces: Sequence[RunTrace], walls: Walls = ()) -> Figure:
    """Draw the final map and path of each filter over ground truth, side by side.

    All panels show the same area: that of the first filter, widened for the others to
    at most twice its size.

    Parameters
    ----------
    traces : sequence of RunTrace
        Runs of the filters over one drive, at least two.
    walls : sequence of (x0, y0, x1, y1)
        Walls to draw [m].

    Raises
    ------
    ValueError
        If there are fewer than two.
    """
    if len(traces) < 2:
        raise ValueError(f"traces must be of two filters or more, got {len(traces)}")
    limits = _common_limits(traces, walls)
    width, height = limits[1] - limits[0]
    rows = -(-len(traces) // _COLUMNS)
    figure = style.new_figure(11.0, (4.9 * height / width + 0.8) * rows + 0.7)
    panels = figure.subplots(rows, _COLUMNS, squeeze=False)
    for k, axes in enumerate(panels.flat):
        if k >= len(traces):
            axes.set_axis_off()
            continue
        style.dress(axes)
        axes.set(aspect="equal", xlim=limits[:, 0], ylim=limits[:, 1])
        axes.set(xlabel="x [m]", ylabel="y [m]" if k % _COLUMNS == 0 else "")
        keys = draw_against_truth(axes, traces[k]) + draw_walls(axes, walls)
        name = traces[k].estimator
        title = name if len(name) <= _LONGEST else f"{name[:_LONGEST]}…"
        style.write_title(axes, title, honesty(traces[k]))
    style.legend_below(figure, keys, columns=len(keys))
    return figure


def honesty(trace: RunTrace) -> str:
    """Write how many true landmarks lie inside their 3σ ellipses, and the error."""
    distances = distances_from_truth(trace)
    if distances is None:
        return f"{len(trace.landmarks)} landmarks"
    count = len(distances.euclidean)
    inside = int((distances.mahalanobis <= 3).sum())
    rms = np.sqrt(np.mean(distances.euclidean**2))
    return f"{inside} of {count} landmarks inside 3σ  ·  map error {rms:.2g} m RMS"


def _common_limits(traces: Sequence[RunTrace], walls: Walls) -> Array:
    boxes = np.array([truth_limits(trace, walls) for trace in traces])
    low, high = boxes[0]
    room = 0.5 * float((high - low).max())
    return np.stack(
        [
            np.maximum(boxes[:, 0].min(axis=0), low - room),
            np.minimum(boxes[:, 1].max(axis=0), high + room),
        ]
    )
