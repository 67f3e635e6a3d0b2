"""Eliminate all of a map but the landmarks around the robot, and keep what still holds.

A node of the :class:`Dissection` eliminates its own landmarks P, when all below it have
been, and hands to its parent what that means for the landmarks R they are linked with
(multifrontal Cholesky; Duff and Reid 1983)::

    [Λ_PP Λ_PR; · U] = sum of the rows of P and of what the children handed up
    L Lᵀ = Λ_PP,   X = L⁻¹ Λ_PR,   U ← U − Xᵀ X

Landmarks of the local map are not eliminated: they stay in R up to the root, whose U is
−C.  When the robot moves on, only the nodes above the old and the new local map are
worked out again; all others are as they were.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack, solve_triangular

from .coordinates import pairs
from .information_matrix import InformationMatrix, Surroundings
from .nested_dissection import Dissection, descends

Array = NDArray[np.float64]
Int = NDArray[np.int64]


class Eliminated(NamedTuple):
    """What one node worked out."""

    own: Int
    """P, shape (p,)."""
    rest: Int
    """R, shape (r,)."""
    factor: Array
    """L, shape (2p, 2p)."""
    response: Array
    """X, shape (2p, 2r)."""
    kept: Array | None
    """U, shape (2r, 2r); of a leaf, where it is −Xᵀ X, None."""

    @property
    def handed(self) -> Array:
        """U, shape (2r, 2r)."""
        return -(self.response.T @ self.response) if self.kept is None else self.kept

    @property
    def nbytes(self) -> int:
        """Memory that it takes [bytes]."""
        kept = 0 if self.kept is None else self.kept.nbytes
        return self.factor.nbytes + self.response.nbytes + kept


class Elimination:
    """The nodes of a map that are worked out, and hold until their landmarks change."""

    def __init__(self) -> None:
        self.dissection = Dissection()
        self._known: dict[int, Eliminated] = {}

    @property
    def nbytes(self) -> int:
        """Memory that what is kept takes [bytes]."""
        return sum(part.nbytes for part in self._known.values())

    def revise(self, matrix: InformationMatrix, first: Array, changed: Int) -> None:
        """Take in rows that changed, and forget what they were the ground of."""
        nodes, parted = self.dissection.revise(matrix, first, changed)
        gone = ancestry(np.append(nodes, np.array(parted, dtype=np.int64)))
        for top in parted:
            gone |= {node for node in self._known if _is_below(node, top)}
        for node in gone:
            self._known.pop(node, None)

    def work_out(
        self, matrix: InformationMatrix, local: Int
    ) -> tuple[list[Eliminated], Int]:
        """Return all nodes, children first, and the landmarks they eliminate."""
        self.dissection.grow(len(matrix))
        nodes = self.dissection.nodes
        inside = np.zeros(len(nodes), dtype=bool)
        inside[local] = True
        own = np.flatnonzero((nodes > 0) & ~inside)
        own = own[np.argsort(nodes[own], kind="stable")]
        names, starts = np.unique(nodes[own], return_index=True)
        parts = np.split(own, starts[1:])[: len(names)]
        members = dict(zip(names.tolist(), parts, strict=True))
        affected = ancestry(nodes[local])
        found: dict[int, Eliminated] = {}
        for node in sorted(ancestry(names) | {1}, reverse=True):
            known = None if node in affected else self._known.get(node)
            if known is None:
                children = [
                    found[child] for child in (2 * node, 2 * node + 1) if child in found
                ]
                mine = members.get(node, np.empty(0, dtype=np.int64))
                beyond = inside | ~descends(nodes, node)
                known = eliminate(matrix, mine, beyond, children)
                if node not in affected:
                    self._known[node] = known
            found[node] = known
        return list(found.values()), np.sort(own)


def ancestry(nodes: Int) -> set[int]:
    """Return nodes and all that are above them."""
    found: set[int] = set()
    front = set(nodes.tolist()) - {0}
    while front:
        found |= front
        front = {node >> 1 for node in front} - found - {0}
    return found


def _is_below(node: int, top: int) -> bool:
    return node >> max(node.bit_length() - top.bit_length(), 0) == top


def eliminate(
    matrix: InformationMatrix,
    own: Int,
    beyond: NDArray[np.bool_],
    children: list[Eliminated],
) -> Eliminated:
    """Eliminate a node's own landmarks; ``beyond`` says which are not below it."""
    counts, links, blocks = matrix.rows(own)
    outside = links[beyond[links]]
    rest = np.setdiff1d(np.concatenate([outside, *(c.rest for c in children)]), own)
    place = np.full(len(beyond), -1)
    place[own] = np.arange(len(own))
    place[rest] = np.arange(len(own), len(own) + len(rest))
    size, p = 2 * (len(own) + len(rest)), 2 * len(own)
    front = np.zeros((size, size))
    here = place[links]
    row = np.repeat(np.arange(len(own)), counts)[here >= 0]
    by_blocks = front.reshape(size // 2, 2, size // 2, 2)
    by_blocks[row, :, here[here >= 0], :] = blocks[here >= 0]
    for child in children:
        at = pairs(place[child.rest])
        front[np.ix_(at, at)] += child.handed
    factor, failed = front[:p, :p], 0
    if p:
        factor, failed = lapack.dpotrf(factor, lower=1, clean=1)
    if failed:
        raise np.linalg.LinAlgError("the information matrix is not positive definite")
    response = np.ascontiguousarray(_solve(factor, front[:p, p:]))
    handed = front[p:, p:] - response.T @ response if children else None
    return Eliminated(own, rest, np.ascontiguousarray(factor), response, handed)


def _solve(factor: Array, right: Array, *, transposed: bool = False) -> Array:
    if not right.size:
        return right.copy()
    return np.asarray(
        solve_triangular(
            factor, right, lower=True, trans=int(transposed), check_finite=False
        )
    )


class Factor:
    """Solves with what :class:`Elimination` worked out, as late as it is asked to."""

    def __init__(
        self, whole: Elimination, matrix: InformationMatrix, local: Int
    ) -> None:
        self._ask = (whole, matrix, local)
        self._nodes: list[Eliminated] | None = None
        self._slots = local

    def nodes(self) -> list[Eliminated]:
        """Return all nodes, children first."""
        if self._nodes is None:
            self._nodes, self._slots = self._ask[0].work_out(*self._ask[1:])
        return self._nodes

    @property
    def slots(self) -> Int:
        """The landmarks eliminated, H."""
        self.nodes()
        return self._slots

    def solve(self, right: Array) -> Array:
        """Work out Λ_HH⁻¹ b."""
        values = np.zeros((2 * len(self._ask[1]), *right.shape[1:]))
        rows = pairs(self.slots)
        values[rows] = right
        for node in self.nodes():
            own, rest = pairs(node.own), pairs(node.rest)
            values[own] = _solve(node.factor, values[own])
            values[rest] -= node.response.T @ values[own]
        values[pairs(self._ask[2])] = 0.0
        return self._back(values)[rows]

    def respond(self, border: Int, shift: Array) -> Array:
        """Work out T δ_B, where B are some of the local landmarks' coordinates."""
        values = np.zeros(2 * len(self._ask[1]))
        rows = pairs(self.slots)
        values[pairs(self._ask[2])[border]] = shift
        return -self._back(values)[rows]

    def _back(self, values: Array) -> Array:
        for node in reversed(self.nodes()):
            own, rest = pairs(node.own), pairs(node.rest)
            right = values[own] - node.response @ values[rest]
            values[own] = _solve(node.factor, right, transposed=True)
        return values


def surround_all(
    whole: Elimination, matrix: InformationMatrix, local: Int
) -> Surroundings:
    """Eliminate all landmarks but the local ones; T is not made, C is."""
    factor = Factor(whole, matrix, local)
    root = factor.nodes()[-1]
    place = np.full(len(matrix), -1)
    place[local] = np.arange(len(local))
    order = np.argsort(place[root.rest])
    border = pairs(place[root.rest][order])
    columns = pairs(order)
    complement = -root.handed[np.ix_(columns, columns)]
    return Surroundings(
        factor.slots,
        border,
        np.empty((0, len(border))),
        (complement + complement.T) / 2,
        factor.solve,
        lambda shift: factor.respond(border, shift),
    )
