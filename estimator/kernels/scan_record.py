"""What a report keeps of a scan: copies of the rows and the ledger of its update."""

from typing import NamedTuple

import numpy as np

from ...arrays import Array, IntArray
from .scan_rows import (
    COLUMN,
    INNOVATION,
    JACOBIAN,
    META_WIDTH,
    ROOT,
)


class ScanRecord(NamedTuple):
    """The stacked system of one scan, copied out of the workspace."""

    rows: Array  # (2m, at least 3 + 2m + META_WIDTH)
    ledger: IntArray  # (LEDGER_HEIGHT, readings), its columns counted in these rows

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
            columns = np.repeat(self.ledger[COLUMN, : count // 2], 2)
            every = np.arange(count)
            pose = H[:, :3] @ rows[:, :3].T
            x = H[every, 3, None] * rows[:, columns].T
            y = H[every, 4, None] * rows[:, columns + 1].T
            factor = np.tril(pose + x + y)
        for k in range(0, count, 2):
            factor[k : k + 2, k : k + 2] = rows[k : k + 2, ROOT : ROOT + 2]
        return factor


def copy_scan(
    rows: Array, ledger: IntArray, used: int, first: int
) -> tuple[Array, IntArray]:
    """Copy the parts of a :class:`ScanRecord` out of the workspace.

    Where the map is much larger than the scan, the copy has only the columns of the
    pose and of the landmarks read.

    Parameters
    ----------
    rows : ndarray
        Of the workspace.
    ledger : ndarray of int64
        One column for each reading of the scan.
    used : int
        Number of readings in use.
    first : int
        Row at which the system linearised at the prior begins.
    """
    found, kept = rows[first : first + 2 * used], ledger.copy()
    if found.shape[1] <= 4 * (3 + 2 * used + META_WIDTH):
        return found.copy(), kept
    columns = ledger[COLUMN, :used]
    landmarks = np.stack([columns, columns + 1], axis=1).ravel()
    chosen = np.concatenate([[0, 1, 2], landmarks, np.arange(-META_WIDTH, 0)])
    kept[COLUMN, :used] = 3 + 2 * np.arange(used)
    return found[:, chosen], kept
