"""Assign the readings of a scan to landmarks of a map, by one of several methods."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.special import chdtri

from ...arrays import Array, IntArray
from ..interface import MapView
from ..kernels.assignment_search import UNPAIRED, Problem, largest_change
from .association_policy import AssociationPolicy
from .joint_assignment import best_assignments, innovations_of, predicted_readings
from .nearest_neighbour import (
    AMBIGUOUS,
    NEW,
    Distances,
    Noise,
    innovation_distances,
    nearest_neighbours,
)

BRANCH_SPREAD = 16.0
"""Assignments of a scan e^8 times less likely than the best one are not considered."""

SAME = 1.0
"""Beliefs with the same landmarks are one if no coordinate changes by more σ."""


class Assignment(NamedTuple):
    """Landmarks of the readings of one scan."""

    cost: float
    """−2 ln of the likelihood, up to a constant of the scan; 0 by nearest neighbour."""
    slots: IntArray
    """Place in the map of each reading's landmark, `NEW` or `AMBIGUOUS`, shape (m,)."""


class Assignments(NamedTuple):
    """The assignments to consider for one scan."""

    ranked: list[Assignment]
    """The most likely first."""
    explained: IntArray
    """Landmarks that some reading may belong to, shape (k,)."""


def assign_scan(
    policy: AssociationPolicy,
    view: MapView,
    readings: Array,
    noise: Noise,
    density: float | Array,
    *,
    ceiling: float = np.inf,
) -> Assignments:
    """Assign readings (m, 2) to the landmarks of a map.

    Parameters
    ----------
    policy : AssociationPolicy
        Method, gates and limits.
    view : MapView
        Pose and landmarks.
    readings : ndarray, shape (m, 2)
        Rows (β, r) [rad, m].
    noise : Noise
        Of the sensor.
    density : float or ndarray, shape (m,)
        Readings per scan that belong to no landmark of the map, where each reading is
        [1 / (rad m)].
    ceiling : float
        Cost beyond which only the most likely assignment is of interest.
    """
    fit = innovation_distances(
        view.mean, view.covariance, len(view.ids), readings, noise, policy.new_gate
    )
    explained = np.flatnonzero(np.isfinite(fit.squared).any(axis=0))
    if policy.association == "nearest":
        return Assignments([Assignment(0.0, assign_nearest(policy, fit))], explained)
    expected, joint = predicted_readings(view.mean, view.covariance, explained)
    pairs_first, count = policy.association == "compatibility", len(readings)
    problem = Problem(
        innovations=innovations_of(readings, expected),
        joint=joint,
        variances=_variances(readings, noise),
        feasible=fit.squared[:, explained] <= policy.pair_gate,
        missing=np.zeros(count) if pairs_first else missing_costs(density, count),
        gate=policy.pair_gate,
        limits=_limits(policy, count),
        pairs_first=pairs_first,
    )
    most = policy.branches if policy.association == "hypotheses" else 1
    found = best_assignments(
        problem,
        most=most,
        spread=BRANCH_SPREAD,
        ceiling=ceiling,
        nodes=policy.search_nodes,
    )
    ranked, chosen = [], list[IntArray]()
    for cost, marks, distances in zip(*found[:3], strict=True):
        slots = _slots(policy, marks, distances, explained)
        if not _is_superfluous(problem, marks, slots, chosen):
            chosen.append(marks)
            ranked.append(Assignment(float(cost), slots))
    return Assignments(ranked, explained)


def _is_superfluous(
    problem: Problem, marks: IntArray, slots: IntArray, better: list[IntArray]
) -> bool:
    """Return whether these only leave out readings that hardly change the belief."""
    ambiguous = slots == AMBIGUOUS
    return any(
        ambiguous[marks != other].all() and largest_change(problem, other, marks) < SAME
        for other in better
    )


def assign_nearest(policy: AssociationPolicy, fit: Distances) -> IntArray:
    """Assign each reading to its most likely landmark, as the policy's gates allow."""
    return nearest_neighbours(
        fit,
        match=policy.match_gate,
        new=policy.new_gate,
        ambiguity=policy.ambiguity,
    )


def _variances(readings: Array, noise: Noise) -> Array:
    """Return (σβ², σr²) of each reading, shape (m, 2); above 0, for their logarithm."""
    return np.maximum(noise.variances(readings[:, 1]), np.finfo(np.float64).tiny)


def _limits(policy: AssociationPolicy, rows: int) -> Array:
    """Return the largest νᵀ S⁻¹ ν of 0 … m pairs together."""
    limits = np.full(rows + 1, np.inf)
    if policy.association == "compatibility":
        limits[1:] = chdtri(2.0 * np.arange(1, rows + 1), policy.pair_tail)
    return limits


def missing_costs(density: float | Array, rows: int) -> Array:
    """Return λ = −2 ln ρ − 2 ln 2π of each reading, its cost without a landmark.

    Examples
    --------
    >>> missing_costs(0.02, 2).round(2)
    array([4.15, 4.15])
    """
    return np.full(rows, -2 * np.log(density) - 2 * np.log(2 * np.pi))


def _slots(
    policy: AssociationPolicy, marks: IntArray, distances: Array, explained: IntArray
) -> IntArray:
    """Translate marks into slots; unpaired readings near a landmark are ambiguous."""
    slots = np.where(distances <= policy.new_gate, AMBIGUOUS, NEW)
    paired = marks != UNPAIRED
    slots[paired] = explained[marks[paired]]
    return np.asarray(slots, dtype=np.int64)
