"""Search for the cheapest joint assignments of a scan, compiled.

An assignment gives each reading one landmark or none, and each landmark at most one
reading.  Its cost is −2 ln of its likelihood, up to a constant of the scan::

    cost = νᵀ S⁻¹ ν + ln det S + Σ λᵢ,    λᵢ = −2 ln ρᵢ − 2 ln 2π

ν and S = H P Hᵀ + Q belong to the paired readings together, the sum is over the
readings left out, and ρᵢ is the density, at the reading, of those that come from no
landmark of the map: clutter and landmarks that are not mapped yet [1 / (rad m)].

A depth-first branch and bound decides one reading after the other.  A pair conditions
the expected readings of all landmarks.  By the chain rule of the Gaussian, the cost
of an assignment is the sum of the costs of its pairs, each given the pairs before::

    h ← h + K (z − h),  C ← C − K C,    K = C Hⱼᵀ (Cⱼⱼ + Q)⁻¹,    C = H P Hᵀ

The k readings still open add at least the following, since C ⪯ k blockdiag(Cⱼⱼ)::

    Σᵢ min(λᵢ, minⱼ νᵀ (k Cⱼⱼ + Q)⁻¹ ν + ln det Q)

`best_assignments` decides at depth d of the search tree the reading ``order[d]``.
The expected readings given the pairs so far stand at ``level[d]`` of ``h``, as shifts,
and ``C``. `search_clique` finds the largest set of landmark pairs that agree.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ...arrays import Array, BoolArray, IntArray
from ...jit import jit, njit_allocating, njit_apart, njit_inlined, njit_internal
from ..models.bearing_range import (
    expected_reading_jit,
    reading_slopes_jit,
    wrap_angle_jit,
)
from .scan_update import copy_covariance


@njit_allocating
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


@njit_allocating
def _decision_order(feasible: BoolArray, innovations: Array) -> IntArray:
    """Return the readings with the fewest landmarks first.

    Ties are broken by the readings themselves: the order of the scan has no effect.
    """
    rows, landmarks = feasible.shape
    options, order = np.zeros(rows, np.int64), np.arange(rows)
    if landmarks == 0:  # there are no innovations to compare
        return order
    for i in range(rows):
        for j in range(landmarks):
            options[i] += feasible[i, j]
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


@njit_allocating
def _needed(feasible: BoolArray, order: IntArray) -> tuple[IntArray, IntArray]:
    """Sort the landmarks by when they are needed last, the latest first.

    Returns
    -------
    tuple of ndarray
        The landmarks in this order, shape (J,), and how many of them the readings from
        each depth on may belong to, shape (m + 1,).
    """
    rows, landmarks = feasible.shape
    names, counts = np.empty(landmarks, np.int64), np.zeros(rows + 1, np.int64)
    is_listed, found = np.zeros(landmarks, np.bool_), 0
    for depth in range(rows - 1, -1, -1):
        for j in range(landmarks):
            if feasible[order[depth], j] and not is_listed[j]:
                is_listed[j], names[found], found = True, j, found + 1
        counts[depth] = found
    for j in range(landmarks):
        if not is_listed[j]:
            names[found], found = j, found + 1
    return names, counts


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
def best_assignments(
    of_scan: tuple[Any, ...], most: int, spread: float, ceiling: float, nodes: int
) -> tuple[Array, IntArray, Array, bool]:
    """Return the cheapest assignments of a scan by depth-first branch and bound.

    Parameters
    ----------
    of_scan : tuple
        The fields of a :class:`Problem`.  A plain tuple reaches a kernel faster.
    most : int
        M, how many at most.
    spread : float
        Largest difference of their costs to the least.
    ceiling : float
        Cost beyond which only the first one found is of interest.
    nodes : int
        Limit of the search.  At the limit, the best assignments found so far are
        returned.  The first of them always gives each reading in turn the pair that is
        most likely given the pairs before it.

    Returns
    -------
    costs : ndarray, shape (M,)
        The cheapest first.
    marks : ndarray of int64, shape (M, m)
        Landmark 0 … J − 1 of each reading or `UNPAIRED`.
    distances : ndarray, shape (M, m)
        As :func:`least_distances` finds them.
    is_complete : bool
        False where the search stopped at its limit of nodes.

    Notes
    -----
    With ``pairs_first`` and χ² limits this is the joint compatibility test of [1]_.

    References
    ----------
    .. [1] J. Neira, J. Tardós, Data association in stochastic mapping using the joint
       compatibility test, IEEE Transactions on Robotics and Automation 17, 2001.
    """
    problem = Problem(*of_scan)
    _, joint, _, _, missing, gate, limits, pairs_first = problem
    rows, landmarks = problem.feasible.shape
    costs, marks = np.full(most, np.inf), np.full((most, rows), UNPAIRED)
    order = _decision_order(problem.feasible, problem.innovations)
    names, counts = _needed(problem.feasible, order)
    nu, Q = problem.innovations[:, names], problem.variances[:, names]
    listed, options = _candidates(problem.feasible[:, names])
    h = np.zeros((rows + 1, landmarks, 2))
    C = np.empty((rows + 1, 2 * landmarks, 2 * landmarks))
    for a in range(landmarks):
        for b in range(landmarks):
            for i in range(2):
                for k in range(2):
                    value = joint[2 * names[a] + i, 2 * names[b] + k]
                    C[0, 2 * a + i, 2 * b + k] = value
    least_base = np.log(Q[:, :, 0] * Q[:, :, 1])
    if pairs_first:
        least_base[:] = -PAIR_BONUS
    level = np.zeros(rows + 1, np.int64)
    cost, squared = np.zeros(rows + 1), np.zeros(rows + 1)
    pairs = np.zeros(rows + 1, np.int64)
    choice = np.full(rows, UNPAIRED)
    taken = np.zeros(landmarks, np.bool_)
    gains = np.empty((4, 2 * landmarks))
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
                for k in range(options[row]):
                    j = listed[row, k]
                    if taken[j]:
                        continue
                    a, b = 2 * j, 2 * j + 1
                    n0 = nu[row, j, 0] - h[here, j, 0]
                    n1 = nu[row, j, 1] - h[here, j, 1]
                    s00 = C[here, a, a] + Q[row, j, 0]
                    s11 = C[here, b, b] + Q[row, j, 1]
                    x, determinant = fit(n0, n1, s00, C[here, b, a], s11)
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
            n = counts[depth + 1]
            condition(nu, Q, row, j, n, h, C, here, depth + 1, gains)
        if found > 0:
            bound, here, open_ = cost[depth + 1], level[depth + 1], rows - depth - 1.0
            for k in range(depth + 1, rows):  # a lower bound on the open readings
                i = order[k]
                least = missing[i]
                for a in range(options[i]):
                    j = listed[i, a]
                    if not taken[j]:
                        c, d = 2 * j, 2 * j + 1
                        n0 = nu[i, j, 0] - h[here, j, 0]
                        n1 = nu[i, j, 1] - h[here, j, 1]
                        s00 = open_ * C[here, c, c] + Q[i, j, 0]
                        s11 = open_ * C[here, d, d] + Q[i, j, 1]
                        x, _ = fit(n0, n1, s00, open_ * C[here, d, c], s11)
                        least = min(least, least_base[i, j] + x)
                bound += least
            if not bound < min(costs[-1], costs[0] + spread, ceiling):
                if choice[row] != UNPAIRED:
                    taken[choice[row]] = False
                is_new = False
                continue
        depth += 1
        is_new = True
    while found > 0 and costs[found - 1] > costs[0] + spread:
        found -= 1
    costs, marks = costs[:found], marks[:found]
    return costs, marks, least_distances(problem, marks), visited < nodes


@njit_allocating
def only_partners(feasible: BoolArray) -> IntArray:
    """Return the landmark that each reading may belong to, or `UNPAIRED`.

    Nothing if a reading may belong to several, or several to the same one.
    """
    partners = np.full(len(feasible), UNPAIRED)
    is_taken = np.zeros(feasible.shape[1], np.bool_)
    for i in range(feasible.shape[0]):
        found = 0
        for j in range(feasible.shape[1]):
            if feasible[i, j]:
                if is_taken[j]:
                    return partners[:0]
                partners[i], is_taken[j], found = j, True, found + 1
        if found > 1:
            return partners[:0]
    return partners


@njit_allocating
def settled_assignments(
    of_scan: tuple[Any, ...],
    partners: IntArray,
    most: int,
    spread: float,
    ceiling: float,
    same: float,
) -> tuple[Array, IntArray]:
    """Return the cheapest assignments if they pair all readings or all but one.

    None of these pairs a reading near no landmark.  The search first finds the one that
    pairs all others, if every pair costs less than its reading left out, given the
    pairs before it.  Leaving out the readings U costs in addition ::

        Σ λ − ln det S_U − ρᵀ (Q − C⁺)⁻¹ ρ

    where S_U is given all other pairs, and ρ and C⁺ are the innovations and C of U
    after all pairs.  Leaving out one reading does not matter if it is too expensive, or
    if the reading is then near its landmark and hardly changes the belief
    (`_without_one`).  Leaving out several must be too expensive.  det S_U is at most
    the product of det S before any pair, and the last term at most νᵀ S⁻¹ ν of all
    pairs.  By Gershgorin's theorem for blocks, C⁺ ⪯ τ Q with the Frobenius norm in
    τ = max tr Q⁻¹ C⁺ + (u − 1) max ‖Q^−½ C⁺ Q^−½‖ of one reading and of two.  So
    leaving out u readings costs at least the larger of ::

        u min (λ − ln det S) − νᵀ S⁻¹ ν
        sum of the u least of λ − ln det S − ρᵀ Q⁻¹ ρ / (1 − τ)

    Where C is larger than 10⁶ Q, rounding in ρ and C⁺ could hide another assignment.

    Parameters
    ----------
    of_scan, most, spread, ceiling
        As in :func:`best_assignments`, without ``pairs_first``.  Of innovations and
        variances, those of partners are read, and the innovations of the first
        landmark.  ``limits`` are not read, and must be infinite.
    partners : ndarray of int64, shape (m,)
        The landmark of each reading or `UNPAIRED`, from :func:`only_partners`.
    same : float
        Leaving out a reading near its landmark does not matter if it changes the belief
        by less than this, see :func:`largest_change`; at most 1.

    Returns
    -------
    costs, marks : ndarray, shapes (M,) and (M, m)
        As the search finds them without its limit of nodes, to the bit, except those
        that do not matter.  Empty if others may be of interest.
    """
    problem = Problem(*of_scan)
    costs, marks = np.empty(most), np.full((most, len(partners)), UNPAIRED)
    # The search decides the last of these first.
    order = _decision_order(problem.feasible, problem.innovations)[::-1]
    rows = (partners != UNPAIRED).sum()  # those with a landmark come first
    names, missing = partners[order[:rows]], problem.missing[order]
    of_pairs, limits = _in_order(problem, order, names), (problem.gate, missing)
    cost, squared, here = _paired(of_pairs, limits, -1)
    limit = min(cost if most == 1 else np.inf, cost + spread, ceiling)
    margin = max(limit - cost, 0.0) + ROUNDING
    more, is_idle = np.empty(0), np.empty(0, np.bool_)
    if cost < np.inf:
        allowed = margin, problem.gate, same
        more, is_idle = _left_out(of_pairs, (here, squared), missing, allowed)
    found, last = 0, -np.inf
    for place in range(most + 1 if len(more) > 0 else 0):
        a = int(np.argmin(more))
        if not more[a] < margin:
            break
        if more[a] - last < ROUNDING:  # which one comes first is not known
            return costs[:0], marks[:0]
        last, more[a] = more[a], np.inf
        if place == most or is_idle[a]:
            continue
        costs[found] = cost if a == rows else _paired(of_pairs, limits, a)[0]
        if a < rows and not costs[found] < min(costs[0] + spread, ceiling):
            continue
        for b in range(rows):
            marks[found, order[b]] = UNPAIRED if a == b else names[b]
        found += 1
    while found > 0 and costs[found - 1] > costs[0] + spread:
        found -= 1
    return costs[:found], marks[:found]


@njit_allocating
def _in_order(
    problem: Problem, order: IntArray, names: IntArray
) -> tuple[Array, Array, Array, Array, Array]:
    """Return ν, Q, h and C of readings and their landmarks, and gains (`condition`).

    Level 0 of h and C is that before any pair; two levels follow for those after some.
    """
    rows = len(names)
    nu, Q = np.empty((rows, rows, 2)), np.empty((rows, rows, 2))
    h, C = np.zeros((3, rows, 2)), np.empty((3, 2 * rows, 2 * rows))
    for a in range(rows):
        for i in range(2):
            nu[a, a, i] = problem.innovations[order[a], names[a], i]
            Q[a, a, i] = problem.variances[order[a], names[a], i]
            for b in range(a + 1):
                for k in range(2):
                    value = problem.joint[2 * names[a] + i, 2 * names[b] + k]
                    C[0, 2 * a + i, 2 * b + k] = value
    return nu, Q, h, C, np.empty((4, 2 * rows))


@njit_allocating
def _left_out(
    of_pairs: tuple[Array, ...],
    after: tuple[int, float],
    missing: Array,
    allowed: tuple[float, float, float],
) -> tuple[Array, BoolArray]:
    """Return what it costs to leave out each reading, and whether it does not matter.

    The last entry is for none left out.  Both are empty if leaving out several may not
    be too expensive, see `settled_assignments`, or if rounding could spoil the costs.

    Parameters
    ----------
    of_pairs : tuple of ndarray
        From `_in_order`.
    after : tuple
        The level of h and C after all pairs, and their νᵀ S⁻¹ ν.
    missing : ndarray
        λ of each reading.
    allowed : tuple of float
        ``limits`` of `_without_one`.
    """
    (nu, Q, h, C, _), (here, squared), margin = of_pairs, after, allowed[0]
    rows, spoilt = len(nu), (np.empty(0), np.empty(0, np.bool_))
    saved = np.empty(rows)  # λ − ln det S
    for a in range(rows):
        c, d = 2 * a, 2 * a + 1
        if not (C[0, c, c] < WIDE * Q[a, a, 0] and C[0, d, d] < WIDE * Q[a, a, 1]):
            return spoilt
        s00, s11 = C[0, c, c] + Q[a, a, 0], C[0, d, d] + Q[a, a, 1]
        saved[a] = missing[a] - np.log(s00 * s11 - C[0, d, c] * C[0, d, c])
    least_saved = saved.min() if rows else np.inf
    more, is_idle = np.full(rows + 1, np.inf), np.ones(rows + 1, np.bool_)
    more[rows], is_idle[rows] = 0.0, False
    # ρᵀ Q⁻¹ ρ of each reading, and the largest tr Q⁻¹ C⁺.
    residuals, share = np.empty(rows), 0.0
    for a in range(rows):
        c, d, q0, q1 = 2 * a, 2 * a + 1, Q[a, a, 0], Q[a, a, 1]
        n0, n1 = nu[a, a, 0] - h[here, a, 0], nu[a, a, 1] - h[here, a, 1]
        left = q0 - C[here, c, c], -C[here, d, c], q1 - C[here, d, d]
        if least_saved - squared < margin:
            one = _without_one((n0, n1), left, (q0, q1), missing[a], allowed)
            if np.isnan(one[0]):
                return spoilt
            more[a], is_idle[a] = one
        residuals[a] = n0 * n0 / q0 + n1 * n1 / q1
        share = max(share, C[here, c, c] / q0 + C[here, d, d] / q1)
    apart = 0.0
    if 2 * least_saved - squared < margin:
        apart = _largest_apart(C[here], Q)
    for u in range(2, rows + 1):
        if u * least_saved - squared >= margin:
            break
        least, next_least, tau = np.inf, np.inf, share + (u - 1) * apart
        for a in range(rows):
            one_more = saved[a] - residuals[a] / (1 - tau)
            next_least = min(next_least, max(least, one_more))
            least = min(least, one_more)
        if not (tau < 1 and least + (u - 1) * next_least >= margin):
            return spoilt
    return more, is_idle


@njit_allocating
def _paired(
    of_pairs: tuple[Array, ...], limits: tuple[float, Array], without: int
) -> tuple[float, float, int]:
    """Return the cost of pairing all readings but one, the last first.

    Parameters
    ----------
    of_pairs : tuple of ndarray
        From `_in_order`.
    limits : tuple
        The gate, and λ of each reading.
    without : int
        The reading to leave out; −1 for none.  With −1, the search must find these
        pairs first, and all readings are conditioned on each pair.  Otherwise, only
        those still open are.

    Returns
    -------
    cost, squared, here : float, float, int
        −2 ln of the likelihood, infinite if the search does not pair so, νᵀ S⁻¹ ν, and
        the level of ``h`` and ``C``.
    """
    (nu, Q, h, C, gains), (gate, missing) = of_pairs, limits
    cost, squared, here = 0.0, 0.0, 0
    for a in range(len(missing) - 1, -1, -1):
        if a == without or a >= len(nu):
            cost = cost + missing[a]
            continue
        c, d = 2 * a, 2 * a + 1
        n0, n1 = nu[a, a, 0] - h[here, a, 0], nu[a, a, 1] - h[here, a, 1]
        s00, s11 = C[here, c, c] + Q[a, a, 0], C[here, d, d] + Q[a, a, 1]
        x, determinant = fit(n0, n1, s00, C[here, d, c], s11)
        own = x + np.log(determinant)
        if not (x <= gate and (own < missing[a] or without >= 0)):
            return np.inf, squared, here
        cost, squared, to = cost + own, squared + x, 2 if here == 1 else 1
        count = len(nu) if without < 0 else a
        condition(nu, Q, a, a, count, h, C, here, to, gains)
        here = to
    return cost, squared, here


@njit_internal
def _largest_apart(C: Array, Q: Array) -> float:
    """Return the largest Frobenius norm ‖Q^−½ C Q^−½‖ of two readings."""
    largest = 0.0
    for a in range(len(Q)):
        for b in range(a):
            total = 0.0
            for i in range(2):
                for k in range(2):
                    value = C[2 * a + i, 2 * b + k]
                    total += value * value / (Q[a, a, i] * Q[b, b, k])
            largest = max(largest, total)
    return float(np.sqrt(largest))


@njit_internal
def _without_one(
    rho: tuple[float, float],
    left: tuple[float, float, float],
    q: tuple[float, float],
    missing: float,
    limits: tuple[float, float, float],
) -> tuple[float, bool]:
    """Return what it costs to leave out one reading, and whether it does not matter.

    Given all other pairs, ::

        S = Q M⁻¹ Q,    νᵀ S⁻¹ ν = ρᵀ M⁻¹ ρ,    M = Q − C⁺

    and the smallest eigenvalue of S⁻¹ Q in :func:`largest_change` is that of Q⁻¹ M.

    Parameters
    ----------
    rho, left, q : tuple of float
        ρ, the lower half of M, and the diagonal of Q.
    missing : float
        λ of the reading.
    limits : tuple of float
        Additional cost that is too expensive, gate of an ambiguous reading, and change
        below which a belief counts as the same.

    Returns
    -------
    more, is_idle : float, bool
        nan where rounding could spoil it.
    """
    (m00, m10, m11), (q0, q1), (margin, gate, same) = left, q, limits
    x, determinant = fit(rho[0], rho[1], m00, m10, m11)
    share = determinant / (q0 * q1)  # det Q / det S
    if not (m00 > 0 and share >= KNOWN):
        return np.nan, False
    more = missing - x - np.log(q0 * q1 / share)
    if more >= margin:
        return more, True
    half = (m00 / q0 + m11 / q1) / 2
    least = half - np.sqrt(max(half * half - share, 0.0))
    squared = (1 + x) * (1 - least) / least  # of the largest change
    # Then λ < ½ and det S < 4 det Q, which is below `SURE`: its place is certain.
    is_same = squared < same * same * (1 - ROUNDING)
    return more, more >= ROUNDING and x <= gate * (1 - ROUNDING) and is_same


# --------------------------------------------------------------------------------------
# Expected readings of several landmarks, conditioned on pairs of a scan, compiled.
#
# ``shifts[d]`` is h minus h(x) and ``joints[d]`` is C after some pairs, its lower half
# only; :mod:`slamgym.estimator.association.scan_assignments` has the equations.

UNPAIRED = -1

#: A landmark is sure to be where the map has it up to this det S / det Q.
SURE = 9.0

#: A difference of costs counts if it exceeds what rounding can cause, for variances of
#: expected readings up to `WIDE` times those of the noise.
ROUNDING = 1e-6
WIDE = 1e6

#: Smallest det Q / det S of a reading, given all others, that rounding cannot spoil.
KNOWN = 0.01

#: Cost that a pair saves where the number of pairs counts before all else.
PAIR_BONUS = 1e6


class Problem(NamedTuple):
    """Readings of one scan and the landmarks that they may belong to."""

    #: ν = z − h(x), shape (m, J, 2), bearings in [-π, π).
    innovations: Array
    #: C = H P Hᵀ of all expected readings, shape (2J, 2J).
    joint: Array
    #: Diagonal of Q for each pair, shape (m, J, 2).
    variances: Array
    #: Pairs to consider, shape (m, J).
    feasible: BoolArray
    #: λ of each reading, shape (m,).
    missing: Array
    #: Largest νᵀ S⁻¹ ν of a pair, given the pairs before it.
    gate: float
    #: Largest νᵀ S⁻¹ ν of 0 … m pairs together, shape (m + 1,).
    limits: Array
    #: Most pairs first, then the least νᵀ S⁻¹ ν, in place of the likelihood.
    pairs_first: bool


@jit
def fill_expected(
    mean: Array, P: Array, slots: IntArray, expected: Array, joint: Array
) -> None:
    """Fill h(x), shape (J, 2), and C = H P Hᵀ, shape (2J, 2J), of some landmarks.

    Parameters
    ----------
    mean, P : ndarray
        (x, y, θ, l1x, …) and its covariance; there may be more behind the landmarks.
    slots : ndarray of int64, shape (J,)
        Places of the landmarks in the map.
    """
    slopes = np.empty((2 * len(slots), 2))
    for j in range(len(slots)):
        c = 3 + 2 * slots[j]
        dx, dy = mean[c] - mean[0], mean[c + 1] - mean[1]
        bearing, expected[j, 1] = expected_reading_jit(dx, dy, mean[2])
        expected[j, 0] = wrap_angle_jit(bearing)
        of_reading = reading_slopes_jit(dx, dy)
        for i in range(4):
            slopes[2 * j + i // 2, i % 2] = of_reading[i]
    for a in range(2 * len(slots)):
        row = 3 + 2 * slots[a // 2], a % 2 - 1.0, slopes[a, 0], slopes[a, 1]
        px, py = _product(row, P, 0), _product(row, P, 1)
        heading = _product(row, P, 2)
        for j in range(a // 2 + 1):
            c = 3 + 2 * slots[j]
            x, y = _product(row, P, c), _product(row, P, c + 1)
            for k in range(2):
                b, to_x, to_y = 2 * j + k, slopes[2 * j + k, 0], slopes[2 * j + k, 1]
                value = -px * to_x - py * to_y + heading * (k - 1.0)
                value += x * to_x
                value += y * to_y
                joint[a, b] = joint[b, a] = value


@njit_internal
def _product(row: tuple[int, float, float, float], P: Array, column: int) -> float:
    """Return an entry of H P.

    Parameters
    ----------
    row : tuple
        Column of the landmark's x in P, and the row of H: its derivatives with respect
        to the heading and the landmark's x and y.  Those with respect to the robot's x
        and y are the negative of the latter.
    P : ndarray
    column : int
    """
    c, turn, x, y = row
    of_pose = -x * P[0, column] - y * P[1, column] + turn * P[2, column]
    return float(of_pose + x * P[c, column] + y * P[c + 1, column])


# Numba counts the references to each view of an array, and to each array that it passes
# to a function.  In the search this took a third of the time, so its inner loops index
# whole arrays and pass numbers.  They repeat ν and S of a pair: one inlined
# function for these made scans of many landmarks a fifth slower.


@njit_internal
def fit(
    n0: float, n1: float, s00: float, s10: float, s11: float
) -> tuple[float, float]:
    """Return νᵀ S⁻¹ ν and det S, from ν and the lower half of S."""
    determinant = s00 * s11 - s10 * s10
    squared = n0 * n0 * s11 - 2 * n0 * n1 * s10 + n1 * n1 * s00
    return squared / determinant, determinant


@njit_inlined
def condition(
    nu: Array,
    Q: Array,
    i: int,
    j: int,
    count: int,
    h: Array,
    C: Array,
    here: int,
    to: int,
    gains: Array,
) -> None:
    """Condition the expected readings of the first ``count`` landmarks on one pair.

    ::

        h ← h + K (z − h),  C ← C − K C

    ``gains``, shape (4, 2J), is room for the rows of C of landmark j, and for K.
    """
    s00 = C[here, 2 * j, 2 * j] + Q[i, j, 0]
    s10 = C[here, 2 * j + 1, 2 * j]
    s11 = C[here, 2 * j + 1, 2 * j + 1] + Q[i, j, 1]
    n0 = nu[i, j, 0] - h[here, j, 0]
    n1 = nu[i, j, 1] - h[here, j, 1]
    determinant = s00 * s11 - s10 * s10
    for a in range(2 * count):
        for k in range(2):
            b = 2 * j + k
            gains[k, a] = C[here, max(a, b), min(a, b)]
        gains[2, a] = (gains[0, a] * s11 - gains[1, a] * s10) / determinant
        gains[3, a] = (gains[1, a] * s00 - gains[0, a] * s10) / determinant
        moved = h[here, a // 2, a % 2] + gains[2, a] * n0 + gains[3, a] * n1
        h[to, a // 2, a % 2] = moved
    _subtract(C[here], gains, count, C[to])


@njit_apart
def _subtract(C: Array, gains: Array, count: int, after: Array) -> None:
    """Fill C − K C, its lower half and what the diagonal blocks have above it."""
    for a in range(0, 2 * count, 2):
        k0, k1 = gains[2, a], gains[3, a]
        m0, m1 = gains[2, a + 1], gains[3, a + 1]
        for b in range(a + 2):  # two rows in one loop, which is faster
            after[a, b] = C[a, b] - k0 * gains[0, b] - k1 * gains[1, b]
            after[a + 1, b] = C[a + 1, b] - m0 * gains[0, b] - m1 * gains[1, b]


@njit_allocating
def condition_on_all(
    problem: Problem, marks: IntArray, shifts: Array, joints: Array
) -> int:
    """Condition on all pairs of an assignment; return the level of the result, 0 or 1.

    Parameters
    ----------
    problem : Problem
    marks : ndarray, shape (m,)
        An assignment.
    shifts, joints : ndarray, shapes (2, J, 2) and (2, 2J, 2J)
        Overwritten.
    """
    nu, Q = problem.innovations, problem.variances
    here, landmarks = 0, problem.feasible.shape[1]
    shifts[0] = 0.0
    copy_covariance(problem.joint, joints[0], 2 * landmarks)
    gains = np.empty((4, 2 * landmarks))
    for i in range(len(marks)):
        if marks[i] != UNPAIRED:
            j, to = marks[i], 1 - here
            condition(nu, Q, i, j, landmarks, shifts, joints, here, to, gains)
            here = to
    return here


@njit_allocating
def least_distances(problem: Problem, marks: IntArray) -> Array:
    """Return the least νᵀ S⁻¹ ν of each unpaired reading to a landmark without one.

    A scan shows a landmark once, so a reading near a paired landmark shows another one.
    Only landmarks whose place in the scan is certain count: det S ≤ `SURE` det Q.

    Parameters
    ----------
    problem : Problem
    marks : ndarray, shape (M, m)
        Assignments.

    Returns
    -------
    ndarray, shape (M, m)
        Infinite for paired readings, and where no such landmark is left.
    """
    innovations, variances = problem.innovations, problem.variances
    landmarks, distances = problem.feasible.shape[1], np.full(marks.shape, np.inf)
    shifts = np.empty((2, landmarks, 2))
    joints = np.empty((2, 2 * landmarks, 2 * landmarks))
    taken = np.zeros(landmarks, np.bool_)
    for s in range(len(marks)):
        taken[:], pairs = False, 0
        for mark in marks[s]:
            if mark != UNPAIRED:
                taken[mark], pairs = True, pairs + 1
        if pairs == len(marks[s]):
            continue
        here = condition_on_all(problem, marks[s], shifts, joints)
        for i in range(len(marks[s])):
            for j in range(landmarks):
                if taken[j] or marks[s, i] != UNPAIRED:
                    continue
                q, C = variances[i, j], joints[here]
                s00, s11 = C[2 * j, 2 * j] + q[0], C[2 * j + 1, 2 * j + 1] + q[1]
                n0 = innovations[i, j, 0] - shifts[here, j, 0]
                n1 = innovations[i, j, 1] - shifts[here, j, 1]
                x, determinant = fit(n0, n1, s00, C[2 * j + 1, 2 * j], s11)
                if determinant <= SURE * q[0] * q[1]:
                    distances[s, i] = min(distances[s, i], x)
    return distances


@jit
def largest_change(of_scan: tuple[Any, ...], marks: IntArray, fewer: IntArray) -> float:
    """Bound how much some pairs change any coordinate of the state, in its σ.

    With means μ and deviations σ, after all pairs 1 and without some of them 2, no
    coordinate has a larger √((μ₂ − μ₁)² + σ₂² − σ₁²) / σ₁.  One pair with innovation ν,
    given the others, shifts a coordinate of variance P by at most √(P λ νᵀ S⁻¹ ν) and
    leaves it at least the variance (1 − λ) P::

        λ = largest eigenvalue of S⁻¹ C = 1 − smallest eigenvalue of S⁻¹ Q

    Parameters
    ----------
    of_scan : tuple
        As in :func:`best_assignments`.
    marks, fewer : ndarray, shape (m,)
        Two assignments.

    Returns
    -------
    float
        Infinite unless ``fewer`` is ``marks`` without some pairs.
    """
    problem = Problem(*of_scan)
    nu, Q = problem.innovations, problem.variances
    for i in range(len(marks)):
        if fewer[i] != marks[i] and fewer[i] != UNPAIRED:
            return np.inf
    landmarks = problem.feasible.shape[1]
    shifts = np.empty((2, landmarks, 2))
    joints = np.empty((2, 2 * landmarks, 2 * landmarks))
    here = condition_on_all(problem, fewer, shifts, joints)
    gains = np.empty((4, 2 * landmarks))
    shift, variance = 0.0, 1.0  # in the σ after all pairs
    for i in range(len(marks)):
        j = marks[i]
        if fewer[i] == j:
            continue
        C, q, to = joints[here], Q[i, j], 1 - here
        s00, s11 = C[2 * j, 2 * j] + q[0], C[2 * j + 1, 2 * j + 1] + q[1]
        n0 = nu[i, j, 0] - shifts[here, j, 0]
        n1 = nu[i, j, 1] - shifts[here, j, 1]
        x, determinant = fit(n0, n1, s00, C[2 * j + 1, 2 * j], s11)
        half = (s11 * q[0] + s00 * q[1]) / (2 * determinant)
        root = np.sqrt(max(half * half - q[0] * q[1] / determinant, 0.0))
        left = half - root  # 1 − λ
        shift = (shift + np.sqrt(x * (1 - left))) / np.sqrt(left)
        variance /= left
        condition(nu, Q, i, j, landmarks, shifts, joints, here, to, gains)
        here = to
    return float(np.sqrt(shift * shift + variance - 1))


# --------------------------------------------------------------------------------------
# Search for the largest clique of pairs of landmarks, compiled.
#
# :mod:`slamgym.estimator.association.constellations` has the equations.


@jit
def compare_pairs(
    pairs: IntArray,
    local: Array,
    older: Array,
    gate: float,
    largest_turn: float,
    agree: BoolArray,
) -> None:
    """Mark which pairs (i, p), (j, q) of landmarks can both be right.

    ::

        (d_ij − d_pq)² ≤ gate (σ²_ij + σ²_pq),   |α_pq − α_ij| ≤ largest turn

    Parameters
    ----------
    pairs : ndarray of int64, shape (N, 2)
        Landmark i of the local map and p of the older map of each pair.
    local, older : ndarray, shapes (3, m, m) and (3, n, n)
        Distance d, its variance σ² and direction α between two landmarks of a map.
    gate : float
        Largest squared difference of two distances over its variance.
    largest_turn : float
        Largest difference of two directions [rad].
    agree : ndarray of bool, shape (N, N)
        The result; a landmark is in one pair only.
    """
    for s in range(len(pairs)):
        i, p = pairs[s, 0], pairs[s, 1]
        for t in range(s):
            j, q = pairs[t, 0], pairs[t, 1]
            is_good = False
            if i != j and p != q:
                difference = local[0, i, j] - older[0, p, q]
                variance = local[1, i, j] + older[1, p, q]
                if difference * difference <= gate * variance:
                    turn = wrap_angle_jit(older[2, p, q] - local[2, i, j])
                    is_good = abs(turn) <= largest_turn
            agree[s, t] = agree[t, s] = is_good


@njit_internal
def _bounds(
    pairs: IntArray, open_: IntArray, count: int, bounds: IntArray, seen: IntArray
) -> None:
    """Count the landmarks of the local map among the open pairs from each one on."""
    seen[:] = 0
    found = 0
    for k in range(count - 1, -1, -1):
        i = pairs[open_[k], 0]
        if seen[i] == 0:
            seen[i] = 1
            found += 1
        bounds[k] = found


@jit
def search_clique(
    pairs: IntArray, agree: BoolArray, floor: int, nodes: int, clique: IntArray
) -> tuple[int, int]:
    """Find the largest set of pairs that all agree with each other.

    Depth-first branch and bound: a set grows by the pairs that agree with all in it.
    Each landmark of the local map can add one pair at most, which bounds its size.

    Parameters
    ----------
    pairs : ndarray of int64, shape (N, 2)
        Landmarks of each pair, that of the local map first.
    agree : ndarray of bool, shape (N, N)
        Which pairs agree.
    floor : int
        Only a larger set is of interest.
    nodes : int
        Limit of the search.
    clique : ndarray of int64, shape (m,)
        The result, where one is found.

    Returns
    -------
    size, visited : int
        Number of pairs found, 0 for none; nodes visited, `nodes` at the limit.
    """
    count, depths = len(pairs), len(clique)
    landmarks = pairs[:, 0].max() + 1 if count else 0
    open_ = np.zeros((depths + 1, count), np.int64)
    bounds = np.zeros((depths + 1, count), np.int64)
    counts = np.zeros(depths + 1, np.int64)
    at = np.zeros(depths + 1, np.int64)
    chosen = np.zeros(depths + 1, np.int64)
    seen = np.zeros(landmarks, np.int64)
    for k in range(count):
        open_[0, k] = k
    counts[0] = count
    _bounds(pairs, open_[0], count, bounds[0], seen)
    best, size, visited, depth = floor, 0, 0, 0
    while depth >= 0:
        k = at[depth]
        if k >= counts[depth] or depth + bounds[depth, k] <= best:
            depth -= 1
            continue
        if visited >= nodes:
            break
        visited += 1
        at[depth] += 1
        pair = open_[depth, k]
        chosen[depth] = pair
        if depth + 1 > best:
            best = size = depth + 1
            for i in range(size):
                clique[i] = chosen[i]
        if depth + 1 < depths:
            found = 0
            for later in range(k + 1, counts[depth]):
                other = open_[depth, later]
                if agree[pair, other]:
                    open_[depth + 1, found] = other
                    found += 1
            depth += 1
            counts[depth], at[depth] = found, 0
            _bounds(pairs, open_[depth], found, bounds[depth], seen)
    return size, visited
