"""The sum of a front and the updates of its children, compiled."""

from ....arrays import Array, IntArray
from ....jit import jit


@jit
def add_update(front: Array, at: IntArray, update: Array) -> None:
    """Add a child's update (r, r) to the rows and columns ``at`` (r,) of a front.

    The sum is that of ``front[np.ix_(at, at)] += update``, without its three copies.
    """
    for i in range(len(at)):
        row, values = front[at[i]], update[i]
        for j in range(len(at)):
            row[at[j]] += values[j]
