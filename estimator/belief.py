"""Beliefs over robot pose and map: a snapshot to keep, and a view to look at."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike

from ..arrays import Array
from .error_frames import (
    ErrorFrame,
    additive_error,
    invariant_covariance,
    invariant_error,
)
from .models.angles import wrap_angle


@dataclass(frozen=True, eq=False, repr=False)
class Belief:
    """A Gaussian belief over robot pose and map: a snapshot, safe to keep.

    The state is (x, y, θ, l1x, l1y, …), landmarks in the order of ``landmark_ids``.
    """

    mean: Array
    """Shape (3 + 2n,), heading in [-π, π); a column may be given."""
    covariance: Array
    """Shape (3 + 2n, 3 + 2n), of the additive error."""
    landmark_ids: tuple[int, ...]
    """Given as any sequence or array, kept as a tuple."""
    frame: ErrorFrame = "additive"
    """Coordinates in which the filter takes its error to be Gaussian."""

    def __post_init__(self) -> None:
        mean = np.array(self.mean, dtype=np.float64).ravel()
        covariance = np.array(self.covariance, dtype=np.float64)
        ids: Any = self.landmark_ids
        ids = tuple(ids.tolist() if isinstance(ids, np.ndarray) else ids)
        object.__setattr__(self, "landmark_ids", ids)
        size = 3 + 2 * len(ids)
        if mean.shape != (size,) or covariance.shape != (size, size):
            raise ValueError(
                f"a belief with {len(ids)} landmarks has mean ({size},) "
                f"and covariance ({size}, {size}), got {mean.shape} and "
                f"{covariance.shape}"
            )
        self._chosen(self.frame)
        mean[2] = wrap_angle(float(mean[2]))
        mean.flags.writeable = covariance.flags.writeable = False
        object.__setattr__(self, "mean", mean)
        object.__setattr__(self, "covariance", covariance)

    @classmethod
    def marginal(
        cls,
        mean: Array,
        covariance: Array,
        slots: Mapping[int, int],
        landmark_ids: Sequence[int],
        frame: ErrorFrame = "additive",
    ) -> Belief:
        """Return the belief over the pose and some landmarks of a larger state.

        Parameters
        ----------
        mean, covariance : ndarray
            The state; there may be room behind it.
        slots : mapping from id to int
            Place of each landmark in the state: column 3 + 2 slot.
        landmark_ids : sequence of int
            The landmarks of the belief, in its order.
        frame : {"additive", "invariant"}
            Coordinates in which the filter takes its error to be Gaussian.
        """
        firsts = [3 + 2 * slots[i] for i in landmark_ids]
        columns = [0, 1, 2, *(first + axis for first in firsts for axis in (0, 1))]
        P = covariance[np.ix_(columns, columns)]
        return cls(mean[columns], P, tuple(landmark_ids), frame)

    @property
    def pose(self) -> Array:
        """(x, y, θ), shape (3,) [m, m, rad]."""
        return self.mean[:3]

    @property
    def pose_covariance(self) -> Array:
        """Shape (3, 3)."""
        return self.covariance[:3, :3]

    @property
    def landmarks(self) -> Array:
        """Positions, shape (n, 2) [m]."""
        return self.mean[3:].reshape(-1, 2)

    @property
    def landmark_covariances(self) -> Array:
        """Marginal covariance of each landmark, shape (n, 2, 2) [m²]."""
        n = len(self.landmark_ids)
        blocks = self.covariance[3:, 3:].reshape(n, 2, n, 2)
        return blocks[np.arange(n), :, np.arange(n), :]

    def error(
        self, true_pose: ArrayLike, true_landmarks: ArrayLike, frame: str | None = None
    ) -> Array:
        """Return the error of this belief against the truth.

        Parameters
        ----------
        true_pose : array_like, shape (3,)
            (x, y, θ) [m, m, rad].
        true_landmarks : array_like, shape (n, 2)
            In the order of ``landmark_ids`` [m].
        frame : {"additive", "invariant"}, optional
            Error coordinates; the filter's own where not given.

        Returns
        -------
        ndarray, shape (3 + 2n,)
            In the order of the state; its covariance is :meth:`error_covariance` of
            the same frame.
        """
        truth = np.concatenate([np.ravel(true_pose), np.ravel(true_landmarks)])
        if truth.shape != self.mean.shape:
            raise ValueError(
                f"the truth must be a pose (3,) and {len(self.landmark_ids)} landmarks "
                f"(n, 2), got {np.shape(true_pose)} and {np.shape(true_landmarks)}"
            )
        if self._chosen(frame) == "invariant":
            return invariant_error(truth, self.mean)
        return additive_error(truth, self.mean)

    def error_covariance(self, frame: str | None = None) -> Array:
        """Return the covariance (3 + 2n, 3 + 2n) that belongs to :meth:`error`."""
        if self._chosen(frame) == "invariant":
            return invariant_covariance(self.mean, self.covariance)
        return self.covariance

    def __repr__(self) -> str:
        n = len(self.landmark_ids)
        return f"Belief of {describe_map(n, self.pose, self.pose_covariance)}"

    def _chosen(self, frame: str | None) -> str:
        chosen = self.frame if frame is None else frame
        if chosen not in ("additive", "invariant"):
            raise ValueError(f"frame must be 'additive' or 'invariant', got {chosen!r}")
        return chosen


def describe_map(landmarks: int, pose: Array, pose_covariance: Array) -> str:
    """Return a pose with its standard deviations and a number of landmarks in words.

    Examples
    --------
    >>> describe_map(6, np.array([1.0, 2.0, 0.5]), np.diag([0.01, 0.04, 0.0004]))
    '6 landmarks, pose (1.000 ± 0.100 m, 2.000 ± 0.200 m, 0.500 ± 0.020 rad)'
    """
    std = np.sqrt(pose_covariance.diagonal().clip(0.0))
    x, y, heading = (f"{p:.3f} ± {s:.3f}" for p, s in zip(pose, std, strict=True))
    noun = "landmark" if landmarks == 1 else "landmarks"
    return f"{landmarks} {noun}, pose ({x} m, {y} m, {heading} rad)"


class _HasMarginals(Protocol):
    @property
    def landmark_ids(self) -> Sequence[int]: ...

    def belief(self, landmark_ids: Sequence[int] | None = None) -> Belief: ...


def describe_filter(slam: _HasMarginals) -> str:
    """Return class, number of landmarks and pose of a filter: its ``__repr__``."""
    pose = slam.belief([])
    found = describe_map(len(slam.landmark_ids), pose.pose, pose.pose_covariance)
    return f"{type(slam).__name__} of {found}"


class MapView(NamedTuple):
    """The present belief of a filter, without a copy: not to keep or to change."""

    mean: Array
    """In the order of the state; there may be room behind it."""
    covariance: Array
    """Of the additive error; there may be room behind it."""
    ids: Sequence[int]
    """Landmarks in the order of the state."""
    whole: Sequence[int] | None = None
    """All landmarks in the map, where the view holds only those around the robot."""

    @property
    def mapped(self) -> Sequence[int]:
        """All landmarks in the map, in its order."""
        return self.ids if self.whole is None else self.whole

    @property
    def landmarks(self) -> Array:
        """Positions, shape (n, 2) [m]."""
        return self.mean[3 : 3 + 2 * len(self.ids)].reshape(-1, 2)

    @property
    def landmark_covariances(self) -> Array:
        """Marginal covariance of each landmark, shape (n, 2, 2) [m²]."""
        columns = np.arange(3, 3 + 2 * len(self.ids)).reshape(-1, 2)
        return self.covariance[columns[:, :, None], columns[:, None, :]]
