"""Associate each row of a scan with a landmark, a candidate for one, or neither.

An association changes no belief.  It takes effect after the filter has accepted the
scan.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from ...arrays import Array, IntArray
from ..interface import MapView
from .association_memory import Candidates, Sensor
from .association_policy import AssociationPolicy
from .missed_detections import Detections
from .nearest_neighbour import AMBIGUOUS, NEW, Noise
from .scan_assignments import assign_nearest, assign_scan

NO_LABEL = -1

LABEL_BITS = 20
"""A label is the scan of the first sighting, shifted by these bits, plus its row."""


class ScanAssociation:
    """Association of the rows of one scan.

    Parameters
    ----------
    policy : AssociationPolicy
    candidates : Candidates
        Before the scan.
    rows : int
        Number of readings in the scan.
    """

    def __init__(
        self, policy: AssociationPolicy, candidates: Candidates, rows: int
    ) -> None:
        self._policy = policy
        self._tentative = candidates.tentative.next_scan(policy.confirm[1])
        self._waiting = dict(candidates.waiting)
        self._next_id, self.scan = candidates.next_id, candidates.scan
        self._density, self._longest = candidates.density, 0.0
        self._detections = candidates.detections
        self.row_ids: list[int | None] = [None] * rows
        """For each row the landmark that the filter associates it with, if any."""
        self.confirmed: dict[int, int] = {}
        """Labels of landmarks that were tentative before this scan."""
        self.labels: list[int] = [NO_LABEL] * rows
        """For each row the label of its tentative landmark, if any."""
        self.tentative_rows: list[int] = []
        self.ambiguous_rows: list[int] = []
        self.explained: set[int] = set()
        """Landmarks that some row may belong to, so that they are not missing."""

    @property
    def candidates(self) -> Candidates:
        """The candidates after the scan."""
        unexplained = self.row_ids.count(None)
        density = self._density.after(unexplained, self._longest, len(self.confirmed))
        return Candidates(
            self._tentative,
            self._waiting,
            self._next_id,
            self.scan + 1,
            density,
            self._detections,
        )

    def assign(
        self,
        rows: IntArray,
        slots: IntArray,
        readings: Array,
        view: MapView,
        noise: Noise,
    ) -> None:
        """Take the slots of the map that some rows are assigned to.

        Rows that no landmark explains may belong to a tentative one; the other rows of
        the scan have no usable bearing and are ambiguous.
        """
        self._longest = float(readings[:, 1].max(initial=0.0))
        for row, slot in zip(rows.tolist(), slots.tolist(), strict=True):
            if slot >= 0:
                self.row_ids[row] = view.ids[slot]
        self.ambiguous_rows += sorted(set(range(len(readings))) - set(rows.tolist()))
        self.ambiguous_rows += rows[slots == AMBIGUOUS].tolist()
        new = rows[slots == NEW]
        if len(new):
            self._match_tentative(new, readings, noise)
        self.ambiguous_rows.sort()
        self.tentative_rows.sort()

    def translate(
        self, ids: Sequence[int], mapped: Sequence[int], aliases: Mapping[int, int]
    ) -> None:
        """Associate by given identities, except those merged or not yet trusted."""
        known = set(mapped)
        for row, given in enumerate(ids):
            landmark_id = aliases.get(given, given)
            if landmark_id in self.explained:  # two names of one landmark in one scan
                self.ambiguous_rows.append(row)
                continue
            self.explained.add(landmark_id)
            self._next_id = max(self._next_id, landmark_id + 1)
            if landmark_id in known or self._policy.trust_ids:
                self.row_ids[row] = landmark_id
            elif self._has_waited(landmark_id):
                self._confirm(row, landmark_id, NO_LABEL)
            else:
                self.tentative_rows.append(row)

    def _match_tentative(self, rows: IntArray, readings: Array, noise: Noise) -> None:
        """Match rows that no landmark explains with tentative ones; confirm these."""
        tentative = self._tentative
        fit = tentative.distances(readings[rows], noise, self._policy.new_gate)
        slots = assign_nearest(self._policy, fit)
        self.ambiguous_rows += rows[slots == AMBIGUOUS].tolist()
        pairs = list(zip(rows.tolist(), slots.tolist(), strict=True))
        for row, slot in pairs:
            if slot >= 0:
                self.labels[row] = int(tentative.labels[slot])
                tentative = tentative.with_sighting(slot, readings[row], noise)
        needed = self._policy.confirm[0]
        enough = tentative.sightings >= needed
        confirmed = set(np.flatnonzero(enough).tolist())
        if needed == 1:
            confirmed.add(NEW)
        for row, slot in pairs:
            if slot in confirmed:
                self._confirm(row, self._next_id, self.labels[row])
            elif slot != AMBIGUOUS:
                self.tentative_rows.append(row)
        fresh = rows[(slots == NEW) & (needed > 1)]
        labels = (self.scan << LABEL_BITS) + fresh
        for row, label in zip(fresh.tolist(), labels.tolist(), strict=True):
            self.labels[row] = label
        self._tentative = tentative.chosen(~enough).with_new(
            readings[fresh], noise, labels
        )

    def _has_waited(self, landmark_id: int) -> bool:
        """Count a sighting of an identity; return whether it has been seen enough."""
        needed, scans = self._policy.confirm
        earlier = self._waiting.pop(landmark_id, ())
        recent = [*(scan for scan in earlier if scan > self.scan - scans), self.scan]
        if len(recent) < needed:
            self._waiting[landmark_id] = recent
        return len(recent) >= needed

    def _confirm(self, row: int, landmark_id: int, label: int) -> None:
        self.row_ids[row] = landmark_id
        self.confirmed[landmark_id] = label
        self._next_id = max(self._next_id, landmark_id + 1)


Option = tuple[float, Callable[[], ScanAssociation]]
"""−2 ln of the likelihood of an association, up to a constant, and its completion."""


def associate(
    policy: AssociationPolicy,
    candidates: Candidates,
    readings: Array,
    view: MapView,
    sensor: Sensor,
    ceiling: float = np.inf,
) -> list[Option]:
    """Associate readings (m, 2) that have no identity, in every way to consider.

    Readings closer than the sensor's least range have no usable bearing: they are
    ambiguous.  Above a cost of ``ceiling``, only the most likely association is of
    interest.

    Returns
    -------
    list of Option
        The most likely first.
    """
    rows = np.flatnonzero(readings[:, 1] >= sensor.min_range)
    density = _unexplained_density(policy, candidates, readings[rows], sensor.noise)
    found = assign_scan(
        policy, view, readings[rows], sensor.noise, density, ceiling=ceiling
    )
    explained = {view.ids[slot] for slot in found.explained.tolist()}

    def complete(slots: IntArray, detections: Detections) -> ScanAssociation:
        before = replace(candidates, detections=detections)
        association = ScanAssociation(policy, before, len(readings))
        association.explained = set(explained)
        association.assign(rows, slots, readings, view, sensor.noise)
        return association

    options = []
    for cost, slots in found.ranked:
        missed, detections = 0.0, candidates.detections
        if policy.association == "hypotheses":
            longest = candidates.density.longest
            missed, detections = detections.after(view, slots, longest)
        options.append((cost + missed, partial(complete, slots, detections)))
    return sorted(options, key=lambda option: option[0])


def _unexplained_density(
    policy: AssociationPolicy, candidates: Candidates, readings: Array, noise: Noise
) -> Array:
    """Return the density of readings from no landmark of the map, at each reading.

    A tentative landmark of one sighting is a landmark with the probability that the
    scans so far suggest; one of more sightings surely is.
    """
    density = np.full(len(readings), policy.density or candidates.density.value)
    if policy.association in ("nearest", "compatibility"):  # they use none
        return density
    tentative = candidates.tentative.next_scan(policy.confirm[1])
    if not len(tentative.seen):
        return density
    fit = tentative.distances(readings, noise, policy.new_gate)
    share = np.where(tentative.sightings > 1, 1.0, candidates.density.landmark_share)
    again = share * np.exp(-fit.unlikelihood / 2) / (2 * np.pi)
    return np.asarray(density + again.max(axis=1))
