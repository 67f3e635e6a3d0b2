"""Repair what rounding does to a covariance that was computed as T P Tᵀ."""

import numpy as np

from ...arrays import Array

__all__ = ["as_covariance"]


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
