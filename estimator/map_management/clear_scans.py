"""Process clear scans, whose readings decide nothing, by compiled calls.

A scan is clear if every other association that a hypothesis would follow leaves nearly
the same belief and the same tentative landmarks as the best one, and if the best one
confirms no landmark.  `associate_clear` associates it, and `count_clear` counts what it
has shown and missed, as `associate` and the pruner do for any scan.  If nothing is left
to decide, `associate_clear` updates the filter and counts, too.  `associate` and the
pruner process all other scans: those that split a hypothesis or confirm a landmark, and
those of a robot that may be lost.

`ClearScans` keeps what the kernels count in a block of memory.  The records that all
other steps use, `Candidates` and `LandmarkRecords`, are renewed from it when needed.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import accumulate
from typing import Any, NamedTuple

import numpy as np

from ...argument_checks import aligned_copy
from ...arrays import Array, BoolArray, IntArray
from ...jit import jit, jit_in_place, njit_allocating, njit_inlined, njit_internal
from ..association.missed_landmarks import (
    PROVEN,
    LostEvidence,
    count_scan,
    evidence_of_heading_jit,
    evidence_of_misses_jit,
    evidence_of_readings_jit,
)
from ..association.scan_assignments import (
    AMBIGUOUS,
    NEW,
    SAME,
    AssociationSensor,
    assign_jointly,
)
from ..association.scan_association import LABEL_BITS, NO_LABEL, Candidates
from ..association.tentative_landmarks import (
    MEMORY,
    RINGS,
    SECTORS,
    TentativeLandmarks,
    UnexplainedDensity,
    add_tentative,
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
    find_slots,
    parts_jit,
    parts_of,
    update_map,
)
from ..interface import MapView, SlamEstimator, hides_its_belief
from ..kernels.scan_update import DONE, OUTCOME, SLOT, USED, usable
from ..models.bearing_range import wrap_angle, wrap_angle_jit
from ..models.relative_geometry import variance_from_robot
from ..models.sensors import BEARING_RANGE
from .loop_closing import ACCURATE, FEWEST_READINGS, LOCAL_STD, NEAR_STDS
from .policy import LandmarkPolicy
from .pruning import LandmarkRecords, add_sighting, noise_of_sightings
from .recent_scans import RecentScans

#: Difference of −2 ln of probabilities: hypotheses e²⁰ = 5e8 times less probable than
#: the best one are discarded.
SPREAD = 40.0
_NO_SLOTS: IntArray = np.empty((1, 0), np.int64)  # where nothing is left to decide


class ClearScan(NamedTuple):
    """A scan as one hypothesis associates it."""

    #: Rows (β, r) [rad, m], shape (m, 2).
    readings: Array
    #: Number of the scan.
    number: int
    #: The landmark of each reading, and the label of its tentative landmark.
    row_ids: tuple[int | None, ...]
    labels: tuple[int, ...]
    #: The landmark of each reading that the filter uses, shape (m,); without a meaning
    #: where it uses none.
    names: IntArray
    #: The tentative landmarks after the scan.
    following: TentativeLandmarks
    #: What `count_clear` returned, where the scan has been taken in at once; else 0.
    counted: int
    #: −2 ln of the likelihood of the associations to consider, the best first.
    costs: Sequence[float] = (0.0,)
    #: Slot of the map of each reading, `NEW` or `AMBIGUOUS`, shape (M, m).
    slots: IntArray = _NO_SLOTS
    #: Place of the tentative landmark of each reading, or below 0, shape (m,).
    tentative_slots: IntArray = _NO_SLOTS[0]
    #: Rows of tentative landmarks, and those that are ambiguous.
    tentative_rows: tuple[int, ...] = ()
    ambiguous_rows: tuple[int, ...] = ()
    #: Whether the landmarks were given.
    is_given: bool = False


class ClearScans:
    """The memory of one hypothesis for clear scans.

    Parameters
    ----------
    slam : EkfSlam
        The filter of the hypothesis, for which :meth:`serve` is true.
    policy : LandmarkPolicy
    sensor : AssociationSensor
    recent : RecentScans
        Of the hypothesis: it notes the scans.
    """

    def __init__(
        self,
        slam: Any,
        policy: LandmarkPolicy,
        sensor: AssociationSensor,
        recent: RecentScans,
    ) -> None:
        self._slam, self._recent = slam, recent
        self._filter = filter_inside(slam)
        self._policy, self._noise = policy, sensor.noise
        self._settings = settings_of(policy, sensor)
        self.forget()

    @staticmethod
    def serve(slam: SlamEstimator, policy: LandmarkPolicy) -> bool:
        """Return whether the kernel does the same as this filter and policy."""
        inside: Any = filter_inside(slam)
        return (
            isinstance(inside, EkfSlam)
            and type(inside).predict is EkfSlam.predict
            and type(inside).update is EkfSlam.update
            and inside.update_kernel is update_map
            and type(inside.map) is GaussianMap
            and inside.sensor == BEARING_RANGE
            and inside.rules.gate == math.inf
            and not hides_its_belief(inside)
            and policy.association in ("hypotheses", "joint")
            and policy.remove_after is None
            and policy.merge_within is None
        )

    def forget(self) -> None:
        """Forget all scans, since other records begin."""
        self._tally: Any = None  # an array, where it holds the records
        self._path: list[list[float]] = []
        #: Number of scans taken in since the records were renewed.
        self._ahead = 0

    def associate(
        self,
        readings: Array,
        ids: IntArray | None,
        ceiling: float,
        candidates: Candidates,
        records: LandmarkRecords,
        alone: bool,
    ) -> ClearScan | None:
        """Associate a scan (m, 2); return None if it is not clear.

        Parameters
        ----------
        readings : ndarray, shape (m, 2)
            Rows (β, r) [rad, m].
        ids : ndarray of int64, shape (m,), or None
            The landmarks, if they are given.
        ceiling : float
            Cost beyond which only the best association is of interest.
        candidates, records
            As last renewed, but for the tentative landmarks.
        alone : bool
            Whether there is no other hypothesis.  If nothing is left to decide, the
            filter then takes in the scan at once.
        """
        if self._tally is None and not self._begin(candidates, records):
            return None
        gaussian, known = self._filter.map, candidates.tentative
        count, way, names = len(readings), ALONE if alone else 0, ids
        if alone and self._filter is self._slam and not len(known.seen):
            way |= AT_ONCE
            if (last := gaussian.newest()) is not None:  # inlined
                last.detach()
        if names is None:
            names = np.empty(count, np.int64)
        else:
            way |= GIVEN
        counted, found = self._by_kernel(known, readings, names, ceiling, way)
        if found is None and not counted:
            return None
        number, row_ids = candidates.scan + self._ahead, tuple(names.tolist())
        labels = (NO_LABEL,) * count
        scan = ClearScan(readings, number, row_ids, labels, names, known, counted)
        if found is None:
            return scan
        if ids is not None:
            following = known.after_scan(self._policy.confirm[1])
            return scan._replace(slots=found[1], following=following, is_given=True)
        return self._with_rows(scan, *found)

    def _by_kernel(
        self,
        known: TentativeLandmarks,
        readings: Array,
        names: IntArray,
        ceiling: float,
        way: int,
    ) -> tuple[int, Associations | None]:
        """Call `take_given` or `associate_clear`."""
        block, tally = self._filter.map.block, self._tally
        if way == GIVEN + ALONE + AT_ONCE:
            counted = take_given(block, tally, readings, names)
            if counted:  # else the filter may only need more room
                return counted, None
        tentative = known.mean, known.covariance, known.seen
        return associate_clear(block, tally, *tentative, readings, names, ceiling, way)

    def _begin(self, candidates: Candidates, records: LandmarkRecords) -> bool:
        """Make the memory of the kernels, if scans of this map may be clear."""
        mapped, capacity = [*self._filter.map.slots], self._policy.capacity or math.inf
        if (
            [*records.ids] != mapped
            or records.doubtful
            or candidates.next_id <= max(mapped, default=-1)
            or len(mapped) > capacity
        ):
            return False
        self._tally = new_tally(candidates, records, self._settings)
        return True

    def _with_rows(
        self,
        scan: ClearScan,
        costs: Array,
        slots: IntArray,
        tentative_slots: IntArray,
        chance: Array,
        density: Array,
    ) -> ClearScan | None:
        """Note what each row is of; return None if a tentative landmark is proven."""
        scan = scan._replace(
            costs=costs.tolist(), slots=slots, tentative_slots=tentative_slots
        )
        marks = slots[0].tolist()
        if min(marks, default=0) < 0:
            pairs = zip(scan.row_ids, marks, strict=True)
            scan = scan._replace(
                row_ids=tuple([i if slot >= 0 else None for i, slot in pairs]),
                tentative_rows=tuple(np.flatnonzero(slots[0] == NEW).tolist()),
                ambiguous_rows=tuple(np.flatnonzero(slots[0] == AMBIGUOUS).tolist()),
            )
        if not len(chance) and not scan.tentative_rows:
            return scan
        return self._with_tentative(scan, chance, density)

    def _with_tentative(
        self, scan: ClearScan, chance: Array, density: Array
    ) -> ClearScan | None:
        """Find the tentative landmarks after a scan; return None if one is proven.

        See `ScanAssociation`.  ``chance`` is the probability to miss each of them, and
        ``density`` that of readings of no known landmark [1 / (rad m)].
        """
        (needed, scans), tentative_slots = self._policy.confirm, scan.tentative_slots
        numbers, known = tally_of(self._tally).numbers, scan.following
        rows = np.flatnonzero(tentative_slots >= 0)
        if len(rows):
            shown = scan.readings[rows], self._noise, density[rows]
            known = known.with_sightings(tentative_slots[rows], *shown)
        known = known.with_misses(chance)
        fresh = [row for row in scan.tentative_rows if tentative_slots[row] < 0]
        if (len(rows) and known.proven(needed).any()) or (fresh and needed == 1):
            return None
        labels = np.append(known.labels, NO_LABEL)[np.maximum(tentative_slots, -1)]
        labels[fresh] = [(scan.number << LABEL_BITS) + row for row in fresh]
        if fresh:
            share = min(float(numbers[SHARE] / numbers[SUMS]), 1.0)
            added = scan.readings[fresh], self._noise, labels[fresh], share
            known = known.with_new(*added)
        following = known.after_scan(scans)
        return scan._replace(labels=tuple(labels.tolist()), following=following)

    def tried(self, scan: ClearScan, ceiling: float) -> list[tuple[float, Marginals]]:
        """Return the costs of associations up to a ceiling, and the beliefs after them.

        The best one comes first.  Those that the filter refuses are left out.
        """
        gaussian, found = self._filter.map, list[tuple[float, Marginals]]()
        names, ids = [*gaussian.slots], gaussian.parts.ids
        for cost, slots in zip(scan.costs, scan.slots, strict=True):
            if cost > ceiling:
                continue
            trial, rows = aligned_copy(gaussian.block), slots >= 0
            if update_map(trial, scan.readings[rows], ids[slots[rows]]) == DONE:
                after = marginals_of(parts_of(trial), names)
                copies = after.mean.copy(), after.variances.copy()
                found.append((cost, Marginals(*copies, names)))
        return found

    def marginals(self) -> Marginals:
        """Return the belief of the filter, valid until its next step."""
        gaussian = self._filter.map
        return marginals_of(gaussian.parts, [*gaussian.slots])

    def update(self, scan: ClearScan) -> bool:
        """Update by a scan as associated; return False if the filter refuses it."""
        recent, before, unused = self._recent, None, ()
        if scan.tentative_rows:
            before = recent.state_before(scan.number, scan.labels)
        counted = scan.counted or self._updated(scan)
        if not counted:
            return False
        self._ahead += 1
        if counted & AFAR:
            parts = self._filter.map.parts
            mean, P = parts.mean[:3], parts.covariance[:3, :3]
            self._path.append([scan.number, *mean.tolist(), *P.ravel().tolist()])
        if counted & UNUSED:
            report = self._slam.report()
            unused = *report.rejected_ids, *report.skipped_ids
        decided = scan.row_ids, scan.labels
        recent.note_clear(scan.number, scan.readings, decided, before, unused)
        return True

    def _updated(self, scan: ClearScan) -> int:
        """Update the filter by a scan, and count it; return 0 if it refuses."""
        gaussian, rows = self._filter.map, scan.slots[0] >= 0
        fed = scan.readings[rows], scan.names[rows]
        if self._filter is self._slam:
            if gaussian.take_in(update_map, *fed) != DONE:
                return 0
        else:
            try:
                self._slam.update(*fed)
            except (ValueError, np.linalg.LinAlgError):
                return 0
        read = scan.readings, scan.slots[0], scan.tentative_slots
        return count_clear(gaussian.block, self._tally, *read, int(scan.is_given))

    def renew(self, before: Candidates, records: LandmarkRecords) -> Candidates:
        """Return the candidates after the scans taken in; renew the records."""
        if self._tally is None:
            return before
        tally, ahead, path = tally_of(self._tally), self._ahead, self._path
        self.forget()
        if not ahead:
            return before
        records.misses, records.information = tally.miss_counts, tally.information
        known, numbers = before.detections, tally.numbers.tolist()
        lost = LostEvidence(*numbers[EVIDENCE:SUMS])
        lost = lost._replace(first_new=int(tally.whole[FIRST_NEW]))
        detections = known._replace(
            detected=tally.detected,
            missed=_renewed(known.missed, records.ids, tally.miss_chances, 1.0),
            shown=_renewed(known.shown, records.ids, tally.shown, 0),
            lost=lost,
            path=np.vstack([known.path, *path]) if path else known.path,
        )
        sums = zip(UnexplainedDensity._fields, numbers[SUMS:PLACE], strict=False)
        density = before.density._replace(**dict(sums), cells=tally.cells)
        number = before.scan + ahead
        return before._replace(scan=number, density=density, detections=detections)


def filter_inside(slam: Any) -> Any:
    """Return the filter inside a recorder, or any other filter itself."""
    return getattr(slam, "inside", slam)


def _renewed(
    before: Mapping[int, Any], ids: Sequence[int], values: Array | IntArray, usual: Any
) -> dict[int, Any]:
    """Return the present values by landmark, without the usual ones."""
    now = {**before, **dict(zip(ids, values.tolist(), strict=True))}
    return {i: value for i, value in now.items() if value != usual}


class Marginals(NamedTuple):
    """A belief without its correlations, to compare it with others."""

    #: In the order of the state, shape (3 + 2n,).
    mean: Array
    #: Of the additive error, shape (3 + 2n,).
    variances: Array
    #: Landmarks in the order of the state.
    ids: Sequence[int]


def marginals_of(belief: MapView | Parts, ids: Sequence[int]) -> Marginals:
    """Return the part of a belief that counts, without a copy."""
    size, variances = 3 + 2 * len(ids), belief.covariance.diagonal()
    return Marginals(belief.mean[:size], variances[:size], ids)


def is_near(one: Marginals, other: Marginals) -> bool:
    """Return whether two maps of the same landmarks have nearly the same belief.

    In every coordinate with means μ₁, μ₂ and deviations σ₁, σ₂, the second belief must
    not be far off the first one and not be much less certain::

        (μ₂ − μ₁)² + σ₂² − σ₁² ≤ (SAME σ₁)²
    """
    if one.ids != other.ids:
        return False
    gap = other.mean - one.mean
    gap[2] = wrap_angle(float(gap[2]))
    return bool(is_near_in(gap, one.variances, other.variances).all())


def is_near_in(gap: Any, variance: Any, other: Any) -> Any:
    """Return whether a second belief is near a first one in some coordinates."""
    return gap**2 + other <= (1 + SAME**2) * variance


# --------------------------------------------------------------------------------------
# The memory of the kernel: a single block, as that of a filter.

# It begins with whole numbers: the landmarks of the map, the field of `LostEvidence`
# that is one, the largest identity, and whether the path of the run has a pose.
COUNT, FIRST_NEW, NEWEST, HAS_PLACE, WHOLE = 0, 1, 2, 3, 4

# The numbers after these: evidence that the run is lost, the sums of the density, the
# last place on the path, the evidence of the scan that waits, and the settings.
EVIDENCE, SUMS, SHARE, PLACE, FEWER, SETTINGS, NUMBERS = 0, 8, 11, 13, 15, 16, 35


# How a kernel associates a scan.  GIVEN: the landmarks are given.  ALONE: there is no
# other hypothesis; a scan that splits it is not clear.  AT_ONCE: the filter may take in
# the scan.
GIVEN, ALONE, AT_ONCE = 1, 2, 4

# What has become of a scan.  TAKEN: the filter has taken it in.  UNUSED: it has not
# used all readings.  AFAR: the path of the run is to remember the pose.
TAKEN, UNUSED, AFAR = 1, 2, 4


class Tally(NamedTuple):
    """The parts of the block, in their order."""

    whole: IntArray  # (WHOLE,)
    numbers: Array  # (NUMBERS,)
    cells: Array  # (SECTORS, RINGS), of `UnexplainedDensity`
    detected: Array  # (3, SECTORS, RINGS), of `Detections`
    miss_chances: Array  # `missed` of `Detections` (n,), in the order of the map
    shown: IntArray  # (n,), of `Detections`
    miss_counts: IntArray  # this (n,) and the next (n, 3), of `LandmarkRecords`
    information: Array
    next_detected: Array  # these (3 SECTORS RINGS,) and (n,) of a scan that waits
    next_miss_chances: Array


#: −2 ln of the likelihood of associations, the best first, and their slots, as in
#: `ClearScan`; the tentative landmarks, the probability of missing each of them, and
#: the density of readings of no known landmark [1 / (rad m)].
Associations = tuple[Array, IntArray, IntArray, Array, Array]


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
    least: float  # landmarks of a constellation that recognises lost ones
    keeps_path: float
    hypotheses: float  # at most


def settings_of(policy: LandmarkPolicy, sensor: AssociationSensor) -> Array:
    """Return the settings as an array."""
    splits, rules = policy.association == "hypotheses", policy.constellations
    lost = math.inf if rules is None else rules.lost_std
    least = 0 if rules is None or rules.always else rules.least
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
            policy.hypotheses,
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
    tally.numbers[SETTINGS:] = settings
    tally.cells[:], tally.detected[:] = density.cells, detections.detected
    tally.miss_chances[:] = [detections.missed.get(i, 1.0) for i in ids]
    tally.shown[:] = [detections.shown.get(i, 0) for i in ids]
    tally.miss_counts[:], tally.information[:] = records.misses, records.information
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
    return ClearRules(noise, sighting, *first, s[14], s[15], s[16], s[17], s[18])


is_near_jit = njit_inlined(is_near_in)
tally_jit, lost_jit = njit_inlined(tally_of), njit_inlined(lost_of)
settings_jit = njit_inlined(settings_in)


# --------------------------------------------------------------------------------------
# The kernels.  Loops in place of whole arrays compile in a fraction of the time.


@jit
def associate_clear(  # noqa: PLR0917 (tuples would reach the kernel later)
    block: Array,
    tally_block: Array,
    tentative_mean: Array,
    tentative_covariance: Array,
    tentative_seen: IntArray,
    readings: Array,
    ids: IntArray,
    ceiling: float,
    way: int,
) -> tuple[int, Associations | None]:
    """Associate a scan; take it in at once if nothing is left to decide.

    Parameters
    ----------
    block, tally_block : ndarray
        The memory of the filter, and that of its hypothesis (:class:`Tally`), in which
        the counts of the scan wait.
    tentative_mean, tentative_covariance, tentative_seen : ndarray
        Of the `TentativeLandmarks`.
    readings : ndarray, shape (m, 2)
        Rows (β, r) [rad, m].
    ids : ndarray of int64, shape (m,)
        The landmarks, if they are given, else filled with those of the best
        association.
    ceiling : float
        Cost beyond which only the best association is of interest.
    way : int
        Any of `GIVEN`, `ALONE` and `AT_ONCE`, added up.

    Returns
    -------
    counted : int
        As of `count_clear` if the filter has taken in the scan; else 0, and its belief
        has not changed.
    found : tuple or None
        If the scan is clear, but not taken in: its associations.
    """
    parts, tally = parts_jit(block), tally_jit(tally_block)
    if tally.whole[COUNT] != parts.numbers[LANDMARKS]:
        return 0, None
    if way & GIVEN:
        found = _given(parts, ids, len(tentative_seen))
    else:
        tentative = tentative_mean, tentative_covariance, tentative_seen
        found = _associate(parts, tally, tentative, readings, ceiling)
    costs, slots = found[0], found[1]
    if way & ALONE:
        costs, slots = _unsplit(block, tally, readings, costs, slots)
    if len(slots) == 0:
        return 0, None
    is_single = way & (AT_ONCE + GIVEN) == AT_ONCE and len(slots) == 1
    is_single &= _name_readings(parts.ids, slots[0], ids)
    if is_single and update_map(block, readings, ids) == DONE:
        read = readings, slots[0], slots[0]
        return count_clear(block, tally_block, *read, 0), None
    return 0, (costs, slots, found[2], found[3], found[4])


@jit_in_place
def take_given(block: Array, tally_block: Array, readings: Array, ids: IntArray) -> int:
    """Take in a scan of given landmarks at once, and count it.

    The arguments are those of `associate_clear`.  Returns 0 if a landmark is new, or if
    the filter refuses the scan; then its belief has not changed.
    """
    parts, tally = parts_jit(block), tally_jit(tally_block)
    slots = parts.ledger[SLOT]
    if tally.whole[COUNT] != parts.numbers[LANDMARKS] or len(ids) > len(slots):
        return 0
    if find_slots(parts, ids, slots) > 0 or update_map(block, readings, ids) != DONE:
        return 0
    return count_clear(block, tally_block, readings, slots, slots, GIVEN)


@njit_internal
def _name_readings(ids: IntArray, slots: IntArray, names: IntArray) -> bool:
    """Write the landmark of each reading that has one; return whether all have."""
    have_all = True
    for k in range(len(slots)):
        if slots[k] < 0:
            have_all = False
        else:
            names[k] = ids[slots[k]]
    return have_all


@njit_allocating
def _unsplit(
    block: Array, tally: Tally, readings: Array, costs: Array, slots: IntArray
) -> tuple[Array, IntArray]:
    """Return the best association of the only hypothesis; none if it splits."""
    can_split = len(slots) > 1 and settings_jit(tally).hypotheses > 1
    if can_split and _splits(block, readings, slots):
        return costs[:0], slots[:0]
    return costs[:1], slots[:1]


@njit_allocating
def _splits(block: Array, readings: Array, slots: IntArray) -> bool:
    """Return whether a scan splits the only hypothesis.

    It does if another association leads to a different belief, see `differing`, or if
    the filter refuses the best one.
    """
    first, other = np.empty_like(block), np.empty_like(block)
    if not _tried(block, readings, slots[0], first):
        return True
    for k in range(1, len(slots)):
        is_taken = _tried(block, readings, slots[k], other)
        if is_taken and not _are_near(first, other):
            return True
    return False


@njit_allocating
def _tried(block: Array, readings: Array, slots: IntArray, trial: Array) -> bool:
    """Write the belief after an association; return whether the filter accepts it."""
    ids, rows = parts_jit(block).ids, np.flatnonzero(slots >= 0)
    trial[:] = block
    return update_map(trial, readings[rows], ids[slots[rows]]) == DONE


@njit_internal
def _are_near(block: Array, other: Array) -> bool:
    """Return whether the map in a block is near that in another, see `is_near`."""
    one, after = parts_jit(block), parts_jit(other)
    for c in range(3 + 2 * one.numbers[LANDMARKS]):
        gap = after.mean[c] - one.mean[c]
        if c == 2:
            gap = wrap_angle_jit(gap)
        if not is_near_jit(gap, one.covariance[c, c], after.covariance[c, c]):
            return False
    return True


@njit_allocating
def _given(parts: Parts, ids: IntArray, tentative: int) -> Associations:
    """Return the association by given landmarks; none if one of them is new."""
    slots, count = np.empty((1, len(ids)), np.int64), 1
    if find_slots(parts, ids, slots[0]) > 0:
        count = 0
    unused = np.full(len(ids), NEW), np.ones(tentative), np.ones(len(ids))
    return np.zeros(count), slots[:count], *unused


@njit_allocating
def _associate(
    parts: Parts,
    tally: Tally,
    tentative: tuple[Array, Array, IntArray],
    readings: Array,
    ceiling: float,
) -> Associations:
    """Associate a scan, and count what it shows; without associations if not clear."""
    settings, seen, rows = settings_jit(tally), tentative[2], len(readings)
    density, chance = np.empty(rows), np.ones(len(seen))
    tentative_slots = np.full(rows, NEW)
    rest = tentative_slots, chance, density
    is_astray, compared = _compared(parts, settings, readings)
    if is_astray or not _is_usable(readings, settings.min_range):
        return np.empty(0), np.empty((0, rows), np.int64), *rest
    _, per_scan, longest = _of_density(tally)
    density[:] = settings.density
    if np.isnan(settings.density):
        fill_density(tally.cells, readings, longest, per_scan, density)
    in_all, gate = density.copy(), settings.new_gate
    if len(seen) > 0:
        share = min(tally.numbers[SHARE] / tally.numbers[SUMS], 1.0)
        add_tentative(tentative, readings, settings.noise, gate, share, in_all)
    belief = _part_of(parts, compared)
    costs, slots, explained = _assign(
        belief, readings, in_all, settings, ceiling, int(settings.most)
    )
    scan = slots, explained, readings
    best = _count_best(belief, compared, parts.ids, tally, costs, scan)
    costs, slots = _with_rivals(costs, slots, best, ceiling)
    if len(costs) > 0 and len(seen) > 0:
        of_new = slots[0] == NEW, density, settings, longest
        _associate_tentative(
            tentative, readings, of_new, tally, tentative_slots, chance
        )
    _name_in_map(slots, compared)
    return costs, slots, *rest


@njit_internal
def _name_in_map(slots: IntArray, compared: IntArray) -> None:
    """Turn places among the compared landmarks into slots of the map."""
    for k in range(slots.shape[0]):
        for i in range(slots.shape[1]):
            if slots[k, i] >= 0:
                slots[k, i] = compared[slots[k, i]]


@njit_allocating
def _associate_tentative(
    tentative: tuple[Array, Array, IntArray],
    readings: Array,
    of_new: tuple[BoolArray, Array, ClearRules, float],
    tally: Tally,
    tentative_slots: IntArray,
    chance: Array,
) -> None:
    """Fill the tentative landmark of each new reading, and the chance to miss each."""
    (mean, P, seen), (is_new, density, settings, longest) = tentative, of_new
    new = np.flatnonzero(is_new)
    if len(new) > 0:
        view = mean, P, len(seen)
        _, found, _ = _assign(view, readings[new], density[new], settings, np.inf, 1)
        for k in range(len(new)):
            tentative_slots[new[k]] = found[0, k]
    counts = tally.next_detected.copy().reshape(tally.detected.shape)
    nothing = new[:0], new[:0], readings[:0]
    is_telling = np.zeros(len(seen), np.bool_)
    count_scan((mean, P), nothing, is_telling, longest, counts, chance)


@njit_allocating
def _with_rivals(
    costs: Array, slots: IntArray, best: int, ceiling: float
) -> tuple[Array, IntArray]:
    """Return the best association and those not far less probable; none to leave it.

    An unpaired reading that is new begins another tentative landmark.
    """
    kept, count = np.zeros(len(costs), np.int64), 1
    kept[0], most = best, min(costs[best] + SPREAD, ceiling)
    for k in range(len(slots)):
        if k != best and costs[k] <= most:
            if ((slots[k] == NEW) != (slots[best] == NEW)).any():
                return costs[:0], slots[:0]
            kept[count], count = k, count + 1
    return costs[kept[:count]], slots[kept[:count]]


@njit_allocating
def _count_best(
    belief: tuple[Array, Array, int],
    compared: IntArray,
    ids: IntArray,
    tally: Tally,
    costs: Array,
    scan: tuple[IntArray, IntArray, Array],
) -> int:
    """Add what missed landmarks cost; return the best association, whose counts wait.

    See `Detections.after`.
    """
    mean, P, n = belief
    best, is_telling = 0, np.empty(n, np.bool_)
    slots, explained, readings = scan
    _, per_scan, longest = _of_density(tally)
    # The Poisson probability of no other reading.
    others = 2 * per_scan if np.isnan(settings_jit(tally).density) else 0.0
    _copy(tally.miss_chances, tally.next_miss_chances)
    for k in range(len(slots)):
        for j in range(n):
            is_older = ids[compared[j]] < tally.whole[FIRST_NEW]
            is_telling[j] = is_older and tally.shown[compared[j]] >= PROVEN
        detected, missed = tally.detected.copy(), tally.miss_chances[compared]
        shown = slots[k], explained, readings
        cost, fewer = count_scan(
            (mean, P), shown, is_telling, longest, detected, missed
        )
        costs[k] += cost + others
        if k == 0 or costs[k] < costs[best]:
            best, tally.numbers[FEWER] = k, fewer
            _copy(detected.ravel(), tally.next_detected)
            for j in range(n):
                tally.next_miss_chances[compared[j]] = missed[j]
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


@njit_allocating
def _compared(
    parts: Parts, settings: ClearRules, readings: Array
) -> tuple[bool, IntArray]:
    """Return whether the robot may be astray, and the landmarks to compare.

    These are all, or those that `without_lost` leaves, in the order of the map.
    """
    mean, P, n = parts.mean, parts.covariance, parts.numbers[LANDMARKS]
    is_astray, lost, local = n >= FEWEST_READINGS, 0, 0
    is_lost, every = np.empty(n, np.bool_), np.arange(n)
    for j in range(n):
        c = 3 + 2 * j
        P[c, c + 1] = P[c + 1, c]  # of a large P, this part alone may be out of date
        dx, dy = mean[c] - mean[0], mean[c + 1] - mean[1]
        std = np.sqrt(max(variance_from_robot(P, c, dx, dy), 0.0))
        is_astray &= std > settings.accurate
        is_lost[j] = std > settings.lost
        lost += is_lost[j]
        local += std <= LOCAL_STD * settings.lost
    can_match = local >= settings.least and lost >= 2 * settings.least
    if is_astray or lost == 0 or not can_match:
        return is_astray, every
    within, count = NEAR_STDS * settings.lost, 0
    if len(readings) > 0:
        within += readings[:, 1].max()
    for j in range(n):
        c = 3 + 2 * j
        away = np.hypot(mean[c] - mean[0], mean[c + 1] - mean[1])
        if not is_lost[j] and away <= within:
            every[count], count = j, count + 1
    return False, every[:count]


@njit_allocating
def _part_of(parts: Parts, chosen: IntArray) -> tuple[Array, Array, int]:
    """Return mean and covariance of the pose and some landmarks, and their number.

    Of a large P, only the lower half and the rows of the pose are up to date.
    """
    n = len(chosen)
    if n == parts.numbers[LANDMARKS]:
        return parts.mean, parts.covariance, n
    size = 3 + 2 * n
    columns, mean, P = np.arange(size), np.empty(size), np.empty((size, size))
    for j in range(n):
        columns[3 + 2 * j], columns[4 + 2 * j] = 3 + 2 * chosen[j], 4 + 2 * chosen[j]
    for a in range(size):
        mean[a] = parts.mean[columns[a]]
        for b in range(size if a < 3 else min(a + 2, size)):
            P[a, b] = parts.covariance[columns[a], columns[b]]
    return mean, P, n


@njit_allocating
def _assign(
    belief: tuple[Array, Array, int],
    readings: Array,
    density: Array,
    settings: ClearRules,
    ceiling: float,
    most: int,
) -> tuple[Array, IntArray, IntArray]:
    """Assign a scan as `assign_scan` does."""
    missing = -2 * np.log(density) - 2 * np.log(2 * np.pi)
    limits = np.full(len(density) + 1, np.inf)
    gates = settings.new_gate, settings.pair_gate, ceiling
    search = False, most, int(settings.nodes)
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


@jit_in_place
def count_clear(
    block: Array,
    tally_block: Array,
    readings: Array,
    slots: IntArray,
    tentative_slots: IntArray,
    given: int,
) -> int:
    """Count a clear scan that the filter has taken in.

    Parameters
    ----------
    block, tally_block : ndarray
        As of `associate_clear`.
    readings : ndarray, shape (m, 2)
        Rows (β, r) [rad, m].
    slots, tentative_slots : ndarray of int64, shape (m,)
        The best association, and the tentative landmarks, as in `ClearScan`.
    given : int
        `GIVEN` if the landmarks were given; 0 if the counts of the scan wait.

    Returns
    -------
    int
        `TAKEN`, with `UNUSED` and `AFAR` added where they apply.
    """
    parts, tally = parts_jit(block), tally_jit(tally_block)
    settings, lost, count = settings_jit(tally), lost_jit(tally), len(readings)
    scans, per_scan, longest = _of_density(tally)
    outcomes, is_afar = parts.ledger[OUTCOME], False
    counts, heading = (tally.miss_counts, tally.information), parts.mean[2]
    fed, used, new, strange = 0, 0, 0, 0
    for k in range(count):
        if slots[k] < 0:
            if tentative_slots[k] < 0:
                new += 1
                strange += slots[k] == NEW
            continue
        j = parts.ledger[SLOT, fed]
        if not given:
            tally.shown[j] = min(tally.shown[j] + 1, PROVEN)
        if outcomes[fed] == USED:
            add_sighting(counts, j, readings[k], heading, settings.sighting)
            used += 1
        fed += 1
    if not given:
        flat = tally.detected.reshape(tally.next_detected.shape)
        _copy(tally.next_detected, flat)
        _copy(tally.next_miss_chances, tally.miss_chances)
        is_afar = settings.keeps_path > 0 and _is_afar(parts, tally, longest / RINGS)
        newest = tally.whole[NEWEST]
        lost = evidence_of_misses_jit(lost, tally.numbers[FEWER], newest)
    has_map = tally.whole[COUNT] > 0
    lost = evidence_of_heading_jit(lost, parts.covariance[2, 2], has_map)
    if not given:
        lost = evidence_of_readings_jit(lost, strange, count - new, per_scan, scans)
    e, tally.whole[FIRST_NEW] = tally.numbers[EVIDENCE:SUMS], lost.first_new
    e[0], e[1], e[2], e[4] = lost.present, lost.lasting, lost.largest, lost.surest
    e[5], e[6], e[7] = lost.unknown, lost.unexplained, lost.explained
    sums = tally.numbers[SUMS:PLACE]
    lengths = sums[2], sums[4]
    sums[2], sums[4] = count_readings(
        tally.cells, readings, slots, tentative_slots, lengths
    )
    sums[0], sums[1] = MEMORY * sums[0] + new, MEMORY * sums[1] + 1
    sums[3] = MEMORY * sums[3]
    return TAKEN + UNUSED * (used < fed) + AFAR * is_afar


@njit_internal
def _is_afar(parts: Parts, tally: Tally, step: float) -> bool:
    """Return whether the path is to remember the pose; note its place."""
    x, y, place = parts.mean[0], parts.mean[1], tally.numbers[PLACE:FEWER]
    if tally.whole[HAS_PLACE] and math.hypot(x - place[0], y - place[1]) < step:
        return False
    tally.whole[HAS_PLACE], place[0], place[1] = 1, x, y
    return True
