"""Gaussians of a pose and landmarks, with points as complex numbers.

With a point (x, y) as x + iy, the rotation R(θ) is e^{iθ} and J = [0 −1; 1 0] is i.
"""

from typing import NamedTuple

import numpy as np

from ....arrays import Array, ComplexArray

Complex = ComplexArray


class Gaussian(NamedTuple):
    """Mean of a pose and n landmarks, and the covariance of its additive error."""

    mean: Array
    """(x, y, θ, l1x, l1y, …), shape (3 + 2n,)."""
    covariance: Array
    """Shape (3 + 2n, 3 + 2n)."""


def points_of(state: Array) -> Complex:
    """Return the positions of the pose and the landmarks, shape (1 + n,)."""
    return np.concatenate([state[:1], state[3::2]]) + 1j * np.concatenate(
        [state[1:2], state[4::2]]
    )


def state_of(points: Complex, heading: float) -> Array:
    """Return (x, y, θ, l1x, l1y, …), shape (3 + 2n,)."""
    flat = np.ascontiguousarray(points).view(np.float64)
    return np.concatenate([flat[:2], [heading], flat[2:]])


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
    lever = 1j * (points_of(map_.mean) - complex(*start[:2]))
    G = np.zeros((len(map_.mean), 3))
    rows = np.r_[0, 3 : len(G) : 2]
    G[rows, 0] = G[rows + 1, 1] = G[2, 2] = 1.0
    G[rows, 2], G[rows + 1, 2] = lever.real, lever.imag
    return Gaussian(map_.mean, map_.covariance + G @ covariance @ G.T)
