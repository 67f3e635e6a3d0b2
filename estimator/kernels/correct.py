"""One correction of a belief, compiled: linearise, condition, compose; iterated."""

from ...arrays import Array, IntArray
from ...jit import njit_inlined, njit_internal
from .belief_arrays import BeliefArrays
from .kalman_gain import absorb, block_of, mirror, times
from .linearise import linearise
from .retract import retract, transport
from .rules import INVARIANT, Rules
from .scan_rows import (
    COLUMN,
    CORRECTION,
    FIRST,
    INNOVATION,
    JACOBIAN,
    PRIOR_MEAN,
    Workspace,
    prior_system_jit,
)


@njit_inlined
def correct(
    belief: BeliefArrays,
    size: int,
    ledger: IntArray,
    rules: Rules,
    workspace: Workspace,
    top: int,
    bottom: int,
) -> int:
    """Condition the belief on the readings of some rows, at one linearisation.

    With more iterations the readings are linearised again at each iterate, always
    against the same prior (Bell and Cathey, 1993).  In the invariant frame the heading
    column of H keeps the prior's geometry: with the exact Gauss-Newton column the
    filter would believe that it observes its heading.

    Parameters
    ----------
    top, bottom
        Rows of the system, counted from FIRST.

    Returns
    -------
    int
        -1, or the row at which the innovation covariance is not positive definite; the
        covariance may then be spoilt.
    """
    mean, covariance = belief.mean, belief.covariance
    rows, columns = workspace.rows, ledger[COLUMN]
    system, prior_mean = rows[FIRST:], rows[PRIOR_MEAN]
    for j in range(size):
        prior_mean[j] = mean[j]
    if rules.iterations > 1:
        copy_covariance(covariance, workspace.prior, size)
    for iteration in range(rules.iterations):
        if iteration > 0:
            copy_covariance(workspace.prior, covariance, size)
        for row in range(top, bottom, 2):
            c = columns[row // 2]
            linearise(mean, belief.reference, rules.linearisation, system, row, c)
            if iteration > 0:
                relate_to_prior(rows, row, c, rules.frame)
        for j in range(size):
            mean[j] = prior_mean[j]
        block = block_of(size, (bottom - top) // 2)
        failed = absorb(covariance, size, rows, columns, top, bottom, block)
        if failed >= 0:
            return failed
        if iteration == 0 and rules.iterations > 1:
            save_prior_rows(rows, top, bottom)
        compose(mean, rows, size, rules.frame)
    if rules.frame == INVARIANT:
        transport(covariance, rows, size)
    mirror(covariance, size)
    return -1


@njit_internal
def compose(mean: Array, rows: Array, size: int, frame: int) -> None:
    """Compose the correction δ with the mean, by the error frame."""
    if frame == INVARIANT:
        retract(mean, rows, size)
        return
    for j in range(size):
        mean[j] += rows[CORRECTION, j]


@njit_internal
def relate_to_prior(rows: Array, row: int, c: int, frame: int) -> None:
    """Turn ν at an iterate into z − h + H δ, the innovation seen from the prior."""
    system, prior = rows[FIRST:], rows[PRIOR_MEAN]
    dx, dy = prior[c] - prior[0], prior[c + 1] - prior[1]
    for i in range(row, row + 2):
        h = system[i, JACOBIAN : JACOBIAN + 5]
        if frame == INVARIANT:
            h[2] = h[3] * dy - h[4] * dx
        system[i, INNOVATION] += times(system, i, c, rows[CORRECTION])


@njit_internal
def save_prior_rows(rows: Array, top: int, bottom: int) -> None:
    """Copy rows of the system linearised at the prior to where the report reads them.

    The next iterate overwrites the system itself.
    """
    system, saved = rows[FIRST:], rows[prior_system_jit(len(rows), 2) :]
    for row in range(top, bottom):
        for j in range(rows.shape[1]):
            saved[row, j] = system[row, j]


@njit_internal
def copy_covariance(source: Array, target: Array, size: int) -> None:
    """Copy a covariance."""
    for i in range(size):
        for j in range(size):
            target[i, j] = source[i, j]
