"""Manage the landmarks of any filter by a policy: `ManagedSlam`.

A managed filter associates readings without identity, confirms tentative landmarks,
and prunes its map after each scan.  It holds a list of hypotheses, one or many.  Each
is one sequence of associations, with a filter that follows it.  The decisions about a
scan are one record, `ScanAssociation`: `associate` begins it, the update of the filter
completes it, and the map is pruned by it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import islice
from math import log
from operator import itemgetter
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ... import argument_checks
from ...argument_checks import LandmarkIds
from ...arrays import Array, IntArray
from ..association.missed_landmarks import LOST_SCORE
from ..association.scan_assignments import AssociationSensor
from ..association.scan_association import (
    Candidates,
    Option,
    ScanAssociation,
    associate,
)
from ..association.tentative_landmarks import TentativeLandmarks
from ..filters.pose_readings import PoseReading, observe_relative_pose
from ..guards import saved_states
from ..guards.interrupts import changing
from ..guards.saved_states import with_prefix, without_prefix
from ..interface import (
    FilterWrapper,
    MapView,
    ScanDecisions,
    SlamEstimator,
    UpdateReport,
    resume,
    snapshot,
    taking_poses,
    view_map,
)
from ..models.bearing_range import wrap_angle
from ..models.motions import UNICYCLE, MotionNoise
from ..models.rigid_motion import rotation
from .clear_scans import SPREAD, ClearScan, ClearScans, Marginals, is_near, marginals_of
from .loop_closing import AROUND, FEWEST_READINGS, is_astray, places_of_scan
from .map_editor import MapEditor
from .policy import LandmarkPolicy, as_policy
from .pruning import LandmarkRecords, MapPruner
from .recent_scans import FedScans, RecentScans

# `benchmarks/association.py` counts the bad runs that these limits decide.

#: Number of associations tried in a scan, for each hypothesis kept.
TRIED = 4

#: Largest number of hypotheses whose poses overlap.
MOST_OVERLAPPING = 3

#: Largest number of hypotheses that are astray and searched for places.
MOST_ASTRAY = 3

#: Least variance of a pose that counts, against rounding [m², rad²].
NIL = 1e-12

#: Two poses overlap up to this Bhattacharyya distance in every coordinate: for equal σ,
#: means 2 σ apart.
OVERLAP = 0.5


class ManagedSlam(FilterWrapper):
    """A filter of any kind that associates, confirms, removes and merges landmarks.

    A :class:`LandmarkPolicy` decides which landmark each reading belongs to, when a new
    landmark is confirmed, and which landmarks to merge or to remove.

    With the association "hypotheses", each hypothesis splits into the most likely joint
    assignments of a scan.  The costs of the scans are added.  Hypotheses beyond the
    number that the policy allows, and those e^20 times less probable than the best one,
    are discarded [1]_, and so are variants of the better ones whose poses overlap with
    theirs.  The belief and the reports are those of the most probable hypothesis.  With
    any other association, there is one.

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

    References
    ----------
    .. [1] D. Reid, An algorithm for tracking multiple targets, IEEE Transactions on
       Automatic Control 24, 1979.

    Examples
    --------
    >>> from slamgym.estimator import EkfSlam
    >>> slam = ManagedSlam(EkfSlam, (0.1, 0.1, 0.05), (0.02, 0.1), management=True)
    >>> for _ in range(3):
    ...     report = slam.update([(0.5, 4.0)])
    >>> report.confirmed_ids, slam.belief().landmark_ids, len(slam.hypotheses)
    ((0,), (0,), 1)
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
        policy = _settled(as_policy(management), estimator)
        noise = {"motion_std": motion_std, "measurement_std": measurement_std}
        self._estimator = partial(estimator, **noise, **options)
        first = self._estimator()
        sensor = AssociationSensor.checked(measurement_std, options)
        motion = options.get("motion", UNICYCLE)
        at_rest = options.get("noise_at_rest", True)
        noise_of_motion = MotionNoise.checked(motion_std, at_rest, motion)
        self._settings = SharedSettings(policy, sensor, noise_of_motion)
        self._hypotheses = [Hypothesis(first, self._settings)]
        #: All hypotheses made so far, and those of them that are not in use.
        self._made = self._hypotheses
        self._spare: list[Hypothesis] = []
        #: Number of steps taken.
        self.steps = 0
        if policy.association == "hypotheses":
            self.passes_on = False

    # The results, which are those of the most probable hypothesis.

    @property
    def hypotheses(self) -> list[Hypothesis]:
        """The hypotheses, the most probable first."""
        self.refuse_interrupted()
        return self._hypotheses

    @property
    def best(self) -> Hypothesis:
        """The most probable hypothesis."""
        return self.hypotheses[0]

    @property
    def filter(self) -> SlamEstimator:
        """Its filter."""
        return self.best.filter

    _inside = filter

    @property
    def policy(self) -> LandmarkPolicy:
        """The policy that decides about landmarks."""
        return self._settings.policy

    @property
    def tentative_landmarks(self) -> Array:
        """Estimated positions of tentative landmarks, shape (t, 2) [m]."""
        places = self.best.candidates.tentative.places
        x, y, heading = self.best.editor.map_view().mean[:3]
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
        return self.best.recent.decisions

    def report(self) -> UpdateReport:
        """Return the report of the last update once more."""
        return self.best.report

    def reset(self, pose: ArrayLike, pose_std: ArrayLike) -> None:
        """Start a new run, without a map, at a pose (3,) with deviations (3,)."""
        self._change_best("reset", lambda best: best.reset(pose, pose_std), anew=True)

    def predict(self, odometry: ArrayLike, dt: float = 1.0) -> None:
        """Move by odometry (d, α) [m, rad], dt multiplies its noise variance."""
        reading = argument_checks.pair("odometry", odometry)
        if type(dt) is not float or dt != 1.0:
            argument_checks.duration(dt)
        # Refused here if it is not finite, before a filter that checks less has moved.
        displacement = self._settings.motion_noise.motion.moved_by(*reading)
        with changing(self, "predict"):
            first, *others = self._hypotheses
            first.predict(reading, dt, displacement)  # it refuses what all would
            self.steps += 1
            for h in others:
                h.predict(reading, dt, displacement)

    def update(
        self, measurements: ArrayLike, landmark_ids: LandmarkIds | None = None
    ) -> UpdateReport:
        """Associate one scan, correct the belief with it, then prune the map.

        A hypothesis whose filter refuses the scan is discarded, as long as another one
        takes it.

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
        readings, ids = argument_checks.scan(measurements), None
        if landmark_ids is not None:
            count = len(readings)
            ids = argument_checks.identity_array(landmark_ids, count, None)
        with changing(self, "update"):
            report = self._update_clear(readings, ids)
            if report is not None:
                return report
        with self._changing("update"):
            if ids is None:
                return self._update_by(self._branches(readings))
            names: list[int] = ids.tolist()
            argument_checks.refuse_repeated(names)
            given = [
                Branch(h.cost, h, partial(h.as_given, readings, names))
                for h in self._hypotheses
            ]
            return self._update_by(given)

    def observe_pose(
        self, reading: ArrayLike, matrix: ArrayLike, covariance: ArrayLike
    ) -> UpdateReport:
        """Correct every hypothesis with a reading of the pose.

        Its cost, νᵀ S⁻¹ ν + ln det S, is added to that of the hypothesis, unless the
        gate of the best one rejects it.  Parameters and report are those of
        `EkfSlam.observe_pose`.

        Raises
        ------
        ValueError
            If an argument is malformed, or the filter does not take such readings;
            all is then as before.
        """
        given = PoseReading.checked(reading, matrix, covariance)
        with changing(self, "observe_pose"):
            every = self._hypotheses
            costs = [h.cost for h in every]
            reports = [every[0].observe_pose(given)]  # it refuses what all would
            self.steps += 1
            reports += [h.observe_pose(given) for h in every[1:]]
            if reports[0].degrees_of_freedom:
                pairs = zip(costs, reports, strict=True)
                costs = [cost + cost_of(report) for cost, report in pairs]
            ranked = sorted(zip(costs, every, strict=True), key=itemgetter(0))
            return self._continue_with(ranked)

    def remove(self, landmark_ids: LandmarkIds) -> None:
        """Marginalise mapped landmarks by hand, shape (n,); all else stays.

        Only the best hypothesis continues.
        """
        ids = argument_checks.mapped_identities(landmark_ids, {*self.landmark_ids})
        self._change_best("remove", lambda best: best.remove(ids))

    def merge(self, kept: int, gone: int) -> None:
        """Merge two mapped landmarks by hand; both identities then name the first.

        Only the best hypothesis continues.
        """
        argument_checks.two_landmarks(kept, gone, self.landmark_ids)
        self._change_best("merge", lambda best: best.merge(kept, gone))

    def state_dict(self) -> dict[str, Any]:
        """Return the state of every hypothesis, as arrays."""
        state: dict[str, Any] = {
            "estimator": np.array(type(self).__name__),
            "costs": np.array([h.cost for h in self.hypotheses]),
        }
        for k, hypothesis in enumerate(self.hypotheses):
            state |= with_prefix(str(k), hypothesis.state_dict())
        return state

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from a saved state, bit for bit under the same settings.

        Raises
        ------
        ValueError
            If the state lacks an entry, or belongs to another estimator; all is then as
            before.
        """
        saved_states.refuse_other_state(state, (), estimator=type(self).__name__)
        table = {"costs": (saved_states.NUMBERS, -1)}
        costs = saved_states.read(state, table)["costs"].tolist()
        if not costs or costs[0] < 0 or costs != sorted(costs):
            raise ValueError(f"state['costs'] must be >= 0 and ascend, got {costs}")
        with self._changing("load_state_dict", anew=True):
            # In place where there is one: members of its filter are passed on.
            best = self._hypotheses[0]
            self._spare = [h for h in self._made if h not in self._hypotheses]
            loaded = [best, *(self._fresh() for _ in costs[1:])]
            for k in reversed(range(len(costs))):  # last the one in use
                loaded[k].load_state_dict(without_prefix(state, str(k)))
            self._continue_with([*zip(costs, loaded, strict=True)])

    def snapshot(self) -> tuple[Any, ...]:
        """Return the present state of every hypothesis, for :meth:`resume`."""
        return [(h.cost, h.snapshot()) for h in self.hypotheses], self.steps

    def resume(self, before: tuple[Any, ...]) -> None:
        """Return to a :meth:`snapshot` of a filter with the same settings."""
        kept, steps = before
        with changing(self, "resume", anew=True):
            for hypothesis in self._hypotheses:
                hypothesis.recent.forget()
            self._spare = self._made
            self._continue_with([(cost, self._resumed(own)) for cost, own in kept])
            self.steps = steps

    def __repr__(self) -> str:
        count = len(self.hypotheses)
        several = f", best of {count} hypotheses" if count > 1 else ""
        return f"Managed {self.filter!r}{several}"

    # A clear scan: one way to associate it in each hypothesis, see `ClearScans`.

    def _update_clear(
        self, readings: Array, ids: IntArray | None
    ) -> UpdateReport | None:
        """Update by a scan if it is clear in every hypothesis; else return None."""
        if len(self._hypotheses) == 1:
            return self._update_alone(self._hypotheses[0], readings, ids)
        taken: list[tuple[float, Hypothesis]] = []
        for cost, h, scan in self._clear_branches(readings, ids):
            if h.update_clear(scan):
                self.steps += not taken  # so that a later error leaves the mark
                taken.append((cost, h))
        if not taken:
            return None
        chosen = distinct([h for _, h in taken], self.policy.hypotheses)
        return self._continue_with([pair for pair in taken if pair[1] in chosen])

    def _update_alone(
        self, h: Hypothesis, readings: Array, ids: IntArray | None
    ) -> UpdateReport | None:
        """Update the only hypothesis by a scan if it is clear; else return None."""
        scan = h.associate_clear(readings, ids, np.inf, True)
        if scan is None:
            return None
        self.steps += scan.counted > 0  # so that a later error leaves the mark
        if not h.update_clear(scan):
            return None
        self.steps += scan.counted == 0
        return h.report

    def _clear_branches(
        self, readings: Array, ids: IntArray | None
    ) -> Sequence[ClearBranch]:
        """Return the best association in each hypothesis; none if it is not clear."""
        ceiling, others = np.inf, 0
        ranked: list[ClearBranch] = []
        for h in self._hypotheses:
            scan = h.associate_clear(readings, ids, ceiling - h.cost, False)
            if scan is None:
                return ()
            ranked.append((h.cost + scan.costs[0], h, scan))
            ceiling = min(ceiling, ranked[-1][0] + SPREAD)
            others += len(scan.costs) - 1
        ranked = sorted([r for r in ranked if r[0] <= ceiling], key=itemgetter(0))
        return () if others and self._is_split(ranked, ceiling) else ranked

    def _is_split(self, ranked: Sequence[ClearBranch], ceiling: float) -> bool:
        """Return whether a scan that seemed clear splits one of these hypotheses."""
        others = [(h, cost) for _, h, scan in ranked for cost in scan.costs[1:]]
        if not [cost for h, cost in others if cost <= ceiling - h.cost]:
            return False
        tried = [
            (h.cost + cost, k, (belief, scan.following.labels.tobytes()))
            for _, h, scan in ranked
            for k, (cost, belief) in enumerate(h.tried(scan, ceiling - h.cost))
        ]
        tried.sort(key=itemgetter(0))
        kept = differing([belief for *_, belief in tried], self.policy.hypotheses)
        return any(tried[n][1] for n in kept)

    # One scan: all ways to associate it.  The most probable ones continue.

    def _branches(self, readings: Array) -> list[Branch]:
        """Return the best associations of a scan, the cheapest first."""
        every, policy = self._hypotheses, self.policy
        if policy.association != "hypotheses":
            return [Branch(h.cost, h, h.alternatives(readings)[0][1]) for h in every]
        astray = [h for h in every if h.is_astray(readings)]
        branches: list[Branch] = []
        most, ceiling = TRIED * policy.hypotheses, np.inf
        for h in [*every, *self._at_places(readings, astray)]:
            found = h.alternatives(readings, ceiling - h.cost)
            if h in astray:
                found += h.deferred(readings, *found[0])
            branches += [Branch(h.cost + cost, h, plan) for cost, plan in found]
            branches.sort(key=itemgetter(0))
            ceiling = branches[0].cost + SPREAD
            branches = [b for b in branches[:most] if b.cost <= ceiling]
            if len(branches) == most:
                ceiling = branches[-1].cost
        return branches

    def _at_places(
        self, readings: Array, astray: Sequence[Hypothesis]
    ) -> list[Hypothesis]:
        """Return the parts of hypotheses around the places that a scan shows.

        The part around a pose c among landmarks is the prior times exp(−½ ‖z − c‖²) in
        the metric of R, where z is the pose relative to them.  Its weight is that of c
        in the prior of z with R added, relative to N(0; 0, R).
        """
        parts: list[Hypothesis] = []
        found = ((h, h.places_of_scan(readings)) for h in astray)
        for h, places in islice(filter(itemgetter(1), found), MOST_ASTRAY):
            for place in places:
                part = self._resumed(h.snapshot())
                reports = part.move_to(*place)
                # The gate of the filter may refuse the place.
                if all(report.degrees_of_freedom for report in reports):
                    cost = sum(map(cost_of, reports)) - log(np.linalg.det(AROUND))
                    part.cost = h.cost + cost
                    parts.append(part)
        return parts

    def _update_by(self, branches: Sequence[Branch]) -> UpdateReport:
        """Update filters by their associations, and continue with the best of them."""
        plans = [branch.complete() for branch in branches]
        every: list[Hypothesis] = []
        for _, h, _ in branches:  # copied where a hypothesis splits
            every.append(self._resumed(h.snapshot()) if h in every else h)
        taken: list[tuple[float, Hypothesis, FedScans, UpdateReport]] = []
        errors: list[Exception] = []
        for branch, h, plan in zip(branches, every, plans, strict=True):
            try:
                taken.append((branch.cost, h, *h.feed(plan)))
            except Exception as error:
                errors.append(error)
        if not taken:
            raise errors[0]
        self.steps += 1
        kept: list[tuple[float, Hypothesis]] = []
        for cost, h, fed, report in taken:
            h.follow(fed, report)
            kept.append((cost + fed.plan.price, h))
        kept.sort(key=itemgetter(0))
        chosen = distinct([h for _, h in kept], self.policy.hypotheses)
        return self._continue_with([pair for pair in kept if pair[1] in chosen])

    def _continue_with(
        self, ranked: Sequence[tuple[float, Hypothesis]]
    ) -> UpdateReport:
        """Continue with hypotheses and their costs, the best first; return its report.

        All others are reused later.
        """
        used = [hypothesis for _, hypothesis in ranked]
        for cost, hypothesis in ranked:
            hypothesis.cost = cost - ranked[0][0]
        spare = [h for h in self._made if h not in used]
        for hypothesis in {*spare}.difference(self._spare):
            hypothesis.recent.forget()
        self._hypotheses, self._spare = used, spare
        return used[0].report

    def _fresh(self) -> Hypothesis:
        """Return a hypothesis that is not in use, in any state."""
        if not self._spare:
            self._spare = [Hypothesis(self._estimator(), self._settings)]
            self._made = [*self._made, *self._spare]
        *self._spare, hypothesis = self._spare
        return hypothesis

    def _resumed(self, before: tuple[Any, ...]) -> Hypothesis:
        """Return a hypothesis that was not in use, continuing from a snapshot."""
        hypothesis = self._fresh()
        hypothesis.resume(before)
        return hypothesis

    def _change_best(
        self, call: str, change: Callable[[Hypothesis], None], *, anew: bool = False
    ) -> None:
        """Change the best hypothesis; only this one continues."""
        with self._changing(call, anew=anew):
            best = self._hypotheses[0]
            change(best)
            self._continue_with([(0.0, best)])

    def _changing(self, call: str, *, anew: bool = False) -> changing:
        """Return a block of changes; a refusal takes back what was viewed before it."""
        every = self._hypotheses
        views = [h.editor.viewed for h in every]

        def undo() -> None:
            for hypothesis, viewed in zip(every, views, strict=True):
                hypothesis.editor.viewed = viewed
            self._spare = [h for h in self._made if h not in every]

        return changing(self, call, undo, anew=anew)


def filter_in(slam: SlamEstimator) -> SlamEstimator:
    """Return the filter of the most probable hypothesis; else the estimator itself."""
    return slam.filter if isinstance(slam, ManagedSlam) else slam


class SharedSettings(NamedTuple):
    """What all hypotheses of a filter have in common."""

    policy: LandmarkPolicy
    sensor: AssociationSensor
    motion_noise: MotionNoise


class Branch(NamedTuple):
    """One way to associate a scan in one hypothesis."""

    #: −2 ln of the probability, with that of the hypothesis.
    cost: float
    hypothesis: Hypothesis
    #: Completes the association.
    complete: Callable[[], ScanAssociation]


def _settled(
    policy: LandmarkPolicy, estimator: Callable[..., SlamEstimator]
) -> LandmarkPolicy:
    """Return a policy that names the association, where it says "auto"."""
    if policy.association != "auto":
        return policy
    made = estimator.func if isinstance(estimator, partial) else estimator
    one = hasattr(made, "local_view") or hasattr(made, "observe_truth")
    return replace(policy, association="joint" if one else "hypotheses")


#: A clear scan in one hypothesis, and the cost of both.
ClearBranch = tuple[float, "Hypothesis", ClearScan]


class Hypothesis:
    """One sequence of associations, and the filter that has followed it.

    Parameters
    ----------
    slam : SlamEstimator
        The filter.
    settings : SharedSettings
        Those of all hypotheses.
    """

    def __init__(self, slam: SlamEstimator, settings: SharedSettings) -> None:
        policy, sensor, self.motion_noise = settings
        self.policy, self.sensor = policy, sensor
        self.filter = slam
        #: −2 ln of its probability, relative to the best hypothesis.
        self.cost = 0.0
        self.editor = MapEditor(slam, merging=policy.merge_within is not None)
        self.pruner = MapPruner(policy, self.editor, sensor.noise)
        self.recent = RecentScans(slam, self.editor, policy)
        self._clear: ClearScans | None = None
        if ClearScans.serve(slam, policy):
            self._clear = ClearScans(slam, policy, sensor, self.recent)
        self._candidates = Candidates()
        #: After a clear scan this scan: the filter can return the report once more.
        self._report: UpdateReport | ClearScan = UpdateReport()

    @property
    def candidates(self) -> Candidates:
        """Landmarks that are not in the map yet, and what the scans have shown."""
        if self._clear is not None:
            self._candidates = self._clear.renew(self._candidates, self.pruner.records)
        return self._candidates

    @candidates.setter
    def candidates(self, changed: Candidates) -> None:
        if self._clear is not None:
            self._clear.forget()
        self._candidates = changed

    @property
    def report(self) -> UpdateReport:
        """The report of the last update."""
        scan = self._report
        if isinstance(scan, UpdateReport):
            return scan
        slam: Any = self.filter
        report: UpdateReport = slam.report()
        return report.completed(
            row_ids=scan.row_ids,
            tentative_rows=scan.tentative_rows,
            ambiguous_rows=scan.ambiguous_rows,
        )

    @report.setter
    def report(self, report: UpdateReport) -> None:
        self._report = report

    @property
    def tentative(self) -> TentativeLandmarks:
        """The landmarks without an identity that are not in the map yet."""
        return self._candidates.tentative

    @tentative.setter
    def tentative(self, changed: TentativeLandmarks) -> None:
        self._candidates = self._candidates._replace(tentative=changed)

    def associate_clear(
        self, readings: Array, ids: IntArray | None, ceiling: float, alone: bool
    ) -> ClearScan | None:
        """Associate a scan (m, 2), by its identities if given; None if not clear."""
        if self._clear is None:
            return None
        known, records = self._candidates, self.pruner.records
        return self._clear.associate(readings, ids, ceiling, known, records, alone)

    def tried(self, scan: ClearScan, ceiling: float) -> list[tuple[float, Marginals]]:
        """Return the costs and the beliefs after all associations of a clear scan."""
        assert self._clear is not None
        return self._clear.tried(scan, ceiling)

    def update_clear(self, scan: ClearScan) -> bool:
        """Update by a clear scan as associated; return False if the filter refuses."""
        assert self._clear is not None
        if not self._clear.update(scan):
            return False
        self.editor.expire()
        if scan.following is not self._candidates.tentative:
            self.tentative = scan.following
        self._report = scan
        return True

    def _settle(self) -> None:
        """Complete what clear scans have left for later, before the map is edited."""
        self.candidates, self.report = self.candidates, self.report

    def map_view(self) -> MapView:
        """Return pose and map, without a copy where possible, until the next step."""
        return view_map(self.filter)

    def marginals(self) -> Marginals:
        """Return the belief without its correlations, until the next step."""
        if self._clear is not None:
            return self._clear.marginals()
        view = self.map_view()
        return marginals_of(view, view.ids)

    def reset(self, pose: ArrayLike, pose_std: ArrayLike) -> None:
        """Start a new run, without a map."""
        self.filter.reset(pose, pose_std)
        self.editor.expire()
        self.pruner.records = LandmarkRecords()
        self.candidates, self.report = Candidates(), UpdateReport()
        self.recent.forget()

    def predict(
        self,
        reading: tuple[float, float],
        dt: float,
        displacement: tuple[float, float, float],
    ) -> None:
        """Move by odometry (d, α), which is a displacement in the robot's frame."""
        self.filter.predict(reading, dt)
        self.editor.expire()
        if len(self._candidates.tentative.seen):
            variance = self.motion_noise.over(displacement, dt)
            self.tentative = self.tentative.moved(displacement, variance)
        self.recent.note_motions((*reading, dt))

    def observe_pose(self, given: PoseReading) -> UpdateReport:
        """Correct the belief with a reading of the pose."""
        self.report = taking_poses(self.filter).observe_pose(*given)
        self.editor.expire()
        self.recent.note_motions(*given.rows())
        return self.report

    def as_given(self, readings: Array, ids: Sequence[int]) -> ScanAssociation:
        """Associate readings (m, 2) by their identities, which must differ."""
        plan = ScanAssociation(self.policy, self.candidates, readings)
        view = self.pruner.view_around(readings)
        plan.translate(ids, view.mapped, self.pruner.records.aliases)
        return plan

    def alternatives(self, readings: Array, ceiling: float = np.inf) -> list[Option]:
        """Associate readings (m, 2) without identity, in every way to consider.

        Of those that cost more than ``ceiling`` only the most likely is of interest.
        """
        argument_checks.refuse_unusable(readings)
        known, view = self.candidates, self.pruner.view_for(readings)
        return associate(self.policy, known, readings, view, self.sensor, ceiling)

    def is_astray(self, readings: Array) -> bool:
        """Return whether a scan (m, 2) finds the robot astray in its map."""
        rules = self.policy.constellations
        if rules is None or not len(readings):
            return False
        return is_astray(self.pruner.view_around(readings), rules)

    def deferred(
        self, readings: Array, cost: float, best: Callable[[], ScanAssociation]
    ) -> list[Option]:
        """Return an option that leaves the decision about a scan to later ones.

        It leaves out all readings, and costs as much as the best association.  There is
        none if this one uses enough landmarks to recognise a place.
        """
        if sum(i is not None for i in best().row_ids) >= FEWEST_READINGS:
            return []
        plan = ScanAssociation(self.policy, self.candidates, readings)
        plan.explained.update(self.pruner.view_around(readings).ids)
        plan.ambiguous_rows.extend(range(len(readings)))
        return [(cost, lambda: plan)]

    def places_of_scan(self, readings: Array) -> list[tuple[Array, IntArray]]:
        """Return places that a scan (m, 2) shows to a robot that is astray.

        A filter whose belief cannot be moved observes its absolute pose there: only
        landmarks of accurate absolute position count.
        """
        view, rules = (self.pruner.view_around(readings), self.policy.constellations)
        assert rules is not None  # else the robot is not astray
        noise, min_range = self.sensor
        places = places_of_scan(view, readings, noise, rules, min_range)
        if not places or self.editor.can_move:
            return places
        if not hasattr(self.filter, "observe_pose"):
            return []
        spread = np.trace(view.landmark_covariances, axis1=1, axis2=2)
        return [place for place in places if spread[place[1]].max() <= AROUND[0, 0] / 4]

    def move_to(self, pose: Array, slots: IntArray) -> list[UpdateReport]:
        """Correct the belief with a place that a scan has shown."""
        if not self.editor.can_move:
            # The heading first: a large turn and a shift together are not linear.
            axes, parts = np.eye(3), (slice(2, 3), slice(2))
            readings = [(pose[k], axes[k], AROUND[k, k]) for k in parts]
            return [self.observe_pose(PoseReading.checked(*each)) for each in readings]
        part = observe_relative_pose(self.filter.belief(), pose, slots, AROUND)
        self.editor.replace_belief(part.mean, part.covariance)
        # The scans before cannot be repeated, since the place would not be.
        self.recent.scans, self.recent.motions = [], ()
        return [part.report()]

    def feed(self, plan: ScanAssociation) -> tuple[FedScans, UpdateReport]:
        """Correct the belief with a scan as associated; the filter may refuse it."""
        plan.missed = self.pruner.expected(plan.readings) - plan.explained
        fed = self.recent.with_scan(plan)
        return fed, self.recent.feed(fed)

    def follow(self, fed: FedScans, report: UpdateReport) -> None:
        """Do what follows :meth:`feed`: note the scan, and prune the map."""
        plan = fed.plan
        self.recent.note_scan(fed, report)
        self.editor.expire()
        view = self.pruner.view_around(plan.readings)
        self.candidates = plan.candidates_after(view)
        made = self.recent.decisions[-1]
        plan.seen = set(view.ids).intersection(made.row_ids)
        if plan.confirmed:  # the filter may refuse the last sighting of a new one
            plan.seen -= {*report.rejected_ids, *report.skipped_ids}
        removed, merged = self.pruner.prune(plan)
        self.recent.note_edits(removed, merged)
        self.report = report.completed(
            removed_ids=tuple(removed),
            merged_ids=tuple(merged),
            confirmed_ids=tuple(i for i in made.added if i in plan.confirmed),
            row_ids=tuple(plan.row_ids),
            tentative_rows=tuple(plan.tentative_rows),
            ambiguous_rows=tuple(plan.ambiguous_rows),
        )

    def remove(self, ids: list[int]) -> None:
        """Marginalise mapped landmarks; all else stays."""
        self._settle()
        self.recent.note_edits(self.pruner.remove(ids), ())

    def merge(self, kept: int, gone: int) -> None:
        """Merge two mapped landmarks; both identities then name the first."""
        self._settle()
        self.pruner.join([(kept, gone)])
        self.recent.note_edits((), [(kept, gone)])

    def state_dict(self) -> dict[str, Any]:
        """Return the filter's state and the records of landmarks, as arrays."""
        self._settle()
        return {
            **with_prefix("landmarks", self.pruner.records.state_dict()),
            **with_prefix("tentative", self.candidates.state_dict()),
            **with_prefix("recent", self.recent.state_dict()),
            **with_prefix("filter", self.filter.state_dict()),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from a saved state; a refusal changes nothing."""
        candidates = Candidates.from_state_dict(without_prefix(state, "tentative"))
        records = LandmarkRecords()
        records.load_state_dict(without_prefix(state, "landmarks"))
        recent = self.recent.checked(without_prefix(state, "recent"))
        self.filter.load_state_dict(without_prefix(state, "filter"))
        self.editor.expire()
        self.candidates, self.pruner.records = candidates, records
        self.recent.restore(recent)
        self.report = UpdateReport()

    def snapshot(self) -> tuple[Any, ...]:
        """Return the present state, decisions included, for :meth:`resume`."""
        kept = self.candidates, self.report
        parts = self.pruner.records.state(), self.recent.state()
        return snapshot(self.filter), *parts, *kept

    def resume(self, before: tuple[Any, ...]) -> None:
        """Return to a :meth:`snapshot` of another hypothesis of the same settings."""
        inside, records, recent, self.candidates, self.report = before
        resume(self.filter, inside)
        self.pruner.records.restore(records)
        self.recent.restore(recent)
        self.editor.expire()


def distinct(hypotheses: Sequence[Hypothesis], most: int) -> list[Hypothesis]:
    """Return the hypotheses that differ from all that are more probable."""
    if len(hypotheses) == 1:
        return [*hypotheses]
    beliefs = [(h.marginals(), h.tentative.labels.tobytes()) for h in hypotheses]
    return [hypotheses[k] for k in differing(beliefs, most)]


def differing(beliefs: Sequence[tuple[Marginals, bytes]], most: int) -> list[int]:
    """Return which beliefs differ from all before in the map or the labels.

    The effect of readings that were left out fades with time.  Of hypotheses with
    overlapping poses, which are variants of one decision, the most probable are
    returned only, so that they leave room for another decision.
    """
    maps = [belief for belief, _ in beliefs]
    variances = np.maximum([each.variances[:3] for each in maps], 0.0) + NIL
    poses = np.hstack([[each.mean[:3] for each in maps], variances]).tolist()
    chosen: list[int] = []
    for k, (belief, labels) in enumerate(beliefs):
        if len(chosen) == most:
            break
        overlapping = sum(_overlap(poses[n], poses[k]) for n in chosen)
        alike = (maps[n] for n in chosen if beliefs[n][1] == labels)
        is_variant = any(is_near(better, belief) for better in alike)
        if overlapping < MOST_OVERLAPPING and not is_variant:
            chosen.append(k)
    return chosen


def _overlap(one: Sequence[float], other: Sequence[float]) -> bool:
    """Return whether two poses overlap, each three means, then three variances.

    The Bhattacharyya distance of two Gaussians is, in one coordinate, ::

        (μ₂ − μ₁)² / 4 (σ₁² + σ₂²) + ½ ln ((σ₁² + σ₂²) / 2 σ₁σ₂)
    """
    for k in range(3):
        gap, variance, v = other[k] - one[k], one[k + 3], other[k + 3]
        apart = (wrap_angle(gap) if k == 2 else gap) ** 2 / (4 * (variance + v))
        apart += log((variance + v) ** 2 / (4 * variance * v)) / 4
        if not apart <= OVERLAP:
            return False
    return True


def cost_of(report: UpdateReport) -> float:
    """Return νᵀ S⁻¹ ν + ln det S of a reading, or SPREAD if it was rejected."""
    if not report.degrees_of_freedom:
        return SPREAD
    return report.nis + 2 * float(np.log(report.innovation_factor.diagonal()).sum())
