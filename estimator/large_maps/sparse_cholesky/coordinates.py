"""Where the coordinates of landmarks stand in a map's arrays."""

from collections.abc import Sequence

import numpy as np

from ....arrays import IntArray


def pairs(places: Sequence[int] | IntArray) -> IntArray:
    """Return the two columns of each landmark, in turn: 2 p, 2 p + 1.

    Examples
    --------
    >>> pairs([0, 3])
    array([0, 1, 6, 7])
    """
    return (2 * np.asarray(places, dtype=np.int64)[:, None] + (0, 1)).ravel()
