"""Offsets of points, and their covariances, against numeric derivatives."""

import numpy as np
import pytest

from slamgym.estimator.models.bearing_range import reading_slopes
from slamgym.estimator.models.relative_geometry import (
    largest_std,
    reading_covariance,
    relative_separation,
    separation,
    squared_offsets,
    variance_from_robot,
)
from slamgym.estimator.models.rigid_motion import rotation

ROBOT, FIRST, THIRD = 0, 3, 7  # columns of points
PAIRS = [(FIRST, ROBOT), (THIRD, ROBOT), (THIRD, FIRST), (ROBOT, FIRST)]
SEEDS = pytest.mark.parametrize("seed", range(4))


def belief(seed):
    rng = np.random.default_rng(seed)
    root = rng.standard_normal((9, 9))
    return 3 * rng.standard_normal(9), root @ root.T


def propagated(function, mean, P, step=1e-6):
    """Return J P Jᵀ, J by central differences."""
    moves = step * np.eye(len(mean))
    J = np.stack([function(mean + d) - function(mean - d) for d in moves], axis=1)
    J /= 2 * step
    return J @ P @ J.T


@SEEDS
@pytest.mark.parametrize(("i", "j"), PAIRS)
def test_relative_covariance_is_that_of_the_offset_in_the_axes_of_the_robot(seed, i, j):
    mean, P = belief(seed)

    def seen(state):  # along the axes of the world at the estimate
        return rotation(mean[2] - state[2]) @ (state[i : i + 2] - state[j : j + 2])

    d, C = relative_separation(mean, P, i, j)
    np.testing.assert_allclose(d, seen(mean))
    np.testing.assert_allclose(C, propagated(seen, mean, P), rtol=1e-6)


@SEEDS
@pytest.mark.parametrize(("i", "j"), PAIRS)
def test_separation_is_the_marginal_of_a_difference(seed, i, j):
    mean, P = belief(seed)
    d, D = separation(mean, P, i, j)
    H = np.zeros((2, 9))
    H[:, i : i + 2], H[:, j : j + 2] = np.eye(2), -np.eye(2)
    np.testing.assert_allclose(d, H @ mean, atol=1e-15)
    np.testing.assert_allclose(D, H @ P @ H.T, rtol=1e-12)
    assert squared_offsets(d, D) == pytest.approx(d @ np.linalg.solve(D, d))
    largest = np.linalg.eigvalsh(D)[-1]
    assert largest_std(D / 1e4) == pytest.approx(np.sqrt(largest) / 100)


@pytest.mark.parametrize("function", [separation, relative_separation])
def test_arrays_of_columns_give_the_same_bits_as_numbers(function):
    mean, P = belief(0)
    columns = np.array([ROBOT, FIRST, 5, THIRD])
    d, C = function(mean, P, columns[:, None], columns)
    for a, i in enumerate(columns.tolist()):
        for b, j in enumerate(columns.tolist()):
            one = function(mean, P, i, j)
            np.testing.assert_array_equal(d[a, b], one[0])
            np.testing.assert_array_equal(C[a, b], one[1])


@SEEDS
def test_covariance_of_a_reading_is_that_of_bearing_and_range(seed):
    mean, P = belief(seed)

    def read(state):
        dx, dy = state[THIRD : THIRD + 2] - state[:2]
        return np.array([np.arctan2(dy, dx) - state[2], np.hypot(dx, dy)])

    d, C = relative_separation(mean, P, THIRD, ROBOT)
    kernel = getattr(reading_covariance, "py_func", reading_covariance)
    bb, br, rr = kernel(P, THIRD, reading_slopes(*d))
    S = propagated(read, mean, P)
    np.testing.assert_allclose([[bb, br], [br, rr]], S, rtol=1e-6, atol=1e-9)
    largest = np.linalg.eigvalsh(C)[-1]
    assert variance_from_robot(P, THIRD, *d) == pytest.approx(largest)
