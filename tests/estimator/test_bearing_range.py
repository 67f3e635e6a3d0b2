import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numba import njit
from numeric_jacobian import numeric_jacobian

from slamgym.estimator.models.bearing_range import (
    expected_reading_jit,
    locate_landmark,
    located_jit,
    predict_measurement,
    reading_slopes_jit,
    wrap_angle,
    wrap_angle_jit,
)

POSE = np.array([0.5, -1.0, 2.5])
LANDMARKS = np.array([[3.0, 4.0], [-6.0, 1.0], [0.5, -9.0]])


def test_pose_jacobian_equals_central_differences():
    numeric = numeric_jacobian(
        lambda p: predict_measurement(p, LANDMARKS).measurement, POSE
    )
    np.testing.assert_allclose(
        predict_measurement(POSE, LANDMARKS).jacobian_pose, numeric, atol=1e-7
    )


@pytest.mark.parametrize("k", range(3))
def test_landmark_jacobian_equals_central_differences(k):
    numeric = numeric_jacobian(
        lambda point: predict_measurement(POSE, point[None]).measurement[0],
        LANDMARKS[k],
    )
    analytic = predict_measurement(POSE, LANDMARKS).jacobian_landmark[k]
    np.testing.assert_allclose(analytic, numeric, atol=1e-7)


def test_locating_a_prediction_returns_the_landmark():
    readings = predict_measurement(POSE, LANDMARKS).measurement
    np.testing.assert_allclose(
        locate_landmark(POSE, readings).position, LANDMARKS, atol=1e-12
    )


def test_locate_jacobians_equal_central_differences():
    readings = predict_measurement(POSE, LANDMARKS).measurement
    located = locate_landmark(POSE, readings)
    numeric = numeric_jacobian(lambda p: locate_landmark(p, readings).position, POSE)
    np.testing.assert_allclose(located.jacobian_pose, numeric, atol=1e-7)
    for k in range(3):
        numeric = numeric_jacobian(
            lambda z: locate_landmark(POSE, z[None]).position[0], readings[k]
        )
        np.testing.assert_allclose(located.jacobian_measurement[k], numeric, atol=1e-7)


@given(st.floats(-1e6, 1e6))
def test_a_wrapped_angle_points_the_same_way_within_the_half_open_interval(angle):
    wrapped = float(wrap_angle(angle))
    assert -np.pi <= wrapped < np.pi
    np.testing.assert_allclose(
        np.exp(1j * wrapped), np.exp(1j * angle), atol=1e-9, rtol=0
    )


@pytest.mark.parametrize("angle", [-np.pi - 1e-16, -np.pi, np.pi, 3 * np.pi])
def test_angles_at_the_seam_are_minus_pi(angle):
    assert wrap_angle(angle) == pytest.approx(-np.pi)
    assert wrap_angle(np.nextafter(-np.pi, -4)) < np.pi


@pytest.mark.parametrize("k", range(3))
def test_the_compiled_reading_equals_value_and_jacobian(k):
    x, y, heading = POSE.tolist()
    dx, dy = LANDMARKS[k, 0] - x, LANDMARKS[k, 1] - y
    expected = predict_measurement(POSE, LANDMARKS[k, None])
    bearing, distance = expected_reading_jit(dx, dy, heading)
    np.testing.assert_allclose(
        (wrap_angle(bearing), distance), expected.measurement[0], rtol=1e-15
    )
    slopes = np.reshape(reading_slopes_jit(dx, dy), (2, 2))
    np.testing.assert_allclose(slopes, expected.jacobian_landmark[0], rtol=1e-15)


@pytest.mark.parametrize("k", range(3))
def test_the_compiled_slopes_equal_central_differences(k):
    def reading(landmark):
        dx, dy = (landmark - POSE[:2]).tolist()
        return np.array(expected_reading_jit(dx, dy, POSE[2]))

    dx, dy = (LANDMARKS[k] - POSE[:2]).tolist()
    np.testing.assert_allclose(
        np.reshape(reading_slopes_jit(dx, dy), (2, 2)),
        numeric_jacobian(reading, LANDMARKS[k]),
        atol=1e-7,
    )


@pytest.mark.parametrize("reading", [(0.3, 2.0), (-3.0, 0.5), (1.6, 40.0)])
def test_the_compiled_inverse_equals_value_and_jacobians(reading):
    expected = locate_landmark(POSE, np.array([reading]))
    distance = reading[1]
    *place, cos, sin = located_jit(*POSE.tolist(), *reading)
    np.testing.assert_allclose(place, expected.position[0], rtol=1e-15)
    across = -distance * sin, distance * cos
    np.testing.assert_allclose(across, expected.jacobian_pose[0, :, 2], rtol=1e-15)
    np.testing.assert_allclose(
        np.column_stack([across, (cos, sin)]),
        expected.jacobian_measurement[0],
        rtol=1e-15,
    )


def test_the_compiled_wrapping_is_that_of_numpy():
    @njit
    def wrapped(angle):
        return wrap_angle_jit(angle)

    angles = [0.0, 3.2, -3.2, np.pi, -np.pi, np.nextafter(-np.pi, -4), 1e6]
    for angle in angles:
        assert wrapped(angle) == wrap_angle(angle)
