"""Compiled kernels of the floor: cells not yet seen, distances to walls, directions.

Symbols
-------
p = (x, y, cos θ, sin θ)   believed pose
δ                          from the robot to a point, ahead and aside in its frame [m]
"""

import math
from typing import Any, NamedTuple

import numpy as np

from ..arrays import Array, BoolArray
from ..estimator.kernels.in_view import View, is_hidden, is_in_view
from ..jit import jit, njit_internal
from .belief_kernels import Rectangle

Pose = tuple[float, float, float, float]

SECTORS = 8
"""Number of directions around the robot, the first straight ahead."""

NEAR_REACH = 0.1
"""Distance over which near densities decay to 1 / e, in diagonals of the floor."""
FAR_REACH = 4 * NEAR_REACH
"""The same of far densities."""

AHEAD, ASIDE, DISTANCE, NEAR, FAR = range(5)  # rows of an array of points
_TIE = 1e-9  # values no farther apart count as equal
_CORNER = 1e-9  # a ray through a corner hits one of its walls
_COS = np.cos(2 * np.pi * np.arange(SECTORS) / SECTORS)
_SIN = np.sin(2 * np.pi * np.arange(SECTORS) / SECTORS)


class Floor(NamedTuple):
    """The plan of a floor and the sight of the robot on it."""

    cells: Array
    """x and y of the centres of the cells, shape (2, C) [m]."""
    walls: Array
    """Rows (x0, y0, x1, y1), shape (W, 4) [m]."""
    bounds: Rectangle
    diagonal: float
    """Of the bounds [m]."""
    sight: View


@jit
def cells_in_view(
    poses: Array, cells: Array, view: tuple[Any, ...], seen: BoolArray
) -> None:
    """Mark the cells (2, C) in view from any of poses (B, T, 3), in `seen` (B, C)."""
    points = np.empty((3, cells.shape[1]))
    for b in range(len(poses)):
        for t in range(poses.shape[1]):
            x, y, heading = poses[b, t, 0], poses[b, t, 1], poses[b, t, 2]
            pose = x, y, math.cos(heading), math.sin(heading)
            look_around(pose, cells, View(*view), seen[b], points)


@njit_internal
def look_around(
    pose: Pose, cells: Array, view: View, seen: BoolArray, points: Array
) -> int:
    """Mark the cells in view as seen, and write those still unseen as points.

    Returns how many are unseen. The first loop has no branches, so that it runs on
    whole vector registers.
    """
    x, y, _, _ = pose
    for c in range(len(seen)):
        write_point(points, c, cells[0, c] - x, cells[1, c] - y, pose)
    unseen = 0
    for c in range(len(seen)):
        if seen[c]:
            continue
        ahead, aside, distance = points[AHEAD, c], points[ASIDE, c], points[DISTANCE, c]
        if is_in_view(ahead, distance, view):
            dx, dy = cells[0, c] - x, cells[1, c] - y
            seen[c] = not is_hidden(x, y, dx, dy, view.walls)
        if not seen[c]:
            points[AHEAD, unseen], points[ASIDE, unseen] = ahead, aside
            points[DISTANCE, unseen] = distance
            unseen += 1
    return unseen


@njit_internal
def write_point(points: Array, k: int, dx: float, dy: float, pose: Pose) -> None:
    """Write the point at p + (dx, dy) as column k of an array of points."""
    _, _, cos, sin = pose
    points[AHEAD, k] = dx * cos + dy * sin
    points[ASIDE, k] = dy * cos - dx * sin
    points[DISTANCE, k] = math.sqrt(dx * dx + dy * dy)


@njit_internal
def measure_points(points: Array, count: int, diagonal: float) -> None:
    """Replace points by their directions (cos, sin), and add both weights.

    The weights are e^{-distance / reach}. The loop has no branches, so that it runs on
    whole vector registers: the exponential is that of a 64th part, a polynomial,
    squared six times. Its relative error is below 1e-13.
    """
    scale = -1.0 / (64 * FAR_REACH * diagonal)
    for k in range(count):
        distance = points[DISTANCE, k]
        share = 1.0 / max(distance, 1e-9)
        points[AHEAD, k] *= share
        points[ASIDE, k] *= share
        t = max(distance * scale, -0.625)  # e^-40 is 0
        p = 1 / 5040 + t * (1 / 40320 + t * (1 / 362880 + t / 3628800))
        p = 1 / 6 + t * (1 / 24 + t * (1 / 120 + t * (1 / 720 + t * p)))
        p = 1.0 + t * (1.0 + t * (0.5 + t * p))
        p *= p
        p *= p
        p *= p
        p *= p
        p *= p
        p *= p
        points[FAR, k] = p
        p *= p
        points[NEAR, k] = p * p


@njit_internal
def write_densities(
    points: Array, weights: int, count: int, unit: float, densities: Array
) -> None:
    """Write the densities s / (s + unit) of points in all directions φ, (8,).

    ::

        s = Σ w max(0, cos(arg δ - φ))² / 2,    w in the row `weights` of the points

    The lobes of all directions add up to one. Opposite directions have the same square
    of the cosine, so one sum over all points and one over those ahead serve both.
    """
    total, total_xx, total_xy = 0.0, 0.0, 0.0
    ahead, ahead_left, left, left_behind = 0.0, 0.0, 0.0, 0.0
    for k in range(count):
        x, y, w = points[AHEAD, k], points[ASIDE, k], points[weights, k]
        xx, xy = w * (x * x), w * (x * y)
        half = 0.5 * (xx + w * (y * y))
        total += 2.0 * half
        total_xx += xx
        total_xy += xy
        ahead += xx if x > 0.0 else 0.0
        ahead_left += half + xy if x + y > 0.0 else 0.0
        left += 2.0 * half - xx if y > 0.0 else 0.0
        left_behind += half - xy if y > x else 0.0
    half = 0.5 * total
    write_opposites(ahead, total_xx, unit, densities, 0)
    write_opposites(ahead_left, half + total_xy, unit, densities, 1)
    write_opposites(left, total - total_xx, unit, densities, 2)
    write_opposites(left_behind, half - total_xy, unit, densities, 3)


@njit_internal
def write_opposites(
    part: float, total: float, unit: float, densities: Array, k: int
) -> None:
    """Write the densities of direction k, and of the opposite one: the remainder."""
    ahead, behind = max(0.5 * part, 0.0), max(0.5 * (total - part), 0.0)
    densities[k] = ahead / (ahead + unit)
    densities[k + SECTORS // 2] = behind / (behind + unit)


@njit_internal
def first_smallest(values: Array, count: int) -> int:
    """Return the first index whose value is within 1e-9 of the smallest.

    So rounding does not decide between cells that are equally near.
    """
    least = math.inf
    for k in range(count):
        least = min(least, values[k])
    for k in range(count):
        if values[k] <= least + _TIE:
            return k
    return -1


@njit_internal
def write_direction(points: Array, k: int, diagonal: float, direction: Array) -> None:
    """Write cosine, sine, and distance in diagonals of point k; zeros for k = -1."""
    direction[:] = 0.0
    if k >= 0:
        direction[0] = min(max(points[AHEAD, k], -1.0), 1.0)
        direction[1] = min(max(points[ASIDE, k], -1.0), 1.0)
        direction[2] = min(points[DISTANCE, k] / diagonal, 1.0)


@njit_internal
def write_wall_distances(
    pose: Pose, walls: Array, diagonal: float, unit: float, shares: Array
) -> None:
    """Write the distance d to the wall as d / (d + unit), d at most the diagonal."""
    x, y, cos, sin = pose
    for k in range(SECTORS):
        rx, ry = cos * _COS[k] - sin * _SIN[k], sin * _COS[k] + cos * _SIN[k]
        nearest = diagonal
        for w in range(len(walls)):
            sx, sy = walls[w, 0] - x, walls[w, 1] - y
            wx, wy = walls[w, 2] - walls[w, 0], walls[w, 3] - walls[w, 1]
            across = rx * wy - ry * wx
            if abs(across) < 1e-12:  # parallel
                continue
            distance = (sx * wy - sy * wx) / across
            share = (sx * ry - sy * rx) / across
            if distance >= 0.0 and -_CORNER <= share <= 1.0 + _CORNER:
                nearest = min(nearest, distance)
        shares[k] = nearest / (nearest + unit)
