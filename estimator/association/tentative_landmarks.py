"""Tentative landmarks: seen too rarely to be in the map, and kept outside it.

They have a map of their own: a mean and a covariance of (x, y, θ, q1x, q1y, …) in the
frame of the robot after a recent scan, as in robocentric mapping [1]_.  Odometry moves
its pose, and readings correct pose and positions together, as in any EKF.  A heading
that slips turns all readings of a scan alike, so that these reveal the slip.  Once the
heading is too uncertain for linearised equations, the positions are expressed in the
frame of the robot, where its pose is 0::

    q ← R(−θ) (q − p)

This map does not depend on the belief of the filter or its frame.  A tentative landmark
that is never confirmed leaves the belief unchanged.

o are the odds that a tentative landmark is a landmark, not clutter.  They begin with
the share of the readings that match no mapped landmark and proved to be of a new one.
ρ is the density of all readings that match no mapped landmark, and ν and S are those
of a reading given the other readings of its scan::

    new       o ← share / (1 − share)
    sighting  o ← o N(ν; S) / ρ
    miss      o ← o (1 − P_D)

References
----------
.. [1] J. A. Castellanos, R. Martinez-Cantin, J. D. Tardós, J. Neira, Robocentric map
   joining: Improving the consistency of EKF-SLAM, Robotics and Autonomous Systems 55,
   2007.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ...arrays import Array, BoolArray, IntArray
from ...jit import jit, jit_in_place, njit_allocating, njit_inlined, njit_internal
from ..guards import saved_states
from ..interface import MapView
from ..models.bearing_range import predict_measurement, wrap_angle
from ..models.rigid_motion import as_covariance, predict, rotation
from .scan_assignments import Noise, extended, fill_distances

# What no formula gives is chosen.  `benchmarks/association.py` counts bad runs and
# landmarks that are mapped twice, and lists the size of the maps.

#: Numbers of cells over the bearings, and over the ranges up to the longest reading.
SECTORS, RINGS = 16, 8

#: Weight of a scan relative to the one after it: running averages of 1 / (1 − 0.98) =
#: 50 scans.
MEMORY = 0.98

#: Ratio: a range counts up to this many times the longest one of a landmark seen again.
BEYOND = 4.0

#: Up to this σ of the heading, the frame remains that of an earlier scan [rad].  What
#: linearisation neglects of a distance is then below σ² / 2 = 0.13 % of it.
STRAIGHT = 0.05

#: Least variance of a reading, relative to the terms of H P Hᵀ: S⁻¹ must exist.  Sums
#: of up to some thousand terms round by less, 1e-16 each.
ROUNDING = 1e-12

#: Least prior probability of being a landmark: the robot may enter a new region.
LEAST_SHARE = 0.01

#: ln of the odds beyond which a tentative landmark may enter the map: 20 to 1, a
#: probability of 95 %.  `benchmarks/association.py` lists the size of the maps.
ENTRY_ODDS = 3.0


class TentativeLandmarks(NamedTuple):
    """Tentative landmarks; methods return changed copies.

    Examples
    --------
    Three sightings within five scans make a landmark:

    >>> noise, none = Noise(0.1, 0.1), TentativeLandmarks()
    >>> one = none.with_new(np.array([[0.0, 4.0]]), noise, np.array([1]), share=0.5)
    >>> again = np.array([0]), np.array([[0.1, 4.1]]), noise, np.array([0.05])
    >>> one.after_scan(5).with_sightings(*again).sightings.tolist()
    [2]
    """

    #: (x, y, θ, q1x, q1y, …), shape (3 + 2t,) [m, m, rad, m, …].
    mean: Array = np.zeros(3)
    #: Shape (3 + 2t, 3 + 2t).
    covariance: Array = np.zeros((3, 3))
    #: One bit per scan, the present scan lowest: whether the landmark was seen, (t,).
    seen: IntArray = np.empty(0, np.int64)
    #: Unique number of each, shape (t,).
    labels: IntArray = np.empty(0, np.int64)
    #: ln o of each, shape (t,).
    odds: Array = np.empty(0)

    @property
    def sightings(self) -> IntArray:
        """Number of sightings of each within the scans that count, shape (t,)."""
        return np.bitwise_count(self.seen).astype(np.int64)

    @property
    def places(self) -> Array:
        """Positions relative to the robot, shape (t, 2) [m]."""
        x, y, heading = self.mean[:3]
        return np.asarray((self.mean[3:].reshape(-1, 2) - (x, y)) @ rotation(heading))

    def moved(
        self, displacement: tuple[float, float, float], variance: Array
    ) -> "TentativeLandmarks":
        """Move the robot by (dx, dy, α) in its frame, with noise (σx², σy², σα²)."""
        mean, P = self.mean.copy(), self.covariance.copy()
        predict(mean, P, mean, len(mean), *displacement, variance, 0)
        return self._replace(mean=mean, covariance=P)

    def view(self) -> MapView:
        """Return their map."""
        return MapView(self.mean, self.covariance, range(len(self.seen)))

    def with_misses(self, chance: Array) -> "TentativeLandmarks":
        """Lower the odds of those that this scan misses; chance (t,) is 1 − P_D."""
        missed = self.seen & 1 == 0
        return self._replace(odds=self.odds + np.where(missed, np.log(chance), 0.0))

    def proven(self, needed: int) -> BoolArray:
        """Return which occur in enough scans and are unlikely clutter, shape (t,)."""
        return (self.sightings >= needed) & (self.odds > ENTRY_ODDS)

    def with_sightings(
        self, slots: IntArray, readings: Array, noise: Noise, density: Array
    ) -> "TentativeLandmarks":
        """Correct k landmarks by a reading of each (k, 2), where the density is ρ.

        With Λ = S⁻¹, a reading has the covariance Λᵢᵢ⁻¹ and the innovation Λᵢᵢ⁻¹ (Λν)ᵢ
        given the others.
        """
        k, landmarks = len(slots), self.view().landmarks[slots]
        expected, by_pose, by_place = predict_measurement(self.mean[:3], landmarks)
        nu = readings - expected
        nu[:, 0] = wrap_angle(nu[:, 0])
        H = np.zeros((k, 2, len(self.mean)))
        H[:, :, :3] = by_pose
        columns = 3 + 2 * slots[:, None, None] + (0, 1)
        np.put_along_axis(H, np.repeat(columns, 2, axis=1), by_place, axis=2)
        slopes = H.reshape(2 * k, -1)
        rows = slopes @ self.covariance
        floor = ROUNDING * (slopes**2 @ self.covariance.diagonal()).reshape(k, 2)
        variances = np.maximum(noise.variances(readings[:, 1]), floor)
        S = rows @ slopes.T + np.diag(variances.ravel())
        root = np.linalg.inv(np.linalg.cholesky(S))  # Λ = rootᵀ root
        A, white = root @ rows, root @ nu.ravel()
        own = (root.T @ root).reshape(k, 2, k, 2)[range(k), :, range(k)]
        fit = (root.T @ white).reshape(k, 2, 1)
        unlikelihood = (fit.mT @ np.linalg.solve(own, fit)).ravel()
        unlikelihood -= np.log(np.linalg.det(own))
        odds, seen = self.odds.copy(), self.seen.copy()
        odds[slots] -= unlikelihood / 2 + np.log(2 * np.pi * density)
        seen[slots] |= 1
        mean, P = self.mean + white @ A, as_covariance(self.covariance - A.T @ A)
        return TentativeLandmarks(mean, P, seen, self.labels, odds)

    def with_new(
        self, readings: Array, noise: Noise, labels: IntArray, share: float
    ) -> "TentativeLandmarks":
        """Add landmarks seen for the first time, by their readings, rows (β, r)."""
        if not len(readings):
            return self
        share = min(max(share, LEAST_SHARE), 0.5)
        odds = np.full(len(readings), np.log(share / (1 - share)))
        new = np.ones(len(readings), np.int64), labels, odds
        rest = map(np.concatenate, zip(self[2:], new, strict=True))
        return TentativeLandmarks(*extended(*self[:2], readings, tuple(noise)), *rest)

    def after_scan(self, scans: int) -> "TentativeLandmarks":
        """Return those seen in the last ``scans`` − 1 scans, in a recent frame."""
        if not len(self.seen):  # the frame begins anew
            return TentativeLandmarks()
        return TentativeLandmarks(*_after_scan(*self, scans))

    def chosen(self, which: BoolArray) -> "TentativeLandmarks":
        """Return some of them."""
        if which.all():
            return self
        map_ = self.view().part(np.flatnonzero(which).tolist())
        rest = self.seen[which], self.labels[which], self.odds[which]
        return TentativeLandmarks(map_.mean, map_.covariance, *rest)


@jit
def _after_scan(
    mean: Array, P: Array, seen: IntArray, labels: IntArray, odds: Array, scans: int
) -> tuple[Array, Array, IntArray, IntArray, Array]:
    """Return the parts of `TentativeLandmarks.after_scan`."""
    shifted = (seen << 1) & ((1 << scans) - 1)
    kept = np.flatnonzero(shifted)
    n, rest = len(kept), (shifted[kept], labels[kept], odds[kept])
    if n == 0:
        return np.zeros(3), np.zeros((3, 3)), *rest
    columns = _columns_of(kept)
    mean, P = mean[columns], P[columns][:, columns].copy()
    if P[2, 2] <= STRAIGHT**2:
        return mean, P, *rest
    cos, sin = np.cos(mean[2]), np.sin(mean[2])
    for j in range(3, 3 + 2 * n, 2):
        dx, dy = mean[j] - mean[0], mean[j + 1] - mean[1]
        mean[j], mean[j + 1] = cos * dx + sin * dy, cos * dy - sin * dx
    mean[:3] = 0.0
    for _ in range(2):  # T P, then T (T P)ᵀ
        for j in range(3, 3 + 2 * n, 2):
            for i in range(len(P)):
                dx, dy = P[j, i] - P[0, i], P[j + 1, i] - P[1, i]
                P[j, i] = cos * dx + sin * dy + mean[j + 1] * P[2, i]
                P[j + 1, i] = cos * dy - sin * dx - mean[j] * P[2, i]
        P[:3] = 0.0
        P = P.T.copy()
    P = (P + P.T) / 2
    for k in range(len(P)):
        P[k, k] = max(P[k, k], 0.0)
    return mean, P, *rest


@njit_allocating
def _columns_of(slots: IntArray) -> IntArray:
    """Return the columns of the pose and of some landmarks, shape (3 + 2n,)."""
    columns = np.arange(3 + 2 * len(slots))
    for i in range(len(slots)):
        columns[3 + 2 * i], columns[4 + 2 * i] = 3 + 2 * slots[i], 4 + 2 * slots[i]
    return columns


@jit
def add_tentative(
    tentative: tuple[Array, Array, IntArray],
    readings: Array,
    of_sensor: tuple[float, ...],
    gate: float,
    share: float,
    density: Array,
) -> None:
    """Add the density of the readings of tentative landmarks.

    One of a single sighting is a landmark with the probability ``share``; one of more
    sightings surely is.

    Parameters
    ----------
    tentative : tuple
        Mean, covariance and ``seen`` of `TentativeLandmarks`.
    readings : ndarray, shape (m, 2)
        Rows (β, r) [rad, m].
    of_sensor : tuple
        The fields of a :class:`Noise`.
    gate : float
        Largest νᵀ S⁻¹ ν of a reading and a landmark that may be its own.
    share : float
        Probability that a reading of no landmark of the map is of a landmark.
    density : ndarray, shape (m,)
        Of the readings [1 / (rad m)].
    """
    mean, P, seen = tentative
    squared = np.full((len(readings), len(seen)), np.inf)
    unlikelihood = squared.copy()
    fill_distances(mean, P, readings, of_sensor, gate, (squared, unlikelihood))
    for k in range(len(readings)):
        most = 0.0
        for j in range(len(seen)):
            is_again = seen[j] & (seen[j] - 1) != 0
            chance = 1.0 if is_again else share
            most = max(most, chance * np.exp(-unlikelihood[k, j] / 2) / (2 * np.pi))
        density[k] += most


class UnexplainedDensity(NamedTuple):
    """A running average of the readings that belong to no landmark of the map.

    Examples
    --------
    >>> density = UnexplainedDensity()
    >>> for _ in range(500):
    ...     density = density.after(np.array([[0, 7.9], [1, 8]]), [0, 1])
    >>> round(density.per_scan, 2)
    2.0
    >>> far, near = density.at(np.array([[0, 7.5], [0, 2.5]]))
    >>> bool(far > 100 * near)
    True
    """

    #: Such readings in running sums, with one in two scans assumed at first.
    readings: float = 1.0
    scans: float = 2.0
    #: Longest range read so far [m].
    farthest: float = 1.0
    #: How many landmarks were confirmed.
    landmarks: float = 1.0
    #: Longest range read of a landmark that was seen before; 0: none yet [m].
    known: float = 0.0
    #: How many readings each sector and ring has shown, shape (SECTORS, RINGS).
    cells: Array = np.zeros((SECTORS, RINGS))

    def at(self, readings: Array, assumed: float | None = None) -> Array:
        """Return the density at readings (m, 2), shape (m,) [1 / (rad m)].

        A density that the policy assumes replaces the one that the scans suggest.

        New landmarks come into view at certain bearings and ranges, most of them far
        ahead.  The density is the product of the shares p of its sector and its ring::

            n / (2π r) · p(sector) SECTORS · p(ring) RINGS

        with n readings per scan, r the longest range, and half a reading added to every
        sector and ring.
        """
        if assumed is not None:
            return np.full(len(readings), assumed)
        density = np.empty(len(readings))
        fill_density(self.cells, readings, self.longest, self.per_scan, density)
        return density

    @property
    def longest(self) -> float:
        """Longest range that the sensor reads, as far as the scans show [m].

        A single wrong reading must not stretch all cells.  One that is more than
        `BEYOND` times as long as any of a landmark seen again does not count.
        """
        return _longest_of(self.farthest, self.known)

    @property
    def per_scan(self) -> float:
        """Readings per scan; at least half a reading within the memory."""
        return _per_scan_of(self.readings, self.scans)

    @property
    def landmark_share(self) -> float:
        """Probability that such a reading is of a landmark."""
        return min(self.landmarks / self.readings, 1.0)

    def after(
        self, readings: Array, new: Sequence[int], landmarks: int = 0
    ) -> "UnexplainedDensity":
        """Count one more scan (m, 2), its rows of no landmark, and those confirmed."""
        slots = np.zeros(len(readings), dtype=np.int64)
        slots[[*new]] = -1
        cells = self.cells.copy() if new else self.cells
        lengths = self.farthest, self.known
        farthest, known = count_readings(cells, readings, slots, slots, lengths)
        sums = MEMORY * self.readings + len(new), MEMORY * self.scans + 1
        confirmed = MEMORY * self.landmarks + landmarks
        return UnexplainedDensity(*sums, farthest, confirmed, known, cells)


def _per_scan_of(readings: float, scans: float) -> float:
    """Return the readings per scan from running sums of both."""
    return max(readings, 0.5) / scans


def _longest_of(farthest: float, known: float) -> float:
    """Return the longest range, unless it is far beyond those of known landmarks."""
    return known if known > 0.0 and BEYOND * known < farthest else farthest


longest_jit = njit_internal(_longest_of)
per_scan_jit = njit_inlined(_per_scan_of)


@njit_internal
def _cell(bearing: float, distance: float, longest: float) -> tuple[int, int]:
    """Return the sector and the ring of a reading."""
    turned = (bearing + np.pi) % (2 * np.pi)
    ring = min(max(distance * (RINGS / longest), 0.0), RINGS - 1.0)
    return int(turned * (SECTORS / (2 * np.pi))) % SECTORS, int(ring)


@jit
def fill_density(
    cells: Array, readings: Array, longest: float, per_scan: float, density: Array
) -> None:
    """Fill the mean density times the shares of the sector and ring of each reading."""
    mean = per_scan / (2 * np.pi * longest)
    sectors, rings = np.zeros(len(cells)), np.zeros(cells.shape[1])
    for i in range(len(sectors)):  # numba compiles sums along an axis for a second
        for j in range(len(rings)):
            sectors[i] += cells[i, j]
            rings[j] += cells[i, j]
    sectors, rings = sectors + 0.5, rings + 0.5
    usual, usual_ring = sectors.sum() / SECTORS, rings.sum() / RINGS
    for k in range(len(readings)):
        sector, ring = _cell(readings[k, 0], readings[k, 1], longest)
        density[k] = mean * (sectors[sector] / usual * rings[ring] / usual_ring)


@jit_in_place
def count_readings(
    cells: Array,
    readings: Array,
    slots: IntArray,
    tentative_slots: IntArray,
    lengths: tuple[float, float],
) -> tuple[float, float]:
    """Count readings with neither slot; return the longest ranges of all scans [m]."""
    farthest, known = lengths
    for k in range(len(readings)):
        bearing, distance = readings[k, 0], readings[k, 1]
        if np.isfinite(bearing) and np.isfinite(distance):
            farthest = max(farthest, distance)
            if slots[k] >= 0 or tentative_slots[k] >= 0:
                known = max(known, distance)
    longest = longest_jit(farthest, known)
    for k in range(len(readings)):
        bearing, distance = readings[k, 0], readings[k, 1]
        is_new = slots[k] < 0 and tentative_slots[k] < 0
        if is_new and np.isfinite(bearing) and np.isfinite(distance):
            cells[_cell(bearing, distance, longest)] += 1.0
    return farthest, known


#: What a saved state holds about them.
TENTATIVE: saved_states.Table = {
    "seen": (saved_states.COUNTS._replace(dtype=np.uint64), "t"),
    "mean": (saved_states.NUMBERS, "3+2t"),
    "covariance": (saved_states.COVARIANCE, "3+2t", "3+2t"),
    "labels": (saved_states.WHOLE, "t"),
    "odds": (saved_states.NUMBERS, "t"),
}
