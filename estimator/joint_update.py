"""One scan's update of one run, compiled: screen, gate, correct, map new landmarks."""

from typing import NamedTuple

import numpy as np

from .compiled import compiled, inlined, part
from .kernels import (
    AT_ESTIMATE,
    INVARIANT,
    Array,
    Int,
    absorb,
    add_landmark,
    linearise,
    retract,
    times,
    transport,
)

# Rows of the ledger of one scan.
SLOT, FATE, NEAR, COLUMN = 0, 1, 2, 3

# What became of a reading.
USED, ADDED, GATED, SKIPPED = 0, 1, 2, 3

# What became of the whole call, where it is not the row that failed.
DONE, NOT_FINITE = -1, -2

# Above this size of the state, one pass over P costs more than a triangular solve.
LARGE = 250
BLOCK = 6  # readings absorbed at a time below it


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


class Workspace(NamedTuple):
    """Room for the intermediate results of one update of up to m readings.

    Where there are two stages, the first holds what was found at the prior, the second
    what was found at a later iterate.
    """

    readings: Array  # (m, 2) the readings in use
    variances: Array  # (m, 2)
    jacobians: Array  # (stages, m, 2, 5)
    innovations: Array  # (stages, m, 2)
    roots: Array  # (stages, m, 3)
    white: Array  # (stages, 2m)
    gains: Array  # (stages, 2m, capacity)
    vectors: Array  # (4, capacity): δ, way, prior mean, heading column
    prior: Array  # (capacity, capacity) P to iterate from, or empty
    before: Array  # (capacity, capacity) P to go back to on failure, or empty
    mean_before: Array  # (capacity,)


@inlined
def new_workspace(m: int, size: int, capacity: int, rules: Rules) -> Workspace:
    """Allocate for ``m`` readings of a belief of that size and capacity."""
    stages = min(rules.iterations, 2)
    iterated = capacity if rules.iterations > 1 else 0
    spoilable = rules.iterations > 1 or rules.sequential or m > BLOCK
    kept = capacity if spoilable else 0
    return Workspace(
        np.empty((m, 2)),
        np.empty((m, 2)),
        np.empty((stages, m, 2, 5)),
        np.empty((stages, m, 2)),
        np.empty((stages, m, 3)),
        np.empty((stages, 2 * m)),
        np.empty((stages, 2 * m, capacity)),
        np.empty((4, capacity)),
        np.empty((iterated, iterated)),
        np.empty((kept, kept)),
        np.empty(capacity),
    )


@part
def block_of(size: int, readings: int) -> int:
    """How many readings to absorb at a time: a few while P fits the fast caches."""
    return BLOCK if size <= LARGE else max(readings, 1)


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
    work: Workspace,
    every_column: Int,
    first: int,
    last: int,
) -> int:
    """Condition the belief on readings ``first`` to ``last`` at one linearisation.

    With more iterations the readings are linearised again at each iterate, always
    against the same prior (Bell and Cathey, 1993); NIS, ν and S stay those at the
    prior.  In the invariant frame the heading column of H is kept at the prior's
    geometry: the exact Gauss-Newton column would make the filter believe that it sees
    its heading.

    Returns
    -------
    int
        -1, or the row whose innovation covariance is not positive definite; the
        covariance may then be spoilt.
    """
    columns, readings = every_column[first:last], work.readings[first:last]
    shift, way = work.vectors[0], work.vectors[1]
    prior, heading = work.vectors[2], work.vectors[3]
    for j in range(size):
        prior[j] = mean[j]
    if rules.iterations > 1:
        keep(covariance, work.prior, size)
    for iteration in range(rules.iterations):
        stage = min(iteration, 1)
        jacobians = work.jacobians[stage, first:last]
        innovations = work.innovations[stage, first:last]
        if iteration > 0:
            keep(work.prior, covariance, size)
        for k in range(last - first):
            c, where = columns[k], rules.linearisation
            linearise(mean, reference, c, where, readings, k, jacobians, innovations)
            if iteration > 0:
                relate_to_prior(
                    prior, work.vectors, c, rules.frame, jacobians, innovations, k
                )
        for j in range(size):
            mean[j] = prior[j]
        failed = absorb(
            covariance,
            size,
            columns,
            jacobians,
            work.variances[first:last],
            innovations,
            work.gains[stage, 2 * first : 2 * last],
            work.roots[stage, first:last],
            work.white[stage, 2 * first : 2 * last],
            work.vectors,
            block_of(size, last - first),
        )
        if failed >= 0:
            return first + failed
        move(mean, shift, way, size, rules.frame)
    if rules.frame == INVARIANT:
        transport(covariance, size, way, heading)
    return -1


@part
def move(mean: Array, shift: Array, way: Array, size: int, frame: int) -> None:
    """Compose the correction δ with the state, as the error frame has it."""
    for j in range(size):
        way[j] = shift[j]
    if frame == INVARIANT:
        retract(mean, way, size)
        return
    for j in range(size):
        mean[j] += shift[j]


@part
def relate_to_prior(
    prior: Array,
    shift: Array,
    c: int,
    frame: int,
    jacobians: Array,
    innovations: Array,
    k: int,
) -> None:
    """Turn ν at an iterate into z − h + H δ, the innovation seen from the prior."""
    if frame == INVARIANT:
        dx, dy = prior[c] - prior[0], prior[c + 1] - prior[1]
        for i in range(2):
            jacobians[k, i, 2] = jacobians[k, i, 3] * dy - jacobians[k, i, 4] * dx
    for i in range(2):
        innovations[k, i] += times(jacobians, k, i, shift, 0, c)


@part
def squared_innovation(
    covariance: Array, column: int, H: Array, variance: Array, innovation: Array
) -> float:
    """NIS of one reading by itself, for the gate."""
    s00 = _spread(covariance, column, H, 0, 0) + variance[0]
    s10 = _spread(covariance, column, H, 1, 0)
    s11 = _spread(covariance, column, H, 1, 1) + variance[1]
    n0, n1 = innovation[0], innovation[1]
    weighted = n0 * n0 * s11 - 2 * n0 * n1 * s10 + n1 * n1 * s00
    nis: float = weighted / (s00 * s11 - s10 * s10)
    return nis


@part
def _spread(covariance: Array, column: int, H: Array, i: int, j: int) -> float:
    """One entry of H P Hᵀ."""
    total = 0.0
    for a in range(5):
        at_a = a if a < 3 else column + a - 3
        for b in range(5):
            at_b = b if b < 3 else column + b - 3
            total += H[i, a] * covariance[at_a, at_b] * H[j, b]
    return total


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


@inlined
def screen(
    mean: Array,
    covariance: Array,
    readings: Array,
    reference: Array,
    rules: Rules,
    work: Workspace,
    ledger: Int,
) -> int:
    """Decide the fate of every reading and gather those to use; change no belief."""
    used = 0
    for k in range(len(readings)):
        column = 3 + 2 * ledger[SLOT, k]
        ledger[FATE, k] = ADDED if ledger[SLOT, k] < 0 else USED
        ledger[NEAR, k] = 0
        if readings[k, 1] < rules.min_range:
            ledger[FATE, k] = SKIPPED
        if ledger[FATE, k] != USED:
            continue
        dx, dy = mean[column] - mean[0], mean[column + 1] - mean[1]
        expected = np.sqrt(dx * dx + dy * dy)
        if expected < rules.min_range:
            ledger[FATE, k] = SKIPPED
            continue
        ledger[COLUMN, used] = column
        work.readings[used, 0] = readings[k, 0]
        work.readings[used, 1] = readings[k, 1]
        # The range as read makes σr small just where its error is negative.
        at = readings[k, 1] if rules.noise_as_read else expected
        set_variance(rules, at, work.variances[used])
        ledger[NEAR, k] = meets(mean, covariance, column)
        if rules.gate < np.inf:
            where, H, nu = rules.linearisation, work.jacobians[0], work.innovations[0]
            linearise(mean, reference, column, where, work.readings, used, H, nu)
            variance = work.variances[used]
            nis = squared_innovation(covariance, column, H[used], variance, nu[used])
            if not nis <= rules.gate:
                ledger[FATE, k] = GATED
                continue
        used += 1
    return used


@part
def set_variance(rules: Rules, distance: float, variance: Array) -> None:
    """Diagonal of Q for a reading at that range [m]."""
    variance[0] = rules.bearing_std**2
    variance[1] = (rules.range_std + rules.range_std_per_metre * distance) ** 2


@inlined
def update_belief(
    mean: Array,
    covariance: Array,
    size: int,
    readings: Array,
    reference: Array,
    rules: Rules,
    work: Workspace,
    ledger: Int,
) -> tuple[int, int, float]:
    """Update one belief with one scan, in place.

    Parameters
    ----------
    mean, covariance, size
        The belief, with room for the landmarks to add.
    readings : ndarray, shape (m, 2)
        Rows (β, r) [rad, m].
    reference : ndarray, shape (capacity,)
        Points at which Jacobians are taken, where the rules say so.
    rules, work
        What the filter does, and room to do it.
    ledger : ndarray of int64, shape (4, at least m)
        Row SLOT: place of each reading's landmark in the map, negative for a new one.
        On return, row FATE: USED, ADDED, GATED or SKIPPED; row NEAR: whether the
        landmark was met; row COLUMN: columns of the landmarks in use.

    Returns
    -------
    outcome : int
        DONE, NOT_FINITE, or the row (of those in use) whose innovation covariance is
        not positive definite.  Unless DONE, nothing has changed.
    used : int
        Number of readings of mapped landmarks in use.
    nis : float
        νᵀ S⁻¹ ν over them.
    """
    m = len(readings)
    for k in range(m):
        if not (np.isfinite(readings[k, 0]) and np.isfinite(readings[k, 1])):
            return NOT_FINITE, 0, 0.0
    used = screen(mean, covariance, readings, reference, rules, work, ledger)
    batch = 1 if rules.sequential else max(used, 1)
    spoilable = len(work.before) > 0 and used > 0
    if spoilable:
        keep(covariance, work.before, size)
        for j in range(size):
            work.mean_before[j] = mean[j]
    for k in range(0, used, batch):
        failed = correct(
            mean, covariance, size, reference, rules, work, ledger[COLUMN], k, k + batch
        )
        if failed >= 0:
            if spoilable:
                keep(work.before, covariance, size)
                for j in range(size):
                    mean[j] = work.mean_before[j]
            return failed, used, 0.0
    nis = 0.0
    for row in range(2 * used):
        nis += work.white[0, row] * work.white[0, row]
    for k in range(m):
        if ledger[FATE, k] == ADDED:
            variance = work.variances[0]
            set_variance(rules, readings[k, 1], variance)
            add_landmark(
                mean,
                covariance,
                size,
                readings[k],
                variance,
                rules.linearisation,
                reference,
                rules.correlated,
            )
            size += 2
    return DONE, used, nis


@compiled
def update_one(
    mean: Array,
    covariance: Array,
    size: int,
    readings: Array,
    reference: Array,
    rule_values: Array,
    ledger: Int,
) -> tuple[int, int, float, Array, Array]:
    """Update a single filter: :func:`update_belief` with a workspace of its own.

    Returns outcome, used and nis of :func:`update_belief`, and of the readings used ν
    (m, 2) and what :func:`joint_factor` needs, (2m, 10 + 2m): for each row of the scan
    its five entries of H, its row of the diagonal block of L, and its row of A in the
    columns of the pose and of the landmarks read after its own.
    """
    rules = as_rules(rule_values)
    work = new_workspace(len(readings), size, len(mean), rules)
    outcome, used, nis = update_belief(
        mean, covariance, size, readings, reference, rules, work, ledger
    )
    if outcome != DONE:
        return outcome, used, nis, work.readings, work.readings
    record = np.zeros((2 * used, 10 + 2 * used))
    for k in range(used):
        for i in range(2):
            row = 2 * k + i
            for j in range(5):
                record[row, j] = work.jacobians[0, k, i, j]
            record[row, 5] = work.roots[0, k, i]
            record[row, 6] = work.roots[0, k, 2 * i]
            if rules.sequential:  # each reading has a linearisation of its own
                continue
            for j in range(3):
                record[row, 7 + j] = work.gains[0, row, j]
            for j in range(k + 1, used):
                c = ledger[COLUMN, j]
                record[row, 10 + 2 * j] = work.gains[0, row, c]
                record[row, 11 + 2 * j] = work.gains[0, row, c + 1]
    return outcome, used, nis, work.innovations[0, :used], record


def joint_factor(record: Array) -> Array:
    """Put together L of S = L Lᵀ from the record of :func:`update_one`.

    Off its diagonal blocks L = H Aᵀ, since Q is diagonal.

    Returns
    -------
    ndarray, shape (2m, 2m), lower triangular
    """
    m = len(record) // 2
    H = np.zeros((2 * m, 3 + 2 * m))
    H[:, :3] = record[:, :3]
    for k in range(m):
        rows = slice(2 * k, 2 * k + 2)
        H[rows, 3 + 2 * k : 5 + 2 * k] = record[rows, 3:5]
    factor = np.tril(H @ record[:, 7:].T)
    for k in range(0, 2 * m, 2):
        (l00, _), (l10, l11) = record[k : k + 2, 5:7]
        factor[k : k + 2, k : k + 2] = (l00, 0.0), (l10, l11)
    return factor
