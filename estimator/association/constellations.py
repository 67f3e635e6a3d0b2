"""Recognise a place by the constellation of its landmarks.

After a long drive without known landmarks the pose is too uncertain to associate single
readings.  The landmarks around the robot and an older part of the map then show the
same place twice, and what both have in common are the distances between landmarks.

Pairs (i, p) and (j, q) of a local and an older landmark agree if ::

    (‖a_i − a_j‖ − ‖b_p − b_q‖)² ≤ g (σ²_ij + σ²_pq)

and if the turn between both directions is plausible.  The largest set of pairs that all
agree, a maximum clique, is the candidate for a match [1]_.  Landmarks between those of
the clique are added, and the match is tested.  It is refused where a second place fits
nearly as well.

References
----------
.. [1] P. Lusk, K. Fathian, J. How, CLIPPER: a graph-theoretic framework for robust data
   association, ICRA 2021.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.special import chdtri

from ... import argument_checks
from ...arrays import Array, BoolArray, ComplexArray, IntArray
from ..kernels.assignment_search import compare_pairs, search_clique
from ..models.relative_geometry import lever_of, offset_covariance, squared_offsets
from ..models.rigid_motion import left_jacobian, rotation

# `benchmarks/loop_closure.py` counts what the limits without a formula decide: loops
# that are closed, and different landmarks that are merged.

#: Most pairs of landmarks that are compared; cost grows with its square.
LARGEST_GRAPH = 800
#: Squared difference of two distances over its variance; χ² of 1 degree, 99.9 %.
DISTANCE_GATE = 10.83
#: A second place that matches a larger share of the landmarks is a rival.
RIVAL_SHARE = 0.75
#: Ratio: how much farther apart a rival's pairs are than the worst pair of the match.
RIVAL_GAP = 3.0


@dataclass(frozen=True)
class Constellations:
    """Settings for recognising landmarks around the robot as an older part of the map.

    Raises
    ------
    ValueError
        If a value is out of range.
    """

    #: Smallest number of landmarks that make a constellation.
    least: int = 6
    #: A second place is a rival if it matches almost as many landmarks: fewer by less
    #: than this number, or more than three quarters of them.  The constellation is then
    #: not used.
    margin: int = 3
    #: A landmark whose position relative to the robot is less certain than this is not
    #: associated with single readings [m].
    lost_std: float = 2.0
    #: Limit of the search; beyond it no constellation is recognised.
    search_nodes: int = 20_000
    #: Whether single readings are not associated with uncertain landmarks either while
    #: the map holds too few landmarks, around the robot or elsewhere, to recognise one.
    always: bool = False

    def __post_init__(self) -> None:
        argument_checks.whole("constellations.least", self.least, 3)
        argument_checks.whole("constellations.margin", self.margin, 1)
        argument_checks.above("constellations.lost_std", self.lost_std, 0.0)
        argument_checks.whole("constellations.search_nodes", self.search_nodes, 1)
        argument_checks.flag("constellations.always", self.always)


def match_constellations(
    places: TwoPlaces, feasible: BoolArray, rules: Constellations
) -> Match | None:
    """Match the landmarks of two maps, or return None.

    Parameters
    ----------
    places : TwoPlaces
        Landmarks of both maps.
    feasible : ndarray of bool, shape (m, n)
        Which landmarks may be the same; rows in the order of importance.
    rules : Constellations
        Limits of a match.

    Examples
    --------
    Six landmarks are seen again, and the local map is turned by 0.3 rad:

    >>> b = np.array([(0, 0), (4, 1), (1, 5), (6, 6), (9, 2), (3, 9)], dtype=float)
    >>> cos, sin = np.cos(0.3), np.sin(0.3)
    >>> a = b @ np.array([(cos, -sin), (sin, cos)]) + 2.0
    >>> drift = np.kron(np.diag([9.0, 0.0]), np.kron(np.ones((6, 6)), np.eye(2)))
    >>> places = TwoPlaces(a, b, 0.01 * np.eye(24) + drift, largest_turn=1.0)
    >>> match = match_constellations(places, np.full((6, 6), True), Constellations())
    >>> match.local.tolist(), match.older.tolist()
    ([0, 1, 2, 3, 4, 5], [0, 1, 2, 3, 4, 5])
    """
    found = agreeing_pairs(places, feasible, rules, most=2)
    if len(found) != 1 or not len(found[0].local):
        return None
    match = extended(places, found[0])
    is_same = is_plausible(places, match) and is_filled(places, match)
    return match if is_same else None


def agreeing_pairs(
    places: TwoPlaces, feasible: BoolArray, rules: Constellations, most: int
) -> list[Match]:
    """Return the largest sets of pairs that agree, each with another displacement.

    The second and later ones are those that are nearly as large as the first.  An empty
    one at the end says that the search has reached its limit.
    """
    pairs, found = _candidates(feasible), list[Match]()
    if len(np.unique(pairs[:, 0])) < rules.least:
        return found
    local, older = tables(places)
    agree = np.zeros((len(pairs), len(pairs)), dtype=np.bool_)
    compare_pairs(pairs, local, older, DISTANCE_GATE, places.largest_turn, agree)
    floor = rules.least - 1
    while len(found) < most:
        if found:
            gaps = moved_gaps(places, found[-1])
            worst = gaps[found[-1].local, found[-1].older].max()
            others = gaps[pairs[:, 0], pairs[:, 1]] > RIVAL_GAP * worst
            pairs, agree = pairs[others], agree[np.ix_(others, others)]
            k = len(found[0].local)
            floor = max(min(k - rules.margin, int(RIVAL_SHARE * k)), 2)
        clique, is_complete = largest_clique(pairs, agree, floor, rules.search_nodes)
        if not len(clique):
            return found if is_complete else [*found, Match(clique, clique)]
        found.append(Match(*pairs[clique].T))
    return found


def _candidates(feasible: BoolArray) -> IntArray:
    """Return feasible pairs (i, p) of the first landmarks, shape (N, 2)."""
    counts = np.cumsum(feasible.sum(axis=1))
    rows = int(np.searchsorted(counts, LARGEST_GRAPH, side="right"))
    return np.argwhere(feasible[:rows])


def tables(places: TwoPlaces) -> tuple[Array, Array]:
    """Return distance, variance and direction between landmarks of each map."""
    m, P = 2 * len(places.local), places.covariance
    return _table(places.local, P[:m, :m]), _table(places.older, P[m:, m:])


def _table(points: Array, P: Array) -> Array:
    columns = 2 * np.arange(len(points))
    xx, xy, yy = offset_covariance(P, columns[None], columns[:, None])
    dx, dy = (points[None] - points[:, None]).transpose(2, 0, 1)
    length = np.hypot(dx, dy)
    squared = np.maximum(length, 1e-12) ** 2
    variance = (dx * dx * xx + 2 * dx * dy * xy + dy * dy * yy) / squared
    return np.stack([length, variance, np.arctan2(dy, dx)])


def largest_clique(
    pairs: IntArray, agree: BoolArray, floor: int, nodes: int
) -> tuple[IntArray, bool]:
    """Return a largest clique of more than `floor` pairs, and if all were searched.

    The clique is empty if there is none, or if the search has reached its limit.
    """
    clique = np.zeros(pairs[:, 0].max(initial=-1) + 2, dtype=np.int64)
    size, visited = search_clique(pairs, agree, floor, nodes, clique)
    is_complete = visited < nodes
    return clique[: size if is_complete else 0], is_complete


def _blocks(covariance: Array) -> Array:
    """Return a covariance as blocks, shape (n, n, 2, 2)."""
    n = len(covariance) // 2
    return covariance.reshape(n, 2, n, 2).transpose(0, 2, 1, 3)


# --------------------------------------------------------------------------------------
# Test whether landmarks of two maps are the same, with the heading free.
#
# The condition a_i = b_p is linear in the coordinates ξ of the invariant error.  If the
# local map has to turn by φ::
#
#     r_i = M(φ) (â_i − b̂_p) = ξ_p − ξ_i,    M(φ) = V(−φ)⁻¹
#
# however large φ is; V is the left Jacobian of SE(2).  A translation u and a
# further turn t of the local map change r by G (u, t), where G is [1, J (b̂ − mean b̂)].
# With S = cov(r) and ‖r‖² = rᵀ S⁻¹ r::
#
#     shape          min over (u, t) of ‖r − G (u, t)‖²              χ² of 2k − 3 dof
#     displacement   min over t of ‖r − J (b̂ − mean b̂) t‖² − shape   χ² of 2 dof
#
# so the heading is free in both: after long drift its covariance is the least reliable.

#: Probability that the right match fails each test, of its shape or its displacement.
TAIL = 1e-4
#: Largest χ² of a further pair given the matched ones; 2 degrees, 99.9 %.
PAIR_GATE = 13.8
#: Least share of the landmarks between the matched ones that must have a partner.
PARTNERS = 0.6


class TwoPlaces(NamedTuple):
    """Landmarks around the robot, and an older part of the map."""

    #: Positions â, shape (m, 2) [m].
    local: Array
    #: Positions b̂, shape (n, 2) [m].
    older: Array
    #: Of the invariant errors ξ of both, shape (2 (m + n), 2 (m + n)); local first.
    covariance: Array
    #: Largest plausible turn of the local map [rad].
    largest_turn: float


class Match(NamedTuple):
    """Landmarks of two maps that are the same."""

    #: Shape (k,).
    local: IntArray
    #: Shape (k,).
    older: IntArray


def turn_between(places: TwoPlaces, match: Match) -> float:
    """Return φ, by which the matched local landmarks have to be turned [rad]."""
    a, b = _matched(places, match)
    return float(np.angle(np.vdot(a - a.mean(), b - b.mean())))


def moved(places: TwoPlaces, match: Match, points: Array) -> Array:
    """Return points (..., 2) of the local map, moved with its matched landmarks [m].

    These are turned and shifted onto their partners.
    """
    a, b = places.local[match.local], places.older[match.older]
    turn = rotation(turn_between(places, match))
    return np.asarray(b.mean(axis=0) + (points - a.mean(axis=0)) @ turn.T)


def moved_gaps(places: TwoPlaces, match: Match) -> Array:
    """Return distances of local and older landmarks after a match, shape (m, n) [m]."""
    d = moved(places, match, places.local)[:, None] - places.older
    return np.asarray(np.hypot(d[..., 0], d[..., 1]))


def is_plausible(places: TwoPlaces, match: Match) -> bool:
    """Test shape and displacement of a match, with the heading free."""
    freedom = 2 * len(match.local) - 3, 2  # of the two parts of a misfit
    return bool(np.all(misfit(places, match) <= chdtri(freedom, TAIL)))


def misfit(places: TwoPlaces, match: Match) -> tuple[float, float]:
    """Return χ² of shape and displacement of a match, of 2k − 3 and 2 degrees."""
    r, S = _offsets(places, match, turn_between(places, match))
    b = places.older[match.older]
    turned = lever_of(b - b.mean(axis=0)).reshape(-1, 1)
    shifted = np.tile(np.eye(2), (len(b), 1))
    try:
        L = np.linalg.cholesky(S)
    except np.linalg.LinAlgError:
        return np.inf, np.inf
    r, turned, shifted = (np.linalg.solve(L, x) for x in (r, turned, shifted))
    shape = _unexplained(r, np.hstack([turned, shifted]))
    return shape, _unexplained(r, turned) - shape


def extended(places: TwoPlaces, match: Match) -> Match:
    """Add the pairs that the matched ones leave no doubt about.

    Given the matched pairs K, the offset of another pair has the mean and covariance ::

        r_j − S_jK S_KK⁻¹ r_K,    S_jj − S_jK S_KK⁻¹ S_Kj

    A pair is added if it passes the gate and each landmark is the other's nearest.
    """
    left = np.setdiff1d(np.arange(len(places.local)), match.local)
    free = np.setdiff1d(np.arange(len(places.older)), match.older)
    gaps = moved_gaps(places, match)[np.ix_(left, free)]
    if not gaps.size:
        return match
    nearest = gaps.argmin(axis=1)
    mutual = gaps.argmin(axis=0)[nearest] == np.arange(len(left))
    i, p = left[mutual], free[nearest[mutual]]
    every = Match(np.append(match.local, i), np.append(match.older, p))
    r, S = _offsets(places, every, turn_between(places, match))
    k = 2 * len(match.local)
    try:
        gain = np.linalg.solve(S[:k, :k], S[:k, k:]).T
    except np.linalg.LinAlgError:  # `misfit` refuses the match
        return match
    r_left, own = (r[k:] - gain @ r[:k]).reshape(-1, 2), np.arange(len(i))
    S_left = _blocks(S[k:, k:] - gain @ S[:k, k:])[own, own]
    good = squared_offsets(r_left, S_left) <= PAIR_GATE
    return Match(np.append(match.local, i[good]), np.append(match.older, p[good]))


def is_filled(places: TwoPlaces, match: Match) -> bool:
    """Return whether most landmarks between the matched ones have a partner."""
    a, b = _matched(places, match)
    local, older = _complex(places.local) - a.mean(), _complex(places.older) - b.mean()
    radius = np.abs(older[match.older]).max()
    inside = max(int((np.abs(x) <= radius).sum()) for x in (local, older))
    return len(a) >= PARTNERS * inside


def _offsets(places: TwoPlaces, match: Match, phi: float) -> tuple[Array, Array]:
    """Return r, shape (2k,), and its covariance S."""
    a, b = _matched(places, match)
    r = (a - b) / left_jacobian(np.array(-phi))
    columns = 2 * np.concatenate([match.local, len(places.local) + match.older])
    columns = (columns[:, None] + np.arange(2)).ravel()
    P, k = places.covariance[np.ix_(columns, columns)], 2 * len(a)
    S = P[:k, :k] + P[k:, k:] - P[:k, k:] - P[k:, :k]
    return np.column_stack([r.real, r.imag]).ravel(), (S + S.T) / 2


def _unexplained(r: Array, modes: Array) -> float:
    """Return what remains of ‖r‖² after a least-squares fit of some modes."""
    fit = np.linalg.lstsq(modes, r, rcond=None)[0]
    return float(np.sum((r - modes @ fit) ** 2))


def _matched(places: TwoPlaces, match: Match) -> tuple[ComplexArray, ComplexArray]:
    return _complex(places.local[match.local]), _complex(places.older[match.older])


def _complex(points: Array) -> ComplexArray:
    return np.asarray(points[:, 0] + 1j * points[:, 1])
