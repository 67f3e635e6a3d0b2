"""Manage the landmarks of any filter by a policy."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ...arrays import Array
from ..association.scan_association import (
    LABEL_BITS,
    NO_LABEL,
    Candidates,
    Option,
    ScanAssociation,
    Sensor,
    associate,
)
from ..filters.ekf import MotionNoise
from ..interface import (
    Belief,
    MapView,
    ScanDecisions,
    SlamEstimator,
    SupportsLocalView,
    SupportsTruth,
    UpdateReport,
    before_update,
    checkpoint,
    optional_members,
    restore,
)
from ..models.rigid_motion import rotation
from ..support import argument_checks, saved_states
from ..support import argument_checks as pair_checks
from ..support.argument_checks import LandmarkIds
from ..support.saved_states import with_prefix, without_prefix
from ..support.undo import Recall, Undo, carried_out, undo_all, undone_on_error
from .map_editor import CachedEditor, edit_map, is_near, mapped_ids, marginal, view_map
from .policy import LandmarkPolicy, as_policy
from .pruning import MapPruner


class ManagedSlam:
    """A filter of any kind that associates, confirms, removes and merges landmarks.

    A :class:`LandmarkPolicy` decides which landmark each reading belongs to, when a new
    landmark is confirmed, and which landmarks to merge or to remove.

    Parameters
    ----------
    estimator : callable
        Makes the filter, from the keywords below; a class will do.
    motion_std, measurement_std, initial_pose, initial_pose_std
        As every filter takes them.
    management : LandmarkPolicy, mapping or True
        The policy, its fields, or True for the default one.
    **options
        Those of the filter.

    Raises
    ------
    ValueError
        If filter or policy refuse a value.
    TypeError
        If the filter's map cannot be edited.

    Notes
    -----
    Tentative landmarks stay outside the filter's state: one that is never confirmed
    does not change the belief.  Readings before the confirming one correct nothing
    unless backdated.

    Examples
    --------
    >>> from slamgym.estimator import EkfSlam
    >>> slam = ManagedSlam(EkfSlam, (0.1, 0.1, 0.05), (0.02, 0.1), management=True)
    >>> for _ in range(3):
    ...     report = slam.update([(0.5, 4.0)])
    >>> report.confirmed_ids, slam.belief().landmark_ids
    ((0,), (0,))
    """

    def __init__(
        self,
        estimator: Callable[..., SlamEstimator],
        motion_std: ArrayLike,
        measurement_std: ArrayLike,
        *,
        management: LandmarkPolicy | Mapping[str, Any] | bool = True,
        initial_pose: ArrayLike = (0.0, 0.0, 0.0),
        initial_pose_std: ArrayLike = (0.0, 0.0, 0.0),
        **options: Any,
    ) -> None:
        self._policy = as_policy(management)
        self._filter = estimator(
            motion_std=motion_std,
            measurement_std=measurement_std,
            initial_pose=initial_pose,
            initial_pose_std=initial_pose_std,
            **options,
        )
        self._sensor = Sensor.checked(measurement_std, options)
        self._motion_noise = MotionNoise.checked(
            motion_std, options.get("noise_at_rest", True)
        )
        merging = self._policy.merge_within is not None
        self._editor = CachedEditor(edit_map(self._filter, merging=merging))
        self._pruner = MapPruner(self._policy, self._editor, self._sensor.noise)
        self._candidates = Candidates()
        self._report: UpdateReport | None = None
        window = self._policy.confirm[1] if self._policy.backdate else 0
        self._recent = RecentScans(
            self._filter, self._editor, window, self._policy.pair_gate
        )
        for name, member in optional_members(self._filter).items():
            setattr(self, name, member)

    @property
    def policy(self) -> LandmarkPolicy:
        """The policy that decides about landmarks."""
        return self._policy

    @property
    def filter(self) -> SlamEstimator:
        """The filter inside."""
        return self._filter

    @property
    def tentative_landmarks(self) -> Array:
        """Estimated positions of tentative landmarks, shape (t, 2) [m]."""
        places = self._candidates.tentative.places
        x, y, heading = self._editor.map_view().mean[:3]
        return np.asarray(places @ rotation(heading).T + (x, y))

    @property
    def decisions(self) -> list[ScanDecisions]:
        """The decisions about the scans since the start or the last loaded state."""
        return self._recent.decisions

    def reset(self, pose: ArrayLike, pose_std: ArrayLike) -> None:
        """Start a new run, without a map, at a pose (3,) with deviations (3,)."""
        with undone_on_error(self.bookmark()):
            self._filter.reset(pose, pose_std)
            self._editor.expire()
            self._pruner.forget()
            self._candidates = Candidates()
            self._recent.forget()

    def predict(self, odometry: ArrayLike, dt: float = 1.0) -> None:
        """Move by odometry (d, α) [m, rad], its motion noise counted √dt times."""
        distance, turn = argument_checks.pair("odometry", odometry)
        variance = self._motion_noise.over(distance, turn, dt)
        with undone_on_error(self.checkpoint(motion=True)):
            self._filter.predict((distance, turn), dt)
            self._editor.expire()
            moved = self._candidates.tentative.moved(distance, turn, variance)
            self._candidates = replace(self._candidates, tentative=moved)
            self._recent.note_motion(distance, turn, dt)

    def update(
        self, measurements: ArrayLike, landmark_ids: LandmarkIds | None = None
    ) -> UpdateReport:
        """Associate one scan, correct the belief with it, then prune the map.

        Parameters
        ----------
        measurements : array_like, shape (m, 2)
            Rows (β, r) [rad, m], all seen at once.
        landmark_ids : sequence of int, length m, optional
            Identity of the landmark behind each row; None: associate the rows.

        Returns
        -------
        UpdateReport
            The filter's, with the changes of the map.

        Raises
        ------
        ValueError, numpy.linalg.LinAlgError
            If the arguments are malformed, or the filter's covariance is degenerate;
            all is then as before.
        """
        readings = argument_checks.scan(measurements)

        def associate() -> ScanAssociation:
            if landmark_ids is None:
                return self.alternatives(readings)[0][1]()
            return self.as_given(readings, landmark_ids)

        return self.take(readings, associate)

    def as_given(self, readings: Array, landmark_ids: LandmarkIds) -> ScanAssociation:
        """Associate readings (m, 2) by their identities."""
        given = argument_checks.identities(landmark_ids, len(readings))
        plan = ScanAssociation(self._policy, self._candidates, len(readings))
        view = self._editor.map_view(self._policy.reach(readings))
        plan.translate(given, view.mapped, self._pruner.merger.aliases)
        return plan

    def alternatives(self, readings: Array, ceiling: float = np.inf) -> list[Option]:
        """Associate readings (m, 2) without identity, in every way to consider.

        Of those that cost more than ``ceiling`` only the most likely is of interest.
        """
        argument_checks.refuse_not_finite(readings)
        known, view = self._candidates, self._pruner.view_for(readings)
        return associate(self._policy, known, readings, view, self._sensor, ceiling)

    def resembles(self, other: ManagedSlam, tolerance: float) -> bool:
        """Return whether another run has the same landmarks, and nearly their means."""
        labels, others = (s._candidates.tentative.labels for s in (self, other))
        views = self._editor.map_view(), other._editor.map_view()
        return np.array_equal(labels, others) and is_near(*views, tolerance)

    def take(
        self, readings: Array, associate: Callable[[], ScanAssociation]
    ) -> UpdateReport:
        """Correct the belief with readings (m, 2) as associated, then prune the map."""
        undo_filter, recall = before_update(self._filter)
        undo = self._editor.checkpoint() if recall else self._undo_records()
        noted: tuple[ScanAssociation, set[int], list[RecentScan], int | None]
        repeats = False

        def correct() -> UpdateReport:
            nonlocal noted, repeats
            plan = associate()
            missed = self._pruner.expected(readings) - plan.explained
            scans, first = self._recent.with_scan(readings, plan)
            noted = plan, missed, scans, first
            repeats = first is not None
            return self._recent.feed(scans, first, plan)

        def absorbed() -> UpdateReport | None:
            return recall() if recall and not repeats else None

        def follow(report: UpdateReport) -> UpdateReport:
            plan, missed, scans, first = noted
            self._recent.note_scan(plan, scans, first, report)
            self._editor.expire()
            self._candidates = plan.candidates
            seen = set(self._editor.map_view().ids).intersection(plan.row_ids)
            seen -= {*report.rejected_ids, *report.skipped_ids}
            removed, merged = self._pruner.prune(readings, plan, seen, missed)
            self._recent.note_edits(removed, merged)
            made = self.decisions[-1]
            self._report = report.replace(
                removed_ids=tuple(removed),
                merged_ids=tuple(merged),
                confirmed_ids=tuple(i for i in made.added if i in plan.confirmed),
                row_ids=tuple(plan.row_ids),
                tentative_rows=tuple(plan.tentative_rows),
                ambiguous_rows=tuple(plan.ambiguous_rows),
            )
            return self._report

        undo, told = undo_all(undo_filter, undo), recall and absorbed
        return carried_out(correct, follow, undo, told, self.bookmark)

    def remove(self, landmark_ids: LandmarkIds) -> None:
        """Marginalise mapped landmarks by hand, shape (n,); all else stays."""
        ids = argument_checks.mapped_identities(landmark_ids, self._slots)
        with undone_on_error(self.bookmark()):
            self._recent.note_edits(self._pruner.remove(ids), ())

    def merge(self, kept: int, gone: int) -> None:
        """Merge two mapped landmarks by hand; both identities then name the first."""
        pair_checks.two_landmarks(kept, gone, self._slots)
        with undone_on_error(self.bookmark()):
            self._pruner.merger.join([(kept, gone)])
            self._recent.note_edits((), [(kept, gone)])

    @property
    def _slots(self) -> dict[int, int]:
        return {i: slot for slot, i in enumerate(self.landmark_ids)}

    def belief(self, landmark_ids: Sequence[int] | None = None) -> Belief:
        """Return the present belief, of the whole map or of pose and some landmarks."""
        if landmark_ids is None:
            return self._filter.belief()
        return marginal(self._filter, landmark_ids)

    def map_view(self) -> MapView:
        """Return pose and map, without a copy where possible, until the next step."""
        return view_map(self._filter)

    @property
    def landmark_ids(self) -> tuple[int, ...]:
        """The mapped landmarks, in the order of the belief."""
        return mapped_ids(self._filter)

    def state_dict(self) -> dict[str, Any]:
        """Return the filter's state and the records of landmarks, as arrays."""
        return self._remembered() | with_prefix("filter", self._filter.state_dict())

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from a saved state, bit for bit under the same settings.

        An error leaves all as before.
        """
        entries = [k for k in self._remembered() if k.count(".") < 2]
        saved_states.refuse_other_state(state, entries, estimator=type(self).__name__)
        candidates = Candidates.from_state_dict(without_prefix(state, "tentative"))
        with undone_on_error(self.bookmark()):
            self._pruner.load_state_dict(without_prefix(state, "landmarks"))
            self._recent.load_state_dict(without_prefix(state, "recent"))
            self._filter.load_state_dict(without_prefix(state, "filter"))
            self._editor.expire()
            self._candidates = candidates

    def checkpoint(self, *, motion: bool = False) -> Undo:
        """Return what takes back later calls; ``motion``: only those of predict."""
        undo_filter = checkpoint(self._filter, motion=motion)
        if not motion:
            return undo_all(undo_filter, self._undo_records())
        records = self._candidates, self._recent.motions

        def undo() -> None:
            undo_filter()
            self._editor.expire()
            self._candidates, self._recent.motions = records

        return undo

    def bookmark(self) -> Undo:
        """Return what takes back later calls, as far as no kernel has run."""
        return undo_all(before_update(self._filter)[0], self._undo_records())

    def recall(self) -> Recall[UpdateReport] | None:
        """Return what tells the report of the next update, once it is absorbed."""
        self._report = None
        return before_update(self._filter)[1] and (lambda: self._report)

    def _undo_records(self) -> Undo:
        """Return what takes back later changes of all but the filter."""
        candidates, report = self._candidates, self._report
        undo_parts = undo_all(
            self._pruner.checkpoint(),
            self._recent.checkpoint(),
            self._editor.checkpoint(),
        )

        def undo() -> None:
            undo_parts()
            self._candidates, self._report = candidates, report

        return undo

    def copy_from(self, other: ManagedSlam) -> None:
        """Continue as another filter of the same settings, decisions included."""
        restore(self._filter, other.filter.state_dict())
        self._pruner.load_state_dict(other._pruner.state_dict())
        self._recent.copy_from(other._recent)
        self._editor.expire()
        self._candidates = other._candidates

    def _remembered(self) -> dict[str, Any]:
        """Return all of the state except the filter's."""
        return {
            "estimator": np.array(type(self).__name__),
            **with_prefix("landmarks", self._pruner.state_dict()),
            **with_prefix("tentative", self._candidates.state_dict()),
            **with_prefix("recent", self._recent.state_dict()),
        }

    def __repr__(self) -> str:
        return f"Managed {self._filter!r}"


# --------------------------------------------------------------------------------------
# The last scans of a run, kept to repeat them once a landmark is confirmed.
#
# The sightings before the confirming one are readings of the new landmark, too.  To
# apply them, the filter goes back to its state before the first of them and repeats the
# scans since then, with the new landmark in them.  Where a sighting contradicts the
# ones before it, given the other readings of its scan, those before it were clutter or
# of another landmark: they are dropped, and the scans are repeated once more.


class RecentScans:
    """Feeds the scans of a run to a filter, and repeats the last ones where needed.

    Parameters
    ----------
    slam : SlamEstimator
        The filter.
    editor : CachedEditor
        Of its map.
    window : int
        Number of scans within which a landmark is confirmed; 0: keep no scans.
    gate : float
        Largest νᵀ S⁻¹ ν of a sighting, given the other readings of its scan.

    Notes
    -----
    No scans are kept of filters for large maps, whose states are expensive to copy, and
    of those that need the truth at every step.
    """

    def __init__(
        self, slam: SlamEstimator, editor: CachedEditor, window: int, gate: float
    ) -> None:
        can_repeat = not isinstance(slam, SupportsTruth | SupportsLocalView)
        self._slam, self._editor = slam, editor
        self._window, self._gate = window if can_repeat else 0, gate
        self.forget()

    def forget(self) -> None:
        """Start a new run."""
        self.scans: list[RecentScan] = []
        self.motions: tuple[Motion, ...] = ()
        self.decisions: list[ScanDecisions] = []
        """About every scan since the start, or since a saved state was loaded."""

    def copy_from(self, other: RecentScans) -> None:
        """Continue from the scans of another run with the same kind of filter."""
        self.scans, self.motions = list(other.scans), other.motions
        self.decisions = list(other.decisions)

    def checkpoint(self) -> Undo:
        """Return what takes back later changes of what is remembered."""
        scans, motions, decisions = list(self.scans), self.motions, self.decisions
        count, newest = len(decisions), decisions[-self._window - 1 :]

        def undo() -> None:
            decisions[count - len(newest) :] = newest
            self.scans, self.motions, self.decisions = list(scans), motions, decisions

        return undo

    def note_motion(self, distance: float, turn: float, dt: float) -> None:
        """Remember a motion since the last scan."""
        if self._window:
            self.motions += ((distance, turn, dt),)

    def note_edits(
        self, removed: Sequence[int], merged: Sequence[tuple[int, int]]
    ) -> None:
        """Remember which landmarks were removed and merged after the last scan."""
        if self.decisions and (removed or merged):
            made = self.decisions[-1]
            self.decisions[-1] = made._replace(
                removed=(*made.removed, *removed), merged=(*made.merged, *merged)
            )
        if self.scans and (removed or merged):
            last = self.scans[-1]
            self.scans[-1] = replace(
                last,
                removed=(*last.removed, *removed),
                merged=(*last.merged, *merged),
            )

    def with_scan(
        self, readings: Array, plan: ScanAssociation
    ) -> tuple[list[RecentScan], int | None]:
        """Return the last scans with a new one, and the first to repeat, if any."""
        row_ids, labels = tuple(plan.row_ids), tuple(plan.labels)
        scan = RecentScan(plan.scan, self.motions, readings, row_ids, labels)
        if not self._window:
            return [scan], None
        if scan.begins:
            scan = replace(scan, before=self._slam.state_dict())
        scans = [*self.scans, scan][-self._window - 1 :]
        return scans, _relabel(scans, plan.confirmed)

    def feed(
        self, scans: list[RecentScan], first: int | None, plan: ScanAssociation
    ) -> UpdateReport:
        """Update the filter with the last scan, and with earlier sightings if any."""
        if first is None:
            return scans[-1].feed(self._slam)
        return self._apply_earlier(scans, first, {*plan.confirmed})

    def note_scan(
        self,
        plan: ScanAssociation,
        scans: list[RecentScan],
        first: int | None,
        report: UpdateReport,
    ) -> None:
        """Remember a scan that the filter has taken in."""
        if self._window:
            self.scans, self.motions = list(scans), ()
        self.decisions.append(_decided(plan, report))
        if first is not None:
            self._revise_decisions(scans[first:-1])

    def _revise_decisions(self, scans: Sequence[RecentScan]) -> None:
        """Note the landmarks that the readings of earlier scans belong to now."""
        newest = self.scans[-1].number
        for scan in scans:
            place = len(self.decisions) - 1 - (newest - scan.number)
            if place >= 0:
                made = self.decisions[place]
                pairs = zip(made.row_ids, scan.row_ids, scan.labels, strict=True)
                ids = tuple(new if label != NO_LABEL else i for i, new, label in pairs)
                self.decisions[place] = made._replace(row_ids=ids)

    def _apply_earlier(
        self, scans: list[RecentScan], first: int, confirmed: set[int]
    ) -> UpdateReport:
        """Repeat the scans since one until no sighting contradicts those before it."""
        reports = self._repeat(scans, first)
        while _drop_contradicted(scans, reports, confirmed, self._gate):
            reports = self._repeat(scans, first)
        return reports[-1]

    def _repeat(self, scans: list[RecentScan], first: int) -> list[UpdateReport]:
        """Repeat the scans since one, and renew the states kept before them."""
        before = scans[first].before
        assert before is not None  # a tentative landmark begins here
        restore(self._slam, before)
        self._editor.expire()
        reports = [scans[first].feed(self._slam)]
        for k in range(first + 1, len(scans)):
            scans[k - 1].edit(self._editor)
            for distance, turn, dt in scans[k].motions:
                self._slam.predict((distance, turn), dt)
            if scans[k].before is not None:
                scans[k] = replace(scans[k], before=self._slam.state_dict())
            reports.append(scans[k].feed(self._slam))
        return reports

    def state_dict(self) -> dict[str, Any]:
        """Return all as arrays."""
        state: dict[str, Any] = {
            "motions": motion_array(self.motions),
            "count": np.array(len(self.scans)),
        }
        for k, scan in enumerate(self.scans):
            state |= with_prefix(str(k), scan.state_dict())
        return state

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore what :meth:`state_dict` returned."""
        motions = motions_of(state["motions"])
        count = saved_states.whole_number("recent.count", state["count"])
        if count > self._window + 1:
            raise ValueError(
                f"state['recent.count'] must be at most {self._window + 1}, got {count}"
            )
        self.scans = [
            RecentScan.from_state_dict(without_prefix(state, str(k)))
            for k in range(count)
        ]
        self.motions = motions
        self.decisions = []


def _decided(plan: ScanAssociation, report: UpdateReport) -> ScanDecisions:
    """Return the outcome of each row of a scan."""
    new = {*report.added_ids, *plan.confirmed}.difference(report.skipped_ids)
    unused = {*report.rejected_ids, *report.skipped_ids} - new
    row_ids = tuple(None if i in unused else i for i in plan.row_ids)
    return ScanDecisions(
        row_ids, tuple(i for i in row_ids if i in new and i is not None)
    )


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
        scans[k] = replace(scans[k], row_ids=ids)
    return shown[0]


def _drop_contradicted(
    scans: list[RecentScan],
    reports: Sequence[UpdateReport],
    confirmed: set[int],
    gate: float,
) -> bool:
    """Drop the sightings before one that contradicts them; return whether any were.

    Parameters
    ----------
    scans : list of RecentScan
        The scans kept.
    reports : sequence of UpdateReport
        Of the last ones of them.
    confirmed : set of int
        The landmarks confirmed in the present scan.
    gate : float
        Largest νᵀ S⁻¹ ν of a sighting, given the other readings of its scan.
    """
    first = len(scans) - len(reports)
    for k, report in enumerate(reports):
        if len(report.innovation) != len(report.associated_ids):
            continue  # of a filter that reports no innovations
        for landmark_id in confirmed.intersection(report.associated_ids):
            earlier = scans[first : first + k]
            if (
                any(landmark_id in scan.row_ids for scan in earlier)
                and report.squared_given_others(landmark_id) > gate
            ):
                scans[first : first + k] = [s.without(landmark_id) for s in earlier]
                return True
    return False


# --------------------------------------------------------------------------------------
# One of the last scans of a run, kept so that it can be repeated.

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
