"""The joint assignment of a scan, step by step in numpy."""

from typing import NamedTuple

import numpy as np

from slamgym.arrays import Array, IntArray
from slamgym.estimator.association.scan_assignments import (
    AMBIGUOUS,
    BRANCH_SPREAD,
    NEW,
    SAME,
    innovation_distances,
    likely_variances_jit,
    missing_costs,
)
from slamgym.estimator.kernels.assignment_search import (
    UNPAIRED,
    Problem,
    best_assignments,
    fill_expected,
    largest_change,
)
from slamgym.estimator.models.bearing_range import wrap_angle


class Solutions(NamedTuple):
    """What `best_assignments` returns."""

    costs: Array
    marks: IntArray
    distances: Array
    is_complete: bool


def solve(problem, most=1, spread=np.inf, ceiling=np.inf, nodes=2000):
    """Return the cheapest assignments of a scan."""
    return Solutions(*best_assignments(tuple(problem), most, spread, ceiling, nodes))


def predicted_readings(mean, covariance, slots):
    """Return h(x), shape (J, 2), and H P Hᵀ, shape (2J, 2J), of some landmarks."""
    count = len(slots)
    expected, joint = np.empty((count, 2)), np.empty((2 * count, 2 * count))
    fill_expected(mean, covariance, slots, expected, joint)
    return expected, joint


def innovations_of(readings, expected):
    """Return z − h(x) of all pairs, shape (m, J, 2), bearings in [-π, π)."""
    innovations = readings[:, None] - expected[None]
    innovations[..., 0] = wrap_angle(innovations[..., 0])
    return innovations


def assign_plainly(
    policy, view, readings, noise, density, *, limits, most, ceiling=np.inf
):
    """Return costs, slots and explained landmarks, as `assign_scan` does jointly."""
    fit = innovation_distances(view, readings, noise, policy.new_gate)
    explained = np.flatnonzero(np.isfinite(fit.squared).any(axis=0))
    expected, joint = predicted_readings(view.mean, view.covariance, explained)
    pairs = [*zip(expected[:, 1], np.diagonal(joint)[1::2], strict=True)]
    variances = [
        [likely_variances_jit(noise, z, *pair) for pair in pairs]
        for z in readings[:, 1]
    ]
    pairs_first = policy.association == "compatibility"
    missing = missing_costs(density)
    problem = Problem(
        innovations_of(readings, expected),
        joint,
        np.reshape(variances, (len(readings), len(explained), 2)),
        np.ascontiguousarray(fit.squared[:, explained] <= policy.pair_gate),
        np.zeros(len(readings)) if pairs_first else missing,
        policy.pair_gate,
        limits,
        pairs_first,
    )
    found = solve(problem, most, BRANCH_SPREAD, ceiling)
    kept, chosen = [], []
    for cost, marks, distances in zip(*found[:3], strict=True):
        slots = np.where(distances <= policy.pair_gate, AMBIGUOUS, NEW)
        slots[marks != UNPAIRED] = explained[marks[marks != UNPAIRED]]
        if not any(
            (slots[marks != other] == AMBIGUOUS).all()
            and largest_change(tuple(problem), other, marks) < SAME
            for other in chosen
        ):
            chosen.append(marks)
            kept.append((cost, slots))
    return [cost for cost, _ in kept], [slots for _, slots in kept], explained
