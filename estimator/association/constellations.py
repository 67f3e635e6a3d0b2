"""Recognise a place by the constellation of its landmarks.

After a long drive without known landmarks the pose is too uncertain to associate single
readings.  The landmarks around the robot and an older part of the map then show the
same place twice, and what both have in common are the distances between landmarks.

Pairs (i, p) and (j, q) of a local and an older landmark agree if ::

    (‖a_i − a_j‖ − ‖b_p − b_q‖)² ≤ g (σ²_ij + σ²_pq)

and if the turn between both directions is plausible.  The largest set of pairs that all
agree, a maximum clique, is the candidate for a match [1]_.  Landmarks between those of
the clique are added, and the match is tested (:mod:`.same_place`).  It is refused where
a second place fits nearly as well.

References
----------
.. [1] P. Lusk, K. Fathian, J. How, CLIPPER: a graph-theoretic framework for robust data
   association, ICRA 2021.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...arrays import Array, BoolArray, IntArray
from ..kernels.assignment_search import compare_pairs, search_clique
from ..support import argument_checks
from .same_place import Match, TwoPlaces, extended, is_same_place, moved_gaps

LARGEST_GRAPH = 800
"""Most pairs of landmarks that are compared."""
DISTANCE_GATE = 10.83
"""Squared difference of two distances over its variance; χ² of 1 degree, 99.9 %."""
RIVAL_SHARE = 0.75
"""A second place with a larger share of the landmarks is a rival."""
RIVAL_GAP = 3.0
"""How much farther apart a rival's pairs are than the worst pair of the match."""


@dataclass(frozen=True)
class Constellations:
    """Settings for recognising landmarks around the robot as an older part of the map.

    Raises
    ------
    ValueError
        If a value is out of range.
    """

    least: int = 6
    """Smallest number of landmarks that make a constellation."""
    margin: int = 3
    """A second place is a rival if it matches almost as many landmarks: fewer by less
    than this number, or more than three quarters of them.  The constellation is then
    not used."""
    lost_std: float = 1.0
    """A landmark whose position relative to the robot is less certain than this is not
    associated with single readings [m]."""
    search_nodes: int = 20_000
    """Limit of the search; beyond it no constellation is recognised."""

    def __post_init__(self) -> None:
        argument_checks.whole("constellations.least", self.least, 3)
        argument_checks.whole("constellations.margin", self.margin, 1)
        argument_checks.above("constellations.lost_std", self.lost_std, 0.0)
        argument_checks.whole("constellations.search_nodes", self.search_nodes, 1)


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
    pairs = _candidates(feasible)
    if len(np.unique(pairs[:, 0])) < rules.least:
        return None
    local, older = tables(places)
    agree = np.zeros((len(pairs), len(pairs)), dtype=np.bool_)
    compare_pairs(pairs, local, older, DISTANCE_GATE, places.largest_turn, agree)
    clique = largest_clique(pairs, agree, rules.least - 1, rules.search_nodes)
    if not len(clique):
        return None
    match = Match(*pairs[clique].T)
    if _has_rival(places, match, pairs, agree, rules):
        return None
    match = extended(places, match)
    return match if is_same_place(places, match) else None


def _candidates(feasible: BoolArray) -> IntArray:
    """Return feasible pairs (i, p) of the first landmarks, shape (N, 2)."""
    counts = np.cumsum(feasible.sum(axis=1))
    rows = int(np.searchsorted(counts, LARGEST_GRAPH, side="right"))
    return np.argwhere(feasible[:rows])


def tables(places: TwoPlaces) -> tuple[Array, Array]:
    """Return distance, variance and direction between landmarks of each map."""
    m = len(places.local)
    P = _blocks(places.covariance)
    return (
        _table(places.local, P[:m, :m]),
        _table(places.older, P[m:, m:]),
    )


def _table(points: Array, P: Array) -> Array:
    d = points[None] - points[:, None]
    length = np.hypot(d[..., 0], d[..., 1])
    u = d / np.maximum(length, 1e-12)[..., None]
    own = P[np.arange(len(points)), np.arange(len(points))]
    C = own[:, None] + own[None] - P - P.transpose(1, 0, 2, 3)
    variance = np.einsum("ija,ijab,ijb->ij", u, C, u)
    return np.stack([length, variance, np.arctan2(d[..., 1], d[..., 0])])


def largest_clique(
    pairs: IntArray, agree: BoolArray, floor: int, nodes: int
) -> IntArray:
    """Return a largest clique of more than `floor` pairs; none at the limit."""
    clique = np.zeros(pairs[:, 0].max(initial=-1) + 2, dtype=np.int64)
    size, visited = search_clique(pairs, agree, floor, nodes, clique)
    return clique[: size if visited < nodes else 0]


def _has_rival(
    places: TwoPlaces,
    match: Match,
    pairs: IntArray,
    agree: BoolArray,
    rules: Constellations,
) -> bool:
    """Return whether another displacement explains nearly as many landmarks.

    The pairs that the displacement of the match explains are left out.
    """
    gaps = moved_gaps(places, match)
    worst = gaps[match.local, match.older].max()
    others = gaps[pairs[:, 0], pairs[:, 1]] > RIVAL_GAP * worst
    k = len(match.local)
    floor = max(min(k - rules.margin, int(RIVAL_SHARE * k)), 2)
    clique = np.zeros(len(places.local) + 1, dtype=np.int64)
    rest = agree[np.ix_(others, others)]
    nodes = rules.search_nodes
    size, visited = search_clique(pairs[others], rest, floor, nodes, clique)
    return size > 0 or visited >= nodes


def _blocks(covariance: Array) -> Array:
    """Return a covariance as blocks, shape (n, n, 2, 2)."""
    n = len(covariance) // 2
    return covariance.reshape(n, 2, n, 2).transpose(0, 2, 1, 3)
