"""Choice of the local landmarks, and of how many to eliminate around them."""

from math import inf

import numpy as np

from ....arrays import Array, IntArray

SMALLEST_LOCAL_MAP = 50
"""Smallest number of landmarks in a new local map."""
FIRST_COUNT = 100
"""Number of landmarks eliminated at first, if the tolerance allows it."""
GROWTH = 16
"""Growth factor of that number when it is too small.  The second step takes all."""
SCALE, EXPONENT = 3, 0.4
"""Size of the local map of a large map: 3 n^0.4.

A change of the local map may eliminate the whole map, at a cost that grows with n; a
step costs the third power of the local size.
"""


def local_map_size(mapped: int, readings: int, required: int) -> int:
    """Return the number of landmarks of a new local map."""
    least = max(SMALLEST_LOCAL_MAP, int(SCALE * mapped**EXPONENT))
    return max(least, 3 * readings, 3 * required // 2)


def choose_local(
    mapped: IntArray, points: Array, centre: Array, required: IntArray, size: int
) -> IntArray:
    """Return the required landmarks and those nearest to a point, ``size`` in all."""
    distances = ((points[mapped] - centre) ** 2).sum(axis=1)
    count = min(size, len(mapped))
    nearest = mapped[np.argpartition(distances, count - 1)[:count]]
    return union(required, np.sort(nearest))[: max(size, len(required))]


def first_elimination_count(last: float, *, enlarged: bool) -> float:
    """Return the number of landmarks to eliminate around a new local map.

    This is the last number if it had to be enlarged, and a smaller one otherwise.
    """
    if enlarged:
        return last
    return max(FIRST_COUNT, min(last, GROWTH**2 * FIRST_COUNT) / GROWTH)


def larger_elimination_count(count: float) -> float:
    """Return the number to eliminate if ``count`` was too small; finally infinity."""
    return GROWTH * count if count < GROWTH * FIRST_COUNT else inf


def union(first: IntArray, second: IntArray) -> IntArray:
    """Return the first slots, then those of the second that are not among them."""
    return np.concatenate([first, second[~np.isin(second, first)]])
