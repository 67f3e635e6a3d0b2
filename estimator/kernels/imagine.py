"""Predicted beliefs after given plans, compiled.

In `imagine_plans`, every plan starts from a copy of a belief. Its steps are those of a
real filter: the expected readings have innovations of zero, so that only the covariance
changes.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from ...arrays import Array, BoolArray, IntArray
from ...jit import jit, njit_internal
from ..models.bearing_range import expected_reading_jit
from ..models.rigid_motion import predict
from .scan_update import (
    DONE,
    LEDGER_HEIGHT,
    SLOT,
    as_rules,
    copy_covariance,
    update_belief,
)
from .sizes_of_covariances import half_log_det, largest_variance


class Settings(NamedTuple):
    """The sensor and the noise of all plans."""

    sight: View
    min_range: float  # [m]
    dropout: float  # probability that a reading is lost
    motion_values: Array
    no_noise: Array  # zeros, for a robot at rest
    rule_values: Array  # with the measurement noise of expected readings


class Room(NamedTuple):
    """A copy of a belief, and room for its updates."""

    mean: Array
    covariance: Array
    reference: Array
    factor: Array
    readings: Array
    ledger: IntArray
    workspace: tuple[Array, Array]


class Imagined(NamedTuple):
    """The beliefs expected after K plans of T steps in B worlds."""

    #: (x, y, θ) after every step, shape (B, K, T, 3) [m, m, rad].
    poses: Array
    #: Of the additive error, shape (B, K, T, 3, 3).
    pose_covariances: Array
    #: log det of the joint covariance of the mapped landmarks in the end, (B, K); with
    #: H horizons after each of them, (B, K, H).
    log_det: Array
    #: Larger eigenvalue of the covariance of each landmark in the end, (B, K, L) [m²],
    #: or after each horizon, (B, K, H, L); inf where it is not mapped.
    worst_variances: Array
    #: Expected number of landmarks seen for the first time until each step,
    #: (B, K, T).
    new_landmarks: Array


@jit
def imagine_plans(
    beliefs: tuple[Array, Array, Array, IntArray],
    plans: Array,
    horizons: IntArray,
    density: tuple[Array, Array],
    settings: tuple[Any, ...],
    workspace: tuple[Any, ...],
    results: tuple[Any, ...],
) -> None:
    """Imagine all plans, see :func:`.filters.imagine.imagine`.

    Parameters
    ----------
    beliefs
        Means, covariances, references and slots, as a batch stores them.
    plans : ndarray, shape (B, K, T, 2)
    horizons : ndarray of int, shape (H,)
        Steps after which the certainty of the map is wanted, increasing.
    density
        Points where a new landmark may be (2, C), and how many are expected (B, C).
    settings
        The entries of `Settings`.
    results
        The arrays of `Imagined`, which are filled; nan from a step on that fails.
    """
    means, covariances, references, slots = beliefs
    view, min_range, dropout, motion_values, rule_values = settings
    sensor = Settings(
        View(*view), min_range, dropout, motion_values, np.zeros(3), rule_values
    )
    outcome = Imagined(*results)
    capacity, landmarks = means.shape[1], slots.shape[1]
    room = Room(
        np.zeros(capacity),
        np.zeros((capacity, capacity)),
        np.zeros(capacity),
        np.zeros((capacity, capacity)),
        np.empty((landmarks, 2)),
        np.zeros((LEDGER_HEIGHT, landmarks), np.int64),
        (workspace[0], workspace[1]),
    )
    points, weights = density
    missed, in_view = np.empty(len(weights[0])), np.empty(len(weights[0]), np.bool_)
    for b in range(len(means)):
        mapped = 0
        for slot in slots[b]:
            mapped += slot >= 0
        size = 3 + 2 * mapped
        for k in range(plans.shape[1]):
            copy_covariance(covariances[b], room.covariance, size)
            for j in range(size):
                room.mean[j], room.reference[j] = means[b, j], references[b, j]
            missed[:], found, judged = 1.0, 0.0, 0
            for t in range(plans.shape[2]):
                d, turn = plans[b, k, t, 0], plans[b, k, t, 1]
                if not imagine_step(room, size, d, turn, sensor):
                    break
                if len(missed):
                    found += look_for_new(
                        room.mean, points, weights[b], sensor, missed, in_view
                    )
                outcome.new_landmarks[b, k, t] = found
                for i in range(3):
                    outcome.poses[b, k, t, i] = room.mean[i]
                    for j in range(3):
                        variance = room.covariance[i, j]
                        outcome.pose_covariances[b, k, t, i, j] = variance
                if judged < len(horizons) and t + 1 == horizons[judged]:
                    judge((b, k, judged), room, size, slots[b], outcome)
                    judged += 1


@njit_internal
def imagine_step(
    room: Room, size: int, distance: float, turn: float, settings: Settings
) -> bool:
    """Predict, and update with the expected readings; False if the update fails."""
    noise = settings.motion_values
    at_rest = distance == 0 and turn == 0 and noise[3] == 0
    variance = settings.no_noise if at_rest else noise
    linearisation = as_rules(settings.rule_values).linearisation
    mean, covariance, reference = room.mean, room.covariance, room.reference
    predict(
        mean, covariance, reference, size, distance, 0.0, turn, variance, linearisation
    )
    count = expect_readings(mean, size, settings, room.readings, room.ledger)
    if count == 0:
        return True
    status, _, _ = update_belief(
        *((mean, covariance, reference), size, room.readings, count, room.ledger),
        *(room.workspace, settings.rule_values),
    )
    return bool(status == DONE)


@njit_internal
def expect_readings(
    mean: Array, size: int, settings: Settings, readings: Array, ledger: IntArray
) -> int:
    """Write the noise-free readings of mapped landmarks in view; return how many.

    Angles are not wrapped: the update wraps differences of readings.
    """
    count, sight = 0, settings.sight
    if settings.dropout >= 1.0:
        return count
    x, y, cos, sin = mean[0], mean[1], math.cos(mean[2]), math.sin(mean[2])
    for slot in range((size - 3) // 2):
        dx, dy = mean[3 + 2 * slot] - x, mean[4 + 2 * slot] - y
        distance = math.sqrt(dx * dx + dy * dy)
        if distance <= settings.min_range:
            continue
        if not is_in_view(dx * cos + dy * sin, distance, sight):
            continue
        if is_hidden(x, y, dx, dy, sight.walls):
            continue
        z0, z1 = expected_reading_jit(dx, dy, mean[2])
        readings[count, 0], readings[count, 1] = z0, z1
        ledger[SLOT, count] = slot
        count += 1
    return count


@njit_internal
def look_for_new(
    mean: Array,
    points: Array,
    weights: Array,
    settings: Settings,
    missed: Array,
    in_view: BoolArray,
) -> float:
    """Return how many landmarks are expected that have been missed until now.

    ``missed`` has the probability of that for a landmark at each point; it falls where
    a point is in view.  ``in_view`` is room for intermediate results.
    """
    found, sight = 0.0, settings.sight
    x, y, cos, sin = mean[0], mean[1], math.cos(mean[2]), math.sin(mean[2])
    for c in range(len(missed)):  # without a branch: on whole vector registers
        dx, dy = points[0, c] - x, points[1, c] - y
        ahead, distance = dx * cos + dy * sin, math.sqrt(dx * dx + dy * dy)
        weight = weights[c] * missed[c]
        in_view[c] = is_in_view(ahead, distance, sight) & (weight > 0.0)
    for c in range(len(missed)):
        if in_view[c]:
            dx, dy = points[0, c] - x, points[1, c] - y
            if not is_hidden(x, y, dx, dy, sight.walls):
                found += weights[c] * missed[c] * (1.0 - settings.dropout)
                missed[c] *= settings.dropout
    return found


@njit_internal
def judge(
    at: tuple[int, int, int], room: Room, size: int, slots: IntArray, outcome: Imagined
) -> None:
    """Write what remains uncertain, ``at`` world, plan and horizon."""
    b, k, h = at
    joint = room.covariance[3:size, 3:size]
    outcome.log_det[b, k, h] = 2.0 * half_log_det(joint, room.factor)
    for i in range(len(slots)):
        outcome.worst_variances[b, k, h, i] = math.inf
        if slots[i] >= 0:
            worst = largest_variance(room.covariance, 3 + 2 * slots[i])
            outcome.worst_variances[b, k, h, i] = worst


# --------------------------------------------------------------------------------------
# Which points the sensor sees from a pose, compiled: range, field of view, walls.
#
# Symbols
# -------
# δ = l - p       from the robot to a point [m], ahead and aside in the robot's frame
# a, b            ends of a wall [m]

_MOUNTED = 1e-6  # a point this near to the line of a wall is mounted on it [m]
_EDGE = 1e-12  # relative; a point on the edge of the view is in view


class View(NamedTuple):
    """What limits the sight of the sensor."""

    max_range: float  # [m]
    # Cosine of half the field of view, -inf where it sees all around.
    cos_half_view: float
    # Walls that hide what is behind them, rows (x0, y0, x1, y1), (W, 4) [m].
    walls: Array


def as_view(max_range: float, field_of_view: float, walls: Array) -> View:
    """Return the limits of a sensor; `walls` is empty where walls do not hide."""
    half = field_of_view / 2
    ends = np.ascontiguousarray(walls, dtype=np.float64).reshape(-1, 4)
    return View(max_range, math.cos(half) if half < math.pi else -math.inf, ends)


@njit_internal
def is_in_view(ahead: float, distance: float, view: View) -> bool:
    """Return whether a point is in range and in the field of view."""
    in_range = distance <= view.max_range * (1.0 + _EDGE)
    in_field = ahead >= (view.cos_half_view - _EDGE) * distance
    return in_range & in_field  # without a branch, for loops over many points


@njit_internal
def is_hidden(x: float, y: float, dx: float, dy: float, walls: Array) -> bool:
    """Return whether a wall crosses the line of sight; its ends belong to it.

    With the ends a and b relative to p, the line to the point passes between them if
    a × δ and b × δ differ in sign. The point lies behind the wall if (a - b) × δ, which
    grows with δ, exceeds a × b::

        (a × δ)(b × δ) <= 0   and   (a - b) × δ sign(a × b) > |a × b|
    """
    for w in range(len(walls)):
        ax, ay, bx, by = walls[w, 0], walls[w, 1], walls[w, 2], walls[w, 3]
        side_a = (ax - x) * dy - (ay - y) * dx
        side_b = (bx - x) * dy - (by - y) * dx
        if side_a * side_b > 0.0:
            continue
        robot_side = (ax - x) * (by - y) - (ay - y) * (bx - x)
        nearer = abs(robot_side) + _MOUNTED * math.hypot(bx - ax, by - ay)
        if (side_a - side_b) * np.sign(robot_side) > nearer:
            return True
    return False
