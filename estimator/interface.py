"""What every estimator promises, and what it answers with."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .error_frames import (
    ErrorFrame,
    additive_error,
    invariant_covariance,
    invariant_error,
)
from .models.angles import wrap_angle

Array = NDArray[np.float64]


class UpdateReport(NamedTuple):
    """What one call of :meth:`SlamEstimator.update` did.

    ``innovation`` rows belong to ``associated_ids``; ν and S are those at the prior.
    """

    nis: float = 0.0
    """νᵀ S⁻¹ ν, χ² distributed when the filter is consistent."""
    degrees_of_freedom: int = 0
    """Of the NIS: twice the number of associated readings."""
    associated_ids: tuple[int, ...] = ()
    """Mapped landmarks whose readings corrected the belief."""
    added_ids: tuple[int, ...] = ()
    """Landmarks that entered the map."""
    rejected_ids: tuple[int, ...] = ()
    """Mapped landmarks whose readings the chi-square gate refused."""
    skipped_ids: tuple[int, ...] = ()
    """Readings too close to use (range below ``min_range``)."""
    near_ids: tuple[int, ...] = ()
    """Mapped landmarks within 10 σ of the robot, where linearising is unsafe."""
    innovation: Array = np.empty((0, 2))
    """ν, shape (m, 2), rows (bearing, range) [rad, m]."""
    factor: Array | Callable[[], Array] = np.empty((0, 0))
    """L, shape (2m, 2m), lower triangular, L Lᵀ = S; or a function that gives it."""
    confirmed_ids: tuple[int, ...] = ()
    """Of those added: tentative before, seen often enough now."""
    removed_ids: tuple[int, ...] = ()
    """Landmarks marginalised: missed too often, or beyond the map's capacity."""
    merged_ids: tuple[tuple[int, int], ...] = ()
    """Pairs (kept, gone) of landmarks found to be one."""
    row_ids: tuple[int | None, ...] = ()
    """For each row of the scan the landmark that it was taken for, if any; empty where
    nothing was associated."""
    tentative_rows: tuple[int, ...] = ()
    """Rows of the scan that speak for a landmark not yet confirmed."""
    ambiguous_rows: tuple[int, ...] = ()
    """Rows left out: of more than one landmark perhaps, or too close to tell."""

    @property
    def innovation_factor(self) -> Array:
        """L, shape (2m, 2m): L⁻¹ ν is white, in the order β1, r1, β2, r2."""
        return self.factor() if callable(self.factor) else self.factor

    @property
    def innovation_covariance(self) -> Array:
        """S, shape (2m, 2m), of the innovations in the order β1, r1, β2, r2."""
        factor = self.innovation_factor
        return factor @ factor.T


@dataclass(frozen=True, eq=False)
class Belief:
    """A Gaussian belief over robot pose and map: a snapshot, safe to keep.

    The state is (x, y, θ, l1x, l1y, …), landmarks in the order of ``landmark_ids``.
    """

    mean: Array
    """Shape (3 + 2n,), heading in [-π, π)."""
    covariance: Array
    """Shape (3 + 2n, 3 + 2n), of the additive error."""
    landmark_ids: tuple[int, ...]
    frame: ErrorFrame = "additive"
    """Coordinates in which the filter takes its error to be Gaussian."""

    def __post_init__(self) -> None:
        mean = np.array(self.mean, dtype=np.float64)
        covariance = np.array(self.covariance, dtype=np.float64)
        size = 3 + 2 * len(self.landmark_ids)
        if mean.shape != (size,) or covariance.shape != (size, size):
            raise ValueError(
                f"a belief with {len(self.landmark_ids)} landmarks has mean ({size},) "
                f"and covariance ({size}, {size}), got {mean.shape} and "
                f"{covariance.shape}"
            )
        self._chosen(self.frame)
        mean[2] = wrap_angle(float(mean[2]))
        mean.flags.writeable = covariance.flags.writeable = False
        object.__setattr__(self, "mean", mean)
        object.__setattr__(self, "covariance", covariance)

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

    def _chosen(self, frame: str | None) -> str:
        chosen = self.frame if frame is None else frame
        if chosen not in ("additive", "invariant"):
            raise ValueError(f"frame must be 'additive' or 'invariant', got {chosen!r}")
        return chosen


@runtime_checkable
class SlamEstimator(Protocol):
    """A filter that follows a robot among landmarks, fed step by step.

    Anything with these methods can stand in an experiment or an agent's loop;
    :func:`slamgym.estimator.check_estimator` tells what a class of your own lacks.
    """

    def reset(self, pose: ArrayLike, pose_std: ArrayLike) -> None:
        """Start a new run, the map empty, at a pose (3,) known to (3,) [m, m, rad]."""

    def predict(self, odometry: ArrayLike, dt: float = 1.0) -> None:
        """Move by odometry (d, α) [m, rad], its motion noise counted √dt times."""

    def update(
        self, measurements: ArrayLike, landmark_ids: Sequence[int] | None = None
    ) -> UpdateReport:
        """Take in one scan, rows (bearing, range) [rad, m], all seen at once."""
        ...

    def belief(self) -> Belief:
        """Return the present belief."""
        ...

    def state_dict(self) -> dict[str, Any]:
        """Return everything that :meth:`load_state_dict` needs, as arrays."""
        ...

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from a saved state, bit for bit."""
