"""Elimination of all landmarks except the local map, with reuse between local maps.

Each node of a :class:`LandmarkDissection` eliminates its own landmarks, after those of
its descendants (:mod:`.multifrontal`).  Landmarks of the local map are not eliminated:
they remain in the fronts up to the root, where the update is −C, the Schur complement
without Λ_LL.

Nodes that do not depend on the local map are cached.  When the local map changes, only
the nodes above the old and the new local map are computed again.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.sparse import csc_array

from ....arrays import Array, BoolArray, IntArray
from .coordinates import pairs
from .extend_add import add_update
from .information_matrix import InformationMatrix
from .landmark_dissection import LandmarkDissection, descends, with_ancestors
from .multifrontal import (
    Node,
    eliminate_in_place,
    marginal_covariance,
    substitute_back,
    substitute_forward,
)
from .schur_complement import SchurComplement


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
        self.dissection = LandmarkDissection()
        self._cache: dict[int, _Eliminated] = {}

    def checkpoint(self) -> Callable[[], None]:
        """Return what takes back later changes of the order."""
        nodes, dissected = self.dissection.nodes.copy(), self.dissection.dissected

        def undo() -> None:
            self.dissection.nodes, self.dissection.dissected = nodes, dissected
            self._cache.clear()

        return undo

    @property
    def nbytes(self) -> int:
        """Memory of the cached nodes [bytes]."""
        return sum(part.nbytes for part in self._cache.values())

    def revise(
        self, matrix: InformationMatrix, first: Array, changed: IntArray
    ) -> None:
        """Update the elimination order after rows changed, and drop invalid nodes."""
        nodes, dissected = self.dissection.revise(matrix, first, changed)
        invalid = with_ancestors(np.append(nodes, np.array(dissected, dtype=np.int64)))
        cached = np.array(list(self._cache), dtype=np.int64)
        for top in dissected:
            invalid.update(cached[descends(cached, top)].tolist())
        for node in invalid:
            self._cache.pop(node, None)

    def eliminate(
        self, matrix: InformationMatrix, local: IntArray
    ) -> tuple[list[Node], Array, IntArray]:
        """Eliminate all landmarks except the local ones.

        Returns
        -------
        nodes : list of Node
            Children first.
        update : ndarray
            Of the root, whose ``rest`` are local landmarks.
        slots : ndarray
            The eliminated landmarks.
        """
        self.dissection.grow(len(matrix))
        nodes = self.dissection.nodes
        is_local = np.zeros(len(nodes), dtype=bool)
        is_local[local] = True
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
        upper = np.triu(done[1].update)
        update = upper + np.triu(upper, 1).T
        return [part.node for part in done.values()], update, slots


def _by_node(slots: IntArray, nodes: IntArray) -> dict[int, IntArray]:
    """Group landmarks by their nodes."""
    order = slots[np.argsort(nodes[slots], kind="stable")]
    names, starts = np.unique(nodes[order], return_index=True)
    groups = np.split(order, starts[1:])[: len(names)]
    return dict(zip(names.tolist(), groups, strict=True))


def _eliminate(
    matrix: InformationMatrix,
    own: IntArray,
    beyond: BoolArray,
    children: list[_Eliminated],
) -> _Eliminated:
    """Eliminate a node's own landmarks; ``beyond`` marks those not below the node."""
    counts, links, blocks = matrix.rows(own)
    inherited = [child.node.rest[::2] // 2 for child in children]
    is_rest = np.zeros(len(beyond), dtype=bool)
    for slots in (links[beyond[links]], *inherited):
        is_rest[slots] = True
    is_rest[own] = False
    rest = np.flatnonzero(is_rest)
    place = np.full(len(beyond), -1)
    place[own] = np.arange(len(own))
    place[rest] = np.arange(len(own), len(own) + len(rest))
    p, r = 2 * len(own), 2 * len(rest)
    top, remainder = np.zeros((p, p + r)), np.zeros((r, r))
    here = place[links]
    row = np.repeat(np.arange(len(own)), counts)[here >= 0]
    quads = top.reshape(len(own), 2, len(own) + len(rest), 2)
    quads[row, :, here[here >= 0], :] = blocks[here >= 0]
    for child, slots in zip(children, inherited, strict=True):
        add_update(top, remainder, pairs(place[slots]), child.update)
    node = eliminate_in_place(top, remainder, pairs(own), pairs(rest))
    return _Eliminated(node, remainder if children else None)


class RestFactor:
    """Factor of all landmarks except the local ones, made when it is first used."""

    def __init__(
        self,
        elimination: LandmarkElimination,
        matrix: InformationMatrix,
        local: IntArray,
    ) -> None:
        self._elimination, self._matrix, self._local = elimination, matrix, local
        self._done: tuple[list[Node], Array, IntArray] | None = None

    def _eliminated(self) -> tuple[list[Node], Array, IntArray]:
        if self._done is None:
            self._done = self._elimination.eliminate(self._matrix, self._local)
        return self._done

    @property
    def slots(self) -> IntArray:
        """The eliminated landmarks, H."""
        return self._eliminated()[2]

    def solve(self, right: Array) -> Array:
        """Return Λ_HH⁻¹ b."""
        nodes, _, slots = self._eliminated()
        rows = pairs(slots)
        values = np.zeros((2 * len(self._matrix), *right.shape[1:]))
        values[rows] = right
        substitute_forward(nodes, values)
        values[pairs(self._local)] = 0.0
        substitute_back(nodes, values)
        return values[rows]

    def respond(self, shift: Array) -> Array:
        """Return T δ_B."""
        nodes, _, slots = self._eliminated()
        values = np.zeros(2 * len(self._matrix))
        values[pairs(self._local)[self.border()[0]]] = shift
        substitute_back(nodes, values)
        return -values[pairs(slots)]

    def covariance(self, slots: IntArray) -> tuple[Array, Array]:
        """Return blocks of Λ_HH⁻¹ and rows of T.

        Parameters
        ----------
        slots : ndarray, shape (v,)
            Eliminated landmarks.

        Returns
        -------
        covariance : ndarray, shape (2v, 2v)
        response : ndarray, shape (2v, c)
        """
        nodes, _, _ = self._eliminated()
        columns = pairs(slots)
        size = len(columns)
        where = (np.arange(size), columns)
        unit = csc_array((np.ones(size), where), (size, 2 * len(self._matrix)))
        covariance, remainder = marginal_covariance(nodes, unit)
        border = pairs(self._local)[self.border()[0]].tolist()
        response = np.zeros((size, len(border)))
        for column, unknown in enumerate(border):
            if unknown in remainder:
                response[:, column] = -remainder[unknown]
        return covariance, response

    def border(self) -> tuple[IntArray, IntArray]:
        """Return the columns of B in the local map, and in the root's front."""
        place = np.full(len(self._matrix), -1)
        place[self._local] = np.arange(len(self._local))
        rest = place[self._eliminated()[0][-1].rest[::2] // 2]
        order = np.argsort(rest)
        return pairs(rest[order]), pairs(order)

    def complement(self) -> SchurComplement:
        """Return the effect on the local map; T is not computed."""
        border, columns = self.border()
        C = -self._eliminated()[1][np.ix_(columns, columns)]
        return SchurComplement(
            self.slots, border, np.empty((0, len(border))), (C + C.T) / 2, self
        )

    def release(self) -> None:
        """Free the memory of the factor that is not cached."""
        self._done = None
