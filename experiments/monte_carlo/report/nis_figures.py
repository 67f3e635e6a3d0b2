"""Figures of innovations over many runs: their size and whiteness."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from ....arrays import Array
from ....evaluation.hypothesis_tests import (
    autocorrelation,
    chi_square_quantile,
    normal_scores,
)
from ...figures.style import GREY, dress, new_figure
from .estimator_lines import EstimatorLook, legend_above, plain
from .scores import EstimatorScores

_MOST_BLOCKS = 60
_LAGS = 10
_TAIL = 0.025
_LEAST = 0.02  # smallest range of correlations on the axis


def nis_figure(shown: list[tuple[EstimatorScores, EstimatorLook]]) -> Figure:
    """Draw NIS by its degrees of freedom over time, and its autocorrelation.

    Innovations are white, so the NIS of neighbouring steps may be pooled: each point
    covers a block of steps and all runs, with its 95 % band of χ².

    Parameters
    ----------
    shown : list of (EstimatorScores, EstimatorLook)
        Estimators with successful runs.
    """
    figure = new_figure(4.8, 4.0)
    above, below = figure.subplots(2, 1, height_ratios=(3, 2))
    _draw_band(above, shown[0][0])
    for scores, look in shown:
        steps, ratios, _ = pooled_nis(scores)
        above.plot(steps, ratios, **look.line(plain(scores.label)))
    above.set(xlabel="step", ylabel="NIS / degrees of freedom")
    _draw_autocorrelations(below, shown)
    for axes in (above, below):
        dress(axes)
    figure.align_ylabels()
    legend_above(figure, above)
    return figure


def pooled_nis(scores: EstimatorScores) -> tuple[Array, Array, Array]:
    """Pool the NIS of all runs in blocks of steps.

    Returns
    -------
    steps, ratios, degrees_of_freedom : ndarray, shape (k,)
        Middle of each block, its NIS by degrees of freedom, and its degrees of freedom;
        blocks without a correction are left out.
    """
    freedom = scores.over_time("nis_dof")
    nis = np.where(freedom > 0, scores.over_time("nis"), 0.0)
    blocks = np.array_split(
        np.arange(len(scores.steps)), min(_MOST_BLOCKS, len(scores.steps))
    )
    totals = np.array([nis[:, block].sum() for block in blocks])
    counts = np.array([freedom[:, block].sum() for block in blocks], dtype=np.float64)
    middles = np.array([scores.steps[block].mean() for block in blocks])
    used = counts > 0
    return middles[used], totals[used] / counts[used], counts[used]


def nis_autocorrelation(scores: EstimatorScores) -> tuple[Array, Array]:
    """Compute the autocorrelation of the NIS.

    Each NIS is first transformed to be nearly normal, as in the test of whiteness.

    Returns
    -------
    correlations, pairs : ndarray, shape (lags,)
        Correlations at lags 1 to 10, and their numbers of pairs.
    """
    normal = normal_scores(scores.over_time("nis"), scores.over_time("nis_dof"))
    return autocorrelation(normal, lags=min(_LAGS, normal.shape[1] - 1))


def _draw_band(axes: Axes, scores: EstimatorScores) -> None:
    steps, _, freedom = pooled_nis(scores)
    low, high = (
        chi_square_quantile(tail, freedom) / freedom for tail in (_TAIL, 1 - _TAIL)
    )
    axes.fill_between(steps, low, high, color=GREY, alpha=0.25, lw=0, label="95 % band")
    axes.axhline(1, color=GREY, lw=0.8)
    axes.margins(x=0.01)


def _draw_autocorrelations(
    axes: Axes, shown: list[tuple[EstimatorScores, EstimatorLook]]
) -> None:
    axes.axhline(0, color=GREY, lw=0.8)
    largest = 0.0
    offsets = np.linspace(-0.25, 0.25, len(shown)) if len(shown) > 1 else [0.0]
    for (scores, look), offset in zip(shown, offsets, strict=True):
        correlations, pairs = nis_autocorrelation(scores)
        largest = max(largest, float(abs(correlations).max()))
        lags = np.arange(1, len(correlations) + 1)
        if scores is shown[0][0]:
            limit = 1.96 / np.sqrt(np.maximum(pairs, 1))
            axes.bar(lags, 2 * limit, 0.8, -limit, color=GREY, alpha=0.25, lw=0)
        axes.vlines(lags + offset, 0, correlations, color=look.colour, lw=1.2)
        axes.plot(lags + offset, correlations, look.marker, color=look.colour, ms=3.5)
    axes.set_ylim(*np.array([-1.1, 1.1]) * max(largest, _LEAST))
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set(xlabel="lag [scans]", ylabel="autocorrelation")
