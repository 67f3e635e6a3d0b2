"""The beliefs of one estimator at every step of one run, as plain arrays."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...arrays import Array
from ...estimator.models.rigid_motion import ErrorFrame
from ...evaluation.trajectory_error import landmark_covariances

Integers = NDArray[np.integer]


class MapEstimate(NamedTuple):
    """The landmarks in the map at one step, in the order of the state."""

    ids: Integers
    """Shape (k,)."""
    means: Array
    """Shape (k, 2) [m]."""
    covariances: Array
    """Shape (k, 2, 2) [m²]."""


@dataclass(frozen=True, eq=False)
class RunTrace:
    """One estimator's run over one log, for steps k = 0 … K.

    Step 0 is the start and its scan, before any motion. "Predicted" means before the
    scan of a step, "updated" after it.

    Raises
    ------
    ValueError
        If the shapes do not match.
    """

    estimator: str
    """Name for titles."""
    t: Array
    """Times, shape (K + 1,) [`time_unit`]."""
    predicted_poses: Array
    """Poses (x, y, θ) before the scans, shape (K + 1, 3) [m, m, rad]."""
    predicted_pose_covariances: Array
    """Shape (K + 1, 3, 3)."""
    poses: Array
    """Updated poses, shape (K + 1, 3) [m, m, rad]."""
    pose_covariances: Array
    """Shape (K + 1, 3, 3)."""
    true_poses: Array | None
    """Shape (K + 1, 3), nan where unknown; None without ground truth."""
    nis: Array
    """Normalised innovation squared of each scan, shape (K + 1,)."""
    nis_dof: Integers
    """Its degrees of freedom, 0 where nothing was corrected, shape (K + 1,)."""
    landmark_ids: Integers
    """Ids of the final map in the order of the state, shape (n,)."""
    landmarks: Array
    """Final means, shape (n, 2) [m]."""
    first_landmarks: Array
    """Means when each landmark entered the map, shape (n, 2) [m]."""
    first_landmark_covariances: Array
    """Covariances when each landmark entered the map, shape (n, 2, 2) [m²]."""
    landmark_history: Sequence[tuple[Integers, Array, Array]]
    """The map after each step, K + 1 times (ids, means, covariances)."""
    true_landmarks: Array | None
    """Shape (n, 2), nan where unknown; None without ground truth."""
    first_covariance: Array
    """Covariance of the state right after the first scan that added landmarks."""
    final_covariance: Array
    """Covariance of the state at the end, shape (3 + 2n, 3 + 2n)."""
    time_unit: str = "s"
    """Unit of `t` for labels; simulated logs count "steps"."""
    frame: ErrorFrame = "additive"
    """Coordinates of the estimator's Gaussian error."""

    def __post_init__(self) -> None:
        steps, n = len(self.t), len(self.landmark_ids)
        if steps == 0:
            raise ValueError("t must hold at least one step, got none")
        if len(self.landmark_history) != steps:
            raise ValueError(
                f"landmark_history must have {steps} entries, "
                f"got {len(self.landmark_history)}"
            )
        for name, shape in _shapes(steps, n).items():
            value = getattr(self, name)
            if value is not None and np.shape(value) != shape:
                raise ValueError(
                    f"{name} must have shape {shape}, got {np.shape(value)}"
                )

    @property
    def last_step(self) -> int:
        """K, the number of motions."""
        return len(self.t) - 1

    @property
    def landmark_covariances(self) -> Array:
        """Final covariance of each landmark, shape (n, 2, 2) [m²]."""
        return landmark_covariances(self.final_covariance)

    def map_at(self, step: int) -> MapEstimate:
        """Return the map after a step."""
        return MapEstimate(*self.landmark_history[step])

    def first_steps(self) -> Integers:
        """Return the step at which each landmark of the final map first appears."""
        first = dict.fromkeys(self.landmark_ids.tolist(), self.last_step)
        for step in range(self.last_step, -1, -1):
            ids = self.map_at(step).ids.tolist()
            first.update({i: step for i in ids if i in first})
        return np.array(list(first.values()), dtype=np.int64)


def _shapes(steps: int, n: int) -> dict[str, tuple[int, ...]]:
    size = 3 + 2 * n
    return {
        "t": (steps,),
        "predicted_poses": (steps, 3),
        "predicted_pose_covariances": (steps, 3, 3),
        "poses": (steps, 3),
        "pose_covariances": (steps, 3, 3),
        "true_poses": (steps, 3),
        "nis": (steps,),
        "nis_dof": (steps,),
        "landmarks": (n, 2),
        "first_landmarks": (n, 2),
        "first_landmark_covariances": (n, 2, 2),
        "true_landmarks": (n, 2),
        "final_covariance": (size, size),
    }
