"""The compressed filter: a large map at the cost of the landmarks around the robot."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...filters.ekf import FRAMES, EkfSlam
from ...filters.first_estimates import FirstEstimatesEkfSlam
from ...filters.invariant import InvariantEkfSlam
from ...filters.iterated import IteratedEkfSlam
from ...filters.observability_constrained import ObservabilityConstrainedEkfSlam
from ...interface import Belief, MapView, UpdateReport
from ...support import argument_checks
from ...support.argument_checks import LOWEST_ID, LandmarkIds
from ...support.memory_limit import covariance_bytes, refuse_beyond_memory
from ..sparse_cholesky.coordinates import pairs
from . import active_set
from .active_set import nearest_to, spare_landmarks
from .deferred_covariance import DeferredCovariance, stored_bytes, subtract, symmetric
from .phase_update import (
    Phase,
    begin_phase,
    combine,
    end_phase,
    roots,
    virtual_landmarks,
)
from .saved_state import checked_state

Array = NDArray[np.float64]
Int = NDArray[np.int64]

BASES: dict[str, type[EkfSlam]] = {
    "ekf": EkfSlam,
    "invariant": InvariantEkfSlam,
    "first_estimates": FirstEstimatesEkfSlam,
    "observability_constrained": ObservabilityConstrainedEkfSlam,
    "iterated": IteratedEkfSlam,
}


class CompressedEkfSlam:
    """Compressed EKF-SLAM: exactly the full filter, at a fraction of its cost.

    Pose and nearby landmarks, the *local map*, are filtered step by step; what that
    means for all other landmarks is gathered in two small matrices and worked into the
    map when the robot leaves the local map [1]_.  Nothing is approximated: means and
    covariances are those of the full filter, up to rounding, for ``invariant`` too.

    The work that the end of a phase leaves for the large covariance is spread over the
    following steps, so that no step does more of it than a step of the full filter.
    Up to 250 landmarks the local map is all of the map, and a step that of the full
    filter.

    Parameters
    ----------
    motion_std, measurement_std, initial_pose, initial_pose_std
        As in :class:`EkfSlam`.
    base : {"ekf", "invariant", "first_estimates", "observability_constrained", \
"iterated"}
        The filter to be.
    local_size : int, optional
        Landmarks in the local map when it is chosen, the nearest to the robot; those
        found later join until it holds half as many again.  Chosen by the filter where
        not given: all of a small map; of a large one a few times those that a scan
        holds, fewer where the robot's readings jump from place to place.
    **settings
        The other keywords of the base filter.

    Raises
    ------
    ValueError
        Where an argument is refused.

    References
    ----------
    .. [1] J. Guivant, E. Nebot, Optimization of the simultaneous localization and
       map-building algorithm for real-time implementation, IEEE T-RA 17(3), 2001.

    Examples
    --------
    >>> slam = CompressedEkfSlam((0.05, 0.02, 0.01), (0.02, 0.1), base="invariant")
    >>> slam.update([(0.0, 2.0), (1.5, 3.0)], landmark_ids=[7, 9]).added_ids
    (7, 9)
    >>> slam.belief([7]).landmarks  # of the whole map: belief()
    array([[2., 0.]])
    """

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
        make = BASES[argument_checks.one_of("base", base, tuple(BASES))]
        self._local = make(motion_std, measurement_std, **settings)
        self._invariant = make is InvariantEkfSlam
        self._local_size = local_size
        if local_size is not None:
            argument_checks.whole("local_size", local_size, 1)
        self.reset(initial_pose, initial_pose_std)

    def reset(self, pose: ArrayLike, pose_std: ArrayLike) -> None:
        """Start a new run with an empty map, as :meth:`EkfSlam.reset`."""
        self._local.reset(pose, pose_std)
        self._slots: dict[int, int] = {}  # place of each landmark in the arrays below
        self._free: list[int] = []
        self._points = np.zeros(0)
        self._references = np.zeros(0)
        self._far = DeferredCovariance()
        self._near: dict[int, None] = {}  # the local landmarks, in their order
        self._virtual = 0
        self._strip = np.zeros((3, 0))
        self._extra = 0  # landmarks of the local map beyond those of a scan
        self._age, self._rest = 0, False  # scans in this phase; whether work may wait
        self._origin = self._local.state_dict()["mean"][:2]  # where it began

    def predict(self, odometry: ArrayLike, dt: float = 1.0) -> None:
        """Move the pose by one odometry reading, as :meth:`EkfSlam.predict`."""
        self._local.predict(odometry, dt)

    def update(
        self, measurements: ArrayLike, landmark_ids: LandmarkIds | None = None
    ) -> UpdateReport:
        """Correct the belief with one scan, then map the landmarks seen first.

        Parameters and report as in :meth:`EkfSlam.update`.

        Raises
        ------
        ValueError
            Where the arguments are malformed, or one scan holds more mapped landmarks
            than ``local_size``; the belief is then as before.
        numpy.linalg.LinAlgError
            Where an innovation covariance is not positive definite, naming the
            reading; the belief is then as before, up to rounding.
        MemoryError
            Where the landmarks are more than memory holds; the belief is then as
            before.
        """
        readings = argument_checks.scan(measurements)
        ids = self._identities(landmark_ids, len(readings))
        if (np.abs(readings) <= argument_checks.LARGEST).all():  # else it is refused
            self._look_after(ids)
        report = self._local.update(readings, ids)
        for i in report.added_ids:
            self._slots[i] = self._free.pop() if self._free else len(self._slots)
            self._near[i] = None
        if report.degrees_of_freedom:
            self._age += 1
            if self._age > 1 or not self._rest:
                self._far.work(report.degrees_of_freedom + 2)
        return report

    def remove(self, landmark_ids: LandmarkIds) -> None:
        """Forget landmarks; the belief about all else stays exactly as it was.

        Parameters
        ----------
        landmark_ids : sequence of int
            Mapped landmarks, without repetition.

        Raises
        ------
        ValueError
            Where one is not in the map; nothing is then removed.
        """
        ids = argument_checks.mapped_identities(landmark_ids, self._slots)
        self._local.remove([i for i in ids if i in self._near])
        for i in ids:
            self._near.pop(i, None)
            self._free.append(self._slots.pop(i))

    def merge(self, kept: int, gone: int) -> None:
        """Condition on two landmarks being one, and forget the second.

        Parameters
        ----------
        kept, gone : int
            Two mapped landmarks.

        Raises
        ------
        ValueError
            Where one is not in the map; nothing is then merged.
        """
        argument_checks.two_landmarks(kept, gone)
        ids = argument_checks.mapped_identities([kept, gone], self._slots)
        if not all(i in self._near for i in ids):
            self._regroup(ids, max(self._local_size or 0, len(self._near), 2))
        self._local.merge(kept, gone)
        self._near.pop(gone)
        self._free.append(self._slots.pop(gone))

    def belief(self, landmark_ids: LandmarkIds | None = None) -> Belief:
        """Return the belief as a snapshot, of the whole map or of a part of it.

        Parameters
        ----------
        landmark_ids : sequence of int, optional
            Of these landmarks and the pose only, in this order: their marginal, at a
            cost that does not grow with the map.  ``belief([])`` is that of the pose.

        Raises
        ------
        ValueError
            Where one is not in the map.
        MemoryError
            Where memory does not hold their covariance.
        """
        ids = argument_checks.asked_identities(landmark_ids, self._slots)
        refuse_beyond_memory(
            f"belief() of {len(ids)} landmarks",
            2 * covariance_bytes(len(ids)),  # of which it takes a copy
            "give landmark_ids",
        )
        now = self._phase()
        near = {i: place for place, i in enumerate(self._near)}
        mean = np.zeros(3 + 2 * len(ids))
        covariance = np.zeros((len(mean), len(mean)))
        is_near = np.array([i in near for i in ids], dtype=bool)
        places = pairs([near[i] for i in ids if i in near])
        inside = np.r_[0:3, 3 + pairs(np.flatnonzero(is_near))]
        local = np.r_[0:3, 3 + places]
        mean[inside] = now.mean[local]
        covariance[np.ix_(inside, inside)] = now.covariance[np.ix_(local, local)]
        if not is_near.all():
            outside = 3 + pairs(np.flatnonzero(~is_near))
            far = pairs([self._slots[i] for i in ids if i not in near])
            strip = np.ascontiguousarray(self._strip[:, far])
            mean[outside] = self._points[far] + self._combine(now.shift, strip)[0]
            cross = self._combine(now.gain[local], strip)
            covariance[np.ix_(inside, outside)] = cross
            covariance[np.ix_(outside, inside)] = cross.T
            root, signs = roots(now.loss, self._invariant)
            block = self._far.marginal(far)
            subtract(block, self._combine(root, strip).T, signs)
            covariance[np.ix_(outside, outside)] = symmetric(block)
            del block  # it may be large, and the belief takes a copy
        frame = FRAMES[self._local.rules.frame]
        return Belief(mean, covariance, tuple(ids), frame)

    def local_view(self, within: float) -> MapView:
        """Look at the pose, and at the landmarks that may be so near [m].

        Up to 5σ nearer than they seem to be; those of the local map in any case.
        """
        pose, ids = self.belief([]), self.landmark_ids
        far = [i for i in ids if i not in self._near]
        columns = self._places(far)
        away = np.hypot(*(self._points[columns].reshape(-1, 2) - pose.pose[:2]).T)
        variances = self._far.diagonal()[columns].reshape(-1, 2).sum(axis=1)
        std = np.sqrt(variances) + np.sqrt(np.trace(pose.covariance[:2, :2]))
        left_out = {far[k] for k in np.flatnonzero(away > within + 5 * std)}
        belief = self.belief([i for i in ids if i not in left_out])
        return MapView(belief.mean, belief.covariance, belief.landmark_ids, ids)

    @property
    def landmark_ids(self) -> tuple[int, ...]:
        """The mapped landmarks, in the order of the belief."""
        return tuple(self._slots)

    @property
    def local_ids(self) -> tuple[int, ...]:
        """The landmarks of the local map."""
        return tuple(self._near)

    @property
    def nbytes(self) -> int:
        """Memory that the belief takes [bytes]."""
        local = covariance_bytes(len(self._near) + self._virtual)
        far = self._far.nbytes + self._strip.nbytes + 2 * self._points.nbytes
        return local + far

    def memory_for(self, landmarks: int) -> int:
        """Return what a map of so many landmarks takes at least [bytes]."""
        return min(stored_bytes(landmarks), covariance_bytes(landmarks))

    def state_dict(self) -> dict[str, Any]:
        """Return copies of everything, as arrays; of a large map, much."""
        local = {f"local_{k}": v for k, v in self._local.state_dict().items()}
        far = {f"far_{k}": v for k, v in self._far.state_dict().items()}
        return {
            "estimator": np.array(type(self).__name__),
            "base": local.pop("local_estimator"),
            "landmark_ids": np.array(list(self._slots), dtype=np.int64),
            "slots": np.array(list(self._slots.values()), dtype=np.int64),
            "points": self._points.copy(),
            "references": self._references.copy(),
            "strip": self._strip.copy(),
            "origin": self._origin.copy(),
            "numbers": np.array(
                [self._virtual, self._extra, self._age, self._rest, *self._free]
            ),
            **local,
            **far,
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from a saved state, as :meth:`EkfSlam.load_state_dict`."""
        name, base = type(self).__name__, type(self._local).__name__
        saved = checked_state(state, name, base, self._invariant)
        self._local.load_state_dict(saved.local)
        self._far, self._slots, self._near = saved.far, saved.slots, saved.near
        self._points, self._references, self._strip, self._origin = saved.arrays
        self._virtual, self._extra, self._age, rest, *self._free = saved.numbers
        self._rest = bool(rest)

    def _identities(self, landmark_ids: LandmarkIds | None, count: int) -> list[int]:
        ids = argument_checks.given_identities(landmark_ids, count, self)
        argument_checks.refuse_reserved(ids)
        return ids

    def _look_after(self, ids: Sequence[int]) -> None:
        """Begin a new phase where this scan, or the landmarks found, ask for one."""
        wanted = [i for i in ids if i in self._slots]
        if self._local_size is not None and len(wanted) > self._local_size:
            raise ValueError(
                f"local_size must be >= {len(wanted)}, the mapped landmarks of one "
                f"scan, got {self._local_size}"
            )
        near, mapped = self._near, len(self._slots)
        is_small = self._local_size is None and mapped <= active_set.WHOLE
        if is_small and len(near) == mapped:
            return
        size = self._local_size or max(len(wanted) + self._extra, 30)
        if all(i in near for i in wanted) and 2 * len(near) <= 3 * size:
            return
        rest, extra = self._age >= active_set.SHORT, self._extra
        if self._local_size is None:
            extra = spare_landmarks(extra, len(wanted), mapped, self._age)
            size = mapped if is_small else max(len(wanted), 4) + extra
        self._regroup(wanted, size)
        self._age, self._rest, self._extra = 0, rest, extra

    def _regroup(self, wanted: Sequence[int], size: int) -> None:
        """End the phase: settle with the map, choose a new local map, begin anew."""
        refuse_beyond_memory(
            f"a local map of {size} landmarks",
            covariance_bytes(3 * size),  # with those that are virtual
            "take a smaller local_size",
        )
        now = self._phase()
        rows = self._settle(now)
        chosen = self._choose(wanted, size, now.mean)
        near, slot = list(self._near), self._slots.__getitem__
        staying = [k for k, i in enumerate(near) if i in chosen]
        places = {slot(i): k for k, i in enumerate(near) if i not in chosen}
        leaving = sorted(places)
        entering = sorted((i for i in chosen if i not in self._near), key=slot)
        self._far.put(pairs(leaving), rows, 3 + pairs([places[s] for s in leaving]))
        columns = self._places(entering)
        kept = np.r_[0:3, 3 + pairs(staying)]
        self._near = dict.fromkeys([near[k] for k in staying] + entering)
        self._strip = np.empty((len(kept) + len(columns), self._far.width))
        self._strip[: len(kept)] = rows[kept]
        fresh = self._strip[len(kept) :]
        self._far.read(columns, fresh)
        fresh[:, self._places([near[k] for k in staying])] = rows[
            kept[3:, None], columns
        ].T
        self._origin = now.mean[:2].copy()
        self._begin()

    def _begin(self) -> None:
        """Give the local filter the landmarks near, as of now."""
        columns = self._places(list(self._near))
        whole = len(self._near) == len(self._slots)
        local = 3 + len(columns)  # coordinates
        self._virtual = 0 if whole else virtual_landmarks(local, self._invariant)
        begin_phase(
            self._local,
            self._points[columns],
            self._strip[:, columns],
            self._references[columns],
            [*range(LOWEST_ID, LOWEST_ID + self._virtual), *self._near],
        )

    def _settle(self, now: Phase) -> Array:
        """Bring the map up to date; return the rows of the local coordinates in it.

        Shape (a, width); of what the map's covariance loses only its factor is made.
        """
        columns = self._places(list(self._near))
        self._far.make_room(2 * (len(self._slots) + len(self._free)))
        width, old = self._far.width, self._strip.shape[1]
        if width > old:
            self._points = np.append(self._points, np.zeros(width - old))
            self._references = np.append(self._references, np.zeros(width - old))
            self._strip = np.pad(self._strip, ((0, 0), (0, width - old)))
        a = len(now.mean)
        if self._virtual:
            root, signs = roots(now.loss, self._invariant)
            coefficients = np.concatenate([now.gain, now.shift, root])
            product = self._combine(coefficients, self._strip)
            rows, shift, lost = product[:a], product[a], product[a + 1 :].T.copy()
            self._points += shift
            self._far.defer(lost, signs)
        else:
            rows = np.zeros((a, width))
        rows[:, columns] = now.covariance[:, 3:]
        self._points[columns] = now.mean[3:]
        self._references[columns] = now.reference[3:]
        return rows

    def _choose(self, wanted: Sequence[int], size: int, mean: Array) -> dict[int, None]:
        """Choose the landmarks of the next phase: the wanted and the nearest ahead."""
        chosen = dict.fromkeys(wanted)
        if len(chosen) >= size:
            return chosen
        ids, slots = list(self._slots), np.array(list(self._slots.values()))
        ahead = mean[:2] + (mean[:2] - self._origin) / 2  # where it may be going
        points = self._points.reshape(-1, 2)[slots]
        for i in nearest_to(ahead, ids, points, size + len(wanted)):
            if len(chosen) >= size:
                break
            chosen[i] = None
        return chosen

    def _combine(self, coefficients: Array, strip: Array) -> Array:
        return combine(coefficients, strip, self._invariant)

    def _phase(self) -> Phase:
        return end_phase(self._local, self._virtual)

    def _places(self, ids: Sequence[int]) -> Int:
        """Columns of landmarks in the map's arrays."""
        return pairs([self._slots[i] for i in ids])
