"""The exactly sparse extended information filter: a large map with few links.

`SparseInformationSlam` is the public filter; `as_arrays` and `checked_state` convert
its belief to a saved state and back.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from .... import argument_checks
from ....argument_checks import LandmarkIds
from ....arrays import Array, IntArray
from ...beliefs import Belief, MapView, UpdateReport, describe_filter
from ...filters.ekf import EkfSlam
from ...guards import saved_states
from ...guards.interrupts import Interruptible, changing
from ...guards.saved_states import with_prefix, without_prefix
from ...models.bearing_range import wrap_angle
from ..multifrontal import PLACES, ROWS
from ..undo import attributes
from . import local_information
from .local_information import link_count
from .scan_update import ESTIMATE, ScanRules, process_scan
from .sparse_belief import SparseBelief


class SparseInformationSlam(Interruptible):
    """Exactly sparse extended information filter.

    The filter stores the map as an information matrix Λ, whose zeros state that two
    landmarks are independent given all others [1]_.  A motion links all *active*
    landmarks, those linked with the pose.  If a scan would raise their number above
    ``active_bound``, every other measurement of a mapped landmark corrects the belief
    as usual.  The filter then marginalises the pose, which links only the landmarks
    active so far, and estimates the pose again from the remaining measurements alone
    (relocation).  Λ stays exactly sparse and no measurement is used twice.  The filter
    loses odometry information, so its belief is less certain than that of the EKF, and
    never more certain.

    As long as the map holds no more than ``dense_limit`` landmarks, the filter is that
    of ``base`` itself, which is many times faster there, and cuts no link.  Later,
    means and covariances near the robot follow from a small dense matrix, from which
    all other landmarks have been eliminated.  This matrix is valid until the robot
    leaves its local map.  The elimination then repeats only the branches of the map
    that the robot left or entered.

    Parameters
    ----------
    motion_std, measurement_std, initial_pose, initial_pose_std, sensor, \
gate_probability, noise_at_rest, min_range
        As in :class:`EkfSlam`; ``measurement_std`` must be positive.
    base : {"ekf", "first_estimates", "observability_constrained"}
        The filter whose Jacobians are used.  Those of "ekf" make it overconfident on
        long drives; those of the others do not.
    active_bound : int or None
        Γ, the largest number of landmarks linked with the pose; at least 2.  The number
        is exceeded temporarily if a single scan holds more landmarks, or fewer than two
        measurements of mapped landmarks that determine the pose.  None: no bound; the
        filter is then an EKF in information form, and the matrix fills.
    sparsify : {"relocate", "prune"}
        "prune" cuts the weakest links between pose and landmarks instead, as the SEIF
        does [2]_.  This makes the filter overconfident; it is meant for comparisons.
    dense_limit : int
        Largest number of landmarks whose dense covariance is stored instead of Λ.
    belief_limit : int
        Largest number of landmarks for which ``belief`` computes a dense covariance.

    Raises
    ------
    ValueError
        If an argument is invalid.

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
    >>> slam.belief([7]).landmarks  # belief() returns the whole map
    array([[2., 0.]])
    """

    __repr__ = describe_filter

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
        dense_limit: int = 100,
        belief_limit: int = 5000,
        **settings: Any,
    ) -> None:
        self._scan_rules = ScanRules(
            motion_std,
            measurement_std,
            base=base,
            active_bound=active_bound,
            sparsify=sparsify,
            **settings,
        )
        self._dense_limit = argument_checks.whole("dense_limit", dense_limit, 0)
        self.belief_limit = argument_checks.whole("belief_limit", belief_limit, 1)
        self.reset(initial_pose, initial_pose_std)

    def reset(self, pose: ArrayLike, pose_std: ArrayLike) -> None:
        """Start a new run with an empty map, as `EkfSlam.reset`."""
        dense = self._scan_rules.dense()
        dense.reset(pose, pose_std)
        self._held: EkfSlam | SparseBelief = dense
        self.interrupted_in = ""

    def predict(self, odometry: ArrayLike, dt: float = 1.0) -> None:
        """Move the pose by one odometry reading, as :meth:`EkfSlam.predict`."""
        self.refuse_interrupted()
        if isinstance(self._held, EkfSlam):
            self._held.predict(odometry, dt)
            return
        noise = self._scan_rules.motion_noise
        moved = noise.motion.moved(odometry)
        pose = local_information.move(
            self._held.pose,
            np.array(moved),
            noise.over(moved, dt),
            from_mean=self._scan_rules.base == ESTIMATE,
        )
        vars(self._held).update(pose=pose, steps=self.steps + 1)

    def update(
        self, measurements: ArrayLike, landmark_ids: LandmarkIds | None = None
    ) -> UpdateReport:
        """Correct the belief with one scan, then map the landmarks seen first.

        Parameters and report as in :meth:`EkfSlam.update`.  Innovation, innovation
        covariance and NIS are those of all used measurements at the prior, whether
        they correct the pose or replace it.

        Raises
        ------
        ValueError
            If the arguments are malformed; the belief is then unchanged.
        numpy.linalg.LinAlgError
            If a covariance is not positive definite; the belief is then unchanged.
        """
        readings = argument_checks.scan(measurements)
        ids = argument_checks.identities(landmark_ids, len(readings), self)
        argument_checks.refuse_unusable(readings, ids)
        self.refuse_interrupted()
        if isinstance(self._held, EkfSlam):
            mapped = self._held.map.slots
            if len(mapped) + len(set(ids).difference(mapped)) <= self._dense_limit:
                return self._held.update(readings, ids)
        belief = self._belief
        if not ids:
            vars(belief).update(report=UpdateReport(), steps=belief.steps + 1)
        else:
            chosen = belief.new_local_map(ids)
            changes = chosen is not None or not belief.slots.keys() >= set(ids)
            undo = belief.checkpoint() if changes else attributes(belief)
            with changing(self, "update", undo):
                if chosen is not None:
                    belief.change_local_map(chosen)
                    belief.origin = belief.pose.mean[:2].copy()
                state, belief.report = process_scan(
                    (belief.local, belief.pose),
                    self._scan_rules,
                    (readings, ids),
                    belief.slots,
                    belief.free_slots(len(ids)),
                )
                belief.add(belief.report.added_ids)
                belief.local, belief.pose = state
                belief.steps += 1
        self._held = belief
        return belief.report

    @property
    def _belief(self) -> SparseBelief:
        """The belief in information form."""
        held = self._held
        return SparseBelief.of(held) if isinstance(held, EkfSlam) else held

    @property
    def _slots(self) -> Mapping[int, int]:
        """The place of each landmark, by identity."""
        held = self._held
        return held.map.slots if isinstance(held, EkfSlam) else held.slots

    def remove(self, landmark_ids: LandmarkIds) -> None:
        """Remove landmarks by marginalisation; the belief about all else is unchanged.

        Landmarks that were linked with the same removed one are linked afterwards.

        Parameters
        ----------
        landmark_ids : sequence of int
            Mapped landmarks, without repetition.

        Raises
        ------
        ValueError
            If one is not in the map; no landmark is then removed.
        """
        ids = argument_checks.mapped_identities(landmark_ids, self._slots)
        with self._changing("remove"):
            if ids:
                self._held.remove(ids)

    def merge(self, kept: int, gone: int) -> None:
        """Condition on two landmarks being the same, and remove the second.

        Parameters
        ----------
        kept, gone : int
            Two mapped landmarks.

        Raises
        ------
        ValueError
            If one is not in the map or both are the same; nothing is merged.
        numpy.linalg.LinAlgError
            As :meth:`EkfSlam.merge`, while the map is dense.
        """
        argument_checks.two_landmarks(kept, gone, self._slots)
        with self._changing("merge"):
            self._held.merge(kept, gone)

    def _changing(self, call: str) -> changing:
        """Return a block that edits the map; a dense filter refuses before it does."""
        held = self._held
        undo = None if isinstance(held, EkfSlam) else held.checkpoint()
        return changing(self, call, undo)

    def belief(self, landmark_ids: LandmarkIds | None = None) -> Belief:
        """Return a snapshot of the belief, for the whole map or a part of it.

        Parameters
        ----------
        landmark_ids : sequence of int, optional
            Return the marginal of the pose and these landmarks, in this order.
            ``belief([])`` is that of the pose.  The cost is low for landmarks near the
            robot.

        Raises
        ------
        ValueError
            If one is not in the map, or more than ``belief_limit`` are asked for.
        """
        self.refuse_interrupted()
        ids = argument_checks.asked_identities(landmark_ids, self._slots)
        argument_checks.refuse_large_belief(
            len(ids), self.belief_limit, "give landmark_ids"
        )
        if isinstance(self._held, EkfSlam):
            return self._held.belief(ids)
        return self._held.marginal(ids)

    def local_view(self, within: float) -> MapView:
        """Return the pose and the landmarks within a distance of it [m].

        The distance is extended by 10σ of the robot's position, because landmarks near
        the robot are rarely less certain than the robot itself.
        """
        within = argument_checks.distance("within", within)
        pose, ids = self.belief([]), self.landmark_ids
        away = np.hypot(*(self.landmarks - pose.pose[:2]).T)
        reach = within + 10 * np.sqrt(np.trace(pose.covariance[:2, :2]))
        belief = self.belief([ids[place] for place in np.flatnonzero(away <= reach)])
        return MapView(belief.mean, belief.covariance, belief.landmark_ids, ids)

    @property
    def landmark_ids(self) -> tuple[int, ...]:
        """The mapped landmarks, in the order of the belief."""
        self.refuse_interrupted()
        return tuple(self._slots)

    @property
    def local_ids(self) -> tuple[int, ...]:
        """The landmarks of the local map."""
        return self._belief.ids_of(self._belief.local.slots)

    @property
    def active_ids(self) -> tuple[int, ...]:
        """The landmarks linked with the pose."""
        belief = self._belief
        return belief.ids_of(belief.local.slots[belief.pose.is_linked])

    @property
    def landmarks(self) -> Array:
        """Positions of all landmarks, shape (n, 2) [m]; no covariance is computed."""
        held = self._held
        if isinstance(held, EkfSlam):
            return held.map.mean[3 : held.map.size].reshape(-1, 2).copy()
        return held.landmarks()

    @property
    def pose(self) -> Array:
        """(x, y, θ), shape (3,) [m, m, rad]; no covariance is computed."""
        held = self._held
        x, y, heading = (held.map if isinstance(held, EkfSlam) else held.pose).mean[:3]
        return np.array([x, y, wrap_angle(float(heading))])

    @property
    def link_count(self) -> int:
        """Number of nonzero 2 × 2 blocks of Λ, including the diagonal."""
        belief = self._belief
        return link_count(belief.map_, belief.local)

    @property
    def nbytes(self) -> int:
        """Memory of the belief [bytes]."""
        held = self._held
        if isinstance(held, EkfSlam):
            return sum(array.nbytes for array in held.map.arrays)
        return held.nbytes

    def state_dict(self) -> dict[str, Any]:
        """Return copies of the whole state, as arrays."""
        self.refuse_interrupted()
        name, base = type(self).__name__, self._scan_rules.base
        if isinstance(self._held, EkfSlam):
            names = {"estimator": np.array(name), "base": np.array(base)}
            return names | with_prefix("dense", self._held.state_dict(), "_")
        return as_arrays(self._held, name, base)

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from a saved state, as `EkfSlam.load_state_dict`."""
        name, base = type(self).__name__, self._scan_rules.base
        if isinstance(state, Mapping) and "dense_estimator" in state:
            saved_states.refuse_other_state(state, (), estimator=name, base=base)
            dense = self._scan_rules.dense()
            dense.load_state_dict(without_prefix(state, "dense", "_"))
            self._held = dense
        else:
            self._held = checked_state(state, name, base)
        self.interrupted_in = ""

    @property
    def steps(self) -> int:
        """Number of steps taken; it changes together with the belief."""
        return self._held.steps

    def report(self) -> UpdateReport:
        """Return the report of the last update once more."""
        self.refuse_interrupted()
        held = self._held
        return held.report() if isinstance(held, EkfSlam) else held.report


# --------------------------------------------------------------------------------------
# Conversion of a sparse belief to arrays, and checks of such arrays.


NUMBERS, COUNTS = saved_states.NUMBERS, saved_states.COUNTS
STATE: saved_states.Table = {
    "landmark_ids": (saved_states.IDS, "n"),
    "slots": (COUNTS, -1),
    "free": (COUNTS, -1),
    "nodes": (COUNTS, "m"),
    "parted": (COUNTS,),
    "origin": (NUMBERS, 2),
    "points": (NUMBERS, "2m"),
    "first": (NUMBERS, "2m"),
    **with_prefix("matrix", ROWS, "_"),
    "local_slots": (PLACES, "k"),
    "local_points": (NUMBERS, "2k"),
    "local_first": (NUMBERS, "2k"),
    "local_information": (NUMBERS, "2k", "2k"),
    "pose_mean": (NUMBERS, 3),
    "pose_gain": (NUMBERS, 3, "2k"),
    "pose_covariance": (NUMBERS, 3, 3),
    "pose_reference": (NUMBERS, 2),
}


def as_arrays(belief: SparseBelief, name: str, base: str) -> dict[str, Any]:
    """Return copies of the whole state, as arrays."""
    map_, local = belief.map_, belief.local
    order, size = map_.elimination, 2 * len(map_.information)
    order.grow(len(map_.information))
    parts = {"local": local, "pose": belief.pose}
    found = {
        "landmark_ids": list(belief.slots),
        "slots": list(belief.slots.values()),
        "free": belief.free,
        "nodes": order.nodes,
        "parted": order.dissected,
        "origin": belief.origin,
        "points": map_.points[:size],
        "first": map_.first[:size],
        **with_prefix("matrix", map_.information.state_dict(), "_"),
    }
    for key in STATE.keys() - found.keys():
        part, _, attribute = key.partition("_")
        found[key] = getattr(parts[part], attribute)
    names = {"estimator": np.array(name), "base": np.array(base)}
    return names | saved_states.write(found, STATE)


def checked_state(state: Mapping[str, Any], name: str, base: str) -> SparseBelief:
    """Return the belief that :func:`as_arrays` saved.

    Raises
    ------
    ValueError
        If the state belongs to another estimator, incomplete or inconsistent.
    """
    table = dict(sorted(STATE.items(), key=lambda item: item[1][0].dtype is np.float64))
    # Whole numbers are read first, because the shapes of the others follow from them.
    saved = saved_states.read(state, table, of={"estimator": name, "base": base})
    matrix, local, pose = (
        without_prefix(saved, part, "_") for part in ("matrix", "local", "pose")
    )
    map_ = local_information.SparseMap()
    map_.information.load_state_dict(matrix)
    count, places = len(map_.information), local["slots"]
    slots, free = _slots(saved, count)
    map_.points, map_.first = saved["points"], saved["first"]
    if len(places) and not 0 <= places.min() <= places.max() < count:
        raise ValueError(
            f"state['local_slots'] must lie in [0, {count}), got {places.min()} to "
            f"{places.max()}"
        )
    _load_order(saved, map_, places)
    saved_states.refuse_indefinite("state['pose_covariance']", pose["covariance"])
    try:
        chosen = local_information.LocalInformation.of(map_, places)
        belief = SparseBelief(
            slots,
            free,
            map_,
            replace(chosen, **local),
            local_information.ConditionalPose(**pose),
            saved["origin"],
        )
        covariance = belief.marginal([]).pose_covariance
    except np.linalg.LinAlgError:
        raise ValueError(
            "state['matrix_blocks'] must be a positive definite information matrix"
        ) from None
    saved_states.refuse_indefinite("the covariance of the pose of state", covariance)
    return belief


def _slots(saved: Mapping[str, Any], count: int) -> tuple[dict[int, int], list[int]]:
    ids = saved["landmark_ids"]
    slots, free = saved["slots"].tolist(), saved["free"].tolist()
    if sorted(slots + free) != list(range(count)) or len(ids) != len(slots):
        raise ValueError(
            f"state['slots'] and state['free'] must share out the {count} rows of the "
            f"matrix among {len(ids)} landmarks, got {len(slots)} and {len(free)}"
        )
    return dict(zip(ids, slots, strict=True)), free


def _load_order(
    saved: Mapping[str, Any], map_: local_information.SparseMap, local: IntArray
) -> None:
    """Load the elimination order; insert landmarks that it does not contain."""
    matrix, nodes = map_.information, saved["nodes"]
    if (nodes >= 2**50).any():
        raise ValueError(
            f"state['nodes'] must be whole numbers in [0, 2⁵⁰), got {nodes.max()}"
        )
    order = map_.elimination
    order.nodes = nodes
    order.dissected = int(saved["parted"])
    others = np.setdiff1d(np.flatnonzero(order.nodes == 0), local)
    others = others[matrix.is_filled(others)]
    if len(others):
        order.revise(matrix, map_.first, others)
    order.check(matrix, local)
