"""Prune a filter's map after each scan: remove landmarks, merge duplicates."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from ...arrays import Array, IntArray
from ...jit import jit_in_place, njit_internal
from ...restorable import Restorable
from ..association.scan_assignments import Noise
from ..association.scan_association import ScanAssociation
from ..guards import saved_states
from ..interface import MapView
from ..models.relative_geometry import largest_std, separation, squared_offsets
from .loop_closing import Pairs, lost, same_landmarks, slots_of, without_lost
from .map_editor import MapEditor
from .policy import LandmarkPolicy


class MapPruner:
    """Removes and merges the landmarks of one filter by a policy.

    Two landmarks are merged if their estimates are close, the offset is accurate enough
    to tell two landmarks apart, it passes the gate, and no scan has shown both.

    Parameters
    ----------
    policy : LandmarkPolicy
    editor : MapEditor
        Edits the filter's map.
    noise : Noise
        Noise of the sensor.

    Attributes
    ----------
    records : LandmarkRecords
        What this run has shown of the landmarks.
    """

    def __init__(self, policy: LandmarkPolicy, editor: MapEditor, noise: Noise) -> None:
        self._policy, self._editor = policy, editor
        self._noise = noise_of_sightings(noise)
        self.records = LandmarkRecords()

    def view_around(self, readings: Array) -> MapView:
        """Return a view of the landmarks that may matter for a scan (m, 2)."""
        is_local = self._editor.is_local
        return self._editor.map_view(self._policy.reach(readings) if is_local else 0.0)

    def view_for(self, readings: Array) -> MapView:
        """Return a view of the landmarks that readings (m, 2) may belong to."""
        view, rules = self.view_around(readings), self._policy.constellations
        return without_lost(view, rules, self._policy.reach(readings))

    def expected(self, scan: Array) -> set[int]:
        """Return the landmarks that a scan (m, 2) should show; changes nothing."""
        view, policy = self.view_around(scan), self._policy
        if policy.remove_after is None or policy.view is None or not view.ids:
            return set()
        mask = policy.view.expects(view.mean[:3].copy(), view.landmarks, scan)
        mask &= ~lost(view, policy.constellations)
        return {view.ids[slot] for slot in np.flatnonzero(mask).tolist()}

    def prune(self, plan: ScanAssociation) -> tuple[list[int], Pairs]:
        """Remove and merge landmarks after a scan that the filter has taken.

        Return the removed landmarks, and the merged ones as pairs (kept, gone).
        """
        self._note_sightings(plan)
        removed = self._remove_missing(plan.missed)
        merged = self._merge_duplicates(plan.seen)
        merged += self._close_loops(plan.confirmed, plan.readings)
        return removed + self._keep_capacity(plan.seen), merged

    def remove(self, ids: list[int]) -> list[int]:
        """Remove landmarks from the map and from the records; return them."""
        if ids:
            self._editor.remove(ids)
            self.records.follow(self._editor.map_view().mapped)
        return ids

    def join(self, pairs: Pairs) -> None:
        """Merge pairs of landmarks; both identities then name the first."""
        self.records.follow(self._editor.map_view().mapped)
        self._editor.merge_pairs(pairs)
        for kept, gone in pairs:
            self.records.join(kept, gone)
        self.records.follow(self._editor.map_view().mapped)

    def _joined(self, pairs: Pairs) -> bool:
        """Merge pairs, or return False: nothing was merged, later scans try again."""
        try:
            self.join(pairs)
        except np.linalg.LinAlgError:
            return False
        return True

    def _note_sightings(self, plan: ScanAssociation) -> None:
        """Record the landmarks that a scan has shown, and that they differ."""
        view, seen = self._editor.map_view(), plan.seen
        within = self._policy.merge_within
        self.records.follow(view.mapped)
        if not seen:
            return
        shown_by = {row: i for row, i in enumerate(plan.row_ids) if i in seen}
        slots = self.records.slots(shown_by.values())
        sighting = plan.readings[[*shown_by]], view.mean[2], self._noise
        add_sightings(self.records.renewed(), slots, *sighting)
        if within is not None:
            shown = view.landmarks[slots := slots_of(view, seen)]
            close = _distances(shown, shown) < 2 * within
            pairs = slots[np.argwhere(np.triu(close, 1))].tolist()
            apart = {_ordered(view.ids[i], view.ids[j]) for i, j in pairs}
            self.records.apart = self.records.apart | apart

    def _remove_missing(self, missed: set[int]) -> list[int]:
        """Count a miss for each landmark of ``missed``; remove those missed too often.

        ``missed`` are the landmarks that this scan should have shown and did not.
        """
        most, records = self._policy.remove_after, self.records
        if most is None:
            return []
        misses, _ = records.renewed()
        misses[records.slots(missed)] += 1
        overdue = np.flatnonzero(records.misses >= most)
        return self.remove([records.ids[k] for k in overdue.tolist()])

    def _merge_duplicates(self, seen: set[int]) -> Pairs:
        """Merge landmarks just seen with their duplicates; return (kept, gone)."""
        merged: Pairs = []
        while (pair := self._duplicate(seen)) is not None and self._joined([pair]):
            kept, gone = pair
            seen = (seen - {gone}) | {kept}
            merged.append(pair)
        return merged

    def _duplicate(self, seen: set[int]) -> tuple[int, int] | None:
        """Find two landmarks that are one; keep the first of them in the map."""
        within = self._policy.merge_within
        if within is None:
            return None
        view = self._editor.map_view()
        slots = slots_of(view, seen)
        near = _distances(view.landmarks[slots], view.landmarks) < within
        for row, other in np.argwhere(near).tolist():
            kept, gone = sorted((int(slots[row]), other))
            if kept != gone and self._is_one(view, kept, gone):
                return view.ids[kept], view.ids[gone]
        return None

    def _is_one(self, view: MapView, kept: int, gone: int) -> bool:
        if _ordered(view.ids[kept], view.ids[gone]) in self.records.apart:
            return False
        columns, policy = (3 + 2 * kept, 3 + 2 * gone), self._policy
        d, D = separation(view.mean, view.covariance, *columns)
        is_accurate = largest_std(D) <= policy.worst_separation_std
        return bool(is_accurate and squared_offsets(d, D) <= policy.merge_gate)

    def _close_loops(self, added: Collection[int], readings: Array) -> Pairs:
        """Merge landmarks around the robot with an older part of the map.

        Parameters
        ----------
        added : collection of int
            Landmarks, seen without identity, that the last scan has added.
        readings : ndarray, shape (m, 2)
            This scan.
        """
        rules, records = self._policy.constellations, self.records
        if rules is None or not (added or records.doubtful):
            return []
        within, view = self._policy.reach(readings), self.view_around(readings)
        found = same_landmarks(view, rules, added, records.doubtful, within)
        records.doubtful, pairs = found
        return pairs if pairs and self._joined(pairs) else []

    def _keep_capacity(self, seen: set[int]) -> list[int]:
        """Remove the landmarks of least information, first among those not seen."""
        capacity, mapped = self._policy.capacity, self._editor.map_view().mapped
        if capacity is None or len(mapped) <= capacity:
            return []
        ranked = self.records.by_information(mapped)
        ranked.sort(key=seen.__contains__)
        return self.remove(ranked[: len(mapped) - capacity])


def _distances(some: Array, others: Array) -> Array:
    """Distances (k, n) between points (k, 2) and (n, 2)."""
    dx, dy = (some[:, None] - others).transpose(2, 0, 1)
    return np.asarray(np.hypot(dx, dy))


def _ordered(i: int, j: int) -> tuple[int, int]:
    return (i, j) if i < j else (j, i)


class LandmarkRecords(Restorable):
    """What a run has shown of the landmarks of its map.

    Misses and information are in the order of the map.

    The information of a landmark is its block of the information matrix, summed over
    all its readings with the pose of the robot taken as known::

        Λ = Σ H_lᵀ Q⁻¹ H_l,   H_l = [a / r; e]
        content = ½ ln det Λ

    with the unit vectors e towards the landmark and a across.  This information is lost
    when the landmark is marginalised and never seen again.

    Examples
    --------
    >>> records = LandmarkRecords()
    >>> records.follow([7, 9])
    >>> records.information[:] = [(9.0, 0.0, 1.0), (5.0, 1.0, 3.0)]  # Λxx, Λxy, Λyy
    >>> records.by_information([9, 7])
    [7, 9]
    """

    replaced = (
        *("ids", "_slots", "misses", "information"),
        *("apart", "aliases", "doubtful"),
    )

    def __init__(self) -> None:
        self.ids: tuple[int, ...] = ()
        self.misses: IntArray = np.zeros(0, dtype=np.int64)
        self.information: Array = np.zeros((0, 3))
        self._slots: dict[int, int] = {}
        #: Landmarks known to differ.
        self.apart: set[tuple[int, int]] = set()
        #: Landmarks merged into others: gone to kept.
        self.aliases: dict[int, int] = {}
        #: Landmarks that may be older, lost ones.
        self.doubtful: set[int] = set()

    def follow(self, ids: Sequence[int]) -> None:
        """Adopt the order of the map: keep records of its landmarks, start new ones."""
        if self.ids == tuple(ids):
            return
        rows = np.array([self._slots.get(i, -1) for i in ids], dtype=np.int64)
        fresh = rows < 0
        for name in ("misses", "information"):
            before = getattr(self, name)
            after = np.zeros((len(rows), *before.shape[1:]), dtype=before.dtype)
            after[~fresh] = before[rows[~fresh]]
            setattr(self, name, after)
        self._slots = {i: k for k, i in enumerate(ids)}
        self.apart = {pair for pair in self.apart if self._slots.keys() >= {*pair}}
        self.ids = tuple(ids)  # last: an interrupted call begins anew

    def renewed(self) -> tuple[IntArray, Array]:
        """Replace misses and information by copies; return the copies.

        The caller may change these in place, since no saved state shares them.
        """
        self.misses, self.information = self.misses.copy(), self.information.copy()
        return self.misses, self.information

    def slots(self, ids: Iterable[int]) -> IntArray:
        """Return the places of landmarks in the order of the map."""
        return np.array([self._slots[i] for i in ids], dtype=np.int64)

    def join(self, kept: int, gone: int) -> None:
        """Add the records of one landmark to those of another."""
        i, j = self._slots[kept], self._slots[gone]
        misses, information = self.renewed()
        information[i] += information[j]
        misses[i] = min(misses[i], misses[j])
        earlier = {i: kept for i, j in self.aliases.items() if j == gone}
        self.aliases = {**self.aliases, gone: kept, **earlier}
        names = {gone: kept}
        self.apart = {_ordered(*(names.get(i, i) for i in pair)) for pair in self.apart}

    def by_information(self, ids: Sequence[int]) -> list[int]:
        """Sort landmarks by information, the least first, of equals the newest."""
        newest_first = ids[::-1]
        xx, xy, yy = self.information[self.slots(newest_first)].T
        order = np.argsort(xx * yy - xy * xy, kind="stable")
        return [newest_first[k] for k in order.tolist()]

    def state_dict(self) -> dict[str, Any]:
        """Return copies of all, as arrays."""
        return saved_states.write(vars(self), RECORDS)

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore what :meth:`state_dict` returned; refuse what does not fit."""
        saved = saved_states.read(state, RECORDS, "landmarks.")
        self.follow(saved["ids"])
        apart, aliases = (saved[name].tolist() for name in ("apart", "aliases"))
        sets = {"apart": {(i, j) for i, j in apart}, "doubtful": {*saved["doubtful"]}}
        vars(self).update(saved | sets, ids=self.ids, aliases=dict(aliases))


#: What a saved state holds about the landmarks of a map.
RECORDS: saved_states.Table = {
    "ids": (saved_states.IDS, "n"),
    "misses": (saved_states.COUNTS, "n"),
    "information": (saved_states.NUMBERS, "n", 3),
    "apart": (saved_states.WHOLE, -1, 2),
    "aliases": (saved_states.WHOLE, -1, 2),
    "doubtful": (saved_states.IDS, -1),
}


def noise_of_sightings(noise: Noise) -> tuple[float, float, float, float]:
    """Return the noise that determines the information of a landmark, above 0."""
    bearing, distance, per_metre = np.maximum(noise[:3], 1e-12).tolist()
    return bearing, distance, per_metre, noise.bearing_std_metres


@jit_in_place
def add_sightings(
    counts: tuple[IntArray, Array],
    slots: IntArray,
    readings: Array,
    heading: float,
    noise: tuple[float, float, float, float],
) -> None:
    """Note the readings (m, 2) of the landmarks in these slots (m,)."""
    for k in range(len(slots)):
        add_sighting(counts, slots[k], readings[k], heading, noise)


@njit_internal
def add_sighting(
    counts: tuple[IntArray, Array],
    slot: int,
    reading: Array,
    heading: float,
    noise: tuple[float, float, float, float],
) -> None:
    """Forgive the misses of a landmark seen; Λ ← Λ + H_lᵀ Q⁻¹ H_l.

    ``counts`` are those of all landmarks: their misses, and Λ as xx, xy, yy.
    """
    misses, information = counts
    bearing_std, range_std, per_metre, metres = noise
    misses[slot] = 0
    bearing, distance = reading[0] + heading, reading[1]
    along = (range_std + per_metre * distance) ** -2
    across = (max(distance, 1e-12) * bearing_std + metres) ** -2
    cos, sin = np.cos(bearing), np.sin(bearing)
    row = information[slot]
    row[0] += along * cos * cos + across * sin * sin
    row[1] += (along - across) * cos * sin
    row[2] += along * sin * sin + across * cos * cos
