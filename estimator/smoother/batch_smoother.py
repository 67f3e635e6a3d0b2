"""Smooth a drive: the most likely poses and landmarks given all its readings."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike

from ...arrays import Array, IntArray
from ..filters.invariant import InvariantEkfSlam
from ..models.bearing_range import locate_landmark
from ..support import argument_checks
from .drive import Drive
from .optimiser import KINDS, Estimate, Noise, Optimiser
from .smoothed_drive import SmoothedDrive

SCALES = {"huber": 1.345, "cauchy": 2.3849}  # 95 % efficient without outliers


def smooth(
    drive: Drive,
    *,
    start: ArrayLike | None = None,
    landmarks: Mapping[int, ArrayLike] | None = None,
    robust: str | None = None,
    robust_scale: float | None = None,
    tolerance: float = 1e-9,
    iterations: int = 100,
) -> SmoothedDrive:
    """Return the most likely poses and landmarks of a drive, with their covariances.

    The maximum a posteriori estimate under the prior, motion and sensor noise of the
    filters [1]_: Levenberg-Marquardt, which eliminates the poses along the chain and
    solves for the landmarks last.

    Parameters
    ----------
    drive : Drive
        Motions and scans.
    start : array_like, shape (N, 3), optional
        Poses to start from; where not given, those of an invariant filter.
    landmarks : mapping from id to (2,), optional
        Landmarks to start from; else from the filter, or from their first reading.
    robust : {"huber", "cauchy"}, optional
        Kernel that gives readings far off less weight.
    robust_scale : float, optional
        Normalised distance of a reading from which on it counts less; 1.345 for Huber's
        and 2.3849 for Cauchy's by default.
    tolerance : float
        The solution is found when no pose or landmark moves more [m, rad].
    iterations : int
        Most iterations.

    Raises
    ------
    ValueError
        Where the drive has no readings, the start does not fit, or it has a landmark
        without a reading.
    numpy.linalg.LinAlgError
        Where the iterations do not converge.
    MemoryError
        Where memory does not suffice.

    References
    ----------
    .. [1] F. Dellaert, M. Kaess, Square Root SAM, IJRR 25(12), 2006.

    Examples
    --------
    >>> drive = Drive(motion_std=(0.1, 0.1, 0.05), measurement_std=(0.02, 0.1))
    >>> drive.update([(0.0, 5.0)], [7])
    >>> drive.predict((2.0, 0.0))
    >>> drive.update([(0.0, 3.2)], [7])
    >>> np.round(smooth(drive).poses[-1], 3)
    array([1.933, 0.   , 0.   ])
    """
    argument_checks.whole("iterations", iterations, 1)
    argument_checks.above("tolerance", tolerance, 0.0)
    noise = _noise(drive, robust, robust_scale)
    arrays, order = drive.arrays()
    poses, known = _start(drive, start, landmarks or {}, order)
    first = Estimate(poses, _landmarks_at(drive, poses, known, order))
    minimum = Optimiser(arrays, noise).minimise(first, tolerance, iterations)
    return SmoothedDrive(minimum, order.tolist(), drive.landmark_ids)


def _noise(drive: Drive, robust: str | None, scale: float | None) -> Noise:
    if robust is not None:
        argument_checks.one_of("robust", robust, tuple(SCALES))
    default = SCALES.get(robust or "", 1.0)
    chosen = default if scale is None else scale
    argument_checks.above("robust_scale", chosen, 0.0)
    rules = drive.rules
    return Noise(np.array(rules), rules.bearing_std, KINDS[robust], float(chosen))


def _start(
    drive: Drive,
    start: ArrayLike | None,
    landmarks: Mapping[int, ArrayLike],
    order: IntArray,
) -> tuple[Array, dict[int, Array]]:
    """Return poses (N, 3) to start from, and landmarks as far as they are known."""
    known = set(order.tolist())
    given = {
        i: argument_checks.finite_vector(f"landmarks[{i}]", place, 2)
        for i, place in landmarks.items()
    }
    for i in given:
        if i not in known:
            raise ValueError(f"landmark {i} has no reading in the drive")
    if start is None:
        poses, found = filtered(drive)
        return poses, found | given
    poses = argument_checks.as_floats("start", start).copy()
    if poses.shape != (drive.poses, 3) or not np.isfinite(poses).all():
        raise ValueError(
            f"start must be finite poses ({drive.poses}, 3), got shape {poses.shape}"
        )
    return poses, given


def filtered(drive: Drive) -> tuple[Array, dict[int, Array]]:
    """Return the poses (N, 3) and landmarks of an invariant filter over a drive."""
    rules, noise = drive.rules, drive.motion_noise
    slam = InvariantEkfSlam(
        np.sqrt(noise.variance),
        (rules.bearing_std, rules.range_std),
        initial_pose=drive.initial_pose,
        initial_pose_std=drive.initial_pose_std,
        range_std_per_metre=rules.range_std_per_metre,
        range_noise_at="reading" if rules.noise_as_read else "expected",
        noise_at_rest=noise.at_rest,
        min_range=rules.min_range,
    )
    poses = np.empty((drive.poses, 3))
    for k, motion in enumerate(drive.motions):
        for distance, turn, dt in motion.steps:
            slam.predict((distance, turn), dt)
        readings, ids = drive.sightings(k)
        slam.update(readings, ids)
        poses[k] = slam.map.mean[:3]
    places = slam.belief().landmarks
    return poses, dict(zip(slam.landmark_ids, places, strict=True))


def _landmarks_at(
    drive: Drive, poses: Array, known: Mapping[int, Array], order: IntArray
) -> Array:
    """Return where the landmarks start, shape (2n,): as known, or as first read."""
    places = dict(known)
    if len(places) < len(order):
        for k in range(drive.poses):
            readings, ids = drive.sightings(k)
            located = locate_landmark(poses[k], readings).position
            for i, place in zip(ids.tolist(), located, strict=True):
                places.setdefault(i, place)
    return np.concatenate([places[i] for i in order.tolist()])
