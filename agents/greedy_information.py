"""Greedy information gain: try a few motions in the mind, take the best.

For every candidate the estimator itself predicts: it is moved along the motion and
updated with the readings it expects of the mapped landmarks in view, whose innovations
are zero, so that only its covariance changes; then it is set back. To the decrease of
½ log det of the map's covariance is added what new ground may bring: the landmarks
still missing are as likely on any unseen part of the floor as on another, and each one
found decreases the criterion by the logarithm of prior over accuracy::

    value = U(now) - U(after) + missing (new cells / unseen cells) Δ,
    Δ = [ln(σx / accuracy) + ln(σy / accuracy)] / N

Where motions are worth next to nothing, the one that ends nearest to what is missing is
taken.
"""

import math
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from .active_slam import Situation
from .belief_arrays import BeliefArrays, belief_in_rows
from .information_reward import uncertainty

Array = NDArray[np.float64]

_STEPS = 4  # a motion is held in the mind for so many steps
_TURNS = (-1.0, -0.5, -0.2, 0.0, 0.2, 0.5, 1.0)  # of the largest turn rate
_ROOM = 0.5  # kept from walls beside the robot's radius [m]
_NEARNESS = 0.03  # worth of a metre nearer to what is missing [nats per landmark]


class _Restorable(Protocol):
    def state_dict(self) -> dict[str, Any]: ...
    def load_state_dict(self, state: Any) -> None: ...


class GreedyInformation:
    """Take the motion after which the estimator expects to know most."""

    def act(self, situation: Situation) -> Array:
        """Choose (v, ω) [m/s, rad/s]; see `Driver.act`."""
        robot = situation.scenario.robot
        candidates = [
            np.array([robot.max_speed * drive, robot.max_turn_rate * turn])
            for drive, turns in ((1.0, _TURNS), (0.0, (-1.0, 1.0)))
            for turn in turns
        ]
        values = [_value(situation, candidate) for candidate in candidates]
        return candidates[int(np.argmax(values))]


def _value(situation: Situation, action: Array) -> float:
    """Tell what holding an action is worth; -inf where it would hit a wall."""
    poses = _poses_ahead(situation, action)
    moves = action[0] != 0.0
    if moves and not _is_free(situation, poses):
        return -math.inf
    before = _measure(situation, belief_of(situation))
    gain = before - _measure(situation, _belief_after(situation, action, poses))
    return (
        gain
        + _worth_of_new_ground(situation, poses)
        - _NEARNESS * _to_go(situation, poses[-1])
    )


def belief_of(situation: Situation) -> BeliefArrays:
    """Give the present belief in rows."""
    return belief_in_rows(situation.belief, len(situation.known), by_id=True)


def _poses_ahead(situation: Situation, action: Array) -> Array:
    """Drive on from the believed pose; (K, 3)."""
    distance, turn = action * situation.scenario.dt
    x, y, heading = situation.belief.pose
    poses = []
    for _ in range(_STEPS):
        x, y = x + distance * math.cos(heading), y + distance * math.sin(heading)
        heading += turn
        poses.append((x, y, heading))
    return np.array(poses)


def _is_free(situation: Situation, poses: Array) -> bool:
    room = situation.scenario.robot.radius + _ROOM
    return bool(situation.plan.clearance(poses[:, :2]).min() >= room)


def _belief_after(situation: Situation, action: Array, poses: Array) -> BeliefArrays:
    """Let the estimator predict and update in the mind, and set it back."""
    estimator: Any = situation.estimator
    restorable: _Restorable = estimator
    state = restorable.state_dict()
    odometry = action * situation.scenario.dt
    ids = np.array(situation.belief.landmark_ids, dtype=np.int64)
    try:
        for pose in poses:
            estimator.predict(odometry)
            readings = _expected(pose, situation.belief.landmarks)
            seen = _in_view(situation, readings)
            estimator.update(readings[seen], ids[seen].tolist())
        after = belief_in_rows(estimator.belief(), len(situation.known), by_id=True)
    finally:
        restorable.load_state_dict(state)
    return after


def _expected(pose: Array, landmarks: Array) -> Array:
    """Expect readings (β, r) of landmarks (n, 2)."""
    offset = landmarks - pose[:2]
    bearing = np.arctan2(offset[:, 1], offset[:, 0]) - pose[2]
    bearing = (bearing + np.pi) % (2 * np.pi) - np.pi
    return np.column_stack([bearing, np.hypot(offset[:, 0], offset[:, 1])])


def _in_view(situation: Situation, readings: Array) -> NDArray[np.bool_]:
    sensor = situation.scenario.sensor
    near = (readings[:, 1] <= sensor.max_range) & (readings[:, 1] > sensor.min_range)
    return np.asarray(near & (np.abs(readings[:, 0]) <= sensor.field_of_view / 2))


def _worth_of_new_ground(situation: Situation, poses: Array) -> float:
    missing = len(situation.known) - len(situation.belief.landmark_ids)
    unseen = np.count_nonzero(~situation.explored)
    if not missing or not unseen:
        return 0.0
    new = situation.plan.seen_from(poses).any(axis=0) & ~situation.explored
    found = missing * np.count_nonzero(new) / unseen
    worth = sum(math.log(std / situation.accuracy) for std in situation.prior_std)
    return found * worth / len(situation.known)


def _to_go(situation: Situation, pose: Array) -> float:
    """Distance from a pose to the nearest thing missing [m]."""
    belief, plan = situation.belief, situation.plan
    points = [belief.landmarks[~situation.known[list(belief.landmark_ids)]]]
    if len(belief.landmark_ids) < len(situation.known):
        cells = plan.cells[~situation.explored]
        points.append(np.column_stack([cells.real, cells.imag]))
    away = np.hypot(*(np.concatenate(points) - pose[:2]).T)
    return float(away.min()) if len(away) else 0.0


def _measure(situation: Situation, beliefs: BeliefArrays) -> float:
    return uncertainty(beliefs, "D", situation.prior_std).item()
