"""Search for the cheapest joint assignments of a scan, compiled.

:mod:`slamgym.estimator.association.joint_assignment` has the equations.  Depth d of the
search tree decides the reading ``order[d]``.  The expected readings given the pairs so
far stand at ``level[d]`` of ``shifts`` and ``joints``.
"""

import numpy as np

from ...arrays import Array, BoolArray, IntArray
from ..support.jit import jit, njit_internal
from .joint_readings import PAIR_BONUS, UNPAIRED, Problem, condition, fit


@njit_internal
def _decision_order(feasible: BoolArray, innovations: Array) -> IntArray:
    """Return the readings with the fewest landmarks first.

    Ties are broken by the readings themselves: the order of the scan has no effect.
    """
    rows, landmarks = feasible.shape
    order = np.arange(rows)
    options = np.zeros(rows, np.int64)
    for i in range(rows):
        for j in range(landmarks):
            options[i] += feasible[i, j]
    for i in range(1, rows):
        k = i
        while k > 0:
            one, other = order[k - 1], order[k]
            b, r = innovations[one, 0, 0], innovations[one, 0, 1]
            c, s = innovations[other, 0, 0], innovations[other, 0, 1]
            is_sorted = options[one] < options[other]
            if options[one] == options[other]:
                is_sorted = b < c or (b == c and r <= s)
            if is_sorted:
                break
            order[k - 1], order[k] = other, one
            k -= 1
    return order


@njit_internal
def _fill_ahead(
    feasible: BoolArray, order: IntArray, ahead: IntArray, counts: IntArray
) -> None:
    """List the landmarks that the readings from each depth on may belong to."""
    for j in range(feasible.shape[1]):
        last = -1
        for depth in range(len(order)):
            if feasible[order[depth], j]:
                last = depth
        for depth in range(last + 1):
            ahead[depth, counts[depth]] = j
            counts[depth] += 1


@njit_internal
def _insert(
    costs: Array, marks: IntArray, found: int, cost: float, choice: IntArray
) -> int:
    """Insert an assignment into the sorted list; return how many are in it."""
    at = min(found, len(costs) - 1)
    if found == len(costs) and not cost < costs[at]:
        return found
    while at > 0 and costs[at - 1] > cost:
        costs[at] = costs[at - 1]
        for i in range(len(choice)):
            marks[at, i] = marks[at - 1, i]
        at -= 1
    costs[at] = cost
    for i in range(len(choice)):
        marks[at, i] = choice[i]
    return min(found + 1, len(costs))


@jit
def search_assignments(
    problem: Problem,
    costs: Array,
    marks: IntArray,
    spread: float,
    ceiling: float,
    nodes: int,
) -> int:
    """Fill the cheapest assignments by depth-first branch and bound.

    Parameters
    ----------
    problem : Problem
    costs, marks : ndarray, shape (M,) and (M, m)
        Infinite and `UNPAIRED`; on return the assignments found, the cheapest first.
    spread, ceiling : float
        Assignments that cost more than the cheapest plus ``spread``, or more than
        ``ceiling``, are of no interest, except the first one found.
    nodes : int
        Limit of nodes to visit once an assignment has been found.

    Returns
    -------
    int
        Number of nodes visited.
    """
    innovations, joint, variances, feasible, missing, gate, limits, pairs_first = (
        problem
    )
    rows, landmarks = feasible.shape
    order = _decision_order(feasible, innovations)
    ahead = np.zeros((rows + 1, landmarks), np.int64)
    counts = np.zeros(rows + 1, np.int64)
    _fill_ahead(feasible, order, ahead, counts)
    shifts = np.zeros((rows + 1, landmarks, 2))
    joints = np.empty((rows + 1, 2 * landmarks, 2 * landmarks))
    joints[0] = joint
    level = np.zeros(rows + 1, np.int64)
    cost, squared = np.zeros(rows + 1), np.zeros(rows + 1)
    pairs = np.zeros(rows + 1, np.int64)
    choice = np.full(rows, UNPAIRED)
    taken = np.zeros(landmarks, np.bool_)
    child = np.empty((rows, landmarks + 1), np.int64)
    child_cost = np.empty((rows, landmarks + 1))
    child_squared = np.empty((rows, landmarks + 1))
    children = np.zeros(rows, np.int64)
    found, visited, depth, is_new = 0, 0, 0, True
    while depth >= 0:
        best = -1
        if depth == rows:
            found = _insert(costs, marks, found, cost[depth], choice)
        elif found == 0 or visited < nodes:
            row, here = order[depth], level[depth]
            if is_new:  # list what the reading may be: nothing, or a landmark
                visited += 1
                child[depth, 0], child_cost[depth, 0] = UNPAIRED, missing
                child_squared[depth, 0] = 0.0
                count = 1
                left = limits[pairs[depth] + 1] - squared[depth]
                for j in range(landmarks):
                    if not feasible[row, j] or taken[j]:
                        continue
                    z, q = innovations[row], variances[row]
                    x, determinant = fit(z, q, shifts[here], joints[here], j, 1.0)
                    if x <= gate and x <= left:
                        base = -PAIR_BONUS if pairs_first else np.log(determinant)
                        child[depth, count] = j
                        child_cost[depth, count] = x + base
                        child_squared[depth, count] = x
                        count += 1
                children[depth] = count
            for k in range(children[depth]):
                if child_cost[depth, k] < np.inf and (
                    best < 0 or child_cost[depth, k] < child_cost[depth, best]
                ):
                    best = k
        if best < 0:  # all tried: go back to the reading before
            depth -= 1
            if depth >= 0 and choice[order[depth]] != UNPAIRED:
                taken[choice[order[depth]]] = False
            is_new = False
            continue
        j = child[depth, best]
        choice[row] = j
        cost[depth + 1] = cost[depth] + child_cost[depth, best]
        squared[depth + 1] = squared[depth] + child_squared[depth, best]
        pairs[depth + 1], level[depth + 1] = pairs[depth], here
        child_cost[depth, best] = np.inf
        if j != UNPAIRED:
            taken[j] = True
            pairs[depth + 1] += 1
            level[depth + 1] = depth + 1
            condition(
                innovations[row],
                variances[row],
                j,
                ahead[depth + 1, : counts[depth + 1]],
                shifts,
                joints,
                here,
                depth + 1,
            )
        if found > 0:
            bound, here = cost[depth + 1], level[depth + 1]
            for k in range(depth + 1, rows):  # a lower bound on the open readings
                i = order[k]
                base = -PAIR_BONUS
                if not pairs_first:
                    base = np.log(variances[i, 0] * variances[i, 1])
                least = missing
                for a in range(landmarks):
                    if feasible[i, a] and not taken[a]:
                        x, _ = fit(
                            innovations[i],
                            variances[i],
                            shifts[here],
                            joints[here],
                            a,
                            float(rows - depth - 1),
                        )
                        least = min(least, base + x)
                bound += least
            if not bound < min(costs[-1], costs[0] + spread, ceiling):
                if j != UNPAIRED:
                    taken[j] = False
                is_new = False
                continue
        depth += 1
        is_new = True
    return visited
