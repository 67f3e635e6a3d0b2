"""The path of a smoothed drive between its poses: after every reading of odometry."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ...arrays import Array
from ..filters.ekf import MotionNoise
from ..kernels.kalman_gain import AT_ESTIMATE
from ..kernels.scan_update import predict
from ..models.bearing_range import wrap_angle
from ..models.rigid_motion import pose_rotation
from .drive import Motion


def path_between(poses: Array, motions: Sequence[Motion], noise: MotionNoise) -> Array:
    """Return the pose after each reading of odometry, given the poses at the scans.

    The readings between two poses lead from the first one to the second except for
    their noise, which the poses determine in sum.  Each reading gets the part of it
    that is expected, given the sum s::

        E[s_i | s] = Σ_i Φᵀ Σ⁻¹ s

    with the covariance Σ_i after reading i and its transition Φ to the end.

    Parameters
    ----------
    poses : ndarray, shape (N, 3)
        At the scans [m, m, rad].
    motions : sequence of Motion
        Those of the drive, the first one empty.
    noise : MotionNoise
        Of the odometry.

    Returns
    -------
    ndarray, shape (1 + P, 3)
        The first pose, and that after each of the P readings; headings in [-π, π).

    Examples
    --------
    >>> steps = ((1.0, 0.0, 1.0), (1.0, 0.0, 3.0))
    >>> spread = np.diag([4.0, 0.0, 0.0])
    >>> still = Motion((), np.zeros(3), np.zeros((3, 3)))
    >>> motions = [still, Motion(steps, np.array([2.0, 0, 0]), spread)]
    >>> noise = MotionNoise.checked((1.0, 0, 0), noise_at_rest=True)
    >>> path_between(np.array([[0.0, 0, 0], [2.4, 0, 0]]), motions, noise)[:, 0]
    array([0. , 1.1, 2.4])
    """
    path = [poses[:1]]
    for k in range(1, len(poses)):
        path.append(_between(poses[k - 1], poses[k], motions[k], noise))
    found = np.concatenate(path)
    found[:, 2] = wrap_angle(found[:, 2])
    return found


def _between(first: Array, last: Array, motion: Motion, noise: MotionNoise) -> Array:
    """Return the poses after the readings of one motion, shape (P, 3)."""
    if len(motion.steps) == 1:
        return last[None]
    turn = pose_rotation(first[2])
    gap = turn.T @ (last - first) - motion.increment
    gap[2] = wrap_angle(gap[2])
    pull = np.linalg.pinv(motion.covariance, hermitian=True) @ gap
    path = np.empty((len(motion.steps), 3))
    pose, covariance = np.zeros(3), np.zeros((3, 3))
    for i, (distance, angle, dt) in enumerate(motion.steps):
        variance = noise.over(distance, angle, dt)
        predict(pose, covariance, pose, 3, distance, angle, variance, AT_ESTIMATE)
        onward = np.eye(3)
        onward[0, 2] = -(motion.increment[1] - pose[1])
        onward[1, 2] = motion.increment[0] - pose[0]
        path[i] = first + turn @ (pose + covariance @ onward.T @ pull)
    path[-1] = last
    return path
