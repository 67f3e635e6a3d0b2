"""Figures of many runs: NEES, heading, NIS and errors over time, per estimator."""

import functools
import math
from typing import Any, NamedTuple, cast

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter

from ...arrays import AnyArray, Array, IntArray
from ...evaluation.hypothesis_tests import (
    autocorrelation_of_nis,
    average_band,
    chi_square_quantile,
    family_band,
)
from ...suggestions import counted
from ..figures.style import ALARM, BLUE, GREY, INK, ORANGE, TEAL, dress, new_figure
from .summary import summarise_monte_carlo
from .verdict import POSE_FREEDOM, EstimatorScores, labels_of, scores_of


class EstimatorLook(NamedTuple):
    """Colour, dashes and marker, distinct even without colour."""

    colour: str
    dashes: Any
    marker: str

    def line(self, label: str | None = None) -> dict[str, Any]:
        """Return the arguments of a matplotlib line."""
        return {"color": self.colour, "ls": self.dashes, "lw": 1.5, "label": label}


Shown = list[tuple[EstimatorScores, EstimatorLook]]


class ShownStudy(NamedTuple):
    """What the figures of a study show, and how wide they are."""

    shown: Shown
    summary: dict[str, Any]
    width: float
    title: str

    @classmethod
    def of(cls, results: "xr.Dataset | ShownStudy", width_mm: float) -> "ShownStudy":
        """Measure results, unless that is done; the title names the world."""
        if isinstance(results, ShownStudy):
            return results
        summary = summarise_monte_carlo(results)
        if not (shown := _shown(results, summary)):
            raise ValueError("results must hold an estimator with a successful run")
        return cls(shown, summary, width_mm / _MM, _title(summary))


_MM = 25.4  # in an inch
_WIDTH = 4.8  # of the figures in a report [inch]
_LOG_FROM = 4.0
_BINS = 70
_FEW_DOTS = 100
#: Of one estimator in `runs_figure`, which shows quantiles of more runs.
MOST_DOTS = 300
_LEAST_RATIO = 1e-6  # of NEES / 3; smaller ones, such as 0 of the truth, are drawn here


def report_figures(
    dataset: xr.Dataset, summary: dict[str, Any], *, width_mm: float | None = None
) -> dict[str, Figure]:
    """Draw all figures of a report.

    Parameters
    ----------
    dataset : xarray.Dataset
        Results of ``monte_carlo``.
    summary : dict
        Their summary, of ``summarise_monte_carlo``.
    width_mm : float, optional
        Width of figures for print, which name the world. By default they are those of
        the web page, which names it.

    Returns
    -------
    dict of str to Figure
        ``nees``, ``runs``, ``heading``, ``nis`` and ``rmse``, of the estimators with
        successful runs; empty if there is none. ``nis`` shows those with innovations,
        which a smoother has not.
    """
    study = ShownStudy(_shown(dataset, summary), summary, _WIDTH, "")
    if not study.shown:
        return {}
    if width_mm is not None:
        study = study._replace(width=width_mm / _MM, title=_title(summary))
    drawn = {
        "nees": nees_figure,
        "runs": runs_figure,
        "heading": heading_figure,
        "rmse": rmse_figure,
    }
    if _innovative(study.shown):
        drawn["nis"] = nis_figure
    return {name: draw(study) for name, draw in drawn.items()}


def _title(summary: dict[str, Any]) -> str:
    runs = counted(summary["runs"], "run")
    return f"{summary['scenario']}, {runs} of {summary['steps']} steps"


def _shown(dataset: xr.Dataset, summary: dict[str, Any]) -> Shown:
    """Return the estimators with successful runs."""
    labels = enumerate(labels_of(dataset))
    each = [(scores_of(dataset, x, summary["frame"]), look_of(i)) for i, x in labels]
    return [pair for pair in each if pair[0].good.any()]


def _innovative(shown: Shown) -> Shown:
    """Return the estimators with innovations."""
    return [pair for pair in shown if pair[0].nis_per_degree is not None]


def nees_figure(
    results: xr.Dataset | ShownStudy, width_mm: float = 85.0, *, ax: Axes | None = None
) -> Figure:
    """Draw ANEES / 3 over time, with the 95 % bands of one step and of the grid.

    Parameters
    ----------
    results : xarray.Dataset
        Results of ``monte_carlo``.
    width_mm : float, default 85
        Width of the figure [mm]: 85 for a column of a paper, 170 for a page.
    ax : Axes, optional
        Axes to draw in; the size and layout of their figure do not change.

    Returns
    -------
    Figure
        A figure for `save_figure`: a new one, or that of `ax`.

    Raises
    ------
    ValueError
        If no estimator has a successful run.
    """
    study = ShownStudy.of(results, width_mm)
    shown, summary, frame = study.shown, study.summary, study.summary["frame"]
    axes = ax or new_figure(study.width, 2.9).subplots()
    runs = max(int(scores.good.sum()) for scores, _ in shown)
    extremes = [draw_bands(axes, runs, POSE_FREEDOM, grid_steps(summary))]
    for scores, look in shown:
        average = np.maximum(scores.anees(frame), _LEAST_RATIO)
        steps = np.arange(scores.first, scores.first + len(average))
        axes.plot(*thinned(steps, average), **look.line(plain(scores.label)))
        _mark_grid(axes, summary["estimators"][scores.label]["decisions"], look)
        extremes.append(average)
    scale_ratios(axes, np.concatenate(extremes))
    return finished(axes, "ANEES / 3", study.title, ax)


def draw_bands(axes: Axes, runs: int, freedom: int, times: int) -> Array:
    """Draw the 95 % bands of an average NEES / n, and return that of one step.

    Parameters
    ----------
    axes : Axes
        Where to draw.
    runs : int
        Number of runs that are averaged.
    freedom : int
        n, degrees of freedom of the NEES.
    times : int
        Number of steps that are tested together; 0 for none.

    Returns
    -------
    ndarray, shape (2,)
        Ends of the band.
    """
    band = np.array(average_band(runs, freedom)) / freedom
    axes.axhspan(*band, color=GREY, alpha=0.25, lw=0, label="95 % band")
    if times:
        wide = np.array(family_band(runs, freedom, times)) / freedom
        label = f"95 % band, {counted(times, 'step')}"
        for end, name in zip(wide, (label, None), strict=True):
            axes.axhline(end, color=GREY, lw=0.8, label=name)
    return band


def scale_ratios(axes: Axes, ratios: Array) -> None:
    """Use a logarithmic scale if a ratio (n,) is far from 1."""
    if ratios.max() > _LOG_FROM or ratios.min() < 1 / _LOG_FROM:
        log_ticks(axes, "y")


def runs_figure(
    results: xr.Dataset | ShownStudy, width_mm: float = 85.0, *, ax: Axes | None = None
) -> Figure:
    """Draw the time average of each run's NEES / 3, a row of dots per estimator.

    Parameters, result and errors are those of :func:`nees_figure`.
    """
    study = ShownStudy.of(results, width_mm)
    shown, frame = study.shown, study.summary["frame"]
    axes = ax or new_figure(study.width, 0.8 + 1.0 * len(shown)).subplots()
    size = 3.4 if len(shown[0][0].good) <= _FEW_DOTS else 2.6
    averages = [scores.ratios(frame) for scores, _ in shown]
    each = [np.log10(np.maximum(_dots(ratios), _LEAST_RATIO)) for ratios in averages]
    logs = np.concatenate(each)
    edges = np.linspace(min(logs.min(), -0.5), max(logs.max(), 0.6), _BINS + 1)
    for row, ((scores, look), dots) in enumerate(zip(shown, each, strict=True)):
        x, lift = _swarm(dots, edges)
        axes.plot(10**x, row + lift, "o", color=look.colour, ms=size, mew=0, alpha=0.75)
        median = max(float(np.median(averages[row])), _LEAST_RATIO)
        label = "median of the runs" if row == 0 else None
        ends = [row - 0.34, row + 0.34]
        axes.plot([median] * 2, ends, color=INK, lw=1.6, label=label)
        axes.annotate(
            plain(scores.label),
            (0.01, row - 0.5),
            xycoords=("axes fraction", "data"),
            va="center",
            fontsize=10,
            color=INK,
        )
    dress(axes)
    axes.set_xlim(10 ** edges[0] / 1.1, 10 ** edges[-1] * 1.1)
    log_ticks(axes, "x")
    axes.axvline(1, color=GREY, lw=1.0, label="expected value")
    axes.axvline(3, color=GREY, lw=1.0, ls=(0, (1.4, 1.6)), label="3 times this value")
    axes.set_yticks([])
    axes.set_ylim(len(shown) - 0.55, -0.7)
    axes.grid(visible=False, axis="y")
    axes.set_xlabel("time average of NEES / 3")
    name_world(axes, study.title)
    return with_legend(axes, ax)


def heading_figure(results: xr.Dataset | ShownStudy, width_mm: float = 85.0) -> Figure:
    """Draw claimed and true deviation of the heading, a panel per estimator [°].

    Parameters, result and errors are those of :func:`nees_figure`.
    """
    study = ShownStudy.of(results, width_mm)
    shown, knowable = study.shown, study.summary["knowable_heading_std"]
    figure = new_figure(study.width, 0.75 + 1.3 * len(shown))
    panels = figure.subplots(len(shown), 1, sharex=True, sharey=True, squeeze=False)
    for axes, (scores, look) in zip(panels[:, 0], shown, strict=True):
        claimed, true = (
            np.degrees(_root_mean_square(scores, name))
            for name in ("heading_std", "heading_error")
        )
        axes.plot(*thinned(scores.steps, true), color=INK, lw=1.0, label="true error")
        axes.plot(
            *thinned(scores.steps, claimed),
            **(look.line("claimed deviation") | {"ls": "-", "lw": 2.0}),
        )
        known = axes.axhline(
            np.degrees(knowable), ls=(0, (1.4, 1.6)), color=GREY, lw=1.2
        )
        known.set_label("deviation at the start")
        dress(axes)
        axes.margins(x=0.01)
        axes.set_ylim(bottom=0)
        axes.set_title(plain(scores.label), loc="left", fontsize=10, color=INK, pad=3)
    panels[-1, 0].set_xlabel("step")
    figure.supylabel("heading, RMS over runs [°]", fontsize=10, color=INK)
    name_world(panels[0, 0], study.title)
    legend_above(figure, panels[0, 0])
    return figure


def rmse_figure(
    results: xr.Dataset | ShownStudy, width_mm: float = 85.0, *, ax: Axes | None = None
) -> Figure:
    """Draw the root mean square of the position's raw error over time.

    Parameters, result and errors are those of :func:`nees_figure`.
    """
    study = ShownStudy.of(results, width_mm)
    shown = study.shown
    axes = ax or new_figure(study.width, 2.5).subplots()
    for scores, look in shown:
        rms = _root_mean_square(scores, "position_error")
        axes.plot(*thinned(scores.steps, rms), **look.line(plain(scores.label)))
    if "position_bound_raw" in shown[0][0].results:
        total = shown[0][0].total(lambda x: x.sum(axis=0), "position_bound_raw")
        least = thinned(shown[0][0].steps, np.sqrt(total / shown[0][0].good.sum()))
        axes.plot(*least, color=GREY, ls=":", lw=1.5, label="bound of any filter")
    axes.set_ylim(bottom=0)
    return finished(axes, "RMS error, raw [m]", study.title, ax)


def name_world(axes: Axes, title: str) -> None:
    """Write the world of a figure for print above its axes, on the right."""
    axes.set_title(title, loc="right", fontsize=8, color=GREY, pad=3)


def finished(axes: Axes, ylabel: str, title: str, ax: Axes | None = None) -> Figure:
    """Dress and label the axes of a number over the steps; `ax` are the caller's."""
    dress(axes)
    name_world(axes, title)
    axes.margins(x=0.01)
    axes.set(xlabel="step", ylabel=ylabel)
    return with_legend(axes, ax)


def with_legend(axes: Axes, ax: Axes | None) -> Figure:
    """Return the figure of axes, its legend above them, or inside the caller's."""
    figure = cast("Figure", axes.figure)
    if ax is None:
        legend_above(figure, axes)
    else:
        axes.legend(frameon=False, fontsize=8, labelcolor=INK)
    return figure


def grid_steps(summary: dict[str, Any]) -> int:
    """Return how many steps are tested together; 0 without tests."""
    decisions = [entry["decisions"] for entry in summary["estimators"].values()]
    return max((len(found["grid"]["steps"]) for found in decisions if found), default=0)


def _mark_grid(
    axes: Axes, decisions: dict[str, Any] | None, look: EstimatorLook
) -> None:
    """Mark the tested steps, filled where rejected."""
    if decisions is None:
        return
    grid = decisions["grid"]
    steps, ratios = np.array(grid["steps"]), np.maximum(grid["statistic"], _LEAST_RATIO)
    rejected = np.array(grid["rejected"])
    for chosen, face in ((rejected, look.colour), (~rejected, "white")):
        if not chosen.any():
            continue  # the layout would make room for an empty line in a corner
        (dots,) = axes.plot(steps[chosen], ratios[chosen], look.marker, ms=4.5)
        dots.set(color=look.colour, markerfacecolor=face, markeredgewidth=1.2, zorder=3)
        dots.set_clip_on(False)


def _root_mean_square(scores: EstimatorScores, name: str) -> Array:
    """Return the RMS over runs; nan, a gap in a line, where it overflows."""
    with np.errstate(over="ignore"):
        total = scores.total(lambda values: (values**2).sum(axis=0), name)
    square = total / scores.good.sum()
    return np.sqrt(np.where(np.isfinite(square), square, np.nan))


def _dots(values: Array) -> Array:
    """Return the values of few runs, or quantiles of many."""
    if len(values) <= MOST_DOTS:
        return values
    return np.asarray(np.quantile(values, (np.arange(MOST_DOTS) + 0.5) / MOST_DOTS))


def _swarm(values: Array, edges: Array) -> tuple[Array, Array]:
    """Return x and height of dots, stacked per bin around the middle of their row."""
    bins = np.clip(np.searchsorted(edges, values, "right") - 1, 0, _BINS - 1)
    order = np.argsort(values, kind="stable")
    lift = np.zeros(len(values))
    tallest = max(int(np.bincount(bins).max()), 8)
    for b in np.unique(bins):
        rows = order[bins[order] == b]
        lift[rows] = (np.arange(len(rows)) - (len(rows) - 1) / 2) * 0.6 / tallest
    return (edges[bins] + edges[bins + 1]) / 2, lift


PURPLE: str = "#cc79a7"  # Okabe, Ito
SKY: str = "#56b4e9"
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
_LETTERS = 13  # per inch, in a row of a legend
_KEY = 7  # width of a key in letters
_ROW = 0.19  # height of a row of a legend [inch]


def look_of(place: int) -> EstimatorLook:
    """Return the look of the estimator with an index in the results, from 0."""
    dashes = (place + place // len(_COLOURS)) % len(_DASHES)  # shifts per cycle
    colour, marker = _COLOURS[place % len(_COLOURS)], _MARKERS[place % len(_MARKERS)]
    return EstimatorLook(colour, _DASHES[dashes], marker)


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
    decades = math.log10(high / low)
    each = (4, (1,)), (2, (1, 3)), (1, (1, 2, 5))
    subs = next((subs for more, subs in each if decades > more), (1, 2, 3, 5, 7))
    axis.set_major_locator(LogLocator(subs=subs, numticks=12))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())


def legend_above(figure: Figure, axes: Axes) -> None:
    """Put the legend above the axes in as many columns as fit; the figure grows."""
    handles, labels = axes.get_legend_handles_labels()
    letters = int(_LETTERS * figure.get_figwidth())
    fitting = (n for n in range(len(labels), 1, -1) if _width(labels, n) <= letters)
    columns = next(fitting, 1)
    rows = math.ceil(len(labels) / columns)
    figure.set_figheight(figure.get_figheight() + _ROW * rows)
    figure.legend(
        handles,
        labels,
        loc="outside upper left",
        ncols=columns,
        frameon=False,
        fontsize=9,
        labelcolor=INK,
        borderaxespad=0.4,
        borderpad=0.0,
        handlelength=1.8,
        columnspacing=1.2,
    )


def _width(labels: list[str], columns: int) -> int:
    """Return the width of a legend whose columns are filled one by one, in letters."""
    filled = np.array_split([len(label) + _KEY for label in labels], columns)
    return int(sum(column.max() for column in filled))


_MOST_BLOCKS = 60
_LAGS = 10
_TAIL = 0.025
_LEAST = 0.02  # smallest range of correlations on the axis


def nis_figure(results: xr.Dataset | ShownStudy, width_mm: float = 85.0) -> Figure:
    """Draw NIS by its degrees of freedom over time, and its autocorrelation.

    Innovations are white, so the NIS of neighbouring steps may be pooled: each point
    covers a block of steps and all runs, with its 95 % band of χ².

    Parameters, result and errors are those of :func:`nees_figure`.
    """
    study = ShownStudy.of(results, width_mm)
    shown = _innovative(study.shown)
    if not shown:
        raise ValueError("results must hold an estimator that reports innovations")
    figure = new_figure(study.width, 4.0)
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
    name_world(above, study.title)
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
    steps = scores.steps
    blocks = np.array_split(np.arange(len(steps)), min(_MOST_BLOCKS, len(steps)))

    def sums(nis: Array, freedom: IntArray) -> Array:
        nis = np.where(freedom > 0, nis, 0.0)
        return np.array(
            [[x[:, block].sum() for block in blocks] for x in (nis, freedom)]
        )

    totals, counts = scores.total(sums, "nis", "nis_dof")
    middles = np.array([steps[block].mean() for block in blocks])
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
    scans = functools.partial(scores.parts, "nis", "nis_dof")
    return autocorrelation_of_nis(scans, lags=min(_LAGS, len(scores.steps) - 1))


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
