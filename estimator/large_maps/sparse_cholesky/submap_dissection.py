"""Elimination order of a map of submaps: a binary tree over the submaps.

The submaps are halved by position, and the halves again, down to single submaps.  A
part of the tree eliminates the unknowns that no submap outside the part touches, so
that only its border is passed on to the part that contains it [1]_ [2]_.

References
----------
.. [1] L. Paz, J. Tardós, J. Neira, Divide and conquer: EKF SLAM in O(n), IEEE T-RO
   24(5), 2008.
.. [2] A. George, Nested dissection of a regular finite element mesh, SIAM Journal on
   Numerical Analysis 10(2), 1973.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ....arrays import Array, IntArray


class Part(NamedTuple):
    """One submap, or two parts joined."""

    submap: int
    """-1 if the part joins the two most recent parts that are not joined yet."""
    interior: IntArray
    """Unknowns that no submap outside the part touches."""
    border: IntArray
    """All other unknowns of the part."""
    places: tuple[IntArray, ...]
    """Positions in (interior, border) of the submap's or each half's unknowns."""


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
    parts: list[Part] = []

    def close(
        submap: int, pieces: Sequence[tuple[IntArray, IntArray]]
    ) -> tuple[IntArray, IntArray]:
        """Join pieces (unknowns, number of submaps inside that touch each)."""
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

    def halve(chosen: IntArray) -> tuple[IntArray, IntArray]:
        if len(chosen) == 1:
            touched = unknowns[chosen[0]]
            return close(int(chosen[0]), [(touched, np.ones_like(touched))])
        return close(-1, [halve(half) for half in _halves(chosen, unknowns, positions)])

    halve(np.arange(len(unknowns)))
    return parts


def _halves(
    chosen: IntArray, unknowns: Sequence[IntArray], positions: Array
) -> tuple[IntArray, IntArray]:
    """Cut along x or y, whichever leaves fewer unknowns on both sides."""
    middle = len(chosen) // 2
    cuts = []
    for axis in range(2):
        order = chosen[np.argsort(positions[chosen, axis], kind="stable")]
        sides = [
            np.unique(np.concatenate([unknowns[k] for k in half]))
            for half in (order[:middle], order[middle:])
        ]
        shared = np.intersect1d(sides[0], sides[1], assume_unique=True)
        cuts.append((len(shared), order))
    order = min(cuts, key=lambda cut: cut[0])[1]
    return order[:middle], order[middle:]
