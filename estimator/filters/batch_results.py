"""What a batch of runs returns: traces, beliefs and views of its arrays."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ...arrays import Array, BoolArray, IntArray
from ..belief import Belief
from ..models.angles import wrap_angle


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

    @classmethod
    def empty(cls, runs: int, steps: int) -> BatchTrace:
        """Return a trace of runs that have not begun: nan, and zero degrees."""
        return cls(
            np.full((runs, steps, 3), np.nan),
            np.full((runs, steps, 3, 3), np.nan),
            np.full((runs, steps), np.nan),
            np.zeros((runs, steps), dtype=np.int64),
        )


class BatchBeliefs(NamedTuple):
    """The present belief of every run; the states are (x, y, θ, l0x, l0y, …)."""

    means: Array
    """Shape (B, 3 + 2L), landmarks by id, zeros where not mapped; θ in [-π, π)."""
    covariances: Array
    """Of the additive error, shape (B, 3 + 2L, 3 + 2L), zeros where not mapped."""
    mapped: BoolArray
    """Which landmarks are in the map, shape (B, L)."""

    @classmethod
    def of(cls, beliefs: Sequence[Belief], landmarks: int) -> BatchBeliefs:
        """Return beliefs of single filters with L landmarks, whose ids are 0 … L−1.

        Raises
        ------
        ValueError
            If a belief has a landmark with another id.
        """
        count, size = len(beliefs), 3 + 2 * landmarks
        means, covariances = np.zeros((count, size)), np.zeros((count, size, size))
        mapped = np.zeros((count, landmarks), dtype=np.bool_)
        for run, belief in enumerate(beliefs):
            ids = belief.landmark_ids
            if not all(0 <= i < landmarks for i in ids):
                raise ValueError(
                    f"landmark ids must be below landmarks = {landmarks}, got {ids}"
                )
            at = [0, 1, 2, *(3 + 2 * i + axis for i in ids for axis in (0, 1))]
            means[run, at], mapped[run, list(ids)] = belief.mean, True
            covariances[run][np.ix_(at, at)] = belief.covariance
        return cls(means, covariances, mapped)

    @property
    def poses(self) -> Array:
        """(x, y, θ), shape (B, 3) [m, m, rad]."""
        return self.means[:, :3]

    @property
    def landmarks(self) -> Array:
        """Positions, shape (B, L, 2) [m], zeros where not mapped."""
        return self.means[:, 3:].reshape(len(self.means), -1, 2)

    @property
    def landmark_covariances(self) -> Array:
        """Marginal covariance of each landmark, shape (B, L, 2, 2) [m²]."""
        count = self.mapped.shape[1]
        blocks = self.covariances[:, 3:, 3:].reshape(-1, count, 2, count, 2)
        each = np.arange(count)
        return np.moveaxis(blocks[:, each, :, each, :], 0, 1)


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

    def beliefs(self) -> BatchBeliefs:
        """Return the beliefs with the landmarks by id, as a snapshot."""
        runs, mapped = len(self.slots), self.slots >= 0
        places = 3 + 2 * np.where(mapped, self.slots, 0)
        pose = np.broadcast_to(np.arange(3), (runs, 3))
        pairs = (places[:, :, None] + np.arange(2)).reshape(runs, -1)
        at = np.concatenate([pose, pairs], axis=1)
        held = np.ones(at.shape, dtype=np.bool_)
        held[:, 3:] = np.repeat(mapped, 2, axis=1)
        row = np.arange(runs)[:, None]
        means = self.means[row, at] * held
        covariances = self.covariances[row[:, :, None], at[:, :, None], at[:, None]]
        covariances *= held[:, :, None] & held[:, None]
        means[:, 2] = wrap_angle(means[:, 2])
        return BatchBeliefs(means, covariances, mapped)
