"""The report of an update on the shared kernels; its parts are computed on request."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property, partial
from itertools import compress

from ...arrays import Array, IntArray
from ..kernels.scan_record import ScanRecord
from ..kernels.scan_rows import ADDED, GATED, NEAR, OUTCOME, SKIPPED, USED
from ..update_report import UpdateReport


class ScanReport(UpdateReport):
    """The results of one scan, from the arrays that its kernel has left; a snapshot.

    Parameters
    ----------
    nis : float
        νᵀ S⁻¹ ν.
    ids : list of int
        Landmark of each reading.
    copies : tuple of ndarray
        The parts of a :class:`ScanRecord`.
    sequential : bool
        Whether readings were linearised one after the other.
    """

    _ids: list[int]
    _copies: tuple[Array, IntArray]
    _sequential: bool

    def __init__(
        self,
        nis: float,
        ids: list[int],
        copies: tuple[Array, IntArray],
        *,
        sequential: bool,
    ) -> None:
        parts = self.__dict__
        parts["nis"], parts["_ids"] = nis, ids
        parts["_copies"], parts["_sequential"] = copies, sequential

    @property
    def _record(self) -> ScanRecord:
        return ScanRecord(*self._copies)

    @cached_property
    def degrees_of_freedom(self) -> int:
        """Of the NIS: twice the number of associated readings."""
        return len(self._record.rows)

    @cached_property
    def associated_ids(self) -> tuple[int, ...]:
        """Mapped landmarks whose readings corrected the belief."""
        return self._with_outcome(USED)

    @cached_property
    def added_ids(self) -> tuple[int, ...]:
        """Landmarks that entered the map."""
        return self._with_outcome(ADDED)

    @cached_property
    def rejected_ids(self) -> tuple[int, ...]:
        """Mapped landmarks whose readings the chi-square gate rejected."""
        return self._with_outcome(GATED)

    @cached_property
    def skipped_ids(self) -> tuple[int, ...]:
        """Landmarks whose readings are too close to use."""
        return self._with_outcome(SKIPPED)

    @cached_property
    def near_ids(self) -> tuple[int, ...]:
        """Mapped landmarks within 10 σ of the robot."""
        return tuple(compress(self._ids, self._record.ledger[NEAR].tolist()))

    @cached_property
    def innovation(self) -> Array:
        """ν, shape (m, 2), rows (bearing, range) [rad, m]."""
        return self._record.innovation

    @property
    def factor(self) -> Callable[[], Array]:
        """The function that returns L, shape (2m, 2m), L Lᵀ = S."""
        return partial(self._record.joint_factor, sequential=self._sequential)

    def _with_outcome(self, outcome: int) -> tuple[int, ...]:
        chosen = self._record.ledger[OUTCOME] == outcome
        return tuple(compress(self._ids, chosen.tolist()))
