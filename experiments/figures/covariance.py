"""Figure of the covariance of the whole state at the begin and end of a run."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from numpy.typing import NDArray

from ...arrays import Array
from ..runs.trace import RunTrace
from .style import GREY, INK, new_figure, write_title

_MOST_LABELS = 30  # rows; larger maps name only some of their landmarks
_UNDEFINED = "#c9ced4"


def covariance_figure(trace: RunTrace) -> Figure:
    """Show the first and the final covariance as heat maps of correlations.

    Each row is labelled with its standard deviation, so that the figure shows the whole
    covariance. Rows without uncertainty have no correlations and are grey.

    Parameters
    ----------
    trace : RunTrace
        The run.
    """
    sizes = [len(ids) for ids, *_ in trace.landmark_history]
    first_step = next((step for step, size in enumerate(sizes) if size), 0)
    figure = new_figure(12.4, 5.6)
    before, after = figure.subplots(1, 2)
    _draw_correlations(before, trace.first_covariance, trace.map_at(first_step).ids)
    image = _draw_correlations(after, trace.final_covariance, trace.landmark_ids)
    write_title(
        before, "Before: the first map", _summary(trace.first_covariance, first_step)
    )
    write_title(
        after, "After: the final map", _summary(trace.final_covariance, trace.last_step)
    )
    bar = figure.colorbar(image, ax=[before, after], shrink=0.85, aspect=28, pad=0.015)
    bar.set_label("correlation", fontsize=10, color=INK)
    bar.ax.tick_params(labelsize=9, color=GREY)
    bar.outline.set_visible(False)
    figure.draw_without_rendering()  # the layout needs a second pass
    return figure


def correlations(covariance: Array) -> Array:
    """Divide a covariance by the standard deviations of its rows and columns.

    Parameters
    ----------
    covariance : ndarray, shape (n, n)
        Any covariance.

    Returns
    -------
    ndarray, shape (n, n)
        In [-1, 1]; nan in rows and columns without variance.

    Examples
    --------
    >>> correlations(np.array([[4.0, 1.0], [1.0, 1.0]]))
    array([[1. , 0.5],
           [0.5, 1. ]])
    """
    std = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    std = np.where(std > 0, std, np.nan)
    return np.asarray(np.clip(covariance / std[:, None] / std, -1.0, 1.0))


def _draw_correlations(
    axes: Axes, covariance: Array, ids: NDArray[np.integer]
) -> AxesImage:
    image = axes.imshow(
        np.ma.masked_invalid(correlations(covariance)),
        cmap="RdBu_r",  # blue to red through white: safe for colour-blind eyes
        vmin=-1,
        vmax=1,
        interpolation="nearest",
    )
    axes.set_facecolor(_UNDEFINED)
    axes.spines[:].set_visible(False)
    axes.tick_params(length=0, labelsize=9, labelcolor=INK, pad=3)
    rows, labels = row_labels(ids)
    axes.set_yticks(rows, labels)
    axes.set_xticks(rows, labels, rotation=90)
    few = len(covariance) <= _MOST_LABELS
    for line in (axes.axhline, axes.axvline):  # between pose and landmarks
        line(2.5, color="white", lw=1.5 if few else 0.6)
    if few:
        _write_deviations(axes, np.sqrt(np.maximum(np.diag(covariance), 0.0)))
    return image


def row_labels(ids: NDArray[np.integer]) -> tuple[list[float], list[str]]:
    """Label the rows x, y, θ, l0x, l0y, …; for large maps only some landmarks.

    Returns
    -------
    positions, labels : list of float, list of str
        Positions in rows, and texts.
    """
    rows, labels = [0.0, 1.0, 2.0], ["x", "y", "θ"]
    if 3 + 2 * len(ids) <= _MOST_LABELS:
        for k, landmark in enumerate(ids):
            rows += [3.0 + 2 * k, 4.0 + 2 * k]
            labels += [f"l{landmark}x", f"l{landmark}y"]
        return rows, labels
    stride = -(-len(ids) // (_MOST_LABELS // 2 - 3))
    chosen = range(stride // 2, len(ids), stride)
    return (
        [1.0, *(3.5 + 2 * k for k in chosen)],  # the pose is too thin for three
        ["pose", *(f"l{ids[k]}" for k in chosen)],
    )


def _write_deviations(axes: Axes, std: Array) -> None:
    for row, value in enumerate(std):
        unit = "rad" if row == 2 else "m"
        axes.annotate(
            f"σ = {value:.2g} {unit}",
            (1, row),
            (5, 0),
            xycoords=("axes fraction", "data"),
            textcoords="offset points",
            va="center",
            fontsize=8,
            color=GREY,
        )


def _summary(covariance: Array, step: int) -> str:
    """Write the step, the number of landmarks, and their mean correlation."""
    every = correlations(covariance)
    landmarks = every[3:, 3:]
    n = len(landmarks) // 2
    between = ~np.kron(np.eye(n, dtype=bool), np.ones((2, 2), dtype=bool))
    values = np.abs(landmarks[between])
    text = f"after step {step}: {n} landmarks"
    if np.isnan(every).any():
        text = f"grey: known exactly; {text}"
    if not np.isfinite(values).any():
        return text
    return f"{text}, mean |correlation| between them {np.nanmean(values):.2f}"
