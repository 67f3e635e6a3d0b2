"""Log determinants and largest variances of covariances, compiled."""

import math

from ...arrays import Array
from ...jit import njit_inlined, njit_internal


@njit_internal
def half_log_det(P: Array, L: Array) -> float:
    """Compute ½ log det P by its Cholesky factor; -inf if not positive definite.

    P has an even size, as landmarks have. On return the lower half of ``L``, which has
    room for it, holds the factor, with reciprocals on the diagonal. The entries are
    found in blocks of 2 × 2, whose four sums a processor computes at once.
    """
    result = 0.0
    for i in range(0, len(P), 2):
        for j in range(0, i, 2):
            _factor_block(P, L, i, j)
        product = _factor_diagonal_block(P, L, i)
        if not product > 0.0:
            return -math.inf
        result += 0.5 * math.log(product)
    return result


@njit_inlined
def _factor_block(P: Array, L: Array, i: int, j: int) -> None:
    """Find rows i, i + 1 and columns j, j + 1 of the factor, left of its diagonal."""
    a, b, c, d = P[i, j], P[i, j + 1], P[i + 1, j], P[i + 1, j + 1]
    for k in range(j):
        upper, lower, left, right = L[i, k], L[i + 1, k], L[j, k], L[j + 1, k]
        a -= upper * left
        b -= upper * right
        c -= lower * left
        d -= lower * right
    a, c = a * L[j, j], c * L[j, j]
    L[i, j], L[i + 1, j] = a, c
    L[i, j + 1] = (b - a * L[j + 1, j]) * L[j + 1, j + 1]
    L[i + 1, j + 1] = (d - c * L[j + 1, j]) * L[j + 1, j + 1]


@njit_inlined
def _factor_diagonal_block(P: Array, L: Array, i: int) -> float:
    """Find the factor of the block at row i; return its determinant, 0 on failure."""
    a, b, c = P[i, i], P[i + 1, i], P[i + 1, i + 1]
    for k in range(i):
        upper, lower = L[i, k], L[i + 1, k]
        a -= upper * upper
        b -= lower * upper
        c -= lower * lower
    if not a > 0.0:
        return 0.0
    L[i, i] = 1.0 / math.sqrt(a)
    L[i + 1, i] = b * L[i, i]
    c -= L[i + 1, i] * L[i + 1, i]
    if not c > 0.0:
        return 0.0
    L[i + 1, i + 1] = 1.0 / math.sqrt(c)
    return float(a * c)


@njit_internal
def largest_variance(covariance: Array, x: int) -> float:
    """Compute the larger eigenvalue of the block at columns x and x + 1."""
    xx, yy = covariance[x, x], covariance[x + 1, x + 1]
    apart, xy = 0.5 * (xx - yy), covariance[x, x + 1]
    return float(0.5 * (xx + yy) + math.sqrt(apart * apart + xy * xy))
