"""Points relative to each other and to the robot, with their covariances.

A point is the robot's position p or a landmark, named by its column in the state
(x, y, θ, l1x, l1y, …): 0 or 3 + 2k.  Columns may be arrays; kernels call the twins
``…_jit``, with numbers.

Symbols
-------
d = q_i − q_j  offset of two points [m]
e              additive errors of a belief, e_θ that of its heading
J              [0 −1; 1 0]; J d is the derivative of R(t) d by t, at t = 0

If robot and map turn together, every offset turns with them, and no reading shows it.
Relative to the robot, whose heading is taken as the direction of the axes, the error of
an offset is ρ::

    e_d = e_i − e_j,    ρ = e_d − J d e_θ

D is the covariance of e_d, g its covariance with e_θ, and C the covariance of ρ::

    D = P_ii + P_jj − P_ij − P_ji,    g = P_iθ − P_jθ
    C = D − g (J d)ᵀ − (J d) gᵀ + σ²_θ J d (J d)ᵀ
"""

from typing import Any

import numpy as np

from ...arrays import Array
from ...jit import njit_inlined, njit_internal

Real = Any  # a number, or an array of any shape
Columns = Any  # a whole number, or an array of these
Matrix = tuple[Real, Real, Real]  # xx, xy and yy of symmetric matrices [m²]


def separation(mean: Array, P: Array, i: Columns, j: Columns) -> tuple[Array, Array]:
    """Return d (..., 2) and D (..., 2, 2) of the points at columns of a belief."""
    return offset_of(mean, i, j), as_matrix(offset_covariance(P, i, j))


def relative_separation(
    mean: Array, P: Array, i: Columns, j: Columns
) -> tuple[Array, Array]:
    """Return d (..., 2) and C (..., 2, 2) of the points at columns of a belief."""
    d, D = offset_of(mean, i, j), offset_covariance(P, i, j)
    g = covariance_with_heading(P, i, j)
    return d, as_matrix(relative_covariance(D, g, P[2, 2], d[..., 0], d[..., 1]))


def offset_of(mean: Array, i: Columns, j: Columns) -> Array:
    """Return d of the points at columns of a state, shape (..., 2) [m]."""
    return np.stack([mean[i] - mean[j], mean[i + 1] - mean[j + 1]], axis=-1)


def offset_covariance(P: Array, i: Columns, j: Columns) -> Matrix:
    """Return D of the points at columns of a covariance, or of one without a pose."""
    xx = P[j, j] + P[i, i] - 2 * P[j, i]
    yy = P[j + 1, j + 1] + P[i + 1, i + 1] - 2 * P[j + 1, i + 1]
    xy = P[j, j + 1] + P[i, i + 1] - P[j, i + 1] - P[j + 1, i]
    return xx, xy, yy


def covariance_with_heading(P: Array, i: Columns, j: Columns) -> tuple[Real, Real]:
    """Return g of the points at columns of a covariance."""
    return P[2, i] - P[2, j], P[2, i + 1] - P[2, j + 1]


def relative_covariance(
    D: Matrix, g: tuple[Real, Real], variance: Real, dx: Real, dy: Real
) -> Matrix:
    """Return C, where σ²_θ is the variance of the heading."""
    (xx, xy, yy), (gx, gy) = D, g
    xx = xx + 2 * dy * gx + dy * dy * variance
    xy = xy + dy * gy - dx * gx - dx * dy * variance
    return xx, xy, yy - 2 * dx * gy + dx * dx * variance


def largest_variance(xx: Real, xy: Real, yy: Real) -> Real:
    """Return the larger eigenvalue of a covariance [m²]."""
    return (xx + yy) / 2 + np.sqrt(((xx - yy) / 2) ** 2 + xy * xy)


offset_covariance_jit = njit_inlined(offset_covariance)
covariance_with_heading_jit = njit_inlined(covariance_with_heading)
relative_covariance_jit = njit_inlined(relative_covariance)
largest_variance_jit = njit_inlined(largest_variance)


@njit_inlined
def variance_from_robot(P: Array, c: int, dx: float, dy: float) -> Real:
    """Return the largest variance of a landmark relative to the robot [m²].

    Parameters
    ----------
    P : ndarray
        Covariance of the state.
    c : int
        Column of the landmark.
    dx, dy : float
        Its offset from the robot [m].
    """
    D, g = offset_covariance_jit(P, c, 0), covariance_with_heading_jit(P, c, 0)
    xx, xy, yy = relative_covariance_jit(D, g, P[2, 2], dx, dy)
    return largest_variance_jit(xx, xy, yy)


@njit_internal
def reading_covariance(
    P: Array, c: int, slopes: tuple[float, float, float, float]
) -> tuple[float, float, float]:
    """Return ββ, βr and rr of H P Hᵀ, of the landmark at column c.

    The slopes are ∂β/∂x, ∂β/∂y, ∂r/∂x and ∂r/∂y by the position of the landmark; those
    by the position of the robot are the opposite.
    """
    ax, ay, ex, ey = slopes
    xx, xy, yy = offset_covariance_jit(P, c, 0)
    gx, gy = covariance_with_heading_jit(P, c, 0)
    bb = ax * ax * xx + 2 * ax * ay * xy + ay * ay * yy
    br = ax * ex * xx + (ax * ey + ay * ex) * xy + ay * ey * yy - (ex * gx + ey * gy)
    rr = ex * ex * xx + 2 * ex * ey * xy + ey * ey * yy
    return bb + P[2, 2] - 2 * (ax * gx + ay * gy), br, rr


def lever_of(offsets: Array) -> Array:
    """Return J d of offsets (..., 2) [m].

    Examples
    --------
    >>> lever_of(np.array([3.0, 1.0]))
    array([-1.,  3.])
    """
    return np.asarray(offsets[..., ::-1] * (-1.0, 1.0))


def as_matrix(entries: Matrix) -> Array:
    """Return xx, xy and yy, of any shape, as matrices (..., 2, 2)."""
    xx, xy, yy = entries
    return np.stack([np.stack([xx, xy], axis=-1), np.stack([xy, yy], axis=-1)], axis=-1)


def largest_std(covariances: Array) -> Array:
    """Return σ in the most uncertain direction, of covariances (..., 2, 2) [m]."""
    C = covariances
    largest = largest_variance(C[..., 0, 0], C[..., 0, 1], C[..., 1, 1])
    return np.asarray(np.sqrt(np.maximum(largest, 0.0)))


def squared_offsets(offsets: Array, covariances: Array) -> Array:
    """Return dᵀ C⁻¹ d of offsets d, χ² of 2 degrees of freedom; ∞ where C is singular.

    Parameters
    ----------
    offsets : ndarray, shape (..., 2)
    covariances : ndarray, shape (..., 2, 2)

    Returns
    -------
    ndarray, shape (...)

    Examples
    --------
    >>> squared_offsets(np.ones((2, 2)), np.stack([np.eye(2), np.ones((2, 2))]))
    array([ 2., inf])
    """
    x, y = offsets[..., 0], offsets[..., 1]
    xx, yy = covariances[..., 0, 0], covariances[..., 1, 1]
    xy = covariances[..., 0, 1]
    determinant = xx * yy - xy * xy
    squared = np.full(determinant.shape, np.inf)
    product = yy * x * x - 2 * xy * x * y + xx * y * y
    np.divide(product, determinant, out=squared, where=determinant > 0)
    return squared
