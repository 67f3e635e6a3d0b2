"""Manage the landmarks of any filter by a policy: `ManagedSlam`.

A managed filter associates readings without identity, confirms tentative landmarks,
and prunes its map after each scan. `RecentScans` repeats the last scans once a landmark
is confirmed.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ...arrays import Array, IntArray
from ..association.missed_landmarks import LOST_SCORE
from ..association.scan_assignments import AssociationSensor
from ..association.scan_association import (
    Candidates,
    Option,
    ScanAssociation,
    associate,
)
from ..filters.pose_readings import PoseReading, observe_relative_pose
from ..guards import argument_checks, saved_states
from ..guards.argument_checks import LandmarkIds
from ..guards.saved_states import with_prefix, without_prefix
from ..guards.undo import Undo, attributes, undo_all, undone_on_error
from ..interface import (
    Belief,
    MapView,
    ScanDecisions,
    SlamEstimator,
    SupportsPoses,
    UpdateReport,
    advance,
    bookmark,
    mapped_ids,
    marginal,
    optional_members,
    resume,
    snapshot,
    taking_poses,
    view_map,
)
from ..models.motions import UNICYCLE, MotionNoise
from ..models.rigid_motion import rotation
from .loop_closing import AROUND, FEWEST_READINGS, is_astray, places_of_scan
from .map_editor import MapEditor
from .policy import LandmarkPolicy, as_policy
from .pruning import LandmarkRecords, MapPruner
from .recent_scans import FedScans, RecentScans


class ManagedFilter:
    """The results of a managed filter: those of its most probable hypothesis."""

    _policy: LandmarkPolicy

    @property
    def best(self) -> ManagedSlam:
        """The filter of the most probable hypothesis."""
        raise NotImplementedError

    @property
    def policy(self) -> LandmarkPolicy:
        """The policy that decides about landmarks."""
        return self._policy

    @property
    def filter(self) -> SlamEstimator:
        """The filter inside."""
        return self.best._filter

    @property
    def tentative_landmarks(self) -> Array:
        """Estimated positions of tentative landmarks, shape (t, 2) [m]."""
        places = self.best.candidates.tentative.places
        x, y, heading = self.best._editor.map_view().mean[:3]
        return np.asarray(places @ rotation(heading).T + (x, y))

    @property
    def lost_score(self) -> float:
        """Evidence that the run is lost, see `LostEvidence` [-]; 0 at the start."""
        return self.best.candidates.detections.lost.largest

    @property
    def probably_lost(self) -> bool:
        """Whether the run is probably lost: `lost_score` is above `LOST_SCORE`."""
        return self.lost_score > LOST_SCORE

    @property
    def decisions(self) -> list[ScanDecisions]:
        """The decisions about the scans since the start or the last loaded state."""
        return self.best._recent.decisions

    @property
    def landmark_ids(self) -> tuple[int, ...]:
        """The mapped landmarks, in the order of the belief."""
        return mapped_ids(self.filter)

    def belief(self, landmark_ids: Sequence[int] | None = None) -> Belief:
        """Return the present belief, of the whole map or of pose and some landmarks."""
        if landmark_ids is None:
            return self.filter.belief()
        return marginal(self.filter, landmark_ids)

    def map_view(self) -> MapView:
        """Return pose and map, without a copy where possible, until the next step."""
        return view_map(self.filter)

    def report(self) -> UpdateReport:
        """Return the report of the last update once more."""
        return self.best._report


class ManagedSlam(ManagedFilter):
    """A filter of any kind that associates, confirms, removes and merges landmarks.

    A :class:`LandmarkPolicy` decides which landmark each reading belongs to, when a new
    landmark is confirmed, and which landmarks to merge or to remove.

    Parameters
    ----------
    estimator : callable
        Makes the filter, from the keywords below; a class will do.
    motion_std, measurement_std
        As every filter takes them.
    management : LandmarkPolicy, mapping or True
        The policy, its fields, or True for the default one.
    **options
        Those of the filter, ``initial_pose`` and ``initial_pose_std`` among them.

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
        **options: Any,
    ) -> None:
        self._policy = as_policy(management)
        noise = {"motion_std": motion_std, "measurement_std": measurement_std}
        self._filter = estimator(**noise, **options)
        self._sensor = AssociationSensor.checked(measurement_std, options)
        motion = options.get("motion", UNICYCLE)
        at_rest = options.get("noise_at_rest", True)
        self._motion_noise = MotionNoise.checked(motion_std, at_rest, motion)
        merging = self._policy.merge_within is not None
        self._editor = MapEditor(self._filter, merging=merging)
        self._pruner = MapPruner(self._policy, self._editor, self._sensor.noise)
        #: Landmarks that are not in the map yet.
        self.candidates = Candidates()
        #: Number of steps taken.
        self.steps = 0
        self._report = UpdateReport()
        self._recent = RecentScans(self._filter, self._editor, self._policy)
        for name, member in optional_members(self._filter).items():
            setattr(self, name, member)

    @property
    def best(self) -> ManagedSlam:
        """The filter itself, which follows one hypothesis."""
        return self

    def reset(self, pose: ArrayLike, pose_std: ArrayLike) -> None:
        """Start a new run, without a map, at a pose (3,) with deviations (3,)."""
        with undone_on_error(self.bookmark()):
            self._filter.reset(pose, pose_std)
            self._editor.expire()
            self._pruner.records = LandmarkRecords()
            self.candidates = Candidates()
            self._recent.forget()
            self._report = UpdateReport()

    def predict(self, odometry: ArrayLike, dt: float = 1.0) -> None:
        """Move by odometry (d, α) [m, rad], dt multiplies its noise variance."""
        reading = argument_checks.pair("odometry", odometry)
        if type(dt) is not float or dt != 1.0:
            argument_checks.duration(dt)
        candidates, noise = self.candidates, self._motion_noise
        displacement = noise.motion.moved(reading)
        if len(candidates.tentative.seen):
            variance = noise.over(displacement, dt)
            moved = candidates.tentative.moved(displacement, variance)
            candidates = candidates._replace(tentative=moved)

        def follow(_: object) -> None:
            self._editor.expire()
            self.candidates = candidates
            self._recent.note_motions((*reading, dt))
            self.steps += 1

        step = partial(self._filter.predict, reading, dt)
        undo = attributes(self, self._recent)
        advance(self._filter, step, follow, undo, lambda: undo)

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
        with undone_on_error(self.bookmark_views(), unless_moved=self):
            if landmark_ids is None:
                plan = self.alternatives(readings)[0][1]()
            else:
                given = argument_checks.identities(landmark_ids, len(readings))
                plan = self.as_given(readings, given)
            return self.take(readings, plan)

    def observe_pose(
        self, reading: ArrayLike, matrix: ArrayLike, covariance: ArrayLike
    ) -> UpdateReport:
        """Correct the belief with a reading of the pose, as `EkfSlam.observe_pose`.

        Raises
        ------
        ValueError
            If an argument is malformed, or the filter does not take such readings;
            all is then as before.
        """
        given = PoseReading.checked(reading, matrix, covariance)

        def follow(report: UpdateReport) -> UpdateReport:
            self._editor.expire()
            self._recent.note_motions(*given.rows())
            self._report = report
            self.steps += 1
            return report

        step = partial(taking_poses(self._filter).observe_pose, *given)
        undo = attributes(self, self._recent)
        return advance(self._filter, step, follow, undo, lambda: undo)

    def as_given(self, readings: Array, ids: Sequence[int]) -> ScanAssociation:
        """Associate readings (m, 2) by their identities, which must differ."""
        plan = ScanAssociation(self._policy, self.candidates, readings)
        view = self._pruner.view_around(readings)
        plan.translate(ids, view.mapped, self._pruner.records.aliases)
        return plan

    def alternatives(self, readings: Array, ceiling: float = np.inf) -> list[Option]:
        """Associate readings (m, 2) without identity, in every way to consider.

        Of those that cost more than ``ceiling`` only the most likely is of interest.
        """
        argument_checks.refuse_unusable(readings)
        known, view = self.candidates, self._pruner.view_for(readings)
        return associate(self._policy, known, readings, view, self._sensor, ceiling)

    def is_astray(self, readings: Array) -> bool:
        """Return whether a scan (m, 2) finds the robot astray in its map."""
        rules = self._policy.constellations
        if rules is None or not len(readings):
            return False
        return is_astray(self._pruner.view_around(readings), rules)

    def deferred(
        self, readings: Array, cost: float, best: Callable[[], ScanAssociation]
    ) -> list[Option]:
        """Return an option that leaves the decision about a scan to later ones.

        It leaves out all readings, and costs as much as the best association.  There is
        none if this one uses enough landmarks to recognise a place.
        """
        if sum(i is not None for i in best().row_ids) >= FEWEST_READINGS:
            return []
        plan = ScanAssociation(self._policy, self.candidates, readings)
        plan.explained.update(self._pruner.view_around(readings).ids)
        plan.ambiguous_rows.extend(range(len(readings)))
        return [(cost, lambda: plan)]

    def places_of_scan(self, readings: Array) -> list[tuple[Array, IntArray]]:
        """Return places that a scan (m, 2) shows to a robot that is astray.

        A filter whose belief cannot be moved observes its absolute pose there: only
        landmarks of accurate absolute position count.
        """
        view, rules = self._pruner.view_around(readings), self._policy.constellations
        assert rules is not None  # else the robot is not astray
        noise, min_range = self._sensor
        places = places_of_scan(view, readings, noise, rules, min_range)
        if not places or self._editor.can_move:
            return places
        if not isinstance(self._filter, SupportsPoses):
            return []
        spread = np.trace(view.landmark_covariances, axis1=1, axis2=2)
        return [place for place in places if spread[place[1]].max() <= AROUND[0, 0] / 4]

    def move_to(self, pose: Array, slots: IntArray) -> list[UpdateReport]:
        """Correct the belief with a place that a scan has shown."""
        if not self._editor.can_move:
            # The heading first: a large turn and a shift together are not linear.
            axes, parts = np.eye(3), (slice(2, 3), slice(2))
            readings = [(pose[k], axes[k], AROUND[k, k]) for k in parts]
            return [self.observe_pose(*reading) for reading in readings]
        part = observe_relative_pose(self._filter.belief(), pose, slots, AROUND)
        self._editor.replace_belief(part.mean, part.covariance)
        # The scans before cannot be repeated, since the place would not be.
        self._recent.scans, self._recent.motions = [], ()
        return [part.report()]

    def take(self, readings: Array, plan: ScanAssociation) -> UpdateReport:
        """Correct the belief with readings (m, 2) as associated, then prune the map."""
        missed = self._pruner.expected(readings) - plan.explained
        fed = self._recent.with_scan(readings, plan)
        step = partial(self._recent.feed, fed)
        follow = partial(self._follow, readings, fed, missed)
        if fed.first is None:
            return advance(self._filter, step, follow, undo_all(), self.bookmark)
        # The filter repeats its steps since a saved state, in new arrays.
        with undone_on_error(self.bookmark()):
            return follow(step())

    def _follow(
        self, readings: Array, fed: FedScans, missed: set[int], report: UpdateReport
    ) -> UpdateReport:
        """Do what follows an update of the filter; return the whole report."""
        plan = fed.plan
        self._recent.note_scan(fed, report)
        self._editor.expire()
        view = self._pruner.view_around(readings)
        self.candidates = plan.candidates_after(view)
        made = self.decisions[-1]
        seen = set(view.ids).intersection(made.row_ids)
        if plan.confirmed:  # the filter may refuse the last sighting of a new one
            seen -= {*report.rejected_ids, *report.skipped_ids}
        removed, merged = self._pruner.prune(readings, plan, seen, missed)
        self._recent.note_edits(removed, merged)
        self._report = report.completed(
            removed_ids=tuple(removed),
            merged_ids=tuple(merged),
            confirmed_ids=tuple(i for i in made.added if i in plan.confirmed),
            row_ids=tuple(plan.row_ids),
            tentative_rows=tuple(plan.tentative_rows),
            ambiguous_rows=tuple(plan.ambiguous_rows),
        )
        self.steps += 1
        return self._report

    def remove(self, landmark_ids: LandmarkIds) -> None:
        """Marginalise mapped landmarks by hand, shape (n,); all else stays."""
        ids = argument_checks.mapped_identities(landmark_ids, {*self.landmark_ids})
        with undone_on_error(self.bookmark()):
            self._recent.note_edits(self._pruner.remove(ids), ())

    def merge(self, kept: int, gone: int) -> None:
        """Merge two mapped landmarks by hand; both identities then name the first."""
        argument_checks.two_landmarks(kept, gone, self.landmark_ids)
        with undone_on_error(self.bookmark()):
            self._pruner.join([(kept, gone)])
            self._recent.note_edits((), [(kept, gone)])

    def state_dict(self) -> dict[str, Any]:
        """Return the filter's state and the records of landmarks, as arrays."""
        return {
            "estimator": np.array(type(self).__name__),
            **with_prefix("landmarks", self._pruner.records.state_dict()),
            **with_prefix("tentative", self.candidates.state_dict()),
            **with_prefix("recent", self._recent.state_dict()),
            **with_prefix("filter", self._filter.state_dict()),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from a saved state, bit for bit under the same settings.

        An error leaves all as before.
        """
        saved_states.refuse_other_state(state, (), estimator=type(self).__name__)
        candidates = Candidates.from_state_dict(without_prefix(state, "tentative"))
        with undone_on_error(self.bookmark()):
            self._pruner.records.load_state_dict(without_prefix(state, "landmarks"))
            self._recent.load_state_dict(without_prefix(state, "recent"))
            self._filter.load_state_dict(without_prefix(state, "filter"))
            self._editor.expire()
            self.candidates, self._report = candidates, UpdateReport()

    def forget_scans(self) -> None:
        """Free the memory of the last scans, of a filter that nobody uses."""
        self._recent.forget()

    def bookmark(self) -> Undo:
        """Return what takes back later calls, as far as no kernel has run."""
        parts = self._recent.bookmark(), self._editor.bookmark()
        own = attributes(self, self._pruner, self._pruner.records)
        return undo_all(*parts, bookmark(self._filter), own)

    def bookmark_views(self) -> Undo:
        """Return what takes back that associations have looked at the map."""
        return self._editor.bookmark()

    def snapshot(self) -> tuple[Any, ...]:
        """Return the present state, decisions included, for :meth:`resume`."""
        kept = self.candidates, self.steps, self._report
        parts = self._pruner.records.state(), self._recent.state()
        return snapshot(self._filter), *parts, *kept

    def resume(self, before: tuple[Any, ...]) -> None:
        """Return to a :meth:`snapshot` of a filter with the same settings."""
        inside, records, recent, self.candidates, self.steps, self._report = before
        resume(self._filter, inside)
        self._pruner.records.restore(records)
        self._recent.restore(recent)
        self._editor.expire()

    def __repr__(self) -> str:
        return f"Managed {self._filter!r}"
