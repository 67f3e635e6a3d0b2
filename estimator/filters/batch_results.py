"""What a batch of runs returns: traces, beliefs and views of its arrays."""

from __future__ import annotations

from typing import NamedTuple

from ...arrays import Array, BoolArray, IntArray


class BatchTrace(NamedTuple):
    """The belief of every run about its pose, after every step; B runs, T steps."""

    poses: Array
    """(x, y, θ), shape (B, T, 3) [m, m, rad], heading in [-π, π)."""
    pose_covariances: Array
    """Shape (B, T, 3, 3)."""
    nis: Array
    """νᵀ S⁻¹ ν of each scan, shape (B, T)."""
    degrees_of_freedom: IntArray
    """Of the NIS, shape (B, T)."""


class BatchBeliefs(NamedTuple):
    """The present belief of every run; the states are (x, y, θ, l0x, l0y, …)."""

    means: Array
    """Shape (B, 3 + 2L), landmarks by id, zeros where not mapped; θ in [-π, π)."""
    covariances: Array
    """Of the additive error, shape (B, 3 + 2L, 3 + 2L), zeros where not mapped."""
    mapped: BoolArray
    """Which landmarks are in the map, shape (B, L)."""


class BatchStorage(NamedTuple):
    """The arrays that hold the beliefs of all runs: live and read-only.

    Entries beyond the mapped landmarks are arbitrary.
    """

    means: Array
    """Shape (B, capacity): (x, y, θ), then the landmarks by slot; θ is not wrapped."""
    covariances: Array
    """Of the additive error, shape (B, capacity, capacity)."""
    slots: IntArray
    """Shape (B, L): landmark i has column 3 + 2 slots[i]; -1 where not mapped."""

    @classmethod
    def of(cls, means: Array, covariances: Array, slots: IntArray) -> BatchStorage:
        """Return read-only views of the arrays."""
        views = means.view(), covariances.view(), slots.view()
        for view in views:
            view.flags.writeable = False
        return cls(*views)
