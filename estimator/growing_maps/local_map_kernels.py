"""Moving columns between a block of rows and rows of their own, compiled."""

import numpy as np
from numpy.typing import NDArray

from ..compiled import compiled

Array = NDArray[np.float64]
Int = NDArray[np.int64]


@compiled
def read_columns(block: Array, first: int, columns: Int, rows: Array) -> None:
    """Copy some columns of a block into rows (c, width), from column ``first`` on.

    Row by row: neighbours lie in one cache line.
    """
    for i in range(len(block)):
        for j in range(len(columns)):
            rows[j, first + i] = block[i, columns[j]]


@compiled
def write_columns(block: Array, first: int, columns: Int, rows: Array) -> None:
    """Copy rows (c, width), from column ``first`` on, into some columns of a block."""
    for i in range(len(block)):
        for j in range(len(columns)):
            block[i, columns[j]] = rows[j, first + i]
