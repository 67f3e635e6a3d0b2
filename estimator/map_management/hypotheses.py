"""Several associations of the same readings, followed until one of them is clear."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice
from math import log
from operator import itemgetter
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ...arrays import Array
from ..association.scan_assignments import SAME
from ..association.scan_association import ScanAssociation
from ..filters.pose_readings import PoseReading
from ..guards import argument_checks, saved_states
from ..guards.argument_checks import LandmarkIds
from ..guards.saved_states import with_prefix, without_prefix
from ..guards.undo import Undo, attributes, to_the_end, undo_all, undone_on_error
from ..interface import Answer, MapView, SlamEstimator, UpdateReport
from ..models.bearing_range import wrap_angle
from .loop_closing import AROUND
from .managed_slam import ManagedFilter, ManagedSlam
from .policy import LandmarkPolicy, as_policy

#: Cost, the filter that takes it, and what completes the association.
Option = tuple[float, ManagedSlam, Callable[[], ScanAssociation]]

#: Hypotheses e^20 times less probable than the best one are discarded.
SPREAD = 40.0

#: Associations tried in a scan, for each hypothesis kept.
TRIED = 4

#: Most hypotheses whose poses overlap.
PER_BASIN = 3

#: Least variance of a pose that counts [m², rad²].
NIL = 1e-12

#: Two poses overlap up to this Bhattacharyya distance in every coordinate.
OVERLAP = 0.5


def manage(
    estimator: Callable[..., SlamEstimator],
    management: LandmarkPolicy | Mapping[str, Any] | bool,
) -> Callable[..., ManagedSlam | HypothesisSlam]:
    """Return what makes a filter managed by a policy, from the keywords of filters."""
    policy = as_policy(management)
    if policy.association == "auto":
        made = estimator.func if isinstance(estimator, partial) else estimator
        one = hasattr(made, "local_view") or hasattr(made, "observe_truth")
        policy = replace(policy, association="joint" if one else "hypotheses")
    kind = HypothesisSlam if policy.association == "hypotheses" else ManagedSlam
    return partial(kind, estimator, management=policy)


@dataclass
class Hypothesis:
    """One sequence of associations, and the filter that has followed it."""

    #: −2 ln of its probability, relative to the best hypothesis.
    cost: float
    slam: ManagedSlam


def distinct(hypotheses: Sequence[Hypothesis], most: int) -> list[Hypothesis]:
    """Return the hypotheses that differ from all that are more probable.

    The effect of readings that were left out fades with time.  Of hypotheses with
    overlapping poses, which are variants of one decision, the most probable are
    returned only, so that they leave room for another decision.
    """
    if len(hypotheses) == 1:
        return [*hypotheses]
    views = [h.slam.map_view() for h in hypotheses]
    variances = np.maximum([v.covariance.diagonal()[:3] for v in views], 0.0) + NIL
    poses = np.hstack([[v.mean[:3] for v in views], variances]).tolist()
    labels = [h.slam.candidates.tentative.labels.tobytes() for h in hypotheses]
    chosen: list[int] = []
    for k, view in enumerate(views):
        if len(chosen) == most:
            break
        overlapping = sum(_overlap(poses[n], poses[k]) for n in chosen)
        alike = (views[n] for n in chosen if labels[n] == labels[k])
        if overlapping < PER_BASIN and not any(is_near(v, view) for v in alike):
            chosen.append(k)
    return [hypotheses[k] for k in chosen]


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


def is_near(one: MapView, other: MapView) -> bool:
    """Return whether two maps of the same landmarks have nearly the same belief.

    In every coordinate with means μ₁, μ₂ and deviations σ₁, σ₂, the second belief must
    not be far off the first one and not be much less certain::

        (μ₂ − μ₁)² + σ₂² − σ₁² ≤ (SAME σ₁)²
    """
    if one.ids != other.ids:
        return False
    size = 3 + 2 * len(one.ids)
    gap = other.mean[:size] - one.mean[:size]
    gap[2] = wrap_angle(float(gap[2]))
    variances, others = (m.covariance.diagonal()[:size] for m in (one, other))
    return bool((gap**2 + others <= (1 + SAME**2) * variances).all())


def cost_of(report: UpdateReport) -> float:
    """Return νᵀ S⁻¹ ν + ln det S of a reading, or SPREAD if it was rejected."""
    if not report.degrees_of_freedom:
        return SPREAD
    return report.nis + 2 * float(np.log(report.innovation_factor.diagonal()).sum())


class HypothesisSlam(ManagedFilter):
    """A managed filter that follows several associations side by side.

    Each hypothesis splits into the most likely joint assignments of a scan.  The costs
    of the scans are added.  Hypotheses beyond the number that the policy allows, and
    those e^20 times less probable than the best one, are discarded (Reid 1979), and so
    are variants of the better ones whose poses overlap with theirs.  The belief and the
    reports are those of the most probable hypothesis.

    Parameters
    ----------
    estimator, motion_std, measurement_std, initial_pose, initial_pose_std, management
        As in `ManagedSlam`.
    **options
        Those of the filter.

    References
    ----------
    .. [1] D. Reid, An algorithm for tracking multiple targets, IEEE Transactions on
       Automatic Control 24, 1979.

    Examples
    --------
    >>> from slamgym.estimator import EkfSlam
    >>> slam = HypothesisSlam(
    ...     EkfSlam,
    ...     (0.1, 0.1, 0.05),
    ...     (0.02, 0.1),
    ...     management={"association": "hypotheses"},
    ... )
    >>> for _ in range(3):
    ...     report = slam.update([(0.5, 4.0)])
    >>> report.confirmed_ids, len(slam.hypotheses)
    ((0,), 1)
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
        noise = motion_std, measurement_std
        options |= {"management": self._policy}
        self._make = partial(ManagedSlam, estimator, *noise, **options)
        #: All filters, and those of them that no hypothesis uses.
        self._filters: list[ManagedSlam] = []
        self._spare: list[ManagedSlam] = []
        #: The hypotheses, the most probable first.
        self.hypotheses = [Hypothesis(0.0, self._fresh())]
        #: Number of steps taken.
        self.steps = 0

    @property
    def best(self) -> ManagedSlam:
        """The filter of the most probable hypothesis."""
        return self.hypotheses[0].slam

    def reset(self, pose: ArrayLike, pose_std: ArrayLike) -> None:
        """Start a new run, without a map, at a pose (3,) with deviations (3,)."""
        self._change_best(lambda best: best.reset(pose, pose_std))

    def predict(self, odometry: ArrayLike, dt: float = 1.0) -> None:
        """Move by odometry (d, α) [m, rad], dt multiplies its noise variance."""
        motion = argument_checks.pair("odometry", odometry)
        slams = self._slams
        self._carry_out(slams, lambda k: slams[k].predict(motion, dt), lambda: None)

    def observe_pose(
        self, reading: ArrayLike, matrix: ArrayLike, covariance: ArrayLike
    ) -> UpdateReport:
        """Correct every hypothesis with a reading of the pose.

        Its cost, νᵀ S⁻¹ ν + ln det S, is added to that of the hypothesis, unless the
        gate of the best one rejects it.  Parameters and report are those of
        `EkfSlam.observe_pose`.
        """
        given = PoseReading.checked(reading, matrix, covariance)
        before, slams = self.hypotheses, self._slams

        def then() -> UpdateReport:
            reports, after = [slam.report() for slam in slams], [*before]
            if reports[0].degrees_of_freedom:
                pairs = zip(before, reports, strict=True)
                after = [Hypothesis(h.cost + cost_of(r), h.slam) for h, r in pairs]
            return self._take_over(sorted(after, key=lambda h: h.cost))

        return self._carry_out(slams, lambda k: slams[k].observe_pose(*given), then)

    def update(
        self, measurements: ArrayLike, landmark_ids: LandmarkIds | None = None
    ) -> UpdateReport:
        """Associate one scan in every hypothesis, and correct the beliefs with it.

        Parameters and errors as in `ManagedSlam.update`.  A hypothesis whose
        filter fails is discarded, as long as another one succeeds.

        Returns
        -------
        UpdateReport
            That of the most probable hypothesis.
        """
        readings = argument_checks.scan(measurements)
        views = (h.slam.bookmark_views() for h in self.hypotheses)
        with undone_on_error(undo_all(*views, attributes(self)), unless_moved=self):
            if landmark_ids is None:
                return self._take(readings, self._options(readings))
            given = argument_checks.identities(landmark_ids, len(readings))
            options = [
                (h.cost, h.slam, partial(h.slam.as_given, readings, given))
                for h in self.hypotheses
            ]
            return self._take(readings, options)

    def _take(self, readings: Array, options: Sequence[Option]) -> UpdateReport:
        """Update filters by their associations, and continue with the best of them."""
        errors: dict[int, Exception] = {}
        costs, origins, completions = zip(*options, strict=True)
        plans = [complete() for complete in completions]
        slams: list[ManagedSlam] = []
        for slam in origins:  # copied where a hypothesis splits
            is_taken = slam in slams
            slams.append(self._resumed(slam.snapshot()) if is_taken else slam)

        def take(k: int) -> None:
            try:
                slams[k].take(readings, plans[k])
            except (np.linalg.LinAlgError, MemoryError) as error:
                errors[k] = error

        def then() -> UpdateReport:
            taken = [k for k in range(len(slams)) if k not in errors]
            if not taken:
                raise errors[0]
            kept = [Hypothesis(costs[k] + plans[k].price, slams[k]) for k in taken]
            kept.sort(key=lambda hypothesis: hypothesis.cost)
            return self._take_over(distinct(kept, self._policy.hypotheses))

        return self._carry_out(slams, take, then)

    def _take_over(self, hypotheses: Sequence[Hypothesis]) -> UpdateReport:
        """Continue with hypotheses, the best first; return the report of this one.

        All other filters are reused later.
        """
        least = hypotheses[0].cost
        self.hypotheses = [Hypothesis(h.cost - least, h.slam) for h in hypotheses]
        used = {*self._slams}
        spare = [slam for slam in self._filters if slam not in used]
        for slam in {*spare}.difference(self._spare):
            slam.forget_scans()
        self._spare = spare
        return self.report()

    def _fresh(self) -> ManagedSlam:
        """Return a filter that no hypothesis uses, in any state."""
        if not self._spare:
            self._spare = [self._make()]
            self._filters = [*self._filters, *self._spare]
        *self._spare, slam = self._spare
        return slam

    def _resumed(self, before: tuple[Any, ...]) -> ManagedSlam:
        """Return a filter that no hypothesis uses, continuing from a snapshot."""
        slam = self._fresh()
        slam.resume(before)
        return slam

    def _carry_out(
        self,
        slams: Sequence[ManagedSlam],
        step: Callable[[int], object],
        then: Callable[[], Answer],
    ) -> Answer:
        """Take one step with each of some filters; return what follows from all steps.

        An interrupt finds no filter moved, or lets the others follow.
        """
        begun, steps = [slam.steps for slam in slams], self.steps + 1

        def finish() -> Answer:
            for k, slam in enumerate(slams):
                if slam.steps == begun[k]:
                    step(k)
            answer = then()
            self.steps = steps
            return answer

        try:
            return finish()
        except BaseException:
            if begun != [slam.steps for slam in slams]:
                to_the_end(finish)
            raise

    def remove(self, landmark_ids: LandmarkIds) -> None:
        """Marginalise landmarks on request; only the best hypothesis continues."""
        self._change_best(lambda best: best.remove(landmark_ids))

    def merge(self, kept: int, gone: int) -> None:
        """Merge two landmarks on request; only the best hypothesis continues."""
        self._change_best(lambda best: best.merge(kept, gone))

    def _change_best(self, change: Callable[[ManagedSlam], None]) -> None:
        """Change the best hypothesis; only this one continues."""
        with undone_on_error(self.bookmark()):
            change(self.best)
            self._take_over(self.hypotheses[:1])

    def state_dict(self) -> dict[str, Any]:
        """Return the state of every hypothesis, as arrays."""
        state: dict[str, Any] = {
            "estimator": np.array(type(self).__name__),
            "costs": np.array([h.cost for h in self.hypotheses]),
        }
        for k, hypothesis in enumerate(self.hypotheses):
            state |= with_prefix(str(k), hypothesis.slam.state_dict())
        return state

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from a saved state, bit for bit under the same settings.

        Raises
        ------
        ValueError
            If the state lacks an entry, or belongs to another estimator; all is then as
            before.
        """
        name = {"estimator": type(self).__name__}
        table = {"costs": (saved_states.NUMBERS, -1)}
        costs = saved_states.read(state, table, of=name)["costs"].tolist()
        if not costs or costs[0] < 0 or costs != sorted(costs):
            raise ValueError(f"state['costs'] must be >= 0 and ascend, got {costs}")
        with undone_on_error(self.bookmark()):
            loaded = [Hypothesis(cost, self._fresh()) for cost in costs]
            for k, hypothesis in enumerate(loaded):
                hypothesis.slam.load_state_dict(without_prefix(state, str(k)))
            self._take_over(loaded)

    def snapshot(self) -> tuple[Any, ...]:
        """Return the present state of every hypothesis, for :meth:`resume`."""
        kept = [(h.cost, h.slam.snapshot()) for h in self.hypotheses]
        return kept, self.steps

    def resume(self, before: tuple[Any, ...]) -> None:
        """Return to a :meth:`snapshot` of a filter with the same settings."""
        kept, self.steps = before
        for slam in self._slams:
            slam.forget_scans()
        self._spare = self._filters
        self._take_over([Hypothesis(cost, self._resumed(own)) for cost, own in kept])

    def bookmark(self) -> Undo:
        """Return what takes back later calls, as far as no kernel has run."""
        slams = (h.slam.bookmark() for h in self.hypotheses)
        return undo_all(*slams, attributes(self))

    def _options(self, readings: Array) -> list[Option]:
        """Return the best associations of a scan, the cheapest first."""
        astray = [h for h in self.hypotheses if h.slam.is_astray(readings)]
        options: list[Option] = []
        most, ceiling = TRIED * self._policy.hypotheses, np.inf
        for h in [*self.hypotheses, *self._at_places(readings, astray)]:
            found = h.slam.alternatives(readings, ceiling - h.cost)
            if h in astray:
                found += h.slam.deferred(readings, *found[0])
            options += [(h.cost + cost, h.slam, plan) for cost, plan in found]
            options.sort(key=itemgetter(0))
            ceiling = options[0][0] + SPREAD
            options = [o for o in options[:most] if o[0] <= ceiling]
            if len(options) == most:
                ceiling = options[-1][0]
        return options

    def _at_places(
        self, readings: Array, astray: Sequence[Hypothesis]
    ) -> list[Hypothesis]:
        """Return the parts of hypotheses around the places that a scan shows.

        The part around a pose c among landmarks is the prior times exp(−½ ‖z − c‖²) in
        the metric of R, where z is the pose relative to them.  Its weight is that of c
        in the prior of z with R added, relative to N(0; 0, R).
        """
        parts: list[Hypothesis] = []
        found = ((h, h.slam.places_of_scan(readings)) for h in astray)
        for h, places in islice(filter(itemgetter(1), found), PER_BASIN):
            for place in places:
                slam = self._resumed(h.slam.snapshot())
                reports = slam.move_to(*place)
                # The gate of the filter may refuse the place.
                if all(report.degrees_of_freedom for report in reports):
                    cost = sum(map(cost_of, reports)) - log(np.linalg.det(AROUND))
                    parts.append(Hypothesis(h.cost + cost, slam))
        return parts

    @property
    def _slams(self) -> list[ManagedSlam]:
        return [hypothesis.slam for hypothesis in self.hypotheses]

    def __repr__(self) -> str:
        count = len(self.hypotheses)
        return repr(self.best) + (f", best of {count} hypotheses" if count > 1 else "")
