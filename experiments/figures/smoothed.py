"""The smoothed path and map of a log: `smoothed_figure`."""

import numpy as np
from matplotlib.artist import Artist
from matplotlib.figure import Figure

from ...arrays import Array
from ...envs.rendering import scene
from ...estimator.models.rigid_motion import rotation
from ...evaluation.trajectory_error import PositionAccuracy, poses_at
from ..logs.ground_truth import path_accuracy
from ..run_and_replay.log_smoothing import SmoothedLog
from . import style
from .maps import box_around

_MOST_POSES = 60  # ellipses along the path; longer runs show every second, third, …

_LANDMARK = scene.EllipseKind("smoothed landmark, 3σ", style.TEAL, fill=0.15)
_POSE = scene.EllipseKind("smoothed pose, 3σ", style.BLUE, fill=0.12, width=0.9)


def smoothed_figure(smoothed: SmoothedLog) -> Figure:
    """Draw the paths of filter and smoother, the truth, and the smoothed map.

    The truth is moved by the rotation and translation that bring it closest to the
    smoothed path: many logs have it in a frame of its own.

    Parameters
    ----------
    smoothed : SmoothedLog
        The smoothed log.
    """
    drive, trace = smoothed.drive, smoothed.filtered.trace
    accuracy = path_accuracy(smoothed.log, trace.t, smoothed.poses)
    truth, landmarks = _truth_beside(smoothed, accuracy)
    chosen = np.arange(0, len(drive.poses), -(-len(drive.poses) // _MOST_POSES))
    poses, covariances = (
        drive.poses[chosen, :2],
        drive.covariances_of(chosen)[:, :2, :2],
    )
    paths = [smoothed.poses[:, :2], trace.poses[:, :2], drive.landmarks]
    limits = box_around(
        np.concatenate([*paths, truth, landmarks]),
        np.concatenate([poses, drive.landmarks]),
        np.concatenate([covariances, drive.landmark_covariances]),
    )
    width, height = limits[1] - limits[0]
    figure = style.new_figure(7.2, 6.2 * height / width + 1.6)
    axes = figure.add_subplot()
    style.dress_map(axes, limits)
    name = f"filter: {trace.estimator}"
    (filtered,) = axes.plot(
        *trace.poses[:, :2].T, color=style.ORANGE, lw=1.0, label=name
    )
    (path,) = axes.plot(
        *smoothed.poses[:, :2].T, color=style.BLUE, lw=1.4, label="smoother"
    )
    _POSE.draw(axes, poses, covariances)
    _LANDMARK.draw(axes, drive.landmarks, drive.landmark_covariances)
    axes.plot(*drive.landmarks.T, ".", color=style.TEAL, ms=3)
    keys: list[Artist] = [path, filtered, _POSE.legend_key(), _LANDMARK.legend_key()]
    if len(truth):
        (line,) = axes.plot(*truth.T, color=style.INK, lw=0.6, label="ground truth")
        keys.insert(0, line)
    if len(landmarks):
        (line,) = axes.plot(
            *landmarks.T, "+", color=style.INK, ms=8, label="true landmark"
        )
        keys.append(line)
    style.write_title(
        axes, f"{smoothed.log.name}, smoothed", _subtitle(smoothed, accuracy)
    )
    style.legend(figure, keys, columns=3)
    return figure


def _truth_beside(
    smoothed: SmoothedLog, accuracy: PositionAccuracy | None
) -> tuple[Array, Array]:
    """Return true path and landmarks moved onto the smoothed ones, (m, 2), (n, 2)."""
    if accuracy is None:
        return np.empty((0, 2)), np.empty((0, 2))
    truth, times = smoothed.log.ground_truth, smoothed.filtered.trace.t
    inside = np.isfinite(
        poses_at(truth[:, 0], np.column_stack([times, smoothed.poses]))
    ).all(axis=1)
    angle, shift = accuracy.alignment
    turn = rotation(angle)
    return (truth[inside, 1:3] - shift) @ turn, (smoothed.log.landmarks - shift) @ turn


def _subtitle(smoothed: SmoothedLog, accuracy: PositionAccuracy | None) -> str:
    drive, trace = smoothed.drive, smoothed.filtered.trace
    parts = [f"{len(drive.poses)} poses, {len(drive.landmarks)} landmarks"]
    filtered = path_accuracy(smoothed.log, trace.t, trace.poses)
    if accuracy is not None and filtered is not None:
        parts.append(
            f"path error, aligned: {accuracy.aligned_rmse:.3g} m, "
            f"filter {filtered.aligned_rmse:.3g} m"
        )
    return "  ·  ".join(parts)
