"""Move of one belief by one odometry reading, compiled.

Symbols are those of the motion model.
"""

from ...arrays import Array
from ...jit import jit, njit_internal
from ..models.rigid_motion import composed_jit
from .kalman_gain import AT_ESTIMATE


@jit
def predict(
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
    """Move a belief by a displacement in the robot's frame, in place; eqs. 1.1 and 1.2.

    Linearised elsewhere than at the estimate, G is taken over the displacement between
    the predicted positions, which the reference keeps.
    """
    x, y, heading, cos, sin = composed_jit(
        mean[0], mean[1], mean[2], forward, sideways, turn
    )
    mean[0], mean[1], mean[2] = x, y, heading
    turned_x = -(forward * sin + sideways * cos)
    turned_y = forward * cos - sideways * sin
    if linearisation != AT_ESTIMATE:
        turned_x, turned_y = -(y - reference[1]), x - reference[0]
        reference[0], reference[1], reference[2] = x, y, heading
    propagate(covariance, size, turned_x, turned_y, cos, sin, motion_variance)


@njit_internal
def propagate(
    covariance: Array,
    size: int,
    turned_x: float,
    turned_y: float,
    cos: float,
    sin: float,
    motion_variance: Array,
) -> None:
    """P ← G P Gᵀ + F R Fᵀ with G = I + (turned_x, turned_y, 0, …) e_θᵀ, in O(size).

    F rotates the noise, whose covariance R is diagonal, by the heading (cos, sin).
    """
    P = covariance
    for j in range(size):
        P[0, j] += turned_x * P[2, j]
        P[1, j] += turned_y * P[2, j]
    for j in range(3, size):
        P[j, 0] = P[0, j]
        P[j, 1] = P[1, j]
    for i in range(3):
        P[i, 0] += turned_x * P[i, 2]
        P[i, 1] += turned_y * P[i, 2]
    along, across = motion_variance[0], motion_variance[1]
    P[0, 0] += cos * cos * along + sin * sin * across
    P[1, 1] += sin * sin * along + cos * cos * across
    P[1, 0] += cos * sin * (along - across)
    P[0, 1] = P[1, 0]
    P[2, 2] += motion_variance[2]
