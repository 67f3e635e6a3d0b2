"""Eliminate the poses of a drive one after the other, backwards in time; compiled.

At an estimate x̂, l̂ the cost is quadratic in the steps δ_k of the poses and δ_l of the
landmarks.  What pose k and all later ones contribute is, as a function of pose k::

    ½ δᵀ Λ_k δ − λ_kᵀ δ + δᵀ B_k δ_l + ½ δ_lᵀ C δ_l − ηᵀ δ_l

with Λ_k over pose k and the landmarks as a separator.  The motion δ_k = q + E w,
q = G δ_{k−1} + s, with noise w ~ N(0, I), is eliminated by minimising over w::

    M = I + Eᵀ Λ E = L Lᵀ,    U = E L⁻ᵀ,    K = U Uᵀ,    T = I − K Λ
    W = Uᵀ B,    Λ ← Tᵀ Λ T + (L⁻ᵀ Uᵀ Λ)ᵀ (…),    λ ← Tᵀ λ,    B ← Tᵀ B
    C ← C − Wᵀ W,    η ← η − Wᵀ Uᵀ λ

and pose k by writing q in terms of pose k − 1.  E is never inverted: directions
without noise, and a start that is known, are exact.  What remains, C and η, is the
Schur complement of the landmarks.  Once δ_l is known, a second pass with λ − B δ_l in
place of λ needs no B.  Then :func:`substitute` computes the poses, forwards in time.
This is the backward information filter of a two-pass smoother [1]_ with the landmarks
as parameters.

The rows W of all poses would need the most memory of a smoother.  The drive is
therefore eliminated in parts of `PART` poses, and only the rows of one part are kept.
Eliminating a part once more restores its rows.

References
----------
.. [1] D. Mayne, A solution of the smoothing problem for linear dynamic systems,
   Automatica 4, 1966.
"""

from __future__ import annotations

from collections.abc import Callable
from math import log1p, sqrt
from typing import NamedTuple

import numpy as np

from ...arrays import Array, IntArray
from ...jit import jit, njit_internal
from ..kernels.scan_update import as_rules, variances
from ..models.bearing_range import (
    difference_jit,
    expected_reading_jit,
    pose_slopes_jit,
    read_distance_jit,
    wrap_angle_jit,
)
from ..models.rigid_motion import composed_jit
from .drive import DriveArrays

#: Number of poses in a part.
PART = 256


class System(NamedTuple):
    """What is left of the poses from k on, of pose k and the landmarks: Λ, λ and B."""

    curvature: Array  # (3, 3)
    slope: Array  # (3,)
    coupling: Array  # (3, 2n)


class Elimination(NamedTuple):
    """What eliminating N poses in p parts leaves, for computing the poses."""

    curvatures: Array  # (N, 3, 3) Λ
    slopes: Array  # (N, 3) λ
    gains: Array  # (N, 3, 3) U
    shifts: Array  # (N, 3) s
    rows: Array  # (PART, 3, 2n) W of the part eliminated last
    blocks: Array  # (n, 2, 2) C before Wᵀ W is subtracted
    right: Array  # (2n,) η
    ends: System  # of the poses after each part, with the parts along axis 0


def new_elimination(poses: int, landmarks: int) -> Elimination:
    """Return an elimination whose arrays are zero."""
    parts, size = -(-poses // PART), 2 * landmarks
    return Elimination(
        np.zeros((poses, 3, 3)),
        np.zeros((poses, 3)),
        np.zeros((poses, 3, 3)),
        np.zeros((poses, 3)),
        np.zeros((min(poses, PART), 3, size)),
        np.zeros((landmarks, 2, 2)),
        np.zeros(size),
        System(
            np.zeros((parts, 3, 3)), np.zeros((parts, 3)), np.zeros((parts, 3, size))
        ),
    )


@jit
def eliminate(
    part: int,
    estimate: tuple[Array, Array],
    landmark_step: Array,
    drive: DriveArrays,
    stds: Array,
    robust: tuple[float, float],
    damping: float,
    out: Elimination,
) -> None:
    """Linearise at poses (N, 3) and landmarks (2n,), and eliminate a part of the poses.

    The last part comes first.  A part may be eliminated again later.

    Parameters
    ----------
    part : int
        Index of the part, whose first pose is part · `PART`.
    landmark_step : ndarray, shape (2n,)
        δ_l in the second pass, where ``drive`` has the widths 0; else zeros.
    stds : ndarray, shape (M, 2)
        Those of each reading.
    robust
        Kind and scale of the robust kernel.
    damping : float
        Levenberg-Marquardt's: the part by which readings count more against a step.
    out
        Filled.  The part adds to C and η.
    """
    poses, first, ends = estimate[0], part * PART, out.ends
    curvature, slope = ends.curvature[part].copy(), ends.slope[part].copy()
    coupling = ends.coupling[part].copy()
    system = System(curvature, slope, coupling)
    noise, room = np.empty((3, 3)), np.empty((5, 3, 3))
    for k in range(min(first + PART, len(poses)) - 1, first - 1, -1):
        width, rows = drive.widths[k], out.rows[k - first]
        before = curvature[0, 0], curvature[1, 1], curvature[2, 2]
        for j in range(drive.firsts[k], drive.firsts[k + 1]):
            _absorb((k, j), estimate, landmark_step, drive, stds, robust, system, out)
        for j in range(drive.fixes.firsts[k], drive.fixes.firsts[k + 1]):
            _absorb_pose(poses[k], drive, j, robust, system, room[0])
        for i in range(3):
            curvature[i, i] += damping * (curvature[i, i] - before[i])
            out.slopes[k, i] = slope[i]
            for j in range(3):
                out.curvatures[k, i, j] = curvature[i, j]
        _noise_in_world(poses, drive, k, noise, out.shifts[k])
        _minimise(curvature, slope, noise, room, out.gains[k])
        _minimise_landmarks(coupling, width, k, room, rows, out)
        _shift(system, width, k, out)
        if k > 0:
            turned = poses[k - 1, 1] - poses[k, 1], poses[k, 0] - poses[k - 1, 0]
            _change_pose(system, width, turned)
    if part > 0:
        ends.curvature[part - 1], ends.slope[part - 1] = curvature, slope
        ends.coupling[part - 1] = coupling
        return
    for i in range(len(out.blocks)):
        for axis in range(2):
            out.blocks[i, axis, axis] *= 1 + damping


@njit_internal
def _absorb(
    where: tuple[int, int],
    estimate: tuple[Array, Array],
    landmark_step: Array,
    drive: DriveArrays,
    stds: Array,
    robust: tuple[float, float],
    system: System,
    out: Elimination,
) -> None:
    """Add reading j of pose k: Hᵀ Q⁻¹ H and Hᵀ Q⁻¹ ν, weighted by a robust kernel.

    ν is the innovation after the step of the landmarks, to first order.
    """
    (k, j), (poses, landmarks) = where, estimate
    curvature, slope, coupling = system
    std, std_below, c = stds[j, 0], stds[j, 1], drive.columns[j]
    nu, nu_below = innovation(poses, landmarks, drive, k, j)
    dx, dy = landmarks[c] - poses[k, 0], landmarks[c + 1] - poses[k, 1]
    ax, ay, bx, by, a_turn, b_turn = pose_slopes_jit(dx, dy, poses[k, 2])
    squared = (nu / std) ** 2 + (nu_below / std_below) ** 2
    weight = robust_weight(squared, robust[0], robust[1])
    a, b = weight / std**2, weight / std_below**2
    nu -= ax * landmark_step[c] + ay * landmark_step[c + 1]
    nu_below -= bx * landmark_step[c] + by * landmark_step[c + 1]
    xx, yy = a * ax * ax + b * bx * bx, a * ay * ay + b * by * by
    xy = a * ax * ay + b * bx * by
    ux, uy = a * ax * nu + b * bx * nu_below, a * ay * nu + b * by * nu_below
    x_turn, y_turn = (
        a * ax * a_turn + b * bx * b_turn,
        a * ay * a_turn + b * by * b_turn,
    )
    block, right = out.blocks[c // 2], out.right
    block[0, 0] += xx
    block[0, 1] += xy
    block[1, 0] += xy
    block[1, 1] += yy
    right[c] += ux
    right[c + 1] += uy
    curvature[0, 0] += xx
    curvature[0, 1] += xy
    curvature[1, 0] += xy
    curvature[1, 1] += yy
    for i, value in ((0, x_turn), (1, y_turn)):
        curvature[i, 2] -= value
        curvature[2, i] -= value
    curvature[2, 2] += a * a_turn * a_turn + b * b_turn * b_turn
    slope[0] -= ux
    slope[1] -= uy
    slope[2] += a * a_turn * nu + b * b_turn * nu_below
    coupling[0, c] -= xx
    coupling[0, c + 1] -= xy
    coupling[1, c] -= xy
    coupling[1, c + 1] -= yy
    coupling[2, c] += x_turn
    coupling[2, c + 1] += y_turn


@njit_internal
def _absorb_pose(
    pose: Array,
    drive: DriveArrays,
    j: int,
    robust: tuple[float, float],
    system: System,
    slopes: Array,
) -> None:
    """Add reading j of a pose itself: Hᵀ R⁻¹ H and Hᵀ R⁻¹ ν, weighted likewise."""
    white = pose_innovation(pose, drive, j)
    squared = white[0] ** 2 + white[1] ** 2 + white[2] ** 2
    weight = robust_weight(squared, robust[0], robust[1])
    multiply(drive.fixes.whiteners[j], drive.fixes.matrices[j], slopes)
    for i in range(3):
        for c in range(3):
            system.slope[c] += weight * slopes[i, c] * white[i]
            for d in range(3):
                system.curvature[c, d] += weight * slopes[i, c] * slopes[i, d]


@njit_internal
def _noise_in_world(
    poses: Array, drive: DriveArrays, k: int, noise: Array, shift: Array
) -> None:
    """Write E = R(θ_{k−1}) N_k and s = x̂_{k−1} ⊕ Δ_k − x̂_k."""
    dx, dy, turn, cos, sin = motion_residual(poses, drive, k)
    shift[0], shift[1], shift[2] = -dx, -dy, -turn
    N = drive.factors[k]
    for j in range(3):
        noise[0, j] = cos * N[0, j] - sin * N[1, j]
        noise[1, j] = sin * N[0, j] + cos * N[1, j]
        noise[2, j] = N[2, j]


@njit_internal
def _minimise(
    curvature: Array, slope: Array, noise: Array, room: Array, gain: Array
) -> None:
    """Minimise over the noise: write U, Λ and λ; leave T in room[0], Uᵀλ in room[4]."""
    T, M, inverse, product, reduced = room[0], room[1], room[2], room[3], room[4]
    multiply(curvature, noise, product)
    left_transposed(noise, product, M)
    for i in range(3):
        M[i, i] += 1.0
    inverse_root(M, inverse)
    right_transposed(noise, inverse, gain)
    transposed_times(gain, slope, reduced[0])
    left_transposed(gain, curvature, product)
    left_transposed(inverse, product, M)
    multiply(gain, product, T)
    complement(T)
    multiply(curvature, T, product)
    transposed_times(T, slope, reduced[1])
    for i in range(3):
        slope[i] = reduced[1, i]
        for j in range(i + 1):
            value = 0.0
            for a in range(3):
                value += T[a, i] * product[a, j] + M[a, i] * M[a, j]
            curvature[i, j] = value
            curvature[j, i] = value


@njit_internal
def _minimise_landmarks(
    coupling: Array, width: int, k: int, room: Array, rows: Array, out: Elimination
) -> None:
    """Write W, zero beyond the width; B ← Tᵀ B, η ← η − Wᵀ Uᵀ λ."""
    T, U = room[0], out.gains[k]
    rows[:, width:] = 0.0
    u0, u1, u2 = room[4, 0, 0], room[4, 0, 1], room[4, 0, 2]
    for c in range(width):
        x, y, z = coupling[0, c], coupling[1, c], coupling[2, c]
        rows[0, c] = U[0, 0] * x + U[1, 0] * y + U[2, 0] * z
        rows[1, c] = U[0, 1] * x + U[1, 1] * y + U[2, 1] * z
        rows[2, c] = U[0, 2] * x + U[1, 2] * y + U[2, 2] * z
        coupling[0, c] = T[0, 0] * x + T[1, 0] * y + T[2, 0] * z
        coupling[1, c] = T[0, 1] * x + T[1, 1] * y + T[2, 1] * z
        coupling[2, c] = T[0, 2] * x + T[1, 2] * y + T[2, 2] * z
        out.right[c] -= rows[0, c] * u0 + rows[1, c] * u1 + rows[2, c] * u2


@njit_internal
def _shift(system: System, width: int, k: int, out: Elimination) -> None:
    """Replace q by q + s: λ ← λ − Λ s, η ← η − Bᵀ s."""
    (curvature, slope, coupling), s = system, out.shifts[k]
    for i in range(3):
        for j in range(3):
            slope[i] -= curvature[i, j] * s[j]
    for c in range(width):
        out.right[c] -= (
            coupling[0, c] * s[0] + coupling[1, c] * s[1] + coupling[2, c] * s[2]
        )


@njit_internal
def _change_pose(system: System, width: int, turned: tuple[float, float]) -> None:
    """Write q = G δ: Λ ← Gᵀ Λ G, λ ← Gᵀ λ, B ← Gᵀ B, G = I + (turned, 0) e_θᵀ."""
    (curvature, slope, coupling), (tx, ty) = system, turned
    slope[2] += tx * slope[0] + ty * slope[1]
    for c in range(width):
        coupling[2, c] += tx * coupling[0, c] + ty * coupling[1, c]
    for j in range(3):
        curvature[2, j] += tx * curvature[0, j] + ty * curvature[1, j]
    for i in range(3):
        curvature[i, 2] += tx * curvature[i, 0] + ty * curvature[i, 1]


# --------------------------------------------------------------------------------------
# Compute the eliminated poses, forwards in time.  With the λ of the second pass::
#
#     δ_k = q − U Uᵀ (Λ q − λ),    q = G δ_{k−1} + s
#
# and the covariance of pose k follows from that of pose k − 1.


@jit
def substitute(poses: Array, drive: DriveArrays, out: Elimination) -> Array:
    """Return the new poses, shape (N, 3), after the second pass.

    They are driven: q is taken from the new pose k − 1, and the noise found acts in its
    frame.  A direction without noise therefore has none, whatever the step.
    """
    new, q, u = np.empty((len(poses), 3)), np.empty(3), np.empty(3)
    for k in range(len(poses)):
        x, y, heading, turn = drive.start[0], drive.start[1], drive.start[2], 0.0
        if k > 0:
            before, step = new[k - 1], drive.increments[k]
            x, y, heading, _, _ = composed_jit(
                before[0], before[1], before[2], step[0], step[1], step[2]
            )
            turn = before[2] - poses[k - 1, 2]
        q[0], q[1] = x - poses[k, 0], y - poses[k, 1]
        q[2] = wrap_angle_jit(heading - poses[k, 2])
        U = out.gains[k]
        u[:] = 0.0
        for a in range(3):
            force = -out.slopes[k, a]
            for j in range(3):
                force += out.curvatures[k, a, j] * q[j]
            for i in range(3):
                u[i] += U[a, i] * force
        dx = -(U[0, 0] * u[0] + U[0, 1] * u[1] + U[0, 2] * u[2])
        dy = -(U[1, 0] * u[0] + U[1, 1] * u[1] + U[1, 2] * u[2])
        new[k, 0], new[k, 1], _, _, _ = composed_jit(x, y, turn, dx, dy, 0.0)
        new[k, 2] = heading - (U[2, 0] * u[0] + U[2, 1] * u[1] + U[2, 2] * u[2])
    return new


@jit
def conditionals(poses: Array, out: Elimination) -> tuple[Array, Array]:
    """Return the covariance of each pose given the landmarks, and its transition.

    ::

        x_k = Φ_k x_{k−1} − U_k W_k l + U_k n,    n ~ N(0, I),    Φ_k = T_k G_k
        Π_k = Φ_k Π_{k−1} Φ_kᵀ + K_k

    Returns
    -------
    covariances : ndarray, shape (N, 3, 3)
        Π.
    transitions : ndarray, shape (N, 3, 3)
        Φ; entry 0 is not used.
    """
    count = len(poses)
    covariances, transitions = np.zeros((count, 3, 3)), np.zeros((count, 3, 3))
    K, moved = np.empty((3, 3)), np.empty((3, 3))
    for k in range(count):
        U, phi = out.gains[k], transitions[k]
        right_transposed(U, U, K)
        multiply(K, out.curvatures[k], phi)
        complement(phi)
        if k > 0:
            tx, ty = poses[k - 1, 1] - poses[k, 1], poses[k, 0] - poses[k - 1, 0]
            for i in range(3):
                phi[i, 2] += tx * phi[i, 0] + ty * phi[i, 1]
            multiply(phi, covariances[k - 1], moved)
            right_transposed(moved, phi, covariances[k])
        for i in range(3):
            for j in range(3):
                covariances[k, i, j] += K[i, j]
    return covariances, transitions


@jit
def fill_sensitivity(
    part: int, before: Array, transitions: Array, out: Elimination
) -> None:
    """Replace the rows W of a part by Ψ_k = Φ_k Ψ_{k−1} − U_k W_k.

    The error of pose k is Ψ_k e_l plus independent noise of covariance Π_k.  ``before``
    is Ψ of the pose before the part, zeros where there is none.
    """
    first = part * PART
    for k in range(first, min(first + PART, len(transitions))):
        U, phi, rows = out.gains[k], transitions[k], out.rows[k - first]
        for c in range(rows.shape[1]):
            x, y, z = rows[0, c], rows[1, c], rows[2, c]
            a, b, turn = before[0, c], before[1, c], before[2, c]
            for i in range(3):
                rows[i, c] = -(U[i, 0] * x + U[i, 1] * y + U[i, 2] * z)
                rows[i, c] += phi[i, 0] * a + phi[i, 1] * b + phi[i, 2] * turn
        before = rows


class Sensitivity:
    """Sensitivity Ψ of poses to errors of the landmarks, computed part by part.

    Parameters
    ----------
    poses : ndarray, shape (N, 3)
        Where the drive was linearised.
    out : Elimination
        The result of eliminating them.
    again : callable
        Eliminates the part with a given index once more.
    """

    def __init__(
        self, poses: Array, out: Elimination, again: Callable[[int], None]
    ) -> None:
        #: Π and Φ of `conditionals`.
        self.given_map, self.transitions = conditionals(poses, out)
        self._out, self._again = out, again
        self._before = [np.zeros_like(out.rows[0])]  # Ψ of the pose before each part
        self._part = -1  # the part whose Ψ the rows hold

    def of(self, poses: IntArray) -> Array:
        """Return Ψ of some poses, shape (p, 3, 2n)."""
        parts, rows = np.divmod(poses, PART)
        found = np.empty((len(poses), *self._out.rows.shape[1:]))
        for part in np.unique(parts).tolist():
            for k in range(min(part, len(self._before) - 1), part + 1):
                self._fill(k)
            found[parts == part] = self._out.rows[rows[parts == part]]
        return found

    def _fill(self, part: int) -> None:
        """Fill the rows with Ψ of a part; Ψ of the pose before it must be known."""
        if part == self._part:
            return
        self._part = -1
        self._again(part)
        fill_sensitivity(part, self._before[part], self.transitions, self._out)
        if part + 1 == len(self._before):
            self._before.append(self._out.rows[-1].copy())
        self._part = part


# --------------------------------------------------------------------------------------
# The cost of poses and landmarks, compiled: what the smoother minimises.
#
# ::
#
#     cost = ½ Σ_k ‖V_k ε_k‖² + Σ_j ρ(e_j),    e_j² = ν_β² / σβ² + ν_r² / σr²
#     ε_k = R(θ_{k−1})ᵀ (x_k − x_{k−1} ⊕ Δ_k)
#
# with the innovation ν = z − h(x, l) of each reading, and ε_0 = x_0 − prior mean.  ρ(e)
# is e²/2, or a robust kernel of scale c: Huber's, c e − c²/2 beyond c, or Cauchy's,
# ½ c² log(1 + e²/c²).

SQUARED, HUBER, CAUCHY = 0.0, 1.0, 2.0


@njit_internal
def robust_loss(squared: float, kind: float, scale: float) -> float:
    """Return ρ(e), given e²."""
    if kind == HUBER and squared > scale * scale:
        return scale * (sqrt(squared) - scale / 2)
    if kind == CAUCHY:
        return scale * scale / 2 * log1p(squared / (scale * scale))
    return squared / 2


@njit_internal
def robust_weight(squared: float, kind: float, scale: float) -> float:
    """Return ρ'(e) / e, the weight of a reading in the normal equations."""
    if kind == HUBER and squared > scale * scale:
        return scale / sqrt(squared)
    if kind == CAUCHY:
        return 1 / (1 + squared / (scale * scale))
    return 1.0


@jit
def reading_stds(
    poses: Array, landmarks: Array, drive: DriveArrays, rule_values: Array
) -> Array:
    """Return σ of each reading, (M, 2), at the range that it should have."""
    rules = as_rules(rule_values)
    stds = np.empty((len(drive.readings), 2))
    for k in range(len(poses)):
        for j in range(drive.firsts[k], drive.firsts[k + 1]):
            c = drive.columns[j]
            dx, dy = landmarks[c] - poses[k, 0], landmarks[c + 1] - poses[k, 1]
            distance = np.sqrt(dx * dx + dy * dy)
            if rules.noise_as_read:
                distance = read_distance_jit(drive.readings[j, 0], drive.readings[j, 1])
            distance = max(distance, rules.min_range)
            variance, below = variances(rules, distance)
            stds[j, 0], stds[j, 1] = np.sqrt(variance), np.sqrt(below)
    return stds


@njit_internal
def motion_residual(poses: Array, drive: DriveArrays, k: int) -> tuple[float, ...]:
    """Return x_k − x_{k−1} ⊕ Δ_k in the world frame, and (cos, sin) of θ_{k−1}.

    For k = 0 the prior mean takes the place of x_{k−1} ⊕ Δ_k.
    """
    x, y, heading = drive.start[0], drive.start[1], drive.start[2]
    cos, sin = 1.0, 0.0
    if k > 0:
        x, y, heading, cos, sin = composed_jit(
            poses[k - 1, 0],
            poses[k - 1, 1],
            poses[k - 1, 2],
            drive.increments[k, 0],
            drive.increments[k, 1],
            drive.increments[k, 2],
        )
    turn = wrap_angle_jit(poses[k, 2] - heading)
    return poses[k, 0] - x, poses[k, 1] - y, turn, cos, sin


@njit_internal
def innovation(
    poses: Array, landmarks: Array, drive: DriveArrays, k: int, j: int
) -> tuple[float, float]:
    """Return ν = z − h of reading j, taken at pose k."""
    c = drive.columns[j]
    dx, dy = landmarks[c] - poses[k, 0], landmarks[c + 1] - poses[k, 1]
    z, expected = drive.readings[j], expected_reading_jit(dx, dy, poses[k, 2])
    return difference_jit(z[0], z[1], expected[0], expected[1])


@njit_internal
def pose_innovation(pose: Array, drive: DriveArrays, j: int) -> tuple[float, ...]:
    """Return L⁻¹ (z − H x) of reading j of a pose itself, angles wrapped."""
    H, whitener = drive.fixes.matrices[j], drive.fixes.whiteners[j]
    a, b, c = drive.fixes.values[j]
    a -= H[0, 0] * pose[0] + H[0, 1] * pose[1] + H[0, 2] * pose[2]
    b -= H[1, 0] * pose[0] + H[1, 1] * pose[1] + H[1, 2] * pose[2]
    c -= H[2, 0] * pose[0] + H[2, 1] * pose[1] + H[2, 2] * pose[2]
    a = a if H[0, 0] or H[0, 1] else wrap_angle_jit(a)
    b = b if H[1, 0] or H[1, 1] else wrap_angle_jit(b)
    c = c if H[2, 0] or H[2, 1] else wrap_angle_jit(c)
    return (
        whitener[0, 0] * a,
        whitener[1, 0] * a + whitener[1, 1] * b,
        whitener[2, 0] * a + whitener[2, 1] * b + whitener[2, 2] * c,
    )


@jit
def total_cost(
    poses: Array,
    landmarks: Array,
    drive: DriveArrays,
    stds: Array,
    kind: float,
    scale: float,
) -> float:
    """Return the cost of poses (N, 3) and landmarks (2n,), stds (M, 2) of readings."""
    total = 0.0
    for k in range(len(poses)):
        dx, dy, turn, cos, sin = motion_residual(poses, drive, k)
        along, across = cos * dx + sin * dy, cos * dy - sin * dx
        for i in range(3):
            v = drive.whiteners[k, i]
            total += (v[0] * along + v[1] * across + v[2] * turn) ** 2 / 2
        for j in range(drive.firsts[k], drive.firsts[k + 1]):
            bearing, distance = innovation(poses, landmarks, drive, k, j)
            squared = (bearing / stds[j, 0]) ** 2 + (distance / stds[j, 1]) ** 2
            total += robust_loss(squared, kind, scale)
        for j in range(drive.fixes.firsts[k], drive.fixes.firsts[k + 1]):
            a, b, c = pose_innovation(poses[k], drive, j)
            total += robust_loss(a * a + b * b + c * c, kind, scale)
    return total


# --------------------------------------------------------------------------------------
# Products and roots of matrices (3, 3), compiled: faster than those of numpy.
#
# The arguments are C-contiguous, since a kernel is compiled anew for every other
# layout.


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
