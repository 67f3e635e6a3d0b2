"""Where readings of an information map are linearised.

Symbols
-------
x̄    position at which the pose is linearised, for as long as it is the same pose [m]
l̄    first estimate of a landmark [m]
δ̄ = l̄ − x̄,  J = [0 −1; 1 0]

A turn of robot and landmark together, δθ about the robot, moves l by J δ̄ δθ.  Readings
are *blind* to it where H_l J δ̄ + H_θ = 0, for one and the same l̄ in all of them: the
information of the whole map is then as well.
"""

import numpy as np
from numpy.typing import NDArray

from ...models.angles import wrap_angle
from ...models.bearing_range import predict_measurement
from .conditional_pose import LinearScan, PoseGivenMap
from .local_information import LocalInformation

Array = NDArray[np.float64]
Int = NDArray[np.int64]

ESTIMATE, FIRST, CONSTRAINED = BASES = (
    "ekf",
    "first_estimates",
    "observability_constrained",
)


def linear_scan(
    base: str,
    local: LocalInformation,
    pose: PoseGivenMap,
    places: Int,
    readings: Array,
    variance: Array,
) -> LinearScan:
    """Linearise readings of local landmarks, shape (n, 2), innovations at the mean.

    "ekf": H at the mean.  "first_estimates": H at (x̄, l̄).
    "observability_constrained": H at the mean, projected off the turn.
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
        H_p, H_l = blind(H_p, H_l, first - pose.reference)
    return LinearScan(innovation, H_p, H_l, variance, places)


def blind(H_p: Array, H_l: Array, apart: Array) -> tuple[Array, Array]:
    """Project rows of readings off the turn, H ← H − (H w) wᵀ / wᵀw.

    w = (−J δ̄/2, 1, J δ̄/2) turns robot and landmark about their midpoint, which is
    orthogonal to the two shifts, to which H is blind anyway.  Of δ̄, shape (n, 2).
    """
    half = np.column_stack([-apart[:, 1], apart[:, 0]]) / 2
    w = np.column_stack([-half, np.ones(len(half)), half])
    H = np.concatenate([H_p, H_l], axis=2)
    seen = np.einsum("nij,nj->ni", H, w) / (w**2).sum(axis=1)[:, None]
    H -= seen[:, :, None] * w[:, None, :]
    return H[..., :3], H[..., 3:]


def first_scan(
    base: str, local: LocalInformation, pose: PoseGivenMap, places: Int, variance: Array
) -> LinearScan:
    """Linearise the readings by which landmarks were found, where they were found.

    H_l is that of the place found; but for "ekf", H_θ = −H_l J δ̄.
    """
    points = local.points.reshape(-1, 2)[places]
    found = predict_measurement(pose.mean, points)
    H_p, H_l = found.jacobian_pose, found.jacobian_landmark
    if base != ESTIMATE:
        apart = local.first.reshape(-1, 2)[places] - pose.reference
        turned = np.column_stack([-apart[:, 1], apart[:, 0]])
        H_p = H_p.copy()
        H_p[:, :, 2] = -np.einsum("nij,nj->ni", H_l, turned)
    return LinearScan(np.zeros_like(points), H_p, H_l, variance, places)
