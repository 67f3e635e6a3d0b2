import numpy as np
import pytest
from numeric_jacobian import numeric_jacobian
from scipy.linalg import logm

from slamgym.estimator import Belief
from slamgym.estimator.models.rigid_motion import (
    additive_error,
    compose,
    composed,
    invariant_covariance,
    invariant_error,
    seen_from,
)
from slamgym.evaluation.hypothesis_tests import average_band
from slamgym.evaluation.nees import normalised_squared_error

MEAN = np.array([1.0, -2.0, 0.7, 3.0, 4.0, -5.0, 2.0])
TRUTH = np.array([1.3, -1.5, 1.2, 2.0, 4.5, -5.5, 1.0])


def group(state):
    """The matrix of SE_{1+n}(2)."""
    n = (len(state) - 3) // 2
    X = np.eye(3 + n)
    c, s = np.cos(state[2]), np.sin(state[2])
    X[:2, :2] = [[c, -s], [s, c]]
    X[:2, 2] = state[:2]
    X[:2, 3:] = state[3:].reshape(-1, 2).T
    return X


def test_invariant_error_is_the_matrix_logarithm():
    log = np.real(logm(group(TRUTH) @ np.linalg.inv(group(MEAN))))
    expected = np.concatenate([log[:2, 2], [log[1, 0]], log[:2, 3:].T.ravel()])
    np.testing.assert_allclose(invariant_error(TRUTH, MEAN), expected, atol=1e-12)


def test_invariant_covariance_is_the_additive_one_to_first_order():
    rng = np.random.default_rng(0)
    root = rng.standard_normal((7, 7))
    P = root @ root.T
    D = numeric_jacobian(lambda truth: invariant_error(truth, MEAN), MEAN)
    np.testing.assert_allclose(invariant_covariance(MEAN, P), D @ P @ D.T, atol=1e-6)


def test_invariant_error_of_no_turn_is_the_difference():
    shifted = MEAN + np.array([1, 2, 0, 1, 2, 1, 2])
    np.testing.assert_allclose(
        invariant_error(shifted, MEAN), [1, 2, 0, 1, 2, 1, 2], atol=1e-15
    )


def test_additive_error_wraps_the_heading():
    far = MEAN.copy()
    far[2] += 2 * np.pi + 0.1
    np.testing.assert_allclose(additive_error(far, MEAN)[2], 0.1, atol=1e-12)


def test_errors_work_over_leading_axes():
    stack = np.stack([TRUTH, MEAN])
    np.testing.assert_array_equal(
        invariant_error(stack, MEAN)[0], invariant_error(TRUTH, MEAN)
    )
    P = np.stack([np.eye(7), 2 * np.eye(7)])
    means = np.stack([MEAN, TRUTH])
    np.testing.assert_array_equal(
        invariant_covariance(means, P)[1], invariant_covariance(TRUTH, P[1])
    )


@pytest.mark.parametrize("frame", ["additive", "invariant"])
def test_a_belief_gives_its_error_and_the_covariance_of_it(frame):
    P = np.diag(np.arange(1.0, 8.0))
    belief = Belief(MEAN, P, (4, 9), frame)
    error = belief.error(TRUTH[:3], TRUTH[3:].reshape(2, 2))
    by_hand = {"additive": additive_error, "invariant": invariant_error}[frame]
    truth, mean = (seen_from(MEAN[:2], state) for state in (TRUTH, MEAN))
    np.testing.assert_allclose(error, by_hand(truth, mean), atol=1e-15)
    expected = P if frame == "additive" else invariant_covariance(mean, P)
    np.testing.assert_array_equal(belief.error_covariance(), expected)
    other = belief.error(TRUTH[:3], TRUTH[3:], frame="additive")
    np.testing.assert_allclose(other, additive_error(TRUTH, MEAN))


def test_the_invariant_error_about_another_origin_is_that_of_the_adjoint():
    P, origin = np.diag(np.arange(1.0, 8.0)), np.array([7.0, -3.0])
    adjoint = np.eye(7)
    adjoint[[0, 1, 3, 4, 5, 6], 2] = np.tile([3.0, 7.0], 3)  # J o
    truth, mean = (seen_from(origin, state) for state in (TRUTH, MEAN))
    np.testing.assert_allclose(
        invariant_error(truth, mean), adjoint @ invariant_error(TRUTH, MEAN), atol=1e-12
    )
    np.testing.assert_allclose(
        invariant_covariance(mean, P),
        adjoint @ invariant_covariance(MEAN, P) @ adjoint.T,
        atol=1e-12,
    )


@pytest.mark.parametrize("kind", [list, np.array, dict.fromkeys, tuple])
def test_a_belief_keeps_ids_of_any_kind_as_a_tuple_and_a_column_as_a_row(kind):
    belief = Belief(np.arange(7.0)[:, None], np.eye(7), kind([9, 4]))
    assert belief.landmark_ids == (9, 4)
    assert {type(i) for i in belief.landmark_ids} == {int}
    assert belief.landmarks.tolist() == [[3, 4], [5, 6]]


def test_a_belief_refuses_what_does_not_fit():
    belief = Belief(np.zeros(5), np.eye(5), (3,))
    with pytest.raises(ValueError, match="the truth must be a pose"):
        belief.error(np.zeros(3), np.zeros((2, 2)))
    with pytest.raises(ValueError, match="frame must be 'additive' or 'invariant'"):
        belief.error(np.zeros(3), np.zeros(2), frame="local")
    with pytest.raises(ValueError, match=r"frame must be .*, got 'rubbish'"):
        Belief(np.zeros(3), np.eye(3), (), frame="rubbish")
    with pytest.raises(ValueError, match="a belief with 1 landmarks has mean"):
        Belief(np.zeros(4), np.eye(4), (3,))
    with pytest.raises(ValueError, match=r"landmark_ids must differ, got \(7, 7\)"):
        Belief(np.zeros(7), np.eye(7), (7, 7))
    for part in (belief.mean, belief.covariance):
        with pytest.raises(ValueError, match="read-only"):
            part[0] = 1.0


def test_a_belief_is_a_copy_of_its_arguments():
    mean, covariance, ids = np.array([0.0, 0.0, 4.0, 5.0, 6.0]), np.eye(5), [3]
    belief = Belief(mean, covariance, ids)
    assert belief.pose[2] == 4.0 - 2 * np.pi
    mean[:], covariance[:], ids[:] = 7.0, 7.0, [7]
    np.testing.assert_array_equal(belief.landmarks, [[5.0, 6.0]])
    np.testing.assert_array_equal(belief.covariance, np.eye(5))
    assert belief.landmark_ids == (3,)


def test_a_belief_of_a_diverged_filter_may_be_nan():
    belief = Belief([np.nan, 0.0, np.inf], np.full((3, 3), np.nan), ())
    error = belief.error(np.zeros(3), np.zeros((0, 2)), frame="additive")
    np.testing.assert_array_equal(error, [np.nan, 0.0, np.nan])


def test_squared_error_of_a_singular_or_broken_covariance_is_nan():
    covariances = np.stack([np.eye(2), np.zeros((2, 2)), np.full((2, 2), np.nan)])
    found = normalised_squared_error(np.ones((3, 2)), covariances)
    np.testing.assert_array_equal(found, [2.0, np.nan, np.nan])


def test_band_holds_the_average_as_often_as_it_says():
    rng = np.random.default_rng(1)
    averages = rng.chisquare(3, (20000, 50)).mean(axis=1)
    low, high = average_band(50, 3)
    assert ((averages > low) & (averages < high)).mean() == pytest.approx(
        0.95, abs=0.01
    )


def test_composed_entries_are_those_of_compose():
    start, pose = np.array([1.5, -2.0, 0.7]), np.array([0.4, -0.9, 2.1])
    *entries, cos, sin = composed(*start, *pose)
    expected = (group(start) @ group(pose))[:2, 2]
    assert entries == pytest.approx([*expected, 2.8])
    assert compose(start, pose)[0] == pytest.approx(entries)
    assert (cos, sin) == pytest.approx((np.cos(0.7), np.sin(0.7)))
