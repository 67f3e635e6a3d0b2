"""Associate each row of a scan with a landmark, a candidate for one, or neither.

An association changes no belief.  It takes effect after the filter has accepted the
scan.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ...arrays import Array, IntArray
from ..belief import MapView
from ..support import saved_states
from .association_policy import AssociationPolicy
from .nearest_neighbour import AMBIGUOUS, NEW, Noise
from .scan_assignments import assign_nearest, assign_scan
from .tentative_landmarks import TentativeLandmarks

NO_LABEL = -1

LABEL_BITS = 20
"""A label is the scan of the first sighting, shifted by so many bits, plus its row."""

MEMORY = 0.98
"""Weight of a scan relative to the one after it, in running averages."""


class Sensor(NamedTuple):
    """What association knows of the sensor."""

    noise: Noise
    min_range: float
    """Readings closer than this have no usable bearing [m]."""

    @classmethod
    def checked(cls, measurement_std: ArrayLike, options: Mapping[str, Any]) -> Sensor:
        """Read a sensor from the arguments of a filter.

        Raises
        ------
        ValueError
            If the bearing noise depends on the range.
        """
        if options.get("bearing_std_metres"):
            raise ValueError(
                "bearing_std_metres must be 0 with management, "
                f"got {options['bearing_std_metres']!r}"
            )
        bearing_std, range_std = np.asarray(measurement_std, dtype=np.float64).tolist()
        per_metre = float(options.get("range_std_per_metre", 0.0))
        min_range = options.get("min_range", 1e-3)
        return cls((bearing_std, range_std, per_metre), min_range)


class UnexplainedDensity(NamedTuple):
    """A running average of the readings that belong to no landmark of the map.

    Examples
    --------
    >>> density = UnexplainedDensity()
    >>> for _ in range(500):
    ...     density = density.after(2, longest=8.0)
    >>> round(density.value * 2 * np.pi * 8.0, 2)
    2.0
    """

    readings: float = 1.0
    scans: float = 2.0
    longest: float = 1.0
    """Longest range read so far [m]."""

    @property
    def value(self) -> float:
        """Readings per scan and [rad m]."""
        return self.readings / (self.scans * 2 * np.pi * self.longest)

    def after(self, readings: int, longest: float) -> UnexplainedDensity:
        """Count one more scan."""
        return UnexplainedDensity(
            MEMORY * self.readings + readings,
            MEMORY * self.scans + 1,
            max(self.longest, longest),
        )


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
    density: UnexplainedDensity = field(default_factory=UnexplainedDensity)
    """Of readings that belong to no landmark of the map."""

    def state_dict(self) -> dict[str, Any]:
        """Return copies of all, as arrays."""
        waiting = [(i, scan) for i, scans in self.waiting.items() for scan in scans]
        return {
            **{key: value.copy() for key, value in self.tentative._asdict().items()},
            "waiting": np.array(waiting, dtype=np.int64).reshape(-1, 2),
            "next_id": np.array(self.next_id),
            "scan": np.array(self.scan),
            "density": np.array(self.density),
        }

    @classmethod
    def from_state_dict(cls, state: Mapping[str, Any]) -> Candidates:
        """Restore what :meth:`state_dict` returned; refuse what does not fit."""
        waiting: dict[int, list[int]] = {}
        pairs = saved_states.whole_numbers(
            "tentative.waiting", state["waiting"], (-1, 2)
        )
        for landmark_id, scan in pairs.tolist():
            waiting.setdefault(landmark_id, []).append(scan)
        density = saved_states.array("tentative.density", state["density"], (3,))
        if density.min() <= 0:
            raise ValueError(f"state['tentative.density'] must be > 0, got {density}")
        return cls(
            TentativeLandmarks.from_state_dict(state),
            waiting,
            saved_states.whole_number("tentative.next_id", state["next_id"]),
            saved_states.whole_number("tentative.scan", state["scan"]),
            UnexplainedDensity(*density.tolist()),
        )


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
        density = self._density.after(self.row_ids.count(None), self._longest)
        tentative, waiting = self._tentative, self._waiting
        return Candidates(tentative, waiting, self._next_id, self.scan + 1, density)

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


def associate(
    policy: AssociationPolicy,
    candidates: Candidates,
    readings: Array,
    view: MapView,
    sensor: Sensor,
    ceiling: float = np.inf,
) -> list[tuple[float, ScanAssociation]]:
    """Associate readings (m, 2) that have no identity, in every way to consider.

    Readings closer than the sensor's least range have no usable bearing: they are
    ambiguous.  Of associations that cost more than ``ceiling`` only the likeliest is of
    interest.

    Returns
    -------
    list of (float, ScanAssociation)
        −2 ln of each one's likelihood, up to a constant; the likeliest first.
    """
    rows = np.flatnonzero(readings[:, 1] >= sensor.min_range)
    density = policy.density or candidates.density.value
    found = assign_scan(
        policy, view, readings[rows], sensor.noise, density, ceiling=ceiling
    )
    explained = {view.ids[slot] for slot in found.explained.tolist()}
    result = []
    for cost, slots in found.ranked:
        association = ScanAssociation(policy, candidates, len(readings))
        association.explained = set(explained)
        association.assign(rows, slots, readings, view, sensor.noise)
        result.append((cost, association))
    return result
