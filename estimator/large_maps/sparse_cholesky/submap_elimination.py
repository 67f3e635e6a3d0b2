"""Sparse least squares over submaps: normal equations, factorised part by part."""

from collections.abc import Callable

import numpy as np
from scipy.sparse import csc_array

from ....arrays import Array
from .multifrontal import Node, eliminate, marginal_covariance, substitute_back
from .submap_dissection import Part

Quadratic = tuple[Array, Array, float]
"""(H, g, c) of the function c − 2 gᵀ x + xᵀ H x."""


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
        self.cost = 0.0
        """c."""
        self._nodes: list[Node] = []
        self._solved = np.zeros(size)  # L⁻¹ g
        updates: list[tuple[Array, Array]] = []
        for part in parts:
            if part.submap >= 0:
                H, g, cost = quadratic(part.submap)
                self.cost += cost
                pieces = [(H, g)]
            else:
                pieces = [updates.pop(-2), updates.pop()]
            updates.append(self._eliminate(part, pieces))

    def _eliminate(
        self, part: Part, pieces: list[tuple[Array, Array]]
    ) -> tuple[Array, Array]:
        """Add (H, g) of the pieces of a part; return the update of its border."""
        count = len(part.interior)
        total = count + len(part.border)
        front = np.zeros((total, total + 1))
        for places, (H, g) in zip(part.places, pieces, strict=True):
            front[places[:, None], places] += H
            front[places, -1] += g
        rest, right = front[count:, count:-1], front[count:, -1]
        if not count:
            return rest, right
        node, solved = eliminate(front, part.interior, part.border)
        response, y = solved[:, :-1], solved[:, -1]
        self._nodes.append(node)
        self._solved[part.interior] = y
        return rest - response.T @ response, right - response.T @ y

    def solution(self) -> Array:
        """Return x = H⁻¹ g, shape (N,)."""
        x = self._solved.copy()
        substitute_back(self._nodes, x)
        return x

    def decrement(self) -> float:
        """Return gᵀ H⁻¹ g, by which the sum falls at its minimum."""
        solved = [self._solved[node.own] for node in self._nodes]
        return float(sum(y @ y for y in solved))

    def covariance(self, rows: csc_array) -> Array:
        """Return A H⁻¹ Aᵀ, shape (v, v), for a sparse A, shape (v, N)."""
        return marginal_covariance(self._nodes, rows)[0]

    @property
    def nbytes(self) -> int:
        """Memory of the factor [bytes]."""
        return sum(node.nbytes for node in self._nodes)
