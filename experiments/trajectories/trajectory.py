"""One drive as arrays: what the robot was told, what it read, and the truth."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...sim_configs import Scenario

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Trajectory:
    """One episode of T steps: T + 1 scans, the first before any motion.

    N landmarks, M rows of readings (N, or more where identities are hidden). What is
    None, the file that the trajectory was read from does not hold.

    Attributes
    ----------
    scenario : Scenario
        The world as it was, all ranges drawn.
    controller : str
        Name of the controller that drove.
    seed : int
        Of the world.
    start_estimate : ndarray, shape (3,)
        Pose that a filter starts from [m, m, rad].
    odometry : ndarray, shape (T, 2)
        (d, α) read after each step [m, rad].
    poses : ndarray, shape (T + 1, 3)
        True (x, y, θ) [m, m, rad], θ not wrapped.
    landmarks : ndarray, shape (N, 2), or None
        True positions [m].
    actions : ndarray, shape (T, 2), or None
        (v, ω) commanded in each step [m/s, rad/s].
    measurements : ndarray, shape (T + 1, M, 2), or None
        Rows (β, r), zeros where unseen [rad, m].
    mask : bool ndarray, shape (T + 1, M), or None
        Rows that hold a measurement.
    collisions : bool ndarray, shape (T,), or None
        Whether a wall held the robot back in each step.
    landmark_ids : int64 ndarray, shape (T + 1, M), or None
        With hidden identities: the true landmark of each row, -1 for clutter and empty
        rows. With known ones always None: row i is landmark i.
    """

    scenario: Scenario
    controller: str
    seed: int
    start_estimate: Array
    odometry: Array
    poses: Array
    landmarks: Array | None = None
    actions: Array | None = None
    measurements: Array | None = None
    mask: NDArray[np.bool_] | None = None
    collisions: NDArray[np.bool_] | None = None
    landmark_ids: NDArray[np.int64] | None = None

    @property
    def steps(self) -> int:
        """T, the number of steps."""
        return len(self.odometry)


ARRAYS = (
    "start_estimate",
    "odometry",
    "poses",
    "landmarks",
    "actions",
    "measurements",
    "mask",
    "collisions",
    "landmark_ids",
)
"""The names of all arrays of a trajectory."""


def array_of(trajectory: Trajectory, name: str) -> NDArray[Any]:
    """Return an array that a trajectory must have to be written.

    Raises
    ------
    ValueError
        If it has none.
    """
    value = getattr(trajectory, name)
    if value is None:
        raise ValueError(
            f"the trajectory of seed {trajectory.seed} must have {name} to be written "
            "in this format, got None"
        )
    array: NDArray[Any] = value
    return array


def arrays_to_write(trajectories: Sequence[Trajectory]) -> tuple[str, ...]:
    """Name the arrays of trajectories: all, but landmark_ids with hidden ids only."""
    hidden = not trajectories[0].scenario.sensor.identities
    return ARRAYS if hidden else ARRAYS[:-1]
