"""Keep a filter's map in order: who is missing, who is double, who is one too many."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ...arrays import Array, IntArray
from ..association.nearest_neighbour import Noise
from ..filters.marginalise_and_merge import separation
from ..interface import MapView
from .landmark_records import LandmarkRecords
from .map_editor import MapEditor
from .policy import LandmarkPolicy


class MapPruner:
    """Removes and merges the landmarks of one filter, as a policy has it.

    Parameters
    ----------
    policy : LandmarkPolicy
    editor : MapEditor
        Of the filter's map.
    noise : Noise
        Of the sensor.
    """

    def __init__(self, policy: LandmarkPolicy, editor: MapEditor, noise: Noise) -> None:
        self._policy, self._editor = policy, editor
        self._noise = np.maximum(noise, 1e-12)
        self.forget()

    def forget(self) -> None:
        """Start a new run."""
        self._records = LandmarkRecords()
        self._apart: set[tuple[int, int]] = set()
        self.aliases: dict[int, int] = {}
        """Of landmarks merged into others: (gone, kept)."""

    def note_sightings(self, readings: Array, ids: Sequence[int]) -> None:
        """Remember which landmarks the scan (m, 2) has shown, and who side by side."""
        view = self._editor.map_view()
        self._records.follow(view.mapped)
        if not ids:
            return
        bearing, distance = readings.T
        bearing_std, range_std, per_metre = self._noise
        along = (range_std + per_metre * distance) ** -2.0
        across = (np.maximum(distance, 1e-12) * bearing_std) ** -2.0
        directions = bearing + view.mean[2]
        self._records.note_sightings(ids, directions, along, across)
        if self._policy.merge_within is not None:
            places = view.landmarks[self._places(view, ids)]
            close = _gaps(places, places) < 2 * self._policy.merge_within
            for i, j in np.argwhere(np.triu(close, 1)).tolist():
                self._apart.add(_ordered(ids[i], ids[j]))

    def expected(self, scan: Array) -> set[int]:
        """Return the landmarks that a scan (m, 2) should show; changes nothing."""
        view, policy = self._editor.map_view(), self._policy
        if policy.remove_after is None or policy.view is None or not view.ids:
            return set()
        mask = policy.view.expects(view.mean[:3].copy(), view.landmarks, scan)
        return {view.ids[slot] for slot in np.flatnonzero(mask).tolist()}

    def prune(
        self,
        readings: Array,
        row_ids: Sequence[int | None],
        seen: set[int],
        missed: set[int],
    ) -> tuple[list[int], list[tuple[int, int]]]:
        """Remove and merge as the policy states; return the ids removed and merged.

        Parameters
        ----------
        readings : ndarray, shape (m, 2)
            The scan.
        row_ids : sequence of int or None, length m
            Landmark of each row.
        seen, missed : set of int
            Landmarks that the scan has shown, and those that it should have shown.
        """
        rows = [row for row, i in enumerate(row_ids) if i in seen]
        ids = [i for i in row_ids if i is not None and i in seen]
        self.note_sightings(readings[rows], ids)
        removed = self.remove_missing(missed)
        merged = self.merge(seen)
        return removed + self.keep_capacity(seen), merged

    def remove_missing(self, missed: set[int]) -> list[int]:
        """Remove landmarks that scans should have shown so many times and did not.

        ``missed`` are those that this scan should have shown.
        """
        if self._policy.remove_after is None:
            return []
        self._records.note_misses(self._records.slots(missed))
        return self.remove(self._records.overdue(self._policy.remove_after))

    def merge(self, seen: set[int]) -> list[tuple[int, int]]:
        """Make one of landmarks just seen and others that are the same; kept, gone."""
        merged: list[tuple[int, int]] = []
        while (pair := self._double(seen)) is not None:
            kept, gone = pair
            self.join(kept, gone)
            seen = (seen - {gone}) | {kept}
            merged.append(pair)
        return merged

    def join(self, kept: int, gone: int) -> None:
        """Make one landmark of two, which answers to both identities."""
        self._records.follow(self._editor.map_view().mapped)
        self._editor.merge(kept, gone)
        self._records.join(kept, gone)
        self._records.follow(self._editor.map_view().mapped)
        earlier = {i: kept for i, j in self.aliases.items() if j == gone}
        self.aliases |= {gone: kept, **earlier}
        self._apart = {_renamed(pair, gone, kept) for pair in self._apart}

    def keep_capacity(self, seen: set[int]) -> list[int]:
        """Give up the landmarks of least information, of those not seen if possible."""
        capacity, ids = self._policy.capacity, list(self._editor.map_view().mapped)
        if capacity is None or len(ids) <= capacity:
            return []
        ranked = self._records.by_information(ids)
        ranked.sort(key=seen.__contains__)
        return self.remove(ranked[: len(ids) - capacity])

    def state_dict(self) -> dict[str, Any]:
        """Return copies of all that is remembered, as arrays."""
        return {
            **self._records.state_dict(),
            "apart": _pairs(sorted(self._apart)),
            "aliases": _pairs(list(self.aliases.items())),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Take back what :meth:`state_dict` returned."""
        self._records.load_state_dict(state)
        self._apart = {(i, j) for i, j in np.asarray(state["apart"]).tolist()}
        self.aliases = dict(np.asarray(state["aliases"]).tolist())

    def remove(self, ids: list[int]) -> list[int]:
        """Remove landmarks from the map and from what is remembered; return them."""
        if ids:
            self._editor.remove(ids)
            self._records.follow(self._editor.map_view().mapped)
            gone = set(ids)
            self._apart = {both for both in self._apart if gone.isdisjoint(both)}
        return ids

    def _double(self, seen: set[int]) -> tuple[int, int] | None:
        """Find two landmarks that are one, the first of them in the map to be kept."""
        view, within = self._editor.map_view(), self._policy.merge_within
        if within is None:
            return None
        slots = self._places(view, [i for i in view.ids if i in seen])
        places = view.landmarks
        for row, other in np.argwhere(_gaps(places[slots], places) < within).tolist():
            kept, gone = sorted((int(slots[row]), other))
            if kept != gone and self._is_one(view, kept, gone):
                return view.ids[kept], view.ids[gone]
        return None

    def _places(self, view: MapView, ids: Sequence[int]) -> IntArray:
        """Return where landmarks stand in the order of a view."""
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


def _gaps(some: Array, others: Array) -> Array:
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
