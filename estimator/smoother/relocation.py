"""Move landmarks out of local minima, compiled.

A landmark close to the path may be estimated on the wrong side of it. All bearings then
have large errors, but no small step reduces the cost. Single readings place it on the
right side.
"""

from __future__ import annotations

import numpy as np

from ...arrays import Array, IntArray
from ...jit import jit, njit_internal
from ..kernels.kalman_gain import Rules, as_rules
from ..kernels.scan_update import bearing_variance, range_variance
from ..models.bearing_range import expected_reading_jit, located_jit, wrap_angle_jit
from .cost import robust_loss
from .drive_arrays import DriveArrays

CANDIDATES = 12  # of a landmark, from readings spread evenly over the drive

GAIN = 4.0  # by which the cost must fall


@jit
def relocate(
    poses: Array,
    landmarks: Array,
    drive: DriveArrays,
    by_landmark: IntArray,
    owners: IntArray,
    rule_values: Array,
    robust: tuple[float, float],
) -> int:
    """Move each landmark to where one of its readings puts it, if that costs far less.

    The poses are fixed, and σβ and σr are those at the range read, so that places
    compare.
    Landmarks whose readings cost no more than they should are passed over.

    Parameters
    ----------
    by_landmark : ndarray of int64, shape (M,)
        The readings ordered by their landmark's column.
    owners : ndarray of int64, shape (M,)
        Pose of each reading.
    robust
        Kind and scale of the robust kernel.

    Returns
    -------
    int
        How many landmarks have moved, in place.
    """
    rules, moved, first = as_rules(rule_values), 0, 0
    place = np.empty(2)
    while first < len(by_landmark):
        c = drive.columns[by_landmark[first]]
        last = first
        while last < len(by_landmark) and drive.columns[by_landmark[last]] == c:
            last += 1
        own = by_landmark[first:last]
        place[0], place[1] = landmarks[c], landmarks[c + 1]
        least = _cost_at(place, own, poses, drive, owners, rules, robust) - GAIN
        bound, first = least, last
        if least < len(own) + 3 * np.sqrt(len(own)):  # the mean, and 3 σ more
            continue
        for i in range(0, len(own), max(len(own) // CANDIDATES, 1)):
            j = own[i]
            pose, z = poses[owners[j]], drive.readings[j]
            place[0], place[1], _, _ = located_jit(
                pose[0], pose[1], pose[2], z[0], z[1]
            )
            cost = _cost_at(place, own, poses, drive, owners, rules, robust)
            if cost < least:
                least = cost
                landmarks[c], landmarks[c + 1] = place[0], place[1]
        moved += least < bound
    return moved


@njit_internal
def _cost_at(
    place: Array,
    own: IntArray,
    poses: Array,
    drive: DriveArrays,
    owners: IntArray,
    rules: Rules,
    robust: tuple[float, float],
) -> float:
    """Return what the readings of one landmark cost if it is at a place."""
    total = 0.0
    for j in own:
        pose, z = poses[owners[j]], drive.readings[j]
        bearing, distance = expected_reading_jit(
            place[0] - pose[0], place[1] - pose[1], pose[2]
        )
        to_bearing = wrap_angle_jit(z[0] - bearing)
        squared = to_bearing**2 / bearing_variance(rules, z[1])
        squared += (z[1] - distance) ** 2 / range_variance(rules, z[1])
        total += robust_loss(squared, robust[0], robust[1])
    return total
