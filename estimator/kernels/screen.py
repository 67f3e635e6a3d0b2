"""Screening of one scan, compiled: minimum range, chi-square gate, nearness."""

import numpy as np

from ...arrays import LARGEST, Array, IntArray
from ...jit import njit_internal
from .belief_arrays import BeliefArrays
from .linearise import linearise
from .rules import Rules
from .scan_rows import (
    ADDED,
    COLUMN,
    FIRST,
    GATED,
    INNOVATION,
    JACOBIAN,
    NEAR,
    OUTCOME,
    READING,
    SKIPPED,
    SLOT,
    USED,
    VARIANCE,
)


@njit_internal
def usable(value: float) -> bool:
    """Whether a number is finite, and its square too, with room to spare."""
    return abs(value) <= LARGEST


@njit_internal
def screen(
    belief: BeliefArrays,
    readings: Array,
    count: int,
    rules: Rules,
    rows: Array,
    ledger: IntArray,
) -> int:
    """Decide the outcome of every reading and collect those to use.

    The belief stays as it is.  Returns how many readings are in use.
    """
    mean, system, used = belief.mean, rows[FIRST:], 0
    for k in range(count):
        bearing, distance = readings[k, 0], readings[k, 1]
        column = 3 + 2 * ledger[SLOT, k]
        ledger[OUTCOME, k] = ADDED if ledger[SLOT, k] < 0 else USED
        ledger[NEAR, k] = 0
        if distance < rules.min_range:
            ledger[OUTCOME, k] = SKIPPED
        if ledger[OUTCOME, k] != USED:
            continue
        dx, dy = mean[column] - mean[0], mean[column + 1] - mean[1]
        expected = np.sqrt(dx * dx + dy * dy)
        if expected < rules.min_range:
            ledger[OUTCOME, k] = SKIPPED
            continue
        row = 2 * used
        ledger[COLUMN, used] = column
        system[row, READING], system[row + 1, READING] = bearing, distance
        # The range as read makes σr small just where its error is negative.
        at = distance if rules.noise_as_read else expected
        system[row, VARIANCE] = bearing_variance(rules, at)
        system[row + 1, VARIANCE] = range_variance(rules, at)
        ledger[NEAR, k] = is_too_near(mean, belief.covariance, column)
        if rules.gate < np.inf:
            linearise(mean, belief.reference, rules.linearisation, system, row, column)
            if not squared_innovation(belief.covariance, system, row, column) <= (
                rules.gate
            ):
                ledger[OUTCOME, k] = GATED
                continue
        used += 1
    return used


@njit_internal
def bearing_variance(rules: Rules, distance: float) -> float:
    """Return σβ² of a reading at that range [m], which is at least the minimum."""
    return (rules.bearing_std + rules.bearing_std_metres / distance) ** 2


@njit_internal
def range_variance(rules: Rules, distance: float) -> float:
    """Return σr² of a reading at that range [m]."""
    return (rules.range_std + rules.range_std_per_metre * distance) ** 2


@njit_internal
def own_covariance(
    P: Array, system: Array, row: int, c: int
) -> tuple[float, float, float]:
    """Return S of the reading in two rows: S_ββ, S_βr, S_rr."""
    h, h_below = system[row, JACOBIAN:], system[row + 1, JACOBIAN:]
    s00, s10, s11 = system[row, VARIANCE], 0.0, system[row + 1, VARIANCE]
    for i in range(5):
        at_i = i if i < 3 else c + i - 3
        for j in range(5):
            entry = P[at_i, j if j < 3 else c + j - 3]
            s00 += h[i] * entry * h[j]
            s10 += h_below[i] * entry * h[j]
            s11 += h_below[i] * entry * h_below[j]
    return s00, s10, s11


@njit_internal
def squared_innovation(covariance: Array, system: Array, row: int, c: int) -> float:
    """Return the NIS of one reading by itself, νᵀ S⁻¹ ν, for the gate."""
    s00, s10, s11 = own_covariance(covariance, system, row, c)
    n0, n1 = system[row, INNOVATION], system[row + 1, INNOVATION]
    weighted = n0 * n0 * s11 - 2 * n0 * n1 * s10 + n1 * n1 * s00
    nis: float = weighted / (s00 * s11 - s10 * s10)
    return nis


@njit_internal
def is_too_near(mean: Array, covariance: Array, column: int) -> bool:
    """Whether the robot is within 10 σ of a landmark, where linearisation fails.

    σ is the largest standard deviation of the landmark's place in the robot's frame,
    whose error is e_l − e_p − J δ e_θ: a common rotation of robot and map cancels.
    """
    P, c = covariance, column
    dx, dy = mean[c] - mean[0], mean[c + 1] - mean[1]
    x_turn, y_turn = P[c, 2] - P[0, 2], P[c + 1, 2] - P[1, 2]
    xx = P[c, c] - 2 * P[c, 0] + P[0, 0] + 2 * dy * x_turn + dy * dy * P[2, 2]
    yy = P[c + 1, c + 1] - 2 * P[c + 1, 1] + P[1, 1]
    yy += dx * dx * P[2, 2] - 2 * dx * y_turn
    xy = P[c, c + 1] - P[c, 1] - P[c + 1, 0] + P[0, 1]
    xy += dy * y_turn - dx * x_turn - dx * dy * P[2, 2]
    # the larger eigenvalue of [xx xy; xy yy]
    spread = (xx + yy) / 2 + np.sqrt(((xx - yy) / 2) ** 2 + xy * xy)
    return bool(dx * dx + dy * dy < 100 * spread)
