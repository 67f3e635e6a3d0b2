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

from ....arrays import Array, ComplexArray, IntArray
from ....jit import jit_in_place, njit_internal
from ...models.bearing_range import wrap_angle
from ...models.rigid_motion import ErrorFrame, points_of, state_of
from ..elimination import Quadratic

# Lower bound of a standard deviation, relative to the largest of the submap.
SMALLEST_RATIO = 1e-5


class FactorError(NamedTuple):
    """Error of a submap against the world, and its derivatives."""

    #: ∂e/∂F_k, ∂e/∂θ_{k+1} and e, shape (3 + 2n, 5).
    columns: Array
    #: C, the derivative of each point's error by the point itself.
    across: complex

    @property
    def error(self) -> Array:
        """e, shape (3 + 2n,)."""
        return self.columns[:, 4]

    def through(self, G: Array) -> Array:
        """Return G ∂e/∂(F_k, F_{k+1}, landmarks) for G of shape (k, 3 + 2n)."""
        found = np.empty((len(G), 3 + G.shape[1]))
        _fill_through(G, G @ self.columns[:, :4], self.across, found)
        return found


@jit_in_place
def _fill_through(G: Array, few: Array, across: complex, found: Array) -> None:
    """Write G J: four columns of J are dense, each other point has the block C."""
    a, b = across.real, across.imag
    for i in range(len(G)):
        found[i, 0], found[i, 1], found[i, 2] = few[i, 0], few[i, 1], few[i, 2]
        found[i, 5] = few[i, 3]
        for row in range(0, G.shape[1] - 1, 2):
            x = row + (row > 0)  # 0, then 3, 5, …
            found[i, 3 + x] = a * G[i, x] + b * G[i, x + 1]
            found[i, 4 + x] = a * G[i, x + 1] - b * G[i, x]


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
    turn = float(wrap_angle(state[2] - start[2] - mean[2]))
    columns = np.zeros((len(state), 5))
    across = _fill(start, state, mean, turn, frame == "invariant", columns)
    return FactorError(columns, across)


@jit_in_place
def _fill(
    start: Array, state: Array, mean: Array, turn: float, invariant: bool, X: Array
) -> complex:
    """Write the columns of a `FactorError` other than 0; return C."""
    turned, ahead = np.exp(-1j * start[2]), np.exp(1j * turn)
    scale, slope = 1.0 + 0.0j, 0.0 + 0.0j
    if invariant:
        scale, slope = inverse_spread_jit(turn)
    across: complex = scale * turned
    X[2, 4], X[2, 2], X[2, 3] = turn, -1.0, 1.0
    for row in range(0, len(state) - 1, 2):
        x = row + (row > 0)  # 0, then 3, 5, …
        seen = turned * complex(state[x] - start[0], state[x + 1] - start[1])
        expected = complex(mean[x], mean[x + 1])
        by_turn = 0.0j
        if invariant:
            expected *= ahead
            by_turn = slope * (seen - expected) - scale * 1j * expected
        found, by_start = scale * (seen - expected), -1j * scale * seen - by_turn
        X[x, 0], X[x, 1], X[x + 1, 0] = -across.real, across.imag, -across.imag
        X[x + 1, 1] = -across.real
        X[x, 2], X[x + 1, 2] = by_start.real, by_start.imag
        X[x, 3], X[x + 1, 3] = by_turn.real, by_turn.imag
        X[x, 4], X[x + 1, 4] = found.real, found.imag
    return across


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


def quadratic(
    found: FactorError, root: Array, information: Array, *, is_first: bool = False
) -> Quadratic:
    """Return the squared error eᵀ P⁻¹ e as a function of the unknowns of the submap.

    The Jacobian is dense in few columns X: those of F_k and of θ_{k+1}.  In the others,
    each point has the 2 × 2 block C on the diagonal.  With their matrix D::

        H = [Xᵀ Λ X  Xᵀ Λ D; ·  Dᵀ Λ D],    Λ X = L⁻ᵀ (L⁻¹ X)

    needs only products with few columns, and 2 × 2 blocks Cᵀ Λ_ij C.

    Parameters
    ----------
    found : FactorError
    root, information : ndarray, shape (3 + 2n, 3 + 2n)
        L⁻¹, where L Lᵀ = P, and Λ = P⁻¹.
    is_first : bool
        Whether F_k is fixed, and no unknown.

    Returns
    -------
    H, g, c
        Upper triangle of H, in c − 2 gᵀ x + xᵀ H x.
    """
    fixed = 0 if is_first else 3
    W = root @ found.columns[:, 3 - fixed :]
    size = fixed + len(W)
    H, g = np.empty((size, size)), np.empty(size)
    _fill_quadratic(information, found.across, root.T @ W, W.T @ W, H, g)
    return H, g, float(W[:, -1] @ W[:, -1])


def gradient(found: FactorError, root: Array, *, is_first: bool = False) -> Array:
    """Return g of `quadratic` alone."""
    response = root.T @ (root @ found.error)
    return -found.through(response[None])[0, 3 * is_first :]


@jit_in_place
def _fill_quadratic(
    information: Array,
    across: complex,
    response: Array,
    product: Array,
    H: Array,
    g: Array,
) -> None:
    """Write the upper triangle of H, and g; see `quadratic`."""
    a, b, many = across.real, across.imag, len(product) - 1
    fixed, last = many - 1, len(information) - 1
    for k in range(many):
        at = k if k < fixed else fixed + 2
        g[at] = -product[k, many]
        for m in range(k, many):
            H[at, m if m < fixed else fixed + 2] = product[k, m]
    for row in range(0, last, 2):
        i = row + (row > 0)  # 0, then 3, 5, …
        u, v = fixed + i, fixed + i + 1
        for k in range(many + 1):
            x, y = response[i, k], response[i + 1, k]
            x, y = a * x + b * y, a * y - b * x
            at = k if k < fixed else fixed + 2
            if k == many:
                g[u], g[v] = -x, -y
            elif at < u:
                H[at, u], H[at, v] = x, y
            else:
                H[u, at], H[v, at] = x, y
        for column in range(row, last, 2):
            j = column + (column > 0)
            p, q = information[i, j], information[i, j + 1]
            r, s = information[i + 1, j], information[i + 1, j + 1]
            p, q, r, s = a * p + b * q, a * q - b * p, a * r + b * s, a * s - b * r
            j += fixed
            H[u, j], H[u, j + 1] = a * p + b * r, a * q + b * s
            H[v, j], H[v, j + 1] = a * r - b * p, a * s - b * q


def retract(mean: Array, error: Array, frame: ErrorFrame) -> Array:
    """Return the state with this error against the mean, shape (3 + 2n,)."""
    if frame == "additive":
        return mean + error
    turn = float(error[2])
    points = np.exp(1j * turn) * points_of(mean)
    points = points + points_of(error) / inverse_spread(turn)[0]
    return state_of(points, float(mean[2]) + turn)


def regularised(P: Array, rows: IntArray) -> Array:
    """Return rows and columns of a covariance, so that they can be solved with.

    The diagonal is increased.
    """
    part = np.empty((len(rows), len(rows)))
    _fill_part(P, rows, part)
    diagonal = np.einsum("ii->i", part)
    diagonal += max(SMALLEST_RATIO**2 * float(diagonal.max()), 1e-18)
    return part


@jit_in_place
def _fill_part(P: Array, rows: IntArray, part: Array) -> None:
    for i in range(len(rows)):
        for j in range(len(rows)):
            part[i, j] = P[rows[i], rows[j]]


# --------------------------------------------------------------------------------------
# Gaussians of a pose and landmarks, with points as complex numbers.
#
# With a point (x, y) as x + iy, the rotation R(θ) is e^{iθ} and J = [0 −1; 1 0] is i.

Complex = ComplexArray


class Gaussian(NamedTuple):
    """Mean of a pose and n landmarks, and the covariance of its additive error."""

    mean: Array  # (x, y, θ, l1x, l1y, …), shape (3 + 2n,)
    covariance: Array  # (3 + 2n, 3 + 2n)
    #: The column of each entry of the mean; None if the order is the same.  With an
    #: order, more rows may follow those of the mean, and there are as many columns.
    order: IntArray | None = None

    def block(self, rows: IntArray, columns: slice = slice(None)) -> Array:
        """Return rows of the covariance, in the order of the mean."""
        if self.order is None:
            return self.covariance[rows, columns]
        return self.covariance[rows].take(self.order[columns], axis=1)

    def add_to(self, rows: Array, first: int) -> None:
        """Add covariance rows from ``first`` on, without columns 0 to 2, to rows."""
        P, order = self.covariance[first:], self.order
        if order is None:
            rows += P[: len(rows), 3 : 3 + rows.shape[1]]
        else:
            _add_columns(P, order[3:], np.empty(P.shape[1]), rows)


@jit_in_place
def _add_columns(matrix: Array, order: IntArray, row: Array, found: Array) -> None:
    for i in range(len(found)):
        for j in range(len(row)):
            row[j] = matrix[i, j]  # reads the memory in order
        for j in range(found.shape[1]):
            found[i, j] += row[order[j]]


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
