"""Room for the intermediate results of one update, and the layout of its rows.

``docs/kernels.md`` has a picture of them.
"""

from typing import NamedTuple

import numpy as np

from ...arrays import Array, IntArray
from ...jit import njit_internal
from .belief_arrays import aligned_zeros

# The first rows are vectors over the whole state.
CORRECTION = 0  # δ
TRANSPORT = 1  # v of the transport T = I + v e_θᵀ
PRIOR_MEAN = 2  # before this correction
HEADING = 3  # P[:, θ]
MEAN_BEFORE = 4  # before the scan

# The stacked system follows: two rows (bearing, range) for each reading in use.  Such a
# row begins with its row of A and ends with META_WIDTH more columns, which are counted
# from the end.
FIRST = 5
READING = -1  # z
VARIANCE = -2  # diagonal of Q
INNOVATION = -3  # ν
WHITE = -4  # w = L⁻¹ ν
ROOT = -6  # and the next: row of the diagonal block of L
JACOBIAN = -11  # and the next four: row of H, by x, y, θ, landmark x, landmark y
META_WIDTH = 16

# Rows of the ledger of one scan.
SLOT = 0  # of each reading: place of its landmark in the map, negative for a new one
OUTCOME = 1  # of each reading: USED, ADDED, GATED or SKIPPED
NEAR = 2  # of each reading: 1 where the robot is too near its landmark to linearise
COLUMN = 3  # of each reading in use: its landmark's first column in the state
LEDGER_HEIGHT = 4

# Outcomes of a reading.
USED, ADDED, GATED, SKIPPED = 0, 1, 2, 3


class Workspace(NamedTuple):
    """Room for one update; every row begins on a cache line."""

    rows: Array  # (FIRST + 2m + 2, capacity + META_WIDTH), two systems to iterate
    before: Array  # (capacity, capacity) P to restore after a failure, or empty
    prior: Array  # (capacity, capacity) P to iterate from, or empty


def new_workspace(
    readings: int, capacity: int, *, iterated: bool, spoilable: bool
) -> Workspace:
    """Allocate the workspace of a belief.

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
        aligned_zeros(FIRST + systems, (capacity + 7) // 8 * 8 + META_WIDTH),
        aligned_zeros(kept, kept),
        aligned_zeros(iterable, iterable),
    )


def new_ledger(readings: int) -> IntArray:
    """Allocate the ledger of a scan of at most so many readings."""
    return np.zeros((LEDGER_HEIGHT, readings), dtype=np.int64)


def prior_system(height: int, iterations: int) -> int:
    """Return the row at which the system linearised at the prior begins.

    Parameters
    ----------
    height : int
        Number of rows of the workspace.
    iterations : int
        With more than one, :func:`.correct.save_prior_rows` copies that system to the
        second half of the rows.
    """
    return FIRST if iterations == 1 else FIRST + (height - FIRST) // 2


prior_system_jit = njit_internal(prior_system)
