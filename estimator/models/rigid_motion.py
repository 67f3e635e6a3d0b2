"""Rigid motions of the plane: composition of poses, SE(2), and errors of a belief.

`predict` moves a belief by one odometry reading.

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

from typing import Any, Literal, get_args

import numpy as np

from ...arrays import Array, ComplexArray
from ...jit import jit_in_place, njit_inlined, njit_internal
from .bearing_range import wrap_angle

Real = Any  # a number, or an array of any shape


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


def rotations(angles: Array) -> Array:
    """Return R(t) of angles of any shape (...), shape (..., 2, 2)."""
    cos, sin = np.cos(angles), np.sin(angles)
    return np.stack([cos, -sin, sin, cos], axis=-1).reshape(*cos.shape, 2, 2)


def pose_rotation(angle: float) -> Array:
    """Return the rotation of a pose (x, y, θ), shape (3, 3), that keeps θ."""
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
    x: Real, y: Real, heading: Real, dx: Real, dy: Real, turn: Real
) -> tuple[Real, Real, Real, Real, Real]:
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


# --------------------------------------------------------------------------------------
# Move of one belief by one odometry reading.


@jit_in_place
def predict(
    mean: Array,
    covariance: Array,
    reference: Array,
    size: int,
    forward: float,
    sideways: float,
    turn: float,
    motion_variance: Array,
    linearisation: int,
) -> None:
    """Move a belief by a displacement in the robot's frame, in place.

    The equations are those of :func:`.motions.predict_pose`, for any displacement.
    Linearised elsewhere than at the estimate (linearisation > 0), G is taken over the
    displacement between the predicted positions, which the reference keeps.
    """
    x, y, heading, cos, sin = composed_jit(
        mean[0], mean[1], mean[2], forward, sideways, turn
    )
    mean[0], mean[1], mean[2] = x, y, heading
    turned_x = -(forward * sin + sideways * cos)
    turned_y = forward * cos - sideways * sin
    if linearisation > 0:
        turned_x, turned_y = -(y - reference[1]), x - reference[0]
        reference[0], reference[1], reference[2] = x, y, heading
    propagate(covariance, size, turned_x, turned_y, cos, sin, motion_variance)


@njit_internal
def propagate(
    covariance: Array,
    size: int,
    turned_x: float,
    turned_y: float,
    cos: float,
    sin: float,
    motion_variance: Array,
) -> None:
    """P ← G P Gᵀ + F R Fᵀ with G = I + (turned_x, turned_y, 0, …) e_θᵀ, in O(size).

    F rotates the noise, whose covariance R is diagonal, by the heading (cos, sin).
    """
    P = covariance
    for j in range(size):
        P[0, j] += turned_x * P[2, j]
        P[1, j] += turned_y * P[2, j]
    for j in range(3, size):
        P[j, 0] = P[0, j]
        P[j, 1] = P[1, j]
    for i in range(3):
        P[i, 0] += turned_x * P[i, 2]
        P[i, 1] += turned_y * P[i, 2]
    along, across = motion_variance[0], motion_variance[1]
    P[0, 0] += cos * cos * along + sin * sin * across
    P[1, 1] += sin * sin * along + cos * cos * across
    P[1, 0] += cos * sin * (along - across)
    P[0, 1] = P[1, 0]
    P[2, 2] += motion_variance[2]


# --------------------------------------------------------------------------------------
# The error of a belief, in the coordinates in which a filter's covariance lives.
#
# Additive: e = x − x̂, the heading wrapped.  Invariant: the coordinates of SE_{1+n}(2),
# in which a turn of the whole map is a straight line.  With t = θ − θ̂ and every point
# q, the robot's position and each landmark::
#
#     ξ_θ = t,    ξ_q = V(t)⁻¹ (q − R(t) q̂),    to first order  ξ = D e
#     D = I − (J q̂; 0 at θ) e_θᵀ
#
# Where the heading is uncertain, positions are spread over an arc: a banana in additive
# coordinates, an ellipse in these.  States are (x, y, θ, l1x, l1y, …).

ErrorFrame = Literal["additive", "invariant"]
ERROR_FRAMES: tuple[ErrorFrame, ...] = get_args(ErrorFrame)


def additive_error(true_state: Array, mean: Array) -> Array:
    """Return e = x − x̂ with the heading wrapped, over any leading axes.

    Parameters
    ----------
    true_state, mean : ndarray, shape (..., 3 + 2n)
        True and estimated state.

    Returns
    -------
    ndarray, shape (..., 3 + 2n)

    Examples
    --------
    >>> additive_error(np.array([1.0, 0.0, 3.1]), np.array([0.0, 0.0, -3.1]))
    array([ 1.        ,  0.        , -0.08318531])
    """
    error = np.asarray(true_state - mean)
    error[..., 2] = wrap_angle(error[..., 2])
    return error


def invariant_error(true_state: Array, mean: Array) -> Array:
    """Return ξ = Log(χ χ̂⁻¹), over any leading axes.

    Parameters
    ----------
    true_state, mean : ndarray, shape (..., 3 + 2n)
        True and estimated state.

    Returns
    -------
    ndarray, shape (..., 3 + 2n)

    Examples
    --------
    A map that is turned as a whole, robot and all, is wrong by its heading alone:

    >>> estimate = np.array([1.0, 0.0, 0.0, 3.0, 0.0])
    >>> truth = np.array([0.0, 1.0, np.pi / 2, 0.0, 3.0])
    >>> np.allclose(invariant_error(truth, estimate), [0, 0, np.pi / 2, 0, 0])
    True
    """
    turn = wrap_angle(np.asarray(true_state[..., 2] - mean[..., 2]))
    true_points, points = points_of(true_state), points_of(mean)
    moved = true_points - np.exp(1j * turn)[..., None] * points
    return state_of(moved / left_jacobian(turn)[..., None], turn)


def invariant_covariance(mean: Array, covariance: Array) -> Array:
    """Return D P Dᵀ, the covariance of ξ for a covariance P of e; any leading axes.

    Parameters
    ----------
    mean : ndarray, shape (..., 3 + 2n)
    covariance : ndarray, shape (..., 3 + 2n, 3 + 2n)

    Returns
    -------
    ndarray, shape (..., 3 + 2n, 3 + 2n)
    """
    lever = state_of(1j * points_of(mean), np.zeros(mean.shape[:-1]))[..., :, None]
    half = covariance - lever * covariance[..., 2:3, :]
    return np.asarray(half - np.swapaxes(lever, -1, -2) * half[..., :, 2:3])


def seen_from(origin: Array, state: Array) -> Array:
    """Return states with positions relative to another origin; any leading axes.

    Coordinates far from the world's origin lose their digits in ξ, which turns about
    it.  The error about another origin o is Ad ξ, so the NEES is the same::

        ξ_q' = ξ_q + J o ξ_θ,    ξ_θ' = ξ_θ

    Parameters
    ----------
    origin : ndarray, shape (..., 2)
    state : ndarray, shape (..., 3 + 2n)

    Returns
    -------
    ndarray, shape (..., 3 + 2n)

    Examples
    --------
    >>> seen_from(np.array([4e6, 5e6]), np.array([4e6 + 1, 5e6 + 2, 0.5, 4e6, 5e6 + 3]))
    array([1. , 2. , 0.5, 0. , 3. ])
    """
    moved = np.array(state)
    moved[..., 0] -= origin[..., 0]
    moved[..., 1] -= origin[..., 1]
    moved[..., 3::2] -= origin[..., :1]
    moved[..., 4::2] -= origin[..., 1:2]
    return moved


def points_of(state: Array) -> ComplexArray:
    """Robot position and landmarks as complex numbers, shape (..., 1 + n)."""
    x = np.concatenate([state[..., :1], state[..., 3::2]], axis=-1)
    y = np.concatenate([state[..., 1:2], state[..., 4::2]], axis=-1)
    return np.asarray(x + 1j * y)


def state_of(points: ComplexArray, heading: Array | float) -> Array:
    """Return the state of points, shape (..., 1 + n), and a heading, shape (...)."""
    flat, turn = np.ascontiguousarray(points).view(np.float64), np.asarray(heading)
    return np.concatenate([flat[..., :2], turn[..., None], flat[..., 2:]], axis=-1)


def as_covariance(product: Array) -> Array:
    """Return (P + Pᵀ) / 2 with no variance below 0.

    Parameters
    ----------
    product : ndarray, shape (n, n)
        P, a covariance but for its last bits.

    Examples
    --------
    >>> as_covariance(np.array([[-1e-20, 1e-20], [0.0, 1.0]])).tolist()
    [[0.0, 5e-21], [5e-21, 1.0]]
    """
    whole = (product + product.T) / 2
    variances = np.einsum("ii->i", whole)  # a view of the diagonal
    np.maximum(variances, 0.0, out=variances)
    return np.asarray(whole)
