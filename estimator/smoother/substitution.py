"""Go back over the eliminated poses, forwards in time, compiled.

With the step δ_l of the landmarks, in the symbols of :mod:`.elimination`::

    δ_k = q − U (Uᵀ (Λ q − λ) + W δ_l),    q = G δ_{k−1} + s

and the covariance of pose k follows from that of pose k − 1.
"""

from __future__ import annotations

import numpy as np

from ...arrays import Array
from ...jit import jit, njit_internal
from ..models.bearing_range import wrap_angle_jit
from ..models.rigid_motion import composed_jit
from .drive_arrays import DriveArrays
from .elimination import Elimination
from .small_matrices import complement, multiply, right_transposed


@jit
def substitute(
    poses: Array, drive: DriveArrays, landmark_step: Array, out: Elimination
) -> Array:
    """Return the new poses, shape (N, 3), given the step of the landmarks.

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
        _pull(k, q, landmark_step, out, u)
        U = out.gains[k]
        dx = -(U[0, 0] * u[0] + U[0, 1] * u[1] + U[0, 2] * u[2])
        dy = -(U[1, 0] * u[0] + U[1, 1] * u[1] + U[1, 2] * u[2])
        new[k, 0], new[k, 1], _, _, _ = composed_jit(x, y, turn, dx, dy, 0.0)
        new[k, 2] = heading - (U[2, 0] * u[0] + U[2, 1] * u[1] + U[2, 2] * u[2])
    return new


@njit_internal
def _pull(
    k: int, q: Array, landmark_step: Array, out: Elimination, pull: Array
) -> None:
    """Write Uᵀ (Λ q − λ) + W δ_l."""
    pull[:] = 0.0
    for i in range(3):
        for c in range(len(landmark_step)):
            pull[i] += out.rows[k, i, c] * landmark_step[c]
    for a in range(3):
        force = -out.slopes[k, a]
        for j in range(3):
            force += out.curvatures[k, a, j] * q[j]
        for i in range(3):
            pull[i] += out.gains[k, a, i] * force


@jit
def conditionals(poses: Array, out: Elimination) -> tuple[Array, Array]:
    """Return the covariance of each pose given the landmarks, and its transition.

    ::

        x_k = Φ_k x_{k−1} − U_k W_k l + U_k n,    n ~ N(0, I),    Φ_k = T_k G_k
        Π_k = Φ_k Π_{k−1} Φ_kᵀ + K_k,    Ψ_k = Φ_k Ψ_{k−1} − U_k W_k

    so that the error of pose k is Ψ_k e_l plus independent noise of covariance Π_k.
    Ψ overwrites the rows W.

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
        rows = out.rows[k]
        for c in range(rows.shape[1]):
            x, y, z = rows[0, c], rows[1, c], rows[2, c]
            for i in range(3):
                rows[i, c] = -(U[i, 0] * x + U[i, 1] * y + U[i, 2] * z)
        if k > 0:
            tx, ty = poses[k - 1, 1] - poses[k, 1], poses[k, 0] - poses[k - 1, 0]
            before = out.rows[k - 1]
            for i in range(3):
                phi[i, 2] += tx * phi[i, 0] + ty * phi[i, 1]
                for c in range(rows.shape[1]):
                    rows[i, c] += (
                        phi[i, 0] * before[0, c]
                        + phi[i, 1] * before[1, c]
                        + phi[i, 2] * before[2, c]
                    )
            multiply(phi, covariances[k - 1], moved)
            right_transposed(moved, phi, covariances[k])
        for i in range(3):
            for j in range(3):
                covariances[k, i, j] += K[i, j]
    return covariances, transitions
