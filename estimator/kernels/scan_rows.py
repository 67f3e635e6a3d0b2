"""Room for the intermediate results of one update, and what stands where in it."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

CACHE_LINE = 64  # [bytes]

# First rows: vectors over the whole state.
SHIFT, WAY, PRIOR_MEAN, HEADING, MEAN_BEFORE = 0, 1, 2, 3, 4

# Then the stacked system, two rows (bearing, range) for each reading in use.
FIRST = 5

# Columns of such a row, counted from its end; before them its row of A.
READING, VARIANCE, INNOVATION, WHITE, COLUMN = -1, -2, -3, -4, -5
ROOT = -7  # and the next: its row of the diagonal block of L
JACOBIAN = -12  # and the next four: by x, y, θ and its landmark's two coordinates
HEAD = 16


class Workspace(NamedTuple):
    """Room for one update; every row begins on a cache line."""

    rows: Array  # (FIRST + 2m + 2, capacity + HEAD), twice as many systems to iterate
    before: Array  # (capacity, capacity) P to go back to on failure, or empty
    prior: Array  # (capacity, capacity) P to iterate from, or empty


def new_workspace(
    readings: int, capacity: int, *, iterated: bool, spoilable: bool
) -> Workspace:
    """Allocate for so many readings of a belief of that capacity.

    Parameters
    ----------
    readings, capacity : int
        Most readings in one scan, and length of the mean.
    iterated : bool
        Whether updates linearise more than once.
    spoilable : bool
        Whether an update can fail after it has changed P.
    """
    systems = (2 if iterated else 1) * (2 * readings + 2)
    kept, iterable = capacity * spoilable, capacity * iterated
    return Workspace(
        aligned_zeros(FIRST + systems, (capacity + 7) // 8 * 8 + HEAD),
        aligned_zeros(kept, kept),
        aligned_zeros(iterable, iterable),
    )


def aligned_zeros(*shape: int) -> Array:
    """Return zeros that begin on a cache line: vectors then lie in one line, not two.

    Examples
    --------
    >>> aligned_zeros(3, 5).ctypes.data % CACHE_LINE
    0
    """
    size = int(np.prod(shape))
    room = np.zeros(size + CACHE_LINE // 8)
    skipped = -room.ctypes.data % CACHE_LINE // 8
    return room[skipped : skipped + size].reshape(shape)
