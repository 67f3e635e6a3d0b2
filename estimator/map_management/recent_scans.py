"""The last scans of a run, kept to repeat them once a landmark is confirmed.

The sightings before the confirming one are readings of the new landmark, too.  To
apply them, the filter goes back to its state before the first of them and repeats the
scans since then, with the new landmark in them.  Where a sighting contradicts the
ones before it, given the other readings of its scan, those before it were clutter or
of another landmark: they are dropped, and the scans are repeated once more.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from copy import deepcopy
from itertools import chain, islice
from typing import Any, NamedTuple

import numpy as np

from ...arrays import Array
from ...restorable import Restorable, State
from ..association.scan_association import LABEL_BITS, NO_LABEL, ScanAssociation
from ..filters.pose_readings import PoseReading
from ..guards import saved_states
from ..guards.saved_states import with_prefix, without_prefix
from ..interface import (
    ScanDecisions,
    SlamEstimator,
    UpdateReport,
    restore,
    returned_on_error,
)
from .map_editor import MapEditor
from .policy import LandmarkPolicy


class RecentScans(Restorable):
    """Feeds the scans of a run to a filter, and repeats the last ones where needed.

    Parameters
    ----------
    slam : SlamEstimator
        The filter.
    editor : MapEditor
        Of its map.
    policy : LandmarkPolicy
        If it backdates, scans are kept as long as they may confirm a landmark.

    Notes
    -----
    The oldest scan kept is one in which a tentative landmark was first seen.  No scans
    are kept of filters for large maps, whose states are expensive to copy, and of those
    that need the truth at every step.
    """

    changing = ("decisions",)
    replaced = ("scans", "motions")

    def __init__(
        self, slam: SlamEstimator, editor: MapEditor, policy: LandmarkPolicy
    ) -> None:
        self._slam, self._editor, self._gate = slam, editor, policy.pair_gate
        can_repeat = not (hasattr(slam, "observe_truth") or hasattr(slam, "local_view"))
        self._window = policy.confirm[1] if policy.backdate and can_repeat else 0
        self.forget()

    def forget(self) -> None:
        """Start a new run."""
        self.scans: list[RecentScan] = []
        self.motions: tuple[Motion, ...] = ()
        #: About every scan since the start, or since a saved state was loaded.
        self.decisions: list[ScanDecisions] = []

    def note_motions(self, *motions: Motion) -> None:
        """Remember odometry, or rows of a reading of the pose, if scans are kept."""
        if self.scans:
            self.motions += motions

    def note_edits(
        self, removed: Sequence[int], merged: Sequence[tuple[int, int]]
    ) -> None:
        """Remember which landmarks were removed and merged after the last scan."""
        if not (removed or merged):
            return
        self.scans = [*self.scans]
        noted: tuple[list[Any], ...] = self.decisions, self.scans
        for scans in filter(None, noted):
            last = scans[-1]
            scans[-1] = last._replace(
                removed=(*last.removed, *removed), merged=(*last.merged, *merged)
            )

    def with_scan(self, plan: ScanAssociation) -> FedScans:
        """Return what to feed to the filter: a new scan, and earlier ones to repeat."""
        row_ids, labels = tuple(plan.row_ids), tuple(plan.labels)
        before = self.state_before(plan.scan, labels)
        # The caller may reuse the array of readings.
        parts = self.motions, plan.readings.copy(), row_ids, labels, before
        scans = [*self.scans, RecentScan(plan.scan, *parts)][-self._window - 1 :]
        first = _relabel(scans, plan.confirmed) if plan.confirmed else None
        return FedScans(plan, scans, first)

    def state_before(
        self, number: int, labels: Sequence[int]
    ) -> Mapping[str, Any] | None:
        """Return the state of the filter, if a tentative landmark begins in a scan."""
        if self._window and max(labels, default=NO_LABEL) >= number << LABEL_BITS:
            return self._slam.state_dict()
        return None

    def feed(self, fed: FedScans) -> UpdateReport:
        """Update the filter with the last scan, and with earlier sightings if any.

        The scans are repeated until no sighting contradicts those before it.  A refusal
        changes nothing.
        """
        _, scans, first = fed
        if first is None:
            return scans[-1].feed(self._slam)
        with returned_on_error(self._slam):
            reports = self._repeat(scans, first)
            while _drop_contradicted(fed, reports, self._gate):
                reports = self._repeat(scans, first)
        return reports[-1]

    def note_scan(self, fed: FedScans, report: UpdateReport) -> None:
        """Remember a scan that the filter has taken in."""
        plan, scans, first = fed
        self._keep(scans)
        self.decisions.append(_decided(plan, report))
        # The readings of scans that were repeated may belong to other landmarks now.
        for scan in [] if first is None else scans[first:-1]:
            place = len(self.decisions) - 1 - (plan.scan - scan.number)
            if place >= 0:
                made = self.decisions[place]
                pairs = zip(made.row_ids, scan.row_ids, scan.labels, strict=True)
                ids = tuple(new if label != NO_LABEL else i for i, new, label in pairs)
                self.decisions[place] = made._replace(row_ids=ids)

    def note_clear(
        self,
        number: int,
        readings: Array,
        decided: tuple[tuple[int | None, ...], tuple[int, ...]],
        before: Mapping[str, Any] | None,
        unused: Collection[int],
    ) -> None:
        """Remember a clear scan that the filter has taken in.

        ``decided`` are the landmark and the label of each row, ``before`` is what
        :meth:`state_before` returned, and ``unused`` the landmarks whose readings the
        filter did not use.
        """
        if self.scans or before is not None:
            scan = RecentScan(number, self.motions, readings.copy(), *decided, before)
            self._keep([*self.scans, scan])
        self.decisions.append(ScanDecisions(_without(unused, decided[0])))

    def _keep(self, scans: list[RecentScan]) -> None:
        """Keep the last scans, beginning with one that the filter can return to."""
        scans = scans[-self._window - 1 :]
        starts = (k for k, scan in enumerate(scans) if scan.before is not None)
        self.scans, self.motions = scans[next(starts, len(scans)) :], ()

    def _repeat(self, scans: list[RecentScan], first: int) -> list[UpdateReport]:
        """Repeat the scans since one, and renew the states kept before them."""
        before = scans[first].before
        assert before is not None  # a tentative landmark begins here
        restore(self._slam, before)
        self._editor.expire()
        reports = [scans[first].feed(self._slam)]
        for k in range(first + 1, len(scans)):
            scans[k - 1].edit(self._editor)
            move(self._slam, scans[k].motions)
            if scans[k].before is not None:
                scans[k] = scans[k]._replace(before=self._slam.state_dict())
            reports.append(scans[k].feed(self._slam))
        return reports

    def state_dict(self) -> dict[str, Any]:
        """Return all as arrays."""
        window = {"motions": self.motions, "count": len(self.scans)}
        state = saved_states.write(window, WINDOW)
        for k, scan in enumerate(self.scans):
            state |= with_prefix(str(k), scan.state_dict())
        return state

    def checked(self, state: Mapping[str, Any]) -> State:
        """Return what :meth:`state_dict` returned for `restore`, or refuse it."""
        saved = saved_states.read(state, WINDOW, "recent.")
        n, most = int(saved["count"]), self._window + 1
        if n > most:
            raise ValueError(f"state['recent.count'] must be at most {most}, got {n}")
        parts = [without_prefix(state, str(k)) for k in range(n)]
        scans = [*map(RecentScan.from_state_dict, parts)]
        return [], scans, _as_tuples(saved["motions"].tolist())


class FedScans(NamedTuple):
    """What one update feeds to a filter: a new scan, and earlier ones once more."""

    #: Association of the present scan.
    plan: ScanAssociation
    #: The scans kept, the present one last.
    scans: list[RecentScan]
    #: Index of the first scan to repeat, if any.
    first: int | None


def _decided(plan: ScanAssociation, report: UpdateReport) -> ScanDecisions:
    """Return the outcome of each row of a scan."""
    row_ids, skipped = tuple(plan.row_ids), report.skipped_ids
    new = {*report.added_ids, *plan.confirmed}.difference(skipped)
    unused = {*report.rejected_ids, *skipped} - new
    row_ids = _without(unused, row_ids)
    return ScanDecisions(row_ids, tuple([i for i in row_ids if i in new]))


def _without(
    unused: Collection[int], row_ids: tuple[int | None, ...]
) -> tuple[int | None, ...]:
    """Return the landmarks of rows, without those whose readings were not used."""
    return tuple(None if i in unused else i for i in row_ids) if unused else row_ids


def _relabel(scans: list[RecentScan], confirmed: Mapping[int, int]) -> int | None:
    """Give confirmed landmarks their earlier sightings.

    Parameters
    ----------
    scans : list of RecentScan
        The scans kept, the present one last.
    confirmed : mapping of int to int
        Label of each landmark confirmed in the present scan.

    Returns
    -------
    int or None
        Index of the first scan to repeat, if any: of those before which the state of
        the filter was kept.
    """
    names = {label: i for i, label in confirmed.items() if label != NO_LABEL}
    starts = [k for k, scan in enumerate(scans[:-1]) if scan.before is not None]
    shown = [k for k in starts if not names.keys().isdisjoint(scans[k].labels)]
    if not shown:
        return None
    for k in range(shown[0], len(scans) - 1):
        pairs = zip(scans[k].row_ids, scans[k].labels, strict=True)
        ids = tuple(names.get(label, i) for i, label in pairs)
        scans[k] = scans[k]._replace(row_ids=ids)
    return shown[0]


def _drop_contradicted(
    fed: FedScans, reports: Sequence[UpdateReport], gate: float
) -> bool:
    """Drop the sightings before one that contradicts them; return whether any were.

    Parameters
    ----------
    fed : FedScans
        The scans, which are changed in place.
    reports : sequence of UpdateReport
        Of the last ones of them.
    gate : float
        Largest νᵀ S⁻¹ ν of a sighting, given the other readings of its scan.
    """
    scans, confirmed = fed.scans, {*fed.plan.confirmed}
    first = len(scans) - len(reports)
    for k, report in enumerate(reports):
        if len(report.innovation) != len(report.associated_ids):
            continue  # of a filter that reports no innovations
        for landmark_id in confirmed.intersection(report.associated_ids):
            earlier = scans[first : first + k]
            is_seen = any(landmark_id in scan.row_ids for scan in earlier)
            if is_seen and report.squared_given_others(landmark_id) > gate:
                scans[first : first + k] = [s.without(landmark_id) for s in earlier]
                return True
    return False


# --------------------------------------------------------------------------------------
# One of the last scans of a run, kept so that it can be repeated.

MOTIONS = (saved_states.NUMBERS, -1, 3)
#: What the saved state of a scan holds, beside the state of the filter.
SCAN: saved_states.Table = {
    "number": (saved_states.COUNTS,),
    "motions": MOTIONS,
    "readings": (saved_states.NUMBERS, "m", 2),
    "row_ids": (saved_states.WHOLE, "m"),
    "labels": (saved_states.WHOLE, "m"),
    "removed": (saved_states.WHOLE, -1),
    "merged": (saved_states.WHOLE, -1, 2),
}
#: What a saved state holds about the last scans, beside these.
WINDOW: saved_states.Table = {"motions": MOTIONS, "count": (saved_states.COUNTS,)}

NO_LANDMARK = np.iinfo(np.int64).min

#: (d, α) [m, rad] and dt; or one of the rows of a reading of the pose.
Motion = tuple[float, float, float]


def move(slam: Any, motions: Sequence[Motion]) -> None:
    """Feed a filter with odometry, and with the readings of the pose among it."""
    rows = iter(motions)
    for distance, turn, dt in rows:
        if dt >= 0:
            slam.predict((distance, turn), dt)
        else:  # −k, of a reading of k components
            slam.observe_pose(*PoseReading.of_rows([*islice(rows, int(1 - 2 * dt))]))


class RecentScan(NamedTuple):
    """One scan, the motion before it, and its association."""

    number: int
    #: Odometry, and readings of the pose.
    motions: tuple[Motion, ...]
    #: Rows (β, r), shape (m, 2).
    readings: Array
    #: Landmark of each row, None where the filter does not use it.
    row_ids: tuple[int | None, ...]
    #: Label of the tentative landmark of each row, or `NO_LABEL`.
    labels: tuple[int, ...]
    #: State of the filter before the scan, where a tentative landmark begins in it.
    before: Mapping[str, Any] | None = None
    #: Landmarks removed after it.
    removed: tuple[int, ...] = ()
    #: Landmarks merged after it: (kept, gone).
    merged: tuple[tuple[int, int], ...] = ()

    def feed(self, slam: SlamEstimator) -> UpdateReport:
        """Update a filter with the rows that it uses."""
        rows = [row for row, i in enumerate(self.row_ids) if i is not None]
        ids = [i for i in self.row_ids if i is not None]
        return slam.update(self.readings[rows], ids)  # a copy: it may be repeated

    def without(self, landmark_id: int) -> RecentScan:
        """Return the scan with the reading of a landmark, if any, left out."""
        if landmark_id not in self.row_ids:
            return self
        row = self.row_ids.index(landmark_id)
        row_ids, labels = list(self.row_ids), list(self.labels)
        row_ids[row], labels[row] = None, NO_LABEL
        return self._replace(row_ids=tuple(row_ids), labels=tuple(labels))

    def edit(self, editor: MapEditor) -> None:
        """Remove and merge landmarks as after the scan."""
        if self.removed:
            editor.remove(self.removed)
        for pairs in _groups(self.merged):
            editor.merge_pairs(pairs)

    def state_dict(self) -> dict[str, Any]:
        """Return all as arrays."""
        row_ids = [NO_LANDMARK if i is None else i for i in self.row_ids]
        saved = saved_states.write(self._asdict() | {"row_ids": row_ids}, SCAN)
        return saved | with_prefix("before", deepcopy(self.before or {}))

    @classmethod
    def from_state_dict(cls, state: Mapping[str, Any]) -> RecentScan:
        """Restore what :meth:`state_dict` returned."""
        saved = saved_states.read(state, SCAN)
        found = {key: _as_tuples(array.tolist()) for key, array in saved.items()}
        row_ids = tuple(None if i == NO_LANDMARK else i for i in found["row_ids"])
        before = deepcopy(without_prefix(state, "before")) or None
        kept = {"readings": saved["readings"], "row_ids": row_ids, "before": before}
        return cls(**found | kept)


def _groups(pairs: Sequence[tuple[int, int]]) -> list[list[tuple[int, int]]]:
    """Split pairs into groups in which each landmark occurs once.

    Examples
    --------
    >>> _groups([(0, 4), (1, 5), (0, 6)])
    [[(0, 4), (1, 5)], [(0, 6)]]
    """
    groups: list[list[tuple[int, int]]] = []
    for pair in pairs:
        if not groups or not {*pair}.isdisjoint(chain(*groups[-1])):
            groups.append([])
        groups[-1].append(pair)
    return groups


def _as_tuples(numbers: Any) -> Any:
    """Return lists of numbers as tuples."""
    return tuple(map(_as_tuples, numbers)) if isinstance(numbers, list) else numbers
