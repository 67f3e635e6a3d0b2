"""Active SLAM in one compiled pass: progress, reward, end and observation of a step.

The pass reads the beliefs where the filters store them. The result for a world does
not depend on the other worlds, to the bit.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from ..arrays import Array, BoolArray, ComplexArray, IntArray
from ..estimator.kernels.imagine import View, is_hidden, is_in_view
from ..estimator.kernels.sizes_of_covariances import half_log_det, largest_variance
from ..jit import (
    fma,
    jit,
    jit_in_place,
    njit_allocating,
    njit_inlined,
    njit_internal,
    njit_reordered,
)
from .belief_features import Bounds, write_belief_features

CELLS = 8.0  # that weigh as much as one landmark
D, A, _ = range(3)  # criteria of the map, in the order of `CRITERIA`


class Episodes(NamedTuple):
    """The progress of the episodes of B worlds, which the pass changes in place."""

    explored: BoolArray  # cells seen so far, as believed, shape (B, C)
    steps: IntArray  # steps so far, shape (B,)
    uncertainty: Array  # of the map, see `information_reward.uncertainty`, shape (B,)
    known: BoolArray  # landmarks known to the required accuracy, shape (B, N)


class StepResults(NamedTuple):
    """The results of one step in B worlds."""

    # The values of the first feature for all worlds, then those of the next one, and so
    # on, without the boolean feature.
    numbers: Array
    mapped: BoolArray  # the boolean feature, which landmarks are mapped, shape (B, N)
    scores: Array  # REWARD, ERROR, shape (2, B)
    ends: BoolArray  # TERMINATED, TRUNCATED, SUCCESS, shape (3, B)
    counts: IntArray  # of landmarks mapped, and of those known, shape (2, B)


REWARD, ERROR = range(2)
TERMINATED, TRUNCATED, SUCCESS = range(3)


class Worlds(NamedTuple):
    """All that the pass reads and writes of B worlds."""

    actions: Array
    collisions: BoolArray
    landmarks: ComplexArray  # true positions x + iy, shape (B, N) [m]; for ERROR alone
    beliefs: tuple[Array, Array, IntArray]  # a `BatchStorage`
    episodes: Episodes
    results: StepResults
    # Where each feature begins among the numbers of one world, and where the last ends.
    starts: IntArray


class TaskRules(NamedTuple):
    """Constants of the task: `RewardWeights`, and settings of the scenario."""

    criterion: int
    accuracy: float
    success_reward: float
    crash_cost: float
    effort_cost: float
    step_cost: float
    limits: tuple[float, float]  # largest speed and turn rate [m/s, rad/s]
    longest_step: float  # [m]
    steps: int  # of an episode
    prior_std: tuple[float, float]  # of an unmapped landmark [m]


class Scratch(NamedTuple):
    """Room for intermediate results."""

    points: Array  # (3, max(C, N))
    variances: Array  # of the landmarks, shape (N,) [m²]
    matrix: Array  # (2N, 2N)


@jit_in_place
def advance(
    chosen: BoolArray,
    moving: BoolArray,
    actions: Array,
    collisions: BoolArray,
    landmarks: ComplexArray,
    beliefs: tuple[Any, ...],
    episodes: tuple[Any, ...],
    results: tuple[Any, ...],
    fixed: tuple[Any, ...],
) -> None:
    """Take the chosen worlds (B,) through a step, or begin their episodes.

    Of the chosen worlds, those that move take a step. The progress of the others starts
    from nothing, and they have no outcome. Worlds not chosen stay.

    The last arguments are plain tuples, with the entries of `BatchStorage`, `Episodes`,
    `StepResults`, and of what never changes: `starts`, `Floor`, `TaskRules` and
    `Scratch`. Numba takes microseconds to recognise a NamedTuple.
    """
    starts, (cells, walls, bounds, diagonal, view), rules, scratch = fixed
    now, after = Episodes(*episodes), StepResults(*results)
    worlds = Worlds(actions, collisions, landmarks, beliefs, now, after, starts)
    floor, room = Floor(cells, walls, bounds, diagonal, View(*view)), Scratch(*scratch)
    for b in range(len(chosen)):
        if chosen[b]:
            advance_world(b, moving[b], worlds, floor, TaskRules(*rules), room)


@njit_inlined
def feature(worlds: Worlds, place: int, b: int) -> Array:
    """Return a numeric feature of one world, by its place in the observation."""
    first, end = worlds.starts[place], worlds.starts[place + 1]
    begin = first * len(worlds.actions) + b * (end - first)
    return worlds.results.numbers[begin : begin + end - first]


@njit_internal
def advance_world(
    b: int,
    moved: bool,
    worlds: Worlds,
    floor: Floor,
    rules: TaskRules,
    scratch: Scratch,
) -> None:
    """Take one world through a step, or begin its episode."""
    means, covariances, slots = worlds.beliefs
    explored, steps, uncertainty, known = worlds.episodes
    mean, covariance = means[b], covariances[b]
    corr, map_std = feature(worlds, 0, b), feature(worlds, 1, b)
    std, landmarks = feature(worlds, 2, b), feature(worlds, 3, b)
    mask, of_pose = worlds.results.mapped[b], feature(worlds, 5, b)
    pose_corr, pose_std = feature(worlds, 6, b), feature(worlds, 7, b)
    into = corr, map_std, std, landmarks, mask, of_pose, pose_corr, pose_std
    write_belief_features(mean, covariance, slots[b], floor.bounds, into)
    goals, progress = feature(worlds, 8, b), feature(worlds, 9, b)
    uncertain, unexplored = feature(worlds, 10, b), feature(worlds, 11, b)
    distances = feature(worlds, 12, b)
    pose = mean[0], mean[1], of_pose[2], of_pose[3]
    if not moved:
        explored[b] = False
    points, diagonal = scratch.points, floor.diagonal
    unseen = look_around(pose, floor.cells, floor.sight, explored[b], points)
    write_nearest(points, unseen, diagonal, goals[:3])
    write_densities(points, unseen, diagonal, CELLS, unexplored)
    accuracy, variances = rules.accuracy, scratch.variances
    mapped = judge_landmarks(covariance, slots[b], accuracy, variances, known[b])
    before = uncertainty[b]
    uncertainty[b] = map_uncertainty(covariance, mapped, slots.shape[1], rules, scratch)
    steps[b] = steps[b] + 1 if moved else 0
    if moved:
        reward_step(b, before - uncertainty[b], worlds, rules)
    else:
        worlds.results.scores[REWARD, b], worlds.results.ends[:, b] = 0.0, False
    worlds.results.scores[ERROR, b] = map_error(mean, slots[b], worlds.landmarks[b])
    write_shares(b, unseen, mapped, worlds, rules, progress)
    write_wall_distances(pose, floor.walls, diagonal, rules.longest_step, distances)
    judged = slots[b], known[b], variances
    write_landmark_goals(pose, mean, judged, diagonal, points, goals, uncertain)


@njit_internal
def judge_landmarks(
    P: Array, slots: IntArray, accuracy: float, variances: Array, known: BoolArray
) -> int:
    """Note the worst variance of each landmark, and which are known.

    Returns the number of mapped landmarks.
    """
    mapped = 0
    for i in range(len(slots)):
        variances[i], known[i] = math.inf, False
        if slots[i] >= 0:
            mapped += 1
            variances[i] = largest_variance(P, 3 + 2 * slots[i])
            known[i] = variances[i] <= accuracy * accuracy
    return mapped


@njit_allocating
def map_uncertainty(
    covariance: Array, mapped: int, landmarks: int, rules: TaskRules, scratch: Scratch
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
def reward_step(b: int, gain: float, worlds: Worlds, rules: TaskRules) -> None:
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
    ends, ended = worlds.results.ends, success or crashed
    worlds.results.scores[REWARD, b], ends[SUCCESS, b] = reward, success
    ends[TERMINATED, b], ends[TRUNCATED, b] = ended, not ended and steps >= rules.steps


@njit_internal
def map_error(mean: Array, slots: IntArray, true: ComplexArray) -> float:
    """Compute the root mean square error of a map [m]; 0 of an empty one.

    The error of a landmark is its distance from the truth in the world's frame, with
    no alignment: an error of the first heading counts.
    """
    squares, mapped = 0.0, 0
    for i in range(len(slots)):
        if slots[i] >= 0:
            x = 3 + 2 * slots[i]
            dx, dy = mean[x] - true[i].real, mean[x + 1] - true[i].imag
            squares, mapped = squares + dx * dx + dy * dy, mapped + 1
    return math.sqrt(squares / mapped) if mapped else 0.0


@njit_internal
def write_shares(
    b: int, unseen: int, mapped: int, worlds: Worlds, rules: TaskRules, shares: Array
) -> None:
    """Write the shares explored, mapped, known, and of time left, and the counts."""
    episodes = worlds.episodes
    cells, known = episodes.explored.shape[1], episodes.known[b]
    counts = worlds.results.counts
    counts[0, b], counts[1, b] = mapped, known.sum()
    shares[0] = (cells - unseen) / cells
    shares[1], shares[2] = mapped / len(known), counts[1, b] / len(known)
    shares[3] = 1.0 - min(episodes.steps[b] / rules.steps, 1.0)


@njit_internal
def write_landmark_goals(
    pose: Pose,
    mean: Array,
    judged: tuple[IntArray, BoolArray, Array],
    diagonal: float,
    points: Array,
    goals: Array,
    uncertain: Array,
) -> None:
    """Write goals and densities of landmarks, from what `judge_landmarks` found."""
    (slots, known, variances), count = judged, 0
    for i in range(len(slots)):
        if slots[i] >= 0 and not known[i]:
            count = add_landmark(points, count, mean, slots[i], pose)
    write_nearest(points, count, diagonal, goals[3:6])
    write_densities(points, count, diagonal, 1.0, uncertain)
    best, count = first_smallest(variances, len(slots)), 0
    if slots[best] >= 0:
        count = add_landmark(points, 0, mean, slots[best], pose)
    write_nearest(points, count, diagonal, goals[6:])


@njit_internal
def add_landmark(points: Array, k: int, mean: Array, slot: int, pose: Pose) -> int:
    """Write a mapped landmark as column k of an array of points; return k + 1."""
    x = 3 + 2 * slot
    write_point(points, k, mean[x] - pose[0], mean[x + 1] - pose[1], pose)
    return k + 1


@njit_internal
def write_nearest(points: Array, count: int, diagonal: float, goal: Array) -> None:
    """Write the direction to the nearest point: cosine, sine, distance in diagonals.

    Zeros without any point.
    """
    goal[:] = 0.0
    k = first_smallest(points[DISTANCE], count)
    if k >= 0:
        distance = points[DISTANCE, k]
        share = 1.0 / max(distance, 1e-9)
        goal[0] = min(max(points[AHEAD, k] * share, -1.0), 1.0)
        goal[1] = min(max(points[ASIDE, k] * share, -1.0), 1.0)
        goal[2] = min(distance / diagonal, 1.0)


# --------------------------------------------------------------------------------------
# Compiled kernels of the floor: cells not yet seen, distances to walls, directions.
#
# Symbols
# -------
# p = (x, y, cos θ, sin θ)   believed pose
# δ                          from the robot to a point, ahead and aside in its frame [m]

Pose = tuple[float, float, float, float]

SECTORS = 8  # number of directions around the robot, the first straight ahead

# Distance over which near densities decay to 1 / e, in diagonals of the floor.
NEAR_REACH = 0.1
FAR_REACH = 4 * NEAR_REACH  # the same of far densities

AHEAD, ASIDE, DISTANCE = range(3)  # rows of an array of points
_TIE = 1e-9  # values no farther apart count as equal
_CORNER = 1e-9  # a ray through a corner hits one of its walls
_COS = np.cos(2 * np.pi * np.arange(SECTORS) / SECTORS)
_SIN = np.sin(2 * np.pi * np.arange(SECTORS) / SECTORS)


class Floor(NamedTuple):
    """The plan of a floor and the sight of the robot on it."""

    cells: Array  # x and y of the centres of the cells, shape (2, C) [m]
    walls: Array  # rows (x0, y0, x1, y1), shape (W, 4) [m]
    bounds: Bounds
    diagonal: float  # of the bounds [m]
    sight: View


class Lobes(NamedTuple):
    """Weighted sums over points with the unit vectors (x, y) towards them."""

    total: float  # Σ w
    xx: float  # Σ w x²
    xy: float  # Σ w x y
    ahead: float  # Σ w x², of points ahead
    # Σ w (x + y)² / 2, of points ahead or to the left by the same angle or more.
    ahead_left: float
    left: float  # Σ w y², of points to the left
    # Σ w (y - x)² / 2, of points to the left or behind by the same angle or more.
    left_behind: float


@jit
def cells_in_view(
    poses: Array, cells: Array, view: tuple[Any, ...], seen: BoolArray
) -> None:
    """Mark the cells (2, C) in view from any of poses (B, T, 3), in `seen` (B, C)."""
    points, sight = np.empty((3, cells.shape[1])), View(*view)
    for b in range(len(poses)):
        for t in range(poses.shape[1]):
            x, y, heading = poses[b, t, 0], poses[b, t, 1], poses[b, t, 2]
            cos, sin = math.cos(heading), math.sin(heading)
            if len(sight.walls) > 0:
                mark_cells((x, y, cos, sin), cells, sight, seen[b], points)
                continue
            for c in range(cells.shape[1]):
                dx, dy = cells[0, c] - x, cells[1, c] - y
                ahead, distance = dx * cos + dy * sin, math.sqrt(dx * dx + dy * dy)
                seen[b, c] |= is_in_view(ahead, distance, sight)


@njit_internal
def look_around(
    pose: Pose, cells: Array, view: View, seen: BoolArray, points: Array
) -> int:
    """Mark the cells in view as seen, and write those still unseen as points.

    Returns how many are unseen.
    """
    mark_cells(pose, cells, view, seen, points)
    unseen = 0
    for c in range(len(seen)):
        if not seen[c]:
            points[AHEAD, unseen] = points[AHEAD, c]
            points[ASIDE, unseen] = points[ASIDE, c]
            points[DISTANCE, unseen] = points[DISTANCE, c]
            unseen += 1
    return unseen


@njit_internal
def mark_cells(
    pose: Pose, cells: Array, view: View, seen: BoolArray, points: Array
) -> None:
    """Mark the cells in view as seen, and write all cells as points.

    The loops have no branches, unless walls hide cells, so that they run on whole
    vector registers.
    """
    x, y, _, _ = pose
    for c in range(len(seen)):
        write_point(points, c, cells[0, c] - x, cells[1, c] - y, pose)
    if len(view.walls) == 0:
        for c in range(len(seen)):
            seen[c] |= is_in_view(points[AHEAD, c], points[DISTANCE, c], view)
    else:
        for c in range(len(seen)):
            if not seen[c] and is_in_view(points[AHEAD, c], points[DISTANCE, c], view):
                dx, dy = cells[0, c] - x, cells[1, c] - y
                seen[c] = not is_hidden(x, y, dx, dy, view.walls)


@njit_internal
def write_point(points: Array, k: int, dx: float, dy: float, pose: Pose) -> None:
    """Write the point at p + (dx, dy) as column k of an array of points."""
    _, _, cos, sin = pose
    points[AHEAD, k] = dx * cos + dy * sin
    points[ASIDE, k] = dy * cos - dx * sin
    points[DISTANCE, k] = math.sqrt(dx * dx + dy * dy)


@njit_internal
def write_densities(
    points: Array, count: int, diagonal: float, unit: float, densities: Array
) -> None:
    """Write the densities s / (s + unit) of points in all directions φ, (16,).

    ::

        s = Σ w max(0, cos(arg δ - φ))² / 2,    w = e^{-|δ| / reach}

    Eight with the near reach, then eight with the far one. The lobes of all directions
    add up to one. Opposite directions have the same square of the cosine, so one sum
    over all points and one over those ahead serve both.
    """
    if count == 0:
        densities[:] = 0.0
        return
    far, near = sum_lobes(points, count, diagonal)
    write_lobes(near, unit, densities[:SECTORS])
    write_lobes(far, unit, densities[SECTORS:])


@njit_reordered
def sum_lobes(points: Array, count: int, diagonal: float) -> tuple[Lobes, Lobes]:
    """Sum the lobes of points with far and with near weights.

    The loop has no branches, so that it runs on whole vector registers. The
    exponential is that of a 64th part, a polynomial, squared six times; its error is
    below 1e-13. The near weight is the fourth power of the far one.
    """
    scale = -1.0 / (64 * FAR_REACH * diagonal)
    f0 = f1 = f2 = f3 = f4 = f5 = f6 = 0.0
    n0 = n1 = n2 = n3 = n4 = n5 = n6 = 0.0
    for k in range(count):
        x, y = points[AHEAD, k], points[ASIDE, k]
        xx, xy, yy = x * x, x * y, y * y
        squared = xx + yy
        half = 0.5 * squared
        ahead = xx if x > 0.0 else 0.0
        ahead_left = half + xy if x + y > 0.0 else 0.0
        left = yy if y > 0.0 else 0.0
        left_behind = half - xy if y > x else 0.0
        t = max(points[DISTANCE, k] * scale, -0.625)  # e^-40 is 0
        p = fma(t, fma(t, fma(t, 1 / 5040, 1 / 720), 1 / 120), 1 / 24)
        p = fma(t, fma(t, fma(t, fma(t, p, 1 / 6), 0.5), 1.0), 1.0)
        p *= p
        p *= p
        p *= p
        p *= p
        p *= p
        p *= p
        w = p / (squared if squared > 1e-18 else 1e-18)
        f0, f1, f2 = f0 + w * squared, f1 + w * xx, f2 + w * xy
        f3, f4 = f3 + w * ahead, f4 + w * ahead_left
        f5, f6 = f5 + w * left, f6 + w * left_behind
        w *= p * p * p
        n0, n1, n2 = n0 + w * squared, n1 + w * xx, n2 + w * xy
        n3, n4 = n3 + w * ahead, n4 + w * ahead_left
        n5, n6 = n5 + w * left, n6 + w * left_behind
    return Lobes(f0, f1, f2, f3, f4, f5, f6), Lobes(n0, n1, n2, n3, n4, n5, n6)


@njit_internal
def write_lobes(lobes: Lobes, unit: float, densities: Array) -> None:
    """Write the densities of all eight directions."""
    total, xx, xy, ahead, ahead_left, left, left_behind = lobes
    half = 0.5 * total
    wholes = xx, half + xy, total - xx, half - xy
    for k, part in enumerate((ahead, ahead_left, left, left_behind)):
        # of direction k, and of the opposite one: the remainder
        near, far = max(0.5 * part, 0.0), max(0.5 * (wholes[k] - part), 0.0)
        densities[k] = near / (near + unit)
        densities[k + SECTORS // 2] = far / (far + unit)


@njit_internal
def first_smallest(values: Array, count: int) -> int:
    """Return the first index whose value is within 1e-9 of the smallest.

    So rounding does not decide between cells that are equally near. Four comparisons
    at a time do not wait for each other.
    """
    a = b = c = d = math.inf
    whole = count & -4
    for k in range(0, whole, 4):
        a = values[k] if values[k] < a else a
        b = values[k + 1] if values[k + 1] < b else b
        c = values[k + 2] if values[k + 2] < c else c
        d = values[k + 3] if values[k + 3] < d else d
    for k in range(whole, count):
        a = values[k] if values[k] < a else a
    least = min(a, b, c, d)
    for k in range(count):
        if values[k] <= least + _TIE:
            return k
    return -1


@njit_internal
def write_wall_distances(
    pose: Pose, walls: Array, diagonal: float, unit: float, shares: Array
) -> None:
    """Write the distance d to the wall as d / (d + unit), d at most the diagonal."""
    x, y, cos, sin = pose
    for k in range(SECTORS):
        rx, ry = cos * _COS[k] - sin * _SIN[k], sin * _COS[k] + cos * _SIN[k]
        nearest = diagonal
        for w in range(len(walls)):
            sx, sy = walls[w, 0] - x, walls[w, 1] - y
            wx, wy = walls[w, 2] - walls[w, 0], walls[w, 3] - walls[w, 1]
            across = rx * wy - ry * wx
            if abs(across) < 1e-12:  # parallel
                continue
            distance = (sx * wy - sy * wx) / across
            share = (sx * ry - sy * rx) / across
            if distance >= 0.0 and -_CORNER <= share <= 1.0 + _CORNER:
                nearest = min(nearest, distance)
        shares[k] = nearest / (nearest + unit)
