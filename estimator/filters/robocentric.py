"""Robocentric EKF-SLAM: the map is estimated in the robot's frame."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from ... import argument_checks
from ...argument_checks import LandmarkIds
from ...arrays import Array, IntArray
from ...jit import jit_in_place, njit_internal
from ..beliefs import Belief, MapView, part_of
from ..guards import saved_states
from ..kernels.scan_update import DONE
from ..models.rigid_motion import as_covariance
from ..models.sensors import only_placing
from .ekf import EkfSlam
from .gaussian_map import LANDMARKS, complete, parts_jit, update_map
from .pose_readings import ObservedMap, PoseReading, observe

# The state that the kernels see, in the robot's frame at the last scan: the motion
# since that scan in place of the pose; the start (x, y), the world's heading and a zero
# in place of the first two landmarks; then the landmarks.  The start is where the robot
# was expected at first, a point of the world near the drive.  The world's origin may
# lie so far away that the smallest turn moves it by more than the map's uncertainty.
# The start's place in the world is the reference of the first landmark.
ORIGIN, HEADING, FIRST_LANDMARK = 3, 5, 7
RESERVED = (-(2**63), 1 - 2**63)  # ids of these two places
TAKEN = -5  # status of an update with one of these ids


@jit_in_place
def update_and_move(block: Array, readings: Array, ids: IntArray) -> int:
    """Update a map with a scan as `update_map`, then move the frame to the robot."""
    for landmark_id in ids:
        if landmark_id <= RESERVED[1]:
            return TAKEN
    status = update_map(block, readings, ids)
    if status == DONE and len(ids) > 0:
        parts = parts_jit(block)
        size = 3 + 2 * parts.numbers[LANDMARKS]
        complete(block)
        move_frame(parts.mean, parts.covariance, size)
    return status


class RobocentricEkfSlam(EkfSlam):
    """EKF-SLAM with the start and the landmarks estimated in the robot's frame.

    The method is that of Castellanos et al. [1]_.  Between scans, the filter estimates
    only the motion w = (x, y, θ) since the last scan, which starts at zero without
    uncertainty.  A scan is linearised at w and at the map in the frame of the last
    scan.  Then the frame moves to the robot.  Every point q and the world's heading φ
    in the robot's frame become::

        q ← R(−θ_w) (q − (x_w, y_w)),    φ ← φ − θ_w,    w ← 0

    Therefore no Jacobian depends on an absolute pose.  The heading remains consistent;
    in long loops, the covariance of the map is too small.  Beliefs are in the world's
    frame.

    Parameters are those of :class:`EkfSlam`.

    References
    ----------
    .. [1] J. Castellanos, R. Martinez-Cantin, J. Tardós, J. Neira, Robocentric map
       joining: improving the consistency of EKF-SLAM, Robotics and Autonomous Systems
       55(1), 2007.
    """

    update_kernel = staticmethod(update_and_move)
    _refusals: ClassVar = {TAKEN: f"landmark_ids must be above {RESERVED[1]}"}

    def reset(self, pose: ArrayLike, pose_std: ArrayLike) -> None:
        """Start a new run, without a map, at a pose (3,) with deviations (3,)."""
        only_placing(self.sensor, "the robocentric filter")
        first = argument_checks.finite_vector("pose", pose, 3)
        std = argument_checks.standard_deviations("pose_std", pose_std, 3)
        c, s = np.cos(first[2]), np.sin(first[2])
        jacobian = np.array([[-c, -s, 0.0], [s, -c, 0.0], [0.0, 0.0, -1.0]])
        mean, reference = np.zeros(FIRST_LANDMARK), np.zeros(FIRST_LANDMARK)
        covariance = np.zeros((FIRST_LANDMARK, FIRST_LANDMARK))
        world = slice(ORIGIN, HEADING + 1)
        mean[HEADING], reference[:3] = -first[2], first
        reference[ORIGIN:HEADING] = first[:2]
        moved = as_covariance(jacobian @ np.diag(std**2) @ jacobian.T)
        covariance[world, world] = moved
        state = {"mean": mean, "covariance": covariance, "reference": reference}
        self.map.restore(state | {"landmark_ids": np.array(RESERVED)})

    def _observe(
        self, given: PoseReading, mean: Array, covariance: Array
    ) -> ObservedMap:
        """Correct the state; the pose in the world is a function of it."""
        whole, jacobian = _in_world(mean, self._start)
        H, nu = given.matrix @ jacobian[:3], given.innovation(whole[:3])
        return observe(mean, covariance, H, given.covariance, nu)

    @property
    def _start(self) -> Array:
        """Where the start lies in the world, shape (2,) [m]."""
        return self.map.reference[ORIGIN:HEADING]

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from a saved state, bit for bit in a filter of the same settings."""
        saved_states.refuse_other_state(state, ["landmark_ids"])
        ids = saved_states.landmark_ids("landmark_ids", state["landmark_ids"])
        if tuple(ids[: len(RESERVED)]) != RESERVED:
            raise ValueError("state must begin with the world's origin, got landmarks")
        super().load_state_dict(state)

    def belief(self, landmark_ids: LandmarkIds | None = None) -> Belief:
        """Return the belief in the world's frame, as `EkfSlam.belief`."""
        n, ids = self.map.size, self.landmark_ids
        mean, jacobian = _in_world(self.map.mean[:n], self._start)
        moved = as_covariance(jacobian @ self.map.covariance[:n, :n] @ jacobian.T)
        whole = Belief(mean, moved, ids)
        if landmark_ids is None:
            return whole
        chosen = argument_checks.mapped_identities(landmark_ids, dict.fromkeys(ids, 0))
        return part_of(whole, chosen, whole.frame)

    def map_view(self) -> MapView:
        """Return pose and map in the world's frame; a copy."""
        whole = self.belief()
        return MapView(whole.mean, whole.covariance, whole.landmark_ids)

    @property
    def landmark_ids(self) -> tuple[int, ...]:
        """The mapped landmarks, in the order of the belief."""
        return tuple(self.map.slots)[len(RESERVED) :]


@jit_in_place
def move_frame(mean: Array, covariance: Array, size: int) -> None:
    """Move the frame to the robot: x ← f(x), P ← T P Tᵀ, in O(size²).

    T subtracts the rows of (x_w, y_w) from every pair of rows, rotates the pair by
    −θ_w, and subtracts J q⁺ times the row of θ_w.
    """
    c, s = np.cos(mean[2]), np.sin(mean[2])
    for i in range(ORIGIN, size, 2):
        if i != HEADING:
            x, y = mean[i] - mean[0], mean[i + 1] - mean[1]
            mean[i], mean[i + 1] = c * x + s * y, c * y - s * x
    mean[HEADING] -= mean[2]
    _turn_rows(mean, covariance, size, c, s)
    _transpose(covariance, size)
    _turn_rows(mean, covariance, size, c, s)
    for i in range(size):
        for j in range(i):
            covariance[j, i] = covariance[i, j]
    for i in range(3):
        mean[i] = 0.0
        for j in range(size):
            covariance[i, j] = covariance[j, i] = 0.0


@njit_internal
def _transpose(covariance: Array, size: int) -> None:
    for i in range(size):
        for j in range(i):
            covariance[i, j], covariance[j, i] = covariance[j, i], covariance[i, j]


@njit_internal
def _turn_rows(mean: Array, covariance: Array, size: int, c: float, s: float) -> None:
    """P ← T P, except for the rows of the motion, which become zero."""
    for i in range(ORIGIN, size, 2):
        if i == HEADING:
            for j in range(size):
                covariance[i, j] -= covariance[2, j]
            continue
        x, y = mean[i], mean[i + 1]
        for j in range(size):
            p, q = (
                covariance[i, j] - covariance[0, j],
                covariance[i + 1, j] - covariance[1, j],
            )
            covariance[i, j] = c * p + s * q + y * covariance[2, j]
            covariance[i + 1, j] = c * q - s * p - x * covariance[2, j]


def _in_world(state: Array, start: Array) -> tuple[Array, Array]:
    """Transform a robocentric state to the world's frame; return its Jacobian too.

    With the start at s in the world and at o in the robot's frame, a point q lies at
    s + R(−φ) (q − o), and the robot's heading is θ_w − φ.
    """
    origin, heading = state[ORIGIN:HEADING], state[HEADING]
    c, s = np.cos(heading), np.sin(heading)
    turn = np.array([[c, s], [-s, c]])
    points = np.concatenate([state[None, :2], state[FIRST_LANDMARK:].reshape(-1, 2)])
    moved = (points - origin) @ turn.T
    places = moved + start
    mean = np.concatenate([places[0], [state[2] - heading], places[1:].ravel()])
    jacobian = np.zeros((len(mean), len(state)))
    jacobian[2, 2], jacobian[2, HEADING] = 1.0, -1.0
    for k, (x, y) in enumerate(moved):
        row = 3 + 2 * (k - 1) if k else 0
        column = FIRST_LANDMARK + 2 * (k - 1) if k else 0
        jacobian[row : row + 2, column : column + 2] = turn
        jacobian[row : row + 2, ORIGIN:HEADING] = -turn
        jacobian[row : row + 2, HEADING] = y, -x
    return mean, jacobian
