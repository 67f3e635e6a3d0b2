"""Poses and landmarks to start the smoother from, by an invariant filter."""

from __future__ import annotations

import numpy as np

from ...arrays import Array
from ..filters.ekf import InvariantEkfSlam
from ..interface import Belief
from .drive import Drive


def filter_drive(
    drive: Drive, known: Belief | None = None, *, iterations: int = 1
) -> tuple[Array, Belief]:
    """Follow a drive with an invariant filter.

    Parameters
    ----------
    drive : Drive
        Motions and scans.
    known : Belief, optional
        A map that the filter has from the beginning.
    iterations : int
        Of each update of the filter.

    Returns
    -------
    poses : ndarray, shape (N, 3)
        After each scan [m, m, rad].
    belief : Belief
        At the end.
    """
    rules, noise = drive.rules, drive.motion_noise
    slam = InvariantEkfSlam(
        np.sqrt(noise.variance),
        (rules.bearing_std, rules.range_std),
        initial_pose=drive.initial_pose,
        initial_pose_std=drive.initial_pose_std,
        range_std_per_metre=rules.range_std_per_metre,
        bearing_std_metres=rules.bearing_std_metres,
        range_noise_at="reading" if rules.noise_as_read else "expected",
        noise_at_rest=noise.at_rest,
        min_range=rules.min_range,
        iterations=iterations,
    )
    if known is not None:
        _take_map(slam, drive, known)
    poses = np.empty((drive.poses, 3))
    for k, motion in enumerate(drive.motions):
        for distance, turn, dt in motion.steps:
            slam.predict((distance, turn), dt)
        readings, ids = drive.sightings(k)
        slam.update(readings, ids)
        poses[k] = slam.map.mean[:3]
    return poses, slam.belief()


def start_of(
    drive: Drive, belief: Belief | None = None, *, iterations: int = 1
) -> tuple[Array, dict[int, Array]]:
    """Return poses (N, 3) that fit a filter's final map, and that map.

    The poses that a filter estimates during the drive do not fit it: each uses only the
    readings until then, and they jump when a loop is closed. A second pass, which has
    the map from the beginning, counts all readings twice, but its poses have no jumps.

    Parameters
    ----------
    drive : Drive
        Motions and scans.
    belief : Belief, optional
        Of a filter at the end of the drive; an invariant one where not given.
    iterations : int
        Of each update of that.
    """
    if belief is None:
        _, belief = filter_drive(drive, iterations=iterations)
    poses, again = filter_drive(drive, belief)
    return poses, dict(zip(again.landmark_ids, again.landmarks, strict=True))


def _take_map(slam: InvariantEkfSlam, drive: Drive, known: Belief) -> None:
    """Give a filter at its start the landmarks of a belief that a drive reads."""
    read = set(drive.landmark_ids)
    columns = [
        3 + 2 * slot + axis
        for slot, i in enumerate(known.landmark_ids)
        if i in read
        for axis in (0, 1)
    ]
    mean = np.concatenate([drive.initial_pose, known.mean[columns]])
    covariance = np.zeros((len(mean), len(mean)))
    covariance[:3, :3] = np.diag(drive.initial_pose_std**2)
    covariance[3:, 3:] = known.covariance[np.ix_(columns, columns)]
    ids = [i for i in known.landmark_ids if i in read]
    slam.load_state_dict(
        slam.state_dict()
        | {
            "mean": mean,
            "covariance": covariance,
            "landmark_ids": np.array(ids, dtype=np.int64),
            "reference": mean,
        }
    )
