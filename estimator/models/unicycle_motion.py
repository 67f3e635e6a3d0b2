"""Unicycle motion model: how one odometry reading moves the robot pose.

Symbols
-------
p = (x, y, θ)    robot pose in the world frame [m, m, rad]
u = (d, α)       odometry: distance driven, then heading turned [m, rad]
ε = (εx, εy, εα) motion noise in the robot's own frame [m, m, rad], ε ~ N(0, R)
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class MotionPrediction(NamedTuple):
    """Next pose and its first derivatives."""

    pose: Array  # (3,)
    jacobian_pose: Array  # (3, 3), G = ∂g/∂p
    jacobian_noise: Array  # (3, 3), F = ∂g/∂ε


def predict_pose(pose: Array, odometry: Array) -> MotionPrediction:
    """Drive d along the old heading, then turn by α.

    ::

        g(p, u, ε) = p + (d + εx) (cos θ,  sin θ, 0)
                       +      εy  (-sin θ, cos θ, 0)
                       + (α + εα) (0, 0, 1)

    evaluated with its derivatives at ε = 0.  θ is returned unwrapped, so that the
    pose stays differentiable; wrap differences of angles, never the state.

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
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    return MotionPrediction(
        pose=pose + np.array([distance * cos, distance * sin, turn]),
        jacobian_pose=np.array(
            [[1, 0, -distance * sin], [0, 1, distance * cos], [0, 0, 1]]
        ),
        jacobian_noise=np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]]),
    )
