"""Choice of the local landmarks of a compressed filter, and of their number."""

from collections.abc import Mapping, Sequence

import numpy as np

from ....arrays import Array

LARGEST_WHOLE_MAP = 350
"""Up to this many landmarks, the local map is the whole map.

The end of a phase has a cost of its own.  In smaller maps it exceeds two full updates.
"""
LARGEST_WHOLE_INVARIANT = 400
"""The same in the invariant frame, where phases end at twice the cost."""
SMALLEST_LOCAL_MAP = 30
"""Smallest number of landmarks at which a local map may be too large."""
SHORT_PHASE = 4
"""Steps after which a phase has paid for its end."""
LARGEST_RATIO, LANDMARKS_PER_RATIO = 2.5, 400
"""Limit of the extra landmarks, as a multiple of the landmarks of a scan.

The multiple is one for every 400 mapped landmarks, at most 2.5: the end of a phase
costs a² n.
"""


def largest_whole_map(*, invariant: bool) -> int:
    """Return the number of landmarks up to which the local map is the whole map."""
    return LARGEST_WHOLE_INVARIANT if invariant else LARGEST_WHOLE_MAP


def extra_landmarks(before: int, read: int, mapped: int, lasted: int) -> int:
    """Return the number of landmarks of the next local map beyond those of a scan.

    Parameters
    ----------
    before : int
        The last such number.
    read : int
        Mapped landmarks in the scan.
    mapped : int
        Landmarks in the map.
    lasted : int
        Steps of the phase that ends.

    Examples
    --------
    >>> [extra_landmarks(9, 10, mapped, lasted=20) for mapped in (300, 1000, 5000)]
    [7, 25, 25]
    >>> extra_landmarks(9, 10, 1000, lasted=1)  # scans far apart from each other
    4
    """
    if lasted < SHORT_PHASE:
        return before // 2
    ratio = min(LARGEST_RATIO, mapped / LANDMARKS_PER_RATIO)
    return min(2 * before + 8, int(max(read, 4) * ratio))


def choose_local(
    centre: Array,
    required: Sequence[int],
    slots: Mapping[int, int],
    points: Array,
    size: int,
) -> dict[int, None]:
    """Return the required landmarks, and the nearest to a point up to ``size`` in all.

    Parameters
    ----------
    centre : ndarray, shape (2,)
    required : sequence of int
    slots : mapping
        Row in ``points`` by landmark.
    points : ndarray, shape (n, 2)
        Positions of the landmarks [m].
    size : int
    """
    chosen = dict.fromkeys(required)
    if len(chosen) >= size:
        return chosen
    ids = list(slots)
    distances = ((points[list(slots.values())] - centre) ** 2).sum(axis=1)
    count = min(size + len(required), len(ids))
    nearest = np.argpartition(distances, count - 1)[:count]
    for k in nearest[np.argsort(distances[nearest], kind="stable")].tolist():
        if len(chosen) >= size:
            break
        chosen[ids[k]] = None
    return chosen
