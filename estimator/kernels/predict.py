"""The filters' arithmetic, compiled: predict, linearise, retract, grow.

Every function works in place on one run's belief: ``mean`` (capacity,) and
``covariance`` (capacity, capacity), of which the first ``size`` = 3 + 2n entries are in
use, in the order (x, y, θ, l1x, l1y, …), and the others zero; ``capacity`` is a
multiple of 4 above ``size``, so that loops may run over whole vector registers.
Scalar loops throughout: the same functions serve one filter, a batch of runs in
threads, and a debugger (``NUMBA_DISABLE_JIT=1``).

Symbols as in :mod:`.unicycle_motion` and :mod:`.bearing_range_model`; for a reading of
the landmark in columns c, c+1 only five columns of H differ from zero, (x, y, θ, c,
c+1).  These and all else about a reading stand in two rows of :mod:`.workspace`.
"""

import numpy as np
from numpy.typing import NDArray

from ..models.angles import wrap_angle
from ..support.fma import fma
from ..support.jit import compiled, part
from .scan_rows import COLUMN, HEADING, INNOVATION, JACOBIAN, READING, SHIFT, WAY

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
    mean: Array, reference: Array, linearisation: int, rows: Array, row: int
) -> None:
    """Fill H and ν of the reading in ``row`` and the next, eqs. 1.4 to 1.6."""
    c, below = int(rows[row, COLUMN]), row + 1
    dx, dy = mean[c] - mean[0], mean[c + 1] - mean[1]
    bearing, distance = np.arctan2(dy, dx) - mean[2], np.sqrt(dx * dx + dy * dy)
    rows[row, INNOVATION] = wrap(rows[row, READING] - bearing)
    rows[below, INNOVATION] = rows[below, READING] - distance
    if linearisation in (AT_REFERENCE, AT_TRUTH):
        dx, dy = reference[c] - reference[0], reference[c + 1] - reference[1]
    per_range = 1 / np.sqrt(dx * dx + dy * dy)
    ex, ey = dx * per_range, dy * per_range
    ax, ay = -ey * per_range, ex * per_range
    rows[row, JACOBIAN], rows[row, JACOBIAN + 1] = -ax, -ay
    rows[below, JACOBIAN], rows[below, JACOBIAN + 1] = -ex, -ey
    rows[row, JACOBIAN + 2], rows[below, JACOBIAN + 2] = -1.0, 0.0
    rows[row, JACOBIAN + 3], rows[row, JACOBIAN + 4] = ax, ay
    rows[below, JACOBIAN + 3], rows[below, JACOBIAN + 4] = ex, ey
    if linearisation == PROJECTED:
        _project(reference, c, rows, row)


@part
def _project(reference: Array, column: int, rows: Array, row: int) -> None:
    """H ← H − (H w) wᵀ / wᵀw: blind to the turn w of robot and landmark together.

    w is J δ of the reference points, spread about their midpoint: the part of a turn
    about the origin that is orthogonal to the two shifts, to which H is blind anyway.
    """
    half_x = (reference[column] - reference[0]) / 2
    half_y = (reference[column + 1] - reference[1]) / 2
    squared = 1 + 2 * (half_x * half_x + half_y * half_y)
    for i in range(row, row + 2):
        along_x = rows[i, JACOBIAN] - rows[i, JACOBIAN + 3]
        along_y = rows[i, JACOBIAN + 1] - rows[i, JACOBIAN + 4]
        turned = along_x * half_y - along_y * half_x + rows[i, JACOBIAN + 2]
        seen = turned / squared
        rows[i, JACOBIAN] -= seen * half_y
        rows[i, JACOBIAN + 1] += seen * half_x
        rows[i, JACOBIAN + 2] -= seen
        rows[i, JACOBIAN + 3] += seen * half_y
        rows[i, JACOBIAN + 4] -= seen * half_x


@part
def retract(mean: Array, rows: Array, size: int) -> None:
    """Compose an invariant correction δ with the state, in place of adding it.

    With t = δθ and every point q, the robot's position and each landmark::

        q⁺ = R(t) q + V(t) (δq − t J q),    θ⁺ = θ + t,    J = [0 −1; 1 0]
        V(t) = [sin t, −(1 − cos t); 1 − cos t, sin t] / t

    the exponential of SE_{1+n}(2) applied from the left (Barrau and Bonnabel, 2015).
    The row WAY becomes v = J (q⁺ − q), 0 at θ, for :func:`transport`.
    """
    t = rows[SHIFT, 2]
    cos, sin = np.cos(t), np.sin(t)
    even, odd = 1.0, 0.0
    if t != 0:
        even, odd = sin / t, 2 * np.sin(t / 2) ** 2 / t
    for i in range(-1, size // 2 - 1):
        c = 3 + 2 * i if i >= 0 else 0
        x, y = mean[c], mean[c + 1]
        ux, uy = rows[SHIFT, c] + t * y, rows[SHIFT, c + 1] - t * x
        mean[c] = cos * x - sin * y + even * ux - odd * uy
        mean[c + 1] = sin * x + cos * y + odd * ux + even * uy
        rows[WAY, c], rows[WAY, c + 1] = y - mean[c + 1], mean[c] - x
    mean[2] += t
    rows[WAY, 2] = 0.0


@part
def transport(covariance: Array, rows: Array, size: int) -> None:
    """P ← T P Tᵀ with T = I + v e_θᵀ, v in the row WAY: of P the lower half only.

    The covariance, constant in invariant coordinates, read at the moved estimate.
    The row HEADING is overwritten with c = P[:, θ].
    """
    for j in range(size):
        rows[HEADING, j] = covariance[2, j] if j < 2 else covariance[j, 2]
    variance = rows[HEADING, 2]
    for i in range(size):
        v = rows[WAY, i]
        rest = rows[HEADING, i] + variance * v
        for j in range(i + 1):
            moved = fma(v, rows[HEADING, j], covariance[i, j])
            covariance[i, j] = fma(rest, rows[WAY, j], moved)


@part
def add_landmark(
    mean: Array,
    covariance: Array,
    size: int,
    bearing: float,
    distance: float,
    bearing_variance: float,
    range_variance: float,
    linearisation: int,
    reference: Array,
    correlated: bool,
) -> None:
    """Append the landmark of one reading, eq. 1.3, with its correlation to all else.

    ::

        P_l* = F_p P_p*,    P_ll = F_p P_pp F_pᵀ + F_z Q F_zᵀ

    Not ``correlated``: P_l* = 0, as in the seed of this project.
    """
    direction = mean[2] + bearing
    cos, sin = np.cos(direction), np.sin(direction)
    r, c = distance, size
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
    across, along = bearing_variance * r * r, range_variance
    x, y = covariance[c], covariance[c + 1]
    x[c] = x[0] + turned_x * x[2] + cos * cos * along + sin * sin * across
    y[c] = y[0] + turned_x * y[2] + cos * sin * (along - across)
    y[c + 1] = y[1] + turned_y * y[2] + sin * sin * along + cos * cos * across
    x[c + 1] = y[c]
    for j in range(size):
        if not correlated:
            x[j] = y[j] = 0.0
        covariance[j, c], covariance[j, c + 1] = x[j], y[j]
