"""The compressed filter: a large map at the cost of the landmarks around the robot."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from .... import argument_checks
from ....argument_checks import LandmarkIds
from ...beliefs import Belief, MapView, UpdateReport, describe_filter
from ...filters.ekf import (
    EkfSlam,
    FirstEstimatesEkfSlam,
    InvariantEkfSlam,
    IteratedEkfSlam,
    ObservabilityConstrainedEkfSlam,
)
from ...guards import saved_states
from ...guards.interrupts import Interruptible, changing
from ...models.sensors import only_placing
from ..undo import Undo, attributes, undo_all
from .compressed_map import (
    SHORT_PHASE,
    SMALLEST_LOCAL_MAP,
    CompressedMap,
    extra_landmarks,
)

BASES: dict[str, type[EkfSlam]] = {
    "ekf": EkfSlam,
    "invariant": InvariantEkfSlam,
    "first_estimates": FirstEstimatesEkfSlam,
    "observability_constrained": ObservabilityConstrainedEkfSlam,
    "iterated": IteratedEkfSlam,
}
CHECKED_LANDMARKS = 200  # landmarks of a saved state whose joint covariance is checked


class CompressedEkfSlam(Interruptible):
    """Compressed EKF-SLAM: the full filter, at a fraction of its cost.

    In each step the filter updates only the *local map*: the pose and the landmarks
    nearby.  It accumulates the effect on all other landmarks in two small matrices, and
    applies it to the map when the robot leaves the local map [1]_.  Nothing is
    approximated: means and covariances equal those of the full filter, up to rounding,
    also for ``invariant``.

    The update of the large covariance and the change of the local map are spread over
    the steps that follow.  Up to 350 landmarks (400 with ``base="invariant"``) the
    local map is the whole map, and a step is a step of the full filter.

    Parameters
    ----------
    motion_std, measurement_std, initial_pose, initial_pose_std
        As in :class:`EkfSlam`.
    base : {"ekf", "invariant", "first_estimates", "observability_constrained", \
"iterated"}
        The filter whose results are computed.
    local_size : int, optional
        Number of landmarks in a new local map, the nearest to the robot.  Landmarks
        found later join it until it is half as large again.  By default, the filter
        chooses the number: all landmarks of a small map; in a large map a few times the
        number of landmarks in a scan, and fewer if consecutive scans have few landmarks
        in common.  A number makes the mean step faster in maps of 250 to 400 landmarks,
        and the slowest step slower.
    **settings
        Other options of the base filter.

    Raises
    ------
    ValueError
        If an argument is invalid.

    References
    ----------
    .. [1] J. Guivant, E. Nebot, Optimization of the simultaneous localization and
       map-building algorithm for real-time implementation, IEEE T-RA 17(3), 2001.

    Examples
    --------
    >>> slam = CompressedEkfSlam((0.05, 0.02, 0.01), (0.02, 0.1), base="invariant")
    >>> slam.update([(0.0, 2.0), (1.5, 3.0)], landmark_ids=[7, 9]).added_ids
    (7, 9)
    >>> slam.belief([7]).landmarks  # belief() returns the whole map
    array([[2., 0.]])
    """

    __repr__ = describe_filter

    def __init__(
        self,
        motion_std: ArrayLike,
        measurement_std: ArrayLike,
        *,
        base: str = "ekf",
        local_size: int | None = None,
        initial_pose: ArrayLike = (0.0, 0.0, 0.0),
        initial_pose_std: ArrayLike = (0.0, 0.0, 0.0),
        **settings: Any,
    ) -> None:
        base_filter = BASES[argument_checks.one_of("base", base, tuple(BASES))]
        noise = np.array(motion_std), np.array(measurement_std)
        self._make = partial(base_filter, *noise, **settings)
        self._map = CompressedMap(self._make())
        only_placing(self._map.filter.sensor, "the compressed filter")
        self._local_size = local_size
        if local_size is not None:
            argument_checks.whole("local_size", local_size, 1)
        self.reset(initial_pose, initial_pose_std)

    def reset(self, pose: ArrayLike, pose_std: ArrayLike) -> None:
        """Start a new run with an empty map, as `EkfSlam.reset`."""
        loaded = CompressedMap(self._make())
        loaded.reset(pose, pose_std)
        # The numbers: landmarks of the local map beyond those of a scan, scans in this
        # phase, how many phases may still spread their beginning over steps.
        with changing(self, "reset", anew=True):
            self._map, self._extra, self._age, self._rests = loaded, 0, 0, 0

    def predict(self, odometry: ArrayLike, dt: float = 1.0) -> None:
        """Move the pose by one odometry reading, as :meth:`EkfSlam.predict`."""
        self.refuse_interrupted()
        self._map.filter.predict(odometry, dt)

    def update(
        self, measurements: ArrayLike, landmark_ids: LandmarkIds | None = None
    ) -> UpdateReport:
        """Correct the belief with one scan, then map the landmarks seen first.

        Parameters and report as in :meth:`EkfSlam.update`.

        Raises
        ------
        ValueError
            If the arguments are malformed, or one scan holds more mapped landmarks
            than ``local_size``; the belief is then unchanged.
        numpy.linalg.LinAlgError
            If an innovation covariance is not positive definite, naming the
            measurement; the belief is then unchanged.
        MemoryError
            If memory cannot hold the landmarks; the belief is then unchanged.
        """
        readings = argument_checks.scan(measurements)
        named = argument_checks.identity_array(landmark_ids, len(readings), self)
        ids, slots = named.tolist(), self._map.slots
        argument_checks.refuse_repeated(ids)
        argument_checks.refuse_reserved(ids)

        required = [i for i in ids if i in slots]
        changes = not self._is_adequate(required)
        with changing(self, "update", self._undo() if changes else None):
            if changes:
                self._choose_local_map(required)
            report = self._map.filter.update(readings, named)
            self._map.add()
            if report.degrees_of_freedom:
                self._age += 1
                rank = report.degrees_of_freedom + 1
                self._map.work(rank, self._age, hurried=not self._rests)
        return report

    def observe_pose(
        self, reading: ArrayLike, matrix: ArrayLike, covariance: ArrayLike
    ) -> UpdateReport:
        """Correct the belief with a reading of the pose, as `EkfSlam.observe_pose`."""
        self.refuse_interrupted()
        return self._map.filter.observe_pose(reading, matrix, covariance)

    def remove(self, landmark_ids: LandmarkIds) -> None:
        """Remove landmarks by marginalisation; the belief about all else is unchanged.

        Raises
        ------
        ValueError
            If one is not in the map; no landmark is then removed.
        """
        ids = argument_checks.mapped_identities(landmark_ids, self._map.slots)
        with changing(self, "remove", self._undo()):
            self._map.remove(ids)

    def merge(self, kept: int, gone: int) -> None:
        """Condition on two landmarks being the same, and remove the second.

        Raises
        ------
        ValueError
            If one is not in the map or both are the same; nothing is merged.
        """
        self.merge_pairs([(kept, gone)])

    def merge_pairs(self, pairs: Sequence[tuple[int, int]]) -> None:
        """Merge several pairs (kept, gone) at once, as one measurement.

        Parameters
        ----------
        pairs : sequence of (int, int)
            Mapped landmarks, each in one pair.

        Raises
        ------
        ValueError
            If one is not in the map or in two pairs; nothing is merged.
        """
        kept, gone = argument_checks.landmark_pairs(pairs, self._map.slots)
        ids, local = [*kept, *gone], self._map.local
        with changing(self, "merge", self._undo()):
            if not all(i in local for i in ids):
                size = max(self._local_size or 0, len(local), len(ids))
                self._map.change_local_map(ids, size, hurried=not self._rests)
            self._map.merge_pairs(list(zip(kept, gone, strict=True)))

    def belief(self, landmark_ids: LandmarkIds | None = None) -> Belief:
        """Return a snapshot of the belief, for the whole map or a part of it.

        Parameters
        ----------
        landmark_ids : sequence of int, optional
            Return the marginal of the pose and these landmarks, in this order, at a
            cost that does not depend on the size of the map.  ``belief([])`` is that of
            the pose.

        Raises
        ------
        ValueError
            If one is not in the map.
        MemoryError
            If memory cannot hold the covariance.
        """
        self.refuse_interrupted()
        ids = argument_checks.asked_identities(landmark_ids, self._map.slots)
        return self._map.belief(ids)

    def local_view(self, within: float) -> MapView:
        """Return the pose and the landmarks within a distance of it [m].

        The distance is extended by 5σ.  The view always holds the local map.
        """
        within = argument_checks.distance("within", within)
        near = self._map.ids_near(self.belief([]), within)
        belief = self.belief(near)
        return MapView(
            belief.mean, belief.covariance, belief.landmark_ids, self.landmark_ids
        )

    @property
    def landmark_ids(self) -> tuple[int, ...]:
        """The mapped landmarks, in the order of the belief."""
        self.refuse_interrupted()
        return tuple(self._map.slots)

    @property
    def local_ids(self) -> tuple[int, ...]:
        """The landmarks of the local map."""
        self.refuse_interrupted()
        return tuple(self._map.local)

    @property
    def nbytes(self) -> int:
        """Memory of the belief [bytes]."""
        return self._map.nbytes

    def state_dict(self) -> dict[str, Any]:
        """Return copies of the whole state, as arrays; large for a large map."""
        self.refuse_interrupted()
        name = {"estimator": np.array(type(self).__name__)}
        return name | self._map.state_dict([self._extra, self._age, self._rests])

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from a saved state, as `EkfSlam.load_state_dict`.

        Of a large map the covariance of the first 200 landmarks is checked.
        """
        loaded = CompressedMap(self._make())
        extra, age, rests = loaded.load_state_dict(state, type(self).__name__)
        some = loaded.belief(list(loaded.slots)[:CHECKED_LANDMARKS])
        saved_states.refuse_indefinite("the covariance of state", some.covariance)
        with changing(self, "load_state_dict", anew=True):
            self._map, self._extra, self._age, self._rests = loaded, extra, age, rests

    def _undo(self) -> Undo:
        """Return what takes back a change of the local map.

        A handover may be further than before: its results do not depend on the time.
        """
        parts = attributes(self._map.filter.map, self._map, self)
        return undo_all(parts, self._map.deferred.checkpoint())

    @property
    def steps(self) -> int:
        """Number of steps taken; it changes together with the belief."""
        return self._map.filter.steps

    def report(self) -> UpdateReport:
        """Return the report of the last update once more."""
        self.refuse_interrupted()
        return self._map.filter.report()

    def _choose_local_map(self, required: Sequence[int]) -> None:
        """Begin a new phase, with a local map that holds these landmarks."""
        if self._local_size is not None and len(required) > self._local_size:
            raise ValueError(
                f"local_size must be >= {len(required)}, the mapped landmarks of one "
                f"scan, got {self._local_size}"
            )
        rests, extra = max(self._rests - 1, 0), self._extra
        is_short = 0 < self._age < SHORT_PHASE
        if not is_short and self._map.deferred.is_up_to_date:
            rests = 2  # one short phase does not matter, several leave too much work
        size, mapped = self._local_size, len(self._map.slots)
        if size is None:
            extra = extra_landmarks(extra, len(required), mapped, self._age)
            size = mapped if self._map.is_small else max(len(required), 4) + extra
        self._map.change_local_map(required, size, hurried=not rests)
        self._extra, self._age, self._rests = extra, 0, rests

    def _is_adequate(self, required: Sequence[int]) -> bool:
        """Return whether the local map holds these landmarks and is not too large."""
        local, mapped = self._map.local, len(self._map.slots)
        is_free = self._local_size is None
        if self._local_size is not None and len(required) > self._local_size:
            return False
        if is_free and self._map.is_small and len(local) == mapped:
            return True
        size = self._local_size or max(len(required) + self._extra, SMALLEST_LOCAL_MAP)
        return all(i in local for i in required) and 2 * len(local) <= 3 * size
