"""The cost of poses and landmarks, compiled: what the smoother minimises.

::

    cost = ½ Σ_k ‖V_k ε_k‖² + Σ_j ρ(e_j),    e_j² = ν_β² / σβ² + ν_r² / σr²
    ε_k = R(θ_{k−1})ᵀ (x_k − x_{k−1} ⊕ Δ_k)

with the innovation ν = z − h(x, l) of each reading, and ε_0 = x_0 − prior mean.  ρ(e)
is e²/2, or a robust kernel of scale c: Huber's, c e − c²/2 beyond c, or Cauchy's,
½ c² log(1 + e²/c²).
"""

from __future__ import annotations

from math import log1p, sqrt

import numpy as np

from ...arrays import Array
from ...jit import jit, njit_internal
from ..kernels.kalman_gain import as_rules
from ..kernels.scan_update import bearing_variance, range_variance
from ..models.bearing_range import expected_reading_jit, wrap_angle_jit
from ..models.rigid_motion import composed_jit
from .drive_arrays import DriveArrays

SQUARED, HUBER, CAUCHY = 0.0, 1.0, 2.0


@njit_internal
def robust_loss(squared: float, kind: float, scale: float) -> float:
    """Return ρ(e), given e²."""
    if kind == HUBER and squared > scale * scale:
        return scale * (sqrt(squared) - scale / 2)
    if kind == CAUCHY:
        return scale * scale / 2 * log1p(squared / (scale * scale))
    return squared / 2


@njit_internal
def robust_weight(squared: float, kind: float, scale: float) -> float:
    """Return ρ'(e) / e, the weight of a reading in the normal equations."""
    if kind == HUBER and squared > scale * scale:
        return scale / sqrt(squared)
    if kind == CAUCHY:
        return 1 / (1 + squared / (scale * scale))
    return 1.0


@jit
def reading_stds(
    poses: Array, landmarks: Array, drive: DriveArrays, rule_values: Array
) -> Array:
    """Return (σβ, σr) of each reading, (M, 2), at the range that it should have."""
    rules = as_rules(rule_values)
    stds = np.empty((len(drive.readings), 2))
    for k in range(len(poses)):
        for j in range(drive.firsts[k], drive.firsts[k + 1]):
            c = drive.columns[j]
            dx, dy = landmarks[c] - poses[k, 0], landmarks[c + 1] - poses[k, 1]
            distance = np.sqrt(dx * dx + dy * dy)
            if rules.noise_as_read:
                distance = drive.readings[j, 1]
            distance = max(distance, rules.min_range)
            stds[j, 0] = np.sqrt(bearing_variance(rules, distance))
            stds[j, 1] = np.sqrt(range_variance(rules, distance))
    return stds


@njit_internal
def motion_residual(poses: Array, drive: DriveArrays, k: int) -> tuple[float, ...]:
    """Return x_k − x_{k−1} ⊕ Δ_k in the world frame, and (cos, sin) of θ_{k−1}.

    For k = 0 the prior mean takes the place of x_{k−1} ⊕ Δ_k.
    """
    x, y, heading = drive.start[0], drive.start[1], drive.start[2]
    cos, sin = 1.0, 0.0
    if k > 0:
        x, y, heading, cos, sin = composed_jit(
            poses[k - 1, 0],
            poses[k - 1, 1],
            poses[k - 1, 2],
            drive.increments[k, 0],
            drive.increments[k, 1],
            drive.increments[k, 2],
        )
    turn = wrap_angle_jit(poses[k, 2] - heading)
    return poses[k, 0] - x, poses[k, 1] - y, turn, cos, sin


@njit_internal
def innovation(
    poses: Array, landmarks: Array, drive: DriveArrays, k: int, j: int
) -> tuple[float, float]:
    """Return ν = z − h of reading j, taken at pose k."""
    c = drive.columns[j]
    dx, dy = landmarks[c] - poses[k, 0], landmarks[c + 1] - poses[k, 1]
    bearing, distance = expected_reading_jit(dx, dy, poses[k, 2])
    z = drive.readings[j]
    return wrap_angle_jit(z[0] - bearing), z[1] - distance


@jit
def total_cost(
    poses: Array,
    landmarks: Array,
    drive: DriveArrays,
    stds: Array,
    kind: float,
    scale: float,
) -> float:
    """Return the cost of poses (N, 3) and landmarks (2n,); stds (M, 2) are (σβ, σr)."""
    total = 0.0
    for k in range(len(poses)):
        dx, dy, turn, cos, sin = motion_residual(poses, drive, k)
        along, across = cos * dx + sin * dy, cos * dy - sin * dx
        for i in range(3):
            v = drive.whiteners[k, i]
            total += (v[0] * along + v[1] * across + v[2] * turn) ** 2 / 2
        for j in range(drive.firsts[k], drive.firsts[k + 1]):
            bearing, distance = innovation(poses, landmarks, drive, k, j)
            squared = (bearing / stds[j, 0]) ** 2 + (distance / stds[j, 1]) ** 2
            total += robust_loss(squared, kind, scale)
    return total
