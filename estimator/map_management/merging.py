"""Decide which mapped landmarks are one, and merge them."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from ...arrays import Array, IntArray
from ..filters.gaussian_map import separation
from ..interface import MapView
from ..support import saved_states
from .landmark_records import LandmarkRecords
from .map_editor import MapEditor
from .policy import LandmarkPolicy


class LandmarkMerger:
    """Merges the landmarks of one filter that a policy considers to be the same.

    Two landmarks are merged if their estimates are close, the offset is accurate enough
    to tell two landmarks apart, it passes the gate, and no scan has shown both.

    Parameters
    ----------
    policy : LandmarkPolicy
    editor : MapEditor
        Edits the filter's map.
    records : LandmarkRecords
        Records of the mapped landmarks, which are joined with the landmarks.
    """

    def __init__(
        self, policy: LandmarkPolicy, editor: MapEditor, records: LandmarkRecords
    ) -> None:
        self._policy, self._editor, self._records = policy, editor, records
        self._apart: set[tuple[int, int]] = set()
        self.aliases: dict[int, int] = {}
        """Landmarks merged into others: gone to kept."""

    def note_scan(self, view: MapView, ids: Sequence[int]) -> None:
        """Record that landmarks seen in one scan are different ones."""
        if self._policy.merge_within is None:
            return
        places = view.landmarks[self._places(view, ids)]
        close = _distances(places, places) < 2 * self._policy.merge_within
        for i, j in np.argwhere(np.triu(close, 1)).tolist():
            self._apart.add(_ordered(ids[i], ids[j]))

    def merge(self, seen: set[int]) -> list[tuple[int, int]]:
        """Merge landmarks just seen with their duplicates; return (kept, gone)."""
        merged: list[tuple[int, int]] = []
        while (pair := self._duplicate(seen)) is not None:
            kept, gone = pair
            try:
                self.join([pair])
            except np.linalg.LinAlgError:  # nothing was merged; later scans try again
                break
            seen = (seen - {gone}) | {kept}
            merged.append(pair)
        return merged

    def join(self, pairs: Sequence[tuple[int, int]]) -> None:
        """Merge pairs of landmarks; both identities then name the first."""
        self._records.follow(self._editor.map_view().mapped)
        self._editor.merge_pairs(pairs)
        for kept, gone in pairs:
            self._records.join(kept, gone)
            earlier = {i: kept for i, j in self.aliases.items() if j == gone}
            self.aliases |= {gone: kept, **earlier}
            self._apart = {_renamed(pair, gone, kept) for pair in self._apart}
        self._records.follow(self._editor.map_view().mapped)

    def forget(self, ids: Iterable[int]) -> None:
        """Drop what is known about landmarks that have been removed."""
        gone = set(ids)
        self._apart = {pair for pair in self._apart if gone.isdisjoint(pair)}

    def state_dict(self) -> dict[str, Any]:
        """Return the landmarks known to differ and the aliases, as arrays."""
        return {
            "apart": _pairs(sorted(self._apart)),
            "aliases": _pairs(list(self.aliases.items())),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore what :meth:`state_dict` returned."""
        apart, aliases = (
            saved_states.whole_numbers(f"landmarks.{key}", state[key], (-1, 2)).tolist()
            for key in ("apart", "aliases")
        )
        self._apart, self.aliases = {(i, j) for i, j in apart}, dict(aliases)

    def _duplicate(self, seen: set[int]) -> tuple[int, int] | None:
        """Find two landmarks that are one; keep the first of them in the map."""
        view, within = self._editor.map_view(), self._policy.merge_within
        if within is None:
            return None
        slots = self._places(view, [i for i in view.ids if i in seen])
        near = _distances(view.landmarks[slots], view.landmarks) < within
        for row, other in np.argwhere(near).tolist():
            kept, gone = sorted((int(slots[row]), other))
            if kept != gone and self._is_one(view, kept, gone):
                return view.ids[kept], view.ids[gone]
        return None

    def _places(self, view: MapView, ids: Sequence[int]) -> IntArray:
        """Return the places of landmarks in the order of a view."""
        if view.whole is None:
            return self._records.slots(ids)
        places = {i: place for place, i in enumerate(view.ids)}
        return np.array([places[i] for i in ids], dtype=np.int64)

    def _is_one(self, view: MapView, kept: int, gone: int) -> bool:
        if _ordered(view.ids[kept], view.ids[gone]) in self._apart:
            return False
        between = separation(view.mean, view.covariance, kept, gone)
        return (
            between.largest_std <= self._policy.worst_separation_std
            and between.squared <= self._policy.merge_gate
        )


def _distances(some: Array, others: Array) -> Array:
    """Distances (k, n) between points (k, 2) and (n, 2)."""
    dx, dy = (some[:, None] - others).transpose(2, 0, 1)
    return np.asarray(np.hypot(dx, dy))


def _ordered(i: int, j: int) -> tuple[int, int]:
    return (i, j) if i < j else (j, i)


def _renamed(pair: tuple[int, int], old: int, new: int) -> tuple[int, int]:
    i, j = (new if landmark_id == old else landmark_id for landmark_id in pair)
    return _ordered(i, j)


def _pairs(pairs: Sequence[tuple[int, int]]) -> IntArray:
    return np.array(pairs, dtype=np.int64).reshape(-1, 2)
