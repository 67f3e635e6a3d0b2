"""The factor of a submap: its error against frames and landmarks in the world.

Symbols
-------
F_k = (p_k, θ_k)  frame of submap k in the world [m, m, rad]
m̂, P              its mean, (last pose, landmarks) in F_k, and the covariance of its
                  error, additive or invariant (:mod:`.rigid_motion`)
Y                 the same quantities in the world: F_{k+1} and landmarks l relative
                  to F_k,  Y_q = R(θ_k)ᵀ (q − p_k),  Y_θ = θ_{k+1} − θ_k

Points are complex numbers here.  The error e of m̂ against Y is Gaussian, N(0, P).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ....arrays import Array, ComplexArray
from ....jit import jit_in_place, njit_internal
from ...models.bearing_range import wrap_angle
from ...models.rigid_motion import ErrorFrame, points_of, state_of

# Lower bound of a standard deviation, relative to the largest of the submap.
SMALLEST_RATIO = 1e-5


class FactorError(NamedTuple):
    """Error of a submap against the world, and its Jacobian."""

    error: Array  # e, shape (3 + 2n,)
    jacobian: Array  # ∂e/∂(F_k, F_{k+1}, landmarks), shape (3 + 2n, 6 + 2n)


def factor_error(
    start: Array, state: Array, mean: Array, frame: ErrorFrame = "additive"
) -> FactorError:
    """Return the error of a submap against the world.

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
    The submap has the landmark 2 m ahead, the world 3 m from the start:

    >>> world = np.array([1.0, 0.0, 0.0, 3.0, 0.0])
    >>> factor_error(np.zeros(3), world, np.array([1.0, 0.0, 0.0, 2.0, 0.0])).error
    array([0., 0., 0., 1., 0.])
    """
    turn, size = float(wrap_angle(state[2] - start[2] - mean[2])), len(state)
    error, jacobian = np.empty(size), np.zeros((size, 3 + size))
    _fill(start, state, mean, turn, frame == "invariant", error, jacobian)
    return FactorError(error, jacobian)


@jit_in_place
def _fill(  # noqa: PLR0917 (a kernel takes no keywords)
    start: Array,
    state: Array,
    mean: Array,
    turn: float,
    invariant: bool,
    error: Array,
    jacobian: Array,
) -> None:
    """Write e, and its derivatives other than 0."""
    turned, ahead = np.exp(-1j * start[2]), np.exp(1j * turn)
    scale, slope = 1.0 + 0.0j, 0.0 + 0.0j
    if invariant:
        scale, slope = inverse_spread_jit(turn)
    across = scale * turned
    error[2], jacobian[2, 2], jacobian[2, 5] = turn, -1.0, 1.0
    for row in range(0, len(state) - 1, 2):
        x = row + (row > 0)  # 0, then 3, 5, …
        seen = turned * complex(state[x] - start[0], state[x + 1] - start[1])
        expected = complex(mean[x], mean[x + 1])
        by_turn = 0.0j
        if invariant:
            expected *= ahead
            by_turn = slope * (seen - expected) - scale * 1j * expected
        found, by_start = scale * (seen - expected), -1j * scale * seen - by_turn
        error[x], error[x + 1] = found.real, found.imag
        for at, sign in ((0, -1.0), (3 + x, 1.0)):
            jacobian[x, at] = jacobian[x + 1, at + 1] = sign * across.real
            jacobian[x + 1, at] = sign * across.imag
            jacobian[x, at + 1] = -sign * across.imag
        jacobian[x, 2], jacobian[x + 1, 2] = by_start.real, by_start.imag
        jacobian[x, 5], jacobian[x + 1, 5] = by_turn.real, by_turn.imag


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


inverse_spread_jit = njit_internal(inverse_spread)


def retract(mean: Array, error: Array, frame: ErrorFrame) -> Array:
    """Return the state with this error against the mean, shape (3 + 2n,)."""
    if frame == "additive":
        return mean + error
    turn = float(error[2])
    points = np.exp(1j * turn) * points_of(mean)
    points = points + points_of(error) / inverse_spread(turn)[0]
    return state_of(points, float(mean[2]) + turn)


def regularised(P: Array) -> Array:
    """Return a covariance with an increased diagonal, so that it can be solved with."""
    largest = float(np.max(np.diagonal(P)))
    return P + np.eye(len(P)) * max(SMALLEST_RATIO**2 * largest, 1e-18)


# --------------------------------------------------------------------------------------
# Gaussians of a pose and landmarks, with points as complex numbers.
#
# With a point (x, y) as x + iy, the rotation R(θ) is e^{iθ} and J = [0 −1; 1 0] is i.

Complex = ComplexArray


class Gaussian(NamedTuple):
    """Mean of a pose and n landmarks, and the covariance of its additive error."""

    mean: Array  # (x, y, θ, l1x, l1y, …), shape (3 + 2n,)
    covariance: Array  # (3 + 2n, 3 + 2n)


def times(factor: complex, rows: Array) -> Array:
    """Multiply pairs of rows, as real and imaginary parts, by a complex number."""
    product = factor * (rows[0::2] + 1j * rows[1::2])
    out = np.empty_like(rows)
    out[0::2], out[1::2] = product.real, product.imag
    return out


def with_uncertain_start(map_: Gaussian, start: Array, covariance: Array) -> Gaussian:
    """Add the uncertainty of the start pose to a map that is given relative to it.

    Parameters
    ----------
    map_ : Gaussian
        Conditioned on a run that begins at ``start``.
    start, covariance : ndarray, shapes (3,) and (3, 3)
        Pose at the beginning of the run.
    """
    if not covariance.any():
        return map_
    lever = 1j * (points_of(map_.mean) - complex(*start[:2]))
    G = np.zeros((len(map_.mean), 3))
    rows = np.r_[0, 3 : len(G) : 2]
    G[rows, 0] = G[rows + 1, 1] = G[2, 2] = 1.0
    G[rows, 2], G[rows + 1, 2] = lever.real, lever.imag
    return Gaussian(map_.mean, map_.covariance + G @ covariance @ G.T)
