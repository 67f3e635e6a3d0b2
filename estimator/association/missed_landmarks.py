"""The landmarks that scans should have shown: how likely they are to be missed.

An assignment that leaves a landmark without a reading, although the sensor sees it
with probability P_D, is less likely by the factor 1 − P_D::

    cost = −2 Σ ln(1 − P_D(β, r))

P_D is the share of expected landmarks that the scans so far have shown, in cells of
bearing and range up to the longest reading; a cell counts the share of its sector or
its ring, the lower one, as one more try or two.  A landmark that is shown costs
−2 ln P_D: a map that explains little does not become likely by expecting little.

A landmark that is in view for sure counts with the least P_D within two σ of where it
should be seen, and scan after scan.  One that may be out of view counts with its mean
P_D, and only where that exceeds those before: what keeps it out of view once does so
for long.  For the same reason something may hide a landmark until it is seen again::

    P(missed so often) = ε + (1 − ε) Π (1 − P_D)

A landmark that enters the map has the same cost, for the scans before the first one
that shows it.  Beliefs about earlier poses represent these, one for each ring that the
robot has passed.  They are taken as independent of the landmark: where both share an
error, as before a loop is closed, their distance counts as less certain than it is,
and the landmark costs less.

A run is probably lost if the scans show far fewer landmarks than its map promises.
For landmarks that are in view for sure, Page's test [1]_ compares the rate P_D, the
least within two σ and half a cell, with a fraction ρ of it.  The half cell makes
landmarks at the edge of the view count little::

    g ← max(0, g + min(c, Σ_seen ln ρ + Σ_missed ln (1 − ρ P_D) / (1 − P_D)))

A scan adds at most c, since a single wrong pose may cause all its misses.  Four
kinds of landmarks are no evidence.  If fewer than two scans have shown a landmark
since it entered the map, it may be clutter.  If a landmark is not assigned a reading
that may belong to it, the scan may show it.  If the scan shows something nearer in
its direction, this may hide it.  If a landmark entered the map after the last scan
at which g was 0, a lost filter may have mapped it a second time.  P_D learns the
rates of a lost run, too, so g falls again: the largest evidence counts.

Misses in succession are independent in few real drives: a tree hides another one for
as long as the robot stands.  A landmark seen again after misses of q < ε, where
q = Π (1 − P_D) since its last sighting, shows that something had hidden it and that
the map was right.  If k of n sightings so far were such ones, a miss counts with the
probability that nothing hides the landmark::

    q / (q + 5 k' / (n + 100)),    k' = max(0, √k − 3)²

k' is a lower limit of what k tends to, since up to nine such sightings occur in lost
runs, too, where readings are given to wrong landmarks.  The 5 allows for sightings that
begin no absence, since nothing is near, and for hidden landmarks that are never seen
again.

Something near may hide all landmarks for a few scans.  So the alarm follows g slowly,
in scans that change g by Δ, until g falls::

    s ← min(g, s + min(|Δ| / 0.3, 1) (g − s) / 5)

A robot whose odometry fails where no landmark is in view for sure misses none.  Its
readings are strange instead: they fit neither the map nor those of earlier scans.  A
second sum compares the likelihoods of n strange readings and m others if as many are
strange as so far, μ in a scan, or if 1 − ρ of those that fitted so far, e in a scan,
are strange, too::

    w ← max(0, w + min(c / 2, n ln (1 + δ / μ) − δ + m ln ρ) / 2),    δ = (1 − ρ) e

A new landmark is strange in its first scan only, which counts c / 4 at most.  The
half allows for clutter that comes in bursts.  Where one scan confirms a landmark, no
reading is strange.

A lost run whose landmarks all stay in view misses none, either.  Many of these have
lost the heading: linearised equations do not hold where its standard deviation is a
radian.  Scans in succession that leave the heading unknown count c / 2 each::

    h ← h + c / 2  if min(σ²_θ, π²/3) > least + 0.8 rad² and there is a map
    h ← 0          otherwise

π²/3 is the variance of a uniform heading: one that is unknown at the start is no
evidence.

References
----------
.. [1] E. S. Page, Continuous inspection schemes, Biometrika 41, 1954.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from ...arrays import Array, BoolArray, IntArray
from ...jit import fma, jit, njit_allocating, njit_inlined, njit_internal
from ..interface import MapView
from ..models.bearing_range import (
    expected_reading_jit,
    reading_slopes_jit,
    wrap_angle_jit,
)
from ..models.relative_geometry import reading_covariance
from .tentative_landmarks import MEMORY, RINGS, SECTORS, UnexplainedDensity

# What no formula gives is chosen.  `benchmarks/association.py` counts the bad runs of
# hypotheses, whose costs HIDDEN and SUREST limit.  `benchmarks/association_alarm.py`
# counts the lost runs that the alarm finds, and its false alarms, for all others.

#: Weights of a Gaussian at 0, +2 σ and −2 σ: with 1/8 each, 2 · 2² σ² / 8 = σ².
NODES = np.array([3 / 4, 1 / 8, 1 / 8])

#: ε: probability that something hides a landmark until it is seen again.
HIDDEN = 0.0003

#: Largest P_D, a probability: something may stand before a landmark.
SUREST = 0.95

#: A bearing whose two σ are wider than this angle says nothing [rad].
WIDEST = np.pi / 4

#: ρ: detection rate of a lost run, as a share of that of its map.
FEWER = 0.5

#: Landmarks hidden for each return; sightings without one that are assumed at first.
HIDDEN_EACH, NO_RETURNS = 5, 100

#: Subtracted from √k of k returns.  A count has a standard deviation of about √k, so √k
#: has one of ½, and this is six σ: up to nine returns prove nothing.
LIMIT = 3.0

#: A change of the evidence counts in full after about this number of scans that change
#: it by at least this, a logarithm of a ratio of likelihoods.
SCANS, TELLING = 5, 0.3

#: Half the angle of what may hide a landmark, beyond two σ [rad].
SHADOW = 0.1

#: P_D of a missed landmark is the least up to this many cells beyond two σ.
MARGIN = 0.5

#: A run whose evidence, a logarithm of a ratio of likelihoods, has exceeded this is
#: probably lost: 20 to 1, as e³ = 20.1.
LOST_SCORE = 3.0

#: c: most evidence of being lost from one scan; more than one must agree.
MOST_OF_SCAN = LOST_SCORE

#: A heading is unknown if its variance has grown by this, about (0.9 rad)² [rad²].
UNKNOWN = 0.8

#: A landmark that was shown in this number of scans is not of clutter.
PROVEN = 2

#: Bearing + π and range of a landmark, and two σ of both.
Place = tuple[float, float, float, float]

#: The landmark that each row of a scan shows, (m,), below 0: none; the landmarks that
#: some row may belong to, (k,); and the rows (β, r), which may hide what is behind
#: them, (p, 2).  To miss a landmark of the last two kinds is no evidence.
Scan = tuple[IntArray, IntArray, Array]

EMPTY: Scan = np.empty(0, np.int64), np.empty(0, np.int64), np.empty((0, 2))

#: Variance of a heading that is equally likely everywhere [rad²].
UNIFORM = np.pi**2 / 3


class LostEvidence(NamedTuple):
    """Evidence that the run is lost."""

    #: g: a logarithm of a ratio of likelihoods.
    present: float = 0.0
    #: s, which follows g.
    lasting: float = 0.0
    #: The largest evidence so far.
    largest: float = 0.0
    #: Landmarks from this identity on are newer than the last scan at which g was 0.
    first_new: int = 0
    #: Least variance of the heading so far [rad²].
    surest: float = UNIFORM
    #: h, of scans in succession that have left the heading unknown.
    unknown: float = 0.0
    #: w, of strange readings.
    unexplained: float = 0.0
    #: Running sum of other readings.
    explained: float = 0.0

    def after(self, more: float, mapped: Sequence[int]) -> LostEvidence:
        """Add the evidence of a scan before which these landmarks were in the map."""
        return evidence_of_misses(self, more, max(mapped, default=-1))

    def with_heading(self, variance: float, has_map: bool = True) -> LostEvidence:
        """Count a scan that leaves a variance of the heading [rad²].

        Examples
        --------
        >>> evidence = LostEvidence()
        >>> for variance in (0.01, 0.9, 1.0, 1.1):
        ...     evidence = evidence.with_heading(variance)
        >>> evidence.unknown > LOST_SCORE
        True
        """
        return evidence_of_heading(self, float(variance), has_map)

    def with_readings(
        self, strange: int, explained: int, before: UnexplainedDensity
    ) -> LostEvidence:
        """Count a scan with readings that fit nothing, and with others."""
        sums = before.per_scan, before.scans
        return evidence_of_readings(self, strange, explained, *sums)


def evidence_of_misses(lost: LostEvidence, more: float, newest: int) -> LostEvidence:
    """Return g, s and the largest evidence, where g changes by ``more``."""
    present = max(0.0, lost.present + min(more, MOST_OF_SCAN))
    first_new = lost.first_new
    if present == 0:
        first_new = max(first_new, 1 + newest)
    share = min(abs(more) / TELLING, 1.0) / SCANS
    lasting = min(present, lost.lasting + share * (present - lost.lasting))
    largest = max(lost.largest, lasting)
    left = lost.surest, lost.unknown, lost.unexplained, lost.explained
    return LostEvidence(present, lasting, largest, first_new, *left)


def evidence_of_heading(
    lost: LostEvidence, variance: float, has_map: bool
) -> LostEvidence:
    """Return h and the largest evidence after a scan."""
    variance = min(max(variance, 0.0), UNIFORM)  # rounded, it may be < 0
    unknown = 0.0
    if has_map and variance - lost.surest > UNKNOWN:
        unknown = lost.unknown + MOST_OF_SCAN / 2
    largest, surest = max(lost.largest, unknown), min(lost.surest, variance)
    left = lost.unexplained, lost.explained
    return LostEvidence(
        lost.present, lost.lasting, largest, lost.first_new, surest, unknown, *left
    )


def evidence_of_readings(
    lost: LostEvidence, strange: int, explained: int, per_scan: float, scans: float
) -> LostEvidence:
    """Return w and the largest evidence after n strange readings and m others."""
    more = (1 - FEWER) * lost.explained / scans
    ratio = strange * math.log(1 + more / per_scan) - more
    ratio += explained * math.log(FEWER)
    unexplained = max(0.0, lost.unexplained + min(ratio, MOST_OF_SCAN / 2) / 2)
    total, largest = MEMORY * lost.explained + explained, max(lost.largest, unexplained)
    left = lost.first_new, lost.surest, lost.unknown
    return LostEvidence(lost.present, lost.lasting, largest, *left, unexplained, total)


evidence_of_misses_jit = njit_inlined(evidence_of_misses)
evidence_of_heading_jit = njit_inlined(evidence_of_heading)
evidence_of_readings_jit = njit_inlined(evidence_of_readings)


class Detections(NamedTuple):
    """How many expected landmarks the scans have shown.

    Examples
    --------
    >>> view = MapView(np.array([0, 0, 0, 4.5, 0.5]), 1e-6 * np.eye(5), (7,))
    >>> detections = Detections()
    >>> for slot in (0, 0, 0, -1):
    ...     scan = np.array([slot]), *EMPTY[1:]
    ...     cost, detections = detections.after(view, scan, longest=8.0)
    >>> share = (3 + 2 * 4 / 5) / 5  # of the cell, with that of its ring
    >>> bool(np.isclose(cost, -2 * np.log(HIDDEN + (1 - HIDDEN) * (1 - share))))
    True
    """

    #: Landmarks seen, expected, and seen again after misses less likely than ε, shape
    #: (3, SECTORS, RINGS).
    detected: Array = np.zeros((3, SECTORS, RINGS))
    #: For landmarks that may have been in view since they were last seen, the
    #: probability of missing them so often if nothing hides them.
    missed: Mapping[int, float] = {}
    #: In how many scans a landmark was shown, up to `PROVEN`.
    shown: Mapping[int, int] = {}
    #: That the run is lost.
    lost: LostEvidence = LostEvidence()
    #: Beliefs about poses of scans: rows of the number of the scan, (x, y, θ), and P,
    #: shape (p, 13).
    path: Array = np.empty((0, 13))

    def after(
        self, view: MapView, scan: Scan, longest: float
    ) -> tuple[float, Detections]:
        """Count one scan; return the cost of the landmarks that it has missed, too.

        Parameters
        ----------
        view : MapView
            The map before the scan.
        scan : Scan
            Which landmarks of the map the scan shows, and may show or hide.
        longest : float
            Longest range read so far [m].
        """
        ids, counts, new = view.ids, self.detected.copy(), self.lost.first_new
        proven = [i < new and self.shown.get(i, 0) >= PROVEN for i in ids]
        is_telling = np.array(proven, dtype=np.bool_)
        missed = np.array([self.missed.get(i, 1.0) for i in ids])
        cost, fewer = count_scan(view[:2], scan, is_telling, longest, counts, missed)
        left = {**self.missed, **dict(zip(ids, missed.tolist(), strict=True))}
        left = {i: chance for i, chance in left.items() if chance < 1}
        shown, seen = self.shown, [ids[k] for k in scan[0].tolist() if k >= 0]
        if rare := [i for i in seen if shown.get(i, 0) < PROVEN]:
            shown = {**shown, **{i: 1 + shown.get(i, 0) for i in rare}}
        evidence = self.lost.after(fewer, view.mapped)
        return cost, Detections(counts, left, shown, evidence, self.path)

    def with_pose(self, scan: int, view: MapView, longest: float) -> Detections:
        """Remember the pose of a scan, unless the robot has hardly moved."""
        for x, y in self.path[-1:, 1:3].tolist():
            if math.hypot(view.mean[0] - x, view.mean[1] - y) < longest / RINGS:
                return self
        row = [scan, *view.mean[:3], *view.covariance[:3, :3].ravel()]
        return self._replace(path=np.vstack([self.path, row]))

    def cost_of_new(
        self, view: MapView, first_scans: Mapping[int, int], longest: float
    ) -> float:
        """Return the cost of new landmarks that no scan before their first has shown.

        Parameters
        ----------
        view : MapView
            The map, with the new landmarks.
        first_scans : mapping of int to int
            Number of the first scan that shows each.
        longest : float
            Longest range read so far [m].
        """
        cost = 0.0
        for i in [i for i in first_scans if i in view.ids]:
            then, chance = view.part([view.ids.index(i)]), 1.0
            then.covariance[3:, :3] = then.covariance[:3, 3:] = 0.0
            path = self.path[self.path[:, 0] < first_scans[i]]
            gaps = np.hypot(*(path[:, 1:3] - then.mean[3:]).T)
            spread = path[:, 4] + path[:, 8] + np.trace(then.covariance)
            for row in path[gaps < longest + 2 * np.sqrt(np.maximum(spread, 0))]:
                then.mean[:3] = row[1:4]
                then.covariance[:3, :3] = row[4:].reshape(3, 3)
                chance = float(self.chance_to_miss(then, longest, chance)[0])
            cost -= 2 * math.log(HIDDEN + (1 - HIDDEN) * chance)
        return cost

    def chance_to_miss(self, view: MapView, longest: float, prior: float = 1) -> Array:
        """Return the probability that a scan shows none of its landmarks, shape (n,).

        ``prior`` is the probability that the scans before it have shown none.
        """
        chance = prior * np.ones(len(view.ids))
        is_telling, counts = np.zeros(len(chance), dtype=np.bool_), self.detected.copy()
        count_scan(view[:2], EMPTY, is_telling, longest, counts, chance)
        return chance


@jit
def count_scan(
    belief: tuple[Array, Array],
    scan: Scan,
    is_telling: BoolArray,
    longest: float,
    counts: Array,
    missed: Array,
) -> tuple[float, float]:
    """Count a scan; return its cost, and the evidence that the run is lost.

    Parameters
    ----------
    belief : tuple
        Mean and covariance of the map.
    scan : Scan
        What the scan shows.
    is_telling : ndarray, shape (n,)
        Whether each landmark can be evidence.  Overwritten.
    longest : float
        Longest range read so far [m].
    counts : ndarray, shape (3, SECTORS, RINGS)
        As in :class:`Detections`.  The scan is added.
    missed : ndarray, shape (n,)
        Probability of missing each landmark so often.  Updated.
    """
    (mean, P), (slots, explained, readings) = belief, scan
    seen, expected, returned = counts[0], counts[1], counts[2]
    is_seen = _seen(slots, len(missed))
    for slot in explained:
        is_telling[slot] &= is_seen[slot]
    (sectors, rings), shares = seen.shape, _detection_rates(seen, expected)
    returns = max(np.sqrt(returned.sum()) - LIMIT, 0.0) ** 2
    hidden = HIDDEN_EACH * returns / (seen.sum() + NO_RETURNS)
    cost, fewer = 0.0, 0.0
    for j in range(len(is_seen)):
        place = _place_in_scan(mean, P, j)
        bearing, distance, turn, aside = place
        cell = (
            whole_times(bearing, 2 * np.pi / sectors) % sectors,
            min(whole_times(distance, longest / rings), rings - 1),
        )
        is_sure = distance + aside < longest and turn <= WIDEST
        if is_sure:
            seen[cell] += is_seen[j]
            expected[cell] += 1
            returned[cell] += is_seen[j] and missed[j] < HIDDEN
        if is_seen[j]:
            cost -= 2 * np.log(shares[cell])
            missed[j] = 1.0
            fewer += is_sure * is_telling[j] * np.log(FEWER)
        elif distance - aside < longest:
            least, likely = _shares_around(shares, place, longest, 0.0)
            left = missed[j] * (1 - least) if is_sure else min(missed[j], 1 - likely)
            odds = HIDDEN + (1 - HIDDEN) * left
            cost -= 2 * np.log(odds / (HIDDEN + (1 - HIDDEN) * missed[j]))
            if is_sure and is_telling[j] and not _is_behind(place, readings):
                least, _ = _shares_around(shares, place, longest, MARGIN)
                telling = 1 / (1 + hidden / max(missed[j], 1e-99))
                fewer += telling * np.log((1 - FEWER * least) / (1 - least))
            missed[j] = left
    return cost, fewer


@njit_allocating
def _seen(slots: IntArray, landmarks: int) -> BoolArray:
    """Return which landmarks some row shows, shape (n,)."""
    is_seen = np.zeros(landmarks, np.bool_)
    for slot in slots:
        if slot >= 0:
            is_seen[slot] = True
    return is_seen


@njit_allocating
def _detection_rates(seen: Array, expected: Array) -> Array:
    """Return P_D of each cell, shape (SECTORS, RINGS)."""
    (sectors, rings), shares = seen.shape, np.empty(seen.shape)
    of_ring = np.empty(rings)
    for b in range(rings):
        sums = 1.0, 2.0
        for a in range(sectors):
            sums = sums[0] + seen[a, b], sums[1] + expected[a, b]
        of_ring[b] = sums[0] / sums[1]
    for a in range(sectors):
        sums = 1.0, 2.0
        for b in range(rings):
            sums = sums[0] + seen[a, b], sums[1] + expected[a, b]
        for b in range(rings):
            usual = min(sums[0] / sums[1], of_ring[b])
            share = (seen[a, b] + 2 * usual) / (expected[a, b] + 2)
            shares[a, b] = min(share, SUREST)
    return shares


@njit_internal
def _is_behind(place: Place, readings: Array) -> bool:
    """Return whether a nearer reading in this direction may hide a landmark."""
    bearing, distance, turn, aside = place
    for i in range(len(readings)):
        gap = abs(wrap_angle_jit(bearing - np.pi - readings[i, 0]))
        if readings[i, 1] < distance - aside and gap <= turn + SHADOW:
            return True
    return False


@njit_internal
def _shares_around(
    shares: Array, place: Place, longest: float, margin: float
) -> tuple[float, float]:
    """Return the least and the mean P_D within two σ and a margin [cells]."""
    sectors, rings = shares.shape
    width, depth = 2 * np.pi / sectors, longest / rings
    bearing, distance, turn, aside = place
    least, likely = SUREST, 0.0
    for a in range(-1, 2):
        turned = bearing + a * (turn + margin * width)
        side = whole_times(turned, width) % sectors
        for b in range(-1, 2):
            away = abs(distance + b * (aside + margin * depth))
            far = whole_times(away, depth)
            share = shares[side, far] if far < rings else 0.0
            least = min(least, share)
            likely += NODES[a] * NODES[b] * share
    return least, likely


@njit_internal
def whole_times(value: float, part: float) -> int:
    """Return ⌊value / part⌋, exactly, as ``//`` does in several times the time."""
    times = np.floor(value / part)  # too large by one where the quotient is rounded up
    return int(times - (fma(-times, part, value) < 0))


@njit_internal
def _place_in_scan(mean: Array, P: Array, j: int) -> Place:
    """Return where a scan is expected to show landmark j."""
    c = 3 + 2 * j
    dx, dy = mean[c] - mean[0], mean[c + 1] - mean[1]
    bearing, distance = expected_reading_jit(dx, dy, mean[2])
    turn, _, aside = reading_covariance(P, c, reading_slopes_jit(dx, dy))
    std = np.sqrt(max(turn, 0.0)), np.sqrt(max(aside, 0.0))
    return wrap_angle_jit(bearing) + np.pi, distance, 2 * std[0], 2 * std[1]
