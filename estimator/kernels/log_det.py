"""Log determinants of covariances, compiled."""

import math

from ...arrays import Array
from ...jit import njit_internal


@njit_internal
def half_log_det(P: Array, L: Array) -> float:
    """Compute ½ log det P by its Cholesky factor; -inf if not positive definite.

    On return the lower half of ``L``, which has room for it, holds the factor, with
    reciprocals on the diagonal.
    """
    result = 0.0
    for i in range(len(P)):
        for j in range(i):
            entry = P[i, j]
            for k in range(j):
                entry -= L[i, k] * L[j, k]
            L[i, j] = entry * L[j, j]
        pivot = P[i, i]
        for k in range(i):
            pivot -= L[i, k] * L[i, k]
        if not pivot > 0.0:
            return -math.inf
        result += 0.5 * math.log(pivot)
        L[i, i] = 1.0 / math.sqrt(pivot)
    return result


@njit_internal
def largest_variance(covariance: Array, x: int) -> float:
    """Compute the larger eigenvalue of the block at columns x and x + 1."""
    xx, yy = covariance[x, x], covariance[x + 1, x + 1]
    across = math.hypot(0.5 * (xx - yy), covariance[x, x + 1])
    return float(0.5 * (xx + yy) + across)
