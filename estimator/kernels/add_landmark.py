"""Landmark initialisation from one reading, compiled."""

from ...jit import njit_internal
from ..models.bearing_range import located_jit
from .belief_arrays import BeliefArrays
from .rules import AT_ESTIMATE, AT_REFERENCE, PROJECTED


@njit_internal
def add_landmark(
    belief: BeliefArrays,
    size: int,
    bearing: float,
    distance: float,
    bearing_variance: float,
    range_variance: float,
    linearisation: int,
    correlated: bool,
) -> None:
    """Append the landmark of one reading, eq. 1.3, with its correlation to all else.

    ::

        P_l* = F_p P_p*,    P_ll = F_p P_pp F_pᵀ + F_z Q F_zᵀ

    Not ``correlated``: P_l* = 0, the initialisation that makes a filter overconfident.
    """
    mean, P, reference = belief
    r, c = distance, size
    lx, ly, cos, sin = located_jit(mean[0], mean[1], mean[2], bearing, r)
    mean[c], mean[c + 1] = lx, ly
    turned_x, turned_y = -r * sin, r * cos
    if linearisation in (AT_REFERENCE, PROJECTED):
        reference[c], reference[c + 1] = lx, ly
    if linearisation != AT_ESTIMATE:
        turned_x = reference[1] - reference[c + 1]
        turned_y = reference[c] - reference[0]
    x, y = P[c], P[c + 1]
    for j in range(size):
        x[j] = P[0, j] + turned_x * P[2, j]
        y[j] = P[1, j] + turned_y * P[2, j]
    across, along = bearing_variance * r * r, range_variance
    x[c] = x[0] + turned_x * x[2] + cos * cos * along + sin * sin * across
    y[c] = y[0] + turned_x * y[2] + cos * sin * (along - across)
    y[c + 1] = y[1] + turned_y * y[2] + sin * sin * along + cos * cos * across
    x[c + 1] = y[c]
    for j in range(size):
        if not correlated:
            x[j] = y[j] = 0.0
        P[j, c], P[j, c + 1] = x[j], y[j]
