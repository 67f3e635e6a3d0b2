"""Which landmarks a compressed filter's local map holds, and how many."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Int = NDArray[np.int64]

# A map of up to so many landmarks is local as a whole: what a split would save in most
# steps it would lose in those that begin a phase.
WHOLE = 250
# Steps that a phase must last to pay for its end.
SHORT = 4
# Landmarks of a local map beyond those of a scan, at most, as a multiple of these; and
# so many mapped landmarks for each of that multiple: a phase's end costs a² n.
MOST, MAPPED = 2.5, 400


def spare_landmarks(before: int, read: int, mapped: int, lasted: int) -> int:
    """Return how many landmarks beyond those of a scan the next local map should hold.

    Parameters
    ----------
    before : int
        How many the last one did.
    read : int
        Mapped landmarks in the scan.
    mapped : int
        Landmarks in the map.
    lasted : int
        Steps of the phase that ends.

    Examples
    --------
    >>> [spare_landmarks(9, 10, mapped, lasted=20) for mapped in (300, 1000, 5000)]
    [7, 25, 25]
    >>> spare_landmarks(9, 10, 1000, lasted=1)  # the readings jump about
    4
    """
    if lasted < SHORT:
        return before // 2
    return min(2 * before + 8, int(max(read, 4) * min(MOST, mapped / MAPPED)))


def nearest_to(
    place: Array, ids: Sequence[int], points: Array, count: int
) -> list[int]:
    """Return the landmarks nearest to a place (2,), by their positions (n, 2)."""
    count = min(count, len(ids))
    distances = ((points - place) ** 2).sum(axis=1)
    nearest = np.argpartition(distances, count - 1)[:count]
    nearest = nearest[np.argsort(distances[nearest], kind="stable")]
    return [ids[k] for k in nearest.tolist()]
