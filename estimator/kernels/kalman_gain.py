"""Kalman gain and update of mean and covariance, for many readings at once, compiled.

`absorb` computes gain and covariance, and `compose` the state. ``system`` holds two
rows for each reading, from the row FIRST of the workspace on. `Workspace` and the
constants above it describe them.  The covariance has room for whole vector registers
(`BeliefArrays`), and the rows are up to 4 entries longer.
"""

import math
from typing import NamedTuple

import numpy as np

from ...arrays import Array, IntArray
from ...jit import fma, njit_apart, njit_inlined, njit_internal
from ..guards.argument_checks import aligned_zeros
from ..models.rigid_motion import turn_coefficients_jit

# Share of a variance below which the remainder counts as rounding.
SINGULAR = 1e-14

# Above this size of the state, one pass over P costs more than a triangular solve.
LARGE = 250
BLOCK = 6  # readings absorbed at a time below it


@njit_internal
def absorb(
    covariance: Array, size: int, rows: Array, columns: IntArray, used: int, block: int
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
        The workspace.  Read are, from its first system, JACOBIAN (H), VARIANCE (the
        diagonal of Q) and INNOVATION (ν).  Written are A, ROOT (the diagonal blocks of
        L), WHITE (w), and δ in the row CORRECTION.  Two rows below are overwritten.
    columns
        For each reading in use, its landmark's first column in P.
    used
        Number of readings in use.
    block
        How many readings to absorb at a time.

    Returns
    -------
    int
        -1 on success: the lower half of P is right, and :func:`restore_upper` completes
        P.  Otherwise the first row at which S is not positive definite: P is then
        invalid, unless that row lies in the first block.
    """
    system, bottom = rows[FIRST:], 2 * used
    begin_correction(size, rows, system, bottom)
    for first in range(0, bottom, 2 * block):
        last = min(first + 2 * block, bottom)
        if first > 0:
            refresh_pose(covariance, size)
            for column in columns[first // 2 : last // 2]:
                refresh(covariance, size, column)
        for row in range(first, last, 2):
            c = columns[row // 2]
            if not whiten(covariance, size, rows, system, first, row, c):
                return row
        downdate(covariance, size, system, first, last)
    return -1


@njit_internal
def begin_correction(size: int, rows: Array, system: Array, bottom: int) -> None:
    """Set δ to zero, and the two rows below the system, as :func:`downdate` asks."""
    delta = rows[CORRECTION]
    for j in range(_whole(size)):
        delta[j] = system[bottom, j] = system[bottom + 1, j] = 0.0


@njit_internal
def whiten(
    covariance: Array,
    size: int,
    rows: Array,
    system: Array,
    first: int,
    row: int,
    c: int,
) -> bool:
    """Fill A, L and w of the reading in ``row`` and the next, and add its share to δ.

    The rows of A from ``first`` on are finished, and P does not contain them yet.
    The function returns false where S is not positive definite; P stays as it is.
    """
    pair = system[row : row + 2]
    _correlate(covariance, size, pair, c)
    least = SINGULAR * _own_variance(pair, 0, c)
    least_below = SINGULAR * _own_variance(pair, 1, c)
    for before in range(first, row, 2):
        _orthogonalise(size, pair, system[before : before + 2], c)
    return _normalise(size, pair, rows[CORRECTION], c, least, least_below)


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


@njit_apart
def _correlate(covariance: Array, size: int, pair: Array, c: int) -> None:
    """Fill the two rows of one reading in A with H P."""
    P = covariance
    a, b = pair[0, JACOBIAN : JACOBIAN + 5], pair[1, JACOBIAN : JACOBIAN + 5]
    a0, a1, a2, a3, a4 = a[0], a[1], a[2], a[3], a[4]
    b0, b1, b2, b3, b4 = b[0], b[1], b[2], b[3], b[4]
    for j in range((size + 3) & -4):
        p0, p1, p2, p3, p4 = P[0, j], P[1, j], P[2, j], P[c, j], P[c + 1, j]
        upper = fma(a4, p4, fma(a3, p3, fma(a2, p2, fma(a1, p1, a0 * p0))))
        lower = fma(b4, p4, fma(b3, p3, fma(b2, p2, fma(b1, p1, b0 * p0))))
        pair[0, j], pair[1, j] = upper, lower


@njit_apart
def _orthogonalise(size: int, pair: Array, done: Array, c: int) -> None:
    """Subtract from the rows of a reading in A their part along two finished rows.

    The factors are the reading's entries of L in the columns of those rows.
    """
    l00, l01 = times(pair, 0, c, done[0]), times(pair, 0, c, done[1])
    l10, l11 = times(pair, 1, c, done[0]), times(pair, 1, c, done[1])
    for j in range(_whole(size)):
        a0, a1 = done[0, j], done[1, j]
        pair[0, j] = fma(-l01, a1, fma(-l00, a0, pair[0, j]))
        pair[1, j] = fma(-l11, a1, fma(-l10, a0, pair[1, j]))


@njit_apart
def _normalise(
    size: int, pair: Array, delta: Array, c: int, least: float, least_below: float
) -> bool:
    """Divide the rows of a reading in A by the Cholesky factor of its block of S.

    The block is what the readings before leave of S.  The function returns false where
    only rounding is left.  It whitens ν likewise and adds its share to δ.
    """
    s00 = _own_variance(pair, 0, c)
    s10 = times(pair, 1, c, pair[0])
    s11 = _own_variance(pair, 1, c)
    if not s00 > least:
        return False
    l00 = np.sqrt(s00)
    l10 = s10 / l00
    rest = s11 - l10 * l10
    if not rest > least_below:
        return False
    l11 = np.sqrt(rest)
    pair[0, ROOT], pair[0, ROOT + 1] = l00, 0.0
    pair[1, ROOT], pair[1, ROOT + 1] = l10, l11
    inverse0, inverse1 = 1 / l00, 1 / l11
    w0 = (pair[0, INNOVATION] - times(pair, 0, c, delta)) * inverse0
    w1 = pair[1, INNOVATION] - times(pair, 1, c, delta)
    w1 = (w1 - l10 * w0) * inverse1
    pair[0, WHITE], pair[1, WHITE] = w0, w1
    for j in range(_whole(size)):
        a0 = pair[0, j] * inverse0
        a1 = fma(-l10, a0, pair[1, j]) * inverse1
        pair[0, j], pair[1, j] = a0, a1
        delta[j] = fma(w1, a1, fma(w0, a0, delta[j]))
    return True


@njit_apart
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
def refresh_pose(covariance: Array, size: int) -> None:
    """Complete the rows of the pose, and the row below them."""
    for row in range(0, 4, 2):
        refresh(covariance, size, row)


@njit_internal
def refresh(covariance: Array, size: int, row: int) -> None:
    """Copy two columns of the lower half into their rows."""
    covariance[row, row + 1] = covariance[row + 1, row]
    for j in range(row + 2, size):
        covariance[row, j] = covariance[j, row]
        covariance[row + 1, j] = covariance[j, row + 1]


@njit_internal
def restore_upper(covariance: Array, size: int) -> None:
    """Copy the lower half into the upper; if P is large, into the rows of the pose."""
    if size <= LARGE:
        mirror(covariance, size)
    else:
        refresh_pose(covariance, size)


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


# --------------------------------------------------------------------------------------
# The correction of the state: δ is composed with the mean, and P follows.


@njit_internal
def compose(mean: Array, base: Array, rows: Array, size: int, frame: int) -> None:
    """Compose the correction δ with the state ``base``, by the error frame."""
    if frame == INVARIANT:
        retract(mean, base, rows, size)
        return
    for j in range(size):
        mean[j] = base[j] + rows[CORRECTION, j]


@njit_internal
def retract(mean: Array, base: Array, rows: Array, size: int) -> None:
    """Compose an invariant correction δ with a state, in place of adding it.

    With t = δθ and every point q, the robot's position and each landmark::

        q⁺ = R(t) q + V(t) (δq − t J q⁻),    θ⁺ = θ + t

    with R, V and J of :mod:`..models.rigid_motion`, and q⁻ of the prior mean, whose
    coordinates δ has.  The row TRANSPORT becomes v = J (q⁺ − q⁻), 0 at θ, for
    :func:`transport`.
    """
    delta, prior, v = rows[CORRECTION], rows[MEAN_BEFORE], rows[TRANSPORT]
    turned = turn_coefficients_jit(delta[2])
    for i in range(-1, size // 2 - 1):
        c = 3 + 2 * i if i >= 0 else 0  # the pose first, then the landmarks
        retract_point(mean, base, prior, delta, turned, c)
        v[c], v[c + 1] = prior[c + 1] - mean[c + 1], mean[c] - prior[c]
    mean[2] = base[2] + delta[2]
    v[2] = 0.0


@njit_internal
def retract_point(
    mean: Array,
    base: Array,
    prior: Array,
    delta: Array,
    turned: tuple[float, float, float, float],
    c: int,
) -> None:
    """Retract the point in columns c and c + 1."""
    cos, sin, even, odd = turned
    x, y, t = base[c], base[c + 1], delta[2]
    ux, uy = delta[c] + t * prior[c + 1], delta[c + 1] - t * prior[c]
    mean[c] = cos * x - sin * y + even * ux - odd * uy
    mean[c + 1] = sin * x + cos * y + odd * ux + even * uy


@njit_internal
def transport(covariance: Array, rows: Array, size: int) -> None:
    """P ← T P Tᵀ with T = I + v e_θᵀ and v in the row TRANSPORT; lower half only.

    P is constant in invariant coordinates; T reads it at the corrected estimate.  The
    row HEADING is overwritten with c = P[:, θ].
    """
    v, c = rows[TRANSPORT], rows[HEADING]
    for j in range(size):
        c[j] = covariance[2, j] if j < 2 else covariance[j, 2]
    variance = c[2]
    for i in range(size):
        v_i = v[i]
        rest = c[i] + variance * v_i
        for j in range(i + 1):
            moved = fma(v_i, c[j], covariance[i, j])
            covariance[i, j] = fma(rest, v[j], moved)


# --------------------------------------------------------------------------------------
# Log determinants of covariances, compiled.


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


# --------------------------------------------------------------------------------------
# Rules of an update: what distinguishes one filter of the family from another.

# Where Jacobians are taken.
AT_ESTIMATE = 0
AT_REFERENCE = 1  # at fixed points kept beside the estimate
PROJECTED = 2  # at the estimate, then made blind to a rotation of the whole map
AT_TRUTH = 3  # at the ground truth, for study

# Error frame: how a correction is composed with the state.
ADDITIVE = 0
INVARIANT = 1


class Rules(NamedTuple):
    """What distinguishes one filter's update from another's; plain numbers."""

    linearisation: int = AT_ESTIMATE
    frame: int = ADDITIVE
    iterations: int = 1  # most linearisations of a reading
    adaptive: bool = False  # linearise again only where a reading asks for it
    correlated: bool = True  # a new landmark with the pose it was seen from
    first_std: float = 0.0  # and the next: the four numbers of the sensor's `std`
    second_std: float = 0.0
    std_per_metre: float = 0.0
    std_metres: float = 0.0
    min_range: float = 1e-3  # [m]
    gate: float = np.inf  # largest NIS of one reading
    noise_as_read: bool = False  # take noise at the range as read, not as expected
    numbers: int = 2  # that a reading has; of one, the second row is void


ITERATIONS = Rules._fields.index("iterations")
#: Column of the first of the four standard deviations of a reading in the rules.
FIRST_STD = Rules._fields.index("first_std")
AFTER_STDS = Rules._fields.index("min_range")
NUMBERS_READ = Rules._fields.index("numbers")


# --------------------------------------------------------------------------------------
# Room for the intermediate results of one update, and the layout of its rows.
#
# ``docs/kernels.md`` has a picture of them.

# The first rows are vectors over the whole state.
CORRECTION = 0  # δ
TRANSPORT = 1  # v of the transport T = I + v e_θᵀ
ITERATE = 2  # where the readings are linearised again
HEADING = 3  # P[:, θ]
MEAN_BEFORE = 4  # the prior mean

# The stacked system follows: two rows (bearing, range) for each reading in use.  Such a
# row begins with its row of A and ends with META_WIDTH more columns, which are counted
# from the end.  Rules that iterate have a second system below it, for readings that are
# linearised again.
FIRST = 5
READING = -1  # z
VARIANCE = -2  # diagonal of Q
INNOVATION = -3  # ν
WHITE = -4  # w = L⁻¹ ν
ROOT = -6  # and the next: row of the diagonal block of L
JACOBIAN = -11  # and the next four: row of H, by x, y, θ, landmark x, landmark y
LANDMARK_X, LANDMARK_Y = JACOBIAN + 3, JACOBIAN + 4
META_WIDTH = 16

# Rows of the ledger of one scan.
SLOT = 0  # of each reading: place of its landmark in the map, negative for a new one
OUTCOME = 1  # of each reading: USED, ADDED, GATED, SKIPPED or WAITING
NEAR = 2  # of each reading: 1 where the robot is within 10 σ of its landmark
COLUMN = 3  # of each reading in use: its landmark's first column in the state
ORDER = 4  # the readings in use in the order in which they are taken one by one
LEDGER_HEIGHT = 5

# Outcomes of a reading.
USED, ADDED, GATED, SKIPPED = 0, 1, 2, 3
WAITING = 4  # of a new landmark that one reading does not place


class Workspace(NamedTuple):
    """Room for one update; every row begins on a cache line."""

    rows: Array  # (FIRST + 2m + 2, capacity + META_WIDTH), two systems to iterate
    before: Array  # empty, or square with room for P, to restore it after a failure


def workspace_for(rules: Rules, readings: int, capacity: int) -> Workspace:
    """Allocate what updates by these rules need.

    Parameters
    ----------
    rules : Rules
        Whether updates may linearise more than once.
    readings, capacity : int
        Most readings in one scan, and length of the mean.
    """
    systems = (2 if rules.iterations > 1 else 1) * (2 * readings + 2)
    kept = capacity * (readings > BLOCK)  # else no update fails after it has changed P
    return Workspace(
        aligned_zeros(FIRST + systems, (capacity + 7) // 8 * 8 + META_WIDTH),
        aligned_zeros(kept, kept),
    )


class BeliefArrays(NamedTuple):
    """One run's belief, which kernels change in place.

    The first ``size`` = 3 + 2n entries are in use, in the order (x, y, θ, l1x, l1y, …),
    and the others are zero.  ``capacity`` is a multiple of 4 above ``size``, so that
    loops may run over whole vector registers.
    """

    mean: Array  # (capacity,)
    covariance: Array  # (capacity, capacity)
    reference: Array  # (capacity,) fixed points for Jacobians, where the rules use them
