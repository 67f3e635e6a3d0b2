"""Unicycle motion model: the pose after one odometry reading, with its Jacobians.

:func:`drive` is the equation.  Filters in numpy use it through :func:`predict_pose`,
kernels through its compiled twin ``drive_jit``.

Symbols
-------
p = (x, y, θ)    robot pose in the world frame [m, m, rad]
u = (d, α)       odometry: distance driven, then heading turned [m, rad]
ε = (εx, εy, εα) motion noise in the robot's own frame [m, m, rad], ε ~ N(0, R)
"""

from typing import Any, NamedTuple

import numpy as np

from ...arrays import Array
from ...jit import njit_inlined

Real = Any  # a number, or an array of any shape


def drive(
    x: Real, y: Real, heading: Real, distance: Real, turn: Real
) -> tuple[Real, Real, Real, Real, Real]:
    """Drive a distance along the heading, then turn: g(p, u, 0) and what G, F need.

    ::

        x' = x + d cos θ,    y' = y + d sin θ,    θ' = θ + α

        G = [1 0 −d sin θ; 0 1 d cos θ; 0 0 1]
        F = [cos θ  −sin θ  0; sin θ  cos θ  0; 0 0 1]

    Parameters
    ----------
    x, y, heading : float or ndarray
        p = (x, y, θ) [m, m, rad].
    distance, turn : float or ndarray
        u = (d, α) [m, rad].

    Returns
    -------
    x, y, heading
        The pose after the step, θ not wrapped.
    cos, sin
        Of the old heading: the entries of G and F that vary.

    Examples
    --------
    >>> [float(value) for value in drive(1.0, 0.0, 0.0, 2.0, 0.5)]
    [3.0, 0.0, 0.5, 1.0, 0.0]
    """
    cos, sin = np.cos(heading), np.sin(heading)
    return x + distance * cos, y + distance * sin, heading + turn, cos, sin


drive_jit = njit_inlined(drive)


class MotionPrediction(NamedTuple):
    """Next pose and its first derivatives."""

    pose: Array  # (3,)
    jacobian_pose: Array  # (3, 3), G = ∂g/∂p
    jacobian_noise: Array  # (3, 3), F = ∂g/∂ε


def predict_pose(pose: Array, odometry: Array) -> MotionPrediction:
    """Move a pose by one odometry reading, with both Jacobians.

    The robot drives d along the old heading, then turns by α::

        g(p, u, ε) = p + (d + εx) (cos θ,  sin θ, 0)
                       +      εy  (-sin θ, cos θ, 0)
                       + (α + εα) (0, 0, 1)

    All are evaluated at ε = 0.  θ is not wrapped, so that the pose stays
    differentiable: wrap differences of angles, never the state.

    Parameters
    ----------
    pose : ndarray, shape (3,)
        p = (x, y, θ) [m, m, rad].
    odometry : ndarray, shape (2,)
        u = (d, α) [m, rad].

    Returns
    -------
    MotionPrediction
        Predicted pose (3,), G (3, 3) and F (3, 3).  The predicted covariance of the
        pose is G Σ Gᵀ + F R Fᵀ.

    Notes
    -----
    CMU 16-833, EKF-SLAM homework, eqs. 1.1 and 1.2; the model of [1]_, section 5.4,
    without the first of its two rotations.

    References
    ----------
    .. [1] S. Thrun, W. Burgard, D. Fox, Probabilistic Robotics, MIT Press, 2005.

    Examples
    --------
    >>> predict_pose(np.zeros(3), np.array([2.0, 0.5])).pose
    array([2. , 0. , 0.5])
    """
    distance, turn = odometry
    x, y, heading, cos, sin = drive(pose[0], pose[1], pose[2], distance, turn)
    return MotionPrediction(
        pose=np.array([x, y, heading]),
        jacobian_pose=np.array(
            [[1, 0, -distance * sin], [0, 1, distance * cos], [0, 0, 1]]
        ),
        jacobian_noise=np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]]),
    )
