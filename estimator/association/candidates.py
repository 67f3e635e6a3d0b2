"""Associate each row of a scan with a landmark, a candidate for one, or neither.

An association changes no belief.  It takes effect after the filter has accepted the
scan.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..belief import MapView
from .association_policy import AssociationPolicy
from .nearest_neighbour import (
    AMBIGUOUS,
    NEW,
    Distances,
    Noise,
    innovation_distances,
    nearest_neighbours,
)
from .tentative_landmarks import TentativeLandmarks

Array = NDArray[np.float64]
Int = NDArray[np.int64]


@dataclass(frozen=True)
class Candidates:
    """Landmarks that are not in the map yet, and the next identity to assign."""

    tentative: TentativeLandmarks = field(default_factory=TentativeLandmarks.none)
    """Landmarks without an identity."""
    waiting: Mapping[int, Sequence[int]] = field(default_factory=dict)
    """Given identities that are not trusted yet, and the scans that showed them."""
    next_id: int = 0
    """Above all identities so far."""
    scan: int = 0
    """Number of scans so far."""

    def state_dict(self) -> dict[str, Any]:
        """Return copies of all, as arrays."""
        waiting = [(i, scan) for i, scans in self.waiting.items() for scan in scans]
        return {
            **{key: value.copy() for key, value in self.tentative._asdict().items()},
            "waiting": np.array(waiting, dtype=np.int64).reshape(-1, 2),
            "next_id": np.array(self.next_id),
            "scan": np.array(self.scan),
        }

    @classmethod
    def from_state_dict(cls, state: Mapping[str, Any]) -> Candidates:
        """Restore what :meth:`state_dict` returned."""
        waiting: dict[int, list[int]] = {}
        for landmark_id, scan in np.asarray(state["waiting"]).tolist():
            waiting.setdefault(landmark_id, []).append(scan)
        tentative = TentativeLandmarks(
            np.array(state["places"], dtype=np.float64),
            np.array(state["covariances"], dtype=np.float64),
            np.array(state["seen"], dtype=np.uint64),
        )
        return cls(tentative, waiting, int(state["next_id"]), int(state["scan"]))


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
        self._next_id, self._scan = candidates.next_id, candidates.scan
        self.row_ids: list[int | None] = [None] * rows
        """For each row the landmark that the filter associates it with, if any."""
        self.confirmed: list[int] = []
        """Landmarks that were tentative before this scan."""
        self.tentative_rows: list[int] = []
        self.ambiguous_rows: list[int] = []
        self.explained: set[int] = set()
        """Landmarks that some row may belong to, so that they are not missing."""

    @property
    def candidates(self) -> Candidates:
        """The candidates after the scan."""
        return Candidates(self._tentative, self._waiting, self._next_id, self._scan + 1)

    def associate(
        self, readings: Array, view: MapView, noise: Noise, min_range: float
    ) -> None:
        """Associate readings (m, 2) that have no identity.

        Readings closer than ``min_range`` [m] have no usable bearing: they are
        ambiguous.
        """
        policy = self._policy
        is_near = readings[:, 1] < min_range
        self.ambiguous_rows += np.flatnonzero(is_near).tolist()
        rows = np.flatnonzero(~is_near)
        fit = innovation_distances(
            view.mean,
            view.covariance,
            len(view.ids),
            readings[rows],
            noise,
            policy.new_gate,
        )
        slots = self._neighbours(fit)
        for row, slot in zip(rows.tolist(), slots.tolist(), strict=True):
            if slot >= 0:
                self.row_ids[row] = view.ids[slot]
        fitting = np.flatnonzero(np.isfinite(fit.squared).any(axis=0))
        self.explained = {view.ids[slot] for slot in fitting.tolist()}
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
                self._confirm(row, landmark_id)
            else:
                self.tentative_rows.append(row)

    def _neighbours(self, fit: Distances) -> Int:
        policy = self._policy
        return nearest_neighbours(
            fit,
            match=policy.match_gate,
            new=policy.new_gate,
            ambiguity=policy.ambiguity,
        )

    def _match_tentative(self, rows: Int, readings: Array, noise: Noise) -> None:
        """Match rows that no landmark explains with tentative ones; confirm these."""
        tentative = self._tentative
        fit = tentative.distances(readings[rows], noise, self._policy.new_gate)
        slots = self._neighbours(fit)
        self.ambiguous_rows += rows[slots == AMBIGUOUS].tolist()
        pairs = list(zip(rows.tolist(), slots.tolist(), strict=True))
        for row, slot in pairs:
            if slot >= 0:
                tentative = tentative.with_sighting(slot, readings[row], noise)
        needed = self._policy.confirm[0]
        enough = tentative.sightings >= needed
        confirmed = set(np.flatnonzero(enough).tolist())
        if needed == 1:
            confirmed.add(NEW)
        for row, slot in pairs:
            if slot in confirmed:
                self._confirm(row, self._next_id)
            elif slot != AMBIGUOUS:
                self.tentative_rows.append(row)
        fresh = rows[(slots == NEW) & (needed > 1)]
        self._tentative = tentative.chosen(~enough).with_new(readings[fresh], noise)

    def _has_waited(self, landmark_id: int) -> bool:
        """Count a sighting of an identity; return whether it has been seen enough."""
        needed, scans = self._policy.confirm
        earlier = self._waiting.pop(landmark_id, ())
        recent = [*(scan for scan in earlier if scan > self._scan - scans), self._scan]
        if len(recent) < needed:
            self._waiting[landmark_id] = recent
        return len(recent) >= needed

    def _confirm(self, row: int, landmark_id: int) -> None:
        self.row_ids[row] = landmark_id
        self.confirmed.append(landmark_id)
        self._next_id = max(self._next_id, landmark_id + 1)
