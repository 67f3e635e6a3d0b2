"""Linearisation of one reading, compiled: its rows of H and its innovation.

For a reading of the landmark in columns c, c+1 of the state only five columns of H
differ from zero: (x, y, θ, c, c+1).  A row of H is stored as these five entries.
"""

from ...arrays import Array
from ...jit import njit_internal
from ..models.bearing_range import (
    expected_reading_jit,
    reading_slopes_jit,
    wrap_angle_jit,
)
from .rules import AT_REFERENCE, AT_TRUTH, PROJECTED
from .scan_rows import INNOVATION, JACOBIAN, READING


@njit_internal
def linearise(
    mean: Array,
    reference: Array,
    linearisation: int,
    system: Array,
    row: int,
    column: int,
) -> None:
    """Fill H and ν of the reading in ``row`` and the next, eqs. 1.4 to 1.6."""
    H = system[row : row + 2, JACOBIAN : JACOBIAN + 5]
    z, nu = system[row : row + 2, READING], system[row : row + 2, INNOVATION]
    dx, dy = mean[column] - mean[0], mean[column + 1] - mean[1]
    bearing, distance = expected_reading_jit(dx, dy, mean[2])
    nu[0], nu[1] = wrap_angle_jit(z[0] - bearing), z[1] - distance
    if linearisation in (AT_REFERENCE, AT_TRUTH):
        dx = reference[column] - reference[0]
        dy = reference[column + 1] - reference[1]
    bearing_x, bearing_y, range_x, range_y = reading_slopes_jit(dx, dy)
    H[0, 0], H[0, 1], H[0, 2] = -bearing_x, -bearing_y, -1.0
    H[1, 0], H[1, 1], H[1, 2] = -range_x, -range_y, 0.0
    H[0, 3], H[0, 4] = bearing_x, bearing_y
    H[1, 3], H[1, 4] = range_x, range_y
    if linearisation == PROJECTED:
        _project(reference, column, H)


@njit_internal
def _project(reference: Array, column: int, H: Array) -> None:
    """H ← H − (H w) wᵀ / wᵀw: blind to the rotation w of robot and landmark together.

    w is J δ of the reference points, spread about their midpoint: the part of a
    rotation about the origin that is orthogonal to both translations, to which H is
    blind anyway.
    """
    half_x = (reference[column] - reference[0]) / 2
    half_y = (reference[column + 1] - reference[1]) / 2
    squared = 1 + 2 * (half_x * half_x + half_y * half_y)
    for i in range(2):
        along_x, along_y = H[i, 0] - H[i, 3], H[i, 1] - H[i, 4]
        turned = along_x * half_y - along_y * half_x + H[i, 2]
        seen = turned / squared
        H[i, 0] -= seen * half_y
        H[i, 1] += seen * half_x
        H[i, 2] -= seen
        H[i, 3] += seen * half_y
        H[i, 4] -= seen * half_x
