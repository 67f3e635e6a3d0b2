"""Test whether landmarks of two maps are the same, with the heading free.

The condition a_i = b_p is linear in the coordinates ξ of the invariant error.  If the
local map has to turn by φ::

    r_i = M(φ) (â_i − b̂_p) = ξ_p − ξ_i,    M(φ) = V(−φ)⁻¹

however large φ is; V is the left Jacobian of SE(2).  A translation u and a further turn
t of the local map change r by G (u, t) with G = [1, J (b̂ − mean b̂)].  With S = cov(r)
and ‖r‖² = rᵀ S⁻¹ r::

    shape          min over (u, t) of ‖r − G (u, t)‖²              χ² of 2k − 3 dof
    displacement   min over t of ‖r − J (b̂ − mean b̂) t‖² − shape   χ² of 2 dof

so the heading is free in both: after long drift its covariance is the least reliable.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.special import chdtri

from ...arrays import Array, ComplexArray, IntArray
from ..models.rigid_motion import left_jacobian

TAIL = 1e-4
"""Probability that the right match fails the test of its shape or displacement."""
PAIR_GATE = 13.8
"""Largest χ² of a further pair given the matched ones; 2 degrees, 99.9 %."""
PARTNERS = 0.6
"""Least share of landmarks between the matched ones that must have a partner."""


class TwoPlaces(NamedTuple):
    """Landmarks around the robot, and an older part of the map."""

    local: Array
    """Positions â, shape (m, 2) [m]."""
    older: Array
    """Positions b̂, shape (n, 2) [m]."""
    covariance: Array
    """Of the invariant errors ξ of both, shape (2 (m + n), 2 (m + n)); local first."""
    largest_turn: float
    """Largest plausible turn of the local map [rad]."""


class Match(NamedTuple):
    """Landmarks of two maps that are the same."""

    local: IntArray
    """Shape (k,)."""
    older: IntArray
    """Shape (k,)."""


class Misfit(NamedTuple):
    """χ² of a match, with the heading free."""

    shape: float
    """Of 2k − 3 degrees of freedom."""
    displacement: float
    """Of 2 degrees of freedom."""


def turn_between(places: TwoPlaces, match: Match) -> float:
    """Return φ, by which the matched local landmarks have to be turned [rad]."""
    a, b = (_complex(points) for points in _matched(places, match))
    return float(np.angle(np.vdot(a - a.mean(), b - b.mean())))


def moved_gaps(places: TwoPlaces, match: Match) -> Array:
    """Return distances of local and older landmarks after a match, shape (m, n) [m].

    The matched landmarks of the local map are turned and shifted onto their partners.
    """
    a, b = (_complex(points) for points in _matched(places, match))
    turn = np.exp(1j * turn_between(places, match))
    moved = b.mean() + turn * (_complex(places.local) - a.mean())
    return np.asarray(np.abs(moved[:, None] - _complex(places.older)[None]))


def is_same_place(places: TwoPlaces, match: Match) -> bool:
    """Test shape and displacement of a match, and what lies between its landmarks."""
    return is_plausible(places, match) and is_filled(places, match)


def is_plausible(places: TwoPlaces, match: Match) -> bool:
    """Test shape and displacement of a match, with the heading free."""
    fit = misfit(places, match)
    freedom = 2 * len(match.local) - 3
    return bool(
        fit.shape <= chdtri(freedom, TAIL) and fit.displacement <= chdtri(2, TAIL)
    )


def misfit(places: TwoPlaces, match: Match) -> Misfit:
    """Return how far shape and displacement of a match are from what is expected."""
    r, S = _offsets(places, match, turn_between(places, match))
    b = places.older[match.older]
    turned = ((b - b.mean(axis=0))[:, ::-1] * (-1.0, 1.0)).reshape(-1, 1)  # J b
    shifted = np.tile(np.eye(2), (len(b), 1))
    try:
        L = np.linalg.cholesky(S)
    except np.linalg.LinAlgError:
        return Misfit(np.inf, np.inf)
    r, turned, shifted = (np.linalg.solve(L, x) for x in (r, turned, shifted))
    shape = _unexplained(r, np.hstack([turned, shifted]))
    return Misfit(shape, _unexplained(r, turned) - shape)


def extended(places: TwoPlaces, match: Match) -> Match:
    """Add the pairs that the matched ones leave no doubt about.

    Given the matched pairs K, the offset of another pair has the mean and covariance ::

        r_j − S_jK S_KK⁻¹ r_K,    S_jj − S_jK S_KK⁻¹ S_Kj

    A pair is added if it passes the gate and each landmark is the other's nearest.
    """
    phi = turn_between(places, match)
    m, n = len(places.local), len(places.older)
    left = np.setdiff1d(np.arange(m), match.local)
    free = np.setdiff1d(np.arange(n), match.older)
    gaps = moved_gaps(places, match)[np.ix_(left, free)]
    if not gaps.size:
        return match
    nearest = gaps.argmin(axis=1)
    mutual = gaps.argmin(axis=0)[nearest] == np.arange(len(left))
    i, p = left[mutual], free[nearest[mutual]]
    every = Match(np.append(match.local, i), np.append(match.older, p))
    r, S = _offsets(places, every, phi)
    k = 2 * len(match.local)
    gain = np.linalg.solve(S[:k, :k], S[:k, k:]).T
    r_left, S_left = r[k:] - gain @ r[:k], S[k:, k:] - gain @ S[:k, k:]
    good = [
        row
        for row in range(len(i))
        if _chi_square(r_left, S_left, slice(2 * row, 2 * row + 2)) <= PAIR_GATE
    ]
    return Match(np.append(match.local, i[good]), np.append(match.older, p[good]))


def is_filled(places: TwoPlaces, match: Match) -> bool:
    """Return whether most landmarks between the matched ones have a partner."""
    phi = turn_between(places, match)
    a, b = (_complex(points) for points in _matched(places, match))
    moved = np.exp(1j * phi) * (_complex(places.local) - a.mean())
    older = _complex(places.older) - b.mean()
    radius = np.abs(older[match.older]).max()
    k = len(match.local)
    inside = max(int((np.abs(x) <= radius).sum()) for x in (moved, older))
    return k >= PARTNERS * inside


def _offsets(places: TwoPlaces, match: Match, phi: float) -> tuple[Array, Array]:
    """Return r, shape (2k,), and its covariance S."""
    a, b = (_complex(points) for points in _matched(places, match))
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


def _chi_square(r: Array, S: Array, rows: slice) -> float:
    part = S[rows, rows]
    if not np.linalg.det(part) > 0:
        return np.inf
    return float(r[rows] @ np.linalg.solve(part, r[rows]))


def _matched(places: TwoPlaces, match: Match) -> tuple[Array, Array]:
    return places.local[match.local], places.older[match.older]


def _complex(points: Array) -> ComplexArray:
    return np.asarray(points[:, 0] + 1j * points[:, 1])
