import numpy as np
import pytest
from numeric_jacobian import numeric_jacobian

from slamgym.estimator.models.bearing_range import wrap_angle
from slamgym.estimator.models.unicycle_motion import drive_jit, predict_pose


@pytest.mark.parametrize("heading", [-2.5, 0.0, 0.7, 3.1])
@pytest.mark.parametrize("odometry", [(0.8, -0.3), (-1.5, 0.0), (0.0, 2.0)])
def test_pose_jacobian_equals_central_differences(heading, odometry):
    pose = np.array([1.0, -2.0, heading])
    numeric = numeric_jacobian(lambda p: predict_pose(p, np.array(odometry)).pose, pose)
    np.testing.assert_allclose(
        predict_pose(pose, np.array(odometry)).jacobian_pose, numeric, atol=1e-7
    )


def test_noise_jacobian_equals_central_differences():
    pose, (d, turn) = np.array([1.0, -2.0, 0.7]), (0.8, -0.3)

    def moved(noise):
        along, across, turned = noise
        x, y, heading = pose
        return np.array(
            [
                x + (d + along) * np.cos(heading) - across * np.sin(heading),
                y + (d + along) * np.sin(heading) + across * np.cos(heading),
                heading + turn + turned,
            ]
        )

    np.testing.assert_allclose(
        predict_pose(pose, np.array([d, turn])).jacobian_noise,
        numeric_jacobian(moved, np.zeros(3)),
        atol=1e-8,
    )


def test_the_robot_drives_before_it_turns():
    pose = predict_pose(np.array([0.0, 0.0, np.pi / 2]), np.array([2.0, 1.0])).pose
    np.testing.assert_allclose(pose, [0.0, 2.0, np.pi / 2 + 1.0], atol=1e-15)


@pytest.mark.parametrize("heading", [-2.5, 0.0, 0.7, 3.1, 40.0])
@pytest.mark.parametrize("odometry", [(0.8, -0.3), (-1.5, 0.0), (0.0, 2.0)])
def test_the_compiled_equation_equals_value_and_jacobians(heading, odometry):
    pose, (distance, _) = np.array([1.0, -2.0, heading]), odometry
    expected = predict_pose(pose, np.array(odometry))
    *moved, cos, sin = drive_jit(*pose.tolist(), *odometry)
    np.testing.assert_allclose(moved, expected.pose, rtol=1e-15)
    G, F = np.eye(3), np.eye(3)
    G[:2, 2] = -distance * sin, distance * cos
    F[:2, :2] = (cos, -sin), (sin, cos)
    np.testing.assert_allclose(G, expected.jacobian_pose, rtol=1e-15)
    np.testing.assert_allclose(F, expected.jacobian_noise, rtol=1e-15)


def test_the_jacobian_entries_of_the_compiled_equation_equal_central_differences():
    pose, (distance, turn) = np.array([1.0, -2.0, 0.7]), (0.8, -0.3)
    *_, cos, sin = drive_jit(*pose.tolist(), distance, turn)
    numeric = numeric_jacobian(
        lambda p: np.array(drive_jit(*p.tolist(), distance, turn)[:3]), pose
    )
    G = np.eye(3)
    G[:2, 2] = -distance * sin, distance * cos
    np.testing.assert_allclose(G, numeric, atol=1e-7)


def test_an_angle_just_below_minus_pi_stays_in_the_interval():
    below = np.nextafter(-np.pi, -4.0)
    assert wrap_angle(below) == -np.pi
    assert wrap_angle(np.array([below, 4.0])) == pytest.approx(
        [-np.pi, 4.0 - 2 * np.pi], abs=1e-15
    )
