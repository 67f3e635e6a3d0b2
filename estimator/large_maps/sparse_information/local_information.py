"""The landmarks near the robot, conditioned on the rest of a sparse information map.

`begin_local_map` eliminates the landmarks around the local map, and `LocalInformation`
holds the result. `ConditionalPose` holds the pose given the map, and `choose_local`
chooses the local landmarks.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from math import inf
from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_solve, lapack, solve_triangular

from ....arrays import Array, BoolArray, IntArray
from ...models.motions import predict_pose
from ..elimination import LandmarkElimination, RestFactor
from ..multifrontal import InformationMatrix, SchurComplement, eliminate_subset, pairs


class SparseMap:
    """Means and information of all landmarks, by slot.

    The exact mean is m + Λ⁻¹ b, where ``residual`` b is the part of the corrections
    that has not been applied yet.
    """

    def __init__(self) -> None:
        self.information = InformationMatrix()
        self.elimination = LandmarkElimination()
        self.points = np.zeros(0)
        self.first = np.zeros(0)  # first estimates
        self.residual = np.zeros(0)

    def grow(self, count: int) -> None:
        """Make room for ``count`` landmarks."""
        self.information.grow(count)
        if 2 * count > len(self.points):
            more = np.zeros(4 * count - len(self.points))
            self.points = np.append(self.points, more)
            self.first = np.append(self.first, more)
            self.residual = np.append(self.residual, more)

    def checkpoint(self) -> Callable[[], None]:
        """Return a function that undoes later changes of means, information, order."""
        arrays = {k: getattr(self, k).copy() for k in ("points", "first", "residual")}
        undo_information = self.information.checkpoint()
        undo_order = self.elimination.checkpoint()

        def undo() -> None:
            vars(self).update(arrays)
            undo_information()
            undo_order()

        return undo


@dataclass(frozen=True)
class FixedLandmarks:
    """Landmarks O linked with the eliminated ones, held at their means."""

    slots: IntArray  # O
    response: Array  # W = Λ_OH T, shape (2o, c): their residual is b + W δ_B
    residual: Array  # b when the local map was chosen, shape (2o,)
    scale: Array  # inverse Cholesky factors of their diagonal blocks, shape (o, 2, 2)

    def residual_after(self, shift: Array) -> Array:
        """Return the residual after the border moved by δ_B, shape (2o,)."""
        return self.residual + self.response @ shift

    def largest_residual(self, shift: Array) -> float:
        """Return the largest residual in conditional standard deviations."""
        left = self.residual_after(shift).reshape(-1, 2)
        white = np.einsum("oij,oj->oi", self.scale, left)
        return float(np.sqrt((white**2).sum(axis=1).max(initial=0.0)))


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
    start: Array  # means of the border when L was chosen, shape (c,)
    eliminated: SchurComplement
    fixed: FixedLandmarks

    @property
    def shift(self) -> Array:
        """Displacement of the border since L was chosen, δ_B, shape (c,)."""
        return self.points[self.eliminated.border] - self.start

    def solver(self) -> tuple[Array, bool]:
        """Return the Cholesky factor of Λ_LL − C for :func:`scipy.linalg.cho_solve`."""
        border = self.eliminated.border
        marginal = self.information.copy()
        marginal[np.ix_(border, border)] -= self.eliminated.complement
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
            eliminated=self.eliminated._replace(border=place[self.eliminated.border]),
        )


def begin_local_map(
    map_: SparseMap, pose: ConditionalPose, slots: IntArray, count: float
) -> tuple[LocalInformation, ConditionalPose]:
    """Choose local landmarks, and eliminate landmarks around them.

    Parameters
    ----------
    map_ : SparseMap
        Pending residuals of local and eliminated landmarks are applied to it.
    pose : ConditionalPose
        Its gain must be that of the local landmarks.
    slots : ndarray
        The local landmarks.
    count : float
        Number of landmarks to eliminate, nearest by links first.
    """
    matrix = map_.information
    eliminated = _eliminate(map_, slots, count)
    columns = pairs(eliminated.slots)
    fixed = np.empty(0, dtype=np.int64)
    if not isinstance(eliminated.factor, RestFactor):  # which leaves no others
        fixed = np.setdiff1d(matrix.neighbours(eliminated.slots), slots)
    pending = map_.residual[columns]
    if pending.any():
        pending = eliminated.factor.solve(pending)
    map_.points[columns] += pending
    map_.residual[columns] = 0.0
    link = matrix.submatrix(fixed, eliminated.slots)
    response = np.zeros((0, len(eliminated.border)))
    if len(fixed):
        response = np.ascontiguousarray(link @ eliminated.response)
    outside, inside = pairs(fixed), pairs(slots)
    map_.residual[outside] -= link @ pending
    residual = map_.residual[inside].copy()
    residual -= matrix.submatrix(slots, eliminated.slots) @ pending
    map_.residual[inside] = 0.0
    local = LocalInformation(
        slots,
        map_.points[inside],
        map_.first[inside],
        matrix.dense(slots),
        map_.points[inside][eliminated.border],
        eliminated,
        FixedLandmarks(
            fixed,
            response,
            map_.residual[outside],
            np.linalg.inv(np.linalg.cholesky(matrix.diagonal(fixed))),
        ),
    )
    return local.settle(pose, residual)


def _eliminate(map_: SparseMap, slots: IntArray, count: float) -> SchurComplement:
    """Eliminate the nearest landmarks by links, or the whole rest of the map."""
    matrix = map_.information
    if count >= len(matrix) - len(slots):
        return RestFactor(map_.elimination, matrix, slots).complement()
    return eliminate_subset(matrix, slots, matrix.nearest_by_links(slots, int(count)))


def write_back(map_: SparseMap, local: LocalInformation) -> None:
    """Write the local map and its effect on the eliminated landmarks to the map."""
    map_.points[pairs(local.slots)] = local.points
    map_.first[pairs(local.slots)] = local.first
    eliminated, shift = local.eliminated, local.shift
    if shift.any():
        map_.points[pairs(eliminated.slots)] -= eliminated.factor.respond(shift)
    map_.residual[pairs(local.fixed.slots)] = local.fixed.residual_after(shift)
    map_.information.replace(local.slots, local.information)
    map_.elimination.revise(map_.information, map_.first, local.slots)


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
# Choice of the local landmarks, and of how many to eliminate around them.

SMALLEST_LOCAL_MAP = 50  # smallest number of landmarks in a new local map
FIRST_COUNT = 100  # number of landmarks eliminated at first, if the tolerance allows it
# Growth factor of that number when it is too small. The second step takes all.
GROWTH = 16
# Take all at once if the larger number exceeds a tenth of the map.
#
# The elimination of all reuses what is known, and is then as fast.
SMALLEST_SHARE = 10
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


def first_elimination_count(last: float, mapped: int, *, enlarged: bool) -> float:
    """Return the number of landmarks to eliminate around a new local map.

    This is the last number if it had to be enlarged, and a smaller one otherwise.

    Examples
    --------
    >>> first_elimination_count(inf, 10_000, enlarged=False)
    100
    """
    if enlarged:
        return last
    less = min(last, GROWTH**2 * FIRST_COUNT) / GROWTH
    return less if _is_worthwhile(less, mapped) else FIRST_COUNT


def larger_elimination_count(count: float, mapped: int) -> float:
    """Return the number to eliminate if ``count`` was too small; finally infinity.

    Examples
    --------
    >>> [larger_elimination_count(100, mapped) for mapped in (10_000, 100_000)]
    [inf, 1600]
    """
    more = GROWTH * count
    return more if count < more < inf and _is_worthwhile(more, mapped) else inf


def _is_worthwhile(count: float, mapped: int) -> bool:
    most = min(GROWTH * FIRST_COUNT, mapped / SMALLEST_SHARE)
    return FIRST_COUNT < count <= most


def union(first: IntArray, second: IntArray) -> IntArray:
    """Return the first slots, then those of the second that are not among them."""
    return np.concatenate([first, second[~np.isin(second, first)]])
