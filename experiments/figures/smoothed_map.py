"""Figure of a smoothed log: truth, filter and smoother in one map."""

import numpy as np
from matplotlib.artist import Artist
from matplotlib.figure import Figure

from ...arrays import Array
from ...estimator.models.rigid_motion import rotation
from ...evaluation.trajectory_error import PositionAccuracy, poses_at
from ..logs.ground_truth import path_accuracy
from ..runs.log_smoothing import SmoothedLog
from . import style
from .map_picture import box_around
from .style import INK, ORANGE, TEAL, EllipseKind, dress, write_title

_LANDMARK = EllipseKind("smoothed landmark, 3σ", TEAL, fill=0.15)
_POSE = EllipseKind("smoothed pose, 3σ", style.BLUE, fill=0.12, width=0.9)
_MOST_POSES = 60  # ellipses along the path


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
    paths = np.concatenate([smoothed.poses[:, :2], trace.poses[:, :2], drive.landmarks])
    limits = box_around(paths, drive.landmarks, drive.landmark_covariances)
    width, height = limits[1] - limits[0]
    figure = style.new_figure(7.2, 6.2 * height / width + 1.6)
    axes = figure.add_subplot()
    dress(axes)
    axes.set(aspect="equal", xlim=limits[:, 0], ylim=limits[:, 1])
    axes.set(xlabel="x [m]", ylabel="y [m]")
    (filtered,) = axes.plot(
        *trace.poses[:, :2].T, color=ORANGE, lw=1.0, label=f"filter: {trace.estimator}"
    )
    (path,) = axes.plot(
        *smoothed.poses[:, :2].T, color=style.BLUE, lw=1.4, label="smoother"
    )
    chosen = np.arange(0, len(drive.poses), -(-len(drive.poses) // _MOST_POSES))
    covariances = drive.pose_covariances[chosen, :2, :2]
    style.set_ellipses(_POSE.add_to(axes), drive.poses[chosen, :2], covariances)
    style.set_ellipses(
        _LANDMARK.add_to(axes), drive.landmarks, drive.landmark_covariances
    )
    axes.plot(*drive.landmarks.T, ".", color=TEAL, ms=3)
    keys: list[Artist] = [path, filtered, _POSE.legend_key(), _LANDMARK.legend_key()]
    accuracy = path_accuracy(smoothed.log, trace.t, smoothed.poses)
    truth = _truth_beside(smoothed, accuracy)
    if truth is not None:
        (line,) = axes.plot(*truth.T, "--", color=INK, lw=0.9, label="ground truth")
        keys.insert(0, line)
    write_title(axes, f"{smoothed.log.name}, smoothed", _subtitle(smoothed, accuracy))
    style.legend_below(figure, keys, columns=3)
    return figure


def _truth_beside(
    smoothed: SmoothedLog, accuracy: PositionAccuracy | None
) -> Array | None:
    """Return the true path moved onto the smoothed one, (m, 2), or None."""
    if accuracy is None:
        return None
    truth, times = smoothed.log.ground_truth, smoothed.filtered.trace.t
    inside = np.isfinite(
        poses_at(truth[:, 0], np.column_stack([times, smoothed.poses]))
    ).all(axis=1)
    angle, shift = accuracy.alignment
    return np.asarray((truth[inside, 1:3] - shift) @ rotation(angle))


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
