"""Likelihood of a whole drive under several noises, compiled, in one call."""

import math
from typing import Any, NamedTuple

import numpy as np

from ...arrays import Array, IntArray
from ...jit import jit, njit_internal
from ..models.rigid_motion import predict
from .kalman_gain import (
    ADDED,
    FIRST,
    FIRST_STD,
    GATED,
    INNOVATION,
    LEDGER_HEIGHT,
    OUTCOME,
    READING,
    ROOT,
    SLOT,
    VARIANCE,
    BeliefArrays,
    Rules,
    Workspace,
)
from .scan_update import (
    DONE,
    as_rules,
    linearise,
    own_covariance,
    update_belief,
    variances,
)

LOG_TURN = math.log(2 * math.pi)

# Columns of a noise, all standard deviations.
MOTION = 0  # σx, σy, σα [m, m, rad]
SENSOR = 3  # σβ [rad], σr [m], part of σr per metre, part of σβ in metres [m]
NOISE_WIDTH = 7


class DriveEvents(NamedTuple):
    """S steps, each some motions and the scan at their end; either may be empty."""

    motions: Array  # (K, 3) rows (d, α, dt) [m, rad, -]
    first_motions: IntArray  # (S + 1,) the motions of step s begin at first_motions[s]
    readings: Array  # (M, 2) rows (β, r) [rad, m]
    landmarks: IntArray  # (M,) the landmark of each reading, 0 … n − 1
    first_readings: IntArray  # (S + 1,)


class DriveRecord(NamedTuple):
    """What is kept of B passes; of the last four nothing where they have length 0."""

    log_likelihoods: Array  # (B, S) of the readings of each step
    nis: Array  # (B, S)
    used: IntArray  # (B, S) readings behind the NIS
    rejected: IntArray  # (B,)
    poses: Array  # (B, S, 3) [m, m, rad]
    pose_covariances: Array  # (B, S, 3, 3)
    innovations: Array  # (B, M, 2) each by its own standard deviation, else nan
    outcomes: IntArray  # (B, M) USED, ADDED, GATED or SKIPPED


@jit
def follow_drive(
    events: tuple[Any, ...],
    noises: Array,
    noise_at_rest: bool,
    rule_values: Array,
    start: tuple[Array, Array],
    belief_arrays: tuple[Array, Array, Array],
    workspace_arrays: tuple[Any, ...],
    slots: IntArray,
    record_arrays: tuple[Any, ...],
) -> None:
    """Filter a drive once under each of B noises, and note how likely its readings are.

    Parameters
    ----------
    events
        The entries of :class:`DriveEvents`.
    noises : ndarray, shape (B, NOISE_WIDTH)
        Standard deviations.
    noise_at_rest : bool
        Whether odometry of exactly (0, 0) has motion noise.
    rule_values
        As :func:`.scan_update.as_rules` reads them; those of the sensor's noise are
        overwritten.
    start
        Mean (3,) and covariance (3, 3) of the first pose.
    belief_arrays, workspace_arrays
        Room: the entries of :class:`.kalman_gain.BeliefArrays` and
        :class:`.kalman_gain.Workspace`.
    slots : ndarray, shape (n,)
        Room for the places of the landmarks in the map.
    record_arrays
        The entries of :class:`DriveRecord`, zero at first.  Where a pass fails, its log
        likelihoods are -inf from that step on.
    """
    drive, record = DriveEvents(*events), DriveRecord(*record_arrays)
    belief, workspace = BeliefArrays(*belief_arrays), Workspace(*workspace_arrays)
    most = len(workspace.rows)
    ledger = np.zeros((LEDGER_HEIGHT, most), np.int64)
    readings, own = np.empty((most, 2)), np.empty((most, 3))
    variance = np.empty(3)
    for b in range(len(noises)):
        begin(belief, slots, start)
        for i in range(NOISE_WIDTH - SENSOR):
            rule_values[FIRST_STD + i] = noises[b, SENSOR + i]
        rules = as_rules(rule_values)
        size = len(start[0])  # a literal would compile all kernels anew
        for s in range(len(drive.first_motions) - 1):
            for k in range(drive.first_motions[s], drive.first_motions[s + 1]):
                dx, dy, turn = (
                    drive.motions[k, 0],
                    drive.motions[k, 1],
                    drive.motions[k, 2],
                )
                moves = noise_at_rest or dx != 0 or dy != 0 or turn != 0
                for i in range(3):
                    sigma = noises[b, MOTION + i]
                    variance[i] = sigma * sigma * drive.motions[k, 3] * moves
                predict(
                    belief.mean,
                    belief.covariance,
                    belief.reference,
                    size,
                    dx,
                    dy,
                    turn,
                    variance,
                    rules.linearisation,
                )
            first = drive.first_readings[s]
            count = drive.first_readings[s + 1] - first
            for k in range(count):
                readings[k, 0] = drive.readings[first + k, 0]
                readings[k, 1] = drive.readings[first + k, 1]
                ledger[SLOT, k] = slots[drive.landmarks[first + k]]
            examine(belief, readings, count, ledger, rules, workspace.rows, own)
            status, used, nis = update_belief(
                belief.mean,
                belief.covariance,
                belief.reference,
                size,
                readings,
                count,
                ledger,
                workspace.rows,
                workspace.before,
                rule_values,
            )
            if status != DONE:
                for rest in range(s, record.log_likelihoods.shape[1]):
                    record.log_likelihoods[b, rest] = -math.inf
                break
            record.nis[b, s], record.used[b, s] = nis, used
            record.log_likelihoods[b, s] = log_density(workspace.rows, used, nis)
            size = settle(drive, record, b, s, size, ledger, own, slots, rules.gate)
            keep(belief, record, b, s)


@njit_internal
def settle(
    drive: DriveEvents,
    record: DriveRecord,
    b: int,
    s: int,
    size: int,
    ledger: IntArray,
    own: Array,
    slots: IntArray,
    gate: float,
) -> int:
    """Count rejected readings as at the gate; return the size with new landmarks."""
    first = drive.first_readings[s]
    for k in range(drive.first_readings[s + 1] - first):
        if ledger[OUTCOME, k] == ADDED:
            slots[drive.landmarks[first + k]] = (size - 3) // 2
            size += 2
        elif ledger[OUTCOME, k] == GATED:
            record.rejected[b] += 1
            least = 0.5 * (gate + own[k, 2]) + LOG_TURN
            record.log_likelihoods[b, s] -= least if math.isfinite(least) else math.inf
        if record.innovations.shape[1] > 0:
            record.innovations[b, first + k, 0] = own[k, 0]
            record.innovations[b, first + k, 1] = own[k, 1]
            record.outcomes[b, first + k] = ledger[OUTCOME, k]
    return size


@njit_internal
def keep(belief: BeliefArrays, record: DriveRecord, b: int, s: int) -> None:
    """Copy the pose and its covariance to the record, where it has room."""
    if record.poses.shape[1] > 0:
        for i in range(3):
            record.poses[b, s, i] = belief.mean[i]
            for j in range(3):
                record.pose_covariances[b, s, i, j] = belief.covariance[i, j]


@njit_internal
def begin(belief: BeliefArrays, slots: IntArray, start: tuple[Array, Array]) -> None:
    """Empty the map, and put the robot at its start."""
    mean, covariance, reference = belief
    for i in range(len(mean)):
        mean[i] = reference[i] = 0.0
        for j in range(len(mean)):
            covariance[i, j] = 0.0
    for i in range(3):
        mean[i] = reference[i] = start[0][i]
        for j in range(3):
            covariance[i, j] = start[1][i, j]
    for i in range(len(slots)):
        slots[i] = -1


@njit_internal
def log_density(rows: Array, used: int, nis: float) -> float:
    """Return log N(ν; 0, S) of the readings of a scan that were used."""
    half_log_det = 0.0
    for row in range(FIRST, FIRST + 2 * used, 2):
        half_log_det += math.log(rows[row, ROOT] * rows[row + 1, ROOT + 1])
    return -0.5 * nis - half_log_det - used * LOG_TURN


@njit_internal
def examine(
    belief: BeliefArrays,
    readings: Array,
    count: int,
    ledger: IntArray,
    rules: Rules,
    rows: Array,
    own: Array,
) -> None:
    """Note of each reading ν_β/√S_ββ, ν_r/√S_rr and log det S, by itself, as predicted.

    Readings of new landmarks get nan.  The rows of the system are overwritten.
    """
    mean, P, system = belief.mean, belief.covariance, rows[FIRST:]
    for k in range(count):
        own[k, 0] = own[k, 1] = own[k, 2] = math.nan
        if ledger[SLOT, k] < 0:
            continue
        c = 3 + 2 * ledger[SLOT, k]
        expected = math.hypot(mean[c] - mean[0], mean[c + 1] - mean[1])
        if min(expected, readings[k, 1]) < rules.min_range:
            continue
        at = readings[k, 1] if rules.noise_as_read else expected
        row, below = 2 * k, 2 * k + 1
        system[row, READING], system[below, READING] = readings[k, 0], readings[k, 1]
        system[row, VARIANCE], system[below, VARIANCE] = variances(rules, at)
        linearise(mean, belief.reference, rules.linearisation, system, row, c)
        s00, s10, s11 = own_covariance(P, system, row, c)
        own[k, 0] = system[row, INNOVATION] / math.sqrt(s00)
        own[k, 1] = system[below, INNOVATION] / math.sqrt(s11)
        own[k, 2] = math.log(s00 * s11 - s10 * s10)
