import math
from itertools import product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from slamgym.estimator.models.rigid_motion import rotation
from slamgym.evaluation.trajectory_error import (
    Alignment,
    align_positions,
    aligned_rms,
    ellipse_areas,
    exchanged_positions,
    landmark_covariances,
    landmark_distances,
    poses_at,
    position_accuracy,
)

POSITIONS = np.array([[0.0, 0.0], [4.0, 1.0], [5.0, -3.0], [-2.0, 6.0]])


def kabsch(estimate, truth):
    """Rotation and translation by singular values, as in Umeyama (1991), scale 1."""
    e_mean, g_mean = estimate.mean(axis=0), truth.mean(axis=0)
    left, _, right = np.linalg.svd((truth - g_mean).T @ (estimate - e_mean))
    sign = np.diag([1.0, np.linalg.det(left @ right)])
    turn = left @ sign @ right
    return turn, g_mean - turn @ e_mean


@given(angle=st.floats(-3.1, 3.1), x=st.floats(-1e3, 1e3), y=st.floats(-1e3, 1e3))
def test_a_rigid_motion_is_found_again(angle, x, y):
    truth = Alignment(angle, np.array([x, y])).apply(POSITIONS)
    found = align_positions(POSITIONS, truth)
    assert found.angle == pytest.approx(angle, abs=1e-9)
    np.testing.assert_allclose(found.translation, [x, y], atol=1e-8)
    for far in ((451234.7, 0.0), (0.0, 451234.7)):  # of the estimate, of the truth
        there = align_positions(POSITIONS + far[0], truth + far[1])
        gap = math.remainder(there.angle - angle, math.tau)
        assert gap == pytest.approx(0, abs=3e-10)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("noise", [0.1, 30.0])
def test_alignment_equals_that_by_singular_values(seed, noise):
    rng = np.random.default_rng(seed)
    estimate = rng.normal(size=(6, 2)) * 5 + 3
    truth = rng.normal(size=(6, 2)) * noise - estimate[:, ::-1]
    rotation, translation = kabsch(estimate, truth)
    found = align_positions(estimate, truth)
    np.testing.assert_allclose(found.translation, translation, atol=1e-9)
    np.testing.assert_allclose(
        found.apply(estimate), estimate @ rotation.T + translation, atol=1e-9
    )


def test_rmse_is_the_root_of_the_mean_square():
    accuracy = position_accuracy([[0, 0], [1, 0]], [[3, 4], [1, 0]])
    np.testing.assert_array_equal(accuracy.raw_errors, [5, 0])
    assert accuracy.raw_rmse == pytest.approx(math.sqrt(12.5))
    np.testing.assert_allclose(
        accuracy.aligned_rmse, math.sqrt(np.mean(accuracy.aligned_errors**2))
    )


def test_one_position_is_aligned_without_turning():
    accuracy = position_accuracy([[1, 2]], [[4, 6]])
    assert accuracy.raw_rmse == 5
    assert accuracy.alignment.angle == 0
    assert accuracy.aligned_rmse == 0


def test_mahalanobis_distance_counts_standard_deviations():
    rng = np.random.default_rng(0)
    estimate, truth = rng.normal(size=(2, 5, 2))
    factors = rng.normal(size=(5, 2, 2))
    P = factors @ factors.transpose(0, 2, 1) + 0.1 * np.eye(2)
    found = landmark_distances(estimate, P, truth)
    for e, block, *lengths in zip(estimate - truth, P, *found, strict=True):
        assert lengths == pytest.approx(
            [math.hypot(*e), math.sqrt(e @ np.linalg.solve(block, e))]
        )


@pytest.mark.parametrize(
    ("estimate", "covariances", "message"),
    [
        ([[1, 2]], [np.zeros((2, 2))], "covariances must be positive definite"),
        ([[1, 2]], [np.diag([1, -1])], "covariances must be positive definite"),
        ([[1, 2]], [np.ones((2, 2))], "covariances must be positive definite"),
        (np.zeros((2, 2)), np.eye(2), r"covariances must have shape \(2, 2, 2\)"),
        ([[math.inf, 0]], [np.eye(2)], "landmarks must be finite"),
    ],
)
def test_landmarks_and_covariances_that_cannot_be_are_refused(
    estimate, covariances, message
):
    with pytest.raises(ValueError, match=message):
        landmark_distances(estimate, covariances, np.zeros(np.shape(estimate)))


def test_landmark_covariances_are_the_blocks_behind_the_pose():
    covariance = np.arange(49.0).reshape(7, 7)
    np.testing.assert_array_equal(
        landmark_covariances(covariance), [covariance[3:5, 3:5], covariance[5:7, 5:7]]
    )
    assert landmark_covariances(np.eye(3)).shape == (0, 2, 2)


@pytest.mark.parametrize("shape", [(4, 4), (5, 7), (2, 2), (5,), (1, 1), ()])
def test_joint_covariance_of_the_wrong_shape_is_refused(shape):
    with pytest.raises(ValueError, match=r"covariance must have shape \(3 \+ 2n"):
        landmark_covariances(np.zeros(shape))


def test_truth_is_interpolated_between_its_rows():
    path = [[0, 0, 10, 0.1], [2, 4, 20, 0.5], [3, 4, 20, 0.5]]
    np.testing.assert_allclose(poses_at([1, 2.5], path), [[2, 15, 0.3], [4, 20, 0.5]])


def test_heading_takes_the_shorter_way_across_pi():
    poses = poses_at([0.25, 0.75], [[0, 0, 0, 3.0], [1, 0, 0, -3.0]])
    turned = 2 * math.pi - 6
    np.testing.assert_allclose(
        poses[:, 2], [3 + turned / 4, -3 - turned / 4], atol=1e-12
    )


def test_outside_its_time_the_truth_is_unknown():
    poses = poses_at([-0.1, 0, 1, 1.1], [[0, 0, 0, 0], [1, 0, 0, 0]])
    np.testing.assert_array_equal(
        np.isnan(poses).all(axis=1), [True, False, False, True]
    )
    assert np.isnan(poses_at([0.0], np.empty((0, 4)))).all()


def test_unknown_headings_stay_unknown_and_spoil_no_others():
    rows = [[0, 0, 0, 3.0], [1, 1, 0, math.nan], [2, 2, 0, -3.0], [3, 3, 0, -3.0]]
    path = np.array(rows)
    poses = poses_at([0.5, 2.5], path)
    np.testing.assert_array_equal(path, rows)
    np.testing.assert_allclose(poses[:, 0], [0.5, 2.5])
    assert np.isnan(poses[0, 2])
    assert poses[1, 2] == pytest.approx(-3.0)


@pytest.mark.parametrize(
    ("estimate", "truth", "message"),
    [
        ([[1, 2, 3]], [[1, 2]],
         r"estimate must have shape \(n, 2\), n >= 1, got \(1, 3\)"),
        (np.empty((0, 2)), np.empty((0, 2)), "estimate must have shape"),
        ([[1, 2]], [[1, math.nan]], "truth must be finite"),
        ([[1, 2]], [[1, 2], [3, 4]], "equally many positions, got 1 and 2"),
        ([["a", "b"]], [[1, 2]], "estimate must be numbers"),
    ],
)  # fmt: skip
def test_positions_that_do_not_fit_are_refused(estimate, truth, message):
    with pytest.raises(ValueError, match=message):
        position_accuracy(estimate, truth)


@pytest.mark.parametrize("path", [[0.0, 1.0, 2.0, 3.0], [[0.0, 1.0, 2.0]]])
def test_a_true_path_must_have_a_time_and_a_pose_in_each_row(path):
    with pytest.raises(ValueError, match=r"ground_truth must have shape \(n, 4\), got"):
        poses_at([0.5], path)


def test_an_ellipse_of_three_deviations_has_the_area_of_its_axes():
    assert ellipse_areas(np.diag([4.0, 9.0])[None])[0] == pytest.approx(54 * math.pi)


def test_positions_at_rest_determine_no_rotation():
    rng = np.random.default_rng(0)
    path = rng.normal(0, 0.02, (30, 2))
    for place, other in product(([0.1, -0.2], [0.25, -4412345.25]), repeat=2):
        rounding = rng.integers(-1, 2, (30, 2)) * np.spacing(np.abs(place))
        still, moving = place + rounding, path + other
        assert align_positions(moving, still).angle == 0
        assert align_positions(still, moving).angle == 0


def a_map(size, seed):
    """Return true positions and estimates in another frame."""
    rng = np.random.default_rng(seed)
    truth = rng.uniform(0, 12, size=(size, 2))
    moved = Alignment(2.0, np.array([300.0, -70.0])).apply(truth)
    return moved + rng.normal(size=truth.shape) * 0.05, truth


@pytest.mark.parametrize(("size", "cycle"), [(5, (0, 3)), (9, (1, 4, 6)), (99, (2, 8))])
def test_exchanged_positions_are_found_with_the_alignment_of_the_right_ones(
    size, cycle
):
    estimate, truth = a_map(size, seed=3)
    wrong = truth.copy()
    wrong[list(np.roll(cycle, -1))] = truth[list(cycle)]
    found = exchanged_positions(estimate, wrong)
    assert found.cycles == (cycle,)
    error = np.linalg.norm(found.alignment.apply(estimate) - truth, axis=1)
    assert error.max() < 0.2


@pytest.mark.parametrize("neighbour", [4, 5])
@pytest.mark.parametrize(("gap", "is_named"), [(0.02, False), (1.0, True)])
def test_an_exchange_is_named_whole_or_not_at_all(neighbour, gap, is_named):
    """Two truths closer than the noise leave open which of them is exchanged."""
    cycle, named = (1, 4, 6), []
    for seed in range(20):
        estimate, truth = a_map(12, seed)
        place = truth[1] + (gap, 0.0)
        estimate[neighbour] += rotation(2.0) @ (place - truth[neighbour])
        truth[neighbour] = place
        wrong = truth.copy()
        wrong[list(np.roll(cycle, -1))] = truth[list(cycle)]
        found = exchanged_positions(estimate, wrong).cycles
        assert found in ((), (cycle,))
        named.append(bool(found))
    assert np.mean(named) > 0.8 if is_named else not any(named)


@pytest.mark.parametrize("size", [1, 2, 4, 5, 30])
def test_right_positions_are_not_exchanged(size):
    for seed in range(20):
        estimate, truth = a_map(size, seed)
        found = exchanged_positions(estimate, truth)
        assert found.cycles == ()
        assert found.alignment.angle == align_positions(estimate, truth).angle


def test_an_exchange_is_named_if_it_is_far_beyond_the_scatter_of_the_others():
    named = set()
    for off in np.linspace(0.5, 6.0, 150):  # of one other position
        estimate, truth = a_map(9, seed=8)
        estimate += 0.02 * np.random.default_rng(0).normal(size=truth.shape)
        estimate[3] += (off, 0.0)
        wrong = truth.copy()
        wrong[[1, 4]] = truth[[4, 1]]
        moved = align_positions(estimate, truth).apply(estimate)
        own, other = (np.linalg.norm(moved - g, axis=1)[[1, 4]] for g in (wrong, truth))
        scale = math.sqrt(np.sum((moved - truth) ** 2) / (2 * 9 - 3))
        is_far = (own > 10 * scale).all() and (own > 5 * other).all()
        found = exchanged_positions(estimate, wrong).cycles
        assert found == (((1, 4),) if is_far else ())
        named.add(is_far)
    assert named == {True, False}


@pytest.mark.parametrize("at", [0, 3])
def test_positions_at_one_place_do_not_disturb_an_exchange(at):
    estimate, truth = a_map(9, seed=3)
    truth[[1, 4]] = truth[[4, 1]]
    for same, near in ((estimate, truth), (truth, estimate)):
        same[[at, 6]], near[[at, 6]] = same[7], near[7] + 0.04 * np.eye(2)
        assert exchanged_positions(estimate, truth).cycles == ((1, 4),)


def test_no_exchange_is_found_in_a_map_whose_others_are_wrong():
    estimate, truth = a_map(8, seed=4)
    truth[[0, 5]] = truth[[5, 0]]
    estimate[[1, 2, 3]] += [(7.0, 1.0), (-3.0, 6.0), (2.0, -9.0)]
    assert exchanged_positions(estimate, truth).cycles == ()


def test_a_landmark_far_from_its_truth_is_no_exchange():
    estimate, truth = a_map(8, seed=5)
    estimate[2] += (6.0, 3.0)
    assert exchanged_positions(estimate, truth).cycles == ()


def test_a_few_others_that_are_far_off_leave_an_exchange_in_doubt():
    estimate, truth = a_map(40, seed=6)
    truth[[0, 5]] = truth[[5, 0]]
    assert exchanged_positions(estimate, truth).cycles == ((0, 5),)
    estimate[[1, 2, 3]] += [(9.0, 1.0), (-3.0, 9.0), (-6.0, -9.0)]
    assert exchanged_positions(estimate, truth).cycles == ()


@pytest.mark.parametrize(("scale", "noise"), [(1, 1e-4), (1, 0.1), (-1, 0.1), (0, 3)])
def test_many_maps_at_once_have_the_aligned_error_of_each(scale, noise):
    truth, errors = np.random.default_rng(3).standard_normal((2, 4, 6, 2))
    estimates = Alignment(0.2, np.array([30.0, 0.0])).apply(scale * truth)
    estimates += noise * errors
    pair = (np.moveaxis(each, -1, 0) for each in (truth, estimates - truth))
    for found, e, g in zip(aligned_rms(*pair), estimates, truth, strict=True):
        one = position_accuracy(e, g)
        apart = np.linalg.norm(one.alignment.apply(e) - g, axis=1)
        np.testing.assert_array_equal(one.aligned_errors, apart)
        assert found == pytest.approx(one.aligned_rmse, rel=1e-9)
    assert aligned_rms(np.zeros((2, 1)), np.ones((2, 1))) == 0  # without a warning
