"""Update of one belief by one scan, compiled: screen, correct, map new landmarks."""

from ...arrays import Array, IntArray
from ...jit import jit
from .add_landmark import add_landmark
from .belief_arrays import BeliefArrays
from .correct import copy_covariance, correct
from .kalman_gain import block_of
from .rules import as_rules
from .scan_rows import (
    ADDED,
    MEAN_BEFORE,
    OUTCOME,
    SLOT,
    WHITE,
    Workspace,
    prior_system_jit,
)
from .screen import bearing_variance, range_variance, screen, usable

# Status of an update, where it is not the reading that failed.
DONE, NOT_USABLE = -1, -2


@jit
def update_belief(
    mean: Array,
    covariance: Array,
    reference: Array,
    size: int,
    readings: Array,
    count: int,
    ledger: IntArray,
    rows: Array,
    before: Array,
    prior: Array,
    rule_values: Array,
) -> tuple[int, int, float]:
    """Update one belief with one scan, in place.

    From Python, call it with ``*belief`` and ``*workspace``, the arrays of these
    NamedTuples one by one: numba takes microseconds to recognise a NamedTuple.

    Parameters
    ----------
    mean, covariance, reference
        :class:`.belief_arrays.BeliefArrays`, with room for the landmarks to add.
    size : int
        Length of the state.
    readings : ndarray, shape (at least count, 2)
        Rows (β, r) [rad, m].
    ledger
        A :func:`.scan_rows.new_ledger` whose row SLOT holds the place of each reading's
        landmark in the map.  On return its other rows are filled, and SLOT holds the
        places of added landmarks, too.
    rows, before, prior
        A :class:`.scan_rows.Workspace`.  On return :func:`.scan_record.record` reads
        the rows.
    rule_values
        The filter's rules, as :func:`.rules.as_rules` reads them.

    Returns
    -------
    status : int
        DONE, NOT_USABLE, or which reading, of those in use, has an innovation
        covariance that is not positive definite.  Unless DONE, nothing has changed.
    used : int
        Number of readings of mapped landmarks in use.
    nis : float
        νᵀ S⁻¹ ν over them.
    """
    belief = BeliefArrays(mean, covariance, reference)
    workspace = Workspace(rows, before, prior)
    rules = as_rules(rule_values)
    for k in range(count):
        if not (usable(readings[k, 0]) and usable(readings[k, 1])):
            return NOT_USABLE, 0, 0.0
    used = screen(belief, readings, count, rules, rows, ledger)
    repeated = rules.sequential or rules.iterations > 1
    spoilable = repeated or used > block_of(size, used)
    if spoilable:
        copy_covariance(belief.covariance, workspace.before, size)
        for j in range(size):
            rows[MEAN_BEFORE, j] = belief.mean[j]
    height = 2 if rules.sequential else max(2 * used, 1)
    for top in range(0, 2 * used, height):
        failed = correct(belief, size, ledger, rules, workspace, top, top + height)
        if failed >= 0:
            if spoilable:
                copy_covariance(workspace.before, belief.covariance, size)
                for j in range(size):
                    belief.mean[j] = rows[MEAN_BEFORE, j]
            return failed // 2, used, 0.0
    nis = 0.0
    first = prior_system_jit(len(rows), rules.iterations)
    for row in range(first, first + 2 * used):
        nis += rows[row, WHITE] * rows[row, WHITE]
    for k in range(count):
        if ledger[OUTCOME, k] == ADDED:
            add_landmark(
                belief,
                size,
                readings[k, 0],
                readings[k, 1],
                bearing_variance(rules, readings[k, 1]),
                range_variance(rules, readings[k, 1]),
                rules.linearisation,
                rules.correlated,
            )
            ledger[SLOT, k] = (size - 3) // 2
            size += 2
    return DONE, used, nis
