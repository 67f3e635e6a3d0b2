"""What a submap says of the frames and landmarks of the world.

Symbols
-------
F_k = (p_k, θ_k)  frame of submap k in the world [m, m, rad]
m̂, P              its mean, (last pose, landmarks) in F_k, and the covariance of its
                  error, additive or invariant (:mod:`.error_frames`)
Y                 the same quantities as the world has them: F_{k+1} and landmarks l
                  seen from F_k,  Y_q = R(θ_k)ᵀ (q − p_k),  Y_θ = θ_{k+1} − θ_k

Points are complex numbers here, so that R(θ) is e^{iθ} and J is i.  The submap says
that the error e of m̂ against Y is Gaussian: N(0, P).
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

from ...error_frames import ErrorFrame
from ...models.angles import wrap_angle

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

SMALLEST = 1e-5
"""Deviations below this share of a submap's largest count as that much."""


class Relation(NamedTuple):
    """Error of a submap against the world, and its derivative."""

    error: Array
    """e, shape (3 + 2n,)."""
    jacobian: Array
    """By F_k, F_{k+1} and the landmarks, shape (3 + 2n, 6 + 2n)."""


def relation(
    start: Array, state: Array, mean: Array, frame: ErrorFrame = "additive"
) -> Relation:
    """Compare a submap with the world.

    ::

        t = Y_θ − m̂_θ,  e_θ = t,   additive:   e_q = Y_q − m̂_q
                                   invariant:  e_q = V(t)⁻¹ (Y_q − R(t) m̂_q)

    Parameters
    ----------
    start : ndarray, shape (3,)
        F_k.
    state : ndarray, shape (3 + 2n,)
        F_{k+1}, and the landmarks in the world.
    mean : ndarray, shape (3 + 2n,)
        m̂.
    frame : {"additive", "invariant"}
        Coordinates of the error.

    Examples
    --------
    A submap saw a landmark 2 m ahead; the world has it at 3 m from where it began:

    >>> world = np.array([1.0, 0.0, 0.0, 3.0, 0.0])
    >>> relation(np.zeros(3), world, np.array([1.0, 0.0, 0.0, 2.0, 0.0])).error
    array([0., 0., 0., 1., 0.])
    """
    turned = np.exp(-1j * start[2])
    seen = turned * (points_of(state) - complex(*start[:2]))
    turn = float(wrap_angle(state[2] - start[2] - mean[2]))
    error, scale, slope = _error(seen, points_of(mean), turn, frame)
    size = len(state)
    jacobian = np.zeros((size, 3 + size))
    jacobian[2, 2], jacobian[2, 5] = -1.0, 1.0
    where = np.r_[0, 3:size:2]
    by_point = scale * turned
    for row, part in ((where, np.real), (where + 1, np.imag)):
        jacobian[row, 0], jacobian[row, 1] = -part(by_point), -part(1j * by_point)
        jacobian[row, 3 + where] = part(by_point)
        jacobian[row, 4 + where] = part(1j * by_point)
        jacobian[row, 2] = part(-1j * scale * seen - slope)
        jacobian[row, 5] = part(slope)
    return Relation(state_of(error, turn), jacobian)


def _error(
    seen: Complex, mean: Complex, turn: float, frame: ErrorFrame
) -> tuple[Complex, complex, Complex]:
    """Return e of points, and its derivatives by the points seen and by the turn."""
    if frame == "additive":
        return seen - mean, 1.0 + 0.0j, np.zeros_like(seen)
    scale, slope = inverse_spread(turn)
    turned = np.exp(1j * turn) * mean
    return scale * (seen - turned), scale, slope * (seen - turned) - scale * 1j * turned


def inverse_spread(turn: float) -> tuple[complex, complex]:
    """Return V(t)⁻¹ = (t/2) (cot(t/2) − i) as a complex number, and its derivative.

    Examples
    --------
    >>> inverse_spread(0.0) == (1.0, -0.5j)
    True
    """
    half = turn / 2
    if abs(half) < 1e-3:
        return complex(1 - half**2 / 3, -half), complex(-half / 3, -0.5)
    cot, sin = 1 / np.tan(half), np.sin(half)
    return complex(half * cot, -half), complex((cot - half / sin**2) / 2, -0.5)


def retract(mean: Array, error: Array, frame: ErrorFrame) -> Array:
    """Return the state that has this error against the mean, shape (3 + 2n,)."""
    if frame == "additive":
        return mean + error
    turn = float(error[2])
    points = np.exp(1j * turn) * points_of(mean)
    points = points + points_of(error) / inverse_spread(turn)[0]
    return state_of(points, float(mean[2]) + turn)


def compose(start: Array, pose: Array) -> tuple[Array, Array, Array]:
    """Return start ⊕ pose, shape (3,), and its derivatives by both, (3, 3) each."""
    c, s = np.cos(start[2]), np.sin(start[2])
    by_pose = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    moved = by_pose @ pose
    by_start = np.eye(3)
    by_start[:2, 2] = -moved[1], moved[0]
    return start + moved, by_start, by_pose


def floor(covariance: Array) -> Array:
    """Return what to add to a covariance so that it can be solved with."""
    largest = float(np.max(np.diagonal(covariance)))
    return np.eye(len(covariance)) * max(SMALLEST**2 * largest, 1e-18)


def whitened(covariance: Array, columns: Array) -> Array:
    """Return L⁻¹ times columns, with L Lᵀ the covariance."""
    lower = np.linalg.cholesky(covariance + floor(covariance))
    return np.asarray(solve_triangular(lower, columns, lower=True, check_finite=False))


def points_of(state: Array) -> Complex:
    """Position of the pose, then of the landmarks, shape (1 + n,)."""
    return np.concatenate([state[:1], state[3::2]]) + 1j * np.concatenate(
        [state[1:2], state[4::2]]
    )


def state_of(points: Complex, heading: float) -> Array:
    """Return (x, y, θ, l1x, l1y, …), shape (3 + 2n,)."""
    flat = np.ascontiguousarray(points).view(np.float64)
    return np.concatenate([flat[:2], [heading], flat[2:]])
