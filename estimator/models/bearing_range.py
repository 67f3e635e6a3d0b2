"""Bearing-range measurement model of a point landmark, forward and inverse.

:func:`predict_measurement` and :func:`locate_landmark` serve filters in numpy, for many
landmarks at once.  The functions with a twin ``…_jit`` serve the kernels: the same
equations for one landmark, entry by entry.

Symbols
-------
p = (x, y, θ)  robot pose in the world frame [m, m, rad]
l = (lx, ly)   landmark position in the world frame [m, m]
z = (β, r)     bearing from the robot's heading, and range [rad, m]
"""

from typing import NamedTuple, TypeVar

import numpy as np

from ...arrays import Array
from ...jit import njit_inlined, njit_internal

Angle = TypeVar("Angle", float, Array)


def wrap_angle(angle: Angle) -> Angle:
    """Bring angles into the half-open interval [-π, π).

    Parameters
    ----------
    angle : float or ndarray, any shape
        Angles [rad].

    Returns
    -------
    float or ndarray, same shape
        The same directions, each in [-π, π) [rad].

    Examples
    --------
    >>> wrap_angle(np.array([0.0, 2 * np.pi, np.pi]))
    array([ 0.        ,  0.        , -3.14159265])
    """
    wrapped = (angle + np.pi) % (2 * np.pi) - np.pi
    # The remainder of a tiny negative number rounds up to 2π itself.
    return wrapped - 2 * np.pi * (wrapped >= np.pi)


wrap_angle_jit = njit_internal(wrap_angle)


class MeasurementPrediction(NamedTuple):
    """Expected readings of m landmarks and their first derivatives."""

    measurement: Array  # (m, 2), rows (β, r)
    jacobian_pose: Array  # (m, 2, 3), Hp = ∂h/∂p
    jacobian_landmark: Array  # (m, 2, 2), Hl = ∂h/∂l


class LandmarkLocation(NamedTuple):
    """World positions of m measured landmarks and their first derivatives."""

    position: Array  # (m, 2), rows (lx, ly)
    jacobian_pose: Array  # (m, 2, 3), ∂l/∂p
    jacobian_measurement: Array  # (m, 2, 2), ∂l/∂z


def predict_measurement(pose: Array, landmarks: Array) -> MeasurementPrediction:
    """Predict bearing and range of each landmark, with both Jacobians.

    ::

        h(p, l) = (atan2(ly - y, lx - x) - θ,  ‖l - (x, y)‖)

    Parameters
    ----------
    pose : ndarray, shape (3,)
        p = (x, y, θ) [m, m, rad].
    landmarks : ndarray, shape (m, 2)
        Landmark positions [m]; none may coincide with the robot.

    Returns
    -------
    MeasurementPrediction
        Readings (m, 2) with the bearing in [-π, π), Hp (m, 2, 3), Hl (m, 2, 2).

    Notes
    -----
    CMU 16-833, EKF-SLAM homework, eqs. 1.4 to 1.6 (row order: bearing, range).

    Examples
    --------
    >>> predict_measurement(np.zeros(3), np.array([[0.0, 2.0]])).measurement
    array([[1.57079633, 2.        ]])
    """
    dx, dy = (landmarks - pose[:2]).T
    squared_range = dx**2 + dy**2
    distance = np.sqrt(squared_range)
    jacobian_landmark = np.empty((len(landmarks), 2, 2))
    jacobian_landmark[:, 0] = np.stack([-dy, dx], axis=1) / squared_range[:, None]
    jacobian_landmark[:, 1] = np.stack([dx, dy], axis=1) / distance[:, None]
    jacobian_pose = np.zeros((len(landmarks), 2, 3))
    jacobian_pose[:, :, :2] = -jacobian_landmark
    jacobian_pose[:, 0, 2] = -1
    bearing = wrap_angle(np.arctan2(dy, dx) - pose[2])
    return MeasurementPrediction(
        measurement=np.stack([bearing, distance], axis=1),
        jacobian_pose=jacobian_pose,
        jacobian_landmark=jacobian_landmark,
    )


def locate_landmark(pose: Array, measurement: Array) -> LandmarkLocation:
    """Locate each measured landmark in the world, with both Jacobians: h⁻¹.

    ::

        l = (x + r cos(θ + β),  y + r sin(θ + β))

    Parameters
    ----------
    pose : ndarray, shape (3,)
        p = (x, y, θ) [m, m, rad].
    measurement : ndarray, shape (m, 2)
        Rows z = (β, r) [rad, m].

    Returns
    -------
    LandmarkLocation
        Positions (m, 2), ∂l/∂p (m, 2, 3) and ∂l/∂z (m, 2, 2).

    Notes
    -----
    CMU 16-833, EKF-SLAM homework, eq. 1.3.

    Examples
    --------
    >>> locate_landmark(np.array([1.0, 0.0, 0.0]), np.array([[0.0, 2.0]])).position
    array([[3., 0.]])
    """
    direction = pose[2] + measurement[:, 0]
    distance = measurement[:, 1]
    along = np.stack([np.cos(direction), np.sin(direction)], axis=1)
    across = np.stack([-np.sin(direction), np.cos(direction)], axis=1)
    turned = distance[:, None] * across
    jacobian_pose = np.empty((len(measurement), 2, 3))
    jacobian_pose[:, :, :2] = np.eye(2)
    jacobian_pose[:, :, 2] = turned
    return LandmarkLocation(
        position=pose[:2] + distance[:, None] * along,
        jacobian_pose=jacobian_pose,
        jacobian_measurement=np.stack([turned, along], axis=2),
    )


def expected_reading(dx: float, dy: float, heading: float) -> tuple[float, float]:
    """Return the bearing, not wrapped, and the range of one landmark: h(p, l).

    Parameters
    ----------
    dx, dy : float
        l − (x, y) [m].
    heading : float
        θ [rad].
    """
    return np.arctan2(dy, dx) - heading, np.sqrt(dx * dx + dy * dy)


def reading_slopes(dx: float, dy: float) -> tuple[float, float, float, float]:
    """Return the Jacobian of one reading by its landmark, (βx, βy, rx, ry).

    ::

        Hl = [βx βy; rx ry] = [−dy/r², dx/r²; dx/r, dy/r],    Hp = [−Hl, (−1; 0)]

    Parameters
    ----------
    dx, dy : float
        l − (x, y), not both 0 [m].
    """
    per_range = 1 / np.sqrt(dx * dx + dy * dy)
    along_x, along_y = dx * per_range, dy * per_range
    return -along_y * per_range, along_x * per_range, along_x, along_y


def located(
    x: float, y: float, heading: float, bearing: float, distance: float
) -> tuple[float, float, float, float]:
    """Return where one measured landmark lies, and the direction (cos, sin) to it.

    ::

        l = (x + r cos, y + r sin)  of  θ + β
        ∂l/∂p = [1 0 −r sin; 0 1 r cos],    ∂l/∂z = [−r sin, cos; r cos, sin]

    Parameters
    ----------
    x, y, heading : float
        p [m, m, rad].
    bearing, distance : float
        z = (β, r) [rad, m].
    """
    direction = heading + bearing
    cos, sin = np.cos(direction), np.sin(direction)
    return x + distance * cos, y + distance * sin, cos, sin


expected_reading_jit = njit_inlined(expected_reading)
reading_slopes_jit = njit_inlined(reading_slopes)
located_jit = njit_inlined(located)


# --------------------------------------------------------------------------------------
# What kernels need of a sensor; for others than bearing and range, `sensors` replaces
# these functions.


def pose_slopes(dx: float, dy: float, heading: float) -> tuple[float, ...]:
    """Return Hl entry by entry, as `reading_slopes`, and then ∂h/∂θ = (−1, 0)."""
    bearing_x, bearing_y, range_x, range_y = reading_slopes_jit(dx, dy)
    return bearing_x, bearing_y, range_x, range_y, -1.0, 0.0


def difference(
    bearing: float, distance: float, expected: float, expected_distance: float
) -> tuple[float, float]:
    """Return a reading minus another, the bearing wrapped."""
    return wrap_angle_jit(bearing - expected), distance - expected_distance


def read_distance(bearing: float, distance: float) -> float:
    """Return the distance of the landmark by its reading, infinite if unknown [m]."""
    return distance


def reading_variances(
    noise: tuple[float, float, float, float], distance: float
) -> tuple[float, float]:
    """Return (σβ + b / r)² and (σr + k r)² at r > 0 [m], of a noise (σβ, σr, k, b)."""
    bearing_std, range_std, per_metre, metres = noise
    bearing_std += metres / distance
    range_std += per_metre * distance
    return bearing_std * bearing_std, range_std * range_std


def placed(
    pose: tuple[float, float, float],
    bearing: float,
    distance: float,
    bearing_variance: float,
    range_variance: float,
) -> tuple[float, ...]:
    """Return where one measured landmark lies, and how it depends on all else.

    ::

        l = (x + r cos, y + r sin)  of  θ + β
        ∂l/∂p = [1 0 −r sin; 0 1 r cos],    ∂l/∂z = [−r sin, cos; r cos, sin]

    Parameters
    ----------
    pose
        p [m, m, rad].
    bearing, distance : float
        z = (β, r) [rad, m].
    bearing_variance, range_variance : float
        The diagonal of Q.

    Returns
    -------
    x, y
        l.
    turned_x, turned_y
        ∂l/∂θ.
    xx, more_xx, xy, yy, more_yy
        ∂l/∂z Q (∂l/∂z)ᵀ; its variances in two parts, which are to be added up.
    """
    x, y, cos, sin = located_jit(pose[0], pose[1], pose[2], bearing, distance)
    across, along = bearing_variance * distance * distance, range_variance
    xx, more_xx = cos * cos * along, sin * sin * across
    yy, more_yy = sin * sin * along, cos * cos * across
    xy = cos * sin * (along - across)
    return x, y, -distance * sin, distance * cos, xx, more_xx, xy, yy, more_yy


def places_at_once() -> bool:
    """Return whether one reading determines where a landmark is."""
    return True


pose_slopes_jit = njit_inlined(pose_slopes)
difference_jit = njit_inlined(difference)
read_distance_jit = njit_inlined(read_distance)
reading_variances_jit = njit_inlined(reading_variances)
placed_jit = njit_inlined(placed)
places_at_once_jit = njit_inlined(places_at_once)
