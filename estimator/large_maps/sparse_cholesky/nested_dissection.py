"""In which order the landmarks of a map are eliminated: a tree of separators.

The landmarks are halved by where they were found; those of one half that are linked
with the other part the two, belong to the root and are eliminated last; either half is
parted in the same manner (nested dissection, George 1973).  Node k has the children
2k and 2k + 1.  Linked landmarks always belong to nodes of which one is an ancestor of
the other, or the same: what is eliminated in one branch leaves all others as they are.
"""

import numpy as np
from numpy.typing import NDArray

from .information_matrix import InformationMatrix

Array = NDArray[np.float64]
Int = NDArray[np.int64]

LEAF = 150  # landmarks, up to which a node is not parted
SPARE = 6  # levels by which a branch may be deeper than were all balanced


class Dissection:
    """Node of each landmark by slot, 0 for those that are in none."""

    def __init__(self) -> None:
        self.nodes = np.zeros(0, dtype=np.int64)
        self.parted = 0  # landmarks when all of them were parted last

    def grow(self, count: int) -> None:
        """Make room for so many landmarks."""
        more = np.zeros(max(count - len(self.nodes), 0), dtype=np.int64)
        self.nodes = np.append(self.nodes, more)

    def revise(
        self, matrix: InformationMatrix, first: Array, changed: Int
    ) -> tuple[Int, list[int]]:
        """Take in landmarks whose rows changed.

        Returns the nodes they were in and are in, and those below which all was parted
        anew.
        """
        count = len(matrix)
        self.grow(count)
        before = self.nodes[changed]
        live = matrix.filled(changed)
        self.nodes[changed[~live]] = 0
        new = changed[live & (self.nodes[changed] == 0)]
        placed = int((self.nodes > 0).sum())
        if len(new) + placed > 2 * self.parted:
            self.parted = len(new) + placed
            everything = np.arange(count)
            everything = everything[matrix.filled(everything)]
            self._dissect(matrix, first, everything, 1)
            return before, [1]
        self._place(matrix, new)
        self._rise(matrix, changed[live])
        after = self.nodes[changed]
        parted = self._part_large(matrix, first, np.unique(after))
        return np.union1d(before, after), parted

    def check(self, matrix: InformationMatrix, local: Int) -> None:
        """Refuse linked landmarks, not both local, in unrelated branches."""
        inside = np.zeros(len(matrix), dtype=bool)
        inside[local] = True
        owners, links = self._apart(matrix, np.flatnonzero(self.nodes))
        wrong = ~(inside[owners] | inside[links])
        if wrong.any():
            raise ValueError("state['nodes'] must keep linked landmarks in one branch")

    def _place(self, matrix: InformationMatrix, new: Int) -> None:
        """Put landmarks beside the one with the deepest node they are linked with."""
        for slot in new.tolist():
            near = self.nodes[matrix.links(slot)]
            self.nodes[slot] = max(int(near.max(initial=0)), 1)

    def _rise(self, matrix: InformationMatrix, changed: Int) -> None:
        """Raise landmarks to an ancestor common with all that they are linked with."""
        owners, links = self._apart(matrix, changed)
        for slot, link in zip(owners.tolist(), links.tolist(), strict=True):
            one, other = int(self.nodes[slot]), int(self.nodes[link])
            shared = common_ancestor(one, other)
            if shared != other:  # it has not risen meanwhile
                self.nodes[slot] = shared

    def _apart(self, matrix: InformationMatrix, slots: Int) -> tuple[Int, Int]:
        """Return these and their links, where they are in unrelated branches."""
        counts, links, _ = matrix.rows(slots)
        owners = np.repeat(slots, counts)
        apart = ~related(self.nodes[owners], self.nodes[links])
        return owners[apart], links[apart]

    def _part_large(
        self, matrix: InformationMatrix, first: Array, touched: Int
    ) -> list[int]:
        """Part leaves that have grown, or a branch that would become too deep."""
        found: list[int] = []
        for node in touched[touched > 0].tolist()[::-1]:
            below = self._below(node)
            if len(below) > 2 * LEAF and (self.nodes[below] == node).all():
                top = self._unbalanced(node)
                self._dissect(matrix, first, self._below(top), top)
                found.append(top)
        return found

    def _unbalanced(self, node: int) -> int:
        """Return the lowest ancestor below which a leaf lies too deep, or the leaf."""
        top, levels = node, 0
        while top > 1:
            top, levels = top >> 1, levels + 1
            if levels > 2 * (len(self._below(top)) // LEAF).bit_length() + SPARE:
                return top
        return node

    def _below(self, node: int) -> Int:
        """Return the landmarks of a node and its descendants."""
        return np.flatnonzero(descends(self.nodes, node))

    def _dissect(
        self, matrix: InformationMatrix, first: Array, slots: Int, top: int
    ) -> None:
        """Part these landmarks anew, from a node downwards."""
        part = matrix.part(slots, slots)
        counts, links = np.diff(part.indptr), part.indices
        places = first.reshape(-1, 2)[slots]
        nodes = np.full(len(slots), top, dtype=np.int64)
        starts = part.indptr
        front = [(top, np.arange(len(slots)))]
        side = np.zeros(len(slots), dtype=np.int8)
        while front:
            node, these = front.pop()
            nodes[these] = node
            if len(these) <= LEAF:
                continue
            axis = int(np.argmax(np.ptp(places[these], axis=0)))
            order = these[np.argsort(places[these, axis], kind="stable")]
            low, high = order[: len(order) // 2], order[len(order) // 2 :]
            side[low], side[high] = 1, 2
            near = low[_touches(low, side, starts, counts, links, 2)]
            over = high[_touches(high, side, starts, counts, links, 1)]
            side[these] = 0
            if len(near) <= len(over):
                low = np.setdiff1d(low, near)
            else:
                high = np.setdiff1d(high, over)
            if len(low) and len(high):
                front += [(2 * node, low), (2 * node + 1, high)]
        self.nodes[slots] = nodes


def _touches(
    slots: Int, side: NDArray[np.int8], starts: Int, counts: Int, links: Int, other: int
) -> NDArray[np.bool_]:
    """Whether each is linked with one on the other side."""
    n = counts[slots]
    ends = np.cumsum(n)
    places = np.arange(ends[-1]) + np.repeat(starts[slots] - ends + n, n)
    hits = np.concatenate([[0], np.cumsum(side[links[places]] == other)])
    return np.asarray(hits[ends] > hits[ends - n])


def depth(nodes: Int) -> Int:
    """Levels below the root; of 0, −1."""
    return np.frexp(nodes.astype(np.float64))[1].astype(np.int64) - 1


def descends(nodes: Int, node: int) -> NDArray[np.bool_]:
    """Whether nodes are this one or below it."""
    below = depth(nodes) - (node.bit_length() - 1)
    return np.asarray((below >= 0) & (nodes >> np.maximum(below, 0) == node))


def related(nodes: Int, others: Int) -> NDArray[np.bool_]:
    """Whether each is above or below the other, or the same; 0 is related to all."""
    apart = depth(nodes) - depth(others)
    up = nodes >> np.maximum(apart, 0)
    down = others >> np.maximum(-apart, 0)
    return np.asarray((nodes == 0) | (others == 0) | (up == down))


def common_ancestor(one: int, other: int) -> int:
    """Return the deepest node that is above both, or one of them."""
    while one != other:
        if one > other:
            one >>= 1
        else:
            other >>= 1
    return one
