"""Likelihood of a drive's readings under given noises, from a filter's innovations.

`drive_likelihood` filters the drive once for each noise; the kernel below it is
`follow_drive`.
"""

from __future__ import annotations

import math
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ... import argument_checks
from ...argument_checks import aligned_zeros, usable_cores
from ...arrays import LARGEST, Array, IntArray
from ...jit import jit, njit_internal
from ..kernels import scan_update as scan
from ..kernels.batch import share_out
from ..kernels.scan_update import (
    DONE,
    BeliefArrays,
    Rules,
    Workspace,
    as_rules,
    linearise,
    own_covariance,
    update_belief,
    variances,
)
from ..models.bearing_range import wrap_angle
from ..models.rigid_motion import predict
from ..models.sensors import only_bearing_range
from .batch import can_batch
from .ekf import EkfSlam
from .gaussian_map import GaussianMap

# NIS beyond which a reading is rejected: a share e⁻¹⁵ of them if the noise is right.
GATE = 30.0
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


def drive_likelihood(
    estimator: EkfSlam,
    events: DriveEvents,
    noises: ArrayLike,
    *,
    gate: float = GATE,
    keep_beliefs: bool = False,
    threads: int | None = None,
) -> DriveRecord:
    """Filter a drive under several noises; return how likely its readings are [1]_.

    ::

        log p(z) = −½ Σ (νᵀ S⁻¹ ν + log det S + 2m log 2π)

    over the scans, of the m readings in use.  The sum has a robust tail: a reading
    whose own NIS is beyond the gate is rejected, and counts as one at the gate.  The
    first reading of a landmark does not count.  A pass that fails has -inf from there.

    Parameters
    ----------
    estimator : EkfSlam
        Filter at its start, for its rules and its first belief; one that can run in
        batches.
    events : DriveEvents
        The drive; see :func:`check_events`.
    noises : array_like, shape (B, 7)
        Standard deviations σx, σy, σα per step of dt = 1 [m, m, rad], σβ [rad], σr [m],
        the part of σr that grows with the range [m/m], and the part of σβ that shrinks
        with it [m].
    gate : float
        The largest NIS of one reading.
    keep_beliefs : bool
        Whether the record holds poses, their covariances, and the innovation of every
        reading too.
    threads : int, optional
        By default, the number of cores.

    Returns
    -------
    DriveRecord
        Of the B passes; each has the same bits as alone.

    References
    ----------
    .. [1] F. C. Schweppe, Evaluation of likelihood functions for Gaussian signals, IEEE
       Trans. Information Theory 11(1), 1965.

    Examples
    --------
    >>> from slamgym.estimator import EkfSlam
    >>> events = DriveEvents(
    ...     motions=np.array([[2.0, 0.0, 1.0]]),
    ...     first_motions=np.array([0, 0, 1]),
    ...     readings=np.array([[0.0, 5.0], [0.0, 3.2]]),
    ...     landmarks=np.array([0, 0]),
    ...     first_readings=np.array([0, 1, 2]),
    ... )
    >>> slam = EkfSlam(motion_std=(0.1,) * 3, measurement_std=(0.1, 0.1))
    >>> noises = [(0.1, 0.1, 0.1, 0.1, sigma, 0.0, 0.0) for sigma in (0.01, 0.1)]
    >>> record = drive_likelihood(slam, events, noises)
    >>> record.log_likelihoods.sum(axis=1).round(2)
    array([0.  , 0.76])
    """
    if not can_batch(estimator):
        raise ValueError(
            f"{type(estimator).__name__} is not one of the filters on the shared "
            "kernels, which can compute innovations for many noises at once"
        )
    only_bearing_range(estimator.sensor, "fit-noise (drive_likelihood)")
    values = argument_checks.as_floats("noises", noises)
    if values.ndim != 2 or values.shape[1] != NOISE_WIDTH:
        raise ValueError(
            f"noises must have shape (B, {NOISE_WIDTH}), got shape {values.shape}"
        )
    check_events(events)
    record = _new_record(len(values), events, keep_beliefs)
    *odometry, dt = events.motions.T
    moved = estimator.motion.displacements(np.column_stack(odometry))
    events = events._replace(motions=np.column_stack([moved, dt]))
    work = partial(_follow, estimator, events, values, gate, record)
    share_out(work, len(values), threads or usable_cores())
    record.poses[..., :2] += estimator.map.mean[:2]
    record.poses[..., 2] = wrap_angle(record.poses[..., 2])
    return record


def check_events(events: DriveEvents) -> None:
    """Refuse events of a drive that the kernels cannot process.

    Raises
    ------
    ValueError
        If a number is not usable, or the parts do not fit together.
    """
    _refuse_numbers("motions", events.motions, 3)
    _refuse_numbers("readings", events.readings, 2)
    _refuse_firsts("first_motions", events.first_motions, len(events.motions))
    _refuse_firsts("first_readings", events.first_readings, len(events.readings))
    if len(events.first_motions) != len(events.first_readings):
        raise ValueError("first_motions and first_readings must have one length")
    if len(events.landmarks) != len(events.readings):
        raise ValueError("landmarks must have one entry for each reading")
    if len(events.landmarks) and events.landmarks.min() < 0:
        raise ValueError("landmarks must be numbered from 0")


def _refuse_numbers(name: str, numbers: Array, columns: int) -> None:
    if numbers.ndim != 2 or numbers.shape[1] != columns:
        raise ValueError(f"{name} must have {columns} columns, got {numbers.shape}")
    usable = (np.abs(numbers) <= LARGEST).all(axis=1)
    if not usable.all():
        row = int(np.argmin(usable))
        raise ValueError(
            f"{name} must be finite numbers, at most {LARGEST:g}, "
            f"got {numbers[row].tolist()} in row {row}"
        )


def _refuse_firsts(name: str, firsts: IntArray, rows: int) -> None:
    is_whole = len(firsts) > 0 and firsts[0] == 0 and firsts[-1] == rows
    if not is_whole or (np.diff(firsts) < 0).any():
        raise ValueError(f"{name} must rise from 0 to {rows}, got {firsts.tolist()}")


def _new_record(count: int, events: DriveEvents, keep_beliefs: bool) -> DriveRecord:
    steps = len(events.first_motions) - 1
    kept, readings = (steps, len(events.readings)) if keep_beliefs else (0, 0)
    return DriveRecord(
        np.zeros((count, steps)),
        np.zeros((count, steps)),
        np.zeros((count, steps), dtype=np.int64),
        np.zeros(count, dtype=np.int64),
        np.full((count, kept, 3), np.nan),
        np.full((count, kept, 3, 3), np.nan),
        np.full((count, readings, 2), np.nan),
        np.full((count, readings), scan.SKIPPED, dtype=np.int64),
    )


def _follow(
    estimator: EkfSlam,
    events: DriveEvents,
    noises: Array,
    gate: float,
    record: DriveRecord,
    part: slice,
) -> None:
    """Fill a part of a record, in memory of its own.

    The motions of the events are displacements here, rows (dx, dy, α, dt).
    """
    landmarks = int(events.landmarks.max(initial=-1)) + 1
    capacity = GaussianMap.capacity_for(landmarks)
    most = int(np.diff(events.first_readings).max(initial=0))
    belief = np.zeros(capacity), aligned_zeros(capacity, capacity), np.zeros(capacity)
    first, motion = estimator.map, estimator.motion_values
    rules = estimator.rules._replace(gate=gate)
    follow_drive(
        tuple(events),  # numba checks the type of a named one at every call
        noises[part],
        bool(motion[3] > 0),
        np.array(rules),
        # From (0, 0): far away, rounding would blur the likelihoods of a search.
        (first.mean[:3] * (0.0, 0.0, 1.0), first.covariance[:3, :3].copy()),
        belief,
        tuple(scan.workspace_for(rules, most, capacity)),
        np.empty(landmarks, dtype=np.int64),
        tuple(array[part] for array in record),
    )


# --------------------------------------------------------------------------------------
# The drive of every noise, compiled.


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
        Room: the entries of :class:`.scan_update.BeliefArrays` and
        :class:`.scan_update.Workspace`.
    slots : ndarray, shape (n,)
        Room for the places of the landmarks in the map.
    record_arrays
        The entries of :class:`DriveRecord`, zero at first.  Where a pass fails, its log
        likelihoods are -inf from that step on.
    """
    drive, record = DriveEvents(*events), DriveRecord(*record_arrays)
    belief, workspace = BeliefArrays(*belief_arrays), Workspace(*workspace_arrays)
    most = len(workspace.rows)
    ledger = np.zeros((scan.LEDGER_HEIGHT, most), np.int64)
    readings, own = np.empty((most, 2)), np.empty((most, 3))
    variance = np.empty(3)
    for b in range(len(noises)):
        begin(belief, slots, start)
        for i in range(NOISE_WIDTH - SENSOR):
            rule_values[scan.FIRST_STD + i] = noises[b, SENSOR + i]
        rules = as_rules(rule_values)
        size = len(start[0])  # a literal would compile all kernels anew
        x, y = belief.mean[0], belief.mean[1]
        for s in range(len(drive.first_motions) - 1):
            move(
                belief,
                len(start[0]),
                drive,
                s,
                noises[b, MOTION:SENSOR],
                variance,
                noise_at_rest,
                rules,
            )
            first = drive.first_readings[s]
            count = drive.first_readings[s + 1] - first
            if count == 0:
                keep(belief, record, b, s)
                continue
            carry(belief.covariance, size, belief.mean[0] - x, belief.mean[1] - y)
            for k in range(count):
                readings[k, 0] = drive.readings[first + k, 0]
                readings[k, 1] = drive.readings[first + k, 1]
                ledger[scan.SLOT, k] = slots[drive.landmarks[first + k]]
            if rules.gate < math.inf or record.innovations.shape[1] > 0:
                examine(belief, readings, count, ledger, rules, workspace.rows, own)
            status, used, nis = update_belief(
                belief, size, readings, count, ledger, workspace, rule_values
            )
            if status != DONE:
                for rest in range(s, record.log_likelihoods.shape[1]):
                    record.log_likelihoods[b, rest] = -math.inf
                break
            record.nis[b, s], record.used[b, s] = nis, used
            record.log_likelihoods[b, s] = log_density(workspace.rows, used, nis)
            size = settle(drive, record, b, s, size, ledger, own, slots, rules.gate)
            keep(belief, record, b, s)
            at_estimate = rules.linearisation == scan.AT_ESTIMATE
            at = belief.mean if at_estimate else belief.reference
            x, y = at[0], at[1]


@njit_internal
def move(
    belief: BeliefArrays,
    size: int,
    drive: DriveEvents,
    s: int,
    noise: Array,
    variance: Array,
    noise_at_rest: bool,
    rules: Rules,
) -> None:
    """Predict the pose through the motions of step s.

    `carry` later applies them to the covariance of the pose and the landmarks.
    """
    for k in range(drive.first_motions[s], drive.first_motions[s + 1]):
        dx, dy, turn = drive.motions[k, 0], drive.motions[k, 1], drive.motions[k, 2]
        moves = noise_at_rest or dx != 0 or dy != 0 or turn != 0
        dt = drive.motions[k, 3] * moves
        at_estimate = rules.linearisation == scan.AT_ESTIMATE
        if at_estimate and dx == 0 and dy == 0 and dt == 0:
            belief.mean[2] += turn  # a turn without noise, or a robot at rest
            continue
        for i in range(3):
            variance[i] = noise[i] * noise[i] * dt
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


@njit_internal
def carry(covariance: Array, size: int, dx: float, dy: float) -> None:
    """Move the covariance of the pose and the landmarks by several motions at once.

    The Jacobians of motions are I + (−Δy, Δx, 0, …) e_θᵀ, so the displacements of the
    robot, or of its reference, add up.
    """
    P = covariance
    for j in range(3, size):
        P[0, j] -= dy * P[2, j]
        P[1, j] += dx * P[2, j]
        P[j, 0], P[j, 1] = P[0, j], P[1, j]


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
        if ledger[scan.OUTCOME, k] == scan.ADDED:
            slots[drive.landmarks[first + k]] = (size - 3) // 2
            size += 2
        elif ledger[scan.OUTCOME, k] == scan.GATED:
            record.rejected[b] += 1
            least = 0.5 * (gate + own[k, 2]) + LOG_TURN
            record.log_likelihoods[b, s] -= least if math.isfinite(least) else math.inf
        if record.innovations.shape[1] > 0:
            record.innovations[b, first + k, 0] = own[k, 0]
            record.innovations[b, first + k, 1] = own[k, 1]
            record.outcomes[b, first + k] = ledger[scan.OUTCOME, k]
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
    mean[:], covariance[:], reference[:], slots[:] = 0.0, 0.0, 0.0, -1
    for i in range(3):
        mean[i] = reference[i] = start[0][i]
        for j in range(3):
            covariance[i, j] = start[1][i, j]


@njit_internal
def log_density(rows: Array, used: int, nis: float) -> float:
    """Return log N(ν; 0, S) of the readings of a scan that were used."""
    half_log_det = 0.0
    for row in range(scan.FIRST, scan.FIRST + 2 * used, 2):
        half_log_det += math.log(rows[row, scan.ROOT] * rows[row + 1, scan.ROOT + 1])
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
    mean, P, system = belief.mean, belief.covariance, rows[scan.FIRST :]
    for k in range(count):
        own[k, 0] = own[k, 1] = own[k, 2] = math.nan
        if ledger[scan.SLOT, k] < 0:
            continue
        c = 3 + 2 * ledger[scan.SLOT, k]
        expected = math.hypot(mean[c] - mean[0], mean[c + 1] - mean[1])
        if min(expected, readings[k, 1]) < rules.min_range:
            continue
        at = readings[k, 1] if rules.noise_as_read else expected
        row, below = 2 * k, 2 * k + 1
        system[row, scan.READING], system[below, scan.READING] = (
            readings[k, 0],
            readings[k, 1],
        )
        system[row, scan.VARIANCE], system[below, scan.VARIANCE] = variances(rules, at)
        linearise(mean, belief.reference, rules.linearisation, system, row, c)
        s00, s10, s11 = own_covariance(P, system, row, c)
        own[k, 0] = system[row, scan.INNOVATION] / math.sqrt(s00)
        own[k, 1] = system[below, scan.INNOVATION] / math.sqrt(s11)
        own[k, 2] = math.log(s00 * s11 - s10 * s10)
