"""Take in a clear scan by compiled calls: all of its readings are of the map.

A scan is clear if its best association gives every reading a landmark, and any other
leaves the same belief.
`associate_clear` associates it, and `count_clear` counts what it has shown and missed,
as `associate` and the pruner do with any scan.  Every other scan is left to these: one
with a new or an ambiguous reading, one while landmarks are tentative, or of a robot
that may be lost.

`ClearScans` keeps what the kernels count in a block of memory.  The records that all
other steps use, `Candidates` and `LandmarkRecords`, are renewed from it when needed.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import accumulate
from typing import Any, NamedTuple

import numpy as np

from ...arrays import Array, IntArray
from ...jit import jit, njit_allocating, njit_inlined, njit_internal
from ..association.missed_landmarks import (
    PROVEN,
    LostEvidence,
    count_scan,
    evidence_of_heading_jit,
    evidence_of_misses_jit,
    evidence_of_readings_jit,
)
from ..association.scan_assignments import NEW, SAME, AssociationSensor, assign_jointly
from ..association.scan_association import Candidates
from ..association.tentative_landmarks import (
    MEMORY,
    RINGS,
    SECTORS,
    UnexplainedDensity,
    count_readings,
    fill_density,
    longest_jit,
    per_scan_jit,
)
from ..filters.ekf import EkfSlam
from ..filters.gaussian_map import (
    LANDMARKS,
    GaussianMap,
    Parts,
    parts_jit,
    parts_of,
    update_map,
)
from ..guards.argument_checks import aligned_copy
from ..interface import MapView, SlamEstimator, hides_its_belief
from ..kernels.scan_update import DONE, OUTCOME, SLOT, USED, usable
from ..models.bearing_range import wrap_angle
from ..models.relative_geometry import variance_from_robot
from ..models.sensors import BEARING_RANGE
from .loop_closing import ACCURATE, FEWEST_READINGS
from .policy import LandmarkPolicy
from .pruning import LandmarkRecords, add_sightings, noise_of_sightings

#: Difference of −2 ln of probabilities: hypotheses e²⁰ = 5e8 times less probable than
#: the best one are discarded.
SPREAD = 40.0


class ClearScans:
    """The memory of one hypothesis for clear scans.

    Parameters
    ----------
    slam : EkfSlam
        The filter of the hypothesis, for which :meth:`serve` is true.
    policy : LandmarkPolicy
    sensor : AssociationSensor
    """

    def __init__(
        self, slam: Any, policy: LandmarkPolicy, sensor: AssociationSensor
    ) -> None:
        self._slam, self._settings = slam, settings_of(policy, sensor)
        self._capacity = policy.capacity or math.inf
        self._tally: Array | None = None
        self._path: list[list[float]] = []
        #: Number of scans taken in since the records were renewed.
        self.ahead = 0
        #: Number of the last one, and whether the filter has used all its readings.
        self.number, self.is_used = 0, True

    @staticmethod
    def serve(slam: SlamEstimator, policy: LandmarkPolicy) -> bool:
        """Return whether this filter and policy do with a scan what the kernel does."""
        return (
            isinstance(slam, EkfSlam)
            and type(slam).predict is EkfSlam.predict
            and type(slam).update is EkfSlam.update
            and type(slam)._update_map is update_map
            and type(slam.map) is GaussianMap
            and slam.sensor == BEARING_RANGE
            and slam.rules.gate == math.inf
            and not hides_its_belief(slam)
            and policy.association in ("hypotheses", "joint")
            and policy.remove_after is None
            and policy.merge_within is None
        )

    def take(
        self,
        candidates: Candidates,
        records: LandmarkRecords,
        readings: Array,
        ids: IntArray,
        *,
        given: bool,
    ) -> bool:
        """Take in a scan if it is clear; return whether it was.

        Parameters
        ----------
        candidates, records
            As renewed last.
        readings : ndarray, shape (m, 2)
            Rows (β, r) [rad, m].
        ids : ndarray of int64, shape (m,)
            Their landmarks, which are filled unless given.
        given : bool
            Whether the landmarks are given.
        """
        gaussian = self._slam.map
        if self._tally is None:
            mapped = gaussian.parts.ids[: gaussian.parts.numbers[LANDMARKS]].tolist()
            is_full = len(mapped) > self._capacity
            if is_full or not may_be_clear(candidates, records, mapped):
                return False
            self._tally = new_tally(candidates, records, self._settings)
        if given:
            if not all(map(gaussian.slots.__contains__, ids.tolist())):
                return False
        else:
            slots = associate_clear(gaussian.block, self._tally, readings, ids)
            if len(slots) == 0 or (len(slots) > 1 and self._splits(slots, readings)):
                return False
        if gaussian.take_in(update_map, readings, ids) != DONE:
            return False
        done = count_clear(gaussian.block, self._tally, readings, given)
        is_afar, self.is_used = done
        self.number, self.ahead = candidates.scan + self.ahead, self.ahead + 1
        if is_afar:
            mean, P = gaussian.parts.mean[:3], gaussian.parts.covariance[:3, :3]
            self._path.append([self.number, *mean.tolist(), *P.ravel().tolist()])
        return True

    @property
    def is_loaded(self) -> bool:
        """Whether the memory holds the records, and no landmark is tentative."""
        return self._tally is not None

    def forget(self) -> None:
        """Forget all scans, since other records begin."""
        self._tally, self._path, self.ahead = None, [], 0

    def _splits(self, slots: IntArray, readings: Array) -> bool:
        """Return whether a hypothesis would follow another association than the best.

        It would not, if both leave nearly the same belief.
        """
        gaussian, views = self._slam.map, []
        ids, size = gaussian.parts.ids, gaussian.size
        for each in slots:
            rows, copy = each >= 0, aligned_copy(gaussian.block)
            if update_map(copy, readings[rows], ids[each[rows]]) != DONE:
                return True
            after = parts_of(copy)
            views.append(MapView(after.mean, after.covariance, range(size // 2 - 1)))
        return not all(is_near(views[0], view) for view in views[1:])

    def renew(self, before: Candidates, records: LandmarkRecords) -> Candidates:
        """Return the candidates after the scans taken in; renew the records."""
        if self._tally is None:
            return before
        tally, self._tally = tally_of(self._tally), None
        if not self.ahead:
            return before
        records.misses, records.information = tally.misses, tally.information
        known, numbers = before.detections, tally.numbers.tolist()
        path = np.vstack([known.path, *self._path]) if self._path else known.path
        lost = LostEvidence(*numbers[EVIDENCE:SUMS])
        lost = lost._replace(first_new=int(tally.whole[FIRST_NEW]))
        detections = known._replace(
            detected=tally.detected,
            missed=_renewed(known.missed, records.ids, tally.missed, 1.0),
            shown=_renewed(known.shown, records.ids, tally.shown, 0),
            lost=lost,
            path=path,
        )
        sums = zip(UnexplainedDensity._fields, numbers[SUMS:PLACE], strict=False)
        density = before.density._replace(**dict(sums))
        scan, self.ahead, self._path = before.scan + self.ahead, 0, []
        return before._replace(scan=scan, density=density, detections=detections)


def may_be_clear(
    candidates: Candidates, records: LandmarkRecords, mapped: Sequence[int]
) -> bool:
    """Return whether scans of a map of these landmarks may be clear."""
    return (
        [*records.ids] == mapped
        and not len(candidates.tentative.seen)
        and not records.doubtful
        and candidates.next_id > max(mapped, default=-1)
    )


def _renewed(
    before: Mapping[int, Any], ids: Sequence[int], values: Array | IntArray, usual: Any
) -> dict[int, Any]:
    """Return the present values by landmark, without the usual ones."""
    now = {**before, **dict(zip(ids, values.tolist(), strict=True))}
    return {i: value for i, value in now.items() if value != usual}


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


# --------------------------------------------------------------------------------------
# The memory of the kernel: a single block, as that of a filter.

# It begins with whole numbers: the landmarks of the map, the field of `LostEvidence`
# that is one, the largest identity, and whether the path of the run has a pose.
COUNT, FIRST_NEW, NEWEST, HAS_PLACE, WHOLE = 0, 1, 2, 3, 4

# The numbers after these: evidence that the run is lost, the sums of the density, the
# last place on the path, the evidence of the scan that waits, and the settings.
EVIDENCE, SUMS, PLACE, FEWER, SETTINGS, NUMBERS = 0, 8, 13, 15, 16, 40


class Tally(NamedTuple):
    """The parts of the block, in their order."""

    whole: IntArray  # (WHOLE,)
    numbers: Array  # (NUMBERS,)
    cells: Array  # (SECTORS, RINGS), of `UnexplainedDensity`
    detected: Array  # (3, SECTORS, RINGS), of `Detections`
    missed: Array  # this and the next (n,), of `Detections`, in the order of the map
    shown: IntArray
    misses: IntArray  # this (n,) and the next (n, 3), of `LandmarkRecords`
    information: Array
    next_detected: Array  # these (3 SECTORS RINGS,) and (n,) of a scan that waits
    next_missed: Array


class ClearRules(NamedTuple):
    """Settings of policy and sensor, all of them floats."""

    noise: tuple[float, float, float, float]  # of the sensor
    sighting: tuple[float, float, float, float]  # noise of a landmark's information
    min_range: float
    new_gate: float
    pair_gate: float
    density: float  # nan: as the scans suggest
    most: float  # assignments to consider
    nodes: float
    accurate: float  # a robot that knows no landmark so well may be astray [m]
    lost: float  # a landmark that is known less well may be lost [m]
    fewest: float  # landmarks of a map that may hold lost ones
    keeps_path: float


def settings_of(policy: LandmarkPolicy, sensor: AssociationSensor) -> Array:
    """Return the settings as an array."""
    splits, rules = policy.association == "hypotheses", policy.constellations
    lost = math.inf if rules is None else rules.lost_std
    least = 2 * rules.least if rules is not None and not rules.always else 0
    return np.array(
        [
            *sensor.noise,
            *noise_of_sightings(sensor.noise),
            sensor.min_range,
            policy.new_gate,
            policy.pair_gate,
            math.nan if policy.density is None else policy.density,
            policy.branches if splits else 1,
            policy.search_nodes,
            ACCURATE * lost if splits else math.inf,
            lost,
            least,
            splits,
        ]
    )


def new_tally(
    candidates: Candidates, records: LandmarkRecords, settings: Array
) -> Array:
    """Return the memory for a map, filled from its records."""
    ids, detections, density = records.ids, candidates.detections, candidates.density
    block = np.zeros(_starts(len(ids))[-1])
    block[:WHOLE].view(np.int64)[COUNT] = len(ids)
    tally = tally_of(block)
    first_new, place = detections.lost.first_new, detections.path[-1:, 1:3]
    tally.whole[FIRST_NEW:] = first_new, max(ids, default=-1), len(place)
    tally.numbers[EVIDENCE:SUMS], tally.numbers[SUMS:PLACE] = (
        detections.lost,
        density[:5],
    )
    tally.numbers[PLACE:FEWER] = place.ravel() if len(place) else 0.0
    tally.numbers[SETTINGS : SETTINGS + len(settings)] = settings
    tally.cells[:], tally.detected[:] = density.cells, detections.detected
    tally.missed[:] = [detections.missed.get(i, 1.0) for i in ids]
    tally.shown[:] = [detections.shown.get(i, 0) for i in ids]
    tally.misses[:], tally.information[:] = records.misses, records.information
    return block


def _starts(n: int) -> list[int]:
    cells = SECTORS * RINGS
    sizes = [WHOLE, NUMBERS, cells, 3 * cells, n, n, n, 3 * n, 3 * cells, n]
    return [*accumulate(sizes, initial=0)]


def tally_of(block: Array) -> Tally:
    """Return the parts of a block by name, without a copy."""
    whole = block[:WHOLE].view(np.int64)
    n, cells = whole[COUNT], SECTORS * RINGS
    a = WHOLE + NUMBERS
    b = a + 4 * cells
    return Tally(
        whole,
        block[WHOLE:a],
        block[a : a + cells].reshape((SECTORS, RINGS)),
        block[a + cells : b].reshape((3, SECTORS, RINGS)),
        block[b : b + n],
        block[b + n : b + 2 * n].view(np.int64),
        block[b + 2 * n : b + 3 * n].view(np.int64),
        block[b + 3 * n : b + 6 * n].reshape((n, 3)),
        block[b + 6 * n : b + 6 * n + 3 * cells],
        block[b + 6 * n + 3 * cells :],
    )


def lost_of(tally: Tally) -> LostEvidence:
    """Return the evidence that the run is lost."""
    e, first_new = tally.numbers, int(tally.whole[FIRST_NEW])
    return LostEvidence(e[0], e[1], e[2], first_new, e[4], e[5], e[6], e[7])


def settings_in(tally: Tally) -> ClearRules:
    """Return the settings by name."""
    s = tally.numbers[SETTINGS:]
    noise, sighting = (s[0], s[1], s[2], s[3]), (s[4], s[5], s[6], s[7])
    first = s[8], s[9], s[10], s[11], s[12], s[13]
    return ClearRules(noise, sighting, *first, s[14], s[15], s[16], s[17])


tally_jit, lost_jit = njit_inlined(tally_of), njit_inlined(lost_of)
settings_jit = njit_inlined(settings_in)


# --------------------------------------------------------------------------------------
# The kernels.  Loops in place of whole arrays compile in a fraction of the time.


@jit
def associate_clear(
    block: Array, tally_block: Array, readings: Array, ids: IntArray
) -> IntArray:
    """Associate a scan if all its readings are of the map, and count what it shows.

    Parameters
    ----------
    block : ndarray
        The memory of the filter, which stays as it is.
    tally_block : ndarray
        That of its hypothesis (:class:`Tally`): the counts of the scan wait in it.
    readings : ndarray, shape (m, 2)
        Rows (β, r) [rad, m].
    ids : ndarray of int64, shape (m,)
        Filled with the landmark of each reading.

    Returns
    -------
    ndarray of int64, shape (M, m)
        Slots of the associations to consider, the best one first; none if the scan is
        not clear.
    """
    parts, tally = parts_jit(block), tally_jit(tally_block)
    settings = settings_jit(tally)
    density, none = np.empty(len(readings)), np.empty((0, len(readings)), np.int64)
    is_known = tally.whole[COUNT] == parts.numbers[LANDMARKS]
    if not (is_known and _is_usable(readings, settings.min_range)):
        return none
    if _may_be_lost(parts, settings):
        return none
    _, per_scan, longest = _of_density(tally)
    fill_density(tally.cells, readings, longest, per_scan, density)
    costs, slots, explained = _assign(parts, readings, density, settings)
    best = _count_best(parts, tally, readings, costs, slots, explained)
    if (slots[best] < 0).any():
        return none
    for i in range(len(ids)):
        ids[i] = parts.ids[slots[best, i]]
    return _with_rivals(costs, slots, best)


@njit_allocating
def _with_rivals(costs: Array, slots: IntArray, best: int) -> IntArray:
    """Return the best association and those not far less probable; none to leave it.

    An unpaired reading that is new begins another tentative landmark.
    """
    kept, count = np.empty_like(slots), 1
    kept[0] = slots[best]
    for k in range(len(slots)):
        if k != best and costs[k] <= costs[best] + SPREAD:
            if (slots[k] == NEW).any():
                return kept[:0]
            kept[count] = slots[k]
            count += 1
    return kept[:count]


@njit_allocating
def _count_best(
    parts: Parts,
    tally: Tally,
    readings: Array,
    costs: Array,
    slots: IntArray,
    explained: IntArray,
) -> int:
    """Add what missed landmarks cost; return the best association, whose counts wait.

    See `Detections.after`.
    """
    best, is_telling = 0, np.empty(len(tally.missed), np.bool_)
    belief, (_, _, longest) = (parts.mean, parts.covariance), _of_density(tally)
    for k in range(len(slots)):
        for j in range(len(is_telling)):
            is_older = parts.ids[j] < tally.whole[FIRST_NEW]
            is_telling[j] = is_older and tally.shown[j] >= PROVEN
        detected, missed = tally.detected.copy(), tally.missed.copy()
        scan = slots[k], explained, readings
        cost, fewer = count_scan(belief, scan, is_telling, longest, detected, missed)
        costs[k] += cost
        if k == 0 or costs[k] < costs[best]:
            best, tally.numbers[FEWER] = k, fewer
            _copy(detected.ravel(), tally.next_detected)
            _copy(missed, tally.next_missed)
    return best


@njit_internal
def _is_usable(readings: Array, min_range: float) -> bool:
    """Return whether all readings can be associated."""
    for k in range(len(readings)):
        if not (usable(readings[k, 0]) and usable(readings[k, 1])):
            return False
        if readings[k, 1] < min_range:
            return False
    return True


@njit_internal
def _may_be_lost(parts: Parts, settings: ClearRules) -> bool:
    """Return whether the robot may be astray or a landmark lost: see `loop_closing`."""
    mean, P, n = parts.mean, parts.covariance, parts.numbers[LANDMARKS]
    is_astray, has_lost = n >= FEWEST_READINGS, False
    for c in range(3, 3 + 2 * n, 2):
        P[c, c + 1] = P[c + 1, c]  # of a large P, this part alone may be out of date
        dx, dy = mean[c] - mean[0], mean[c + 1] - mean[1]
        std = np.sqrt(max(variance_from_robot(P, c, dx, dy), 0.0))
        is_astray &= std > settings.accurate
        has_lost |= std > settings.lost
    return is_astray or (has_lost and n >= settings.fewest)


@njit_allocating
def _assign(
    parts: Parts, readings: Array, density: Array, settings: ClearRules
) -> tuple[Array, IntArray, IntArray]:
    """Assign a scan as `assign_scan` does."""
    missing, limits = np.empty(len(density)), np.full(len(density) + 1, np.inf)
    for k in range(len(density)):
        rho = density[k] if np.isnan(settings.density) else settings.density
        missing[k] = -2 * np.log(rho) - 2 * np.log(2 * np.pi)
    gates = settings.new_gate, settings.pair_gate, np.inf
    search = False, int(settings.most), int(settings.nodes)
    belief = parts.mean, parts.covariance, parts.numbers[LANDMARKS]
    scan = readings, missing, limits
    return assign_jointly(belief, scan, settings.noise, gates, search)


@njit_internal
def _copy(values: Array, to: Array) -> None:
    for k in range(len(values)):
        to[k] = values[k]


@njit_internal
def _of_density(tally: Tally) -> tuple[float, float, float]:
    """Return the number of scans and readings per scan, and the longest range."""
    sums = tally.numbers[SUMS:PLACE]
    return sums[1], per_scan_jit(sums[0], sums[1]), longest_jit(sums[2], sums[4])


@jit
def count_clear(
    block: Array, tally_block: Array, readings: Array, given: bool
) -> tuple[bool, bool]:
    """Count a scan of mapped landmarks that the filter has taken in.

    Parameters
    ----------
    block, tally_block : ndarray
        As of `associate_clear`.
    readings : ndarray, shape (m, 2)
        Rows (β, r) [rad, m].
    given : bool
        Whether the landmarks were given; else the counts of the scan wait.

    Returns
    -------
    is_afar : bool
        Whether the path of the run is to remember the pose.
    is_used : bool
        Whether the filter has used all readings.
    """
    parts, tally = parts_jit(block), tally_jit(tally_block)
    settings, lost, count = settings_jit(tally), lost_jit(tally), len(readings)
    scans, per_scan, longest = _of_density(tally)
    slots, outcomes, is_afar = parts.ledger[SLOT], parts.ledger[OUTCOME], False
    if not given:
        _copy(tally.next_detected, tally.detected.ravel())
        _copy(tally.next_missed, tally.missed)
        for k in range(count):
            tally.shown[slots[k]] = min(tally.shown[slots[k]] + 1, PROVEN)
        newest = tally.whole[NEWEST]
        lost = evidence_of_misses_jit(lost, tally.numbers[FEWER], newest)
        is_afar = settings.keeps_path > 0 and _is_afar(parts, tally, longest / RINGS)
    has_map = tally.whole[COUNT] > 0
    lost = evidence_of_heading_jit(lost, parts.covariance[2, 2], has_map)
    if not given:
        lost = evidence_of_readings_jit(lost, 0, count, per_scan, scans)
    e, tally.whole[FIRST_NEW] = tally.numbers[EVIDENCE:SUMS], lost.first_new
    e[0], e[1], e[2], e[4] = lost.present, lost.lasting, lost.largest, lost.surest
    e[5], e[6], e[7] = lost.unknown, lost.unexplained, lost.explained
    sums, none = tally.numbers[SUMS:PLACE], np.empty(0, np.int64)
    sums[2], sums[4] = count_readings(tally.cells, readings, none, (sums[2], sums[4]))
    sums[0], sums[1], sums[3] = MEMORY * sums[0], MEMORY * sums[1] + 1, MEMORY * sums[3]
    counts, used, heading = (tally.misses, tally.information), 0, parts.mean[2]
    seen, shown = np.empty(count, np.int64), np.empty((count, 2))
    for k in range(count):
        if outcomes[k] == USED:
            seen[used] = slots[k]
            shown[used, 0], shown[used, 1] = readings[k, 0], readings[k, 1]
            used += 1
    add_sightings(counts, seen[:used], shown[:used], heading, settings.sighting)
    return is_afar, used == count


@njit_internal
def _is_afar(parts: Parts, tally: Tally, step: float) -> bool:
    """Return whether the path is to remember the pose; note its place."""
    x, y, place = parts.mean[0], parts.mean[1], tally.numbers[PLACE:FEWER]
    if tally.whole[HAS_PLACE] and math.hypot(x - place[0], y - place[1]) < step:
        return False
    tally.whole[HAS_PLACE], place[0], place[1] = 1, x, y
    return True
