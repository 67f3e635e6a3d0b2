"""One scan's update of one run, compiled: screen, gate, correct, map new landmarks."""

from typing import NamedTuple

import numpy as np

from ..support.argument_checks import LARGEST
from ..support.jit import compiled, inlined, part
from .covariance_update import absorb, block_of, mirror, times
from .predict import (
    AT_ESTIMATE,
    INVARIANT,
    Array,
    Int,
    add_landmark,
    linearise,
    retract,
    transport,
)
from .scan_rows import (
    COLUMN,
    FIRST,
    HEAD,
    INNOVATION,
    JACOBIAN,
    MEAN_BEFORE,
    PRIOR_MEAN,
    READING,
    ROOT,
    SHIFT,
    VARIANCE,
    WHITE,
)

# Rows of the ledger of one scan.
SLOT, FATE, NEAR = 0, 1, 2

# What became of a reading.
USED, ADDED, GATED, SKIPPED = 0, 1, 2, 3

# What became of the whole call, where it is not the row that failed.
DONE, NOT_USABLE = -1, -2


class Rules(NamedTuple):
    """What distinguishes one filter's update from another's; plain numbers."""

    linearisation: int = AT_ESTIMATE
    frame: int = 0
    iterations: int = 1
    sequential: bool = False
    correlated: bool = True
    bearing_std: float = 0.0  # [rad]
    range_std: float = 0.0  # [m]
    range_std_per_metre: float = 0.0
    min_range: float = 1e-3  # [m]
    gate: float = np.inf  # largest NIS of one reading
    noise_as_read: bool = False  # take σr at the range as read, not as expected


def first_kept(height: int, iterations: int) -> int:
    """First row of what was found at the prior, in a workspace of so many rows."""
    return FIRST if iterations == 1 else FIRST + (height - FIRST) // 2


_first_kept = part(first_kept)


@part
def set_aside(rows: Array, top: int, bottom: int) -> None:
    """Copy some rows to where :func:`first_kept` has them."""
    down = _first_kept(len(rows), 2) - FIRST
    for row in range(top, bottom):
        for j in range(rows.shape[1]):
            rows[row + down, j] = rows[row, j]


@part
def usable(value: float) -> bool:
    """Whether a number is finite, and its square with room to spare."""
    return abs(value) <= LARGEST


@part
def keep(source: Array, target: Array, size: int) -> None:
    """Copy a covariance."""
    for i in range(size):
        for j in range(size):
            target[i, j] = source[i, j]


@inlined
def as_rules(values: Array) -> Rules:
    """Read rules from the array ``numpy.array(rules)``: one argument, not ten."""
    return Rules(
        int(values[0]),
        int(values[1]),
        int(values[2]),
        values[3] > 0,
        values[4] > 0,
        values[5],
        values[6],
        values[7],
        values[8],
        values[9],
        values[10] > 0,
    )


@inlined
def correct(
    mean: Array,
    covariance: Array,
    size: int,
    reference: Array,
    rules: Rules,
    rows: Array,
    prior: Array,
    top: int,
    bottom: int,
) -> int:
    """Condition the belief on the readings of some rows at one linearisation.

    With more iterations the readings are linearised again at each iterate, always
    against the same prior (Bell and Cathey, 1993); what was found at the prior is kept
    further down, at :func:`first_kept`.  In the invariant frame the heading column of H
    is kept at the prior's geometry: the exact Gauss-Newton column would make the filter
    believe that it sees its heading.

    Returns
    -------
    int
        -1, or the row at which the innovation covariance is not positive definite; the
        covariance may then be spoilt.
    """
    for j in range(size):
        rows[PRIOR_MEAN, j] = mean[j]
    if rules.iterations > 1:
        keep(covariance, prior, size)
    for iteration in range(rules.iterations):
        if iteration > 0:
            keep(prior, covariance, size)
        for row in range(top, bottom, 2):
            linearise(mean, reference, rules.linearisation, rows, row)
            if iteration > 0:
                relate_to_prior(rows, row, rules.frame)
        for j in range(size):
            mean[j] = rows[PRIOR_MEAN, j]
        block = block_of(size, (bottom - top) // 2)
        failed = absorb(covariance, size, rows, top, bottom, block)
        if failed >= 0:
            return failed
        if iteration == 0 and rules.iterations > 1:
            set_aside(rows, top, bottom)
        move(mean, rows, size, rules.frame)
    if rules.frame == INVARIANT:
        transport(covariance, rows, size)
    mirror(covariance, size)
    return -1


@part
def move(mean: Array, rows: Array, size: int, frame: int) -> None:
    """Compose the correction δ with the state, as the error frame has it."""
    if frame == INVARIANT:
        retract(mean, rows, size)
        return
    for j in range(size):
        mean[j] += rows[SHIFT, j]


@part
def relate_to_prior(rows: Array, row: int, frame: int) -> None:
    """Turn ν at an iterate into z − h + H δ, the innovation seen from the prior."""
    c = int(rows[row, COLUMN])
    dx = rows[PRIOR_MEAN, c] - rows[PRIOR_MEAN, 0]
    dy = rows[PRIOR_MEAN, c + 1] - rows[PRIOR_MEAN, 1]
    for i in range(row, row + 2):
        if frame == INVARIANT:
            turned = rows[i, JACOBIAN + 3] * dy - rows[i, JACOBIAN + 4] * dx
            rows[i, JACOBIAN + 2] = turned
        rows[i, INNOVATION] += times(rows, i, SHIFT)


@part
def squared_innovation(covariance: Array, rows: Array, row: int) -> float:
    """NIS of one reading by itself, for the gate."""
    c, below = int(rows[row, COLUMN]), row + 1
    s00, s10, s11 = rows[row, VARIANCE], 0.0, rows[below, VARIANCE]
    for i in range(5):
        at_i = i if i < 3 else c + i - 3
        for j in range(5):
            entry = covariance[at_i, j if j < 3 else c + j - 3]
            h0, h1 = rows[row, JACOBIAN + j], rows[below, JACOBIAN + j]
            s00 += rows[row, JACOBIAN + i] * entry * h0
            s10 += rows[below, JACOBIAN + i] * entry * h0
            s11 += rows[below, JACOBIAN + i] * entry * h1
    n0, n1 = rows[row, INNOVATION], rows[below, INNOVATION]
    weighted = n0 * n0 * s11 - 2 * n0 * n1 * s10 + n1 * n1 * s00
    nis: float = weighted / (s00 * s11 - s10 * s10)
    return nis


@part
def meets(mean: Array, covariance: Array, column: int) -> bool:
    """Whether the robot is within 10 σ of a landmark, where linearising fails.

    σ is the largest deviation of the landmark's place in the robot's frame, whose error
    is e_l − e_p − J δ e_θ: a doubt about the heading of the whole map is none here.
    """
    P, c = covariance, column
    dx, dy = mean[c] - mean[0], mean[c + 1] - mean[1]
    x_turn, y_turn = P[c, 2] - P[0, 2], P[c + 1, 2] - P[1, 2]
    xx = P[c, c] - 2 * P[c, 0] + P[0, 0] + 2 * dy * x_turn + dy * dy * P[2, 2]
    yy = P[c + 1, c + 1] - 2 * P[c + 1, 1] + P[1, 1]
    yy += dx * dx * P[2, 2] - 2 * dx * y_turn
    xy = P[c, c + 1] - P[c, 1] - P[c + 1, 0] + P[0, 1]
    xy += dy * y_turn - dx * x_turn - dx * dy * P[2, 2]
    spread = (xx + yy) / 2 + np.sqrt(((xx - yy) / 2) ** 2 + xy * xy)
    return bool(dx * dx + dy * dy < 100 * spread)


@part
def screen(
    mean: Array,
    covariance: Array,
    readings: Array,
    count: int,
    reference: Array,
    rules: Rules,
    rows: Array,
    ledger: Int,
) -> int:
    """Decide the fate of every reading and gather those to use; change no belief."""
    used = 0
    for k in range(count):
        bearing, distance = readings[k, 0], readings[k, 1]
        column = 3 + 2 * ledger[SLOT, k]
        ledger[FATE, k] = ADDED if ledger[SLOT, k] < 0 else USED
        ledger[NEAR, k] = 0
        if distance < rules.min_range:
            ledger[FATE, k] = SKIPPED
        if ledger[FATE, k] != USED:
            continue
        dx, dy = mean[column] - mean[0], mean[column + 1] - mean[1]
        expected = np.sqrt(dx * dx + dy * dy)
        if expected < rules.min_range:
            ledger[FATE, k] = SKIPPED
            continue
        row = FIRST + 2 * used
        rows[row, COLUMN] = rows[row + 1, COLUMN] = column
        rows[row, READING], rows[row + 1, READING] = bearing, distance
        # The range as read makes σr small just where its error is negative.
        at = distance if rules.noise_as_read else expected
        rows[row, VARIANCE] = rules.bearing_std**2
        rows[row + 1, VARIANCE] = range_variance(rules, at)
        ledger[NEAR, k] = meets(mean, covariance, column)
        if rules.gate < np.inf:
            linearise(mean, reference, rules.linearisation, rows, row)
            if not squared_innovation(covariance, rows, row) <= rules.gate:
                ledger[FATE, k] = GATED
                continue
        used += 1
    return used


@part
def range_variance(rules: Rules, distance: float) -> float:
    """σr² of a reading at that range [m]."""
    return (rules.range_std + rules.range_std_per_metre * distance) ** 2


@compiled
def update_belief(
    mean: Array,
    covariance: Array,
    size: int,
    readings: Array,
    count: int,
    reference: Array,
    rule_values: Array,
    rows: Array,
    before: Array,
    prior: Array,
    ledger: Int,
) -> tuple[int, int, float]:
    """Update one belief with one scan, in place.

    Parameters
    ----------
    mean, covariance, size
        The belief, with room for the landmarks to add.
    readings : ndarray, shape (at least count, 2)
        Rows (β, r) [rad, m].
    reference : ndarray, shape (capacity,)
        Points at which Jacobians are taken, where the rules say so.
    rule_values
        What the filter does, as :func:`as_rules` reads it.
    rows, before, prior
        A :class:`.workspace.Workspace`.  On return its rows hold what
        :func:`record` reads.
    ledger : ndarray of int64, shape (3, at least count)
        Row SLOT: place of each reading's landmark in the map, negative for a new one.
        On return, row FATE: USED, ADDED, GATED or SKIPPED; row NEAR: whether the
        landmark was met.

    Returns
    -------
    outcome : int
        DONE, NOT_USABLE, or which reading, of those in use, has an innovation
        covariance that is not positive definite.  Unless DONE, nothing has changed.
    used : int
        Number of readings of mapped landmarks in use.
    nis : float
        νᵀ S⁻¹ ν over them.
    """
    rules = as_rules(rule_values)
    for k in range(count):
        if not (usable(readings[k, 0]) and usable(readings[k, 1])):
            return NOT_USABLE, 0, 0.0
    used = screen(mean, covariance, readings, count, reference, rules, rows, ledger)
    repeated = rules.sequential or rules.iterations > 1
    spoilable = repeated or used > block_of(size, used)
    if spoilable:
        keep(covariance, before, size)
        for j in range(size):
            rows[MEAN_BEFORE, j] = mean[j]
    bottom = FIRST + 2 * used
    height = 2 if rules.sequential else max(bottom - FIRST, 1)
    for top in range(FIRST, bottom, height):
        failed = correct(
            mean, covariance, size, reference, rules, rows, prior, top, top + height
        )
        if failed >= 0:
            if spoilable:
                keep(before, covariance, size)
                for j in range(size):
                    mean[j] = rows[MEAN_BEFORE, j]
            return (failed - FIRST) // 2, used, 0.0
    nis = 0.0
    first = _first_kept(len(rows), rules.iterations)
    for row in range(first, first + 2 * used):
        nis += rows[row, WHITE] * rows[row, WHITE]
    for k in range(count):
        if ledger[FATE, k] == ADDED:
            add_landmark(
                mean,
                covariance,
                size,
                readings[k, 0],
                readings[k, 1],
                rules.bearing_std**2,
                range_variance(rules, readings[k, 1]),
                rules.linearisation,
                reference,
                rules.correlated,
            )
            size += 2
    return DONE, used, nis


def record(rows: Array, used: int, rules: Rules) -> Array:
    """Copy what a report says of a scan out of the rows of its update.

    Of A no more than the columns of the pose and of the landmarks read, where the map
    is much larger than the scan; COLUMN then counts in these.

    Returns
    -------
    ndarray, shape (2m, at least 3 + 2m + HEAD)
    """
    first = first_kept(len(rows), rules.iterations)
    found = rows[first : first + 2 * used]
    if found.shape[1] <= 4 * (3 + 2 * used + HEAD):
        return found.copy()
    columns = found[::2, COLUMN].astype(np.int64)
    landmarks = np.stack([columns, columns + 1], axis=1).ravel()
    chosen = np.concatenate([[0, 1, 2], landmarks, np.arange(-HEAD, 0)])
    compact: Array = found[:, chosen]
    compact[:, COLUMN] = 3 + np.arange(2 * used) // 2 * 2
    return compact


def joint_factor(record: Array, sequential: bool = False) -> Array:
    """Put together L of S = L Lᵀ from the :func:`record` of an update.

    Off its diagonal blocks L = H Aᵀ, since Q is diagonal; or 0 where each reading had
    a linearisation of its own.

    Returns
    -------
    ndarray, shape (2m, 2m), lower triangular
    """
    every = np.arange(len(record))
    columns = record[:, COLUMN].astype(np.int64)
    factor = np.zeros((len(record), len(record)))
    if not sequential:
        pose = record[:, JACOBIAN : JACOBIAN + 3] @ record[:, :3].T
        x = record[every, JACOBIAN + 3, None] * record[:, columns].T
        y = record[every, JACOBIAN + 4, None] * record[:, columns + 1].T
        factor = np.tril(pose + x + y)
    for k in range(0, len(record), 2):
        factor[k : k + 2, k : k + 2] = record[k : k + 2, ROOT : ROOT + 2]
    return factor
