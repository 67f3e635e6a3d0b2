"""Associate each row of a scan with a landmark, a candidate for one, or neither.

`associate` assigns readings to landmarks of the map, and the others to tentative
landmarks. An association changes no belief.  It takes effect after the filter has
accepted the scan.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from ...arrays import Array, IntArray
from ..guards import saved_states
from ..interface import MapView
from .missed_landmarks import Detections, LostEvidence
from .scan_assignments import (
    AMBIGUOUS,
    NEW,
    AssociationPolicy,
    AssociationSensor,
    Noise,
    assign_scan,
)
from .tentative_landmarks import (
    RINGS,
    SECTORS,
    TENTATIVE,
    TentativeLandmarks,
    UnexplainedDensity,
    add_tentative,
)

NO_LABEL = -1

#: A label is the scan of the first sighting, shifted by these bits, plus its row: a
#: scan has up to a million rows.
LABEL_BITS = 20


class ScanAssociation:
    """All decisions about the rows of one scan.

    Parameters
    ----------
    policy : AssociationPolicy
    candidates : Candidates
        Before the scan, except that `associate` has counted its detections.
    readings : ndarray, shape (m, 2)
        The scan, rows (β, r) [rad, m].
    """

    def __init__(
        self, policy: AssociationPolicy, candidates: Candidates, readings: Array
    ) -> None:
        self._policy, self.readings = policy, readings
        self._tentative = candidates.tentative
        self._waiting = dict(candidates.waiting)
        self._next_id, self.scan = candidates.next_id, candidates.scan
        self._density, self._detections = candidates.density, candidates.detections
        #: For each row the landmark that the filter associates it with, if any.
        self.row_ids: list[int | None] = [None] * len(readings)
        #: Labels of landmarks that were tentative before this scan.
        self.confirmed: dict[int, int] = {}
        #: For each row the label of its tentative landmark, if any.
        self.labels: list[int] = [NO_LABEL] * len(readings)
        self.tentative_rows: list[int] = []
        self.ambiguous_rows: list[int] = []
        #: Landmarks that some row may belong to, so that they are not missing.
        self.explained: set[int] = set()
        #: Landmarks that the scan should have shown and did not.
        self.missed: set[int] = set()
        #: Landmarks that it has shown, once the filter has taken it.
        self.seen: set[int] = set()
        self._is_assigned = False
        #: Cost of the landmarks that it confirms, once the filter has taken the scan.
        self.price = 0.0

    def candidates_after(self, view: MapView) -> Candidates:
        """Return the candidates after the scan, given the belief after it."""
        known = self.scan << LABEL_BITS  # lower labels are those of earlier scans
        new = [row for row, i in enumerate(self.row_ids) if i is None]
        new = [row for row in new if not 0 <= self.labels[row] < known]
        density = self._density.after(self.readings, new, len(self.confirmed))
        turn = view.covariance[2, 2]
        lost = self._detections.lost.with_heading(turn, len(view.mapped) > 0)
        if self._is_assigned:
            strange = sum([label >= known for label in self.labels])
            others = len(self.labels) - len(new)
            lost = lost.with_readings(strange, others, self._density)
        detections = Detections(*self._detections[:3], lost, self._detections.path)
        if self._is_assigned and self._policy.association == "hypotheses":
            # A landmark that one scan confirms has no label, and costs nothing.
            firsts = {i: label >> LABEL_BITS for i, label in self.confirmed.items()}
            self.price = detections.cost_of_new(view, firsts, self._density.longest)
            detections = detections.with_pose(self.scan, view, self._density.longest)
        tentative = self._tentative.after_scan(self._policy.confirm[1])
        changed = tentative, self._waiting, self._next_id, self.scan + 1
        return Candidates(*changed, density, detections)

    def assign(self, slots: IntArray, view: MapView, noise: Noise) -> None:
        """Take the slots of the map that the rows are assigned to.

        Rows that no landmark explains may belong to a tentative one.
        """
        self._is_assigned = True
        marks = slots.tolist()
        self.row_ids = [view.ids[slot] if slot >= 0 else None for slot in marks]
        self.ambiguous_rows = [k for k, slot in enumerate(marks) if slot == AMBIGUOUS]
        new = [row for row, slot in enumerate(marks) if slot == NEW]
        if new or len(self._tentative.seen):
            self._match_tentative(np.array(new, dtype=np.int64), noise)

    def translate(
        self, ids: Sequence[int], mapped: Sequence[int], aliases: Mapping[int, int]
    ) -> None:
        """Associate by given identities, except those merged or not yet trusted."""
        known = set(mapped)
        for row, given in enumerate(ids):
            landmark_id = aliases.get(given, given) if aliases else given
            if landmark_id in self.explained:  # two names of one landmark in one scan
                self.ambiguous_rows.append(row)
                continue
            self.explained.add(landmark_id)
            if landmark_id in known or self._policy.trust_ids:
                self.row_ids[row] = landmark_id
            elif self._has_waited(landmark_id):
                self._confirm(row, landmark_id, NO_LABEL)
            else:
                self.tentative_rows.append(row)
        self._next_id = max(self._next_id, 1 + max(self.explained, default=-1))

    def _match_tentative(self, rows: IntArray, noise: Noise) -> None:
        """Match rows that no landmark explains with tentative ones; confirm these.

        A row that is ambiguous because of a tentative landmark begins another one: the
        first sighting of that landmark may have been an outlier.
        """
        tentative, readings = self._tentative, self.readings
        density = self._density.at(readings[rows], self._policy.density)
        view = tentative.view()
        found = assign_scan(self._policy, view, readings[rows], noise, density, most=1)
        slots, needed = found.slots[0], self._policy.confirm[0]
        again, fresh = slots >= 0, (slots < 0) & (needed > 1)
        if again.any():
            sightings = slots[again], readings[rows[again]], noise, density[again]
            tentative = tentative.with_sightings(*sightings)
        chance = self._detections.chance_to_miss(view, self._density.longest)
        tentative = tentative.with_misses(chance)
        enough = tentative.proven(needed)
        # Rows of no tentative landmark take the last entry.
        entries = np.maximum(slots, -1)
        labels = np.append(tentative.labels, NO_LABEL)[entries]
        labels[fresh] = (self.scan << LABEL_BITS) + rows[fresh]
        enters = np.append(enough, needed == 1)[entries]
        outcomes = rows.tolist(), labels.tolist(), enters.tolist()
        for row, label, is_confirmed in zip(*outcomes, strict=True):
            self.labels[row] = label
            if is_confirmed:
                self._confirm(row, self._next_id, label)
            else:
                self.tentative_rows.append(row)
        self._tentative = tentative.chosen(~enough).with_new(
            readings[rows[fresh]], noise, labels[fresh], self._density.landmark_share
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


class Candidates(NamedTuple):
    """Landmarks that are not in the map yet, and the next identity to assign."""

    #: Landmarks without an identity.
    tentative: TentativeLandmarks = TentativeLandmarks()
    #: Given identities that are not trusted yet, and the scans that showed them.
    waiting: Mapping[int, Sequence[int]] = {}  # never changed in place
    #: Above all identities so far.
    next_id: int = 0
    #: Number of scans so far.
    scan: int = 0
    #: Of readings that belong to no landmark of the map.
    density: UnexplainedDensity = UnexplainedDensity()
    #: Which landmarks the scans have shown.
    detections: Detections = Detections()

    def state_dict(self) -> dict[str, Any]:
        """Return copies of all, as arrays."""
        waiting = [(i, scan) for i, scans in self.waiting.items() for scan in scans]
        found = {
            **self._asdict(),
            **self.tentative._asdict(),
            **self.detections._asdict(),
            "waiting": waiting,
            "density": self.density[:5],
            "unexplained": self.density.cells,
        }
        return saved_states.write(found, CANDIDATES)

    @classmethod
    def from_state_dict(cls, state: Mapping[str, Any]) -> Candidates:
        """Restore what :meth:`state_dict` returned; refuse what does not fit."""
        saved = saved_states.read(state, CANDIDATES, "tentative.")
        waiting: dict[int, list[int]] = {}
        for landmark_id, scan in saved["waiting"].tolist():
            waiting.setdefault(landmark_id, []).append(scan)
        missed = {int(i): left for i, left in saved["missed"].tolist()}
        shown = dict(saved["shown"].tolist())
        lost = LostEvidence(*saved["lost"].tolist())
        lost = lost._replace(first_new=int(lost.first_new))
        most_lost = max(lost.lasting, lost.unknown, lost.unexplained)
        density, (seen, expected, returned) = saved["density"], saved["detected"]
        is_share = (returned >= 0) & (returned <= seen) & (seen <= expected)
        for name, wanted, is_so in (
            ("density", "> 0", density[:4].min() > 0),
            ("density", ">= 0", density[4] >= 0),
            ("unexplained", ">= 0", saved["unexplained"].min() >= 0),
            ("detected", ">= 0, each count at most the one it is part of", is_share),
            ("missed", "probabilities", [0 <= left <= 1 for left in missed.values()]),
            ("lost", ">= 0", min(lost) >= 0),
            ("lost", "at most the largest so far", most_lost <= lost.largest),
        ):
            if not np.all(is_so):
                raise ValueError(f"state['tentative.{name}'] must be {wanted}")
        saved["seen"] = saved["seen"].astype(np.int64)
        tentative = TentativeLandmarks(**{key: saved[key] for key in TENTATIVE})
        counts = int(saved["next_id"]), int(saved["scan"])
        new = UnexplainedDensity(*density.tolist())._replace(cells=saved["unexplained"])
        detections = Detections(saved["detected"], missed, shown, lost, saved["path"])
        return cls(tentative, waiting, *counts, new, detections)


#: What a saved state holds about the landmarks that are not in the map yet.
CANDIDATES: saved_states.Table = {
    **TENTATIVE,
    "waiting": (saved_states.WHOLE, -1, 2),
    "next_id": (saved_states.COUNTS,),
    "scan": (saved_states.COUNTS,),
    "density": (saved_states.NUMBERS, 5),
    "unexplained": (saved_states.NUMBERS, SECTORS, RINGS),
    "detected": (saved_states.NUMBERS, 3, SECTORS, RINGS),
    "missed": (saved_states.NUMBERS, -1, 2),
    "shown": (saved_states.WHOLE, -1, 2),
    "lost": (saved_states.NUMBERS, 8),
    "path": (saved_states.NUMBERS, -1, 13),
}

#: −2 ln of the likelihood of an association, up to a constant, and its completion.
Option = tuple[float, Callable[[], ScanAssociation]]


def associate(
    policy: AssociationPolicy,
    candidates: Candidates,
    readings: Array,
    view: MapView,
    sensor: AssociationSensor,
    ceiling: float = np.inf,
) -> list[Option]:
    """Associate readings (m, 2) that have no identity, in every way to consider.

    The most likely association comes first.  Above a cost of ``ceiling``, only this one
    is of interest.  Readings closer than the sensor's least range have no usable
    bearing: they are ambiguous.
    """
    usable = [distance >= sensor.min_range for distance in readings[:, 1].tolist()]
    used, noise = readings if all(usable) else readings[usable], sensor.noise
    density = _unexplained_density(policy, candidates, used, noise)
    found = assign_scan(policy, view, used, noise, density, ceiling=ceiling)

    def complete(slots: IntArray, detections: Detections) -> ScanAssociation:
        counted = candidates._replace(detections=detections)
        association = ScanAssociation(policy, counted, readings)
        association.explained = {view.ids[slot] for slot in found.explained.tolist()}
        if used is not readings:
            of_used, slots = slots, np.full(len(readings), AMBIGUOUS)
            slots[usable] = of_used
        association.assign(slots, view, noise)
        return association

    options = []
    known, longest = candidates.detections, candidates.density.longest
    for cost, slots in zip(found.costs.tolist(), found.slots, strict=True):
        scan = slots, found.explained, used
        missed, detections = known.after(view, scan, longest)
        if policy.density is None:  # the Poisson probability of no other reading
            missed += 2 * candidates.density.per_scan
        options.append((cost + missed, partial(complete, slots, detections)))
    return sorted(options, key=lambda option: option[0])


def _unexplained_density(
    policy: AssociationPolicy, candidates: Candidates, readings: Array, noise: Noise
) -> Array:
    """Return the density of readings from no landmark of the map, at each reading."""
    density = candidates.density.at(readings, policy.density)
    if policy.association in ("nearest", "compatibility"):  # they use none
        return density
    mean, P, seen = candidates.tentative[:3]
    if len(seen):
        share, gate = candidates.density.landmark_share, float(policy.new_gate)
        add_tentative((mean, P, seen), readings, tuple(noise), gate, share, density)
    return density
