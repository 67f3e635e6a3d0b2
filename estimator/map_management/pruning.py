"""Prune a filter's map after each scan: remove landmarks, merge duplicates."""

from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np

from ...arrays import Array
from ..association.nearest_neighbour import Noise
from ..association.scan_association import ScanAssociation
from ..interface import MapView
from ..support.undo import Undo, contents
from .landmark_records import LandmarkRecords
from .loop_closing import LoopCloser, Pairs
from .map_editor import MapEditor
from .merging import LandmarkMerger
from .policy import LandmarkPolicy


class MapPruner:
    """Removes and merges the landmarks of one filter by a policy.

    Parameters
    ----------
    policy : LandmarkPolicy
    editor : MapEditor
        Edits the filter's map.
    noise : Noise
        Noise of the sensor.

    Attributes
    ----------
    merger : LandmarkMerger
        Merges landmarks of this run.
    """

    def __init__(self, policy: LandmarkPolicy, editor: MapEditor, noise: Noise) -> None:
        self._policy, self._editor = policy, editor
        bearing_std, range_std, per_metre = np.maximum(noise[:3], 1e-12).tolist()
        metres = noise.bearing_std_metres
        self._noise = Noise(bearing_std, range_std, per_metre, metres)
        self.forget()

    def forget(self) -> None:
        """Start a new run."""
        self._records = LandmarkRecords()
        self.merger = LandmarkMerger(self._policy, self._editor, self._records)
        self._closer = LoopCloser(self._policy.constellations)

    def note_sightings(self, readings: Array, ids: Sequence[int]) -> None:
        """Record the landmarks that the rows of a scan (m, 2) have shown."""
        view = self._editor.map_view()
        self._records.follow(view.mapped)
        if not ids:
            return
        bearing, distance = readings.T
        bearing_std, range_std, per_metre, metres = self._noise
        along = (range_std + per_metre * distance) ** -2.0
        across = (np.maximum(distance, 1e-12) * bearing_std + metres) ** -2.0
        self._records.note_sightings(ids, bearing + view.mean[2], along, across)
        self.merger.note_scan(view, ids)

    def expected(self, scan: Array) -> set[int]:
        """Return the landmarks that a scan (m, 2) should show; changes nothing."""
        view, policy = self._editor.map_view(), self._policy
        if policy.remove_after is None or policy.view is None or not view.ids:
            return set()
        mask = policy.view.expects(view.mean[:3].copy(), view.landmarks, scan)
        mask &= ~self._closer.lost(view)
        return {view.ids[slot] for slot in np.flatnonzero(mask).tolist()}

    def prune(
        self,
        readings: Array,
        plan: ScanAssociation,
        seen: set[int],
        missed: set[int],
    ) -> tuple[list[int], list[tuple[int, int]]]:
        """Remove and merge landmarks; return the removed ids and pairs (kept, gone).

        Parameters
        ----------
        readings : ndarray, shape (m, 2)
            The scan.
        plan : ScanAssociation
            Landmarks of its rows, and those that it has confirmed.
        seen, missed : set of int
            Landmarks that the scan has shown, and those that it should have shown.
        """
        row_ids = plan.row_ids
        rows = [row for row, i in enumerate(row_ids) if i in seen]
        ids = [i for i in row_ids if i is not None and i in seen]
        self.note_sightings(readings[rows], ids)
        removed = self.remove_missing(missed)
        merged = self.merger.merge(seen)
        merged += self.close_loops(plan.confirmed, self._policy.reach(readings))
        return removed + self.keep_capacity(seen), merged

    def remove_missing(self, missed: set[int]) -> list[int]:
        """Count a miss for each landmark of ``missed``; remove those missed too often.

        ``missed`` are the landmarks that this scan should have shown and did not.
        """
        if self._policy.remove_after is None:
            return []
        self._records.note_misses(self._records.slots(missed))
        return self.remove(self._records.overdue(self._policy.remove_after))

    def close_loops(self, added: Collection[int], within: float) -> Pairs:
        """Merge landmarks around the robot with an older part of the map.

        Parameters
        ----------
        added : collection of int
            Landmarks, seen without identity, that the last scan has added.
        within : float
            Reach of the readings [m].
        """
        if not self._closer.is_waiting(added):
            return []
        pairs = self._closer.pairs(self._editor.map_view(within), added, within)
        try:
            if pairs:
                self.merger.join(pairs)
        except np.linalg.LinAlgError:  # nothing was merged; later scans try again
            return []
        return pairs

    def view_for(self, readings: Array) -> MapView:
        """Return a view of the landmarks that readings (m, 2) may belong to."""
        reach = self._policy.reach(readings)
        return self._closer.without_lost(self._editor.map_view(reach), reach)

    def keep_capacity(self, seen: set[int]) -> list[int]:
        """Remove the landmarks of least information, first among those not seen."""
        capacity, ids = self._policy.capacity, list(self._editor.map_view().mapped)
        if capacity is None or len(ids) <= capacity:
            return []
        ranked = self._records.by_information(ids)
        ranked.sort(key=seen.__contains__)
        return self.remove(ranked[: len(ids) - capacity])

    def remove(self, ids: list[int]) -> list[int]:
        """Remove landmarks from the map and from the records; return them."""
        if ids:
            self._editor.remove(ids)
            self._records.follow(self._editor.map_view().mapped)
            self.merger.forget(ids)
        return ids

    def checkpoint(self) -> Undo:
        """Return what takes back later changes of what is remembered."""
        return contents(self, self._records, self.merger, self._closer)

    def state_dict(self) -> dict[str, Any]:
        """Return copies of all records, as arrays."""
        return {
            **self._records.state_dict(),
            **self.merger.state_dict(),
            **self._closer.state_dict(),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore what :meth:`state_dict` returned; refuse what does not fit."""
        for part in (self._records, self.merger, self._closer):
            part.load_state_dict(state)
