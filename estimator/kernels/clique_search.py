"""Search for the largest clique of pairs of landmarks, compiled.

:mod:`slamgym.estimator.association.constellations` has the equations.
"""

import numpy as np

from ...arrays import Array, BoolArray, IntArray
from ...jit import jit, njit_internal
from ..models.bearing_range import wrap_angle_jit


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
            clique[:size] = chosen[:size]
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
