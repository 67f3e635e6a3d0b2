"""Rigid motions of the plane: composition of poses, and the exponential of SE(2).

Symbols
-------
R(t)    rotation by t, the complex number e^{it}
V(t)    [sin t, −(1 − cos t); 1 − cos t, sin t] / t, the number (e^{it} − 1) / (it)
J       [0 −1; 1 0], the complex number i

A correction ξ = (ξ_p, t, ξ_l, …) in the invariant error frame moves the heading by t
and every point q, the robot's position or a landmark, to R(t) q + V(t) ξ_q: the
exponential of SE_{1+n}(2), applied from the left [1]_.

References
----------
.. [1] A. Barrau, S. Bonnabel, An EKF-SLAM algorithm with consistency properties,
   arXiv:1510.06263, 2015.
"""

import numpy as np

from ...arrays import Array, ComplexArray
from ...jit import njit_inlined


def rotation(angle: float) -> Array:
    """Return R(t), shape (2, 2).

    Examples
    --------
    >>> rotation(0.0)
    array([[ 1., -0.],
           [ 0.,  1.]])
    """
    cos, sin = np.cos(angle), np.sin(angle)
    return np.array([[cos, -sin], [sin, cos]])


def pose_rotation(angle: float) -> Array:
    """Return R(t) for poses (x, y, θ), shape (3, 3); the heading stays."""
    turn = np.eye(3)
    turn[:2, :2] = rotation(angle)
    return turn


def compose(start: Array, pose: Array) -> tuple[Array, Array, Array]:
    """Return start ⊕ pose, shape (3,), and its derivatives by both, (3, 3) each.

    ::

        (p, θ) ⊕ (q, φ) = (p + R(θ) q, θ + φ)
    """
    by_pose = pose_rotation(start[2])
    moved = by_pose @ pose
    by_start = np.eye(3)
    by_start[:2, 2] = -moved[1], moved[0]
    return start + moved, by_start, by_pose


def composed(
    x: float, y: float, heading: float, dx: float, dy: float, turn: float
) -> tuple[float, float, float, float, float]:
    """Return (x, y, θ) ⊕ (dx, dy, turn) entry by entry, and (cos, sin) of θ."""
    cos, sin = np.cos(heading), np.sin(heading)
    return x + cos * dx - sin * dy, y + sin * dx + cos * dy, heading + turn, cos, sin


composed_jit = njit_inlined(composed)


def left_jacobian(turn: Array) -> ComplexArray:
    """Return V(t) as a complex number, sinc(t/2) e^{it/2}; any shape.

    Examples
    --------
    >>> left_jacobian(np.array(0.0)) == 1
    np.True_
    """
    return np.asarray(np.sinc(turn / (2 * np.pi)) * np.exp(1j * turn / 2))


def turn_coefficients(turn: float) -> tuple[float, float, float, float]:
    """Return (cos t, sin t) of R(t), and (sin t, 1 − cos t) / t of V(t)."""
    cos, sin = np.cos(turn), np.sin(turn)
    even, odd = 1.0, 0.0
    if turn != 0:
        even, odd = sin / turn, 2 * np.sin(turn / 2) ** 2 / turn
    return cos, sin, even, odd


turn_coefficients_jit = njit_inlined(turn_coefficients)
