"""NEES of positions, landmarks, whole states and relative maps."""

import numpy as np
import pytest
from scipy.linalg import logm

from slamgym.evaluation.hypothesis_tests import autocorrelation
from slamgym.evaluation.nees import (
    heading_nees,
    in_frame,
    is_indefinite,
    landmark_nees,
    nees_of_poses,
    normalised_squared_error,
    parts_of_landmarks,
    pose_nees,
    position_nees,
    relative_map_nees,
    relative_state,
    state_nees,
    whitened,
)

RUNS = 20_000
MEAN = np.array([3.0, -2.0, 0.7, 5.0, 1.0, -4.0, 6.0])


@pytest.fixture(scope="module")
def small_errors():
    """Draw true states around the mean, with a full covariance, small enough."""
    rng = np.random.default_rng(0)
    root = 1e-4 * rng.standard_normal((7, 7))
    truth = MEAN + rng.standard_normal((RUNS, 7)) @ root.T
    return truth, np.tile(MEAN, (RUNS, 1)), np.tile(root @ root.T, (RUNS, 1, 1))


def expect_chi_square(nees, dof):
    assert nees.mean() == pytest.approx(dof, abs=4 * np.sqrt(2 * dof / RUNS))
    assert nees.var() == pytest.approx(2 * dof, rel=0.15)


@pytest.mark.parametrize("frame", ["additive", "invariant"])
@pytest.mark.parametrize("far", [(1e3, -1e3), (451234.5, 4412345.25), (1e9, -1e9)])
def test_nees_does_not_depend_on_the_origin_of_the_world(small_errors, far, frame):
    truth, means, covariances = (1e2 * array[:50] for array in small_errors)
    covariances = 1e2 * covariances
    shift = np.array([*far, 0, *far, *far])
    least = np.sqrt(np.linalg.eigvalsh(covariances)[:, 0])  # what an error counts in
    rounding = 10 * np.spacing(max(np.abs(far))) / least
    for nees in (pose_nees, position_nees, state_nees, landmark_nees):
        there = truth + shift, means + shift
        near = nees(there[0] - shift, there[1] - shift, covariances, frame=frame)
        found = nees(*there, covariances, frame=frame)
        slack = (rounding if near.ndim == 1 else rounding[:, None]) * np.sqrt(near)
        assert (np.abs(found - near) <= slack + 1e-9 * near).all()


def test_poses_far_from_the_origin_with_a_thin_covariance_keep_their_nees():
    rng = np.random.default_rng(3)
    P = np.diag([0.001, 0.001, 0.05]) ** 2
    poses = np.zeros((2000, 3))
    poses[:, 0] = np.linspace(0, 2000, len(poses))
    truth = poses + rng.standard_normal(poses.shape) * [0.001, 0.001, 0.05]
    nees = pose_nees(truth, poses, np.tile(P, (2000, 1, 1)), frame="invariant")
    expect_chi_square(np.tile(nees, RUNS // len(nees)), 3)


def large_errors(axes=(2, 3)):
    """Return true states, estimates and full covariances with errors of any size."""
    rng = np.random.default_rng(11)
    means, roots = rng.normal(0, 3, (*axes, 7)), rng.normal(0, 0.3, (*axes, 7, 7))
    return means + rng.normal(0, 0.6, means.shape), means, roots @ roots.mT


def error_and_slope(truth, mean, frame):
    """Return e, or ξ about the estimated position by a matrix logarithm, and ∂ξ/∂e."""
    D, error = np.eye(7), truth - mean
    error[2] = np.remainder(error[2] + np.pi, 2 * np.pi) - np.pi
    if frame == "additive":
        return error, D
    group = np.tile(np.eye(5), (2, 1, 1))
    shift = mean[[0, 1, 0, 0, 1, 0, 1]] * (1, 1, 0, 1, 1, 1, 1)
    truth, mean = truth - shift, mean - shift
    for matrix, state in zip(group, (truth, mean), strict=True):
        c, s = np.cos(state[2]), np.sin(state[2])
        matrix[:2, :2] = [[c, -s], [s, c]]
        matrix[:2, 2:] = np.delete(state, 2).reshape(3, 2).T
    log = logm(group[0] @ np.linalg.inv(group[1])).real
    x, y = np.delete(mean, 2).reshape(3, 2).T
    D[[0, 3, 5], 2], D[[1, 4, 6], 2] = y, -x
    return np.insert(log[:2, 2:].T.ravel(), 2, log[1, 0]), D


@pytest.mark.parametrize("frame", ["additive", "invariant"])
def test_nees_of_large_errors_is_that_of_the_definition_of_their_frame(frame):
    truth, means, P = large_errors()
    pose = truth[..., :3], means[..., :3], P[..., :3, :3]
    found = [
        *(pose_nees(*pose, frame=frame), position_nees(*pose, frame=frame)),
        *(heading_nees(*pose), state_nees(truth, means, P, frame=frame)),
        *np.moveaxis(landmark_nees(truth, means, P, frame=frame), -1, 0),
    ]
    parts = [0, 1, 2], [0, 1], [2], range(7), [3, 4], [5, 6]
    for at in np.ndindex(2, 3):
        e, D = error_and_slope(truth[at], means[at], frame)
        for nees, rows in zip(found, parts, strict=True):
            block = (D @ P[at] @ D.T)[np.ix_(rows, rows)]
            expected = e[rows] @ np.linalg.solve(block, e[rows])
            assert nees[at] == pytest.approx(expected, rel=1e-7)
    errors, _ = in_frame(truth, means, P, "additive")
    assert errors[at] == pytest.approx(
        error_and_slope(truth[at], means[at], "additive")[0]
    )


def test_autocorrelation_of_a_moving_sum_and_across_gaps():
    noise = np.random.default_rng(1).standard_normal((50, 1001))
    series = 3.0 + noise[:, 1:] + noise[:, :-1]
    series[:, 500:700] = np.nan
    correlations, pairs = autocorrelation(series, lags=2)
    np.testing.assert_allclose(correlations, [0.5, 0.0], atol=0.02)
    np.testing.assert_array_equal(pairs, [50 * 798, 50 * 796])


@pytest.mark.parametrize("size", [3, 7])
@pytest.mark.parametrize("scale", [1e-9, 1.0, 1e10])
def test_the_error_is_normalised_over_all_leading_axes_and_at_any_scale(size, scale):
    rng = np.random.default_rng(1)
    root = rng.standard_normal((2, 5, size, size))
    covariances = root @ root.mT + np.eye(size)
    errors = rng.standard_normal((2, 5, size))
    solved = np.linalg.solve(covariances, errors[..., None])[..., 0]
    found = normalised_squared_error(scale * errors, scale**2 * covariances)
    np.testing.assert_allclose(found, (errors * solved).sum(axis=-1), rtol=1e-9)


@pytest.mark.parametrize("size", [3, 5])
def test_lower_halves_of_covariances_of_any_type_and_shape_count(size):
    P, e = 4 * np.eye(size), np.ones(size)
    P[0, 1] = P[1, 0] = 1
    expected = e @ np.linalg.solve(P, e)
    for kind in (float, np.float32, int):
        found = normalised_squared_error(e.astype(kind), P.astype(kind))
        assert found == pytest.approx(expected)
    upper, lower = P + np.triu(P + 9, 1), P.copy()
    lower[2, 1] = np.nan
    assert normalised_squared_error(e, upper) == pytest.approx(expected)
    assert np.isnan(whitened(e, lower)).tolist() == [False] * 2 + [True] * (size - 2)
    several = normalised_squared_error(e, np.stack([P, 2 * P]))
    np.testing.assert_allclose(several, [expected, expected / 2])
    assert normalised_squared_error(e[None][:0], P[None][:0]).shape == (0,)


def test_one_map_may_have_many_truths():
    rng = np.random.default_rng(2)
    mean, P, truths = MEAN, np.eye(7) + 0.1, rng.normal(MEAN, 0.1, (4, 7))
    found = relative_map_nees(truths, mean, P)
    each = [float(relative_map_nees(truth, mean, P)) for truth in truths]
    np.testing.assert_allclose(found, each)


@pytest.mark.parametrize("size", [3, 12])
def test_a_covariance_singular_within_rounding_has_no_nees(size):
    covariance = np.tile(np.eye(size), (3, 1, 1))
    covariance[1:, 0, 1] = covariance[1:, 1, 0] = 1 - 0.4e-10, 1 - 0.6e-10
    nees = normalised_squared_error(np.ones((3, size)), covariance)
    assert nees[0] == pytest.approx(size)
    assert np.isnan(nees).tolist() == [False, True, False]
    covariance[2, 1] = np.nan
    assert np.isnan(normalised_squared_error(np.ones((3, size)), covariance)[2])


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("frame", ["additive", "invariant"])
def test_a_variance_of_one_axis_that_is_rounding_gives_no_nees(axis, frame):
    covariances = np.tile(np.diag([1e-4] * 5), (4, 1, 1))
    covariances[:, axis, axis] = 0.0, 0.9e-18, 1.1e-18, 1e-4
    covariances[:, 2:4, 2:4], covariances[3, 2] = [[1e-4, 5e-5], [5e-5, 1e-4]], 0.0
    states, before = np.tile([0.0, 0.0, 0.0, 3.0, 1.0], (4, 1)), covariances.copy()
    given = states + 0.01, states, covariances
    nees, of_map = (each(*given, frame=frame) for each in (state_nees, landmark_nees))
    np.testing.assert_allclose(of_map[:2], of_map[[2, 2]])  # the heading stays
    np.testing.assert_array_equal(np.isfinite(nees), [False, False, True, False])
    np.testing.assert_array_equal(covariances, before)
    with np.errstate(all="ignore"):
        P, errors = np.moveaxis(covariances[:, :3, :3], 0, -1), np.full((3, 4), 0.01)
        position, pose = next(nees_of_poses(P, errors))
    expected = [False, False, True, True], [False, False, True, False]
    np.testing.assert_array_equal(np.isfinite([position, pose]), expected)


def test_the_map_has_a_nees_where_the_pose_is_certain_and_the_state_has_none():
    rng = np.random.default_rng(6)
    means, root = rng.normal(0, 3, (2, 7)), rng.normal(0, 0.1, (2, 7, 7))
    root[:, :3], truth = 0.0, means + rng.normal(0, 0.1, (2, 7))
    state = relative_state(truth, means, root @ root.mT)
    squares = whitened(state.errors, state.covariance) ** 2
    expected = relative_map_nees(truth, means, root @ root.mT)
    np.testing.assert_allclose(squares[0, :, :4].sum(axis=-1), expected, rtol=1e-9)
    assert np.isnan(squares[:, :, 4:]).all()


def test_a_position_certain_in_a_slanted_direction_has_no_nees():
    """A certain y in the frame of a slightly wrong heading, rounded by a solver."""
    rng = np.random.default_rng(4)
    basis = np.zeros((2000, 3, 2))
    basis[:, 0, 0] = basis[:, 2, 1] = 0.01
    basis[:, 1] = 0.01 * 10.0 ** rng.uniform(-8, 0, (2000, 2))
    covariances = basis @ basis.mT * (1 + 1e-16 * rng.standard_normal((2000, 3, 3)))
    poses = np.zeros((2000, 3))
    assert np.isnan(pose_nees(poses + 0.01, poses, covariances, frame="additive")).all()


@pytest.mark.parametrize(
    "function", [pose_nees, position_nees, state_nees, landmark_nees]
)
def test_an_unknown_frame_is_not_taken_for_the_additive_one(function):
    states, P = np.zeros((2, 5)), np.tile(np.eye(5), (2, 1, 1))
    if function in (pose_nees, position_nees):
        states, P = states[:, :3], P[:, :3, :3]
    with pytest.raises(ValueError, match="frame must be 'additive' or 'invariant'"):
        function(states, states, P, frame="right")


def test_heading_nees_is_the_square_of_the_wrapped_error_by_its_variance():
    truth, pose = np.array([0.0, 0.0, 3.1]), np.array([0.0, 0.0, -3.1])
    found = heading_nees(truth, pose, np.diag([1.0, 1.0, 0.04]))
    assert found == pytest.approx((2 * np.pi - 6.2) ** 2 / 0.04)


def test_a_singular_covariance_is_not_indefinite_by_rounding():
    rows = np.random.default_rng(8).standard_normal((40, 3))
    for scale in (1e-6, 1.0, 1e6):
        P = scale * rows @ rows.T
        assert not is_indefinite(P)
        assert is_indefinite(P - 1e-3 * scale * np.eye(40))
    for far, is_rounding in ((3.2e-5, True), (6e-5, False)):  # its square to 2e-9
        assert is_indefinite(np.array([[0.0, far], [far, 1.0]])) != is_rounding
    assert not is_indefinite(np.where(np.eye(3, k=1), np.nan, -np.eye(3)))


def test_deviations_of_landmarks_are_whitened_in_the_axes_of_the_map():
    truth, means, P = large_errors()
    state = relative_state(truth, means, P)
    found = whitened(state.landmarks[0], state.landmark_covariances[0])
    nees = relative_map_nees(truth, means, P)
    errors, blocks = parts_of_landmarks(truth - means, P)

    def seen(state):
        gaps = (state[3:].reshape(2, 2) - state[:2]) @ [1, 1j] * np.exp(-1j * state[2])
        return gaps.view(float)

    for b in np.ndindex(2, 3):
        slopes = [
            (seen(means[b] + h) - seen(means[b] - h)) / 2e-6 for h in 1e-6 * np.eye(7)
        ]
        J, c, s = np.transpose(slopes), *np.exp(1j * means[b][2]).view((float, 2))
        R, error = np.array([[c, -s], [s, c]]), seen(truth[b]) - seen(means[b])
        expected = error @ np.linalg.solve(J @ P[b] @ J.T, error)
        assert nees[b] == pytest.approx(expected, rel=1e-5)
        for k, rows in enumerate((slice(0, 2), slice(2, 4))):
            own = slice(3 + 2 * k, 5 + 2 * k)
            np.testing.assert_array_equal(errors[b][k], (truth - means)[b][own])
            np.testing.assert_array_equal(blocks[b][k], P[b][own, own])
            L = np.linalg.cholesky(R @ J[rows] @ P[b] @ J[rows].T @ R.T)
            expected = np.linalg.solve(L, R @ error[rows])
            np.testing.assert_allclose(found[b][k], expected, rtol=1e-5)
