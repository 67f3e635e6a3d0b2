"""Kalman gain and covariance update for many readings at once, compiled.

``system`` holds two rows for each reading, from the row FIRST of the workspace on:
:mod:`.scan_rows` lists their columns.  The covariance has room for whole vector
registers (:class:`.belief_arrays.BeliefArrays`), and the rows are up to 4 entries
longer.
"""

import numpy as np

from ...arrays import Array, IntArray
from ...jit import fma, njit_internal
from .scan_rows import CORRECTION, FIRST, INNOVATION, JACOBIAN, ROOT, VARIANCE, WHITE

# Share of a variance below which the remainder counts as rounding.
SINGULAR = 1e-14

# Above this size of the state, one pass over P costs more than a triangular solve.
LARGE = 250
BLOCK = 6  # readings absorbed at a time below it


@njit_internal
def block_of(size: int, readings: int) -> int:
    """Return how many readings to absorb at a time: few while P fits the caches."""
    return BLOCK if size <= LARGE else max(readings, 1)


@njit_internal
def absorb(
    covariance: Array,
    size: int,
    rows: Array,
    columns: IntArray,
    top: int,
    bottom: int,
    block: int,
) -> int:
    """Condition P on m simultaneous readings, and find the correction of the state.

    ::

        S = H P Hᵀ + Q = L Lᵀ,   A = L⁻¹ H P,   w = L⁻¹ ν
        δ = Aᵀ w,   P ← P − Aᵀ A,   NIS = wᵀ w

    All readings have one linearisation, so that their order does not matter.  P is
    downdated after each block of a few readings, which spares a small map most of the
    triangular solve.  With a single block P changes at the very end, which spares a
    large map the many passes over P.

    Parameters
    ----------
    covariance, size
        P.
    rows
        The workspace.  Read are, from row ``top`` to ``bottom`` of its system, JACOBIAN
        (H), VARIANCE (the diagonal of Q) and INNOVATION (ν).  Written are A, ROOT (the
        diagonal blocks of L), WHITE (w), and δ in the row CORRECTION.  Two rows below
        ``bottom`` are overwritten.
    columns
        For each reading in use, its landmark's first column in P.
    top, bottom
        Rows of the system, counted from FIRST.
    block
        How many readings to absorb at a time.

    Returns
    -------
    int
        -1: the lower half of P is right, and :func:`mirror` is to restore the upper.
        Or the first row at which S is not positive definite: P is then spoilt, unless
        that row lies in the first block.
    """
    system, delta = rows[FIRST:], rows[CORRECTION]
    for j in range(_whole(size)):
        delta[j] = system[bottom, j] = system[bottom + 1, j] = 0.0
    for first in range(top, bottom, 2 * block):
        last = min(first + 2 * block, bottom)
        if first > top:
            _refresh_for(covariance, size, columns[first // 2 : last // 2])
        for row in range(first, last, 2):
            c, below = columns[row // 2], row + 1
            _correlate(covariance, size, system, row, c)
            least = SINGULAR * _own_variance(system, row, c)
            least_below = SINGULAR * _own_variance(system, below, c)
            for before in range(first, row, 2):
                _orthogonalise(size, system, row, before, c)
            if not _normalise(size, system, delta, row, c, least, least_below):
                return row
        downdate(covariance, size, system, first, last)
    return -1


@njit_internal
def times(system: Array, row: int, c: int, vector: Array) -> float:
    """Multiply a row of H, whose landmark is in columns c and c + 1, by a vector."""
    h = system[row, JACOBIAN : JACOBIAN + 5]
    product = h[0] * vector[0] + h[1] * vector[1]
    product += h[2] * vector[2]
    return float(product + h[3] * vector[c] + h[4] * vector[c + 1])


@njit_internal
def _own_variance(system: Array, row: int, c: int) -> float:
    """Return the diagonal entry of H P Hᵀ + Q, with H P in the row of A."""
    variance: float = times(system, row, c, system[row]) + system[row, VARIANCE]
    return variance


@njit_internal
def _whole(size: int) -> int:
    """Round up to a multiple of 8: whole vector registers, no scalar remainder."""
    return (size + 7) & -8


@njit_internal
def _correlate(covariance: Array, size: int, system: Array, row: int, c: int) -> None:
    """Fill the two rows of one reading in A with H P."""
    P, below = covariance, row + 1
    a = system[row, JACOBIAN : JACOBIAN + 5]
    b = system[below, JACOBIAN : JACOBIAN + 5]
    a0, a1, a2, a3, a4 = a[0], a[1], a[2], a[3], a[4]
    b0, b1, b2, b3, b4 = b[0], b[1], b[2], b[3], b[4]
    for j in range((size + 3) & -4):
        p0, p1, p2, p3, p4 = P[0, j], P[1, j], P[2, j], P[c, j], P[c + 1, j]
        upper = fma(a4, p4, fma(a3, p3, fma(a2, p2, fma(a1, p1, a0 * p0))))
        lower = fma(b4, p4, fma(b3, p3, fma(b2, p2, fma(b1, p1, b0 * p0))))
        system[row, j], system[below, j] = upper, lower


@njit_internal
def _orthogonalise(size: int, system: Array, row: int, before: int, c: int) -> None:
    """Subtract from the rows of a reading in A their part along two finished rows.

    The factors are the reading's entries of L in the columns of those rows.
    """
    A, below = system, row + 1
    l00, l01 = times(A, row, c, A[before]), times(A, row, c, A[before + 1])
    l10, l11 = times(A, below, c, A[before]), times(A, below, c, A[before + 1])
    for j in range(_whole(size)):
        a0, a1 = A[before, j], A[before + 1, j]
        A[row, j] = fma(-l01, a1, fma(-l00, a0, A[row, j]))
        A[below, j] = fma(-l11, a1, fma(-l10, a0, A[below, j]))


@njit_internal
def _normalise(
    size: int,
    system: Array,
    delta: Array,
    row: int,
    c: int,
    least: float,
    least_below: float,
) -> bool:
    """Divide the rows of a reading in A by the Cholesky factor of its block of S.

    The block is what the readings before leave of S.  The function returns false where
    only rounding is left.  It whitens ν likewise and adds its share to δ.
    """
    A, below = system, row + 1
    s00 = _own_variance(A, row, c)
    s10 = times(A, below, c, A[row])
    s11 = _own_variance(A, below, c)
    if not s00 > least:
        return False
    l00 = np.sqrt(s00)
    l10 = s10 / l00
    rest = s11 - l10 * l10
    if not rest > least_below:
        return False
    l11 = np.sqrt(rest)
    A[row, ROOT], A[row, ROOT + 1] = l00, 0.0
    A[below, ROOT], A[below, ROOT + 1] = l10, l11
    inverse0, inverse1 = 1 / l00, 1 / l11
    w0 = (A[row, INNOVATION] - times(A, row, c, delta)) * inverse0
    w1 = A[below, INNOVATION] - times(A, below, c, delta)
    w1 = (w1 - l10 * w0) * inverse1
    A[row, WHITE], A[below, WHITE] = w0, w1
    for j in range(_whole(size)):
        a0 = A[row, j] * inverse0
        a1 = fma(-l10, a0, A[below, j]) * inverse1
        A[row, j], A[below, j] = a0, a1
        delta[j] = fma(w1, a1, fma(w0, a0, delta[j]))
    return True


@njit_internal
def downdate(
    covariance: Array, size: int, system: Array, first: int, last: int
) -> None:
    """P ← P − Aᵀ A with rows ``first`` to ``last`` of A; lower half of P only.

    The loop takes four rows of P and four of A at a time, which fills the registers of
    a processor.  Where ``last`` ends a group of two, the next two rows of A must be
    zero.
    """
    A, P = system, covariance
    one, two, three, four = np.uint64(1), np.uint64(2), np.uint64(3), np.uint64(4)
    end = np.uint64((size + 3) & -4)  # unsigned, so that no index counts from the end
    for i in range(np.uint64(0), end, four):
        i1, i2, i3 = i + one, i + two, i + three
        width = (i + np.uint64(11)) & ~np.uint64(7)  # whole registers: rather too much
        width = min(width, end & ~np.uint64(7))
        for k in range(np.uint64(first), np.uint64(last), four):
            k1, k2, k3 = k + one, k + two, k + three
            b0, b1, b2, b3 = -A[k, i], -A[k1, i], -A[k2, i], -A[k3, i]
            c0, c1, c2, c3 = -A[k, i1], -A[k1, i1], -A[k2, i1], -A[k3, i1]
            d0, d1, d2, d3 = -A[k, i2], -A[k1, i2], -A[k2, i2], -A[k3, i2]
            e0, e1, e2, e3 = -A[k, i3], -A[k1, i3], -A[k2, i3], -A[k3, i3]
            for j in range(width):
                a0, a1, a2, a3 = A[k, j], A[k1, j], A[k2, j], A[k3, j]
                p, q, r, s = P[i, j], P[i1, j], P[i2, j], P[i3, j]
                P[i, j] = fma(b3, a3, fma(b2, a2, fma(b1, a1, fma(b0, a0, p))))
                P[i1, j] = fma(c3, a3, fma(c2, a2, fma(c1, a1, fma(c0, a0, q))))
                P[i2, j] = fma(d3, a3, fma(d2, a2, fma(d1, a1, fma(d0, a0, r))))
                P[i3, j] = fma(e3, a3, fma(e2, a2, fma(e1, a1, fma(e0, a0, s))))
    for i in range(end & ~np.uint64(7), end):  # the last corner
        for j in range(end & ~np.uint64(7), i + one):
            rest = P[i, j]
            for k in range(np.uint64(first), np.uint64(last)):
                rest = fma(-A[k, i], A[k, j], rest)
            P[i, j] = rest


@njit_internal
def _refresh_for(covariance: Array, size: int, columns: IntArray) -> None:
    """Complete the rows of P that the next readings look at."""
    for pose in range(0, 4, 2):
        _refresh(covariance, size, pose)
    for column in columns:
        _refresh(covariance, size, column)


@njit_internal
def _refresh(covariance: Array, size: int, row: int) -> None:
    """Copy two columns of the lower half into their rows."""
    covariance[row, row + 1] = covariance[row + 1, row]
    for j in range(row + 2, size):
        covariance[row, j] = covariance[j, row]
        covariance[row + 1, j] = covariance[j, row + 1]


@njit_internal
def mirror(covariance: Array, size: int) -> None:
    """Copy the lower half into the upper, in tiles of 4 × 4."""
    for i in range(0, size, 4):
        for j in range(0, i, 4):
            for a in range(i, i + 4):
                for b in range(j, j + 4):
                    covariance[b, a] = covariance[a, b]
        for a in range(i + 1, i + 4):
            for b in range(i, a):
                covariance[b, a] = covariance[a, b]
