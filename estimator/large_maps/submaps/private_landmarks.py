"""Landmarks that a single submap holds, as functions of the unknowns of the join."""

from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_solve

from ....arrays import Array, IntArray
from ...models.rigid_motion import ErrorFrame
from ..sparse_cholesky.coordinates import pairs
from .factor import FactorError, inverse_spread, regularised
from .gaussian import times
from .store import Submap


class PrivateLandmarks(NamedTuple):
    """n landmarks of a single submap, in the world."""

    points: Array
    """Shape (2n,) [m]."""
    jacobian: Array
    """By the unknowns of the submap, shape (2n, u)."""
    covariance: Array
    """Conditional covariance given these unknowns, shape (2n, 2n)."""


def private_landmarks(
    submap: Submap,
    shared: IntArray,
    wanted: IntArray,
    start: Array,
    factor: FactorError,
    frame: ErrorFrame,
) -> PrivateLandmarks:
    """Transform landmarks that only one submap holds into the world.

    Given the error e_b of the shared part, their error is e_p = G e_b + w, with noise
    w::

        G = P_pb P_bb⁻¹,    cov w = P_pp − G P_bp
        Y_p = V(t) (G e_b + w) + R(t) m̂_p,     l = p_k + R(θ_k) Y_p

    Parameters
    ----------
    submap : Submap
    shared : ndarray
        Rows of the pose and the shared landmarks in the submap's state.
    wanted : ndarray, shape (n,)
        Slots of the landmarks.
    start : ndarray, shape (3,)
        Frame of the submap in the world.
    factor : FactorError
        e_b, and its derivative by the unknowns of the submap.  The derivative by
        ``start`` comes first; it is left out if the frame is fixed.
    frame : {"additive", "invariant"}
        Coordinates of the error.
    """
    error, jacobian = factor
    by_slot = {slot: place for place, slot in enumerate(submap.slots.tolist())}
    rows = 3 + pairs([by_slot[slot] for slot in wanted.tolist()])
    P = submap.covariance
    P_bp = P[shared[:, None], rows]
    lower = np.linalg.cholesky(regularised(P[shared[:, None], shared]))
    G = cho_solve((lower, True), P_bp, check_finite=False).T
    points = submap.mean[rows[::2]] + 1j * submap.mean[rows[1::2]]
    moved = (G @ error).view(np.complex128)
    by_unknowns = G @ jacobian
    scale = 1.0 + 0.0j
    if frame == "additive":
        seen = points + moved
    else:
        turn = float(error[2])
        scale, slope = inverse_spread(turn)
        turned = np.exp(1j * turn) * points
        seen = turned + moved / scale
        by_turn = slope * (seen - turned) - 1j * scale * turned
        by_unknowns -= np.outer(by_turn.view(np.float64), jacobian[2])
    out = np.exp(1j * start[2])
    by_unknowns = times(out / scale, by_unknowns)
    if by_unknowns.shape[1] > len(error):  # the start is an unknown, too
        by_unknowns[0::2, 0] += 1.0
        by_unknowns[1::2, 1] += 1.0
        by_unknowns[:, 2] += (1j * out * seen).view(np.float64)
    noise = P[rows[:, None], rows] - G @ P_bp
    noise = times(out / scale, times(out / scale, noise).T)
    world = complex(*start[:2]) + out * seen
    return PrivateLandmarks(world.view(np.float64), by_unknowns, (noise + noise.T) / 2)
