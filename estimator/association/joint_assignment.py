"""The most likely joint assignments of a scan's readings to landmarks.

An assignment gives each reading one landmark or none, and each landmark at most one
reading.  Its cost is −2 ln of its likelihood, up to a constant of the scan::

    cost = νᵀ S⁻¹ ν + ln det S + Σ λᵢ,    λᵢ = −2 ln ρᵢ − 2 ln 2π

ν and S = H P Hᵀ + Q belong to the paired readings together, the sum is over the
readings left out, and ρᵢ is the density, at the reading, of those that come from no
landmark of the map: clutter and landmarks that are not mapped yet [1 / (rad m)].

A depth-first branch and bound decides one reading after the other.  A pair conditions
the expected readings of all landmarks.  By the chain rule of the Gaussian, the cost of
an assignment is the sum of the costs of its pairs, each given the pairs before it::

    h ← h + K (z − h),  C ← C − K C,    K = C Hⱼᵀ (Cⱼⱼ + Q)⁻¹,    C = H P Hᵀ

The k readings still open add at least the following, since C ⪯ k blockdiag(Cⱼⱼ)::

    Σᵢ min(λᵢ, minⱼ νᵀ (k Cⱼⱼ + Q)⁻¹ ν + ln det Q)
"""

from typing import NamedTuple

import numpy as np

from ...arrays import Array, IntArray
from ..kernels.assignment_search import (
    UNPAIRED,
    Problem,
    fill_distances,
    fill_expected,
    search_assignments,
)
from ..models.bearing_range import wrap_angle


class Solutions(NamedTuple):
    """The best assignments, the cheapest first."""

    costs: Array
    """Shape (M,)."""
    marks: IntArray
    """Landmark 0 … J − 1 of each reading or `UNPAIRED`, shape (M, m)."""
    distances: Array
    """Least νᵀ S⁻¹ ν of each unpaired reading to a landmark without a reading, given
    the pairs, shape (M, m)."""
    is_complete: bool
    """False where the search stopped at its limit of nodes."""


def predicted_readings(
    mean: Array, covariance: Array, slots: IntArray
) -> tuple[Array, Array]:
    """Return h(x), shape (J, 2), and H P Hᵀ, shape (2J, 2J), of some landmarks.

    Parameters
    ----------
    mean, covariance : ndarray
        (x, y, θ, l1x, …) and P; there may be more behind the landmarks.
    slots : ndarray of int64, shape (J,)
        Places of the landmarks in the map.
    """
    count = len(slots)
    expected, joint = np.empty((count, 2)), np.empty((2 * count, 2 * count))
    fill_expected(mean, covariance, slots, expected, joint)
    return expected, joint


def innovations_of(readings: Array, expected: Array) -> Array:
    """Return z − h(x) of all pairs, shape (m, J, 2), bearings in [-π, π)."""
    innovations = readings[:, None] - expected[None]
    innovations[..., 0] = wrap_angle(innovations[..., 0])
    return innovations


def best_assignments(
    problem: Problem,
    *,
    most: int = 1,
    spread: float = np.inf,
    ceiling: float = np.inf,
    nodes: int = 2000,
) -> Solutions:
    """Return the cheapest assignments of a scan.

    Parameters
    ----------
    problem : Problem
    most : int
        M, how many at most.
    spread : float
        Largest difference of their costs to the least.
    ceiling : float
        Cost beyond which only the first one found is of interest.
    nodes : int
        Limit of the search.  At the limit, the best assignments found so far are
        returned.  The first of them always gives each reading in turn the pair that is
        most likely given the pairs before it.

    Notes
    -----
    With ``pairs_first`` and χ² limits this is the joint compatibility test of [1]_.

    References
    ----------
    .. [1] J. Neira, J. Tardós, Data association in stochastic mapping using the joint
       compatibility test, IEEE Transactions on Robotics and Automation 17, 2001.

    Examples
    --------
    >>> expected, variances = np.array([(0.0, 5.0), (0.3, 5.0)]), np.full((2, 2), 0.01)
    >>> problem = Problem(
    ...     innovations=innovations_of(expected + 0.2, expected),
    ...     joint=np.tile(0.04 * np.eye(2), (2, 2)),
    ...     variances=variances,
    ...     feasible=np.ones((2, 2), dtype=bool),
    ...     missing=np.full(2, 9.0),
    ...     gate=25.0,
    ...     limits=np.full(3, np.inf),
    ...     pairs_first=False,
    ... )
    >>> best_assignments(problem).marks.tolist()
    [[0, 1]]
    """
    rows, visited = len(problem.innovations), 0
    costs = np.full(most, np.inf)
    marks = np.full((most, rows), UNPAIRED)
    distances = np.full((most, rows), np.inf)
    if problem.feasible.size:
        visited = search_assignments(problem, costs, marks, spread, ceiling, nodes)
    else:
        costs[0] = problem.missing.sum()
    count = int((np.isfinite(costs) & (costs <= costs[0] + spread)).sum())
    if problem.feasible.size:
        fill_distances(problem, marks[:count], distances[:count])
    return Solutions(costs[:count], marks[:count], distances[:count], visited < nodes)
