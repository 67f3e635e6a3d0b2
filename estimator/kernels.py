"""The filters' arithmetic, compiled: predict, linearise, whiten, downdate, grow.

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
    reading: Array,
    jacobian: Array,
    innovation: Array,
) -> None:
    """Fill H (2, 5) and ν (2,) of one reading, eqs. 1.4 to 1.6."""
    dx, dy = mean[column] - mean[0], mean[column + 1] - mean[1]
    innovation[0] = wrap(reading[0] - np.arctan2(dy, dx) + mean[2])
    innovation[1] = reading[1] - np.sqrt(dx * dx + dy * dy)
    if linearisation in (AT_REFERENCE, AT_TRUTH):
        dx = reference[column] - reference[0]
        dy = reference[column + 1] - reference[1]
    q = dx * dx + dy * dy
    r = np.sqrt(q)
    jacobian[0, 0], jacobian[0, 1], jacobian[0, 2] = dy / q, -dx / q, -1.0
    jacobian[0, 3], jacobian[0, 4] = -dy / q, dx / q
    jacobian[1, 0], jacobian[1, 1], jacobian[1, 2] = -dx / r, -dy / r, 0.0
    jacobian[1, 3], jacobian[1, 4] = dx / r, dy / r
    if linearisation == PROJECTED:
        _project(reference, column, jacobian)


@part
def _project(reference: Array, column: int, jacobian: Array) -> None:
    """H ← H − (H w) wᵀ / wᵀw: blind to the turn w of robot and landmark together.

    w is J δ of the reference points, spread about their midpoint: the part of a turn
    about the origin that is orthogonal to the two shifts, to which H is blind anyway.
    """
    half_x = (reference[column] - reference[0]) / 2
    half_y = (reference[column + 1] - reference[1]) / 2
    squared = 1 + 2 * (half_x * half_x + half_y * half_y)
    for i in range(2):
        seen = (
            (jacobian[i, 0] - jacobian[i, 3]) * half_y
            - (jacobian[i, 1] - jacobian[i, 4]) * half_x
            + jacobian[i, 2]
        ) / squared
        jacobian[i, 0] -= seen * half_y
        jacobian[i, 1] += seen * half_x
        jacobian[i, 2] -= seen
        jacobian[i, 3] += seen * half_y
        jacobian[i, 4] -= seen * half_x


@part
def whiten(
    covariance: Array,
    size: int,
    columns: Int,
    jacobians: Array,
    variances: Array,
    innovations: Array,
    gains: Array,
    factor: Array,
    white: Array,
) -> int:
    """Solve the joint innovation covariance of m simultaneous readings.

    ::

        S = H P Hᵀ + Q = L Lᵀ,    A = L⁻¹ H P,    w = L⁻¹ ν

    row after row, without touching P.  The result does not depend on the order of the
    readings, and NIS = wᵀ w.

    Parameters
    ----------
    covariance, size
        P; left as it is.
    columns : ndarray of int64, shape (m,)
        First column of each reading's landmark.
    jacobians, variances, innovations
        H (m, 2, 5), the diagonal of Q (m, 2), ν (m, 2).
    gains, factor, white
        Results A (2m, capacity), L (2m, 2m, lower) and w (2m,).

    Returns
    -------
    int
        -1, or the first reading at which S is not positive definite.
    """
    for k in range(len(columns)):
        _correlate(covariance, size, columns[k], jacobians[k], gains, 2 * k)
        _orthogonalise(size, columns[k], jacobians[k], gains, factor, 2 * k)
        if not _normalise(
            size, columns[k], jacobians[k], variances[k], gains, factor, 2 * k
        ):
            return k
        for i in range(2 * k, 2 * k + 2):
            rest = innovations[k, i - 2 * k]
            for j in range(i):
                rest -= factor[i, j] * white[j]
            white[i] = rest / factor[i, i]
    return -1


@part
def _correlate(
    covariance: Array, size: int, column: int, H: Array, gains: Array, row: int
) -> None:
    """Rows ``row`` and ``row`` + 1 of A: H P of one reading."""
    c = column
    h00, h01, h02, h03, h04 = H[0, 0], H[0, 1], H[0, 2], H[0, 3], H[0, 4]
    h10, h11, h12, h13, h14 = H[1, 0], H[1, 1], H[1, 2], H[1, 3], H[1, 4]
    for j in range(_padded(size)):
        p0, p1, p2 = covariance[0, j], covariance[1, j], covariance[2, j]
        p3, p4 = covariance[c, j], covariance[c + 1, j]
        gains[row, j] = h00 * p0 + h01 * p1 + h02 * p2 + h03 * p3 + h04 * p4
        gains[row + 1, j] = h10 * p0 + h11 * p1 + h12 * p2 + h13 * p3 + h14 * p4


@part
def _orthogonalise(
    size: int, column: int, H: Array, gains: Array, factor: Array, row: int
) -> None:
    """Subtract from two rows of A their part along the rows before; fill L there."""
    for i in range(0, row, 2):
        l00, l01 = _times(H, 0, gains, i, column), _times(H, 0, gains, i + 1, column)
        l10, l11 = _times(H, 1, gains, i, column), _times(H, 1, gains, i + 1, column)
        factor[row, i], factor[row, i + 1] = l00, l01
        factor[row + 1, i], factor[row + 1, i + 1] = l10, l11
        for j in range(_padded(size)):
            a0, a1 = gains[i, j], gains[i + 1, j]
            q0, q1 = gains[row, j], gains[row + 1, j]
            q0 -= l00 * a0
            q1 -= l10 * a0
            gains[row, j] = q0 - l01 * a1
            gains[row + 1, j] = q1 - l11 * a1


@part
def _normalise(
    size: int,
    column: int,
    H: Array,
    variance: Array,
    gains: Array,
    factor: Array,
    row: int,
) -> bool:
    """Divide two rows of A by the square root of their own 2 × 2 part of S."""
    s00 = _times(H, 0, gains, row, column) + variance[0]
    s10 = _times(H, 1, gains, row, column)
    s11 = _times(H, 1, gains, row + 1, column) + variance[1]
    if not (s00 > 0 and s11 - s10 * s10 / s00 > 0):
        return False
    l00 = np.sqrt(s00)
    l10 = s10 / l00
    l11 = np.sqrt(s11 - l10 * l10)
    factor[row, row], factor[row, row + 1] = l00, 0.0
    factor[row + 1, row], factor[row + 1, row + 1] = l10, l11
    inverse0, inverse1 = 1 / l00, 1 / l11
    for j in range(_padded(size)):
        a0 = gains[row, j] * inverse0
        gains[row, j] = a0
        gains[row + 1, j] = (gains[row + 1, j] - l10 * a0) * inverse1
    return True


@part
def _times(H: Array, i: int, gains: Array, row: int, column: int) -> float:
    """One row of H times one row of A."""
    product: float = (
        H[i, 0] * gains[row, 0]
        + H[i, 1] * gains[row, 1]
        + H[i, 2] * gains[row, 2]
        + H[i, 3] * gains[row, column]
        + H[i, 4] * gains[row, column + 1]
    )
    return product


@part
def downdate(covariance: Array, size: int, gains: Array, rows: int) -> None:
    """P ← P − Aᵀ A, symmetric by construction; ``rows`` of A, an even number.

    Two rows of P at a time against four of A, and of P the lower half only: what keeps
    the registers of a processor busy.
    """
    for i in range(0, size, 2):
        width = _padded(i + 2)
        for k in range(0, rows - 2, 4):
            b0, b1, b2, b3 = _column(gains, k, i)
            c0, c1, c2, c3 = _column(gains, k, i + 1)
            for j in range(width):
                a0, a1, a2, a3 = _column(gains, k, j)
                p, q = covariance[i, j], covariance[i + 1, j]
                covariance[i, j] = p - b0 * a0 - b1 * a1 - b2 * a2 - b3 * a3
                covariance[i + 1, j] = q - c0 * a0 - c1 * a1 - c2 * a2 - c3 * a3
        if rows % 4:
            k = rows - 2
            b0, b1, c0, c1 = (
                gains[k, i],
                gains[k + 1, i],
                gains[k, i + 1],
                gains[k + 1, i + 1],
            )
            for j in range(width):
                a0, a1 = gains[k, j], gains[k + 1, j]
                covariance[i, j] = covariance[i, j] - b0 * a0 - b1 * a1
                covariance[i + 1, j] = covariance[i + 1, j] - c0 * a0 - c1 * a1
    for i in range(size):
        for j in range(i):
            covariance[j, i] = covariance[i, j]


@part
def _column(gains: Array, k: int, j: int) -> tuple[float, float, float, float]:
    return gains[k, j], gains[k + 1, j], gains[k + 2, j], gains[k + 3, j]


@part
def _padded(size: int) -> int:
    """Next multiple of 4: whole vector registers, no scalar remainder."""
    return (size + 3) // 4 * 4


@part
def combine(gains: Array, white: Array, rows: int, size: int, shift: Array) -> None:
    """δ = Aᵀ w, the correction of the state."""
    for j in range(size):
        shift[j] = 0.0
    for k in range(rows):
        weight, gain = white[k], gains[k]
        for j in range(size):
            shift[j] += weight * gain[j]


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
