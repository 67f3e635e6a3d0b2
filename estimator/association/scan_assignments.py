"""Assign the readings of a scan to landmarks of a map, by one of several methods.

`assign_scan` applies the method that the `AssociationPolicy` names: the nearest
neighbour, or the most likely joint assignment.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from math import exp, inf, log, pi
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import chdtri

from ... import argument_checks
from ...arrays import Array, BoolArray, IntArray
from ...jit import jit, jit_in_place, njit_allocating, njit_internal
from ..interface import MapView
from ..kernels.assignment_search import (
    UNPAIRED,
    Problem,
    best_assignments,
    fill_expected,
    largest_change,
    least_distances,
    only_partners,
    settled_assignments,
)
from ..kernels.scan_update import copy_covariance
from ..models.bearing_range import (
    reading_slopes_jit,
    reading_variances_jit,
    wrap_angle_jit,
)
from ..models.relative_geometry import reading_covariance
from ..models.sensors import DELAYED, bearing_range_std, only_bearing_range, sensor_in

#: Difference of −2 ln of likelihoods: an assignment of a scan that is e⁸ = 3000 times
#: less likely than the best one is not considered.
BRANCH_SPREAD = 16.0

#: Least variance of a reading, so that S has an inverse.
TINY = float(np.finfo(np.float64).tiny)

#: Beliefs with the same landmarks are one if no coordinate changes by more σ: where
#: both are nearer, the next scans decide alike.
SAME = 1.0


class Assignments(NamedTuple):
    """The M assignments to consider for one scan, the most likely first."""

    #: −2 ln of the likelihood, up to a constant of the scan, shape (M,); 0 by nearest
    #: neighbour.
    costs: Array
    #: Place in the map of each reading's landmark, `NEW` or `AMBIGUOUS`, shape (M, m).
    slots: IntArray
    #: Landmarks that some reading may belong to, shape (k,).
    explained: IntArray


def assign_scan(
    policy: AssociationPolicy,
    view: MapView,
    readings: Array,
    noise: Noise,
    density: Array,
    *,
    ceiling: float = np.inf,
    most: int | None = None,
) -> Assignments:
    """Assign readings (m, 2) to the landmarks of a map.

    Parameters
    ----------
    policy : AssociationPolicy
        Method, gates and limits.
    view : MapView
        Pose and landmarks.
    readings : ndarray, shape (m, 2)
        Rows (β, r) [rad, m].
    noise : Noise
        Of the sensor.
    density : ndarray, shape (m,)
        Readings per scan that belong to no landmark of the map, where each reading is
        [1 / (rad m)].
    ceiling : float
        Cost beyond which only the most likely assignment is of interest.
    most : int, optional
        How many assignments at most, if fewer than the policy considers.
    """
    if policy.association == "nearest":
        fit = innovation_distances(view, readings, noise, policy.new_gate)
        explained = np.flatnonzero(np.isfinite(fit.squared).any(axis=0))
        return Assignments(
            np.zeros(1), nearest_neighbours(fit, policy)[None], explained
        )
    pairs_first, count = policy.association == "compatibility", len(readings)
    missing = np.zeros(count) if pairs_first else missing_costs(density)
    if most is None:
        most = policy.branches if policy.association == "hypotheses" else 1
    scan = readings, missing, _limits(policy.pair_gate if pairs_first else inf, count)
    gates = float(policy.new_gate), float(policy.pair_gate), float(ceiling)
    search = pairs_first, most, policy.search_nodes
    belief = *view[:2], len(view.ids)
    return Assignments(*assign_jointly(belief, scan, tuple(noise), gates, search))


@jit
def assign_jointly(
    belief: tuple[Array, Array, int],
    scan: tuple[Array, Array, Array],
    of_sensor: tuple[float, ...],
    gates: tuple[float, float, float],
    search: tuple[bool, int, int],
) -> tuple[Array, IntArray, IntArray]:
    """Assign a scan; return the fields of :class:`Assignments`.

    Parameters
    ----------
    belief : tuple
        Mean and covariance of the map, and its number of landmarks.
    scan : tuple
        The readings (m, 2), and ``missing`` and ``limits`` of the :class:`Problem`.
    of_sensor : tuple
        The fields of a :class:`Noise`.
    gates : tuple
        Largest νᵀ S⁻¹ ν of a reading and an explained landmark, and of a pair; cost
        beyond which only the first assignment found is of interest.
    search : tuple
        ``pairs_first`` of the :class:`Problem`, the largest number of assignments, and
        the limit of nodes.
    """
    (mean, P, landmarks), (readings, missing, limits) = belief, scan
    (new_gate, pair_gate, ceiling), (pairs_first, most, nodes) = gates, search
    rows = len(readings)
    squared = np.full((rows, landmarks), np.inf)
    unused = np.empty_like(squared)
    fill_distances(mean, P, readings, of_sensor, new_gate, (squared, unused))
    explained, feasible = _near_pairs(squared, pair_gate)
    near = len(explained)
    expected, joint = np.empty((near, 2)), np.empty((2 * near, 2 * near))
    fill_expected(mean, P, explained, expected, joint)
    innovations, variances = np.empty((rows, near, 2)), np.empty((rows, near, 2))
    pairs, of_map = (feasible, innovations, variances), (expected, joint)
    of_scan = innovations, joint, variances, feasible, missing
    problem = *of_scan, pair_gate, limits, pairs_first
    reach = most, BRANCH_SPREAD, ceiling
    costs, marks = missing[:0], np.empty((0, rows), np.int64)
    partners = only_partners(feasible)
    if len(partners) == rows and not pairs_first:
        _fill_pairs(pairs, readings, of_map, of_sensor, True)
        costs, marks = settled_assignments(problem, partners, *reach, SAME)
    if len(costs) == 1 and (marks[0] != UNPAIRED).all():
        return costs, explained[marks[0]].reshape((1, rows)), explained
    _fill_pairs(pairs, readings, of_map, of_sensor, False)
    if len(costs) > 0:
        distances = least_distances(Problem(*problem), marks)
    else:
        costs, marks, distances, _ = best_assignments(problem, *reach, nodes)
    slots, kept = _slots(problem, (costs, marks), distances, explained)
    return costs[:kept], slots[:kept], explained


@njit_allocating
def _slots(
    problem: tuple[Any, ...],
    found: tuple[Array, IntArray],
    distances: Array,
    explained: IntArray,
) -> tuple[IntArray, int]:
    """Return the slots of assignments, and how many are not superfluous.

    These move to the front of ``found``, costs and marks.
    """
    (costs, marks), pair_gate = found, Problem(*problem).gate
    slots, kept = np.empty_like(marks), 0
    for s in range(len(marks)):
        for i in range(marks.shape[1]):
            slots[kept, i] = AMBIGUOUS if distances[s, i] <= pair_gate else NEW
            if marks[s, i] != UNPAIRED:
                slots[kept, i] = explained[marks[s, i]]
        if not _is_superfluous(problem, marks[:kept], marks[s], slots[kept]):
            costs[kept] = costs[s]
            for i in range(marks.shape[1]):
                marks[kept, i] = marks[s, i]
            kept += 1
    return slots, kept


@njit_allocating
def _near_pairs(squared: Array, pair_gate: float) -> tuple[IntArray, BoolArray]:
    """Return the landmarks with a finite distance, (k,), and pairs to consider."""
    (rows, landmarks), count = squared.shape, 0
    explained = np.empty(landmarks, np.int64)
    feasible = np.empty(squared.shape, np.bool_)
    for j in range(landmarks):
        is_near = False
        for i in range(rows):
            is_near |= squared[i, j] < np.inf
            feasible[i, count] = squared[i, j] <= pair_gate
        if is_near:
            explained[count], count = j, count + 1
    return explained[:count], feasible[:, :count].copy()


@njit_internal
def _fill_pairs(
    pairs: tuple[BoolArray, Array, Array],
    readings: Array,
    of_map: tuple[Array, Array],
    of_sensor: tuple[float, ...],
    partners_only: bool,
) -> None:
    """Fill innovations and variances of all pairs, or of partners and landmark 0."""
    (feasible, innovations, variances), (expected, joint) = pairs, of_map
    noise = Noise(*of_sensor)
    for i in range(feasible.shape[0]):
        for j in range(feasible.shape[1]):
            if partners_only and j > 0 and not feasible[i, j]:
                continue
            bearing, distance = readings[i, 0] - expected[j, 0], expected[j, 1]
            innovations[i, j, 0] = wrap_angle_jit(bearing)
            innovations[i, j, 1] = readings[i, 1] - distance
            spread = joint[2 * j + 1, 2 * j + 1]
            q = likely_variances_jit(noise, readings[i, 1], distance, spread)
            variances[i, j, 0], variances[i, j, 1] = max(q[0], TINY), max(q[1], TINY)


@njit_allocating
def _is_superfluous(
    of_scan: tuple[Any, ...], better: IntArray, marks: IntArray, slots: IntArray
) -> bool:
    """Return whether these only leave out readings that hardly change the belief."""
    for other in better:
        is_part = ((slots == AMBIGUOUS) | (marks == other)).all()
        if is_part and largest_change(of_scan, other, marks) < SAME:
            return True
    return False


@lru_cache(maxsize=64)
def _limits(gate: float, rows: int) -> Array:
    """Return the largest νᵀ S⁻¹ ν of 0 … m pairs together, from that of one pair."""
    tail = exp(-gate / 2)  # P(χ² > gate), 2 degrees of freedom
    return np.append(np.inf, chdtri(2.0 * np.arange(1, rows + 1), tail))


def missing_costs(density: Array) -> Array:
    """Return λ = −2 ln ρ − 2 ln 2π of each reading, its cost without a landmark.

    Examples
    --------
    >>> missing_costs(np.array([0.02])).round(2)
    array([4.15])
    """
    return np.asarray(-2 * np.log(density) - 2 * log(2 * pi))


ASSOCIATIONS = ("auto", "nearest", "joint", "compatibility", "hypotheses")

#: Scans that fit the bits of one mask of a tentative landmark, an int64 ≥ 0.
MOST_SCANS = 63


@dataclass(frozen=True)
class AssociationPolicy:
    """How readings are associated, and when a new landmark is confirmed.

    Raises
    ------
    ValueError
        If a value is out of range.
    """

    #: How readings without identity are assigned to landmarks: "nearest", each reading
    #: to its most likely landmark; "joint", the most likely assignment of the whole
    #: scan; "compatibility", the most pairs that are jointly compatible (JCBB);
    #: "hypotheses", several joint assignments, followed until the readings decide
    #: between them; "auto", hypotheses, but joint in filters for large maps and those
    #: that observe the truth.
    association: str = "auto"
    #: Readings per scan from no landmark of the map, clutter and new landmarks
    #: [1 / (rad m)]; None: estimate it from the scans so far.
    density: float | None = None
    #: Most hypotheses at a time.
    hypotheses: int = 10
    #: Most assignments of one scan that a hypothesis splits into.
    branches: int = 4
    #: Limit of the search for joint assignments; beyond it the best found so far is
    #: taken.
    search_nodes: int = 2000
    #: A joint assignment pairs a reading and a landmark up to this νᵀ S⁻¹ ν, given the
    #: other pairs.  A reading that is farther than this from every landmark without a
    #: reading is of a new landmark.
    pair_gate: float = 15.0
    #: Whether the sightings before the confirming one count: the filter then repeats
    #: the scans since the first sighting, with the new landmark in them.
    backdate: bool = True
    #: A reading is of a landmark only up to this νᵀ S⁻¹ ν; χ² of 2 dof, here 99 %.
    match_gate: float = 9.21
    #: With "nearest", a reading is of a new landmark only if its νᵀ S⁻¹ ν to every
    #: known one is larger than this.  With every method, a landmark with a smaller
    #: νᵀ S⁻¹ ν to some reading is not missing.
    new_gate: float = 25.0
    #: Left out where two landmarks differ by less than this in −2 ln likelihood.
    ambiguity: float = 1.0
    #: (k, n): a landmark enters the map when k of n successive scans have shown it.  A
    #: landmark without identity must also be unlikely to be clutter, unless k is 1.
    confirm: tuple[int, int] = (3, 8)
    #: Whether landmarks that come with an identity enter at first sight.
    trust_ids: bool = True

    def __post_init__(self) -> None:
        argument_checks.one_of("association", self.association, ASSOCIATIONS)
        if self.density is not None:
            argument_checks.above("density", self.density, 0.0)
        for name in ("hypotheses", "branches", "search_nodes"):
            argument_checks.whole(name, getattr(self, name), 1)
        argument_checks.above("pair_gate", self.pair_gate, 0.0)
        argument_checks.flag("backdate", self.backdate)
        argument_checks.above("match_gate", self.match_gate, 0.0)
        argument_checks.at_least("new_gate", self.new_gate, self.match_gate)
        argument_checks.at_least("ambiguity", self.ambiguity, 0.0)
        argument_checks.flag("trust_ids", self.trust_ids)
        object.__setattr__(self, "confirm", _k_of_n(self.confirm))


def _k_of_n(value: Any) -> tuple[int, int]:
    with suppress(TypeError, ValueError):
        k, n = (argument_checks.whole("confirm", each, 1) for each in value)
        if k <= n <= MOST_SCANS:
            return k, n
    raise ValueError(
        f"confirm must be whole numbers (k, n) with 1 <= k <= n <= {MOST_SCANS}, "
        f"got {value!r}"
    )


class Noise(NamedTuple):
    """Noise of a sensor: a reading of range r has σβ + b / r and σr + k r.

    Examples
    --------
    >>> Noise(0.1, 0.5, bearing_std_metres=0.4).variances(np.array([4.0])).round(2)
    array([[0.04, 0.25]])
    """

    #: σβ [rad].
    bearing_std: float
    #: σr [m].
    range_std: float
    #: k.
    range_std_per_metre: float = 0.0
    #: b [m].
    bearing_std_metres: float = 0.0

    def variances(self, ranges: Array) -> Array:
        """Return the variances of bearing and range at ranges (m,) > 0, (m, 2)."""
        return np.array(bearing_range_std(self, ranges)).T ** 2


def with_readings(view: MapView, readings: Array, noise: Noise) -> MapView:
    """Return a map, without room behind it, with a new landmark for each reading."""
    mean, P = map(np.ascontiguousarray, view[:2])
    more = extended(mean, P, np.ascontiguousarray(readings), tuple(noise))
    return MapView(*more, range(len(view.ids) + len(readings)))


@jit
def extended(
    mean: Array, P: Array, readings: Array, of_sensor: tuple[float, ...]
) -> tuple[Array, Array]:
    """Return mean and covariance of a map with a new landmark for each reading."""
    noise, n, size = Noise(*of_sensor), len(mean), len(mean) + 2 * len(readings)
    places, C, turned = np.empty(size), np.empty((size, size)), np.empty(size)
    copy_covariance(P, C, n)
    for j in range(n):
        places[j] = mean[j]
    for i in range(len(readings)):
        direction, distance = mean[2] + readings[i, 0], readings[i, 1]
        cos, sin, a = np.cos(direction), np.sin(direction), n + 2 * i
        places[a], places[a + 1] = mean[0] + distance * cos, mean[1] + distance * sin
        turned[a], turned[a + 1] = -distance * sin, distance * cos
        for k in range(2):  # J P, then J (J P)ᵀ
            for j in range(n):
                C[a + k, j] = C[j, a + k] = P[k, j] + turned[a + k] * P[2, j]
        for b in range(n, a + 2):
            for k in range(2):
                own = C[b, k] + C[b, 2] * turned[a + k]
                C[a + k, b] = C[b, a + k] = own
        q = reading_variances_jit(noise, distance)
        C[a, a] += turned[a] * turned[a] * q[0] + cos * cos * q[1]
        C[a + 1, a + 1] += turned[a + 1] * turned[a + 1] * q[0] + sin * sin * q[1]
        C[a + 1, a] += turned[a] * turned[a + 1] * q[0] + cos * sin * q[1]
        C[a, a + 1] = C[a + 1, a]
    return places, C


class AssociationSensor(NamedTuple):
    """The properties of the sensor that association uses."""

    noise: Noise
    #: Readings closer than this have no usable bearing [m].
    min_range: float

    @classmethod
    def checked(
        cls, measurement_std: ArrayLike, options: Mapping[str, Any]
    ) -> AssociationSensor:
        """Read a sensor from the arguments of a filter, which has checked them."""
        sensor = sensor_in(options)
        if options.get("landmark_init") == DELAYED:
            sensor = sensor.delayed()
        only_bearing_range(sensor, "data association")
        noise = Noise(*sensor.noise(measurement_std))
        return cls(noise, options.get("min_range", 1e-3))


@jit_in_place
def likely_variances_jit(
    noise: Noise, measured: float, expected: float, spread: float
) -> tuple[float, float]:
    """Return (σβ², σr²) at the most likely range, given the reading and the map.

    The noise depends on the true range.  At the measured one, a reading that is short
    by chance looks too accurate, and at the expected one, the error of the map counts.
    Between them is ::

        r̂ = h + C / (C + σr²(h)) (z − h)

    Parameters
    ----------
    noise : Noise
    measured, expected : float
        z and h [m].
    spread : float
        C, the variance of h [m²].
    """
    total = spread + reading_variances_jit(noise, expected)[1]
    if total > 0:
        expected += spread / total * (measured - expected)
    return reading_variances_jit(noise, expected)


# What a reading is of, where it is not a slot of the map.
NEW, AMBIGUOUS = -1, -2


class Distances(NamedTuple):
    """How well each of m readings fits each of n landmarks."""

    #: νᵀ S⁻¹ ν, shape (m, n); infinite where beyond what was asked for.
    squared: Array
    #: νᵀ S⁻¹ ν + ln det S, shape (m, n): −2 ln of the likelihood, but for a constant.
    #:
    #: Of two landmarks at the same distance in σ, the more certain one is more likely.
    unlikelihood: Array


def innovation_distances(
    view: MapView, readings: Array, noise: Noise, largest: float
) -> Distances:
    """Compare every reading with every landmark of a map.

    ::

        ν = z − h(x),    S = H P Hᵀ + Q

    at the estimate.  The range alone excludes most pairs without their H: where
    ν_r² > largest (tr C + σr²) with C the covariance of l − p, νᵀ S⁻¹ ν is too large,
    whatever the bearing.

    Parameters
    ----------
    view : MapView
        (x, y, θ, l1x, …) and P of n landmarks.
    readings : ndarray, shape (m, 2)
        Rows (β, r) [rad, m].
    noise : Noise
        Of the sensor.
    largest : float
        Pairs with a νᵀ S⁻¹ ν above this may be left infinite.

    Examples
    --------
    >>> mean = np.array([0, 0, 0, 5.0, 0, 0, 5.0])
    >>> readings = np.array([(0.0, 5.2), (1.57, 4.9)])
    >>> view = MapView(mean, 0.01 * np.eye(7), (1, 2))
    >>> fit = innovation_distances(view, readings, Noise(0.1, 0.1), largest=25)
    >>> (fit.squared < 9.21).tolist()
    [[True, False], [False, True]]
    """
    shape = (len(readings), len(view.ids))
    fit = Distances(np.full(shape, np.inf), np.full(shape, np.inf))
    fill_distances(*view[:2], readings, tuple(noise), largest, tuple(fit))
    return fit


@jit_in_place
def fill_distances(
    mean: Array,
    covariance: Array,
    readings: Array,
    of_sensor: tuple[float, ...],
    largest: float,
    fit: tuple[Array, ...],
) -> None:
    """Fill the fields of :class:`Distances`, infinite before."""
    noise, (squared, unlikelihood) = Noise(*of_sensor), fit
    P, x, y, heading = covariance, mean[0], mean[1], mean[2]
    for j in range(squared.shape[1]):
        c = 3 + 2 * j
        dx, dy = mean[c] - x, mean[c + 1] - y
        distance = np.sqrt(dx * dx + dy * dy)
        if not distance > 0:
            continue
        xx = P[0, 0] + P[c, c] - 2 * P[0, c]
        yy = P[1, 1] + P[c + 1, c + 1] - 2 * P[1, c + 1]
        is_complete = False
        for k in range(len(readings)):
            nu_r = readings[k, 1] - distance
            farther = max(distance, readings[k, 1])
            most = noise.range_std + noise.range_std_per_metre * farther
            if nu_r * nu_r > largest * (xx + yy + most * most):
                continue
            if not is_complete:  # what the readings share, for few landmarks only
                is_complete = True
                slopes = reading_slopes_jit(dx, dy)
                s_bb, s_br, s_rr = reading_covariance(P, c, slopes)
                bearing = np.arctan2(dy, dx) - heading
            nu_b = wrap_angle_jit(readings[k, 0] - bearing)
            q = likely_variances_jit(noise, readings[k, 1], distance, s_rr)
            rr, bb = s_rr + q[1], s_bb + q[0]
            determinant = rr * bb - s_br * s_br
            if not determinant > 0:
                continue
            d = nu_b * nu_b * rr - 2 * nu_b * nu_r * s_br + nu_r * nu_r * bb
            d /= determinant
            if d <= largest:
                squared[k, j] = d
                unlikelihood[k, j] = d + np.log(determinant)


def nearest_neighbours(fit: Distances, policy: AssociationPolicy) -> IntArray:
    """Give each reading at most one landmark, and each landmark at most one reading.

    A reading belongs to the landmark under which it is most likely, among those whose
    νᵀ S⁻¹ ν is within the gate, if it is also that landmark's most likely reading.

    Parameters
    ----------
    fit : Distances
        Of m readings and n landmarks.
    policy : AssociationPolicy
        Its ``match_gate`` is the gate.  A reading farther than ``new_gate`` from every
        landmark belongs to none of them.  If −2 ln of the likelihood of the second-best
        landmark within the gate is larger by no more than ``ambiguity``, the reading is
        left out.

    Returns
    -------
    ndarray of int64, shape (m,)
        A slot of the map, `NEW`, or `AMBIGUOUS`: not to be used.

    Examples
    --------
    >>> d = np.array([[1.0, np.inf], [4.0, np.inf], [np.inf, 12.0], [np.inf, np.inf]])
    >>> nearest_neighbours(Distances(d, d), AssociationPolicy(ambiguity=0)).tolist()
    [0, -2, -2, -1]
    """
    rows = len(fit.squared)
    chosen = np.full(rows, NEW, dtype=np.int64)
    if not fit.squared.size:
        return chosen
    scores = np.where(fit.squared <= policy.match_gate, fit.unlikelihood, np.inf)
    chosen[fit.squared.min(axis=1) <= policy.new_gate] = AMBIGUOUS
    best = scores.argmin(axis=1)
    every = np.arange(rows)
    score = scores[every, best]
    is_mutual = scores.argmin(axis=0)[best] == every
    scores[every, best] = np.inf
    is_clear = is_mutual & (scores.min(axis=1) > score + policy.ambiguity)
    chosen[is_clear] = best[is_clear]
    return chosen
