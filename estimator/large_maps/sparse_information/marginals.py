"""Marginals of the pose and some landmarks of a sparse information map."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.linalg import solve_triangular

from ....arrays import Array, IntArray
from ..sparse_cholesky.coordinates import pairs
from ..sparse_cholesky.landmark_elimination import RestFactor
from ..sparse_cholesky.schur_complement import SchurComplement
from .conditional_pose import ConditionalPose
from .local_information import LocalInformation, SparseMap


class Marginal(NamedTuple):
    """Gaussian of the pose and n landmarks."""

    mean: Array
    """Shape (3 + 2n,)."""
    covariance: Array
    """Shape (3 + 2n, 3 + 2n)."""


def marginal(
    map_: SparseMap,
    local: LocalInformation,
    rest: RestFactor,
    pose: ConditionalPose,
    slots: IntArray,
) -> Marginal:
    """Return the marginal of the pose and some landmarks.

    With L the local map and H all other landmarks::

        p = K m_L + ω,   m_H = −T m_B + h,   cov ω = Ω,  cov h = Λ_HH⁻¹
        Σ_LL = (Λ_LL − C)⁻¹

    With G = [K; E; −T], the covariance is G Σ_LL Gᵀ plus Ω and blocks of Λ_HH⁻¹.  Only
    the requested rows of T and Λ_HH⁻¹ are computed.

    Parameters
    ----------
    map_ : SparseMap
    local : LocalInformation
    rest : RestFactor
        Of all landmarks except the local ones.
    pose : ConditionalPose
    slots : ndarray, shape (n,)
        The landmarks.
    """
    place = np.full(len(map_.points) // 2, -1)
    place[local.slots] = np.arange(len(local.slots))
    is_near = place[slots] >= 0
    inside = np.append([True] * 3, np.repeat(is_near, 2))
    outside = np.flatnonzero(~inside)
    here = np.append([0, 1, 2], 3 + pairs(place[slots[is_near]]))
    whole = rest.complement()
    near = _near(local, whole, pose)  # its bits do not depend on the slots
    covariance = np.empty((len(inside), len(inside)))
    covariance[np.ix_(inside, inside)] = near[np.ix_(here, here)]
    if len(outside):
        own, T = rest.covariance(slots[~is_near])
        border = 3 + whole.border
        own += T @ near[np.ix_(border, border)] @ T.T
        covariance[np.ix_(outside, outside)] = (own + own.T) / 2
        cross = -T @ near[np.ix_(border, here)]
        covariance[np.ix_(outside, inside)] = cross
        covariance[np.ix_(inside, outside)] = cross.T
    mean = np.concatenate([pose.mean, means(map_, local)[pairs(slots)]])
    return Marginal(mean, covariance)


def _near(
    local: LocalInformation, whole: SchurComplement, pose: ConditionalPose
) -> Array:
    """Return the covariance of the pose and all local landmarks."""
    exact = replace(local, eliminated=whole)
    rows = np.vstack([pose.gain, np.eye(len(local.points))])
    root = solve_triangular(exact.solver()[0], rows.T, lower=True, check_finite=False)
    covariance = root.T @ root
    covariance[:3, :3] += pose.covariance
    return np.asarray(covariance)


def means(map_: SparseMap, local: LocalInformation) -> Array:
    """Return the positions of all landmarks by slot, flat [m]."""
    points = map_.points.copy()
    shift = local.shift
    if shift.any():
        eliminated = local.eliminated
        points[pairs(eliminated.slots)] -= eliminated.factor.respond(shift)
    points[pairs(local.slots)] = local.points
    return points
