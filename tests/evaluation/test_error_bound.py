"""The bound on the errors of any filter: against Kalman's covariance, and dense."""

import tracemalloc

import numpy as np
import pytest

from slamgym.estimator.kernels.batch import about_centre
from slamgym.estimator.models.motions import predict_pose
from slamgym.estimator.models.rigid_motion import rotation
from slamgym.estimator.models.sensors import BEARING_RANGE, POSITION
from slamgym.evaluation.error_bound import (
    efficiency,
    map_error_squared,
    posterior_bound,
)

NOISE = {
    "motion_std": (0.1, 0.05, 0.03),
    "measurement_std": (0.02, 0.1),
    "sensor": BEARING_RANGE.with_noise(
        range_std_per_metre=0.01, bearing_std_metres=0.05
    ),
}
START_STD = (0.1, 0.2, 0.05)
PLACES = np.array([[3.0, 2.0], [-1.0, 4.0], [2.0, -5.0], [6.0, 1.0]])


def exact_drive(steps=25):
    """Return poses (T, 3) and visibility (T, L) of a drive without noise."""
    poses = [np.array([1.0, -0.5, 0.4])]
    for _ in range(steps):
        poses.append(predict_pose(poses[-1], np.array([0.3, 0.2])).pose)
    visible = np.random.default_rng(2).random((steps + 1, len(PLACES))) < 0.6
    return np.array(poses), visible


def bound_of(poses, visible, landmarks=PLACES, **changes):
    """Return the bound of one run."""
    settings = {"dt": np.ones(len(poses)), "start_std": START_STD, **NOISE} | changes
    return posterior_bound(poses[None], landmarks[None], visible[None], **settings)


def lever(point):
    """Return −J p."""
    return np.array([point[1], -point[0]])


def corrected(P, H, R):
    """Take in a reading of H ξ."""
    return P - P @ H.T @ np.linalg.solve(H @ P @ H.T + R, H @ P)


def dense_bound(poses, visible, pose_std, sensor, motion_std, measurement_std):
    """Bound one run by the recursion of its invariant error, with dense matrices::

    motion     ξ_p += R(θ) ε_xy − J p' ε_α,    ξ_θ += ε_α,    ξ_l −= J l ε_α
    reading    G (ξ_l − ξ_p) + noise,    G = ∂z/∂(l − p)
    first one  ξ_l = ξ_p + G⁻¹ noise
    """
    D = np.eye(3)
    D[:2, 2] = lever(poses[0, :2])
    P, order, states = D @ np.diag(np.square(START_STD)) @ D.T, [], []
    for t, pose in enumerate(poses):
        if t:
            F = np.eye(len(P), 3)
            F[:2, :2] = rotation(poses[t - 1, 2])
            for row, point in enumerate([pose[:2], *PLACES[order]]):
                F[[0, 1] if row == 0 else [1 + 2 * row, 2 + 2 * row], 2] = lever(point)
            P = P + F @ np.diag(np.square(motion_std)) @ F.T
        for i in np.flatnonzero(visible[t]):
            G = sensor.predict(pose, PLACES[[i]]).jacobian_landmark[0]
            distance = np.linalg.norm(PLACES[i] - pose[:2])
            Q = np.diag(sensor.stds(measurement_std, distance) ** 2)
            if i in order:
                H, c = np.zeros((2, len(P))), 3 + 2 * order.index(i)
                H[:, :2], H[:, c : c + 2] = -G, G
                P = corrected(P, H, Q)
            else:
                order.append(i)
                A = np.vstack([np.eye(len(P)), np.eye(2, len(P))])
                P = A @ P @ A.T
                P[-2:, -2:] += np.linalg.inv(G) @ Q @ np.linalg.inv(G).T
        for axis in np.flatnonzero(np.isfinite(pose_std[t])):
            H = np.zeros((1, len(P)))
            H[0, 2] = 1.0 if axis == 2 else -lever(pose[:2])[axis]
            H[0, axis] = 1.0
            P = corrected(P, H, pose_std[t, axis] ** 2)
        D[:2, 2] = -lever(pose[:2])
        states.append(
            (P[:2, :2].trace(), P[2, 2], (D @ P[:3, :3] @ D.T)[:2, :2].trace())
        )
    at = np.argsort(order)
    columns = [0, 1, 2, *(np.array([3, 4]) + 2 * at[:, None]).ravel()]
    return np.array(states).T, P[np.ix_(columns, columns)]


@pytest.mark.parametrize("fixes", [False, True])
@pytest.mark.parametrize("sensor", [NOISE["sensor"], POSITION])
def test_the_bound_is_the_recursion_of_the_invariant_error(sensor, fixes):
    poses, visible = exact_drive()
    rng = np.random.default_rng(5)
    poses += 0.1 * rng.standard_normal(poses.shape)  # sideways too
    pose_std = np.full((len(poses), 3), np.inf)
    if fixes:
        pose_std[3::3, :2], pose_std[1::2, 2] = (0.2, 0.1), 0.05
    visible[:, 2] = False
    noise = NOISE | {"sensor": sensor}
    bound = bound_of(poses, visible, pose_std=pose_std, **noise)
    expected, covariance = dense_bound(poses, visible, pose_std, **noise)
    for found, row in zip(bound, expected, strict=False):
        np.testing.assert_allclose(found[0], row, rtol=1e-9)
    np.testing.assert_allclose(bound.covariances[0], covariance, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("far", [(1e3, -1e3), (451234.5, 4412345.25), (1e9, -1e9)])
def test_the_bound_about_a_point_near_the_path_is_that_of_the_origin(far):
    poses, visible = exact_drive()
    pose_std = np.full((len(poses), 3), np.inf)
    pose_std[3::3, :2] = 0.2
    near = bound_of(poses, visible, pose_std=pose_std)
    shifted = poses + np.array([*far, 0])
    given = {"landmarks": PLACES + far, "pose_std": pose_std, "origin": far}
    found = bound_of(shifted, visible, **given)
    rounding = np.spacing(max(np.abs(far)))  # of coordinates; ranges are about 1 m
    for array, other in zip(near[:4], found[:4], strict=True):
        np.testing.assert_allclose(other, array, rtol=20 * rounding + 1e-13)


def test_a_robot_that_stands_cannot_learn_its_heading():
    poses, visible = np.tile([2.0, 1.0, 0.3], (50, 1)), np.ones((50, 4), dtype=bool)
    bound = bound_of(poses, visible, dt=np.zeros(50), start_std=(0, 0, 0.3))
    assert bound.heading[0] == pytest.approx(0.09, rel=1e-12)


def test_runs_are_bounded_each_by_itself():
    poses, visible = exact_drive()
    others = ~visible
    others[:, 2] = False
    pose_std = np.full((3, len(poses), 3), np.inf)
    pose_std[:, 4:9] = [[[0.2, 0.1, np.inf]], [[0.2, 0.1, 0.05]], [[0.2, 0.3, np.inf]]]
    drives = poses + np.arange(3)[:, None, None], PLACES + np.arange(3)[:, None, None]
    seen = np.stack([visible, others, visible])
    given = {"start_std": START_STD, "dt": np.ones(len(poses)), **NOISE}
    together = posterior_bound(*drives, seen, pose_std=pose_std, **given)
    for b in range(3):
        drive = drives[0][b], seen[b], drives[1][b]
        alone = bound_of(*drive, pose_std=pose_std[b])
        for many, one in zip(together[:5], alone, strict=False):
            np.testing.assert_array_equal(many[b], one[0])


def test_readings_that_place_no_landmark_have_no_bound():
    poses, visible = exact_drive()
    *found, covariances, _ = bound_of(poses, visible, sensor="bearing")
    assert [each.shape for each in found] == [(1, 26)] * 3 + [(1,)]
    assert all(np.isnan(each).all() for each in found)
    assert covariances == ()


def test_landmarks_that_are_never_read_do_not_change_a_bit_and_take_no_memory():
    poses, visible = exact_drive()
    places, seen = np.zeros((1, 10_000, 2)), np.zeros((1, len(poses), 10_000), bool)
    where = [7, 30, 4000, 9999]
    places[0, where], seen[0][:, where] = PLACES, visible
    drive, noise = np.ones(len(poses)), {"start_std": START_STD, **NOISE}
    few = posterior_bound(poses[None], PLACES[None], visible[None], drive, **noise)
    tracemalloc.start()
    many = posterior_bound(poses[None], places, seen, drive, **noise)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    for array, other in zip(few[:4], many[:4], strict=True):
        assert array.tobytes() == other.tobytes()
    assert few.covariances[0].tobytes() == many.covariances[0].tobytes()
    assert peak < 10 * (places.nbytes + seen.nbytes)  # not (2 × 10,000)² numbers


@pytest.mark.parametrize("pose_std", [np.inf, 0.1])
def test_readings_without_noise_have_no_bound_beyond_the_second(pose_std):
    poses, visible = exact_drive()
    visible[:] = True
    bound = bound_of(
        poses,
        visible,
        measurement_std=(0, 0),
        sensor=BEARING_RANGE,
        motion_std=(0, 0, 0),
        start_std=(0, 0, 0),
        pose_std=[pose_std] * 3,
    )
    assert np.isnan(bound.position[0, 1:]).all()
    assert np.isnan(bound.covariances[0]).all()


def test_no_landmark_leaves_dead_reckoning():
    poses, visible = exact_drive()
    bound = bound_of(poses, np.zeros_like(visible))
    turned = 0.05**2 + 0.03**2 * np.arange(len(poses))
    assert bound.heading[0] == pytest.approx(turned)
    assert np.isnan(bound.map[0])


def test_the_error_of_a_map_is_about_its_centre():
    error = np.array([[4, 0], [6, 0], [5, 3.0]])
    assert map_error_squared(error) == pytest.approx((1 + 1 + 1 + 1 + 0 + 4) / 3)
    many = error * np.arange(20).reshape(4, 5, 1, 1)
    expected = [[map_error_squared(each) for each in row] for row in many]
    np.testing.assert_allclose(map_error_squared(many), expected)


def test_the_map_is_bounded_about_its_centre():
    poses, visible = exact_drive()
    visible[:, 1] = False
    bound = bound_of(poses, visible)
    P, centre = bound.covariances[0], np.eye(3) - 1 / 3
    assert len(P) == 3 + 2 * 3
    about = [np.trace(centre @ P[axis::2, axis::2] @ centre) / 3 for axis in (3, 4)]
    assert bound.map[0] == pytest.approx(sum(about))


def test_the_interval_of_the_efficiency_is_that_of_student():
    found = efficiency(np.ones(3), np.array([0.5, 1.0, 1.5]))
    reach = 4.302652729911275 * 0.5 / np.sqrt(3)
    assert found.value == 1
    assert found.interval == pytest.approx((1 - reach, 1 + reach))
    over_steps = np.array([0.5, 1.0, 1.5])[:, None] + [-0.3, 0.1, 0.2]
    assert efficiency(np.ones(3), over_steps).interval == pytest.approx(found.interval)
    assert np.isfinite(efficiency(np.ones(2), np.array([1.0, 2.0])).interval).all()
    one = efficiency(np.ones(1), np.full(1, 2.0))
    assert (one.value, np.isnan(one.interval).all()) == (0.5, True)
    for errors in (np.zeros(3), np.empty(0)):
        assert np.isnan(efficiency(np.ones(len(errors)), errors).value)
    assert efficiency(np.zeros(3), np.ones(3)).value == 0


def test_a_map_without_landmarks_has_no_centre_in_plain_python_either():
    assert np.isnan(about_centre.py_func(np.eye(3), 3, np.zeros(3)))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"landmarks": np.zeros((1, 3, 2))}, r"landmarks must have shape \(1, 4, 2\)"),
        ({"visible": np.ones((1, 26))}, r"visible must have shape \(B, T, L\), got"),
        ({"motion_std": (0.1, -1, 0)}, "motion_std must be 3 finite numbers >= 0"),
        ({"pose_std": (0.0, np.inf, np.inf)}, "pose_std must be above 0"),
        ({"threads": -1}, "threads must be"),
    ],
)
def test_wrong_arguments_are_named(change, message):
    poses, visible = exact_drive()
    arguments = {"true_poses": poses[None], "landmarks": PLACES[None]}
    arguments |= {"visible": visible[None], "dt": np.ones(len(poses))}
    arguments |= {"start_std": START_STD, **NOISE}
    with pytest.raises(ValueError, match=message):
        posterior_bound(**arguments | change)
