"""Unscented EKF-SLAM: cubature points instead of Jacobians."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from ...arrays import Array, IntArray
from ...jit import njit_allocating
from ...kernel_variants import specialised
from ..kernels import scan_update as scan
from ..kernels.scan_update import (
    DONE,
    BeliefArrays,
    Rules,
    Workspace,
    add_landmarks,
    as_rules,
    screen,
    squared_norm,
    squared_ratio,
    update_lower_half,
    variances,
)
from ..models.bearing_range import difference_jit, expected_reading_jit
from ..models.rigid_motion import composed_jit, predict
from .ekf import EkfSlam
from .gaussian_map import move_pose, update_map


@njit_allocating
def symmetric_root(covariance: Array, size: int, points: int) -> Array:
    """Return √points times the symmetric root of P, read from its lower half."""
    values, vectors = np.linalg.eigh(covariance[:size, :size])
    root: Array = vectors * np.sqrt(points * np.maximum(values, 0.0)) @ vectors.T
    return root


@njit_allocating
def predict_through_points(
    mean: Array,
    covariance: Array,
    reference: Array,
    size: int,
    forward: float,
    sideways: float,
    turn: float,
    motion_variance: Array,
    linearisation: int,
) -> None:
    """Move a belief as :func:`.rigid_motion.predict` does, without Jacobians."""
    points = size + 3  # and as many opposite ones
    root = symmetric_root(covariance, size, points)
    deviations = np.zeros((6, points))  # of the pose, and of its motion
    for i in range(3):
        for j in range(size):
            deviations[i, j] = root[i, j]
        deviations[3 + i, size + i] = np.sqrt(points * motion_variance[i])
    poses = np.empty((3, 2 * points))
    for k in range(2 * points):
        sign, e = 1.0 if k < points else -1.0, deviations[:, k % points]
        poses[0, k], poses[1, k], poses[2, k], _, _ = composed_jit(
            sign * e[0],  # relative to the mean: averages of large numbers lose digits
            sign * e[1],
            mean[2] + sign * e[2],
            forward + sign * e[3],
            sideways + sign * e[4],
            turn + sign * e[5],
        )
    for i in range(3):
        way = poses[i].mean()
        poses[i] -= way
        mean[i] = way if i == 2 else mean[i] + way
    cross = (poses[:, :size] - poses[:, points : points + size]) @ root
    for i in range(3):
        for j in range(3):
            covariance[i, j] = (poses[i] * poses[j]).mean()
        for j in range(3, size):
            covariance[i, j] = covariance[j, i] = cross[i, j] / (2 * points)


@njit_allocating
def update_through_points(
    arrays: tuple[Array, Array, Array],
    size: int,
    readings: Array,
    count: int,
    ledger: IntArray,
    work_arrays: tuple[Array, Array],
    rule_values: Array,
) -> tuple[int, int, float]:
    """Update a belief as `update_lower_half` does, without Jacobians."""
    belief, workspace = BeliefArrays(*arrays), Workspace(*work_arrays)
    rows, rules = workspace.rows, as_rules(rule_values)
    used = screen(belief, readings, count, rules, np.inf, rows, ledger)
    if used < 0:
        return used, 0, 0.0
    if used > 0:
        root = symmetric_root(belief.covariance, size, size)
        spread, used = look_from_points(belief.mean, root, rules, rows, ledger, count)
        failed = condition(belief, root, spread[: 2 * used], rows, ledger[scan.COLUMN])
        if failed >= 0:
            return failed // 2, used, 0.0
    add_landmarks(belief, size, readings, count, rules, ledger)
    return DONE, used, squared_norm(rows, used)


@njit_allocating
def look_from_points(
    mean: Array, root: Array, rules: Rules, rows: Array, ledger: IntArray, count: int
) -> tuple[Array, int]:
    """Return what each point reads, less the average of all points, (2m, 2n), and m.

    These are the m readings within the gate.  The function also writes their ν to the
    system, and the diagonal of their Q at the mean distance of the points.
    """
    size, system, read, used = len(root), rows[scan.FIRST :], 0, 0
    spread = np.empty((2 * count, 2 * size))
    for k in range(count):
        if ledger[scan.OUTCOME, k] != scan.USED:
            continue
        row, c = 2 * used, ledger[scan.COLUMN, read]
        meta = system[2 * read : 2 * read + 2]
        z0, z1 = meta[0, scan.READING], meta[1, scan.READING]
        v0, v1 = meta[0, scan.VARIANCE], meta[1, scan.VARIANCE]
        read, distance, first, second = read + 1, 0.0, spread[row], spread[row + 1]
        dx, dy = mean[c] - mean[0], mean[c + 1] - mean[1]
        e0, e1 = expected_reading_jit(dx, dy, mean[2])
        for i in range(2 * size):
            sign, e = 1.0 if i < size else -1.0, root[i % size]
            to_x, to_y = dx + sign * (e[c] - e[0]), dy + sign * (e[c + 1] - e[1])
            r0, r1 = expected_reading_jit(to_x, to_y, mean[2] + sign * e[2])
            first[i], second[i] = difference_jit(r0, r1, e0, e1)
            distance += np.sqrt(to_x * to_x + to_y * to_y)
        if not rules.noise_as_read:
            v0, v1 = variances(rules, distance / (2 * size))
        a0, a1 = first.mean(), second.mean()
        first -= a0
        second -= a1
        n0, n1 = difference_jit(z0, z1, e0 + a0, e1 + a1)
        if rules.gate < np.inf:
            s00, s10 = (first * first).mean() + v0, (first * second).mean()
            s11 = (second * second).mean() + v1
            if not squared_ratio(n0, n1, s00, s10, s11) <= rules.gate:
                ledger[scan.OUTCOME, k] = scan.GATED
                continue
        system[row, scan.INNOVATION], system[row + 1, scan.INNOVATION] = n0, n1
        system[row, scan.VARIANCE], system[row + 1, scan.VARIANCE] = v0, v1
        ledger[scan.COLUMN, used] = c
        used += 1
    return spread, used


@njit_allocating
def condition(
    belief: BeliefArrays, root: Array, spread: Array, rows: Array, columns: IntArray
) -> int:
    """Condition a belief on readings with the spread Δ over the points.

    ::

        S = Δ Δᵀ / 2n + Q = L Lᵀ,   A = L⁻¹ Δ Dᵀ / 2n,   w = L⁻¹ ν
        x ← x + Aᵀ w,   P ← P − Aᵀ A

    with the deviations D of the points.  Returns -1, or the row at which S is not
    positive definite; the belief is then as before.
    """
    (bottom, points), size, system = spread.shape, len(root), rows[scan.FIRST :]
    scan.begin_correction(size, rows, system, bottom)
    delta, A = rows[scan.CORRECTION], (spread[:, :size] - spread[:, size:]) @ root
    L = spread @ spread.T
    for i in range(bottom):
        row, w = system[i], system[i, scan.INNOVATION]
        row[: len(belief.mean)] = 0.0
        for j in range(size):
            row[j] = A[i, j] / points
        own = L[i, i] / points + row[scan.VARIANCE]
        rest = own
        for k in range(i):
            factor = L[i, k] / points
            for j in range(k):
                factor -= L[i, j] * L[k, j]
            L[i, k] = factor = factor / L[k, k]
            rest -= factor * factor
            w -= factor * system[k, scan.WHITE]
            for j in range(size):
                row[j] -= factor * system[k, j]
        if not rest > scan.SINGULAR * own:
            return i
        L[i, i] = root_of_rest = np.sqrt(rest)
        row[scan.WHITE] = w / root_of_rest
        for j in range(size):
            row[j] /= root_of_rest
            delta[j] += row[scan.WHITE] * row[j]
    for j in range(size):
        belief.mean[j] += delta[j]
    scan.downdate(belief.covariance, size, system, 0, bottom)
    for j in range(size):  # below zero by rounding alone
        belief.covariance[j, j] = max(belief.covariance[j, j], 0.0)
    scan.restore_upper(belief.covariance, size)
    record(L, system, columns)
    return -1


@njit_allocating
def record(L: Array, system: Array, columns: IntArray) -> None:
    """Leave L where a report looks for H Aᵀ, with H that selects a column."""
    for i in range(len(L)):
        c = columns[i // 2] + i % 2
        system[i, scan.ROOT] = L[i, i & -2]
        system[i, scan.ROOT + 1] = L[i, i] * (i % 2)
        system[i, scan.JACOBIAN : scan.JACOBIAN + 5] = 0.0
        system[i, scan.LANDMARK_X + i % 2] = 1.0
        for j in range(len(L)):
            system[j, c] = L[i, j]


INSTEAD: dict[Callable[..., Any], Callable[..., Any]] = {
    predict: predict_through_points,
    update_lower_half: update_through_points,
}
move_by_points = specialised(move_pose, INSTEAD, "unscented")
update_by_points = specialised(update_map, INSTEAD, "unscented")


class UnscentedSlam(EkfSlam):
    """Unscented filter with cubature points and wrapped angles; dense, O(n³) per step.

    The models transform the 2N points mean ± √N Lᵢ, L Lᵀ = P, each of weight 1/2N [1]_
    [2]_.  L is symmetric.  To predict, the state is extended by the motion noise.  New
    landmarks are initialised by linearisation, as in ``ekf``.  The filter needs no
    Jacobians, but is as overconfident about its heading as the EKF: use it for
    comparison only.

    Parameters are those of :class:`EkfSlam`.

    References
    ----------
    .. [1] S. Julier, J. Uhlmann, A new extension of the Kalman filter to nonlinear
       systems, SPIE AeroSense, 1997.
    .. [2] I. Arasaratnam, S. Haykin, Cubature Kalman filters, IEEE TAC 54(6), 2009.
    """

    update_kernel = staticmethod(update_by_points)
    move_kernel = staticmethod(move_by_points)
