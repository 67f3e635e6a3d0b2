"""The sum of a front and the updates of its children, compiled."""

from ....arrays import Array, IntArray
from ....jit import jit


@jit
def add_update(top: Array, rest: Array, at: IntArray, update: Array) -> None:
    """Add a child's update (r, r) to the rows and columns ``at`` (r,) of a front.

    The front is ``top`` (p, n), its first rows, above ``rest`` (n - p, n - p), the
    other rows without their first columns.  Only upper triangles are read and written.
    """
    p = len(top)
    for i in range(len(at)):
        for j in range(i, len(at)):
            row, column = at[i], at[j]
            if row > column:
                row, column = column, row
            if row < p:
                top[row, column] += update[i, j]
            else:
                rest[row - p, column - p] += update[i, j]
