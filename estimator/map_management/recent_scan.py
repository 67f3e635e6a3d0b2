"""One of the last scans of a run, kept so that it can be repeated."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ...arrays import Array
from ..association.scan_association import LABEL_BITS, NO_LABEL
from ..interface import SlamEstimator, UpdateReport
from ..support import saved_states
from ..support.saved_states import with_prefix, without_prefix
from .map_editor import CachedEditor

ENTRIES = ["number", "motions", "readings", "row_ids", "labels", "removed", "merged"]
"""What the saved state of a scan holds, beside the state of the filter."""

NO_LANDMARK = np.iinfo(np.int64).min

Motion = tuple[float, float, float]
"""(d, α) [m, rad] and dt."""


@dataclass(frozen=True)
class RecentScan:
    """One scan, the motion before it, and its association."""

    number: int
    motions: tuple[Motion, ...]
    readings: Array
    """Rows (β, r), shape (m, 2)."""
    row_ids: tuple[int | None, ...]
    """Landmark of each row, None where the filter does not use it."""
    labels: tuple[int, ...]
    """Label of the tentative landmark of each row, or `NO_LABEL`."""
    before: Mapping[str, Any] | None = None
    """State of the filter before the scan, where a tentative landmark begins in it."""
    removed: tuple[int, ...] = ()
    """Landmarks removed after it."""
    merged: tuple[tuple[int, int], ...] = ()
    """Landmarks merged after it: (kept, gone)."""

    @property
    def begins(self) -> bool:
        """Whether a tentative landmark is seen here for the first time."""
        return any(
            label != NO_LABEL and label >> LABEL_BITS == self.number
            for label in self.labels
        )

    def feed(self, slam: SlamEstimator) -> UpdateReport:
        """Update a filter with the rows that it uses."""
        rows = [row for row, i in enumerate(self.row_ids) if i is not None]
        ids = [i for i in self.row_ids if i is not None]
        return slam.update(self.readings[rows], ids)

    def without(self, landmark_id: int) -> RecentScan:
        """Return the scan with the reading of a landmark, if any, left out."""
        if landmark_id not in self.row_ids:
            return self
        row = self.row_ids.index(landmark_id)
        row_ids, labels = list(self.row_ids), list(self.labels)
        row_ids[row], labels[row] = None, NO_LABEL
        return replace(self, row_ids=tuple(row_ids), labels=tuple(labels))

    def edit(self, editor: CachedEditor) -> None:
        """Remove and merge landmarks as after the scan."""
        if self.removed:
            editor.remove(self.removed)
        for pairs in _groups(self.merged):
            editor.merge_pairs(pairs)

    def state_dict(self) -> dict[str, Any]:
        """Return all as arrays."""
        row_ids = [NO_LANDMARK if i is None else i for i in self.row_ids]
        return {
            "number": np.array(self.number),
            "motions": motion_array(self.motions),
            "readings": self.readings.copy(),
            "row_ids": np.array(row_ids, dtype=np.int64),
            "labels": np.array(self.labels, dtype=np.int64),
            "removed": np.array(self.removed, dtype=np.int64),
            "merged": np.array(self.merged, dtype=np.int64).reshape(-1, 2),
            **with_prefix("before", self.before or {}),
        }

    @classmethod
    def from_state_dict(cls, state: Mapping[str, Any]) -> RecentScan:
        """Restore what :meth:`state_dict` returned."""
        saved_states.refuse_other_state(state, ENTRIES)
        readings = saved_states.array("readings", state["readings"], (-1, 2))
        row_ids, labels = (
            saved_states.whole_numbers(key, state[key], (len(readings),)).tolist()
            for key in ("row_ids", "labels")
        )
        merged = saved_states.whole_numbers("merged", state["merged"], (-1, 2))
        return cls(
            saved_states.whole_number("number", state["number"]),
            motions_of(state["motions"]),
            readings,
            tuple(None if i == NO_LANDMARK else i for i in row_ids),
            tuple(labels),
            without_prefix(state, "before") or None,
            tuple(saved_states.whole_numbers("removed", state["removed"]).tolist()),
            tuple((i, j) for i, j in merged.tolist()),
        )


def _groups(pairs: Sequence[tuple[int, int]]) -> list[list[tuple[int, int]]]:
    """Split pairs into groups in which each landmark occurs once.

    Examples
    --------
    >>> _groups([(0, 4), (1, 5), (0, 6)])
    [[(0, 4), (1, 5)], [(0, 6)]]
    """
    groups: list[list[tuple[int, int]]] = []
    used: set[int] = set()
    for pair in pairs:
        if not groups or not used.isdisjoint(pair):
            groups.append([])
            used = set()
        groups[-1].append(pair)
        used.update(pair)
    return groups


def motion_array(motions: Sequence[Motion]) -> Array:
    """Return motions as rows (d, α, dt), shape (k, 3)."""
    return np.array(motions, dtype=np.float64).reshape(-1, 3)


def motions_of(array: Any) -> tuple[Motion, ...]:
    """Return the motions of such rows, or refuse them."""
    rows = saved_states.array("motions", array, (-1, 3)).tolist()
    return tuple((distance, turn, dt) for distance, turn, dt in rows)
