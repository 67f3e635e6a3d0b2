"""The landmarks near the robot, conditioned on the rest of a sparse information map."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import cho_solve, lapack

from ....arrays import Array, BoolArray, IntArray
from ..sparse_cholesky.coordinates import pairs
from ..sparse_cholesky.information_matrix import InformationMatrix
from ..sparse_cholesky.landmark_elimination import LandmarkElimination, RestFactor
from ..sparse_cholesky.schur_complement import SchurComplement, eliminate_subset
from .conditional_pose import ConditionalPose, MapMeasurement


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
        """Return what takes back later changes of means, information and order."""
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

    slots: IntArray
    """O."""
    response: Array
    """W = Λ_OH T, shape (2o, c): their residual is b + W δ_B."""
    residual: Array
    """b when the local map was chosen, shape (2o,)."""
    scale: Array
    """Inverse Cholesky factors of their diagonal blocks, shape (o, 2, 2)."""

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
    points: Array
    """Means, shape (2k,) [m]."""
    first: Array
    """First estimates, shape (2k,) [m]."""
    information: Array
    """Λ_LL, shape (2k, 2k)."""
    start: Array
    """Means of the border when L was chosen, shape (c,)."""
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
    ) -> tuple["LocalInformation", ConditionalPose]:
        """Add information, Λ ← Λ + Yᵀ Y, and move map and pose to the new mean."""
        Y = measurement.rows
        added = replace(self, information=self.information + Y.T @ Y)
        return added.settle(pose, Y.T @ measurement.innovation)

    def settle(
        self, pose: ConditionalPose, residual: Array
    ) -> tuple["LocalInformation", ConditionalPose]:
        """Move the map by δ = (Λ_LL − C)⁻¹ b, and the pose by K δ."""
        if not residual.any():
            return self, pose
        delta = cho_solve(self.solver(), residual, check_finite=False)
        moved = pose._replace(mean=pose.mean + pose.gain @ delta)
        return replace(self, points=self.points + delta), moved

    def extended(self, slots: IntArray, points: Array) -> "LocalInformation":
        """Append landmarks without information, at these points."""
        return replace(
            self,
            slots=np.concatenate([self.slots, slots]),
            points=np.concatenate([self.points, points]),
            first=np.concatenate([self.first, points]),
            information=np.pad(self.information, (0, 2 * len(slots))),
        )

    def without(self, gone: BoolArray, information: Array) -> "LocalInformation":
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
