"""Sparse least squares over submaps, by divide and conquer.

The submaps are halved by where they lie, and the halves again, down to single ones.
From the single submaps upwards, two parts are joined by adding what they say; the
unknowns that no submap outside the part touches are then eliminated, so that only the
border of a part is handed on [1]_ [2]_.

References
----------
.. [1] L. Paz, J. Tardós, J. Neira, Divide and conquer: EKF SLAM in O(n), IEEE T-RO
   24(5), 2008.
.. [2] A. George, Nested dissection of a regular finite element mesh, SIAM Journal on
   Numerical Analysis 10(2), 1973.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

Array = NDArray[np.float64]
Int = NDArray[np.int64]
Quadratic = tuple[Array, Array, float]
"""(H, g, c) of the function c − 2 gᵀ x + xᵀ H x."""


class Part(NamedTuple):
    """One submap, or two parts joined."""

    submap: int
    """-1: this part joins two others, the last two left over."""
    interior: Int
    """Unknowns that nothing outside touches."""
    border: Int
    """The others."""
    places: tuple[Int, ...]
    """Where the unknowns of the submap, or of each half, are in (interior, border)."""


class Eliminated(NamedTuple):
    """Interior of a part, in terms of its border: L y = g_i,  x_i = L⁻ᵀ (y − S x_b)."""

    part: Part
    lower: Array
    """L, the Cholesky factor of H_ii."""
    response: Array
    """S = L⁻¹ H_ib."""


def dissect(unknowns: Sequence[Int], positions: Array) -> list[Part]:
    """Halve and halve again; return the parts, every one after its halves.

    Parameters
    ----------
    unknowns : sequence of ndarray
        Those that each submap touches.
    positions : ndarray, shape (K, 2)
        Where the submaps lie [m]; only the cost depends on it.
    """
    touches = np.bincount(np.concatenate(unknowns))
    parts: list[Part] = []

    def close(submap: int, pieces: Sequence[tuple[Int, Int]]) -> tuple[Int, Int]:
        """Make a part of pieces (unknowns, how many submaps inside touch each)."""
        union, places = np.unique(
            np.concatenate([piece[0] for piece in pieces]), return_inverse=True
        )
        weights = np.concatenate([piece[1] for piece in pieces])
        inside = np.bincount(places, weights).astype(np.int64)
        done = inside == touches[union]
        order = np.empty(len(union), dtype=np.int64)
        order[np.argsort(~done, kind="stable")] = np.arange(len(union))
        cuts = np.cumsum([len(piece[0]) for piece in pieces])[:-1]
        where = tuple(np.split(order[places], cuts))
        parts.append(Part(submap, union[done], union[~done], where))
        return union[~done], inside[~done]

    def halve(chosen: Int) -> tuple[Int, Int]:
        if len(chosen) == 1:
            mine = unknowns[chosen[0]]
            return close(int(chosen[0]), [(mine, np.ones_like(mine))])
        return close(-1, [halve(half) for half in _halves(chosen, unknowns, positions)])

    halve(np.arange(len(unknowns)))
    return parts


def _halves(chosen: Int, unknowns: Sequence[Int], positions: Array) -> tuple[Int, Int]:
    """Cut along x or along y: where fewer unknowns are touched from both sides."""
    middle = len(chosen) // 2
    cuts = []
    for axis in range(2):
        order = chosen[np.argsort(positions[chosen, axis], kind="stable")]
        sides = [
            np.unique(np.concatenate([unknowns[k] for k in half]))
            for half in (order[:middle], order[middle:])
        ]
        cuts.append(
            (len(np.intersect1d(sides[0], sides[1], assume_unique=True)), order)
        )
    order = min(cuts, key=lambda cut: cut[0])[1]
    return order[:middle], order[middle:]


class Elimination:
    """The sum of what all submaps say, factorised.

    Parameters
    ----------
    parts : list of Part
        From :func:`dissect`.
    size : int
        Number of unknowns.
    say : callable
        Gives (H, g, c) of a submap by its index, in the order of its unknowns.

    Raises
    ------
    numpy.linalg.LinAlgError
        Where the sum does not determine the unknowns.
    """

    def __init__(
        self, parts: list[Part], size: int, say: Callable[[int], Quadratic]
    ) -> None:
        self.size = size
        self.cost = 0.0
        self._done: list[Eliminated] = []
        self._right: list[Array] = []
        waiting: list[tuple[Array, Array]] = []
        for part in parts:
            if part.submap >= 0:
                H, g, cost = say(part.submap)
                self.cost += cost
                pieces = [(H, g)]
            else:
                pieces = [waiting.pop(-2), waiting.pop()]
            waiting.append(self._eliminate(part, pieces))

    def _eliminate(
        self, part: Part, pieces: list[tuple[Array, Array]]
    ) -> tuple[Array, Array]:
        """Add up the pieces of a part, and return what is left for its border."""
        count = len(part.interior)
        total = count + len(part.border)
        H, g = np.zeros((total, total)), np.zeros(total)
        for places, (piece, right) in zip(part.places, pieces, strict=True):
            H[places[:, None], places] += piece
            g[places] += right
        if not count:
            return H, g
        lower: Array = np.linalg.cholesky(H[:count, :count]).astype(np.float64)
        both = np.column_stack([H[:count, count:], g[:count]])
        solved = solve_triangular(lower, both, lower=True, check_finite=False)
        response, y = solved[:, :-1], solved[:, -1]
        self._done.append(Eliminated(part, lower, np.ascontiguousarray(response)))
        self._right.append(y)
        rest = H[count:, count:] - response.T @ response
        return rest, g[count:] - response.T @ y

    def solution(self) -> Array:
        """Return x = H⁻¹ g, shape (N,)."""
        x = np.zeros(self.size)
        for done, y in zip(reversed(self._done), reversed(self._right), strict=True):
            part = done.part
            x[part.interior] = solve_triangular(
                done.lower,
                y - done.response @ x[part.border],
                lower=True,
                trans="T",
                check_finite=False,
            )
        return x

    def decrement(self) -> float:
        """Return gᵀ H⁻¹ g, by which the sum falls at its minimum."""
        return float(sum(y @ y for y in self._right))

    def covariance(self, unknowns: Int, rows: Int, values: Array, size: int) -> Array:
        """Return A H⁻¹ Aᵀ, shape (v, v), of a sparse A, shape (v, N).

        It is Yᵀ Y, with L Y = Aᵀ.  Only the parts that A touches, and those they are
        halves of, are visited; rows of Y are kept from where they are first touched
        until their part is done.

        Parameters
        ----------
        unknowns, rows, values : ndarray, shape (k,)
            Column, row and value of what is not zero in A; what stands at one place is
            added up.
        size : int
            v.
        """
        order = np.argsort(unknowns, kind="stable")
        rows, values = rows[order], values[order]
        cuts = np.searchsorted(unknowns[order], np.arange(self.size + 1)).tolist()
        live: dict[int, Array] = {}
        total = np.zeros((size, size))
        for part, lower, response in self._done:
            interior = part.interior.tolist()
            if not any(u in live or cuts[u + 1] > cuts[u] for u in interior):
                continue
            mine = np.zeros((len(interior), size))
            for place, u in enumerate(interior):
                row = mine[place]
                np.add.at(
                    row, rows[cuts[u] : cuts[u + 1]], values[cuts[u] : cuts[u + 1]]
                )
                if u in live:
                    mine[place] += live.pop(u)
            touched = np.flatnonzero(mine.any(axis=0))
            Y = solve_triangular(
                lower, mine[:, touched], lower=True, check_finite=False
            )
            total[touched[:, None], touched] += Y.T @ Y
            for u, change in zip(part.border.tolist(), response.T @ Y, strict=True):
                if u not in live:
                    live[u] = np.zeros(size)
                live[u][touched] -= change
        return total

    @property
    def nbytes(self) -> int:
        """Memory of the factors [bytes]."""
        return sum(
            done.lower.nbytes
            + done.response.nbytes
            + done.part.border.nbytes
            + done.part.interior.nbytes
            for done in self._done
        )
