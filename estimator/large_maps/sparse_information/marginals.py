"""What a sparse information matrix says about some of its landmarks and the pose."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

from ..sparse_cholesky.coordinates import pairs
from ..sparse_cholesky.information_matrix import Surroundings
from .conditional_pose import PoseGivenMap
from .local_information import LocalInformation, Map

Array = NDArray[np.float64]
Int = NDArray[np.int64]


class Marginal(NamedTuple):
    """Of the pose and some landmarks."""

    mean: Array
    """Shape (3 + 2n,)."""
    covariance: Array
    """Shape (3 + 2n, 3 + 2n)."""


def marginal(
    world: Map,
    local: LocalInformation,
    everything: Surroundings,
    pose: PoseGivenMap,
    slots: Int,
) -> Marginal:
    """Marginal of the pose and of landmarks by their slots.

    With L the local map and ``everything`` all landmarks H beside it::

        p = K m_L + ω,   m_H = −T m_B + h,   cov ω = Ω,  cov h = Λ_HH⁻¹
        Σ_LL = (Λ_LL − C)⁻¹

    so that with G = [K; E; −T] the answer is G Σ_LL Gᵀ plus Ω and blocks of Λ_HH⁻¹, of
    which only the columns that were asked for are solved for.
    """
    place = np.full(len(world.points) // 2, -1)
    place[local.slots] = np.arange(len(local.slots))
    is_near = place[slots] >= 0
    inside = np.append([True] * 3, np.repeat(is_near, 2))
    outside = np.flatnonzero(~inside)
    here = np.append([0, 1, 2], 3 + pairs(place[slots[is_near]]))
    columns = pairs(np.searchsorted(everything.slots, slots[~is_near]))
    near = _near(local, everything, pose)  # the same bits whatever is asked for
    border = 3 + everything.border
    covariance = np.empty((len(inside), len(inside)))
    covariance[np.ix_(inside, inside)] = near[np.ix_(here, here)]
    if len(outside):
        unit = np.zeros((2 * len(everything.slots), len(columns)))
        unit[columns, np.arange(len(columns))] = 1.0
        solved = everything.solve(unit)
        link = world.information.part(everything.slots, local.slots).tocsc()
        T = (link[:, everything.border].T @ solved).T
        own = solved[columns] + T @ near[np.ix_(border, border)] @ T.T
        covariance[np.ix_(outside, outside)] = (own + own.T) / 2
        cross = -T @ near[np.ix_(border, here)]
        covariance[np.ix_(outside, inside)] = cross
        covariance[np.ix_(inside, outside)] = cross.T
    mean = np.concatenate([pose.mean, means(world, local)[pairs(slots)]])
    return Marginal(mean, covariance)


def _near(
    local: LocalInformation, everything: Surroundings, pose: PoseGivenMap
) -> Array:
    """Covariance of the pose and all local landmarks."""
    exact = replace(local, surroundings=everything)
    rows = np.vstack([pose.gain, np.eye(len(local.points))])
    root = solve_triangular(exact.solver()[0], rows.T, lower=True, check_finite=False)
    covariance = root.T @ root
    covariance[:3, :3] += pose.covariance
    return np.asarray(covariance)


def means(world: Map, local: LocalInformation) -> Array:
    """Positions of all landmarks as they are known now, by slots, flat [m]."""
    points = world.points.copy()
    around = local.surroundings
    shift = local.shift
    if shift.any():
        points[pairs(around.slots)] -= around.respond(shift)
    points[pairs(local.slots)] = local.points
    return points
