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
SMALLEST_SHARE = 10
"""Take all at once if the larger number exceeds a tenth of the map.

The elimination of all reuses what is known, and is then as fast.
"""
SCALE, EXPONENT = 2, 0.4
"""Size of the local map of a large map: 2 n^0.4.

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


def first_elimination_count(last: float, mapped: int, *, enlarged: bool) -> float:
    """Return the number of landmarks to eliminate around a new local map.

    This is the last number if it had to be enlarged, and a smaller one otherwise.

    Examples
    --------
    >>> first_elimination_count(inf, 10_000, enlarged=False)
    100
    """
    if enlarged:
        return last
    less = min(last, GROWTH**2 * FIRST_COUNT) / GROWTH
    return less if _is_worthwhile(less, mapped) else FIRST_COUNT


def larger_elimination_count(count: float, mapped: int) -> float:
    """Return the number to eliminate if ``count`` was too small; finally infinity.

    Examples
    --------
    >>> [larger_elimination_count(100, mapped) for mapped in (10_000, 100_000)]
    [inf, 1600]
    """
    more = GROWTH * count
    return more if count < more < inf and _is_worthwhile(more, mapped) else inf


def _is_worthwhile(count: float, mapped: int) -> bool:
    most = min(GROWTH * FIRST_COUNT, mapped / SMALLEST_SHARE)
    return FIRST_COUNT < count <= most


def union(first: IntArray, second: IntArray) -> IntArray:
    """Return the first slots, then those of the second that are not among them."""
    return np.concatenate([first, second[~np.isin(second, first)]])
