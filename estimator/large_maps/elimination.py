"""Elimination of the unknowns of a large sparse map, and its order.

`LandmarkElimination` eliminates all landmarks except the local map from a sparse
information matrix.  Each node of a tree eliminates its own landmarks, after those of
its descendants (:mod:`.multifrontal`).  Landmarks of the local map are not eliminated:
they remain in the fronts up to the root, where the update is −C, the Schur complement
without Λ_LL.  Nodes that do not depend on the local map are cached.  When the local map
changes, only the nodes above the old and the new local map are computed again.

The nodes form a binary tree of separators.  The landmarks are halved by position.
Those of one half that are linked with the other half separate the two.  They belong to
the root and are eliminated last; both halves are dissected in the same way (nested
dissection, George 1973).  Node k has the children 2k and 2k + 1.  Of two linked
landmarks, the node of one is always an ancestor of the node of the other, or the same
node.  Elimination in one branch therefore does not affect any other branch.

`SubmapElimination` solves the least-squares problem of joined submaps in the same way,
part by part of the tree that `dissect` returns.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from scipy.sparse import csc_array

from ...arrays import Array, BoolArray, IntArray
from ...jit import jit_in_place
from .multifrontal import (
    GrowingCovariance,
    InformationMatrix,
    Node,
    add_update,
    eliminate,
    inverse,
    marginal_covariance,
    pairs,
    substitute_back,
    substitute_forward,
)

LEAF = 75  # largest number of landmarks in a leaf
EXTRA_LEVELS = 6  # levels by which a branch may exceed the depth of a balanced tree


class _Eliminated(NamedTuple):
    """A node and its update; of a leaf, whose update is −Xᵀ X, None."""

    node: Node
    stored_update: Array | None

    @property
    def update(self) -> Array:
        """Upper triangle of the update of the parent's front, shape (r, r)."""
        if self.stored_update is None:
            return -(self.node.response.T @ self.node.response)
        return self.stored_update

    @property
    def nbytes(self) -> int:
        """Memory of factor and update [bytes]."""
        update = 0 if self.stored_update is None else self.stored_update.nbytes
        return self.node.lower.nbytes + self.node.response.nbytes + update


class LandmarkElimination:
    """Elimination order of a map, and the eliminated nodes that are still valid."""

    def __init__(self) -> None:
        #: Node of each landmark by slot; 0 for landmarks without a node.
        self.nodes = np.zeros(0, dtype=np.int64)
        #: Number of landmarks when the whole map was dissected.
        self.dissected = 0
        self._cache: dict[int, _Eliminated] = {}

    @property
    def nbytes(self) -> int:
        """Memory of the cached nodes [bytes]."""
        return sum(part.nbytes for part in self._cache.values())

    def grow(self, count: int) -> None:
        """Make room for ``count`` landmarks."""
        more = np.zeros(max(count - len(self.nodes), 0), dtype=np.int64)
        self.nodes = np.append(self.nodes, more)

    def revise(
        self, matrix: InformationMatrix, first: Array, changed: IntArray
    ) -> None:
        """Update the elimination order after rows changed, and drop invalid nodes.

        Parameters
        ----------
        matrix : InformationMatrix
        first : ndarray, shape (2n,) or longer
            First position estimates of the landmarks [m].
        changed : ndarray, shape (k,)
            Landmarks whose rows changed.
        """
        count = len(matrix)
        self.grow(count)
        before = self.nodes[changed]
        filled = matrix.is_filled(changed)
        self.nodes[changed[~filled]] = 0
        new = changed[filled & (self.nodes[changed] == 0)]
        total = len(new) + int((self.nodes > 0).sum())
        if total > 2 * self.dissected:
            self.dissected = total
            everything = np.arange(count)
            self._dissect(matrix, first, everything[matrix.is_filled(everything)], 1)
            self._cache.clear()
            return
        self._insert(matrix, new)
        self._raise_linked(matrix, changed[filled])
        after = self.nodes[changed]
        dissected = self._dissect_large_leaves(matrix, first, np.unique(after))
        invalid = with_ancestors(np.concatenate([before, after, dissected]).astype(int))
        cached = np.array(list(self._cache), dtype=np.int64)
        for top in dissected:
            invalid.update(cached[descends(cached, top)].tolist())
        for node in invalid:
            self._cache.pop(node, None)

    def eliminate(self, matrix: InformationMatrix, local: IntArray) -> RestFactor:
        """Eliminate all landmarks except the local ones."""
        self.grow(len(matrix))
        nodes = self.nodes
        place = np.full(len(nodes), -1)
        place[local] = np.arange(len(local))
        is_local = place >= 0
        slots = np.flatnonzero((nodes > 0) & ~is_local)
        members = _by_node(slots, nodes)
        affected = with_ancestors(nodes[local])
        done: dict[int, _Eliminated] = {}
        present = with_ancestors(np.array(list(members), dtype=np.int64))
        for node in sorted(present | {1}, reverse=True):
            part = None if node in affected else self._cache.get(node)
            if part is None:
                children = [done[k] for k in (2 * node, 2 * node + 1) if k in done]
                own = members.get(node, np.empty(0, dtype=np.int64))
                beyond = is_local | ~descends(nodes, node)
                part = _eliminate(matrix, own, beyond, children)
                if node not in affected:
                    self._cache[node] = part
            done[node] = part
        border = done[1].node.rest[::2] // 2
        order = np.argsort(place[border])
        columns = pairs(order)
        upper = np.triu(done[1].update)
        C = -(upper + np.triu(upper, 1).T)[np.ix_(columns, columns)]
        factors = [part.node for part in done.values()]
        return RestFactor(factors, slots, border[order], C, len(nodes))

    def check(self, matrix: InformationMatrix, local: IntArray) -> None:
        """Raise a ValueError if linked landmarks, not both local, are unrelated."""
        is_local = np.zeros(len(matrix), dtype=bool)
        is_local[local] = True
        owners, links = self._unrelated(matrix, np.flatnonzero(self.nodes))
        if not (is_local[owners] | is_local[links]).all():
            raise ValueError("state['nodes'] must keep linked landmarks in one branch")

    def _insert(self, matrix: InformationMatrix, new: IntArray) -> None:
        """Assign each landmark to the deepest node among its links."""
        for slot in new.tolist():
            linked = self.nodes[matrix.links(slot)]
            self.nodes[slot] = max(int(linked.max(initial=0)), 1)

    def _raise_linked(self, matrix: InformationMatrix, changed: IntArray) -> None:
        """Move landmarks up to a common ancestor with all their links."""
        owners, links = self._unrelated(matrix, changed)
        for slot, link in zip(owners.tolist(), links.tolist(), strict=True):
            one, other = int(self.nodes[slot]), int(self.nodes[link])
            shared = common_ancestor(one, other)
            if shared != other:  # otherwise the other landmark has moved up already
                self.nodes[slot] = shared

    def _unrelated(
        self, matrix: InformationMatrix, slots: IntArray
    ) -> tuple[IntArray, IntArray]:
        """Return the pairs of these landmarks and their links in unrelated branches."""
        counts, links, _ = matrix.rows(slots)
        owners = np.repeat(slots, counts)
        apart = ~related(self.nodes[owners], self.nodes[links])
        return owners[apart], links[apart]

    def _dissect_large_leaves(
        self, matrix: InformationMatrix, first: Array, touched: IntArray
    ) -> list[int]:
        """Dissect leaves that have grown, or their branch if it becomes too deep."""
        dissected: list[int] = []
        for node in touched[touched > 0].tolist()[::-1]:
            below = self._below(node)
            if len(below) > 2 * LEAF and (self.nodes[below] == node).all():
                top = self._unbalanced(node)
                self._dissect(matrix, first, self._below(top), top)
                dissected.append(top)
        return dissected

    def _unbalanced(self, leaf: int) -> int:
        """Return the lowest ancestor for which the leaf is too deep, or the leaf."""
        top, levels = leaf, 0
        while top > 1:
            top, levels = top >> 1, levels + 1
            balanced = (len(self._below(top)) // LEAF).bit_length()
            if levels > 2 * balanced + EXTRA_LEVELS:
                return top
        return leaf

    def _below(self, node: int) -> IntArray:
        """Return the landmarks of a node and its descendants."""
        return np.flatnonzero(descends(self.nodes, node))

    def _dissect(
        self, matrix: InformationMatrix, first: Array, slots: IntArray, top: int
    ) -> None:
        """Assign landmarks to a node and new descendants of it."""
        part = matrix.submatrix(slots, slots)
        points = first.reshape(-1, 2)[slots]
        nodes = np.full(len(slots), top, dtype=np.int64)
        front = [(top, np.arange(len(slots)))]
        side = np.zeros(len(slots), dtype=np.int8)
        while front:
            node, these = front.pop()
            nodes[these] = node
            if len(these) <= LEAF:
                continue
            axis = int(np.argmax(np.ptp(points[these], axis=0)))
            order = these[np.argsort(points[these, axis], kind="stable")]
            low, high = order[: len(order) // 2], order[len(order) // 2 :]
            side[low], side[high] = 1, 2
            low_separator = low[_linked(low, part.indptr, part.indices, side == 2)]
            high_separator = high[_linked(high, part.indptr, part.indices, side == 1)]
            side[these] = 0
            if len(low_separator) <= len(high_separator):
                low = np.setdiff1d(low, low_separator)
            else:
                high = np.setdiff1d(high, high_separator)
            if len(low) and len(high):
                front += [(2 * node, low), (2 * node + 1, high)]
        self.nodes[slots] = nodes


def _by_node(slots: IntArray, nodes: IntArray) -> dict[int, IntArray]:
    """Group landmarks by their nodes."""
    order = slots[np.argsort(nodes[slots], kind="stable")]
    names, starts = np.unique(nodes[order], return_index=True)
    groups = np.split(order, starts[1:])[: len(names)]
    return dict(zip(names.tolist(), groups, strict=True))


def _eliminate(
    matrix: InformationMatrix, own: IntArray, far: BoolArray, below: list[_Eliminated]
) -> _Eliminated:
    """Eliminate a node's own landmarks; ``far`` marks those not below the node."""
    counts, links, blocks = matrix.rows(own)
    inherited = [child.node.rest[::2] // 2 for child in below]
    is_rest = np.zeros(len(far), dtype=bool)
    for slots in (links[far[links]], *inherited):
        is_rest[slots] = True
    is_rest[own] = False
    rest = np.flatnonzero(is_rest)
    place = np.full(len(far), -1)
    place[own] = np.arange(len(own))
    place[rest] = np.arange(len(own), len(own) + len(rest))
    p, r = 2 * len(own), 2 * len(rest)
    top, remainder = np.zeros((p, p + r)), np.zeros((r, r))
    here = place[links]
    row = np.repeat(np.arange(len(own)), counts)[here >= 0]
    quads = top.reshape(len(own), 2, len(own) + len(rest), 2)
    quads[row, :, here[here >= 0], :] = blocks[here >= 0]
    for child, slots in zip(below, inherited, strict=True):
        add_update(top, remainder, pairs(place[slots]), child.update)
    node = eliminate(top, remainder, pairs(own), pairs(rest))
    return _Eliminated(node, remainder if below else None)


class RestFactor(NamedTuple):
    """All landmarks H except the local ones L, eliminated from a map.

    ::

        Λ_LL δ_L + Λ_LH δ_H = b_L,   Λ_HL δ_L + Λ_HH δ_H = 0
        ⟹ (Λ_LL − C) δ_L = b_L,   δ_H = −T δ_B,   T = Λ_HH⁻¹ Λ_HB,   C = Λ_BH T

    where B ⊂ L are the local landmarks linked with H.
    """

    nodes: list[Node]  # children first
    slots: IntArray  # H
    border: IntArray  # B, in the order of L
    complement: Array  # C, shape (2c, 2c), symmetric
    size: int  # number of slots of the map

    def respond(self, shift: Array) -> Array:
        """Return T δ_B."""
        values = np.zeros(2 * self.size)
        values[pairs(self.border)] = shift
        substitute_back(self.nodes, values)
        return -values[pairs(self.slots)]

    def covariance(self, slots: IntArray) -> tuple[Array, Array]:
        """Return blocks of Λ_HH⁻¹ and rows of T.

        Parameters
        ----------
        slots : ndarray, shape (v,)
            Eliminated landmarks.

        Returns
        -------
        covariance : ndarray, shape (2v, 2v)
        response : ndarray, shape (2v, 2c)
        """
        columns = pairs(slots)
        size = len(columns)
        where = (np.arange(size), columns)
        unit = csc_array((np.ones(size), where), (size, 2 * self.size))
        covariance, remainder = marginal_covariance(self.nodes, unit)
        response = np.zeros((size, 2 * len(self.border)))
        for column, unknown in enumerate(pairs(self.border).tolist()):
            response[:, column] = -remainder.get(unknown, 0.0)
        return covariance, response


def _linked(
    rows: IntArray, starts: IntArray, links: IntArray, others: BoolArray
) -> BoolArray:
    """Return which rows of a sparse matrix link to one of the others."""
    n = starts[rows + 1] - starts[rows]
    ends = np.cumsum(n)
    places = np.arange(ends[-1]) + np.repeat(starts[rows] - ends + n, n)
    hits = np.concatenate([[0], np.cumsum(others[links[places]])])
    return np.asarray(hits[ends] > hits[ends - n])


def depth(nodes: IntArray) -> IntArray:
    """Return the levels of nodes below the root; -1 for 0."""
    return np.frexp(nodes.astype(np.float64))[1].astype(np.int64) - 1


def descends(nodes: IntArray, node: int) -> BoolArray:
    """Return which nodes are this node or its descendants."""
    below = depth(nodes) - (node.bit_length() - 1)
    return np.asarray((below >= 0) & (nodes >> np.maximum(below, 0) == node))


def related(nodes: IntArray, others: IntArray) -> BoolArray:
    """Return which pairs are on one path from the root; 0 is related to all nodes."""
    apart = depth(nodes) - depth(others)
    up = nodes >> np.maximum(apart, 0)
    down = others >> np.maximum(-apart, 0)
    return np.asarray((nodes == 0) | (others == 0) | (up == down))


def common_ancestor(one: int, other: int) -> int:
    """Return the deepest node that is an ancestor of both, or one of the two."""
    while one != other:
        if one > other:
            one >>= 1
        else:
            other >>= 1
    return one


def with_ancestors(nodes: IntArray) -> set[int]:
    """Return nodes and all their ancestors, without 0."""
    found: set[int] = set()
    front = set(nodes.tolist()) - {0}
    while front:
        found |= front
        front = {node >> 1 for node in front} - found - {0}
    return found


Quadratic = tuple[Array, Array, float]  # (H, g, c) of the function c − 2 gᵀ x + xᵀ H x


class SubmapElimination:
    """Cholesky factor of H, where c − 2 gᵀ x + xᵀ H x is the sum over all submaps.

    Parameters
    ----------
    parts : list of Part
        From :func:`dissect`.
    size : int
        Number of unknowns N.
    quadratic : callable
        Returns (H, g, c) of a submap by its index, in the order of its unknowns.

    Raises
    ------
    numpy.linalg.LinAlgError
        If the sum does not determine the unknowns.
    """

    def __init__(
        self, parts: list[Part], size: int, quadratic: Callable[[int], Quadratic]
    ) -> None:
        #: c.
        self.cost = 0.0
        self._nodes: list[Node] = []
        self._solved = np.zeros(size)  # L⁻¹ g
        updates: list[Array] = []
        for part in parts:
            count, r = len(part.interior), len(part.border)
            if part.submap >= 0:
                H, g, cost = quadratic(part.submap)
                self.cost += cost
                unknowns = np.append(part.interior, part.border)
                self._solved[unknowns[part.places[0]]] += g
                if not count:  # the order is that of the submap
                    updates.append(H)
                    continue
                pieces = [H]
            else:
                pieces = [updates.pop(-2), updates.pop()]
            top, rest = np.zeros((count, count + r)), np.zeros((r, r))
            for places, piece in zip(part.places, pieces, strict=True):
                add_update(top, rest, places, piece)
            if count:
                node = eliminate(top, rest, part.interior, part.border)
                self._nodes.append(node)
            updates.append(rest)
        substitute_forward(self._nodes, self._solved)

    def solution(self) -> Array:
        """Return x = H⁻¹ g, shape (N,)."""
        x = self._solved.copy()
        substitute_back(self._nodes, x)
        return x

    def decrement(self) -> float:
        """Return gᵀ H⁻¹ g, by which the sum falls at its minimum."""
        solved = [self._solved[node.own] for node in self._nodes]
        return float(sum(y @ y for y in solved))

    def solve(self, g: Array) -> tuple[float, Array]:
        """Return gᵀ H⁻¹ g and H⁻¹ g for another g, which is overwritten."""
        substitute_forward(self._nodes, g)
        decrement = float(g @ g)
        substitute_back(self._nodes, g)
        return decrement, g

    def covariance(self, rows: csc_array) -> Array:
        """Return A H⁻¹ Aᵀ, shape (v, v), for a sparse A, shape (v, N)."""
        return marginal_covariance(self._nodes, rows)[0]

    def inverse(self, rows: IntArray, size: int) -> GrowingCovariance:
        """Return H⁻¹ with each unknown in a given row, and room for more variables."""
        return inverse(self._nodes, rows, size)

    @property
    def nbytes(self) -> int:
        """Memory of the factor [bytes]."""
        return sum(node.nbytes for node in self._nodes)


# --------------------------------------------------------------------------------------
# Elimination order of a map of submaps: a binary tree over the submaps.
#
# The submaps are halved by position, and the halves again, down to single submaps.  A
# part of the tree eliminates the unknowns that no submap outside the part touches, so
# that only its border is passed on to the part that contains it [1]_ [2]_.
#
# References
# ----------
# .. [1] L. Paz, J. Tardós, J. Neira, Divide and conquer: EKF SLAM in O(n), IEEE T-RO
#    volume 24, number 5, 2008.
# .. [2] A. George, Nested dissection of a regular finite element mesh, SIAM Journal on
#    Numerical Analysis 10(2), 1973.


class Part(NamedTuple):
    """One submap, or two parts joined."""

    # -1 if the part joins the two most recent parts that are not joined yet.
    submap: int
    interior: IntArray  # unknowns that no submap outside the part touches
    border: IntArray  # all other unknowns of the part
    # Positions in (interior, border) of the submap's or each half's unknowns.
    places: tuple[IntArray, ...]


def dissect(unknowns: Sequence[IntArray], positions: Array) -> list[Part]:
    """Halve the submaps recursively; return all parts, halves before their union.

    Parameters
    ----------
    unknowns : sequence of ndarray
        Unknowns that each submap touches.
    positions : ndarray, shape (K, 2)
        Positions of the submaps [m]; they affect only the cost.
    """
    touches = np.bincount(np.concatenate(unknowns))
    scratch = np.full(len(touches), -1)
    parts: list[Part] = []

    def close(
        submap: int, pieces: Sequence[tuple[IntArray, IntArray]]
    ) -> tuple[IntArray, IntArray]:
        """Join pieces (unknowns, number of submaps inside that touch each)."""
        every, weights = (np.concatenate(each) for each in zip(*pieces, strict=True))
        found = np.empty((3, len(every)), dtype=np.int64)
        done, n = _join(every, weights, touches, scratch, found)
        places, order, inside = found
        where = (places[: len(pieces[0][0])], places[len(pieces[0][0]) :])
        parts.append(Part(submap, order[:done], order[done:n], where[: len(pieces)]))
        return order[done:n], inside[done:n]

    def halve(chosen: IntArray) -> tuple[IntArray, IntArray]:
        if len(chosen) == 1:
            touched = unknowns[chosen[0]]
            return close(int(chosen[0]), [(touched, np.ones_like(touched))])
        halves = _halves(chosen, unknowns, positions, scratch)
        return close(-1, [halve(half) for half in halves])

    halve(np.arange(len(unknowns)))
    return parts


@jit_in_place
def _join(
    every: IntArray,
    weights: IntArray,
    touches: IntArray,
    row: IntArray,
    found: IntArray,
) -> tuple[int, int]:
    """Write the union of unknowns, those first that no submap outside touches.

    Parameters
    ----------
    every, weights : ndarray, shape (m,)
        Unknowns, and numbers of submaps inside.
    touches : ndarray, shape (N,)
        Numbers of all submaps that touch each unknown.
    row : ndarray, shape (N,)
        Scratch of -1, before and after.
    found : ndarray, shape (3, m)
        On return, the place of each of ``every`` in the union, the union of n unknowns,
        and the number of submaps inside that touch each of them.

    Returns
    -------
    done, n
        How many unknowns are touched inside alone, and all.
    """
    places, order, inside = found[0], found[1], found[2]
    n = done = 0
    for k in range(len(every)):
        if row[every[k]] < 0:
            row[every[k]], order[n], inside[n] = n, every[k], 0
            n += 1
        inside[row[every[k]]] += weights[k]
    for i in range(n):
        if inside[i] == touches[order[i]]:
            order[i], order[done] = order[done], order[i]
            inside[i], inside[done] = inside[done], inside[i]
            done += 1
    for i in range(n):
        row[order[i]] = i
    for k in range(len(every)):
        places[k] = row[every[k]]
    for i in range(n):
        row[order[i]] = -1
    return done, n


def _halves(
    chosen: IntArray, unknowns: Sequence[IntArray], positions: Array, scratch: IntArray
) -> tuple[IntArray, IntArray]:
    """Cut along x or y, whichever leaves fewer unknowns on both sides."""
    middle = len(chosen) // 2
    cuts = []
    for axis in range(2):
        order = chosen[np.argsort(positions[chosen, axis], kind="stable")]
        one, other = (
            np.concatenate([unknowns[k] for k in half])
            for half in (order[:middle], order[middle:])
        )
        cuts.append((_count_common(one, other, scratch), order))
    order = min(cuts, key=lambda cut: cut[0])[1]
    return order[:middle], order[middle:]


@jit_in_place
def _count_common(one: IntArray, other: IntArray, row: IntArray) -> int:
    """Count the numbers that occur in both; ``row`` is a scratch of -1."""
    common = 0
    row[one] = 0
    for each in other:
        if row[each] == 0:
            common, row[each] = common + 1, 1
    row[one] = -1
    return common
