"""The exactly sparse extended information filter: a large map with few links."""

from collections.abc import Mapping, Sequence
from math import inf
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...interface import Belief, MapView, UpdateReport
from ...models.angles import wrap_angle
from ...support import argument_checks
from ...support.argument_checks import LandmarkIds
from ..sparse_cholesky.coordinates import pairs
from ..sparse_cholesky.information_matrix import Surroundings
from ..sparse_cholesky.landmark_elimination import surround_all
from .active_set import AROUND, choose_local, first_reach, local_size, union, wider
from .conditional_pose import PoseGivenMap, move
from .linearisation import ESTIMATE
from .local_information import Map, begin, finish, link_count
from .marginals import marginal, means
from .saved_state import SavedState, as_arrays, checked_state
from .scan import ScanRules
from .scan_update import Sparsity, consider
from .sparsification import State, active, identify, integrate_out

Array = NDArray[np.float64]
Int = NDArray[np.int64]
Flags = NDArray[np.bool_]


class SparseInformationSlam:
    """Exactly sparse extended information filter: few links, and none of them made up.

    The map is kept as an information matrix Λ, whose zeros say that two landmarks are
    independent given all others [1]_.  A motion links all landmarks to which the pose
    is linked, the *active* ones.  When a scan would make them more than
    ``active_bound``, every other of its readings of mapped landmarks corrects the
    belief as usual; then the pose is integrated out, which links the landmarks active
    so far and no others, and taken anew from the remaining readings alone, as if the
    robot had been kidnapped.  So Λ stays exactly sparse, no reading counts twice, and
    what is lost is odometry: the belief is less certain than that of the EKF, never
    more.

    Means and covariances near the robot come from a small dense matrix, in which the
    landmarks around it are eliminated; while the robot stays among the same landmarks
    this holds, and of the rest of the map all but the branches that it left or entered.

    Parameters
    ----------
    motion_std, measurement_std, initial_pose, initial_pose_std, range_std_per_metre, \
range_noise_at, gate_probability, noise_at_rest, min_range
        As in :class:`EkfSlam`; ``measurement_std`` above 0.
    base : {"ekf", "first_estimates", "observability_constrained"}
        The filter whose Jacobians are taken: those of "ekf" make it overconfident on
        long drives, the others do not.
    active_bound : int or None
        Γ, the largest number of landmarks linked with the pose; at least 2.  A scan
        that holds more itself, or fewer than two readings of mapped landmarks that
        determine the pose, exceeds it for a while.  None: no bound, the EKF in other
        clothes, with a matrix that fills.
    sparsify : {"relocate", "prune"}
        "prune" cuts the weakest links between pose and landmarks instead, as the SEIF
        does [2]_, which makes the filter overconfident: it exists for comparison.
    tolerance : float
        Corrections wait where they would move a landmark far from the robot by less
        than this share of its standard deviation given its neighbours.  What waits is
        kept and not lost.  0: none waits, every mean is exact, at the cost of
        eliminating the whole map whenever the robot leaves its local map.
    belief_limit : int
        Largest number of landmarks of which ``belief`` makes a dense covariance.

    Raises
    ------
    ValueError
        Where an argument is refused.

    References
    ----------
    .. [1] M. Walter, R. Eustice, J. Leonard, Exactly sparse extended information
       filters for feature-based SLAM, IJRR 26(4), 2007.
    .. [2] S. Thrun, Y. Liu, D. Koller, A. Ng, Z. Ghahramani, H. Durrant-Whyte,
       Simultaneous localization and mapping with sparse extended information filters,
       IJRR 23(7-8), 2004.

    Examples
    --------
    >>> slam = SparseInformationSlam((0.05, 0.02, 0.01), (0.02, 0.1), active_bound=10)
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
        initial_pose: ArrayLike = (0.0, 0.0, 0.0),
        initial_pose_std: ArrayLike = (0.0, 0.0, 0.0),
        base: str = "ekf",
        active_bound: int | None = 20,
        sparsify: str = "relocate",
        tolerance: float = 1e-3,
        belief_limit: int = 5000,
        **settings: Any,
    ) -> None:
        self._scan_rules = ScanRules(motion_std, measurement_std, base=base, **settings)
        self._sparsity = Sparsity(
            inf
            if active_bound is None
            else argument_checks.whole("active_bound", active_bound, 2),
            argument_checks.one_of("sparsify", sparsify, ("relocate", "prune"))
            == "prune",
        )
        self._tolerance = argument_checks.at_least("tolerance", tolerance, 0.0)
        self.belief_limit = argument_checks.whole("belief_limit", belief_limit, 1)
        self.reset(initial_pose, initial_pose_std)

    def reset(self, pose: ArrayLike, pose_std: ArrayLike) -> None:
        """Start a new run with an empty map, as :meth:`EkfSlam.reset`."""
        first = argument_checks.finite_vector("pose", pose, 3)
        std = argument_checks.standard_deviations("pose_std", pose_std, 3)
        self._slots: dict[int, int] = {}  # place of each landmark in the map
        self._free: list[int] = []
        self._world = Map()
        self._pose = PoseGivenMap(
            first.copy(), np.zeros((3, 0)), np.diag(std**2), first[:2].copy()
        )
        self._local, self._pose = begin(
            self._world, self._pose, np.empty(0, dtype=np.int64), AROUND
        )
        self._reach: float = AROUND
        self._widened = False  # whether the first reach did not do
        self._origin = first[:2].copy()  # where the local map was chosen
        self._others: Surroundings | None = None

    def predict(self, odometry: ArrayLike, dt: float = 1.0) -> None:
        """Move the pose by one odometry reading, as :meth:`EkfSlam.predict`."""
        distance, turn = argument_checks.pair("odometry", odometry)
        variance = self._scan_rules.motion_variance(distance, turn, dt)
        self._pose = move(
            self._pose,
            np.array([distance, turn]),
            variance,
            from_mean=self._scan_rules.base == ESTIMATE,
        )

    def update(
        self, measurements: ArrayLike, landmark_ids: LandmarkIds | None = None
    ) -> UpdateReport:
        """Correct the belief with one scan, then map the landmarks seen first.

        Parameters and report as in :meth:`EkfSlam.update`; innovation, its covariance
        and the NIS are those of all readings in use at the prior, whether they then
        correct the pose or replace it.

        Raises
        ------
        ValueError
            Where the arguments are malformed; the belief is then as before.
        numpy.linalg.LinAlgError
            Where a covariance is not positive definite; the belief is then as before,
            up to rounding.
        """
        readings = argument_checks.scan(measurements)
        ids = argument_checks.given_identities(landmark_ids, len(readings), self)
        argument_checks.refuse_unusable(readings, ids)
        if not ids:
            return UpdateReport()
        self._look_after(ids)
        while True:
            outcome = consider(
                (self._local, self._pose),
                self._scan_rules,
                self._sparsity,
                (readings, ids),
                self._slots,
                self._vacant(len(ids)),
            )
            local = outcome.local
            if local.outer.unrest(local.shift) <= self._tolerance:
                break
            self._take(self._local.slots, wider(self._reach))
            self._widened = True
        for i, slot in zip(outcome.report.added_ids, outcome.added_slots, strict=True):
            self._slots[i] = slot
        self._free = [slot for slot in self._free if slot not in outcome.added_slots]
        self._world.grow(len(self._slots) + len(self._free))
        self._pose, self._local = outcome.pose, local
        return outcome.report

    def remove(self, landmark_ids: LandmarkIds) -> None:
        """Forget landmarks; the belief about all else stays exactly as it was.

        Landmarks that were linked with the same removed one are linked afterwards.

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
        if ids:
            gone = self._take_with_links(ids)
            self._drop(ids, gone, integrate_out(self._local, self._pose, gone))

    def merge(self, kept: int, gone: int) -> None:
        """Condition on two landmarks being one, and forget the second.

        Parameters
        ----------
        kept, gone : int
            Two mapped landmarks.

        Raises
        ------
        ValueError
            Where one is not in the map, or they are the same; nothing is then merged.
        """
        argument_checks.two_landmarks(kept, gone)
        one, _ = argument_checks.mapped_identities([kept, gone], self._slots)
        dropped = self._take_with_links([gone, kept])
        place = int(np.flatnonzero(self._local.slots == self._slots[one])[0])
        dropped[place] = False
        merged = identify(self._local, self._pose, place, dropped)
        self._drop([gone], dropped, merged)

    def _take_with_links(self, ids: Sequence[int]) -> Flags:
        """Take landmarks in hand and all that are linked with them; return which."""
        slots = np.array([self._slots[i] for i in ids])
        linked = np.append(slots, self._world.information.neighbours(slots))
        self._take(union(self._local.slots, linked), self._first_reach())
        return np.isin(self._local.slots, slots)

    def _drop(self, ids: Sequence[int], gone: Flags, rest: State) -> None:
        """Go on with what remains of the belief, and free the places of the others."""
        stays = np.repeat(~gone, 2)
        information = np.where(stays & stays[:, None], self._local.information, 0.0)
        self._world.information.put(self._local.slots, information)
        self._local, self._pose = rest
        self._others = None
        self._world.elimination.dissection.nodes[[self._slots[i] for i in ids]] = 0
        for i in ids:
            self._free.append(self._slots.pop(i))

    def belief(self, landmark_ids: LandmarkIds | None = None) -> Belief:
        """Return the belief as a snapshot, of the whole map or of a part of it.

        Parameters
        ----------
        landmark_ids : sequence of int, optional
            Of these landmarks and the pose only, in this order: their marginal.
            ``belief([])`` is that of the pose.  The first call since the local map was
            chosen factorises all the rest of the map; further ones, as long as they
            ask for landmarks near the robot, cost little.

        Raises
        ------
        ValueError
            Where one is not in the map, or they are more than ``belief_limit``.
        """
        ids = argument_checks.asked_identities(landmark_ids, self._slots)
        argument_checks.refuse_large_belief(
            len(ids), self.belief_limit, "give landmark_ids"
        )
        slots = np.array([self._slots[i] for i in ids], dtype=np.int64)
        answer = marginal(
            self._world, self._local, self._everything(), self._pose, slots
        )
        return Belief(answer.mean, answer.covariance, tuple(ids), "additive")

    def local_view(self, within: float) -> MapView:
        """Look at the pose, and at the landmarks that may be so near [m].

        Up to 10σ of the robot's position nearer than they seem to be: what is near the
        robot is hardly known worse than the robot itself.
        """
        pose, ids = self.belief([]), self.landmark_ids
        away = np.hypot(*(self.landmarks - pose.pose[:2]).T)
        reach = within + 10 * np.sqrt(np.trace(pose.covariance[:2, :2]))
        near = [ids[place] for place in np.flatnonzero(away <= reach)]
        belief = self.belief(near)
        return MapView(belief.mean, belief.covariance, belief.landmark_ids, ids)

    @property
    def landmark_ids(self) -> tuple[int, ...]:
        """The mapped landmarks, in the order of the belief."""
        return tuple(self._slots)

    @property
    def local_ids(self) -> tuple[int, ...]:
        """The landmarks of the local map."""
        local = set(self._local.slots.tolist())
        return tuple(i for i, slot in self._slots.items() if slot in local)

    @property
    def active_ids(self) -> tuple[int, ...]:
        """The landmarks linked with the pose."""
        linked = set(self._local.slots[active(self._pose)].tolist())
        return tuple(i for i, slot in self._slots.items() if slot in linked)

    @property
    def landmarks(self) -> Array:
        """Positions of all landmarks, shape (n, 2) [m]; no covariance is computed."""
        points = means(self._world, self._local).reshape(-1, 2)
        return points[list(self._slots.values())]

    @property
    def pose(self) -> Array:
        """(x, y, θ), shape (3,) [m, m, rad]; no covariance is computed."""
        x, y, heading = self._pose.mean
        return np.array([x, y, wrap_angle(heading)])

    @property
    def link_count(self) -> int:
        """Number of 2 × 2 blocks of Λ that are not zero, the diagonal counted."""
        return link_count(self._world, self._local)

    @property
    def nbytes(self) -> int:
        """Memory that the belief takes [bytes]."""
        local, world = self._local, self._world
        arrays = (world.points, world.first, world.residual, local.information)
        around = (local.surroundings.response, local.outer.response)
        kept = world.information.nbytes + world.elimination.nbytes
        return kept + sum(a.nbytes for a in arrays + around)

    def state_dict(self) -> dict[str, Any]:
        """Return copies of everything, as arrays."""
        return as_arrays(
            SavedState(
                self._slots,
                self._free,
                self._world,
                self._local,
                self._pose,
                self._origin,
                self._reach,
                self._widened,
            ),
            type(self).__name__,
            self._scan_rules.base,
        )

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from a saved state, as :meth:`EkfSlam.load_state_dict`."""
        saved = checked_state(state, type(self).__name__, self._scan_rules.base)
        self._slots, self._free, self._world = saved.slots, saved.free, saved.world
        self._local, self._pose = saved.local, saved.pose
        self._origin, self._reach = saved.origin, saved.reach
        self._widened = saved.widened
        self._others = None

    def _look_after(self, ids: Sequence[int]) -> None:
        """Choose a new local map where this scan, or what was found, asks for one."""
        seen = np.array([self._slots[i] for i in ids if i in self._slots], dtype=int)
        local = self._local.slots
        wanted = union(seen, local[active(self._pose)])
        size = local_size(len(self._slots), len(ids), len(wanted))
        if np.isin(seen, local).all() and 2 * len(local) <= 3 * size:
            return
        here = self._pose.mean[:2]
        ahead = here + (here - self._origin) / 2  # where it may be going
        mapped = np.array(list(self._slots.values()))
        points = self._world.points.reshape(-1, 2)
        self._take(
            choose_local(mapped, points, ahead, wanted, size), self._first_reach()
        )
        self._origin, self._widened = here.copy(), False

    def _first_reach(self) -> float:
        if not self._tolerance:
            return inf
        return first_reach(self._reach, widened=self._widened)

    def _take(self, slots: Int, reach: float) -> None:
        """Hand the local map back, and take these landmarks in hand."""
        old, pose = self._local.slots, self._pose
        finish(self._world, self._local)
        self._others, self._local = None, self._local.without_factor()
        gain = np.zeros((3, 2 * len(slots)))
        _, before, now = np.intersect1d(old, slots, return_indices=True)
        gain[:, pairs(now)] = pose.gain[:, pairs(before)]
        pose = pose._replace(gain=gain)
        self._local, self._pose = begin(self._world, pose, slots, reach)
        self._reach = reach
        around = self._local.surroundings
        is_all = len(slots) + len(around.slots) == len(self._slots)
        self._others = around if is_all and not len(around.response) else None

    def _everything(self) -> Surroundings:
        """All landmarks but the local ones, eliminated."""
        if self._others is None:
            self._others = surround_all(
                self._world.elimination, self._world.information, self._local.slots
            )
        return self._others

    def _vacant(self, count: int) -> Int:
        """Places for so many new landmarks."""
        fresh = len(self._slots) + len(self._free)
        places = self._free[::-1] + list(range(fresh, fresh + count))
        return np.array(places[:count], dtype=np.int64)
