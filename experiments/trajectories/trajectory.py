"""One drive as arrays: actions, readings, and the truth."""

import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from functools import lru_cache

import numpy as np

from ...arrays import AnyArray, Array, BoolArray, IntArray
from ...sim_configs import Scenario, load_scenario


@dataclass(frozen=True, eq=False)
class Trajectory:
    """One episode of T steps: T + 1 scans, the first before any motion.

    There are N landmarks and M rows of readings: N, or more if identities are hidden.
    An array is None if the file of the trajectory does not hold it.

    Attributes
    ----------
    scenario : Scenario
        The world, with all ranges drawn.
    controller : str
        Name of the controller.
    seed : int
        Seed of the world.
    start_estimate : ndarray, shape (3,)
        Initial pose of filters [m, m, rad].
    odometry : ndarray, shape (T, 2)
        (d, α) read after each step [m, rad].
    poses : ndarray, shape (T + 1, 3)
        True (x, y, θ) [m, m, rad], θ not wrapped.
    landmarks : ndarray, shape (N, 2), or None
        True positions [m].
    actions : ndarray, shape (T, 2), or None
        Command (v, ω) of each step [m/s, rad/s].
    measurements : ndarray, shape (T + 1, M, 2), or None
        Rows (β, r), zeros where unseen [rad, m].
    mask : bool ndarray, shape (T + 1, M), or None
        Rows that hold a measurement.
    collisions : bool ndarray, shape (T,), or None
        Whether a wall stopped the robot in each step.
    landmark_ids : int64 ndarray, shape (T + 1, M), or None
        For hidden identities, the true landmark of each row, -1 for clutter and empty
        rows. For known identities None: row i is landmark i.
    belief_poses : ndarray, shape (T + 1, 3), or None
        Of a filter after each scan [m, m, rad]; see `with_beliefs`.
    belief_pose_covariances : ndarray, shape (T + 1, 3, 3), or None
        Of the additive error, as everywhere.
    belief_landmarks : ndarray, shape (T + 1, M, 2), or None
        Of its map, zeros in empty rows [m].
    belief_landmark_covariances : ndarray, shape (T + 1, M, 2, 2), or None
        Of each landmark alone [m²].
    belief_landmark_ids : int64 ndarray, shape (T + 1, M), or None
        The filter's landmark of each row, -1 in empty rows. For known identities row i
        is landmark i.
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
    mask: BoolArray | None = None
    collisions: BoolArray | None = None
    landmark_ids: IntArray | None = None
    belief_poses: Array | None = None
    belief_pose_covariances: Array | None = None
    belief_landmarks: Array | None = None
    belief_landmark_covariances: Array | None = None
    belief_landmark_ids: IntArray | None = None

    @property
    def steps(self) -> int:
        """T, the number of steps."""
        return len(self.odometry)


_NAMES = tuple(field.name for field in fields(Trajectory))
#: The names of the arrays of a drive.
ARRAYS = _NAMES[_NAMES.index("start_estimate") : _NAMES.index("belief_poses")]
#: The names of the arrays of what a filter believes during it.
BELIEFS = _NAMES[_NAMES.index("belief_poses") :]


@lru_cache(maxsize=8)
def scenario_from_text(text: str) -> Scenario:
    """Parse a scenario from the TOML in a file of trajectories."""
    return load_scenario(tomllib.loads(text))


def array_of(trajectory: Trajectory, name: str) -> AnyArray:
    """Return an array of a trajectory that its format requires.

    Raises
    ------
    ValueError
        If the trajectory lacks it.
    """
    value = getattr(trajectory, name)
    if value is None:
        raise ValueError(
            f"the trajectory of seed {trajectory.seed} must have {name}, got None: "
            "the format of its data set may not hold it"
        )
    array: AnyArray = value
    return array


def arrays_to_write(trajectories: Sequence[Trajectory]) -> tuple[str, ...]:
    """Return the names of the arrays; landmark_ids only if identities are hidden."""
    names = ARRAYS[:-1] if trajectories[0].scenario.sensor.identities else ARRAYS
    return names if trajectories[0].belief_poses is None else (*names, *BELIEFS)


def belief_rows(trajectory: Trajectory) -> dict[str, AnyArray]:
    """Return the arrays of beliefs with one row per moment, (T + 1, …); {} of none.

    `belief_arrays` is the inverse.
    """
    if trajectory.belief_poses is None:
        return {}
    arrays = {name: array_of(trajectory, name) for name in BELIEFS}
    return {name: array.reshape(len(array), -1) for name, array in arrays.items()}


def belief_arrays(rows: Mapping[str, AnyArray]) -> dict[str, AnyArray]:
    """Return the arrays of beliefs, from rows that hold them all or none."""
    if BELIEFS[0] not in rows:
        return {}
    scans, landmarks = rows["belief_landmark_ids"].shape
    shapes = (3,), (3, 3), (landmarks, 2), (landmarks, 2, 2), (landmarks,)
    return {
        name: np.asarray(rows[name]).reshape(scans, *shape)
        for name, shape in zip(BELIEFS, shapes, strict=True)
    }
