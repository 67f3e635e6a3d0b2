"""Products and roots of matrices (3, 3), compiled: faster than those of numpy.

The arguments are C-contiguous, since a kernel is compiled anew for every other layout.
"""

import numpy as np

from ...arrays import Array
from ...jit import njit_internal


@njit_internal
def multiply(a: Array, b: Array, out: Array) -> None:
    """Write the product of two matrices (3, 3)."""
    for i in range(3):
        for j in range(3):
            out[i, j] = a[i, 0] * b[0, j] + a[i, 1] * b[1, j] + a[i, 2] * b[2, j]


@njit_internal
def left_transposed(a: Array, b: Array, out: Array) -> None:
    """Write aᵀ b of two matrices (3, 3)."""
    for i in range(3):
        for j in range(3):
            out[i, j] = a[0, i] * b[0, j] + a[1, i] * b[1, j] + a[2, i] * b[2, j]


@njit_internal
def right_transposed(a: Array, b: Array, out: Array) -> None:
    """Write a bᵀ of two matrices (3, 3)."""
    for i in range(3):
        for j in range(3):
            out[i, j] = a[i, 0] * b[j, 0] + a[i, 1] * b[j, 1] + a[i, 2] * b[j, 2]


@njit_internal
def transposed_times(a: Array, b: Array, out: Array) -> None:
    """Write aᵀ b of a matrix (3, 3) and a vector."""
    for i in range(3):
        out[i] = a[0, i] * b[0] + a[1, i] * b[1] + a[2, i] * b[2]


@njit_internal
def complement(a: Array) -> None:
    """Replace a matrix (3, 3) by I − a."""
    for i in range(3):
        for j in range(3):
            a[i, j] = (1.0 if i == j else 0.0) - a[i, j]


@njit_internal
def inverse_root(M: Array, inverse: Array) -> None:
    """Write L⁻¹ of M = L Lᵀ, both (3, 3), lower triangular."""
    l00 = np.sqrt(M[0, 0])
    l10, l20 = M[1, 0] / l00, M[2, 0] / l00
    l11 = np.sqrt(M[1, 1] - l10 * l10)
    l21 = (M[2, 1] - l20 * l10) / l11
    l22 = np.sqrt(M[2, 2] - l20 * l20 - l21 * l21)
    inverse[0, 0], inverse[1, 1], inverse[2, 2] = 1 / l00, 1 / l11, 1 / l22
    inverse[1, 0] = -l10 / l00 / l11
    inverse[2, 1] = -l21 / l11 / l22
    inverse[2, 0] = -(l20 * inverse[0, 0] + l21 * inverse[1, 0]) / l22
    inverse[0, 1] = inverse[0, 2] = inverse[1, 2] = 0.0
