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
Schur complement of the landmarks.  :mod:`.substitution` goes back, forwards in time.
This is the backward information filter of a two-pass smoother [1]_ with the landmarks
as parameters.

References
----------
.. [1] D. Mayne, A solution of the smoothing problem for linear dynamic systems,
   Automatica 4, 1966.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ...arrays import Array
from ...jit import jit, njit_internal
from ..models.bearing_range import reading_slopes_jit
from .cost import innovation, motion_residual, robust_weight
from .drive_arrays import DriveArrays
from .small_matrices import (
    complement,
    inverse_root,
    left_transposed,
    multiply,
    right_transposed,
    transposed_times,
)


class Elimination(NamedTuple):
    """What eliminating N poses leaves, for the way back."""

    curvatures: Array  # (N, 3, 3) Λ
    slopes: Array  # (N, 3) λ
    gains: Array  # (N, 3, 3) U
    shifts: Array  # (N, 3) s
    rows: Array  # (N, 3, 2n) W
    blocks: Array  # (n, 2, 2) C before Wᵀ W is subtracted
    right: Array  # (2n,) η


def new_elimination(poses: int, landmarks: int) -> Elimination:
    """Allocate room; rows beyond the landmarks that a pose meets stay zero."""
    return Elimination(
        np.zeros((poses, 3, 3)),
        np.zeros((poses, 3)),
        np.zeros((poses, 3, 3)),
        np.zeros((poses, 3)),
        np.zeros((poses, 3, 2 * landmarks)),
        np.zeros((landmarks, 2, 2)),
        np.zeros(2 * landmarks),
    )


@jit
def eliminate(
    poses: Array,
    landmarks: Array,
    drive: DriveArrays,
    stds: Array,
    robust: tuple[float, float],
    damping: float,
    out: Elimination,
) -> None:
    """Linearise at poses (N, 3) and landmarks (2n,), and eliminate the poses.

    Parameters
    ----------
    stds : ndarray, shape (M, 2)
        (σβ, σr) of each reading.
    robust
        Kind and scale of the robust kernel.
    damping : float
        Levenberg-Marquardt's: the part by which readings count more against a step.
    out
        Filled.
    """
    curvature, slope = np.zeros((3, 3)), np.zeros(3)
    coupling = np.zeros((3, len(landmarks)))
    noise, room = np.empty((3, 3)), np.empty((5, 3, 3))
    out.blocks[:] = 0.0
    out.right[:] = 0.0
    for k in range(len(poses) - 1, -1, -1):
        width = drive.widths[k]
        before = curvature[0, 0], curvature[1, 1], curvature[2, 2]
        for j in range(drive.firsts[k], drive.firsts[k + 1]):
            _absorb(
                poses,
                landmarks,
                drive,
                (k, j),
                (stds[j, 0], stds[j, 1], robust[0], robust[1]),
                curvature,
                slope,
                coupling,
                out,
            )
        for i in range(3):
            curvature[i, i] += damping * (curvature[i, i] - before[i])
            out.slopes[k, i] = slope[i]
            for j in range(3):
                out.curvatures[k, i, j] = curvature[i, j]
        _noise_in_world(poses, drive, k, noise, out.shifts[k])
        _minimise(curvature, slope, noise, room, out.gains[k])
        _minimise_landmarks(coupling, width, k, room, out)
        _shift(curvature, slope, coupling, width, k, out)
        if k > 0:
            turned = poses[k - 1, 1] - poses[k, 1], poses[k, 0] - poses[k - 1, 0]
            _change_pose(curvature, slope, coupling, width, turned)
    for i in range(len(out.blocks)):
        for axis in range(2):
            out.blocks[i, axis, axis] *= 1 + damping


@njit_internal
def _absorb(
    poses: Array,
    landmarks: Array,
    drive: DriveArrays,
    where: tuple[int, int],
    noise: tuple[float, float, float, float],
    curvature: Array,
    slope: Array,
    coupling: Array,
    out: Elimination,
) -> None:
    """Add reading j of pose k: Hᵀ Q⁻¹ H and Hᵀ Q⁻¹ ν, weighted by a robust kernel."""
    k, j = where
    bearing_std, range_std, kind, scale = noise
    c = drive.columns[j]
    to_bearing, to_range = innovation(poses, landmarks, drive, k, j)
    dx, dy = landmarks[c] - poses[k, 0], landmarks[c + 1] - poses[k, 1]
    bx, by, rx, ry = reading_slopes_jit(dx, dy)
    squared = (to_bearing / bearing_std) ** 2 + (to_range / range_std) ** 2
    weight = robust_weight(squared, kind, scale)
    b, r = weight / bearing_std**2, weight / range_std**2
    xx, yy = b * bx * bx + r * rx * rx, b * by * by + r * ry * ry
    xy = b * bx * by + r * rx * ry
    ux = b * bx * to_bearing + r * rx * to_range
    uy = b * by * to_bearing + r * ry * to_range
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
    for i, value in ((0, b * bx), (1, b * by)):
        curvature[i, 2] += value
        curvature[2, i] += value
    curvature[2, 2] += b
    slope[0] -= ux
    slope[1] -= uy
    slope[2] -= b * to_bearing
    coupling[0, c] -= xx
    coupling[0, c + 1] -= xy
    coupling[1, c] -= xy
    coupling[1, c + 1] -= yy
    coupling[2, c] -= b * bx
    coupling[2, c + 1] -= b * by


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
    coupling: Array, width: int, k: int, room: Array, out: Elimination
) -> None:
    """Write W; B ← Tᵀ B, η ← η − Wᵀ Uᵀ λ."""
    T, U, rows = room[0], out.gains[k], out.rows[k]
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
def _shift(
    curvature: Array,
    slope: Array,
    coupling: Array,
    width: int,
    k: int,
    out: Elimination,
) -> None:
    """Replace q by q + s: λ ← λ − Λ s, η ← η − Bᵀ s."""
    s = out.shifts[k]
    for i in range(3):
        for j in range(3):
            slope[i] -= curvature[i, j] * s[j]
    for c in range(width):
        out.right[c] -= (
            coupling[0, c] * s[0] + coupling[1, c] * s[1] + coupling[2, c] * s[2]
        )


@njit_internal
def _change_pose(
    curvature: Array,
    slope: Array,
    coupling: Array,
    width: int,
    turned: tuple[float, float],
) -> None:
    """Write q = G δ: Λ ← Gᵀ Λ G, λ ← Gᵀ λ, B ← Gᵀ B, G = I + (turned, 0) e_θᵀ."""
    tx, ty = turned
    slope[2] += tx * slope[0] + ty * slope[1]
    for c in range(width):
        coupling[2, c] += tx * coupling[0, c] + ty * coupling[1, c]
    for j in range(3):
        curvature[2, j] += tx * curvature[0, j] + ty * curvature[1, j]
    for i in range(3):
        curvature[i, 2] += tx * curvature[i, 0] + ty * curvature[i, 1]
