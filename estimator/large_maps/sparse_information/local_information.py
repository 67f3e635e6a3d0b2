"""The landmarks near the robot, conditioned on the rest of a sparse information map.

`LocalInformation` holds the local landmarks, after the elimination of all others.
`ConditionalPose` holds the pose given the map, and `choose_local` chooses the local
landmarks.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_solve, lapack, solve_triangular

from ....arrays import Array, BoolArray, IntArray
from ...models.motions import predict_pose
from ..elimination import LandmarkElimination, RestFactor
from ..multifrontal import InformationMatrix, pairs
from ..undo import Undo, contents


class SparseMap:
    """Means and information of all landmarks, by slot."""

    def __init__(self) -> None:
        self.information = InformationMatrix()
        self.elimination = LandmarkElimination()
        self.points = np.zeros(0)
        self.first = np.zeros(0)  # first estimates

    def grow(self, count: int) -> None:
        """Make room for ``count`` landmarks."""
        self.information.grow(count)
        if 2 * count > len(self.points):
            more = np.zeros(4 * count - len(self.points))
            self.points = np.append(self.points, more)
            self.first = np.append(self.first, more)

    def checkpoint(self) -> Undo:
        """Return what takes back later changes of means, information and order."""
        return contents(self, self.elimination, self.information)


@dataclass(frozen=True)
class LocalInformation:
    """Mean and information of the local landmarks L; an immutable value.

    While the robot measures only local landmarks, no other entry of Λ changes.  The
    complement C of the eliminated landmarks then stays valid, and the dense matrix
    Λ_LL − C gives the same solution for L as the whole map.
    """

    slots: IntArray
    points: Array  # means, shape (2k,) [m]
    first: Array  # first estimates, shape (2k,) [m]
    information: Array  # Λ_LL, shape (2k, 2k)
    rest: RestFactor  # all other landmarks H
    border: IntArray  # columns of B in L, shape (2c,)
    start: Array  # means of B when L was chosen, shape (2c,)

    @classmethod
    def of(cls, map_: SparseMap, slots: IntArray) -> LocalInformation:
        """Choose local landmarks, and eliminate all others."""
        rest, inside = map_.elimination.eliminate(map_.information, slots), pairs(slots)
        place = np.full(rest.size, -1)
        place[slots] = np.arange(len(slots))
        return cls(
            slots,
            map_.points[inside],
            map_.first[inside],
            map_.information.dense(slots),
            rest,
            pairs(place[rest.border]),
            map_.points[pairs(rest.border)],
        )

    @property
    def shift(self) -> Array:
        """Displacement of the border since L was chosen, δ_B, shape (2c,)."""
        return self.points[self.border] - self.start

    def solver(self) -> tuple[Array, bool]:
        """Return the Cholesky factor of Λ_LL − C for :func:`scipy.linalg.cho_solve`."""
        marginal = self.information.copy()
        marginal[np.ix_(self.border, self.border)] -= self.rest.complement
        factor, failed = lapack.dpotrf(marginal, lower=1, clean=1)
        if failed:
            raise np.linalg.LinAlgError(
                "the information of the map is not positive definite at landmark "
                f"{(failed - 1) // 2} of the local map"
            )
        return factor, True

    def absorb(
        self, pose: ConditionalPose, measurement: MapMeasurement
    ) -> tuple[LocalInformation, ConditionalPose]:
        """Add information, Λ ← Λ + Yᵀ Y, and move map and pose to the new mean."""
        Y = measurement.rows
        added = replace(self, information=self.information + Y.T @ Y)
        return added.settle(pose, Y.T @ measurement.innovation)

    def settle(
        self, pose: ConditionalPose, residual: Array
    ) -> tuple[LocalInformation, ConditionalPose]:
        """Move the map by δ = (Λ_LL − C)⁻¹ b, and the pose by K δ."""
        if not residual.any():
            return self, pose
        delta = cho_solve(self.solver(), residual, check_finite=False)
        moved = pose._replace(mean=pose.mean + pose.gain @ delta)
        return replace(self, points=self.points + delta), moved

    def extended(self, slots: IntArray, points: Array) -> LocalInformation:
        """Append landmarks without information, at these points."""
        return replace(
            self,
            slots=np.concatenate([self.slots, slots]),
            points=np.concatenate([self.points, points]),
            first=np.concatenate([self.first, points]),
            information=np.pad(self.information, (0, 2 * len(slots))),
        )

    def without(self, gone: BoolArray, information: Array) -> LocalInformation:
        """Drop landmarks, shape (k,); ``information`` is that of the others."""
        rest = ~np.repeat(gone, 2)
        place = np.cumsum(rest) - 1
        return replace(
            self,
            slots=self.slots[~gone],
            points=self.points[rest],
            first=self.first[rest],
            information=information,
            border=place[self.border],
        )


def write_back(map_: SparseMap, local: LocalInformation) -> None:
    """Write the local map and its effect on the eliminated landmarks to the map."""
    map_.points = means(map_, local)
    map_.first[pairs(local.slots)] = local.first
    map_.information.replace(local.slots, local.information)
    map_.elimination.revise(map_.information, map_.first, local.slots)


def means(map_: SparseMap, local: LocalInformation) -> Array:
    """Return the positions of all landmarks by slot, flat [m]."""
    points = map_.points.copy()
    if local.shift.any():
        points[pairs(local.rest.slots)] -= local.rest.respond(local.shift)
    points[pairs(local.slots)] = local.points
    return points


def link_count(map_: SparseMap, local: LocalInformation) -> int:
    """Count the nonzero blocks of Λ, including the current local map."""
    matrix, slots = map_.information, local.slots
    k = len(slots)
    blocks = local.information.reshape(k, 2, k, 2)
    current = int(blocks.any(axis=(1, 3)).sum())
    return matrix.block_count - len(matrix.submatrix(slots, slots).indices) + current


# --------------------------------------------------------------------------------------
# The pose conditioned on the map, and its change by motion and measurements.
#
# Symbols
# -------
# p = (x, y, θ)  robot pose [m, m, rad]
# m              positions of the local landmarks, stacked, shape (2k,) [m]
# p = μ_p + K (m − μ_m) + ω,  ω ~ N(0, Ω):  K is nonzero only for active landmarks
#
# The joint information of pose and map is [Ω⁻¹, −Ω⁻¹ K; ·, Λ + Kᵀ Ω⁻¹ K], where Λ is
# the information of the map alone.  Storing K, Ω and Λ separately allows a singular Ω,
# for a pose that is known exactly or a robot that cannot slip sideways.

# The pose is not taken from measurements with a larger heading uncertainty [rad].
LARGEST_HEADING_STD = 0.3


class ConditionalPose(NamedTuple):
    """p | m ~ N(μ_p + K (m − μ_m), Ω)."""

    mean: Array  # μ_p, shape (3,)
    gain: Array  # K, shape (3, 2k)
    covariance: Array  # Ω, shape (3, 3)
    # x̄, the linearisation point of every base except "ekf", shape (2,) [m].
    reference: Array

    @property
    def is_linked(self) -> BoolArray:
        """Which local landmarks are active, i.e. linked with the pose, shape (k,)."""
        return np.asarray(self.gain.any(axis=0).reshape(-1, 2).any(axis=1))


class LinearScan(NamedTuple):
    """n linearised measurements: z = h + H_p δp + H_l δl + v, v ~ N(0, Q)."""

    innovation: Array  # ν = z − h, shape (n, 2)
    jacobian_pose: Array  # H_p, shape (n, 2, 3)
    jacobian_landmark: Array  # H_l, shape (n, 2, 2)
    variance: Array  # diagonal of Q, shape (n, 2)
    landmarks: IntArray  # positions of the landmarks in the local map, shape (n,)

    def subset(self, chosen: BoolArray) -> LinearScan:
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

    rows: Array  # Y, shape (·, 2k)
    innovation: Array  # w = W ν


def move(
    pose: ConditionalPose, moved: Array, variance: Array, *, from_mean: bool = True
) -> ConditionalPose:
    """Predict the pose: K ← G K, Ω ← G Ω Gᵀ + F R Fᵀ; Λ does not change.

    G is evaluated for the motion from the mean.  With ``from_mean=False`` it is
    evaluated from x̄ to the predicted position x̂⁻, which then becomes the new x̄:
    G = I + (J (x̂⁻ − x̄), 0) e_θᵀ.
    """
    predicted = predict_pose(pose.mean, moved)
    G, F = predicted.jacobian_pose, predicted.jacobian_noise
    if not from_mean:
        way = predicted.pose[:2] - pose.reference
        G = G.copy()
        G[:2, 2] = -way[1], way[0]
    covariance = G @ pose.covariance @ G.T + (F * variance) @ F.T
    covariance = (covariance + covariance.T) / 2
    reached = predicted.pose
    return ConditionalPose(reached, G @ pose.gain, covariance, reached[:2].copy())


def marginalise_pose(pose: ConditionalPose, scan: LinearScan) -> tuple[Array, Array]:
    """Return H = H_l + H_p K and N = Q + H_p Ω H_pᵀ: measurements of the map alone."""
    H_p = scan.jacobian_pose.reshape(-1, 3)
    H = scan.jacobian_map(pose.gain.shape[1]) + H_p @ pose.gain
    N = H_p @ pose.covariance @ H_p.T
    N[np.diag_indices_from(N)] += scan.variance.ravel()
    return H, (N + N.T) / 2


def correct(
    old: ConditionalPose, scan: LinearScan
) -> tuple[ConditionalPose, MapMeasurement]:
    """Condition on measurements.

    ::

        H = H_l + H_p K,  N = Q + H_p Ω H_pᵀ = L Lᵀ,  Y = L⁻¹ H,  V = L⁻¹ H_p Ω
        Λ ← Λ + Yᵀ Y,  μ_p ← μ_p + Vᵀ L⁻¹ ν,  K ← K − Vᵀ Y,  Ω ← Ω − Vᵀ V
    """
    H, N = marginalise_pose(old, scan)
    L = np.linalg.cholesky(N)
    H_p = scan.jacobian_pose.reshape(-1, 3)
    right = np.column_stack([H, scan.innovation.ravel(), H_p @ old.covariance])
    white = solve_triangular(L, right, lower=True, check_finite=False)
    Y, w, V = white[:, :-4], white[:, -4], white[:, -3:]
    corrected = ConditionalPose(
        old.mean + V.T @ w, old.gain - V.T @ Y, old.covariance - V.T @ V, old.reference
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


def cut_links(pose: ConditionalPose, matrix: Array, weak: BoolArray) -> ConditionalPose:
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
    moved = np.linalg.solve(matrix[np.ix_(dropped, dropped)], K_w.T)
    gain = np.zeros_like(pose.gain)
    gain[:, stays] = pose.gain[:, stays] - moved.T @ matrix[np.ix_(dropped, stays)]
    added = K_w @ moved
    return pose._replace(gain=gain, covariance=pose.covariance + (added + added.T) / 2)


# --------------------------------------------------------------------------------------
# Choice of the local landmarks.

SMALLEST_LOCAL_MAP = 50  # smallest number of landmarks in a new local map
# Size of the local map of a large map: 2 n^0.4.
#
# A change of the local map may eliminate the whole map, at a cost that grows with n; a
# step costs the third power of the local size.
SCALE, EXPONENT = 2, 0.4


def local_map_size(mapped: int, readings: int, required: int) -> int:
    """Return the number of landmarks of a new local map."""
    least = max(SMALLEST_LOCAL_MAP, int(SCALE * mapped**EXPONENT))
    return max(least, 3 * readings, 3 * required // 2)


def choose_local(
    mapped: IntArray, points: Array, centre: Array, required: IntArray, size: int
) -> IntArray:
    """Return the required landmarks and those nearest to a point, ``size`` in all."""
    distances = ((points[mapped] - centre) ** 2).sum(axis=1)
    count = min(size, len(mapped))
    nearest = mapped[np.argpartition(distances, count - 1)[:count]]
    return union(required, np.sort(nearest))[: max(size, len(required))]


def union(first: IntArray, second: IntArray) -> IntArray:
    """Return the first slots, then those of the second that are not among them."""
    return np.concatenate([first, second[~np.isin(second, first)]])
