"""Condition a covariance on many readings at once, compiled: the heart of the update.

Works on ``covariance`` (capacity, capacity), of which the first ``size`` rows and
columns are in use and the others zero, and on the rows of :mod:`.workspace`.
``capacity`` is a multiple of 4 above ``size``, and the rows are longer by up to 4, so
that loops may run over whole vector registers.
"""

import numpy as np

from ..support.fma import fma
from ..support.jit import part
from .predict import Array
from .scan_rows import COLUMN, INNOVATION, JACOBIAN, ROOT, SHIFT, VARIANCE, WHITE

# Share of a variance below which what is left of it counts as rounding.
SINGULAR = 1e-14

# Above this size of the state, one pass over P costs more than a triangular solve.
LARGE = 250
BLOCK = 6  # readings absorbed at a time below it


@part
def block_of(size: int, readings: int) -> int:
    """How many readings to absorb at a time: a few while P fits the fast caches."""
    return BLOCK if size <= LARGE else max(readings, 1)


@part
def absorb(
    covariance: Array, size: int, rows: Array, top: int, bottom: int, block: int
) -> int:
    """Condition P on m simultaneous readings, and find the correction of the state.

    ::

        S = H P Hᵀ + Q = L Lᵀ,   A = L⁻¹ H P,   w = L⁻¹ ν
        δ = Aᵀ w,   P ← P − Aᵀ A,   NIS = wᵀ w

    all at one linearisation, so that the order of the readings does not matter.  A few
    readings at a time, ``block``: P is downdated after each block, which spares a small
    map most of the triangular solve; with one block P changes at the very end, which
    spares a large map the many passes over P.

    Parameters
    ----------
    covariance, size
        P.
    rows
        The stacked system from row ``top`` to ``bottom``: given the columns COLUMN,
        JACOBIAN (H), VARIANCE (the diagonal of Q) and INNOVATION (ν); found are A,
        ROOT (the diagonal blocks of L), WHITE (w), and δ in the row SHIFT.  Two rows
        below ``bottom`` are overwritten.

    Returns
    -------
    int
        -1, with the lower half of P right and the upper for :func:`mirror` to restore,
        or the first row at which S is not positive definite; P is then spoilt if that
        is not in the first block.
    """
    for j in range(_whole(size)):
        rows[SHIFT, j] = rows[bottom, j] = rows[bottom + 1, j] = 0.0
    for first in range(top, bottom, 2 * block):
        last = min(first + 2 * block, bottom)
        if first > top:
            _refresh_for(covariance, size, rows, first, last)
        for row in range(first, last, 2):
            _correlate(covariance, size, rows, row)
            least = SINGULAR * (times(rows, row, row) + rows[row, VARIANCE])
            below = row + 1
            least_below = SINGULAR * (times(rows, below, below) + rows[below, VARIANCE])
            for before in range(first, row, 2):
                _orthogonalise(size, rows, row, before)
            if not _normalise(size, rows, row, least, least_below):
                return row
        downdate(covariance, size, rows, first, last)
    return -1


@part
def times(rows: Array, i: int, row: int) -> float:
    """Row ``i`` of H times another row over the whole state, of A or such."""
    c = int(rows[i, COLUMN])
    pose = rows[i, JACOBIAN] * rows[row, 0] + rows[i, JACOBIAN + 1] * rows[row, 1]
    pose += rows[i, JACOBIAN + 2] * rows[row, 2]
    x, y = rows[i, JACOBIAN + 3], rows[i, JACOBIAN + 4]
    product: float = pose + x * rows[row, c] + y * rows[row, c + 1]
    return product


@part
def _whole(size: int) -> int:
    """Next multiple of 8: whole vector registers, no scalar remainder."""
    return (size + 7) & -8


@part
def _correlate(covariance: Array, size: int, rows: Array, row: int) -> None:
    """Fill the two rows of one reading in A with H P."""
    c, below = int(rows[row, COLUMN]), row + 1
    a0, a1, a2 = rows[row, JACOBIAN], rows[row, JACOBIAN + 1], rows[row, JACOBIAN + 2]
    b0, b1 = rows[below, JACOBIAN], rows[below, JACOBIAN + 1]
    b2 = rows[below, JACOBIAN + 2]
    a3, a4 = rows[row, JACOBIAN + 3], rows[row, JACOBIAN + 4]
    b3, b4 = rows[below, JACOBIAN + 3], rows[below, JACOBIAN + 4]
    for j in range((size + 3) & -4):
        p0, p1, p2 = covariance[0, j], covariance[1, j], covariance[2, j]
        p3, p4 = covariance[c, j], covariance[c + 1, j]
        a = fma(a4, p4, fma(a3, p3, fma(a2, p2, fma(a1, p1, a0 * p0))))
        b = fma(b4, p4, fma(b3, p3, fma(b2, p2, fma(b1, p1, b0 * p0))))
        rows[row, j], rows[below, j] = a, b


@part
def _orthogonalise(size: int, rows: Array, row: int, before: int) -> None:
    """Subtract from the rows of a reading their part along two finished rows."""
    below = row + 1
    l00, l01 = times(rows, row, before), times(rows, row, before + 1)
    l10, l11 = times(rows, below, before), times(rows, below, before + 1)
    for j in range(_whole(size)):
        a0, a1 = rows[before, j], rows[before + 1, j]
        rows[row, j] = fma(-l01, a1, fma(-l00, a0, rows[row, j]))
        rows[below, j] = fma(-l11, a1, fma(-l10, a0, rows[below, j]))


@part
def _normalise(
    size: int, rows: Array, row: int, least: float, least_below: float
) -> bool:
    """Divide the rows of a reading by the square root of their own 2 × 2 part of S.

    Of what the readings before leave of S; false where nothing but rounding is left.
    Whiten likewise what they leave of ν, and add its share to δ.
    """
    below = row + 1
    s00 = times(rows, row, row) + rows[row, VARIANCE]
    s10 = times(rows, below, row)
    s11 = times(rows, below, below) + rows[below, VARIANCE]
    if not s00 > least:
        return False
    l00 = np.sqrt(s00)
    l10 = s10 / l00
    rest = s11 - l10 * l10
    if not rest > least_below:
        return False
    l11 = np.sqrt(rest)
    rows[row, ROOT], rows[row, ROOT + 1] = l00, 0.0
    rows[below, ROOT], rows[below, ROOT + 1] = l10, l11
    inverse0, inverse1 = 1 / l00, 1 / l11
    w0 = (rows[row, INNOVATION] - times(rows, row, SHIFT)) * inverse0
    w1 = rows[below, INNOVATION] - times(rows, below, SHIFT)
    w1 = (w1 - l10 * w0) * inverse1
    rows[row, WHITE], rows[below, WHITE] = w0, w1
    for j in range(_whole(size)):
        a0 = rows[row, j] * inverse0
        a1 = fma(-l10, a0, rows[below, j]) * inverse1
        rows[row, j], rows[below, j] = a0, a1
        rows[SHIFT, j] = fma(w1, a1, fma(w0, a0, rows[SHIFT, j]))
    return True


@part
def downdate(covariance: Array, size: int, rows: Array, first: int, last: int) -> None:
    """P ← P − Aᵀ A with rows ``first`` to ``last`` of A, of P the lower half only.

    Four rows of P at a time against four of A: what keeps the registers of a processor
    busy.  Where ``last`` ends a group of two, the next two rows of A must be zero.
    """
    one, two, three, four = np.uint64(1), np.uint64(2), np.uint64(3), np.uint64(4)
    end = np.uint64((size + 3) & -4)  # unsigned, so that no index counts from the end
    for i in range(np.uint64(0), end, four):
        i1, i2, i3 = i + one, i + two, i + three
        width = (i + np.uint64(11)) & ~np.uint64(7)  # whole registers: rather too much
        width = min(width, end & ~np.uint64(7))
        for k in range(np.uint64(first), np.uint64(last), four):
            k1, k2, k3 = k + one, k + two, k + three
            b0, b1, b2, b3 = -rows[k, i], -rows[k1, i], -rows[k2, i], -rows[k3, i]
            c0, c1, c2, c3 = -rows[k, i1], -rows[k1, i1], -rows[k2, i1], -rows[k3, i1]
            d0, d1, d2, d3 = -rows[k, i2], -rows[k1, i2], -rows[k2, i2], -rows[k3, i2]
            e0, e1, e2, e3 = -rows[k, i3], -rows[k1, i3], -rows[k2, i3], -rows[k3, i3]
            for j in range(width):
                a0, a1, a2, a3 = rows[k, j], rows[k1, j], rows[k2, j], rows[k3, j]
                p, q = covariance[i, j], covariance[i1, j]
                r, s = covariance[i2, j], covariance[i3, j]
                covariance[i, j] = fma(b3, a3, fma(b2, a2, fma(b1, a1, fma(b0, a0, p))))
                covariance[i1, j] = fma(
                    c3, a3, fma(c2, a2, fma(c1, a1, fma(c0, a0, q)))
                )
                covariance[i2, j] = fma(
                    d3, a3, fma(d2, a2, fma(d1, a1, fma(d0, a0, r)))
                )
                covariance[i3, j] = fma(
                    e3, a3, fma(e2, a2, fma(e1, a1, fma(e0, a0, s)))
                )
    for i in range(end & ~np.uint64(7), end):  # the last corner
        for j in range(end & ~np.uint64(7), i + one):
            rest = covariance[i, j]
            for k in range(np.uint64(first), np.uint64(last)):
                rest = fma(-rows[k, i], rows[k, j], rest)
            covariance[i, j] = rest


@part
def _refresh_for(
    covariance: Array, size: int, rows: Array, first: int, last: int
) -> None:
    """Complete the rows of P that the readings of some rows look at."""
    for pose in range(0, 4, 2):
        _refresh(covariance, size, pose)
    for row in range(first, last, 2):
        _refresh(covariance, size, int(rows[row, COLUMN]))


@part
def _refresh(covariance: Array, size: int, row: int) -> None:
    """Copy two columns of the lower half into their rows."""
    covariance[row, row + 1] = covariance[row + 1, row]
    for j in range(row + 2, size):
        covariance[row, j] = covariance[j, row]
        covariance[row + 1, j] = covariance[j, row + 1]


@part
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
