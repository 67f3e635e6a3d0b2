"""Figure of the distances of a run's path and map from ground truth."""

import math

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from scipy.special import chdtri

from ...arrays import Array, BoolArray
from ...evaluation.trajectory_error import LandmarkDistances, landmark_distances
from ..runs.trace import RunTrace
from . import style
from .map_picture import box_around
from .style import ALARM, GREY, INK, TEAL, EllipseKind, dress, write_title
from .walls import Walls, draw_walls, wall_ends

_LANDMARK = EllipseKind("estimated landmark, 3σ", TEAL, fill=0.15)
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
        names = [f"l{i}" for i in trace.landmark_ids[landmarks]]
        _draw_distances(beside[0], beside[1], distances, names, room=tall)
    dress(area)
    area.set(aspect="equal", xlim=limits[:, 0], ylim=limits[:, 1])
    area.set(xlabel="x [m]", ylabel="y [m]")
    keys = draw_against_truth(area, trace) + draw_walls(area, walls)
    write_title(area, "Estimate and ground truth", _summary(trace, poses, distances))
    style.legend_below(figure, keys, columns=len(keys))
    return figure


def _known(truth: Array | None) -> BoolArray:
    """Return which rows of a truth hold a position."""
    if truth is None:
        return np.zeros(0, dtype=bool)
    return np.asarray(np.isfinite(truth[:, :2]).all(axis=1))


def truth_limits(trace: RunTrace, walls: Walls = ()) -> Array:
    """Return a box around a run's estimates, its truth and walls, shape (2, 2) [m]."""
    truths = [trace.true_poses, trace.true_landmarks]
    points = [trace.poses[:, :2], trace.landmarks]
    points += [truth[:, :2] for truth in truths if truth is not None]
    points.append(wall_ends(walls))
    return box_around(
        np.concatenate(points), trace.landmarks, trace.landmark_covariances
    )


def draw_against_truth(axes: Axes, trace: RunTrace) -> list[Artist]:
    """Draw estimates, truth and the lines between them; return the legend's keys."""
    poses, landmarks = _known(trace.true_poses), _known(trace.true_landmarks)
    shown = _LANDMARK.add_to(axes)
    style.set_ellipses(shown, trace.landmarks, trace.landmark_covariances)
    axes.plot(*trace.landmarks.T, ".", color=TEAL, ms=4)
    (path,) = axes.plot(
        *trace.poses[:, :2].T, color=style.BLUE, lw=1.6, label="estimated path"
    )
    keys: list[Artist] = [path, _LANDMARK.legend_key()]
    if poses.any() and trace.true_poses is not None:
        truth = np.where(poses[:, None], trace.true_poses[:, :2], np.nan)
        (line,) = axes.plot(*truth.T, "--", color=INK, lw=1.3, label="true path")
        steps = np.flatnonzero(poses)[:: -(-len(poses) // _MOST_ERRORS)]
        _join(axes, trace.poses[steps, :2], truth[steps], width=0.8)
        keys.insert(1, line)
    if landmarks.any() and trace.true_landmarks is not None:
        truth = trace.true_landmarks[landmarks]
        few = len(truth) <= _FEW
        size = 9 if few else 5
        (crosses,) = axes.plot(
            *truth.T, "+", color=INK, ms=size, mew=size / 7, label="true landmark"
        )
        _join(axes, trace.landmarks[landmarks], truth, width=1.6)
        keys.append(crosses)
    return [*keys, Line2D([], [], color=ALARM, lw=1.4, label="error")]


def _join(axes: Axes, estimates: Array, truth: Array, *, width: float) -> None:
    lines = LineCollection(
        list(np.stack([estimates, truth], axis=1)),
        colors=ALARM,
        linewidths=width,
        zorder=3,
        label="error",
    )
    axes.add_collection(lines, autolim=False)


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
    metres: Axes,
    deviations: Axes,
    distances: LandmarkDistances,
    names: list[str],
    *,
    room: float,
) -> None:
    """Draw one bar per landmark, in the order of the state from the top.

    As many are named as fit into the height of the axes, `room` [inches].
    """
    _draw_bars(metres, distances.euclidean)
    _draw_bars(deviations, distances.mahalanobis)
    stride = max(1, math.ceil(len(names) * _NAME_HEIGHT / room))
    metres.set_yticks(range(0, len(names), stride), names[::stride])
    deviations.set_yticks([])
    metres.set_xlabel("distance [m]")
    deviations.set_xlabel("distance [σ]")
    bound = float(np.sqrt(chdtri(2, 0.05)))
    deviations.set_xlim(0, max(deviations.get_xlim()[1], 1.15 * bound))
    deviations.axvline(bound, color=GREY, lw=1.2, ls="--")
    inside = np.mean(distances.mahalanobis <= bound)
    write_title(metres, "Euclidean", "from truth, by landmark")
    write_title(deviations, "Mahalanobis", f"{inside:.0%} in the 95% bound")


def _draw_bars(axes: Axes, values: Array) -> None:
    rows, few = np.arange(len(values)), len(values) <= _FEW
    dress(axes)
    axes.grid(visible=False, axis="y")
    axes.hlines(rows, 0, values, color=ALARM, lw=1.6 if few else 0.8)
    axes.plot(values, rows, "o", color=ALARM, ms=4.5 if few else 2.5)
    axes.set_xlim(0, 1.1 * max(float(values.max()), 1e-9))
    axes.set_ylim(len(rows) - 0.4, -0.6)
    axes.tick_params(axis="y", length=0)


def _summary(
    trace: RunTrace, poses: BoolArray, distances: LandmarkDistances | None
) -> str:
    parts = [trace.estimator]
    if poses.any() and trace.true_poses is not None:
        error = trace.poses[poses, :2] - trace.true_poses[poses, :2]
        rms = np.sqrt(np.mean(np.sum(error**2, axis=1)))
        parts.append(f"path error {rms:.2g} m RMS")
    if distances is not None:
        rms = np.sqrt(np.mean(distances.euclidean**2))
        parts.append(f"landmark error {rms:.2g} m RMS")
    return "  ·  ".join(parts)
