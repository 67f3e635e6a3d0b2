"""Figures of a run's accuracy: distances from the truth, errors, and covariance.

`truth_figure` draws path and map beside the truth, `comparison_figure` the maps of
several filters, `errors_figure` errors and innovations, and `covariance_figure` the
correlations of the state.
"""

import math
from collections.abc import Sequence

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.lines import Line2D
from numpy.typing import NDArray
from scipy.special import chdtri

from ...arrays import Array, BoolArray, IntArray
from ...envs.rendering.scene import EllipseKind
from ...estimator.models.rigid_motion import additive_error
from ...evaluation.trajectory_error import LandmarkDistances, landmark_distances
from ..run_and_replay.trace import RunTrace
from . import style
from .maps import Walls, box_around, draw_walls, shared_limits, wall_ends

_LANDMARK = EllipseKind("estimated landmark, 3σ", style.TEAL, fill=0.15)
_MOST_ERRORS = 80  # error lines along the path
_FEW = 40  # landmarks; larger maps have smaller marks
_NAME_HEIGHT = 0.16  # [inches] of the name of a landmark beside its bar


def truth_figure(trace: RunTrace, walls: Walls = ()) -> Figure:
    """Draw path and map over ground truth, and the distance of every landmark to it.

    Distances are Euclidean and Mahalanobis, as in section 2 of the CMU 16-833
    EKF-SLAM homework.

    Parameters
    ----------
    trace : RunTrace
        With true poses, true landmarks, or both; nan entries are not compared.
    walls : sequence of (x0, y0, x1, y1)
        Walls to draw [m].

    Raises
    ------
    ValueError
        If the run has no ground truth at all.
    """
    poses, landmarks = _known(trace.true_poses), _known(trace.true_landmarks)
    if not (poses.any() or landmarks.any()):
        raise ValueError("trace must have true poses or true landmarks, got neither")
    limits = truth_limits(trace, walls)
    width, height = limits[1] - limits[0]
    distances = distances_from_truth(trace)
    if distances is None:
        figure = style.new_figure(7.2, 6.2 * height / width + 1.5)
        area = figure.add_subplot()
    else:  # its height makes the map as high as the bars beside it
        tall = 5.6 * height / width
        figure = style.new_figure(10.8, tall + 1.5)
        area, *beside = figure.subplots(1, 3, width_ratios=[6.2, 1.7, 1.7])
        ids = trace.landmark_ids[landmarks].astype(np.int64)
        _draw_distances(beside, distances, ids, room=tall)
    style.dress_map(area, limits)
    keys = draw_against_truth(area, trace) + draw_walls(area, walls)
    style.write_title(
        area, "Estimate and ground truth", _summary(trace, poses, distances)
    )
    style.legend(figure, keys, columns=len(keys))
    return figure


def _known(truth: Array | None) -> BoolArray:
    """Return which rows of a truth hold a position."""
    if truth is None:
        return np.zeros(0, dtype=bool)
    return np.asarray(np.isfinite(truth[:, :2]).all(axis=1))


def truth_limits(trace: RunTrace, walls: Walls = ()) -> Array:
    """Return a box around a run's estimates, its truth and walls, shape (2, 2) [m]."""
    points = [trace.poses[:, :2], trace.landmarks, trace.every_true_landmark]
    points += [] if trace.true_poses is None else [trace.true_poses[:, :2]]
    points.append(wall_ends(walls))
    return box_around(
        np.concatenate(points), trace.landmarks, trace.landmark_covariances
    )


def draw_against_truth(axes: Axes, trace: RunTrace) -> list[Artist]:
    """Draw estimates, truth and the lines between them; return the legend's keys."""
    poses, landmarks = _known(trace.true_poses), _known(trace.true_landmarks)
    _LANDMARK.draw(axes, trace.landmarks, trace.landmark_covariances)
    axes.plot(*trace.landmarks.T, ".", color=style.TEAL, ms=4)
    (path,) = axes.plot(
        *trace.poses[:, :2].T, color=style.BLUE, lw=2, label="estimated path"
    )
    keys: list[Artist] = [path, _LANDMARK.legend_key()]
    if poses.any() and trace.true_poses is not None:
        truth = np.where(poses[:, None], trace.true_poses[:, :2], np.nan)
        (line,) = axes.plot(*truth.T, color=style.INK, lw=0.8, label="true path")
        steps = np.flatnonzero(poses)[:: -(-len(poses) // _MOST_ERRORS)]
        _join(axes, trace.poses[steps, :2], truth[steps], width=0.8)
        keys.insert(1, line)
    if landmarks.any() and trace.true_landmarks is not None:
        truth, mapped = trace.every_true_landmark, trace.true_landmarks[landmarks]
        size = 9 if len(truth) <= _FEW else 5
        (crosses,) = axes.plot(
            *truth.T, "+", color=style.INK, ms=size, mew=size / 7, label="true landmark"
        )
        _join(axes, trace.landmarks[landmarks], mapped, width=1.6)
        keys.append(crosses)
    return [*keys, Line2D([], [], color=style.ALARM, lw=1.4, label="error")]


def _join(axes: Axes, estimates: Array, truth: Array, *, width: float) -> None:
    lines = LineCollection(
        list(np.stack([estimates, truth], axis=1)),
        colors=style.ALARM,
        linewidths=width,
        zorder=3,
        label="error",
    )
    axes.add_collection(lines)


def distances_from_truth(trace: RunTrace) -> LandmarkDistances | None:
    """Return the distances of the landmarks with known truth; None if there is none."""
    known = _known(trace.true_landmarks)
    if not known.any():
        return None
    truth = np.asarray(trace.true_landmarks)[known]
    return landmark_distances(
        trace.landmarks[known], trace.landmark_covariances[known], truth
    )


def _draw_distances(
    panels: Sequence[Axes], distances: LandmarkDistances, ids: IntArray, *, room: float
) -> None:
    """Draw one bar per landmark, in the order of their ids from the top.

    As many are named as fit into the height of the axes, `room` [inches].
    """
    (metres, sigmas), order = panels, np.argsort(ids)
    _draw_bars(metres, distances.euclidean[order])
    _draw_bars(sigmas, distances.mahalanobis[order])
    names = [f"l{i}" for i in ids[order]]
    stride = max(1, math.ceil(len(names) * _NAME_HEIGHT / room))
    metres.set_yticks(range(0, len(names), stride), names[::stride])
    sigmas.set_yticks([])
    metres.set_xlabel("distance [m]")
    sigmas.set_xlabel("distance [σ]")
    bound = float(np.sqrt(chdtri(2, 0.05)))
    sigmas.set_xlim(0, max(sigmas.get_xlim()[1], 1.15 * bound))
    sigmas.axvline(bound, color=style.GREY, lw=1.2, ls="--")
    inside = np.mean(distances.mahalanobis <= bound)
    style.write_title(metres, "Euclidean", "from truth, by landmark")
    style.write_title(sigmas, "Mahalanobis", f"{inside:.0%} in the 95% bound")


def _draw_bars(axes: Axes, values: Array) -> None:
    rows, few = np.arange(len(values)), len(values) <= _FEW
    style.dress(axes)
    axes.grid(visible=False, axis="y")
    axes.hlines(rows, 0, values, color=style.ALARM, lw=1.6 if few else 0.8)
    axes.plot(values, rows, "o", color=style.ALARM, ms=4.5 if few else 2.5)
    axes.set_xlim(0, 1.1 * max(float(values.max()), 1e-9))
    axes.set_ylim(len(rows) - 0.4, -0.6)
    axes.tick_params(axis="y", length=0)


def _summary(
    trace: RunTrace, poses: BoolArray, distances: LandmarkDistances | None
) -> str:
    parts = [style.short_name(trace.estimator)]
    if poses.any() and trace.true_poses is not None:
        error = trace.poses[poses, :2] - trace.true_poses[poses, :2]
        rms = np.sqrt(np.mean(np.sum(error**2, axis=1)))
        parts.append(f"path error {rms:.2g} m RMS")
    if distances is not None:
        rms = np.sqrt(np.mean(distances.euclidean**2))
        parts.append(f"landmark error {rms:.2g} m RMS")
    return "  ·  ".join(parts)


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
    limits = shared_limits([truth_limits(trace, walls) for trace in traces])
    width, height = limits[1] - limits[0]
    rows = -(-len(traces) // _COLUMNS)
    figure = style.new_figure(11.0, (4.9 * height / width + 0.8) * rows + 0.7)
    panels = figure.subplots(rows, _COLUMNS, squeeze=False)
    for k, axes in enumerate(panels.flat):
        if k >= len(traces):
            axes.set_axis_off()
            continue
        ylabel = "y [m]" if k % _COLUMNS == 0 else ""
        style.dress_map(axes, limits, labels=("x [m]", ylabel))
        keys = draw_against_truth(axes, traces[k]) + draw_walls(axes, walls)
        name = traces[k].estimator
        title = name if len(name) <= _LONGEST else f"{name[:_LONGEST]}…"
        style.write_title(axes, title, honesty(traces[k]))
    style.legend(figure, keys, columns=len(keys))
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


_ROWS = (("x error [m]", "x"), ("y error [m]", "y"), ("θ error [rad]", "θ"))
#: Times the band's upper bound, or parts of its lower one: NIS beyond, the largest or
#: the median, needs a logarithmic axis.
_LOG_FROM = 8.0


def errors_figure(trace: RunTrace) -> Figure:
    """Draw pose errors with their ±3σ bands, and the NIS with its 95% band, over time.

    Without true poses, the figure shows the NIS alone, which needs no truth.

    Parameters
    ----------
    trace : RunTrace
        The run.
    """
    truth = trace.true_poses
    known = truth is not None and bool(np.isfinite(truth).any())
    rows = len(_ROWS) + 1 if known else 1
    figure = style.new_figure(8.4, 1.0 + 1.9 * rows)
    axes = figure.subplots(rows, 1, sharex=True, squeeze=False)[:, 0]
    if truth is not None and known:
        errors = -additive_error(truth, trace.poses)
        std = style.deviations(trace.pose_covariances)
        for k, (label, name) in enumerate(_ROWS):
            _draw_error(axes[k], trace.t, errors[:, k], std[:, k])
            axes[k].set_ylabel(label)
            inside = np.abs(errors[:, k]) <= 3 * std[:, k]
            share = np.mean(inside[np.isfinite(errors[:, k])])
            title = f"{name}: {share:.0%} of the errors within ±3σ"
            style.write_title(axes[k], title, size=10)
        _legend_above(axes[0], columns=2)
    _draw_nis(axes[-1], trace)
    axes[-1].set_xlabel(f"time [{trace.time_unit}]")
    figure.align_ylabels(axes)
    return figure


def nis_band(
    dof: NDArray[np.integer], probability: float = 0.95
) -> tuple[Array, Array]:
    """Return the bounds of a consistent filter's NIS for a probability.

    Parameters
    ----------
    dof : ndarray of int, shape (k,)
        Degrees of freedom.
    probability : float, default 0.95
        Probability between the bounds; half of the rest lies below, half above.

    Returns
    -------
    lower, upper : ndarray, shape (k,)
        Quantiles of χ²(dof), nan where dof is 0.
    """
    known = np.where(dof > 0, dof, np.nan)
    tail = (1 - probability) / 2
    return np.asarray(chdtri(known, 1 - tail)), np.asarray(chdtri(known, tail))


def _draw_error(axes: Axes, t: Array, error: Array, std: Array) -> None:
    style.dress(axes)
    axes.fill_between(
        t, -3 * std, 3 * std, color=style.BLUE, alpha=0.15, lw=0, label="±3σ"
    )
    for sign in (-1, 1):
        axes.plot(t, sign * 3 * std, color=style.BLUE, lw=0.8, alpha=0.6)
    axes.axhline(0, color=style.GREY, lw=0.6)
    axes.plot(t, error, color=style.INK, lw=1.2, label="error")
    axes.margins(x=0.01)


def _draw_nis(axes: Axes, trace: RunTrace) -> None:
    """Draw the NIS of the steps with a correction; outliers have another marker."""
    style.dress(axes)
    lower, upper = nis_band(trace.nis_dof)
    used = trace.nis_dof > 0
    band = axes.fill_between(trace.t, lower, upper, step="mid", color=style.TEAL, lw=0)
    band.set(alpha=0.18, label="95% band")
    inside = used & (trace.nis >= lower) & (trace.nis <= upper)
    size = 4.0 if len(trace.t) <= 300 else 2.0
    for which, marker, colour, label in (
        (inside, "o", style.INK, "inside"),
        (used & ~inside, "D", style.ALARM, "outside"),
    ):
        axes.plot(
            trace.t[which], trace.nis[which], marker, color=colour, ms=size, label=label
        )
    axes.set_ylabel("NIS")
    axes.margins(x=0.01)
    if not used.any():
        style.write_title(axes, "NIS: none was reported", size=10)
        return
    share = np.mean(inside[used])
    style.write_title(axes, f"NIS: {share:.0%} of the steps in the 95% band", size=10)
    nis, least = trace.nis[used], float(np.nanmin(lower))
    if nis.max() > _LOG_FROM * np.nanmax(upper):
        axes.set_yscale("log")
        axes.set_ylim(bottom=max(0.3 * least, 1e-3))
    elif nis.any() and _LOG_FROM * np.median(nis) < least:
        axes.set_yscale("log")
        axes.set_ylim(bottom=0.3 * float(nis[nis > 0].min()))
    else:
        axes.set_ylim(bottom=-0.03 * axes.get_ylim()[1])  # markers at 0 are whole
    _legend_above(axes, columns=3)


def _legend_above(axes: Axes, columns: int) -> None:
    axes.legend(
        loc="lower right",
        bbox_to_anchor=(1.01, 0.98),
        ncols=columns,
        frameon=False,
        fontsize=9,
        borderaxespad=0.2,
    )


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
    first_step = trace.step_of_first_map()
    figure = style.new_figure(12.4, 5.6)
    before, after = figure.subplots(1, 2)
    _draw_correlations(before, trace.first_covariance, trace.map_at(first_step).ids)
    size = _size_of_correlations(trace.first_covariance, first_step)
    style.write_title(before, "Before: the first map", size)
    image = _draw_correlations(after, trace.final_covariance, trace.landmark_ids)
    size = _size_of_correlations(trace.final_covariance, trace.last_step)
    style.write_title(after, "After: the final map", size)
    bar = figure.colorbar(image, ax=[before, after], shrink=0.85, aspect=28, pad=0.015)
    bar.set_label("correlation", fontsize=10, color=style.INK)
    bar.ax.tick_params(labelsize=9, color=style.GREY)
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
    std = style.deviations(covariance)
    std = np.where(std > 0, std, np.nan)
    return np.asarray(np.clip(covariance / std[:, None] / std, -1.0, 1.0))


def _draw_correlations(
    axes: Axes, covariance: Array, ids: NDArray[np.integer]
) -> AxesImage:
    known = np.ma.masked_invalid(correlations(covariance))
    # Blue to red through white: safe for colour-blind eyes.
    image = axes.imshow(known, cmap="RdBu_r", vmin=-1, vmax=1, interpolation="nearest")
    axes.set_facecolor(_UNDEFINED)
    axes.spines[:].set_visible(False)
    axes.tick_params(length=0, labelsize=9, labelcolor=style.INK, pad=3)
    rows, labels = row_labels(ids)
    axes.set_yticks(rows, labels)
    axes.set_xticks(rows, labels, rotation=90)
    few = len(covariance) <= _MOST_LABELS
    for line in (axes.axhline, axes.axvline):  # between pose and landmarks
        line(2.5, color="white", lw=1.5 if few else 0.6)
    if few:
        _write_deviations(axes, style.deviations(covariance))
    return image


def entries(ids: NDArray[np.integer]) -> list[str]:
    """Name the entries of a state: x, y, θ, l0x, l0y, …."""
    return ["x", "y", "θ", *(f"l{i}{axis}" for i in ids for axis in "xy")]


def row_labels(ids: NDArray[np.integer]) -> tuple[list[float], list[str]]:
    """Label the rows x, y, θ, l0x, l0y, …; for large maps only some landmarks.

    Returns
    -------
    positions, labels : list of float, list of str
        Positions in rows, and texts.
    """
    labels = entries(ids)
    if len(labels) <= _MOST_LABELS:
        return [float(row) for row in range(len(labels))], labels
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
            color=style.GREY,
        )


def _size_of_correlations(covariance: Array, step: int) -> str:
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
