"""The data of a drive as kernels take it, and the order of its landmarks.

Symbols
-------
x_k            pose k = 0 … N − 1, (x, y, θ) in the world frame [m, m, rad]
Δ_k            odometry from pose k − 1 to pose k, a pose in the frame of pose k − 1
ε_k = N_k w_k  noise of that motion in the frame of pose k − 1, w_k ~ N(0, I)
V_k            whitener: V_k N_k = I where N_k has full rank
"""

from typing import NamedTuple

import numpy as np

from ...arrays import Array, IntArray

NEGLIGIBLE = 1e-12
"""Variance of a direction without noise, relative to that of the noisiest one."""


class DriveArrays(NamedTuple):
    """N poses, M readings of n landmarks; entry 0 of the motions is the prior."""

    start: Array
    """Prior mean of pose 0, shape (3,)."""
    increments: Array
    """Δ_k, shape (N, 3) [m, m, rad]; row 0 is not read."""
    factors: Array
    """N_k, shape (N, 3, 3); entry 0 is the deviation of the prior."""
    whiteners: Array
    """V_k, shape (N, 3, 3)."""
    firsts: IntArray
    """The readings of pose k are rows firsts[k] … firsts[k + 1], shape (N + 1,)."""
    readings: Array
    """Rows (β, r), shape (M, 2) [rad, m]."""
    columns: IntArray
    """First column of the landmark of each reading, 2 slot, shape (M,)."""
    widths: IntArray
    """Columns of the landmarks that pose k or a later one reads, shape (N,)."""


def noise_factors(covariances: Array) -> tuple[Array, Array]:
    """Return N with N Nᵀ = Σ, and V with V Σ Vᵀ = I, of covariances (N, 3, 3).

    A direction without noise, to which the solution adheres, gets the weight of the
    noisiest one in V: V only measures how far an iterate is from the solution.

    Examples
    --------
    >>> factor, whitener = noise_factors(np.diag([4.0, 0.0, 1.0])[None])
    >>> np.allclose(factor @ factor.transpose(0, 2, 1), np.diag([4.0, 0.0, 1.0]))
    True
    >>> np.round(np.sort(abs(whitener[0]).max(axis=1)), 3)
    array([0.5, 0.5, 1. ])
    """
    variances, axes = np.linalg.eigh(covariances)
    largest = variances[:, -1:]
    noisy = variances > NEGLIGIBLE * largest
    std = np.sqrt(np.where(noisy, variances, 0.0))
    scale = np.sqrt(np.where(largest > 0, largest, 1.0))
    weights = 1 / np.where(noisy, std, scale)
    factors, whiteners = axes * std[:, None], weights[:, :, None] * axes.mT
    # One layout whatever the number of poses: for another, kernels compile anew.
    return np.ascontiguousarray(factors), np.ascontiguousarray(whiteners)


def landmark_order(ids: IntArray, firsts: IntArray) -> tuple[IntArray, IntArray]:
    """Order landmarks by their last reading, the latest first.

    The elimination goes backwards in time.  In this order the landmarks that it has met
    are always the first ones of the state.

    Parameters
    ----------
    ids : ndarray of int64, shape (M,)
        Landmark of each reading.
    firsts : ndarray of int64, shape (N + 1,)
        As in :class:`DriveArrays`.

    Returns
    -------
    order : ndarray, shape (n,)
        Landmark ids.
    widths : ndarray, shape (N,)
        As in :class:`DriveArrays`.

    Examples
    --------
    >>> order, widths = landmark_order(np.array([4, 7, 4]), np.array([0, 1, 2, 3]))
    >>> order.tolist(), widths.tolist()
    ([4, 7], [4, 4, 2])
    """
    found, from_the_end = np.unique(ids[::-1], return_index=True)
    by_last = np.argsort(from_the_end, kind="stable")
    last_rows = len(ids) - 1 - from_the_end[by_last]
    last_poses = np.searchsorted(firsts, last_rows, side="right") - 1
    poses = np.arange(len(firsts) - 1)
    met = np.searchsorted(-last_poses, -poses, side="right")
    return found[by_last], 2 * met
