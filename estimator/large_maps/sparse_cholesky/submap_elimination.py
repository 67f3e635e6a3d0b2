"""Sparse least squares over submaps: normal equations, factorised part by part."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_array

from .multifrontal import (
    Node,
    eliminate,
    marginal_covariance,
    substitute_back,
    substitute_forward,
)
from .submap_dissection import Part

Array = NDArray[np.float64]
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
        self._forward = np.zeros(size)
        waiting: list[Array] = []
        for part in parts:
            if part.submap >= 0:
                H, g, cost = quadratic(part.submap)
                unknowns = np.concatenate([part.interior, part.border])
                self._forward[unknowns[part.places[0]]] += g
                self.cost += cost
                updates = [H]
            else:
                updates = [waiting.pop(-2), waiting.pop()]
            waiting.append(self._eliminate(part, updates))
        substitute_forward(self._nodes, self._forward)

    def _eliminate(self, part: Part, updates: list[Array]) -> Array:
        """Add the updates to the front of a part; return the update of its border."""
        count = len(part.interior)
        total = count + len(part.border)
        front = np.zeros((total, total))
        for places, update in zip(part.places, updates, strict=True):
            front[places[:, None], places] += update
        if not count:
            return front
        node = eliminate(front, part.interior, part.border)
        self._nodes.append(node)
        return front[count:, count:] - node.response.T @ node.response

    def solution(self) -> Array:
        """Return x = H⁻¹ g, shape (N,)."""
        x = self._forward.copy()
        substitute_back(self._nodes, x)
        return x

    def decrement(self) -> float:
        """Return gᵀ H⁻¹ g, by which the sum falls at its minimum."""
        return float(self._forward @ self._forward)

    def covariance(self, rows: csc_array) -> Array:
        """Return A H⁻¹ Aᵀ, shape (v, v), for a sparse A, shape (v, N)."""
        return marginal_covariance(self._nodes, rows)[0]

    @property
    def nbytes(self) -> int:
        """Memory of the factor [bytes]."""
        return sum(node.nbytes for node in self._nodes)
