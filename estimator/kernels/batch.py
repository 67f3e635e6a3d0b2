"""The loop over runs and steps, compiled; the arithmetic is that of one filter."""

import numpy as np
from numpy.typing import NDArray

from ..support.jit import compiled, part
from .predict import Array, Int, predict
from .scan_update import ADDED, DONE, FATE, SLOT, as_rules, update_belief, usable

NEVER = -1


@compiled
def drive_runs(  # every array of a batch once, with a leading run axis
    means: Array,
    covariances: Array,
    references: Array,
    slots: Int,
    mapped: Int,
    rule_values: Array,
    motion_values: Array,
    odometry: Array,
    measurements: Array,
    visible: NDArray[np.bool_],
    dt: Array,
    poses: Array,
    pose_covariances: Array,
    nis: Array,
    freedom: Int,
    failed_at: Int,
    rows: Array,
    before: Array,
    prior: Array,
) -> None:
    """Take each run through all its steps, in place.

    ``motion_values`` holds the variances (σx², σy², σα²) and 1 where a robot at rest
    has motion noise too; ``rows``, ``before`` and ``prior`` are a workspace.
    """
    rules = as_rules(rule_values)
    landmarks = slots.shape[1]
    ledger = np.zeros((3, landmarks), np.int64)
    readings = np.empty((landmarks, 2))
    ids = np.empty(landmarks, np.int64)
    variance = np.empty(3)
    for b in range(len(means)):
        if failed_at[b] != NEVER:
            failed_at[b] = 0
            continue
        mean, covariance = means[b], covariances[b]
        for t in range(len(dt)):
            d, turn = odometry[b, t, 0], odometry[b, t, 1]
            m = gather(
                measurements[b, t], visible[b, t], slots[b], readings, ids, ledger
            )
            if not (usable(d) and usable(turn) and m >= 0):
                failed_at[b] = t
                break
            share = dt[t] if motion_values[3] > 0 or d != 0 or turn != 0 else 0.0
            for i in range(3):
                variance[i] = motion_values[i] * share
            size = 3 + 2 * mapped[b]
            predict(
                mean,
                covariance,
                size,
                d,
                turn,
                variance,
                rules.linearisation,
                references[b],
            )
            outcome, used, nis[b, t] = update_belief(
                mean,
                covariance,
                size,
                readings,
                m,
                references[b],
                rule_values,
                rows,
                before,
                prior,
                ledger,
            )
            if outcome != DONE:
                nis[b, t] = np.nan
                failed_at[b] = t
                break
            freedom[b, t] = 2 * used
            mapped[b] += note_new(m, ids, ledger, slots[b], mapped[b])
            for i in range(3):
                poses[b, t, i] = mean[i]
                for j in range(3):
                    pose_covariances[b, t, i, j] = covariance[i, j]


@part
def gather(
    measurements: Array,
    visible: NDArray[np.bool_],
    slots: Int,
    readings: Array,
    ids: Int,
    ledger: Int,
) -> int:
    """Collect the readings that there are, and their places in the map.

    Returns how many, or -1 where one is not usable.
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


@part
def note_new(m: int, ids: Int, ledger: Int, slots: Int, mapped: int) -> int:
    """Give the added landmarks their places in the map; return how many."""
    added = 0
    for k in range(m):
        if ledger[FATE, k] == ADDED:
            slots[ids[k]] = mapped + added
            added += 1
    return added
