"""Search for the cheapest joint assignments of a scan, compiled.

:mod:`slamgym.estimator.association.joint_assignment` has the equations.  Depth d of the
search tree decides the reading ``order[d]``.  The expected readings given the pairs so
far stand at ``level[d]`` of ``shifts`` and ``joints``.
"""

import numpy as np

from ...arrays import Array, BoolArray, IntArray
from ...jit import jit, njit_internal
from .joint_readings import PAIR_BONUS, UNPAIRED, Problem, condition, fit


@njit_internal
def _candidates(feasible: BoolArray) -> tuple[IntArray, IntArray]:
    """List the landmarks that each reading may belong to, and count them."""
    listed = np.zeros(feasible.shape, np.int64)
    counts = np.zeros(len(feasible), np.int64)
    for i in range(feasible.shape[0]):
        for j in range(feasible.shape[1]):
            if feasible[i, j]:
                listed[i, counts[i]] = j
                counts[i] += 1
    return listed, counts


@njit_internal
def _decision_order(feasible: BoolArray, innovations: Array) -> IntArray:
    """Return the readings with the fewest landmarks first.

    Ties are broken by the readings themselves: the order of the scan has no effect.
    """
    options = feasible.sum(axis=1)
    order = np.arange(len(options))
    for i in range(1, len(options)):
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
def _needed(feasible: BoolArray, order: IntArray) -> tuple[IntArray, IntArray]:
    """Sort the landmarks by when they are needed last, the latest first.

    Returns
    -------
    tuple of ndarray
        The landmarks in this order, shape (J,), and how many of them the readings from
        each depth on may belong to, shape (m + 1,).
    """
    rows, landmarks = feasible.shape
    last = np.full(landmarks, -1)
    for depth in range(rows):
        for j in range(landmarks):
            if feasible[order[depth], j]:
                last[j] = depth
    counts = np.zeros(rows + 1, np.int64)
    for depth in range(rows):
        counts[depth] = (last >= depth).sum()
    return np.argsort(-last, kind="mergesort"), counts


@njit_internal
def _insert(
    costs: Array,
    marks: IntArray,
    found: int,
    cost: float,
    choice: IntArray,
    names: IntArray,
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
        marks[at, i] = UNPAIRED if choice[i] == UNPAIRED else names[choice[i]]
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
    variances, missing, gate, limits, pairs_first = (
        problem.variances,
        problem.missing,
        problem.gate,
        problem.limits,
        problem.pairs_first,
    )
    rows, landmarks = problem.feasible.shape
    order = _decision_order(problem.feasible, problem.innovations)
    names, counts = _needed(problem.feasible, order)
    innovations = problem.innovations[:, names]
    listed, options = _candidates(problem.feasible[:, names])
    shifts = np.zeros((rows + 1, landmarks, 2))
    joints = np.empty((rows + 1, 2 * landmarks, 2 * landmarks))
    for a in range(landmarks):
        for b in range(landmarks):
            for i in range(2):
                for k in range(2):
                    value = problem.joint[2 * names[a] + i, 2 * names[b] + k]
                    joints[0, 2 * a + i, 2 * b + k] = value
    least_base = np.log(variances[:, 0] * variances[:, 1])
    if pairs_first:
        least_base[:] = -PAIR_BONUS
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
            found = _insert(costs, marks, found, cost[depth], choice, names)
        elif found == 0 or visited < nodes:
            row, here = order[depth], level[depth]
            if is_new:  # list what the reading may be: nothing, or a landmark
                visited += 1
                child[depth, 0], child_cost[depth, 0] = UNPAIRED, missing[row]
                child_squared[depth, 0] = 0.0
                count = 1
                left = limits[pairs[depth] + 1] - squared[depth]
                for j in listed[row, : options[row]]:
                    if taken[j]:
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
                counts[depth + 1],
                shifts,
                joints,
                here,
                depth + 1,
            )
        if found > 0:
            bound, here = cost[depth + 1], level[depth + 1]
            for k in range(depth + 1, rows):  # a lower bound on the open readings
                i = order[k]
                base, least = least_base[i], missing[i]
                for a in listed[i, : options[i]]:
                    if not taken[a]:
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
