"""Which landmarks a local information map holds, and how many around it count."""

from math import inf

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Int = NDArray[np.int64]

# Landmarks that a local map holds at least when it is chosen, and those eliminated
# around it at first, where the tolerance allows to leave others.
LOCAL, AROUND = 50, 100
# By how many times more of those are taken, should they not do; all, should these not.
WIDER = 16
# In a large map the local one is larger: all around it may have to be eliminated, at a
# cost that grows with the map, while a step costs the third power of the local size.
SHARE, POWER = 3, 0.4


def local_size(mapped: int, readings: int, wanted: int) -> int:
    """Return how many landmarks a local map should hold when it is chosen."""
    least = max(LOCAL, int(SHARE * mapped**POWER))
    return max(least, 3 * readings, 3 * wanted // 2)


def choose_local(
    mapped: Int, points: Array, centre: Array, wanted: Int, size: int
) -> Int:
    """Return the wanted landmarks and the nearest to a point, ``size`` in all."""
    distances = ((points[mapped] - centre) ** 2).sum(axis=1)
    count = min(size, len(mapped))
    nearest = mapped[np.argpartition(distances, count - 1)[:count]]
    return union(wanted, np.sort(nearest))[: max(size, len(wanted))]


def first_reach(last: float, *, widened: bool) -> float:
    """Return how many landmarks to eliminate around a new local map: what was needed.

    Where the last reach did at once, less may do.
    """
    return last if widened else max(AROUND, min(last, WIDER**2 * AROUND) / WIDER)


def wider(reach: float) -> float:
    """Return how many to eliminate where ``reach`` did not do: in the end, all."""
    return WIDER * reach if reach < WIDER * AROUND else inf


def union(first: Int, second: Int) -> Int:
    """Return the first places, then those of the second that are not among them."""
    return np.concatenate([first, second[~np.isin(second, first)]])
