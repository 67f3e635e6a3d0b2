"""Loop over runs and steps, compiled, with the kernels of a single filter."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import numpy as np

from ...arrays import Array, BoolArray, IntArray
from ...jit import jit, jit_in_place, njit_allocating, njit_internal
from ..models.rigid_motion import predict
from .scan_update import (
    ADDED,
    DONE,
    LEDGER_HEIGHT,
    OUTCOME,
    SLOT,
    as_rules,
    update_belief,
    usable,
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
