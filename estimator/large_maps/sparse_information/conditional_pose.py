"""The pose conditioned on the map, and its change by motion and measurements.

Symbols
-------
p = (x, y, θ)  robot pose [m, m, rad]
m              positions of the local landmarks, stacked, shape (2k,) [m]
p = μ_p + K (m − μ_m) + ω,  ω ~ N(0, Ω):  K is nonzero only for active landmarks

The joint information of pose and map is [Ω⁻¹, −Ω⁻¹ K; ·, Λ + Kᵀ Ω⁻¹ K], where Λ is the
information of the map alone.  Storing K, Ω and Λ separately allows a singular Ω, for a
pose that is known exactly or a robot that cannot slip sideways.
"""

from typing import NamedTuple

import numpy as np
from scipy.linalg import solve_triangular

from ....arrays import Array, BoolArray, IntArray
from ...models.unicycle_motion import predict_pose
from ..sparse_cholesky.coordinates import pairs

LARGEST_HEADING_STD = 0.3
"""The pose is not taken from measurements with a larger heading uncertainty [rad]."""


class ConditionalPose(NamedTuple):
    """p | m ~ N(μ_p + K (m − μ_m), Ω)."""

    mean: Array
    """μ_p, shape (3,)."""
    gain: Array
    """K, shape (3, 2k)."""
    covariance: Array
    """Ω, shape (3, 3)."""
    reference: Array
    """x̄, the linearisation point of every base except "ekf", shape (2,) [m]."""

    @property
    def is_linked(self) -> BoolArray:
        """Which local landmarks are active, i.e. linked with the pose, shape (k,)."""
        return np.asarray(self.gain.any(axis=0).reshape(-1, 2).any(axis=1))


class LinearScan(NamedTuple):
    """n linearised measurements: z = h + H_p δp + H_l δl + v, v ~ N(0, Q)."""

    innovation: Array
    """ν = z − h, shape (n, 2)."""
    jacobian_pose: Array
    """H_p, shape (n, 2, 3)."""
    jacobian_landmark: Array
    """H_l, shape (n, 2, 2)."""
    variance: Array
    """Diagonal of Q, shape (n, 2)."""
    landmarks: IntArray
    """Positions of the landmarks in the local map, shape (n,)."""

    def subset(self, chosen: BoolArray) -> "LinearScan":
        """Return some of the measurements."""
        return LinearScan(
            self.innovation[chosen],
            self.jacobian_pose[chosen],
            self.jacobian_landmark[chosen],
            self.variance[chosen],
            self.landmarks[chosen],
        )

    def jacobian_map(self, size: int) -> Array:
        """Return ∂z/∂m for the whole local map, shape (2n, size)."""
        n = len(self.landmarks)
        H = np.zeros((n, 2, size))
        rows = np.arange(n)[:, None, None]
        columns = pairs(self.landmarks).reshape(n, 1, 2)
        H[rows, np.arange(2)[:, None], columns] = self.jacobian_landmark
        return H.reshape(2 * n, size)


class MapMeasurement(NamedTuple):
    """Information about the map alone: W (z − h) = Y δm + white noise."""

    rows: Array
    """Y, shape (·, 2k)."""
    innovation: Array
    """w = W ν."""


def move(
    pose: ConditionalPose, odometry: Array, variance: Array, *, from_mean: bool = True
) -> ConditionalPose:
    """Predict the pose: K ← G K, Ω ← G Ω Gᵀ + F R Fᵀ; Λ does not change.

    G is evaluated for the motion from the mean.  With ``from_mean=False`` it is
    evaluated from x̄ to the predicted position x̂⁻, which then becomes the new x̄:
    G = I + (J (x̂⁻ − x̄), 0) e_θᵀ.
    """
    motion = predict_pose(pose.mean, odometry)
    G, F = motion.jacobian_pose, motion.jacobian_noise
    if not from_mean:
        way = motion.pose[:2] - pose.reference
        G = G.copy()
        G[:2, 2] = -way[1], way[0]
    covariance = G @ pose.covariance @ G.T + (F * variance) @ F.T
    covariance = (covariance + covariance.T) / 2
    return ConditionalPose(
        motion.pose, G @ pose.gain, covariance, motion.pose[:2].copy()
    )


def marginalise_pose(pose: ConditionalPose, scan: LinearScan) -> tuple[Array, Array]:
    """Return H = H_l + H_p K and N = Q + H_p Ω H_pᵀ: measurements of the map alone."""
    H_p = scan.jacobian_pose.reshape(-1, 3)
    H = scan.jacobian_map(pose.gain.shape[1]) + H_p @ pose.gain
    N = H_p @ pose.covariance @ H_p.T
    N[np.diag_indices_from(N)] += scan.variance.ravel()
    return H, (N + N.T) / 2


def correct(
    pose: ConditionalPose, scan: LinearScan
) -> tuple[ConditionalPose, MapMeasurement]:
    """Condition on measurements.

    ::

        H = H_l + H_p K,  N = Q + H_p Ω H_pᵀ = L Lᵀ,  Y = L⁻¹ H,  V = L⁻¹ H_p Ω
        Λ ← Λ + Yᵀ Y,  μ_p ← μ_p + Vᵀ L⁻¹ ν,  K ← K − Vᵀ Y,  Ω ← Ω − Vᵀ V
    """
    H, N = marginalise_pose(pose, scan)
    L = np.linalg.cholesky(N)
    H_p = scan.jacobian_pose.reshape(-1, 3)
    right = np.column_stack([H, scan.innovation.ravel(), H_p @ pose.covariance])
    white = solve_triangular(L, right, lower=True, check_finite=False)
    Y, w, V = white[:, :-4], white[:, -4], white[:, -3:]
    corrected = ConditionalPose(
        pose.mean + V.T @ w,
        pose.gain - V.T @ Y,
        pose.covariance - V.T @ V,
        pose.reference,
    )
    return corrected, MapMeasurement(Y, w)


def relocate(
    pose: ConditionalPose, scan: LinearScan
) -> tuple[ConditionalPose, MapMeasurement] | None:
    """Discard the pose and estimate it from these measurements alone.

    With Q^{-1/2} H_p = [Q₁ Q₂] [R; 0], Y = Q^{-1/2} H_l and w = Q^{-1/2} ν::

        Ω = R⁻¹ R⁻ᵀ,  K = −R⁻¹ Q₁ᵀ Y,  μ_p ← μ_p + R⁻¹ Q₁ᵀ w,   Λ ← Λ + Yᵀ Q₂ Q₂ᵀ Y

    This is the limit of :func:`correct` for a pose with infinite variance.  Only the
    measured landmarks stay active.  The function returns None if the measurements do
    not determine a pose.
    """
    scale = 1 / np.sqrt(scan.variance.ravel())
    H_p = scan.jacobian_pose.reshape(-1, 3) * scale[:, None]
    Y = scan.jacobian_map(pose.gain.shape[1]) * scale[:, None]
    w = scan.innovation.ravel() * scale
    Q, R = np.linalg.qr(H_p, mode="complete")
    if len(w) < 4 or abs(R[2, 2]) * LARGEST_HEADING_STD < 1:
        return None  # R₃₃ is 1 / σθ if the position is unknown
    back = solve_triangular(R[:3], np.column_stack([Q[:, :3].T @ Y, Q[:, :3].T @ w]))
    root = solve_triangular(R[:3], np.eye(3))
    moved = pose._replace(
        mean=pose.mean + back[:, -1],
        gain=np.ascontiguousarray(-back[:, :-1]),
        covariance=root @ root.T,
    )
    return moved, MapMeasurement(Q[:, 3:].T @ Y, Q[:, 3:].T @ w)


def cut_links(
    pose: ConditionalPose, information: Array, weak: BoolArray
) -> ConditionalPose:
    """Remove the links between the pose and weak landmarks, as the SEIF does.

    The weak landmarks w are marginalised out of p | m with all passive landmarks fixed
    at their means.  C is the block of Λ of the weak landmarks, and s are the other
    active ones::

        K_s ← K_s − K_w C⁻¹ Λ_ws,   Ω ← Ω + K_w C⁻¹ K_wᵀ,   K_w ← 0

    Fixing the passive landmarks adds information that was never measured.
    """
    dropped = np.repeat(weak, 2)
    stays = pose.is_linked.repeat(2) & ~dropped
    K_w = pose.gain[:, dropped]
    moved = np.linalg.solve(information[np.ix_(dropped, dropped)], K_w.T)
    gain = np.zeros_like(pose.gain)
    gain[:, stays] = pose.gain[:, stays] - moved.T @ information[np.ix_(dropped, stays)]
    added = K_w @ moved
    return pose._replace(gain=gain, covariance=pose.covariance + (added + added.T) / 2)
