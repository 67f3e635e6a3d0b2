"""Corrections in the invariant error frame, compiled: of the mean and of P."""

from ...arrays import Array
from ...jit import fma, njit_internal
from ..models.rigid_motion import turn_coefficients_jit
from .scan_rows import CORRECTION, HEADING, TRANSPORT


@njit_internal
def retract(mean: Array, rows: Array, size: int) -> None:
    """Compose an invariant correction δ with the state, in place of adding it.

    With t = δθ and every point q, the robot's position and each landmark::

        q⁺ = R(t) q + V(t) (δq − t J q),    θ⁺ = θ + t

    with R, V and J of :mod:`..models.rigid_motion`.  The row TRANSPORT becomes
    v = J (q⁺ − q), 0 at θ, for :func:`transport`.
    """
    delta, v = rows[CORRECTION], rows[TRANSPORT]
    t = delta[2]
    cos, sin, even, odd = turn_coefficients_jit(t)
    for i in range(-1, size // 2 - 1):
        c = 3 + 2 * i if i >= 0 else 0  # the pose first, then the landmarks
        x, y = mean[c], mean[c + 1]
        ux, uy = delta[c] + t * y, delta[c + 1] - t * x
        mean[c] = cos * x - sin * y + even * ux - odd * uy
        mean[c + 1] = sin * x + cos * y + odd * ux + even * uy
        v[c], v[c + 1] = y - mean[c + 1], mean[c] - x
    mean[2] += t
    v[2] = 0.0


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
