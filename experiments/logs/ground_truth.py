"""The ground truth of a log at the times and in the order of a run.

`without_identities` hides the identities of a log's readings from filters.

The ground truth may be the path of an antenna at (a, b) on the robot, forward and to
the left, which the header gives in metres as ``groundtruth_offset: a,b``::

    antenna = position + C(θ) (a, b),    C(θ) = [cos θ, -sin θ; sin θ, cos θ]
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ...arrays import Array, IntArray
from ...estimator.models.bearing_range import wrap_angle
from ...evaluation.trajectory_error import PositionAccuracy, poses_at, position_accuracy
from .recording import steps_of
from .slamlog import NO_LANDMARK, LogError, Scan, SlamLog


def true_poses_of(log: SlamLog, times: Array) -> Array | None:
    """Interpolate the true poses of the robot.

    Parameters
    ----------
    log : SlamLog
        A log, with or without ground truth.
    times : ndarray, shape (k,)
        Times of the poses [s].

    Returns
    -------
    ndarray, shape (k, 3), or None
        (x, y, θ) [m, m, rad], nan where unknown; None if all are unknown. If the
        antenna is not at the robot's centre, the heading must be known too.
    """
    poses = poses_at(times, log.ground_truth)
    offset = antenna_offset(log)
    if offset.any():
        poses[:, :2] -= _turned(offset, poses[:, 2])
    return poses if np.isfinite(poses[:, :2]).any() else None


def starts_at_truth(log: SlamLog) -> bool:
    """Whether a log starts at the true pose, so that its map has the truth's frame.

    The header (``start_from``) decides, or the true pose at the start within three
    standard deviations (``start_sigma``) and 1 cm and 0.01 rad.  Where the file has no
    true pose, its start is taken for true; where these begin later, only a start other
    than the origin is.
    """
    source = log.header.get("start_from")
    if source is not None:
        return source == "ground truth"
    if not len(log.ground_truth):
        return True
    first = next(steps_of(log))
    poses = true_poses_of(log, np.array([first.t]))
    if poses is None:
        return bool(log.start.any())
    error = poses[0] - log.start
    error[2] = wrap_angle(error[2])
    sigma = log.header.get("start_sigma", "0,0,0")
    slack = 0.01 + 3 * np.array([float(number) for number in sigma.split(",")])
    return not (np.abs(error) > slack).any()  # an unknown heading is no error


class TrueLandmarks(NamedTuple):
    """The true landmarks of a world."""

    #: Shape (n,).
    ids: IntArray
    #: Shape (n, 2) [m].
    positions: Array

    def of(self, ids: Sequence[int]) -> Array | None:
        """Return the positions by ids, (k, 2), nan where unknown; None if all are."""
        known = dict(zip(self.ids.tolist(), self.positions, strict=True))
        if known.keys().isdisjoint(ids):
            return None
        return np.array([known.get(i, np.full(2, np.nan)) for i in ids])


def true_landmarks_of(
    log: SlamLog,
    ids: Sequence[int],
    landmarks: Array,
    path: tuple[Array, Array],
    identities: Mapping[int, int] | None = None,
) -> Array | None:
    """Look up the true positions of some landmarks, in their order.

    If the log does not identify its readings, the ids are the filter's own. Without
    their identities a landmark is then paired with the nearest true one, if each is the
    nearest of the other. The map is compared both as it is and after the motion that
    aligns the path with the truth; the pairs are those of the better fit.

    Parameters
    ----------
    log : SlamLog
        A log, with or without true landmarks.
    ids : sequence of int
        Ids of the landmarks.
    landmarks : ndarray, shape (n, 2)
        Their estimated positions [m].
    path : (ndarray, ndarray)
        Times and estimated poses of the same run, as `path_accuracy` takes them.
    identities : mapping of int to int, optional
        The true landmark of each id, if the filter has chosen the ids itself.

    Returns
    -------
    ndarray, shape (n, 2), or None
        Positions [m], nan where unknown; None if all are unknown.
    """
    truth = TrueLandmarks(log.landmark_ids, log.landmarks)
    if identities is not None:
        return truth.of([identities.get(i, NO_LANDMARK) for i in ids])
    if not (len(landmarks) and len(log.landmarks) and hides_identities(log)):
        return truth.of(ids)
    from scipy.spatial.distance import cdist  # noqa: PLC0415 (slow to import)

    places, accuracy = [landmarks], path_accuracy(log, *path)
    if accuracy is not None:
        places.append(accuracy.alignment.apply(landmarks))
    both = [cdist(moved, log.landmarks) for moved in places]
    gaps = min(both, key=lambda found: found.min(axis=1).sum())
    nearest = gaps.argmin(axis=1)
    is_mutual = gaps.argmin(axis=0)[nearest] == np.arange(len(landmarks))
    return np.where(is_mutual[:, None], log.landmarks[nearest], np.nan)


def path_accuracy(log: SlamLog, times: Array, poses: Array) -> PositionAccuracy | None:
    """Compare an estimated path with the ground truth, at the times of the truth.

    The estimate is interpolated between its steps, so the error weighs time evenly,
    whatever the distribution of the steps. The positions are those of the antenna.

    Parameters
    ----------
    log : SlamLog
        A log, with or without ground truth.
    times : ndarray, shape (k,)
        Times of the steps [s].
    poses : ndarray, shape (k, 3)
        Estimated (x, y, θ) after the steps [m, m, rad].

    Returns
    -------
    PositionAccuracy or None
        None if no ground truth lies within the time of the steps.
    """
    estimate = poses_at(log.ground_truth[:, 0], np.column_stack([times, poses]))
    inside = np.isfinite(estimate).all(axis=1)
    if not inside.any():
        return None
    estimate, truth = estimate[inside], log.ground_truth[inside, 1:3]
    antenna = estimate[:, :2] + _turned(antenna_offset(log), estimate[:, 2])
    return position_accuracy(antenna, truth)


def antenna_offset(log: SlamLog) -> Array:
    """Return the place (a, b) on the robot where the truth was measured [m].

    Raises
    ------
    LogError
        If the header's ``groundtruth_offset`` is not two numbers.
    """
    text = log.header.get("groundtruth_offset", "0,0")
    try:
        forward, left = (float(number) for number in text.split(","))
    except ValueError:
        raise LogError(
            f"{log.name}: groundtruth_offset must be two numbers a,b, got {text!r}"
        ) from None
    return np.array([forward, left])


def _turned(offset: Array, headings: Array) -> Array:
    """Rotate an offset on the robot by each heading: (k, 2) [m]."""
    cos, sin = np.cos(headings), np.sin(headings)
    return np.stack(
        [cos * offset[0] - sin * offset[1], sin * offset[0] + cos * offset[1]], axis=1
    )


def without_identities(log: SlamLog) -> SlamLog:
    """Hide the identities of a log's readings, and keep them as true ids for scores.

    Parameters
    ----------
    log : SlamLog
        A log; scans without identities stay as they are.

    Examples
    --------
    >>> scan = Scan(0.0, [(0.1, 5.0)], landmark_ids=[4])
    >>> (hidden,) = without_identities(SlamLog("drive", events=(scan,))).events
    >>> hidden.landmark_ids, hidden.true_ids
    (None, array([4]))
    """
    events = tuple(
        replace(event, landmark_ids=None, true_ids=true_ids_of(event))
        if isinstance(event, Scan)
        else event
        for event in log.events
    )
    return replace(log, events=events, header=log.header | {"identities": "false"})


def hides_identities(log: SlamLog) -> bool:
    """Whether some scan of a log has no identities."""
    return any(scan.landmark_ids is None for scan in log.scans)


def true_ids_of(scan: Scan) -> IntArray | None:
    """Return the true landmark of each reading, hidden or not; None if unknown."""
    return scan.landmark_ids if scan.true_ids is None else scan.true_ids
