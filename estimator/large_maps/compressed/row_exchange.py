"""Copy rows and columns between the arrays of a map and a local map, compiled."""

from ....arrays import Array, IntArray
from ....jit import jit


@jit
def read_columns(block: Array, first: int, columns: IntArray, rows: Array) -> None:
    """Copy some columns of a block into rows (c, width), from column ``first`` on.

    The copy runs row by row, because neighbours share a cache line.
    """
    for i in range(len(block)):
        for j in range(len(columns)):
            rows[j, first + i] = block[i, columns[j]]


@jit
def read_marginal(
    block: Array, first: int, columns: IntArray, covariance: Array
) -> None:
    """Copy what a block holds of the covariance (c, c) of some columns, lower half."""
    last = first + len(block)
    for i in range(len(columns)):
        row = columns[i]
        if first <= row < last:
            for j in range(len(columns)):
                column = columns[j]
                if column <= row:
                    value = block[row - first, column]
                    covariance[i, j] = covariance[j, i] = value


@jit
def write_columns(
    block: Array,
    first: int,
    own: IntArray,
    columns: IntArray,
    rows: Array,
    places: IntArray,
) -> None:
    """Copy the rows at ``places``, from column ``first`` on, into some columns.

    Only the rows ``own`` of the block change.
    """
    for i in own:
        for j in range(len(columns)):
            block[i, columns[j]] = rows[places[j], first + i]


@jit
def fill_extended(
    covariance: Array, before: int, pose: Array, rows: Array, virtual: int, step: int
) -> None:
    """Put a local map and the extension of a phase into the covariance of a filter.

    Parameters
    ----------
    covariance : ndarray, shape (capacity, capacity)
        Overwritten; its first ``before`` rows and columns were in use.
    pose : ndarray, shape (3, 3)
        Covariance of the pose.
    rows : ndarray, shape (a, a - 3)
        Covariance of pose and local landmarks with the local landmarks.  Of the last
        a - 3 rows, only the lower half is used.
    virtual, step : int
        Number of columns of the extension; every ``step``-th belongs to a coordinate.
    """
    size = max(before, len(rows) + virtual)
    covariance[:size, :size] = 0.0
    for i in range(len(rows)):
        for j in range(i + 1):
            value = pose[i, j] if i < 3 else rows[j, i - 3]
            if j >= 3:
                value = rows[i, j - 3]
            k, m = i + virtual * (i >= 3), j + virtual * (j >= 3)
            covariance[k, m] = covariance[m, k] = value
        if virtual:
            k, m = i + virtual * (i >= 3), 3 + step * i
            covariance[k, m] = covariance[m, k] = 1.0


@jit
def unpivot(factor: Array, places: IntArray, rows: Array) -> None:
    """Copy the first rows of a triangular factor, its columns to their places."""
    for i in range(len(rows)):
        for j in range(i, len(places)):
            rows[i, places[j]] = factor[i, j]
