"""Linearisation points of the measurements of a sparse information map.

Symbols
-------
x̄    linearisation point of the position, fixed until the pose moves [m]
l̄    first estimate of a landmark [m]
δ̄ = l̄ − x̄,  J = [0 −1; 1 0]

A rotation of robot and landmark by δθ about the robot moves the landmark by J δ̄ δθ.
Measurements do not observe this rotation if H_l J δ̄ + H_θ = 0.  If all measurements of
a landmark use the same l̄, the information of the whole map does not observe it either.
"""

import numpy as np

from ....arrays import Array, IntArray
from ...models.bearing_range import predict_measurement, wrap_angle
from .conditional_pose import ConditionalPose, LinearScan
from .local_information import LocalInformation

ESTIMATE, FIRST, CONSTRAINED = BASES = (
    "ekf",
    "first_estimates",
    "observability_constrained",
)


def linearise_scan(
    base: str,
    local: LocalInformation,
    pose: ConditionalPose,
    places: IntArray,
    readings: Array,
    variance: Array,
) -> LinearScan:
    """Linearise measurements of local landmarks, with innovations at the mean.

    "ekf": H at the mean.  "first_estimates": H at (x̄, l̄).
    "observability_constrained": H at the mean, projected off the rotation.

    Parameters
    ----------
    base : str
    local : LocalInformation
    pose : ConditionalPose
    places : ndarray, shape (n,)
        Positions of the landmarks in the local map.
    readings, variance : ndarray, shape (n, 2)
    """
    points = local.points.reshape(-1, 2)[places]
    expected = predict_measurement(pose.mean, points)
    innovation = readings - expected.measurement
    innovation[:, 0] = wrap_angle(innovation[:, 0])
    H_p, H_l = expected.jacobian_pose, expected.jacobian_landmark
    first = local.first.reshape(-1, 2)[places]
    if base == FIRST:
        fixed = predict_measurement(np.append(pose.reference, 0.0), first)
        H_p, H_l = fixed.jacobian_pose, fixed.jacobian_landmark
    elif base == CONSTRAINED:
        H_p, H_l = _without_rotation(H_p, H_l, first - pose.reference)
    return LinearScan(innovation, H_p, H_l, variance, places)


def _without_rotation(H_p: Array, H_l: Array, apart: Array) -> tuple[Array, Array]:
    """Project Jacobians off the rotation, H ← H − (H w) wᵀ / wᵀw, for δ̄, shape (n, 2).

    w = (−J δ̄/2, 1, J δ̄/2) rotates robot and landmark about their midpoint.  It is
    orthogonal to both translations, which H does not observe in any case.
    """
    half = _quarter_turn(apart) / 2
    w = np.column_stack([-half, np.ones(len(half)), half])
    H = np.concatenate([H_p, H_l], axis=2)
    observed = np.einsum("nij,nj->ni", H, w) / (w**2).sum(axis=1)[:, None]
    H -= observed[:, :, None] * w[:, None, :]
    return H[..., :3], H[..., 3:]


def linearise_new_landmarks(
    base: str,
    local: LocalInformation,
    pose: ConditionalPose,
    places: IntArray,
    variance: Array,
) -> LinearScan:
    """Linearise the first measurements of landmarks, at the initial estimates.

    H_l is evaluated at the initial estimate; except for "ekf", H_θ = −H_l J δ̄.
    """
    points = local.points.reshape(-1, 2)[places]
    expected = predict_measurement(pose.mean, points)
    H_p, H_l = expected.jacobian_pose, expected.jacobian_landmark
    if base != ESTIMATE:
        turned = _quarter_turn(local.first.reshape(-1, 2)[places] - pose.reference)
        H_p = H_p.copy()
        H_p[:, :, 2] = -np.einsum("nij,nj->ni", H_l, turned)
    return LinearScan(np.zeros_like(points), H_p, H_l, variance, places)


def _quarter_turn(vectors: Array) -> Array:
    """Return J v, shape (n, 2)."""
    return np.column_stack([-vectors[:, 1], vectors[:, 0]])
