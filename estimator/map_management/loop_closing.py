"""Close loops after long drift: recognise landmarks around the robot as older ones.

A landmark is lost if its position relative to the robot, with the error ::

    e_l − e_p − J (l − p) e_θ,

is less certain than the policy allows, while the map holds enough landmarks, around
the robot and elsewhere, to recognise a constellation.  Readings are not associated with
lost landmarks, so that around a robot that has lost its map a new one begins.  A
landmark that enters the map where a lost one may be is *doubtful*: it may be a second
copy.  Once a constellation around the robot is recognised among the lost landmarks,
both are merged by one measurement.  Where the loop has been closed otherwise, the older
landmark is no longer lost, and a doubtful one is merged with it if their offset is
accurate and passes the gate.

A robot that knows the relative position of no landmark accurately, as after a gap in
the readings, is too far from its estimate for linearised innovations: they exclude the
right landmarks.  The readings of one scan then form the constellation, and the places
where it fits best become parts of the belief, as in a Gaussian sum filter [1]_.  If
a scan shows too few landmarks, one hypothesis leaves the scan out.

References
----------
.. [1] D. Alspach, H. Sorenson, Nonlinear Bayesian estimation using Gaussian sum
   approximations, IEEE Transactions on Automatic Control 17, 1972.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace

import numpy as np

from ... import argument_checks
from ...arrays import LARGEST, Array, BoolArray, IntArray
from ...jit import jit
from ..association.constellations import (
    LARGEST_GRAPH,
    Constellations,
    TwoPlaces,
    agreeing_pairs,
    is_plausible,
    match_constellations,
    moved,
    turn_between,
)
from ..association.scan_assignments import Noise, with_readings
from ..interface import MapView
from ..models.bearing_range import wrap_angle
from ..models.relative_geometry import (
    covariance_with_heading,
    largest_std,
    lever_of,
    relative_separation,
    separation,
    squared_offsets,
    variance_from_robot,
)
from ..models.rigid_motion import invariant_covariance, seen_from

#: Landmarks that are the same: (kept, gone).
Pairs = list[tuple[int, int]]

# Squared distances in σ are χ² of 2 degrees.  `benchmarks/loop_closure.py` counts what
# the limits without a formula decide: loops that are closed, and different landmarks
# that are merged.

#: Landmarks count as local within this many times the reach of the readings.
LOCAL_REACH = 3.0
#: Largest χ² of the offset of two landmarks that may be the same: 5 σ, a tail of 4e-6.
OFFSET_GATE = 25.0
#: Largest χ² of the offset of two landmarks that are the same, 99 %: −2 ln 0.01.
SAME_GATE = 9.21
#: Landmarks around the robot are those with a σ below this share of that of lost ones.
LOCAL_STD = 0.5
#: An offset is accurate if its σ is below this share of that of lost landmarks.
ACCURATE = 0.25
#: Beyond the reach of a reading, its landmark may be by this multiple of the σ of lost
#: landmarks: no landmark that matters is left out.
NEAR_STDS = 10.0
#: The heading may be wrong by this number of σ, a tail of 6e-5, and by this angle more,
#: where its σ is too small [rad].
TURN_STDS, SLACK = 4.0, 0.2
#: Covariance of a pose around a place that a scan shows, (0.5 m)² and (0.15 rad)²: far
#: wider than a scan leaves it, and narrow enough for linearised readings.
AROUND = np.diag([0.5, 0.5, 0.15]) ** 2
#: Added to variances that may be zero, against rounding [m², rad²].
TINY = 1e-12
#: Number of Gauss-Newton steps for the turn of the robot, from each of two starts.
TURNS = 4
#: Least number of readings that recognise a place, and most places of a scan.
FEWEST_READINGS, MOST_PLACES = 3, 4


def lost(view: MapView, rules: Constellations | None) -> BoolArray:
    """Return which landmarks of a view are lost, shape (n,); none without rules.

    Unless the rules say always, none is as long as no constellation can be recognised,
    with few landmarks around the robot or in the map.
    """
    is_lost = np.zeros(len(view.ids), dtype=np.bool_)
    if rules is None or not (rules.always or len(view.mapped) >= 2 * rules.least):
        return is_lost
    local, known = _find_lost(*view[:2], float(rules.lost_std), is_lost)
    # A view of a part of the map may lack some landmarks near the robot.
    is_known = local >= rules.least or view.whole is not None
    can_match = is_known and len(view.mapped) - known >= 2 * rules.least
    return is_lost if can_match or rules.always else np.zeros_like(is_lost)


def without_lost(view: MapView, rules: Constellations | None, within: float) -> MapView:
    """Return a view without lost landmarks, and without those beyond a distance [m].

    If no landmark is lost, the view is returned unchanged.
    """
    is_lost = lost(view, rules)
    if rules is None or not is_lost.any():
        return view
    away = np.hypot(*(view.landmarks - view.mean[:2]).T)
    is_near = away <= within + NEAR_STDS * rules.lost_std
    return view.part(np.flatnonzero(~is_lost & is_near).tolist())


def same_landmarks(
    view: MapView,
    rules: Constellations,
    added: Collection[int],
    doubtful: set[int],
    within: float,
) -> tuple[set[int], Pairs]:
    """Return the doubtful landmarks after a scan, and the landmarks to merge.

    Parameters
    ----------
    view : MapView
        The map around the robot.
    rules : Constellations
    added : collection of int
        Landmarks that the scan has added to the map.
    doubtful : set of int
        Those before the scan: landmarks that may be older, lost ones.
    within : float
        Reach of the readings [m].
    """
    is_lost, doubtful = lost(view, rules), doubtful & set(view.mapped)
    new = slots_of(view, added)
    if len(new) and is_lost.any():
        squared, _ = _offsets(view, new, np.flatnonzero(is_lost))
        fitting = new[(squared <= OFFSET_GATE).any(axis=1)]
        doubtful |= {view.ids[k] for k in fitting.tolist()}
    slots = slots_of(view, doubtful)
    if not len(slots):
        return doubtful, []
    pairs = _found_again(view, slots, is_lost, ACCURATE * rules.lost_std)
    if added and not pairs:
        pairs = _recognised(view, is_lost, within, rules)
    return doubtful, pairs


def slots_of(view: MapView, ids: Collection[int]) -> IntArray:
    """Return the places of landmarks in a view, in its order."""
    return np.array([k for k, i in enumerate(view.ids) if i in ids], dtype=np.int64)


def _found_again(
    view: MapView, doubtful: IntArray, is_lost: BoolArray, accurate: float
) -> Pairs:
    """Return doubtful landmarks and the older ones, no longer lost, that they are."""
    is_older = ~is_lost
    is_older[doubtful] = False
    older = np.flatnonzero(is_older)
    doubtful = doubtful[~is_lost[doubtful]]
    if not len(older) or not len(doubtful):
        return []
    squared, std = _offsets(view, doubtful, older)
    squared[older[None] > doubtful[:, None]] = np.inf
    squared[std > accurate] = np.inf
    best = squared.argmin(axis=1)
    rows = np.arange(len(doubtful))
    good = (squared[rows, best] <= SAME_GATE) & (squared.argmin(axis=0)[best] == rows)
    return _named(view, older[best[good]], doubtful[good])


def _recognised(
    view: MapView, is_lost: BoolArray, within: float, rules: Constellations
) -> Pairs:
    """Return landmarks of a constellation that is recognised."""
    away = np.hypot(*(view.landmarks - view.mean[:2]).T)
    local = np.flatnonzero(~is_lost & (away <= LOCAL_REACH * within))
    local = local[np.argsort(away[local], kind="stable")]
    older = np.flatnonzero(is_lost)
    feasible = _offsets(view, local, older)[0] <= OFFSET_GATE
    used = feasible.any(axis=0)
    older, feasible = older[used], feasible[:, used]
    match = match_constellations(_two_places(view, local, older), feasible, rules)
    if match is None:
        return []
    return _named(view, older[match.older], local[match.local])


def _named(view: MapView, kept: IntArray, gone: IntArray) -> Pairs:
    """Return the identities of landmarks, given by their places in a view."""
    pairs = zip(kept.tolist(), gone.tolist(), strict=True)
    return [(view.ids[i], view.ids[j]) for i, j in pairs]


def is_astray(view: MapView, rules: Constellations) -> bool:
    """Return whether the robot has a map, but knows no landmark of it accurately."""
    n = len(view.ids)
    if n < FEWEST_READINGS:
        return False
    accurate = ACCURATE * rules.lost_std
    return not _find_lost(*view[:2], accurate, np.zeros(n, dtype=np.bool_))[1]


def places_of_scan(
    view: MapView,
    readings: Array,
    noise: Noise,
    rules: Constellations,
    min_range: float = 0.0,
) -> list[tuple[Array, IntArray]]:
    """Return where a robot may be if it knows no landmark accurately.

    Parameters
    ----------
    view : MapView
        The map around the robot.
    readings : ndarray, shape (m, 2)
        The scan, rows (β, r) [rad, m].
    noise : Noise
        Of the sensor.
    rules : Constellations
        Limits of the search.
    min_range : float
        Readings closer than this are not used [m].

    Returns
    -------
    list of (ndarray, ndarray), shapes (3,) and (k,)
        Pose (x, y, θ) [m, m, rad], and the k landmarks that the scan shows there, by
        their place in the view.

    Raises
    ------
    ValueError
        If a bearing is not finite.
    """
    if len(readings) < FEWEST_READINGS:
        return []
    r = readings[:, 1]
    readings = readings[(r >= min_range) & (r <= LARGEST)]
    argument_checks.refuse_unusable(readings)
    gaps = _gaps(view, readings, noise)
    compared = np.sort(gaps, axis=None)[:LARGEST_GRAPH]
    feasible = gaps <= min(OFFSET_GATE, compared.max(initial=0.0))
    partners, used = feasible.sum(axis=1), np.flatnonzero(feasible.any(axis=0))
    rows = np.argsort(partners, kind="stable")[(partners == 0).sum() :]
    both = with_readings(view.part(used.tolist()), readings[rows], noise)
    known = np.arange(len(used))
    places = _two_places(both, len(used) + np.arange(len(rows)), known)
    feasible = feasible[np.ix_(rows, used)]
    rules = replace(rules, least=FEWEST_READINGS)
    found = []
    for match in agreeing_pairs(places, feasible, rules, most=MOST_PLACES):
        if len(match.local) and is_plausible(places, match):
            heading = wrap_angle(float(view.mean[2]) + turn_between(places, match))
            pose = np.append(moved(places, match, view.mean[:2]), heading)
            found.append((pose, used[match.older]))
    return found


def _gaps(view: MapView, readings: Array, noise: Noise) -> Array:
    """Return χ² of readings (m, 2) and landmarks, shape (m, n).

    If the robot is turned by φ, the offset of a landmark is Gaussian with the mean
    d + φ c / σ², where c is its covariance with the heading, and the reading shows the
    offset z(φ)::

        χ² = min over φ of φ² / σ² + ‖z(φ) − d − φ c / σ²‖²

    Gauss-Newton steps start at φ = 0, and at the φ for which the reading points to the
    landmark.  They neglect that the noise of the reading turns with the robot.
    """
    n, P = len(view.ids), view.covariance
    variance, r = P[2, 2] + TINY, readings[:, 1, None, None]
    across_std, along_std = np.sqrt(noise.variances(readings[:, 1])).T[..., None, None]
    columns = 3 + 2 * np.arange(n)
    d, D = separation(view.mean, P, columns, 0)
    lever = np.stack(covariance_with_heading(P, columns, 0), axis=-1) / variance
    C = D - variance * lever[:, :, None] * lever[:, None]
    size = np.trace(view.landmark_covariances + P[:2, :2], axis1=1, axis2=2)
    size = size[:, None, None] + (along_std**2 + (r * across_std) ** 2)[..., None]
    C = C + TINY * (1 + size) * np.eye(2)  # rounded, it might be singular
    ahead, found = view.mean[2] + readings[:, :1], np.inf
    pointing = wrap_angle(np.arctan2(d[:, 1], d[:, 0]) - ahead)
    for begin in (np.zeros_like(pointing), pointing):
        turn = begin
        for _ in range(TURNS):
            along = np.stack([np.cos(ahead + turn), np.sin(ahead + turn)], axis=-1)
            across = lever_of(along)
            stds = along_std * along, r * across_std * across
            S = C + sum(x[..., :, None] * x[..., None, :] for x in stds)
            slope = r * across - lever
            gap = r * along - d - turn[..., None] * lever
            found = np.minimum(found, turn**2 / variance + squared_offsets(gap, S))
            start = gap - turn[..., None] * slope
            own, rest = squared_offsets(slope, S), squared_offsets(start, S)
            both = squared_offsets(slope + start, S) - own - rest
            turn = np.clip(-both / 2 / (own + 1 / variance), -np.pi, np.pi)
    return np.asarray(found)


def _two_places(view: MapView, local: IntArray, older: IntArray) -> TwoPlaces:
    turn = TURN_STDS * float(np.sqrt(view.covariance[2, 2])) + SLACK
    part = view.part(np.concatenate([local, older]).tolist())
    around = seen_from(part.mean[:2], part.mean)
    covariance = invariant_covariance(around, part.covariance)[3:, 3:]
    points = view.landmarks[local], view.landmarks[older]
    return TwoPlaces(*points, covariance, min(turn, np.pi))


@jit
def _find_lost(
    mean: Array, P: Array, limit: float, is_lost: BoolArray
) -> tuple[int, int]:
    """Mark landmarks whose largest σ relative to the robot exceeds a limit [m].

    Return how many are local, and how many are not lost.
    """
    local, known = 0, 0
    for j in range(len(is_lost)):
        c = 3 + 2 * j
        dx, dy = mean[c] - mean[0], mean[c + 1] - mean[1]
        std = np.sqrt(max(variance_from_robot(P, c, dx, dy), 0.0))
        is_lost[j] = std > limit
        local += std <= LOCAL_STD * limit
        known += not std > limit
    return local, known


def _offsets(view: MapView, some: IntArray, others: IntArray) -> tuple[Array, Array]:
    """Return χ² and largest σ of the offsets of landmarks, shapes (m, n)."""
    columns = 3 + 2 * some[:, None], 3 + 2 * others
    d, C = relative_separation(view.mean, view.covariance, *columns)
    return squared_offsets(d, C), largest_std(C)
