"""The arrays in which a filter processes a scan; they grow with scan and map."""

from __future__ import annotations

import numpy as np

from ...arrays import Array, IntArray
from ..kernels.kalman_gain import BLOCK
from ..kernels.rules import Rules
from ..kernels.scan_record import copy_scan
from ..kernels.scan_rows import (
    OUTCOME,
    USED,
    Workspace,
    new_ledger,
    new_workspace,
    prior_system,
)


class ScanWorkspace:
    """Ledger and intermediate results of one update.

    Parameters
    ----------
    rules : Rules
        They decide which arrays an update needs.
    """

    def __init__(self, rules: Rules) -> None:
        self._rules = rules
        self.readings = self.capacity = 0
        """Most readings in a scan, and length of the mean."""

    def make_room(self, readings: int, capacity: int) -> None:
        """Grow the arrays where a scan could overflow them."""
        if readings < self.readings and capacity == self.capacity:
            return
        room = 8 + 2 * readings
        self.arrays = workspace_for(self._rules, room, capacity)
        self.ledger = new_ledger(room)
        height = len(self.arrays.rows)
        self._first_row = prior_system(height, self._rules.iterations)
        self.readings, self.capacity = room, capacity

    def copies(self, used: int, readings: int) -> tuple[Array, IntArray]:
        """Return copies of what the last update has left, for a :class:`ScanRecord`."""
        ledger, first = self.ledger[:, :readings], self._first_row
        return copy_scan(self.arrays.rows, ledger, used, first)

    def failed_reading(self, status: int, readings: int) -> int:
        """Return the reading whose innovation covariance could not be factored."""
        used = np.flatnonzero(self.ledger[OUTCOME, :readings] == USED)
        return int(used[status])


def workspace_for(rules: Rules, readings: int, capacity: int) -> Workspace:
    """Allocate what updates by these rules need, with this many readings at most."""
    repeated = rules.iterations > 1 or rules.sequential
    return new_workspace(
        readings,
        capacity,
        iterated=rules.iterations > 1,
        spoilable=repeated or readings > BLOCK,
    )


def covariances_for(rules: Rules) -> int:
    """Return how many arrays of the size of P an update needs: P, and copies of it."""
    iterated = rules.iterations > 1
    return 1 + iterated + (iterated or rules.sequential)


def not_positive_definite(landmark_id: int) -> np.linalg.LinAlgError:
    """Return the error of an innovation covariance that cannot be factored."""
    return np.linalg.LinAlgError(
        "the innovation covariance is not positive definite at the reading of "
        f"landmark {landmark_id}: the belief or measurement_std is degenerate"
    )
