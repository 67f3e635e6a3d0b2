"""Greedy information gain: compare a few motions by prediction, and take the best.

For every candidate motion the estimator itself predicts the belief. It moves along the
motion and is updated with the expected readings of the mapped landmarks in view. Their
innovations are zero, so only the covariance changes. Then its state is restored. The
value of a motion is the decrease of ½ log det of the map's covariance, plus the
expected gain from new landmarks. A missing landmark is equally likely in any unseen
cell. Finding it decreases the criterion by the logarithm of prior over accuracy::

    value = U(now) - U(after) + missing (new cells / unseen cells) Δ,
    Δ = [ln(σx / accuracy) + ln(σy / accuracy)] / N

A small term prefers motions that end near a goal. It decides between small values.
"""

import math
from typing import Any

import numpy as np

from ..arrays import Array, BoolArray
from ..envs.angles import wrap_angle
from ..envs.robot import displacement
from ..estimator.filters.batch_results import BatchBeliefs
from .agent_knowledge import AgentKnowledge
from .belief_arrays import belief_storage
from .information_reward import uncertainty

_STEPS = 4  # length of a candidate motion
_TURNS = (-1.0, -0.5, -0.2, 0.0, 0.2, 0.5, 1.0)  # of the largest turn rate
_CLEARANCE = 0.5  # distance kept from walls beyond the robot's radius [m]
_NEARNESS = 0.03  # value of one metre nearer to a goal [nats per landmark]


class GreedyInformation:
    """Takes the motion with the largest expected information."""

    def act(self, knowledge: AgentKnowledge) -> Array:
        """Choose (v, ω) [m/s, rad/s]; see `Baseline.act`."""
        robot = knowledge.scenario.robot
        candidates = [
            np.array([robot.max_speed * drive, robot.max_turn_rate * turn])
            for drive, turns in ((1.0, _TURNS), (0.0, (-1.0, 1.0)))
            for turn in turns
        ]
        values = [_value(knowledge, candidate) for candidate in candidates]
        return candidates[int(np.argmax(values))]


def _value(knowledge: AgentKnowledge, action: Array) -> float:
    """Return the value of holding an action, -inf if the robot would hit a wall."""
    poses = _poses_ahead(knowledge, action)
    moves = action[0] != 0.0
    if moves and not _is_free(knowledge, poses):
        return -math.inf
    before = _measure(knowledge, belief_rows(knowledge))
    gain = before - _measure(knowledge, _belief_after(knowledge, action, poses))
    return (
        gain
        + _exploration_gain(knowledge, poses)
        - _NEARNESS * _distance_to_goals(knowledge, poses[-1])
    )


def belief_rows(knowledge: AgentKnowledge) -> BatchBeliefs:
    """Return the present belief as arrays."""
    size = len(knowledge.known)
    return belief_storage(knowledge.belief, size, by_id=True).beliefs()


def _poses_ahead(knowledge: AgentKnowledge, action: Array) -> Array:
    """Return the poses of the next steps from the believed pose, (K, 3)."""
    distance, turn = action * knowledge.scenario.dt
    x, y, heading = knowledge.belief.pose
    poses = []
    for _ in range(_STEPS):
        dx, dy = displacement(distance, 0.0, math.cos(heading), math.sin(heading))
        x, y, heading = x + dx, y + dy, heading + turn
        poses.append((x, y, heading))
    return np.array(poses)


def _is_free(knowledge: AgentKnowledge, poses: Array) -> bool:
    clearance = knowledge.scenario.robot.radius + _CLEARANCE
    return bool(knowledge.grid.clearance(poses[:, :2]).min() >= clearance)


def _belief_after(
    knowledge: AgentKnowledge, action: Array, poses: Array
) -> BatchBeliefs:
    """Return the belief after a motion; the estimator's state is restored."""
    estimator: Any = knowledge.estimator
    state = estimator.state_dict()
    odometry = action * knowledge.scenario.dt
    ids = np.array(knowledge.belief.landmark_ids, dtype=np.int64)
    try:
        for pose in poses:
            estimator.predict(odometry)
            readings = _expected(pose, knowledge.belief.landmarks)
            seen = _in_view(knowledge, readings)
            estimator.update(readings[seen], ids[seen].tolist())
        after = belief_storage(
            estimator.belief(), len(knowledge.known), by_id=True
        ).beliefs()
    finally:
        estimator.load_state_dict(state)
    return after


def _expected(pose: Array, landmarks: Array) -> Array:
    """Return the expected readings (β, r) of landmarks (n, 2)."""
    offset = landmarks - pose[:2]
    bearing = wrap_angle(np.arctan2(offset[:, 1], offset[:, 0]) - pose[2])
    return np.column_stack([bearing, np.hypot(offset[:, 0], offset[:, 1])])


def _in_view(knowledge: AgentKnowledge, readings: Array) -> BoolArray:
    sensor = knowledge.scenario.sensor
    near = (readings[:, 1] <= sensor.max_range) & (readings[:, 1] > sensor.min_range)
    return np.asarray(near & (np.abs(readings[:, 0]) <= sensor.field_of_view / 2))


def _exploration_gain(knowledge: AgentKnowledge, poses: Array) -> float:
    missing = len(knowledge.known) - len(knowledge.belief.landmark_ids)
    unseen = np.count_nonzero(~knowledge.explored)
    if not missing or not unseen:
        return 0.0
    new = knowledge.grid.visible_from(poses).any(axis=0) & ~knowledge.explored
    found = missing * np.count_nonzero(new) / unseen
    worth = sum(math.log(std / knowledge.accuracy) for std in knowledge.prior_std)
    return found * worth / len(knowledge.known)


def _distance_to_goals(knowledge: AgentKnowledge, pose: Array) -> float:
    """Return the distance from a pose to the nearest goal [m], 0 without goals."""
    away = np.hypot(*(knowledge.goals() - pose[:2]).T)
    return float(away.min()) if len(away) else 0.0


def _measure(knowledge: AgentKnowledge, beliefs: BatchBeliefs) -> float:
    return uncertainty(beliefs, "D", knowledge.prior_std).item()
