"""The filters' arithmetic, compiled: predict, linearise, absorb, retract, grow.

Every function works in place on one run's belief: ``mean`` (capacity,) and
``covariance`` (capacity, capacity), of which the first ``size`` = 3 + 2n entries are in
use, in the order (x, y, θ, l1x, l1y, …), and the others zero; ``capacity`` is a
multiple of 4 above ``size``, so that loops may run over whole vector registers.
Scalar loops throughout: the same functions serve one filter, a batch of runs in
threads, and a debugger (``NUMBA_DISABLE_JIT=1``).

Symbols as in :mod:`.unicycle_motion` and :mod:`.bearing_range_model`; for a reading of
the landmark in columns c, c+1 only five columns of H differ from zero, (x, y, θ, c,
c+1), and ``jacobian`` (2, 5) holds just these.
"""

import numpy as np
from numpy.typing import NDArray

from .angles import wrap_angle
from .compiled import compiled, part

Array = NDArray[np.float64]
Int = NDArray[np.int64]

wrap = part(wrap_angle)

# Where the Jacobians are taken.
AT_ESTIMATE = 0
AT_REFERENCE = 1  # at fixed points kept beside the estimate
PROJECTED = 2  # at the estimate, then made blind to a turn of the whole map
AT_TRUTH = 3  # at the ground truth, for study

# Share of a variance below which what is left of it counts as rounding.
SINGULAR = 1e-14

# How a correction is composed with the state.
ADDITIVE = 0
INVARIANT = 1


@part
def propagate(
    covariance: Array,
    size: int,
    turned_x: float,
    turned_y: float,
    cos: float,
    sin: float,
    motion_variance: Array,
) -> None:
    """P ← G P Gᵀ + F R Fᵀ with G = I + (turned_x, turned_y, 0, …) e_θᵀ; O(size)."""
    for j in range(size):
        covariance[0, j] += turned_x * covariance[2, j]
        covariance[1, j] += turned_y * covariance[2, j]
    for j in range(3, size):
        covariance[j, 0] = covariance[0, j]
        covariance[j, 1] = covariance[1, j]
    for i in range(3):
        covariance[i, 0] += turned_x * covariance[i, 2]
        covariance[i, 1] += turned_y * covariance[i, 2]
    along, across = motion_variance[0], motion_variance[1]
    covariance[0, 0] += cos * cos * along + sin * sin * across
    covariance[1, 1] += sin * sin * along + cos * cos * across
    covariance[1, 0] += cos * sin * (along - across)
    covariance[0, 1] = covariance[1, 0]
    covariance[2, 2] += motion_variance[2]


@compiled
def predict(
    mean: Array,
    covariance: Array,
    size: int,
    distance: float,
    turn: float,
    motion_variance: Array,
    linearisation: int,
    reference: Array,
) -> None:
    """Move the belief by one odometry reading, eqs. 1.1 and 1.2.

    Linearised elsewhere than at the estimate, G is taken over the displacement between
    the predicted positions, which ``reference`` keeps.
    """
    cos, sin = np.cos(mean[2]), np.sin(mean[2])
    mean[0] += distance * cos
    mean[1] += distance * sin
    mean[2] += turn
    turned_x, turned_y = -distance * sin, distance * cos
    if linearisation != AT_ESTIMATE:
        turned_x = -(mean[1] - reference[1])
        turned_y = mean[0] - reference[0]
        reference[0], reference[1], reference[2] = mean[0], mean[1], mean[2]
    propagate(covariance, size, turned_x, turned_y, cos, sin, motion_variance)


@part
def linearise(
    mean: Array,
    reference: Array,
    column: int,
    linearisation: int,
    readings: Array,
    k: int,
    jacobians: Array,
    innovations: Array,
) -> None:
    """Fill H (2, 5) and ν (2,) of reading k, eqs. 1.4 to 1.6."""
    H, nu = jacobians, innovations
    dx, dy = mean[column] - mean[0], mean[column + 1] - mean[1]
    nu[k, 0] = wrap(readings[k, 0] - np.arctan2(dy, dx) + mean[2])
    nu[k, 1] = readings[k, 1] - np.sqrt(dx * dx + dy * dy)
    if linearisation in (AT_REFERENCE, AT_TRUTH):
        dx = reference[column] - reference[0]
        dy = reference[column + 1] - reference[1]
    per_range = 1 / np.sqrt(dx * dx + dy * dy)
    ex, ey = dx * per_range, dy * per_range
    ax, ay = -ey * per_range, ex * per_range
    H[k, 0, 0], H[k, 0, 1], H[k, 0, 2], H[k, 0, 3], H[k, 0, 4] = -ax, -ay, -1.0, ax, ay
    H[k, 1, 0], H[k, 1, 1], H[k, 1, 2], H[k, 1, 3], H[k, 1, 4] = -ex, -ey, 0.0, ex, ey
    if linearisation == PROJECTED:
        _project(reference, column, H[k])


@part
def _project(reference: Array, column: int, H: Array) -> None:
    """H ← H − (H w) wᵀ / wᵀw: blind to the turn w of robot and landmark together.

    w is J δ of the reference points, spread about their midpoint: the part of a turn
    about the origin that is orthogonal to the two shifts, to which H is blind anyway.
    """
    half_x = (reference[column] - reference[0]) / 2
    half_y = (reference[column + 1] - reference[1]) / 2
    squared = 1 + 2 * (half_x * half_x + half_y * half_y)
    for i in range(2):
        along_x, along_y = H[i, 0] - H[i, 3], H[i, 1] - H[i, 4]
        seen = (along_x * half_y - along_y * half_x + H[i, 2]) / squared
        H[i, 0] -= seen * half_y
        H[i, 1] += seen * half_x
        H[i, 2] -= seen
        H[i, 3] += seen * half_y
        H[i, 4] -= seen * half_x


@part
def absorb(
    covariance: Array,
    size: int,
    columns: Int,
    jacobians: Array,
    variances: Array,
    innovations: Array,
    gains: Array,
    roots: Array,
    white: Array,
    shift: Array,
    block: int,
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
    columns : ndarray of int64, shape (m,)
        First column of each reading's landmark.
    jacobians, variances, innovations
        H (m, 2, 5), the diagonal of Q (m, 2), ν (m, 2).
    gains, roots, white, shift
        Results A (2m, capacity), the diagonal blocks of L as (l00, l10, l11), shape
        (m, 3), w (2m,) and δ in the first row of an array (…, capacity).

    Returns
    -------
    int
        -1, or the first reading at which S is not positive definite; P is then spoilt
        if that is not in the first block.
    """
    m = len(columns)
    for j in range(size):
        shift[0, j] = 0.0
    for first in range(0, m, block):
        last = min(first + block, m)
        if first > 0:
            _refresh(covariance, size, 0)
            _refresh(covariance, size, 2)
        for k in range(first, last):
            c = columns[k]
            if first > 0:
                _refresh(covariance, size, c)
            _correlate(covariance, size, c, jacobians, k, gains)
            scale0 = times(jacobians, k, 0, gains, 2 * k, c) + variances[k, 0]
            scale1 = times(jacobians, k, 1, gains, 2 * k + 1, c) + variances[k, 1]
            for before in range(2 * first, 2 * k, 2):
                _orthogonalise(size, c, jacobians, k, gains, before)
            least0, least1 = SINGULAR * scale0, SINGULAR * scale1
            if not _normalise(
                size, c, jacobians, k, variances, gains, roots, least0, least1
            ):
                return k
            _shift(size, c, jacobians, k, innovations, gains, roots, white, shift)
        downdate(covariance, size, gains, 2 * first, 2 * last)
    for i in range(0, size, 2):
        _refresh(covariance, size, i)
    return -1


@part
def _refresh(covariance: Array, size: int, row: int) -> None:
    """Copy two columns of the lower half into their rows."""
    covariance[row, row + 1] = covariance[row + 1, row]
    for j in range(row + 2, size):
        covariance[row, j] = covariance[j, row]
        covariance[row + 1, j] = covariance[j, row + 1]


@part
def _correlate(
    covariance: Array, size: int, c: int, jacobians: Array, k: int, gains: Array
) -> None:
    """Rows 2k and 2k + 1 of A: H P of reading k, its landmark in columns c, c + 1."""
    H, row = jacobians, 2 * k
    a0, a1, a2, a3, a4 = H[k, 0, 0], H[k, 0, 1], H[k, 0, 2], H[k, 0, 3], H[k, 0, 4]
    b0, b1, b2, b3, b4 = H[k, 1, 0], H[k, 1, 1], H[k, 1, 2], H[k, 1, 3], H[k, 1, 4]
    for j in range(_padded(size)):
        p0, p1, p2 = covariance[0, j], covariance[1, j], covariance[2, j]
        p3, p4 = covariance[c, j], covariance[c + 1, j]
        gains[row, j] = a0 * p0 + a1 * p1 + a2 * p2 + a3 * p3 + a4 * p4
        gains[row + 1, j] = b0 * p0 + b1 * p1 + b2 * p2 + b3 * p3 + b4 * p4


@part
def _orthogonalise(
    size: int, c: int, jacobians: Array, k: int, gains: Array, before: int
) -> None:
    """Subtract from the rows of reading k their part along two finished rows."""
    i, row = before, 2 * k
    l00 = times(jacobians, k, 0, gains, i, c)
    l01 = times(jacobians, k, 0, gains, i + 1, c)
    l10 = times(jacobians, k, 1, gains, i, c)
    l11 = times(jacobians, k, 1, gains, i + 1, c)
    for j in range(_padded(size)):
        a0, a1 = gains[i, j], gains[i + 1, j]
        gains[row, j] = gains[row, j] - l00 * a0 - l01 * a1
        gains[row + 1, j] = gains[row + 1, j] - l10 * a0 - l11 * a1


@part
def _normalise(
    size: int,
    c: int,
    jacobians: Array,
    k: int,
    variances: Array,
    gains: Array,
    roots: Array,
    least0: float,
    least1: float,
) -> bool:
    """Divide the rows of reading k by the square root of their own 2 × 2 part of S.

    Of what the readings before leave of S; false where nothing but rounding is left.
    """
    row = 2 * k
    s00 = times(jacobians, k, 0, gains, row, c) + variances[k, 0]
    s10 = times(jacobians, k, 1, gains, row, c)
    s11 = times(jacobians, k, 1, gains, row + 1, c) + variances[k, 1]
    if not s00 > least0:
        return False
    l00 = np.sqrt(s00)
    l10 = s10 / l00
    rest = s11 - l10 * l10
    if not rest > least1:
        return False
    l11 = np.sqrt(rest)
    roots[k, 0], roots[k, 1], roots[k, 2] = l00, l10, l11
    inverse0, inverse1 = 1 / l00, 1 / l11
    for j in range(_padded(size)):
        a0 = gains[row, j] * inverse0
        gains[row, j] = a0
        gains[row + 1, j] = (gains[row + 1, j] - l10 * a0) * inverse1
    return True


@part
def _shift(
    size: int,
    c: int,
    jacobians: Array,
    k: int,
    innovations: Array,
    gains: Array,
    roots: Array,
    white: Array,
    shift: Array,
) -> None:
    """Whiten what the readings before leave of ν, and add its share to δ."""
    row = 2 * k
    w0 = (innovations[k, 0] - times(jacobians, k, 0, shift, 0, c)) / roots[k, 0]
    w1 = innovations[k, 1] - times(jacobians, k, 1, shift, 0, c)
    w1 = (w1 - roots[k, 1] * w0) / roots[k, 2]
    white[row], white[row + 1] = w0, w1
    for j in range(size):
        shift[0, j] = shift[0, j] + w0 * gains[row, j] + w1 * gains[row + 1, j]


@part
def times(jacobians: Array, k: int, i: int, rows: Array, row: int, c: int) -> float:
    """One row of H times one row over the whole state, of A or such."""
    H, A = jacobians, rows
    pose = H[k, i, 0] * A[row, 0] + H[k, i, 1] * A[row, 1] + H[k, i, 2] * A[row, 2]
    product: float = pose + H[k, i, 3] * A[row, c] + H[k, i, 4] * A[row, c + 1]
    return product


@part
def downdate(covariance: Array, size: int, gains: Array, first: int, last: int) -> None:
    """P ← P − Aᵀ A with rows ``first`` to ``last`` of A, an even number.

    Two rows of P at a time against four of A, and of P the lower half only: what keeps
    the registers of a processor busy.
    """
    whole = last - (last - first) % 4
    one, end = np.uint64(1), np.uint64(size)
    for i in range(np.uint64(0), end, np.uint64(2)):  # unsigned: never from the end
        below, width = i + one, np.uint64(_padded(int(i) + 2))
        for k0 in range(np.uint64(first), np.uint64(whole), np.uint64(4)):
            k1 = k0 + one
            k2 = k1 + one
            k3 = k2 + one
            b0, b1, b2, b3 = gains[k0, i], gains[k1, i], gains[k2, i], gains[k3, i]
            c0, c1 = gains[k0, below], gains[k1, below]
            c2, c3 = gains[k2, below], gains[k3, below]
            for j in range(width):
                a0, a1, a2, a3 = gains[k0, j], gains[k1, j], gains[k2, j], gains[k3, j]
                p, q = covariance[i, j], covariance[below, j]
                covariance[i, j] = p - b0 * a0 - b1 * a1 - b2 * a2 - b3 * a3
                covariance[below, j] = q - c0 * a0 - c1 * a1 - c2 * a2 - c3 * a3
        if whole < last:
            r0 = np.uint64(whole)
            r1 = r0 + one
            b0, b1, c0, c1 = (
                gains[r0, i],
                gains[r1, i],
                gains[r0, below],
                gains[r1, below],
            )
            for j in range(width):
                a0, a1 = gains[r0, j], gains[r1, j]
                covariance[i, j] = covariance[i, j] - b0 * a0 - b1 * a1
                covariance[below, j] = covariance[below, j] - c0 * a0 - c1 * a1


@part
def _padded(size: int) -> int:
    """Next multiple of 4: whole vector registers, no scalar remainder."""
    return (size + 3) // 4 * 4


@part
def retract(mean: Array, shift: Array, size: int) -> None:
    """Compose an invariant correction δ with the state, in place of adding it.

    With t = δθ and every point q, the robot's position and each landmark::

        q⁺ = R(t) q + V(t) (δq − t J q),    θ⁺ = θ + t,    J = [0 −1; 1 0]
        V(t) = [sin t, −(1 − cos t); 1 − cos t, sin t] / t

    the exponential of SE_{1+n}(2) applied from the left (Barrau and Bonnabel, 2015).
    ``shift`` is turned from δ into v = J (q⁺ − q), 0 at θ, for :func:`transport`.
    """
    t = shift[2]
    cos, sin = np.cos(t), np.sin(t)
    even, odd = 1.0, 0.0
    if t != 0:
        even, odd = sin / t, 2 * np.sin(t / 2) ** 2 / t
    for i in range(-1, size // 2 - 1):
        column = 3 + 2 * i if i >= 0 else 0
        x, y = mean[column], mean[column + 1]
        ux, uy = shift[column] + t * y, shift[column + 1] - t * x
        mean[column] = cos * x - sin * y + even * ux - odd * uy
        mean[column + 1] = sin * x + cos * y + odd * ux + even * uy
        shift[column], shift[column + 1] = y - mean[column + 1], mean[column] - x
    mean[2] += t
    shift[2] = 0.0


@part
def transport(covariance: Array, size: int, way: Array, heading: Array) -> None:
    """P ← T P Tᵀ with T = I + v e_θᵀ, v = ``way``: a rank-2 update.

    The covariance, constant in invariant coordinates, read at the moved estimate.
    ``heading`` (capacity,) is overwritten with c = P[:, θ].
    """
    for j in range(size):
        heading[j] = covariance[2, j]
    variance = heading[2]
    for i in range(size):
        # P_ij += v_i c_j + v_j (c_i + v_i c_θ), the same for (i, j) and (j, i)
        v, rest = way[i], heading[i]
        target = covariance[i]
        for j in range(i + 1):
            target[j] += (v * heading[j] + way[j] * rest) + variance * (v * way[j])
        for j in range(i):
            covariance[j, i] = target[j]


@part
def add_landmark(
    mean: Array,
    covariance: Array,
    size: int,
    reading: Array,
    variance: Array,
    linearisation: int,
    reference: Array,
    correlated: bool,
) -> None:
    """Append the landmark of one reading, eq. 1.3, with its correlation to all else.

    ::

        P_l* = F_p P_p*,    P_ll = F_p P_pp F_pᵀ + F_z Q F_zᵀ

    Not ``correlated``: P_l* = 0, as in the seed of this project.
    """
    direction = mean[2] + reading[0]
    cos, sin = np.cos(direction), np.sin(direction)
    r, c = reading[1], size
    mean[c], mean[c + 1] = mean[0] + r * cos, mean[1] + r * sin
    turned_x, turned_y = -r * sin, r * cos
    if linearisation in (AT_REFERENCE, PROJECTED):
        reference[c], reference[c + 1] = mean[c], mean[c + 1]
    if linearisation != AT_ESTIMATE:
        turned_x = reference[1] - reference[c + 1]
        turned_y = reference[c] - reference[0]
    for j in range(size):
        covariance[c, j] = covariance[0, j] + turned_x * covariance[2, j]
        covariance[c + 1, j] = covariance[1, j] + turned_y * covariance[2, j]
    across, along = variance[0] * r * r, variance[1]
    x, y = covariance[c], covariance[c + 1]
    x[c] = x[0] + turned_x * x[2] + cos * cos * along + sin * sin * across
    y[c] = y[0] + turned_x * y[2] + cos * sin * (along - across)
    y[c + 1] = y[1] + turned_y * y[2] + sin * sin * along + cos * cos * across
    x[c + 1] = y[c]
    for j in range(size):
        if not correlated:
            x[j] = y[j] = 0.0
        covariance[j, c], covariance[j, c + 1] = x[j], y[j]
