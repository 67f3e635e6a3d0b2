"""Which points the sensor sees from a pose, compiled: range, field of view, walls.

Symbols
-------
δ = l - p       from the robot to a point [m], ahead and aside in the robot's frame
a, b            ends of a wall [m]
"""

import math
from typing import NamedTuple

import numpy as np

from ...arrays import Array
from ...jit import njit_internal

_MOUNTED = 1e-6  # a point this near to the line of a wall is mounted on it [m]
_EDGE = 1e-12  # relative; a point on the edge of the view is in view


class View(NamedTuple):
    """What limits the sight of the sensor."""

    max_range: float
    """[m]"""
    cos_half_view: float
    """Cosine of half the field of view, -inf where it sees all around."""
    walls: Array
    """Walls that hide what is behind them, rows (x0, y0, x1, y1), (W, 4) [m]."""


def as_view(max_range: float, field_of_view: float, walls: Array) -> View:
    """Return the limits of a sensor; `walls` is empty where walls do not hide."""
    half = field_of_view / 2
    ends = np.ascontiguousarray(walls, dtype=np.float64).reshape(-1, 4)
    return View(max_range, math.cos(half) if half < math.pi else -math.inf, ends)


@njit_internal
def is_in_view(ahead: float, distance: float, view: View) -> bool:
    """Return whether a point is in range and in the field of view."""
    in_range = distance <= view.max_range * (1.0 + _EDGE)
    in_field = ahead >= (view.cos_half_view - _EDGE) * distance
    return in_range & in_field  # without a branch, for loops over many points


@njit_internal
def is_hidden(x: float, y: float, dx: float, dy: float, walls: Array) -> bool:
    """Return whether a wall crosses the line of sight; its ends belong to it.

    With the ends a and b relative to p, the line to the point passes between them if
    a × δ and b × δ differ in sign. The point lies behind the wall if (a - b) × δ, which
    grows with δ, exceeds a × b::

        (a × δ)(b × δ) <= 0   and   (a - b) × δ sign(a × b) > |a × b|
    """
    for w in range(len(walls)):
        ax, ay, bx, by = walls[w, 0], walls[w, 1], walls[w, 2], walls[w, 3]
        side_a = (ax - x) * dy - (ay - y) * dx
        side_b = (bx - x) * dy - (by - y) * dx
        if side_a * side_b > 0.0:
            continue
        robot_side = (ax - x) * (by - y) - (ay - y) * (bx - x)
        nearer = abs(robot_side) + _MOUNTED * math.hypot(bx - ax, by - ay)
        if (side_a - side_b) * np.sign(robot_side) > nearer:
            return True
    return False
