"""The landmarks around the robot, with all that the rest of the map means for them."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_solve, lapack

from ..sparse_cholesky.coordinates import pairs
from ..sparse_cholesky.information_matrix import (
    InformationMatrix,
    Surroundings,
    surround,
)
from ..sparse_cholesky.landmark_elimination import Elimination, surround_all
from .conditional_pose import MapReading, PoseGivenMap

Array = NDArray[np.float64]
Int = NDArray[np.int64]


class Map:
    """Means and information of all landmarks, in the order of their slots.

    The exact mean is m + Λ⁻¹ b: ``residual`` b is what a correction left to do.
    """

    def __init__(self) -> None:
        self.information = InformationMatrix()
        self.elimination = Elimination()
        self.points = np.zeros(0)
        self.first = np.zeros(0)  # where each was found
        self.residual = np.zeros(0)

    def grow(self, count: int) -> None:
        """Make room for so many landmarks."""
        self.information.grow(count)
        if 2 * count > len(self.points):
            more = np.zeros(4 * count - len(self.points))
            self.points = np.append(self.points, more)
            self.first = np.append(self.first, more)
            self.residual = np.append(self.residual, more)


@dataclass(frozen=True)
class Outer:
    """The landmarks beyond the surroundings, held where they are."""

    slots: Int
    response: Array
    """W = Λ_OH T, shape (2o, c): their residual is b + W δ_B."""
    residual: Array
    """b when the local map was chosen, shape (2o,)."""
    scale: Array
    """Inverse Cholesky factors of their own blocks, shape (o, 2, 2)."""

    def residual_after(self, shift: Array) -> Array:
        """Residual after the border moved by δ_B, shape (2o,)."""
        return self.residual + self.response @ shift

    def unrest(self, shift: Array) -> float:
        """Largest residual, as a shift in its own conditional standard deviations."""
        left = self.residual_after(shift).reshape(-1, 2)
        white = np.einsum("oij,oj->oi", self.scale, left)
        return float(np.sqrt((white**2).sum(axis=1).max(initial=0.0)))


@dataclass(frozen=True)
class LocalInformation:
    """Mean and information of the landmarks L near the robot; a value.

    While only they are seen, Λ changes nowhere else, so that C (the complement of the
    :class:`Surroundings`) holds, and all that a full solution would say about L follows
    from the small dense Λ_LL − C.
    """

    slots: Int
    points: Array
    """Means, shape (2k,) [m]."""
    first: Array
    """Their first estimates, shape (2k,) [m]."""
    information: Array
    """Λ_LL, shape (2k, 2k)."""
    start: Array
    """Means of the border when L was chosen, shape (c,)."""
    surroundings: Surroundings
    outer: Outer

    @property
    def shift(self) -> Array:
        """How far the border has moved, δ_B, shape (c,)."""
        return self.points[self.surroundings.border] - self.start

    def solver(self) -> tuple[Array, bool]:
        """Cholesky factor of Λ_LL − C, for :func:`scipy.linalg.cho_solve`."""
        border = self.surroundings.border
        marginal = self.information.copy()
        marginal[np.ix_(border, border)] -= self.surroundings.complement
        factor, failed = lapack.dpotrf(marginal, lower=1, clean=1)
        if failed:
            raise np.linalg.LinAlgError(
                "the information of the map is not positive definite at landmark "
                f"{(failed - 1) // 2} of the local map"
            )
        return factor, True

    def without_factor(self) -> "LocalInformation":
        """Let go of the factor around it, which may be large."""
        return replace(
            self,
            surroundings=self.surroundings._replace(solve=np.copy, respond=np.copy),
        )

    def absorb(
        self, pose: PoseGivenMap, reading: MapReading
    ) -> tuple["LocalInformation", PoseGivenMap]:
        """Add information, Λ ← Λ + Yᵀ Y, and move map and pose to the new mean."""
        added = replace(
            self, information=self.information + reading.rows.T @ reading.rows
        )
        return added.settle(pose, reading.rows.T @ reading.innovation)

    def settle(
        self, pose: PoseGivenMap, residual: Array
    ) -> tuple["LocalInformation", PoseGivenMap]:
        """Move the map by δ = (Λ_LL − C)⁻¹ b, and the pose by K δ."""
        if not residual.any():
            return self, pose
        delta = cho_solve(self.solver(), residual, check_finite=False)
        moved = pose._replace(mean=pose.mean + pose.gain @ delta)
        return replace(self, points=self.points + delta), moved

    def extended(self, slots: Int, points: Array) -> "LocalInformation":
        """Append landmarks of which nothing is known yet, at these points."""
        return replace(
            self,
            slots=np.concatenate([self.slots, slots]),
            points=np.concatenate([self.points, points]),
            first=np.concatenate([self.first, points]),
            information=np.pad(self.information, (0, 2 * len(slots))),
        )


def begin(
    world: Map, pose: PoseGivenMap, slots: Int, reach: float
) -> tuple[LocalInformation, PoseGivenMap]:
    """Take landmarks in hand, the ``reach`` nearest by links eliminated around them.

    ``pose.gain`` must be that of these landmarks.
    """
    matrix = world.information
    around = _eliminated(world, slots, reach)
    columns = pairs(around.slots)
    outer = np.setdiff1d(matrix.neighbours(around.slots), slots)
    waiting = world.residual[columns]
    if waiting.any():
        waiting = around.solve(waiting)
    world.points[columns] += waiting
    world.residual[columns] = 0.0
    rest = matrix.part(outer, around.slots)
    response = np.zeros((0, len(around.border)))
    if len(outer):
        response = np.ascontiguousarray(rest @ around.response)
    outside, inside = pairs(outer), pairs(slots)
    world.residual[outside] -= rest @ waiting
    residual = world.residual[inside].copy()
    residual -= matrix.part(slots, around.slots) @ waiting
    world.residual[inside] = 0.0
    local = LocalInformation(
        slots,
        world.points[inside],
        world.first[inside],
        matrix.dense(slots),
        world.points[inside][around.border],
        around,
        Outer(
            outer,
            response,
            world.residual[outside],
            np.linalg.inv(np.linalg.cholesky(matrix.diagonal(outer))),
        ),
    )
    return local.settle(pose, residual)


def _eliminated(world: Map, slots: Int, reach: float) -> Surroundings:
    """Eliminate the nearest by links, or all where these are as many as there are."""
    matrix = world.information
    if reach >= len(matrix) - len(slots):
        return surround_all(world.elimination, matrix, slots)
    return surround(matrix, slots, matrix.around(slots, reach))


def finish(world: Map, local: LocalInformation) -> None:
    """Hand everything back to the map."""
    world.points[pairs(local.slots)] = local.points
    world.first[pairs(local.slots)] = local.first
    around, shift = local.surroundings, local.shift
    if shift.any():
        world.points[pairs(around.slots)] -= around.respond(shift)
    world.residual[pairs(local.outer.slots)] = local.outer.residual_after(shift)
    world.information.put(local.slots, local.information)
    world.elimination.revise(world.information, world.first, local.slots)


def link_count(world: Map, local: LocalInformation) -> int:
    """Count the blocks of Λ that are not zero, those of the local map as they are."""
    matrix, slots = world.information, local.slots
    k = len(slots)
    blocks = local.information.reshape(k, 2, k, 2)
    now = int(blocks.any(axis=(1, 3)).sum())
    return matrix.block_count - len(matrix.part(slots, slots).indices) + now
