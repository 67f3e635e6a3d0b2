"""The exactly sparse extended information filter: a large map with few links.

`SparseInformationSlam` is the public filter; `as_arrays` and `checked_state` convert
its belief to a saved state and back.
"""

from __future__ import annotations

from collections.abc import Mapping
from math import inf
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ....arrays import Array, IntArray
from ...interface import Belief, MapView, UpdateReport, describe_filter
from ...models.bearing_range import wrap_angle
from ...support import argument_checks, saved_states
from ...support import argument_checks as pair_checks
from ...support.argument_checks import LandmarkIds
from ...support.undo import Undo, attributes, undo_all
from ..elimination import RestFactor
from ..multifrontal import Factor, SchurComplement, SubsetFactor
from .local_information import (
    ConditionalPose,
    FixedLandmarks,
    LocalInformation,
    SparseMap,
    link_count,
    move,
)
from .scan_update import ESTIMATE, ScanResult, ScanRules, Sparsity, process_scan
from .sparse_belief import SparseBelief


class SparseInformationSlam:
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

    Means and covariances near the robot follow from a small dense matrix, from which
    the surrounding landmarks have been eliminated.  This matrix is valid until the
    robot leaves its local map.  The elimination then repeats only the branches of the
    map that the robot left or entered.

    Parameters
    ----------
    motion_std, measurement_std, initial_pose, initial_pose_std, range_std_per_metre, \
range_noise_at, gate_probability, noise_at_rest, min_range
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
    tolerance : float
        Corrections of distant landmarks are deferred while they are smaller than this
        fraction of the landmark's standard deviation given its neighbours.  No
        correction is lost.  With 0 every mean is exact, and the filter eliminates the
        whole map whenever the robot leaves its local map.
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
        tolerance: float = 1e-3,
        belief_limit: int = 5000,
        **settings: Any,
    ) -> None:
        self._scan_rules = ScanRules(motion_std, measurement_std, base=base, **settings)
        bound: float = inf
        if active_bound is not None:
            bound = argument_checks.whole("active_bound", active_bound, 2)
        kind = argument_checks.one_of("sparsify", sparsify, ("relocate", "prune"))
        self._sparsity = Sparsity(bound, kind == "prune")
        self._tolerance = argument_checks.at_least("tolerance", tolerance, 0.0)
        self.belief_limit = argument_checks.whole("belief_limit", belief_limit, 1)
        self.reset(initial_pose, initial_pose_std)

    def reset(self, pose: ArrayLike, pose_std: ArrayLike) -> None:
        """Start a new run with an empty map, as `EkfSlam.reset`."""
        first = argument_checks.finite_vector("pose", pose, 3)
        std = argument_checks.standard_deviations("pose_std", pose_std, 3)
        self._belief = SparseBelief.empty(first, std)

    def predict(self, odometry: ArrayLike, dt: float = 1.0) -> None:
        """Move the pose by one odometry reading, as :meth:`EkfSlam.predict`."""
        distance, turn = argument_checks.pair("odometry", odometry)
        variance = self._scan_rules.motion_noise.over(distance, turn, dt)
        self._belief.pose = move(
            self._belief.pose,
            np.array([distance, turn]),
            variance,
            from_mean=self._scan_rules.base == ESTIMATE,
        )

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
        ids = argument_checks.given_identities(landmark_ids, len(readings), self)
        argument_checks.refuse_unusable(readings, ids)
        if not ids:
            return UpdateReport()
        with self._belief.undone_on_error():
            self._belief.choose_local_map(ids, exact=self._is_exact)
            result = self._process(readings, ids)
            while result.largest_residual > self._tolerance:
                self._belief.enlarge_elimination()
                result = self._process(readings, ids)
            self._belief.add(result.report.added_ids, result.added_slots)
            self._belief.pose, self._belief.local = result.pose, result.local
        return result.report

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
        ids = argument_checks.mapped_identities(landmark_ids, self._belief.slots)
        if ids:
            self._belief.remove(ids, exact=self._is_exact)

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
        """
        pair_checks.two_landmarks(kept, gone, self._belief.slots)
        self._belief.merge(kept, gone, exact=self._is_exact)

    def belief(self, landmark_ids: LandmarkIds | None = None) -> Belief:
        """Return a snapshot of the belief, for the whole map or a part of it.

        Parameters
        ----------
        landmark_ids : sequence of int, optional
            Return the marginal of the pose and these landmarks, in this order.
            ``belief([])`` is that of the pose.  The first call after a change of the
            local map factorises the rest of the map.  Later calls are cheap if they
            ask for landmarks near the robot.

        Raises
        ------
        ValueError
            If one is not in the map, or more than ``belief_limit`` are asked for.
        """
        ids = argument_checks.asked_identities(landmark_ids, self._belief.slots)
        argument_checks.refuse_large_belief(
            len(ids), self.belief_limit, "give landmark_ids"
        )
        answer = self._belief.marginal(ids)
        return Belief(answer.mean, answer.covariance, tuple(ids), "additive")

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
        return tuple(self._belief.slots)

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
        return self._belief.landmarks()

    @property
    def pose(self) -> Array:
        """(x, y, θ), shape (3,) [m, m, rad]; no covariance is computed."""
        x, y, heading = self._belief.pose.mean
        return np.array([x, y, wrap_angle(heading)])

    @property
    def link_count(self) -> int:
        """Number of nonzero 2 × 2 blocks of Λ, including the diagonal."""
        return link_count(self._belief.map_, self._belief.local)

    @property
    def nbytes(self) -> int:
        """Memory of the belief [bytes]."""
        return self._belief.nbytes

    def state_dict(self) -> dict[str, Any]:
        """Return copies of the whole state, as arrays."""
        return as_arrays(self._belief, type(self).__name__, self._scan_rules.base)

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from a saved state, as `EkfSlam.load_state_dict`."""
        name, base = type(self).__name__, self._scan_rules.base
        self._belief = checked_state(state, name, base)

    def checkpoint(self, *, motion: bool = False) -> Undo:
        """Return what takes back later calls; ``motion``: only those of predict."""
        undo_belief = attributes(self._belief) if motion else self._belief.checkpoint()
        return undo_all(undo_belief, attributes(self))

    @property
    def _is_exact(self) -> bool:
        """Whether every correction must reach the whole map at once."""
        return not self._tolerance

    def _process(self, readings: Array, ids: list[int]) -> ScanResult:
        belief = self._belief
        return process_scan(
            (belief.local, belief.pose),
            self._scan_rules,
            self._sparsity,
            (readings, ids),
            belief.slots,
            belief.free_slots(len(ids)),
        )


# --------------------------------------------------------------------------------------
# Conversion of a sparse belief to arrays, and checks of such arrays.

_PARTS = {
    "matrix": ("counts", "links", "blocks"),
    "local": ("slots", "points", "first", "information", "start"),
    "around": ("slots", "border", "response", "complement"),
    "outer": ("slots", "response", "residual", "scale"),
    "pose": ("mean", "gain", "covariance", "reference"),
}
_MAP = ("points", "first", "residual")
_OTHERS = ("landmark_ids", "slots", "free", "nodes", "parted")
_LOCAL_MAP = ("origin", "reach", "widened")
_WHOLE_NUMBERS = {"counts", "links", "border", "slots"}
_LARGEST_WHOLE = 2.0**53


def as_arrays(belief: SparseBelief, name: str, base: str) -> dict[str, Any]:
    """Return copies of the whole state, as arrays."""
    map_, local = belief.map_, belief.local
    dissection = map_.elimination.dissection
    dissection.grow(len(map_.information))
    parts = {
        "local": local,
        "around": local.eliminated,
        "outer": local.fixed,
        "pose": belief.pose,
    }
    return {
        "estimator": np.array(name),
        "base": np.array(base),
        "landmark_ids": np.array(list(belief.slots), dtype=np.int64),
        "slots": np.array(list(belief.slots.values()), dtype=np.int64),
        "free": np.array(belief.free, dtype=np.int64),
        "nodes": dissection.nodes.copy(),
        "parted": np.array(dissection.dissected),
        "origin": belief.origin.copy(),
        "reach": np.array(float(belief.count)),
        "widened": np.array(belief.enlarged),
        **{k: getattr(map_, k)[: 2 * len(map_.information)].copy() for k in _MAP},
        **{f"matrix_{k}": v for k, v in map_.information.state_dict().items()},
        **{
            f"{prefix}_{key}": getattr(part, key).copy()
            for prefix, part in parts.items()
            for key in _PARTS[prefix]
        },
    }


def checked_state(state: Mapping[str, Any], name: str, base: str) -> SparseBelief:
    """Return the belief that :func:`as_arrays` saved.

    Raises
    ------
    ValueError
        If the state is of another estimator, incomplete or inconsistent.
    """
    entries = [f"{prefix}_{key}" for prefix, keys in _PARTS.items() for key in keys]
    entries += [*_OTHERS, *_MAP, *_LOCAL_MAP]
    saved_states.refuse_other_state(state, entries, estimator=name, base=base)
    map_ = SparseMap()
    map_.information.load_state_dict(_part(state, "matrix"))
    count = len(map_.information)
    slots, free = _slots(state, count)
    map_.points, map_.first, map_.residual = (
        saved_states.array(key, state[key], (2 * count,)) for key in _MAP
    )
    pose = ConditionalPose(**_part(state, "pose"))
    of_local = _part(state, "local")
    local = LocalInformation(
        **of_local,
        eliminated=_eliminated(map_, of_local["slots"], _part(state, "around")),
        fixed=FixedLandmarks(**_part(state, "outer")),
    )
    _check_shapes(local, pose)
    _check_slots(local, count)
    _load_dissection(state, map_, local.slots)
    origin = saved_states.array("origin", state["origin"], (2,))
    reach = argument_checks.as_floats("state['reach']", state["reach"])
    if reach.shape != (1,) or not reach[0] > 0:
        raise ValueError(f"state['reach'] must be a number > 0, got {state['reach']!r}")
    widened = saved_states.flag("widened", state["widened"])
    belief = SparseBelief(
        slots, free, map_, local, pose, origin, float(reach[0]), widened
    )
    _check_definite(belief)
    return belief


def _check_definite(belief: SparseBelief) -> None:
    """Raise a ValueError where pose or map have no positive definite covariance."""
    saved_states.refuse_indefinite("state['pose_covariance']", belief.pose.covariance)
    try:
        pose = belief.marginal([]).covariance
    except np.linalg.LinAlgError:
        raise ValueError(
            "state['matrix_blocks'] must be a positive definite information matrix"
        ) from None
    saved_states.refuse_indefinite("the covariance of the pose of state", pose)


def _slots(state: Mapping[str, Any], count: int) -> tuple[dict[int, int], list[int]]:
    ids = saved_states.landmark_ids("landmark_ids", state["landmark_ids"])
    slots, free = (
        saved_states.whole_numbers(key, state[key], (-1,), 0).tolist()
        for key in ("slots", "free")
    )
    if sorted(slots + free) != list(range(count)) or len(ids) != len(slots):
        raise ValueError(
            f"state['slots'] and state['free'] must share out the {count} rows of the "
            f"matrix among {len(ids)} landmarks, got {len(slots)} and {len(free)}"
        )
    return dict(zip(ids, slots, strict=True)), free


def _eliminated(
    map_: SparseMap, local: IntArray, around: dict[str, Any]
) -> SchurComplement:
    """Return the saved complement; its factor is made when it is first used."""
    slots, response = around["slots"], around["response"]
    factor: Factor = SubsetFactor(map_.information, slots, response)
    if len(slots) and not len(response):
        factor = RestFactor(map_.elimination, map_.information, local)
    return SchurComplement(**around, factor=factor)


def _load_dissection(
    state: Mapping[str, Any], map_: SparseMap, local: IntArray
) -> None:
    """Load the elimination order; insert landmarks that it does not contain."""
    matrix, count = map_.information, len(map_.information)
    nodes = saved_states.whole_numbers("nodes", state["nodes"], (count,), 0)
    if (nodes >= 2**50).any():
        raise ValueError(
            f"state['nodes'] must be whole numbers in [0, 2⁵⁰), got {nodes.max()}"
        )
    dissection = map_.elimination.dissection
    dissection.nodes = nodes
    dissection.dissected = saved_states.whole_number("parted", state["parted"])
    others = np.setdiff1d(np.flatnonzero(dissection.nodes == 0), local)
    others = others[matrix.is_filled(others)]
    if len(others):
        dissection.revise(matrix, map_.first, others)
    dissection.check(matrix, local)


def _part(state: Mapping[str, Any], prefix: str) -> dict[str, Any]:
    """Return copies of the entries with a prefix, all of them finite numbers."""
    part: dict[str, Any] = {}
    for key in _PARTS[prefix]:
        values = saved_states.array(f"{prefix}_{key}", state[f"{prefix}_{key}"])
        if key not in _WHOLE_NUMBERS:
            part[key] = values
            continue
        if (np.abs(values) > _LARGEST_WHOLE).any():
            raise ValueError(f"state['{prefix}_{key}'] must be whole numbers <= 2⁵³")
        part[key] = values.astype(np.int64)
    return part


def _check_shapes(local: LocalInformation, pose: ConditionalPose) -> None:
    eliminated, fixed = local.eliminated, local.fixed
    k, c = 2 * len(local.slots), len(eliminated.border)
    h = 2 * len(eliminated.slots) if len(eliminated.response) else 0
    o = 2 * len(fixed.slots)
    for name, array, shape in (
        ("pose_mean", pose.mean, (3,)),
        ("pose_gain", pose.gain, (3, k)),
        ("pose_covariance", pose.covariance, (3, 3)),
        ("pose_reference", pose.reference, (2,)),
        ("local_points", local.points, (k,)),
        ("local_first", local.first, (k,)),
        ("local_information", local.information, (k, k)),
        ("local_start", local.start, (c,)),
        ("around_response", eliminated.response, (h, c)),
        ("around_complement", eliminated.complement, (c, c)),
        ("outer_response", fixed.response, (o, c)),
        ("outer_residual", fixed.residual, (o,)),
        ("outer_scale", fixed.scale, (o // 2, 2, 2)),
    ):
        if array.shape != shape:
            raise ValueError(f"state[{name!r}] must be {shape}, got {array.shape}")


def _check_slots(local: LocalInformation, count: int) -> None:
    for name, slots, end in (
        ("local_slots", local.slots, count),
        ("around_slots", local.eliminated.slots, count),
        ("outer_slots", local.fixed.slots, count),
        ("around_border", local.eliminated.border, 2 * len(local.slots)),
    ):
        if len(slots) and not 0 <= slots.min() <= slots.max() < end:
            raise ValueError(
                f"state[{name!r}] must lie in [0, {end}), got {slots.min()} to "
                f"{slots.max()}"
            )
