"""Loop over runs and steps, compiled, with the kernels of a single filter."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import numpy as np

from ...arrays import Array, BoolArray, IntArray
from ...jit import jit, jit_in_place, njit_allocating, njit_internal
from ..models.bearing_range import expected_reading_jit
from ..models.rigid_motion import predict, propagate
from .scan_update import (
    ADDED,
    BLOCK,
    DONE,
    FIRST,
    JACOBIAN,
    LARGE,
    LEDGER_HEIGHT,
    MEAN_BEFORE,
    OUTCOME,
    SLOT,
    VARIANCE,
    BeliefArrays,
    Rules,
    absorb,
    add_landmark,
    as_rules,
    fill_slopes,
    refresh,
    refresh_pose,
    update_belief,
    usable,
    variances,
)

NEVER = -1


class RunArrays(NamedTuple):
    """The beliefs of B runs, each array with a leading run axis."""

    means: Array  # (B, capacity)
    covariances: Array  # (B, capacity, capacity)
    references: Array  # (B, capacity)
    slots: IntArray  # (B, L) place of each landmark in the map, -1 if not mapped
    mapped: IntArray  # (B,) number of mapped landmarks


class StepData(NamedTuple):
    """The data of T steps of B runs."""

    odometry: Array  # (B, T, 3), displacements (dx, dy, α) in the robot's frame
    measurements: Array  # (B, T, L, 2)
    visible: BoolArray  # (B, T, L)
    dt: Array  # (B, T), duration of each step


@jit
def drive_runs(
    run_arrays: tuple[Array, Array, Array, IntArray, IntArray],
    step_data: tuple[Array, Array, BoolArray, Array],
    trace: tuple[Array, Array, Array, IntArray],
    chosen: BoolArray,
    failed_at: IntArray,
    motion_values: Array,
    rule_values: Array,
    workspace_arrays: tuple[Array, Array],
) -> None:
    """Take each run through all its steps, in place.

    The arguments are plain tuples of the entries of :class:`RunArrays`,
    :class:`StepData` and :class:`.scan_update.Workspace`, because numba takes
    microseconds to recognise a NamedTuple.

    Parameters
    ----------
    trace
        On return: poses (B, T, 3), their covariances (B, T, 3, 3), NIS (B, T) and its
        degrees of freedom (B, T).
    chosen : ndarray of bool, shape (B,)
        The runs that take part.
    failed_at : ndarray, shape (B,)
        On return the step at which a chosen run failed, 0 if that was in an earlier
        call; NEVER if it did not.
    motion_values : ndarray, shape (4,)
        The variances (σx², σy², σα²), and 1 if a robot at rest has motion noise too.
    rule_values
        As :func:`.scan_update.as_rules` reads them.
    """
    runs, data = RunArrays(*run_arrays), StepData(*step_data)
    poses, pose_covariances, nis, degrees_of_freedom = trace
    room = new_room(runs.slots.shape[1], workspace_arrays)
    for b in range(len(chosen)):
        if not chosen[b]:
            continue
        if failed_at[b] != NEVER:
            failed_at[b] = 0
            continue
        mean, covariance = runs.means[b], runs.covariances[b]
        for t in range(data.dt.shape[1]):
            odometry, visible = data.odometry[b, t], data.visible[b, t]
            scan = odometry, data.measurements[b, t], visible
            used, nis[b, t] = step_run(
                b, runs, scan, data.dt[b, t], motion_values, rule_values, room
            )
            if used < 0:
                failed_at[b] = t
                break
            degrees_of_freedom[b, t] = used * as_rules(rule_values).numbers
            for i in range(3):
                poses[b, t, i] = mean[i]
                for j in range(3):
                    pose_covariances[b, t, i, j] = covariance[i, j]


@jit_in_place
def begin_runs(
    run_arrays: tuple[Any, ...], chosen: BoolArray, poses: Array, variances: Array
) -> None:
    """Restart the chosen runs, (B,), at poses (B, 3) with variances (3,)."""
    runs = RunArrays(*run_arrays)
    for b in range(len(chosen)):
        if chosen[b]:
            runs.means[b], runs.references[b], runs.covariances[b] = 0.0, 0.0, 0.0
            runs.slots[b], runs.mapped[b] = NEVER, 0
            for i in range(3):
                runs.means[b, i] = runs.references[b, i] = poses[b, i]
                runs.covariances[b, i, i] = variances[i]


class StepRoom(NamedTuple):
    """Room for one step of one run."""

    ledger: IntArray
    readings: Array
    ids: IntArray
    variance: Array
    workspace: tuple[Any, ...]


@njit_allocating
def new_room(landmarks: int, workspace_arrays: tuple[Any, ...]) -> StepRoom:
    """Allocate room for scans of so many landmarks."""
    return StepRoom(
        np.zeros((LEDGER_HEIGHT, landmarks), np.int64),
        np.empty((landmarks, 2)),
        np.empty(landmarks, np.int64),
        np.empty(3),
        workspace_arrays,
    )


@njit_internal
def step_run(
    b: int,
    runs: RunArrays,
    scan: tuple[Array, Array, BoolArray],
    dt: float,
    motion_values: Array,
    rule_values: Array,
    room: StepRoom,
) -> tuple[int, float]:
    """Take one run through a step: one predict and one update.

    Returns the number of readings of mapped landmarks in use, and their NIS; -1 and nan
    where the run fails.
    """
    mean, covariance = runs.means[b], runs.covariances[b]
    reference, slots = runs.references[b], runs.slots[b]
    ledger, readings, ids, variance, workspace = room
    odometry, measurements, visible = scan
    dx, dy, turn = odometry[0], odometry[1], odometry[2]
    m = gather(measurements, visible, slots, readings, ids, ledger)
    if not (usable(dx) and usable(dy) and usable(turn) and m >= 0):
        return -1, np.nan
    moves = dx != 0 or dy != 0 or turn != 0
    share = dt if motion_values[3] > 0 or moves else 0.0
    for i in range(3):
        variance[i] = motion_values[i] * share
    size, linearisation = 3 + 2 * runs.mapped[b], as_rules(rule_values).linearisation
    predict(mean, covariance, reference, size, dx, dy, turn, variance, linearisation)
    belief = mean, covariance, reference
    status, used, nis = update_belief(
        belief, size, readings, m, ledger, workspace, rule_values
    )
    if status != DONE:
        return -1, np.nan
    for k in range(m):
        if ledger[OUTCOME, k] == ADDED:
            slots[ids[k]] = runs.mapped[b]
            runs.mapped[b] += 1
    return used, nis


@njit_internal
def gather(
    measurements: Array,
    visible: BoolArray,
    slots: IntArray,
    readings: Array,
    ids: IntArray,
    ledger: IntArray,
) -> int:
    """Collect the readings of one step and the places of their landmarks in the map.

    Returns the number of readings, or -1 if one is not usable.
    """
    m = 0
    for i in range(len(visible)):
        if visible[i]:
            if not (usable(measurements[i, 0]) and usable(measurements[i, 1])):
                return -1
            readings[m, 0], readings[m, 1] = measurements[i, 0], measurements[i, 1]
            ids[m] = i
            ledger[SLOT, m] = slots[i]
            m += 1
    return m


# --------------------------------------------------------------------------------------
# Covariances alone, linearised at the truth: the bound of the errors of any filter.


class TrueDrives(NamedTuple):
    """What B runs of T scans do and read, without noise."""

    poses: Array  # (B, T, 3)
    places: Array  # (B, L, 2) of landmarks
    visible: BoolArray  # (B, T, L)
    dt: Array  # (B, T), duration of the motion before each scan
    pose_std: Array  # (B, T, 3), of readings of the poses, infinite where there is none


@jit
def drive_at_truth(
    covariances: Array,
    all_slots: IntArray,
    true_drives: tuple[Array, Array, BoolArray, Array, Array],
    least: Array,
    spread: Array,
    motion_variance: Array,
    rule_values: Array,
    rows: Array,
) -> None:
    """Take the covariance of each run through its true drive, in place.

    Parameters
    ----------
    covariances : ndarray, shape (B, capacity, capacity)
        On return the lower halves and the rows of the pose, landmarks in the order of
        their first readings; nan where an innovation covariance is not positive
        definite.
    all_slots : ndarray, shape (B, L)
        On return the place of each landmark in the map, NEVER if it was not read.
    true_drives : TrueDrives
        As a plain tuple.
    least : ndarray, shape (B, 3, T)
        On return the variance of the position in the invariant frame, that of the
        heading, and that of the position in the additive frame.
    spread : ndarray, shape (B,)
        On return the mean variance of a landmark about the centre of the map.
    motion_variance, rule_values
        (σx², σy², σα²), and rules as :func:`.scan_update.as_rules` reads them.
    rows
        As in :class:`.scan_update.Workspace`, for three more readings than in any scan.
    """
    drives, variance, truth = TrueDrives(*true_drives), np.empty(3), rows[MEAN_BEFORE]
    columns, rules = np.empty(all_slots.shape[1] + 3, np.int64), as_rules(rule_values)
    for b in range(len(spread)):
        P, slots, size = covariances[b], all_slots[b], 3
        for t in range(least.shape[2]):
            before, pose = drives.poses[b, max(t - 1, 0)], drives.poses[b, t]
            x, y = pose[0], pose[1]
            for i in range(3):
                truth[i], variance[i] = pose[i], motion_variance[i] * drives.dt[b, t]
            if t > 0:
                cos, sin = np.cos(before[2]), np.sin(before[2])
                propagate(P, size, before[1] - y, x - before[0], cos, sin, variance)
            scan = drives.places[b], drives.visible[b, t], drives.pose_std[b, t]
            size, used = linearise_at_truth(P, size, slots, scan, rules, rows, columns)
            if used > 0:
                block = BLOCK if size <= LARGE else used
                if absorb(P, size, rows, columns, used, block) >= 0:
                    P[:] = np.nan
                    break
                refresh_pose(P, size)
            least[b, 1, t], least[b, 2, t] = P[2, 2], P[0, 0] + P[1, 1]
            lever = 2 * (y * P[0, 2] - x * P[1, 2]) + (x * x + y * y) * P[2, 2]
            least[b, 0, t] = least[b, 2, t] + lever
        spread[b] = about_centre(P, size, truth)


@njit_internal
def linearise_at_truth(
    P: Array,
    size: int,
    slots: IntArray,
    scan: tuple[Array, BoolArray, Array],
    rules: Rules,
    rows: Array,
    columns: IntArray,
) -> tuple[int, int]:
    """Fill H and Q of one scan and of the readings of the pose; append new landmarks.

    Returns the length of the state, and the number of readings for `absorb`.
    """
    used, truth = 0, rows[MEAN_BEFORE]
    x, y, heading = truth[0], truth[1], truth[2]
    places, visible, pose_std = scan
    for k in range(len(slots)):
        if not visible[k]:
            continue
        dx, dy = places[k, 0] - x, places[k, 1] - y
        distance, row = np.sqrt(dx * dx + dy * dy), FIRST + 2 * used
        if distance < rules.min_range:
            continue
        if slots[k] == NEVER:
            z0, z1 = expected_reading_jit(dx, dy, heading)
            add_landmark(BeliefArrays(truth, P, truth), size, z0, z1, rules)
            slots[k], size = (size - 3) // 2, size + 2
            continue
        columns[used], used = 3 + 2 * slots[k], used + 1
        refresh(P, size, columns[used - 1])
        H = rows[row : row + 2, JACOBIAN : JACOBIAN + 5]
        fill_slopes(dx, dy, heading, H)
        rows[row, VARIANCE], rows[row + 1, VARIANCE] = variances(rules, distance)
    for axis in range(3):
        if pose_std[axis] < np.inf:
            row, columns[used], used = FIRST + 2 * used, 0, used + 1
            rows[row : row + 2, JACOBIAN : JACOBIAN + 5] = 0.0
            rows[row, JACOBIAN + axis] = 1.0
            rows[row, VARIANCE] = pose_std[axis] ** 2
            rows[row + 1, VARIANCE] = 1.0  # of a void row
    return size, used


@njit_internal
def about_centre(P: Array, size: int, mean: Array) -> float:
    """Return the mean variance of the landmarks about their centre, invariant frame."""
    own, of_sum, count = 0.0, 0.0, (size - 3) / 2
    if size == 3:
        return np.nan
    for i in range(3, size):
        u = mean[i + 1] if i % 2 else -mean[i - 1]  # of −J l
        for j in range(4 - i % 2, i + 1, 2):  # of the same axis
            v = mean[j + 1] if i % 2 else -mean[j - 1]
            shared = P[i, j] + u * P[2, j] + v * P[2, i] + u * v * P[2, 2]
            own += shared * (i == j)
            of_sum += shared * (2 - (i == j))
    return float((own - of_sum / count) / count)


# --------------------------------------------------------------------------------------
# Small shares: a thread whose core is busy then delays the others little.
SHARES_PER_THREAD = 8


def share_out(work: Callable[[slice], object], count: int, threads: int) -> None:
    """Do work on 0 … count − 1 in small slices, each by whichever thread is free.

    Compiled functions that release the interpreter run at the same time.

    Examples
    --------
    >>> share_out(print, 3, threads=1)
    slice(0, 3, None)
    """
    threads = min(threads, count)
    if threads <= 1:
        work(slice(0, count))
        return
    share = -(-count // (SHARES_PER_THREAD * threads))
    shares = [slice(start, start + share) for start in range(0, count, share)]
    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(work, shares))
