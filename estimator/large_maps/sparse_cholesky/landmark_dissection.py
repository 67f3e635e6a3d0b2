"""Elimination order of the landmarks of a map: a binary tree of separators.

The landmarks are halved by position.  Those of one half that are linked with the other
half separate the two.  They belong to the root and are eliminated last; both halves are
dissected in the same way (nested dissection, George 1973).  Node k has the children
2k and 2k + 1.  Of two linked landmarks, the node of one is always an ancestor of the
node of the other, or the same node.  Elimination in one branch therefore does not
affect any other branch.
"""

import numpy as np

from ....arrays import Array, BoolArray, IntArray
from .information_matrix import InformationMatrix

LEAF = 75
"""Largest number of landmarks in a leaf."""
EXTRA_LEVELS = 6
"""Levels by which a branch may exceed the depth of a balanced tree."""


class LandmarkDissection:
    """Node of each landmark by slot; 0 for landmarks without a node."""

    def __init__(self) -> None:
        self.nodes = np.zeros(0, dtype=np.int64)
        self.dissected = 0  # number of landmarks when the whole map was dissected

    def grow(self, count: int) -> None:
        """Make room for ``count`` landmarks."""
        more = np.zeros(max(count - len(self.nodes), 0), dtype=np.int64)
        self.nodes = np.append(self.nodes, more)

    def revise(
        self, matrix: InformationMatrix, first: Array, changed: IntArray
    ) -> tuple[IntArray, list[int]]:
        """Update the tree after rows of the matrix changed.

        Parameters
        ----------
        matrix : InformationMatrix
        first : ndarray, shape (2n,) or longer
            First position estimates of the landmarks [m].
        changed : ndarray, shape (k,)
            Landmarks whose rows changed.

        Returns
        -------
        nodes : ndarray
            Nodes that the landmarks were in or are in now.
        dissected : list of int
            Nodes whose branches were dissected again.
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
            return before, [1]
        self._insert(matrix, new)
        self._raise_linked(matrix, changed[filled])
        after = self.nodes[changed]
        dissected = self._dissect_large_leaves(matrix, first, np.unique(after))
        return np.union1d(before, after), dissected

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
            low_separator = low[_is_linked(low, part.indptr, part.indices, side == 2)]
            high_separator = high[
                _is_linked(high, part.indptr, part.indices, side == 1)
            ]
            side[these] = 0
            if len(low_separator) <= len(high_separator):
                low = np.setdiff1d(low, low_separator)
            else:
                high = np.setdiff1d(high, high_separator)
            if len(low) and len(high):
                front += [(2 * node, low), (2 * node + 1, high)]
        self.nodes[slots] = nodes


def _is_linked(
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
