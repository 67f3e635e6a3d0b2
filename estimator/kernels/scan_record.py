"""What a report keeps of a scan: the rows that its update has left."""

from typing import NamedTuple

import numpy as np

from .belief_arrays import Array, Int
from .rules import Rules
from .scan_rows import (
    COLUMN,
    INNOVATION,
    JACOBIAN,
    META_WIDTH,
    ROOT,
    prior_system,
)


class ScanRecord(NamedTuple):
    """The stacked system of one scan, copied out of the workspace."""

    rows: Array  # (2m, at least 3 + 2m + META_WIDTH)
    columns: Int  # (m,) first column of each reading's landmark in these rows

    @property
    def innovation(self) -> Array:
        """Innovations ν, shape (m, 2)."""
        return self.rows[:, INNOVATION].reshape(-1, 2)

    def joint_factor(self, *, sequential: bool) -> Array:
        """Return L of S = L Lᵀ, shape (2m, 2m), lower triangular.

        Off its diagonal blocks L = H Aᵀ, since Q is diagonal; or 0 where readings were
        linearised one after the other.
        """
        rows, count = self.rows, len(self.rows)
        H = rows[:, JACOBIAN : JACOBIAN + 5]
        factor = np.zeros((count, count))
        if not sequential:
            columns = np.repeat(self.columns, 2)
            every = np.arange(count)
            pose = H[:, :3] @ rows[:, :3].T
            x = H[every, 3, None] * rows[:, columns].T
            y = H[every, 4, None] * rows[:, columns + 1].T
            factor = np.tril(pose + x + y)
        for k in range(0, count, 2):
            factor[k : k + 2, k : k + 2] = rows[k : k + 2, ROOT : ROOT + 2]
        return factor


def record(rows: Array, ledger: Int, used: int, rules: Rules) -> ScanRecord:
    """Copy what a report needs of a scan out of its rows and its ledger.

    Where the map is much larger than the scan, the copy has only the columns of the
    pose and of the landmarks read.
    """
    first = prior_system(len(rows), rules.iterations)
    found = rows[first : first + 2 * used]
    columns = ledger[COLUMN, :used]
    if found.shape[1] <= 4 * (3 + 2 * used + META_WIDTH):
        return ScanRecord(found.copy(), columns.copy())
    landmarks = np.stack([columns, columns + 1], axis=1).ravel()
    chosen = np.concatenate([[0, 1, 2], landmarks, np.arange(-META_WIDTH, 0)])
    return ScanRecord(found[:, chosen], 3 + 2 * np.arange(used))
