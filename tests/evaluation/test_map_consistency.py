"""Tests of the final map: which maps are accepted, and which are rejected."""

import numpy as np
import pytest

from slamgym.evaluation.map_consistency import map_test

HONEST = np.random.default_rng(4).standard_normal((100, 20, 2))


def test_an_honest_map_is_shown_to_be_consistent():
    assert map_test(HONEST).shown


@pytest.mark.parametrize("factor", [0.3, 3.0])
def test_one_landmark_of_twenty_with_a_wrong_covariance_is_rejected(factor):
    errors = HONEST.copy()
    errors[:, 7] *= factor
    found = map_test(errors)
    assert not found.accepted
    assert found.landmarks[found.landmark_p_values.argmin()] == 7


def test_a_mean_error_that_is_hidden_in_the_squares_is_rejected():
    errors = HONEST.copy()
    errors[:, 3, 0] += 0.8
    found = map_test(errors)
    assert not found.accepted
    assert found.mean_p_values.min() < found.p_values.min()


def test_wrong_covariances_between_landmarks_are_rejected_by_the_whole_map():
    nees, freedom = 2 * (HONEST**2).sum(axis=(1, 2)), np.full(100, 40)
    assert not map_test(HONEST, nees, freedom).accepted


def test_a_matrix_with_a_negative_eigenvalue_is_rejected():
    nees, freedom = (HONEST**2).sum(axis=(1, 2)), np.full(100, 40)
    nees[5] = np.inf
    found = map_test(HONEST, nees, freedom)
    assert not found.accepted
    assert (found.indefinite, found.all_runs) == (1, 100)


def test_a_map_without_nees_is_not_shown_to_be_consistent():
    errors = HONEST.copy()
    errors[0, 0] = np.inf
    found = map_test(errors)
    assert found.accepted
    assert not found.shown
