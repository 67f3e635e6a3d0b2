"""Active SLAM in one compiled pass: progress, reward, end and observation of a step.

The pass reads the beliefs where the filters store them. The result for a world does
not depend on the other worlds, to the bit.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from ..arrays import Array, BoolArray, IntArray
from ..estimator.kernels.imagine import View
from ..estimator.kernels.kalman_gain import half_log_det, largest_variance
from ..jit import jit, njit_internal
from .belief_kernels import FeatureArrays, write_belief_features
from .floor_kernels import (
    DISTANCE,
    Floor,
    Pose,
    first_smallest,
    look_around,
    write_densities,
    write_direction,
    write_point,
    write_wall_distances,
)

CELLS = 8.0  # that weigh as much as one landmark
D, A, _ = range(3)  # criteria of the map, in the order of `CRITERIA`


class Episodes(NamedTuple):
    """The progress of the episodes of B worlds, which the pass changes in place."""

    explored: BoolArray
    """Cells seen so far, as believed, shape (B, C)."""
    steps: IntArray
    """Steps so far, shape (B,)."""
    uncertainty: Array
    """Of the map, see `information_reward.uncertainty`, shape (B,)."""
    known: BoolArray
    """Landmarks known to the required accuracy, shape (B, N)."""


class StepOutcome(NamedTuple):
    """The outcome of one step in B worlds; arrays of shape (B,)."""

    rewards: Array
    terminated: BoolArray
    truncated: BoolArray
    success: BoolArray


class Worlds(NamedTuple):
    """All that the pass reads and writes of B worlds."""

    beliefs: tuple[Array, Array, IntArray]
    """A `BatchStorage`."""
    actions: Array
    collisions: BoolArray
    episodes: Episodes
    outcome: StepOutcome
    counts: tuple[IntArray, IntArray]
    """Landmarks mapped and known, (B,)."""
    belief_features: FeatureArrays
    features: tuple[Array, Array, Array, Array, Array]
    """Goals, progress, uncertain, unexplored and walls, see `ActiveSlamTask`."""


class Rules(NamedTuple):
    """Constants of the task: `RewardWeights`, and settings of the scenario."""

    criterion: int
    accuracy: float
    success_reward: float
    crash_cost: float
    effort_cost: float
    step_cost: float
    limits: tuple[float, float]
    """Largest speed and turn rate [m/s, rad/s]."""
    longest_step: float
    """[m]"""
    steps: int
    """Of an episode."""
    prior_std: tuple[float, float]
    """Of an unmapped landmark [m]."""


class Scratch(NamedTuple):
    """Room for intermediate results."""

    points: Array
    """Shape (3, max(C, N))."""
    variances: Array
    """Of the landmarks, shape (N,) [m²]."""
    matrix: Array
    """Shape (2N, 2N)."""


@jit
def advance(
    chosen: BoolArray,
    moving: BoolArray,
    worlds: tuple[Any, ...],
    plan: tuple[Any, ...],
    rules: tuple[Any, ...],
    scratch: tuple[Any, ...],
) -> None:
    """Take the chosen worlds (B,) through a step, or begin their episodes.

    Of the chosen worlds, those that move take a step. The progress of the others starts
    from nothing, and they have no outcome. Worlds not chosen stay. The arrays come as
    plain tuples, the entries of `Worlds`, `Floor`, `Rules` and `Scratch`: numba takes
    microseconds to recognise a NamedTuple.
    """
    beliefs, actions, collisions, episodes, outcome, counts, of_belief, more = worlds
    now, result = Episodes(*episodes), StepOutcome(*outcome)
    everything = Worlds(
        beliefs, actions, collisions, now, result, counts, of_belief, more
    )
    cells, walls, bounds, diagonal, view = plan
    floor = Floor(cells, walls, bounds, diagonal, View(*view))
    for b in range(len(chosen)):
        if chosen[b]:
            advance_world(
                b, moving[b], everything, floor, Rules(*rules), Scratch(*scratch)
            )


@njit_internal
def advance_world(
    b: int, moved: bool, worlds: Worlds, floor: Floor, rules: Rules, scratch: Scratch
) -> None:
    """Take one world through a step, or begin its episode."""
    means, covariances, slots = worlds.beliefs
    explored, steps, uncertainty, known = worlds.episodes
    mean, covariance = means[b], covariances[b]
    features, bounds = worlds.belief_features, floor.bounds
    write_belief_features(b, mean, covariance, slots[b], bounds, features)
    directions = features[5]
    pose = mean[0], mean[1], directions[b, 2], directions[b, 3]
    if not moved:
        explored[b] = False
    points = scratch.points
    unseen = look_around(pose, floor.cells, floor.sight, explored[b], points)
    write_nearest(points, unseen, floor.diagonal, worlds.features[0][b, :3])
    write_densities(points, unseen, floor.diagonal, CELLS, worlds.features[3][b])
    accuracy, variances = rules.accuracy, scratch.variances
    mapped = judge_landmarks(covariance, slots[b], accuracy, variances, known[b])
    before = uncertainty[b]
    uncertainty[b] = map_uncertainty(covariance, mapped, slots.shape[1], rules, scratch)
    steps[b] = steps[b] + 1 if moved else 0
    if moved:
        reward_step(b, before - uncertainty[b], worlds, rules)
    write_shares(b, unseen, mapped, worlds, rules)
    distances, diagonal = worlds.features[4][b], floor.diagonal
    write_wall_distances(pose, floor.walls, diagonal, rules.longest_step, distances)
    write_landmark_goals(b, pose, mean, worlds, diagonal, scratch)


@njit_internal
def judge_landmarks(
    covariance: Array,
    slots: IntArray,
    accuracy: float,
    variances: Array,
    known: BoolArray,
) -> int:
    """Note the worst variance of each landmark, and which are known.

    Returns the number of mapped landmarks.
    """
    mapped = 0
    for i in range(len(slots)):
        variances[i], known[i] = math.inf, False
        if slots[i] >= 0:
            mapped += 1
            variances[i] = largest_variance(covariance, 3 + 2 * slots[i])
            known[i] = variances[i] <= accuracy * accuracy
    return mapped


@njit_internal
def map_uncertainty(
    covariance: Array, mapped: int, landmarks: int, rules: Rules, scratch: Scratch
) -> float:
    """Compute the uncertainty of a map, see `information_reward.uncertainty`."""
    missing, size = landmarks - mapped, 2 * mapped
    P = covariance[3 : 3 + size, 3 : 3 + size]
    sx, sy = rules.prior_std
    if rules.criterion == D:
        prior = missing * (math.log(sx) + math.log(sy))
        return (prior + half_log_det(P, scratch.matrix)) / landmarks
    if rules.criterion == A:
        return float((missing * (sx * sx + sy * sy) + np.trace(P)) / landmarks)
    largest = max(sx * sx, sy * sy) if missing > 0 else 0.0
    if mapped > 0:
        largest = max(largest, np.linalg.eigvalsh(np.ascontiguousarray(P))[-1])
    return float(largest)


@njit_internal
def reward_step(b: int, gain: float, worlds: Worlds, rules: Rules) -> None:
    """Compute the reward of a step, and whether it ends the episode."""
    crashed, steps = worlds.collisions[b], worlds.episodes.steps[b]
    success = not crashed and worlds.episodes.known[b].all()
    drive = min(abs(worlds.actions[b, 0]) / rules.limits[0], 1.0)
    turn = min(abs(worlds.actions[b, 1]) / rules.limits[1], 1.0)
    reward = gain - rules.step_cost
    reward -= rules.effort_cost * (0.5 * (drive * drive + turn * turn))
    if crashed:
        reward -= rules.crash_cost
    if success:
        reward += rules.success_reward * (2.0 - steps / rules.steps)
    outcome = worlds.outcome
    outcome.rewards[b], outcome.success[b] = reward, success
    outcome.terminated[b] = success or crashed
    outcome.truncated[b] = not outcome.terminated[b] and steps >= rules.steps


@njit_internal
def write_shares(
    b: int, unseen: int, mapped: int, worlds: Worlds, rules: Rules
) -> None:
    """Write the shares explored, mapped, known, and of time left, and the counts."""
    shares, episodes = worlds.features[1][b], worlds.episodes
    cells, known = episodes.explored.shape[1], episodes.known[b]
    counts = worlds.counts
    counts[0][b], counts[1][b] = mapped, known.sum()
    shares[0] = (cells - unseen) / cells
    shares[1], shares[2] = mapped / len(known), counts[1][b] / len(known)
    shares[3] = 1.0 - min(episodes.steps[b] / rules.steps, 1.0)


@njit_internal
def write_landmark_goals(
    b: int, pose: Pose, mean: Array, worlds: Worlds, diagonal: float, scratch: Scratch
) -> None:
    """Write goals and densities of the landmarks."""
    points, slots = scratch.points, worlds.beliefs[2][b]
    goals, _, uncertain, _, _ = worlds.features
    count = 0
    for i in range(len(slots)):
        if slots[i] >= 0 and not worlds.episodes.known[b, i]:
            count = add_landmark(points, count, mean, slots[i], pose)
    write_nearest(points, count, diagonal, goals[b, 3:6])
    write_densities(points, count, diagonal, 1.0, uncertain[b])
    best, count = first_smallest(scratch.variances, len(slots)), 0
    if slots[best] >= 0:
        count = add_landmark(points, 0, mean, slots[best], pose)
    write_nearest(points, count, diagonal, goals[b, 6:])


@njit_internal
def add_landmark(points: Array, k: int, mean: Array, slot: int, pose: Pose) -> int:
    """Write a mapped landmark as column k of an array of points; return k + 1."""
    x = 3 + 2 * slot
    write_point(points, k, mean[x] - pose[0], mean[x + 1] - pose[1], pose)
    return k + 1


@njit_internal
def write_nearest(points: Array, count: int, diagonal: float, goal: Array) -> None:
    """Write the direction to the nearest point."""
    nearest = first_smallest(points[DISTANCE], count)
    write_direction(points, nearest, diagonal, goal)
