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
from ..estimator.kernels.imagine import View, is_hidden, is_in_view
from ..jit import fma, jit, njit_internal, njit_reordered
from .belief_kernels import Rectangle

Pose = tuple[float, float, float, float]

SECTORS = 8
"""Number of directions around the robot, the first straight ahead."""

NEAR_REACH = 0.1
"""Distance over which near densities decay to 1 / e, in diagonals of the floor."""
FAR_REACH = 4 * NEAR_REACH
"""The same of far densities."""

AHEAD, ASIDE, DISTANCE = range(3)  # rows of an array of points
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


class Lobes(NamedTuple):
    """Weighted sums over points with the unit vectors (x, y) towards them."""

    total: float
    """Σ w"""
    xx: float
    """Σ w x²"""
    xy: float
    """Σ w x y"""
    ahead: float
    """Σ w x², of points ahead."""
    ahead_left: float
    """Σ w (x + y)² / 2, of points ahead or to the left by the same angle or more."""
    left: float
    """Σ w y², of points to the left."""
    left_behind: float
    """Σ w (y - x)² / 2, of points to the left or behind by the same angle or more."""


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

    Returns how many are unseen. The first loops have no branches, unless walls hide
    cells, so that they run on whole vector registers.
    """
    x, y, _, _ = pose
    for c in range(len(seen)):
        write_point(points, c, cells[0, c] - x, cells[1, c] - y, pose)
    if len(view.walls) == 0:
        for c in range(len(seen)):
            seen[c] |= is_in_view(points[AHEAD, c], points[DISTANCE, c], view)
    else:
        mark_not_hidden(pose, cells, view, seen, points)
    unseen = 0
    for c in range(len(seen)):
        if not seen[c]:
            points[AHEAD, unseen] = points[AHEAD, c]
            points[ASIDE, unseen] = points[ASIDE, c]
            points[DISTANCE, unseen] = points[DISTANCE, c]
            unseen += 1
    return unseen


@njit_internal
def mark_not_hidden(
    pose: Pose, cells: Array, view: View, seen: BoolArray, points: Array
) -> None:
    """Mark the cells in view that no wall hides as seen."""
    x, y, _, _ = pose
    for c in range(len(seen)):
        if seen[c] or not is_in_view(points[AHEAD, c], points[DISTANCE, c], view):
            continue
        dx, dy = cells[0, c] - x, cells[1, c] - y
        seen[c] = not is_hidden(x, y, dx, dy, view.walls)


@njit_internal
def write_point(points: Array, k: int, dx: float, dy: float, pose: Pose) -> None:
    """Write the point at p + (dx, dy) as column k of an array of points."""
    _, _, cos, sin = pose
    points[AHEAD, k] = dx * cos + dy * sin
    points[ASIDE, k] = dy * cos - dx * sin
    points[DISTANCE, k] = math.sqrt(dx * dx + dy * dy)


@njit_internal
def write_densities(
    points: Array, count: int, diagonal: float, unit: float, densities: Array
) -> None:
    """Write the densities s / (s + unit) of points in all directions φ, (16,).

    ::

        s = Σ w max(0, cos(arg δ - φ))² / 2,    w = e^{-|δ| / reach}

    Eight with the near reach, then eight with the far one. The lobes of all directions
    add up to one. Opposite directions have the same square of the cosine, so one sum
    over all points and one over those ahead serve both.
    """
    if count == 0:
        densities[:] = 0.0
        return
    far, near = sum_lobes(points, count, diagonal)
    write_lobes(near, unit, densities[:SECTORS])
    write_lobes(far, unit, densities[SECTORS:])


@njit_reordered
def sum_lobes(points: Array, count: int, diagonal: float) -> tuple[Lobes, Lobes]:
    """Sum the lobes of points with far and with near weights.

    The loop has no branches, so that it runs on whole vector registers. The
    exponential is that of a 64th part, a polynomial, squared six times; its error is
    below 1e-13. The near weight is the fourth power of the far one.
    """
    scale = -1.0 / (64 * FAR_REACH * diagonal)
    f0 = f1 = f2 = f3 = f4 = f5 = f6 = 0.0
    n0 = n1 = n2 = n3 = n4 = n5 = n6 = 0.0
    for k in range(count):
        x, y = points[AHEAD, k], points[ASIDE, k]
        xx, xy, yy = x * x, x * y, y * y
        squared = xx + yy
        half = 0.5 * squared
        ahead = xx if x > 0.0 else 0.0
        ahead_left = half + xy if x + y > 0.0 else 0.0
        left = yy if y > 0.0 else 0.0
        left_behind = half - xy if y > x else 0.0
        t = max(points[DISTANCE, k] * scale, -0.625)  # e^-40 is 0
        p = fma(t, fma(t, fma(t, 1 / 5040, 1 / 720), 1 / 120), 1 / 24)
        p = fma(t, fma(t, fma(t, fma(t, p, 1 / 6), 0.5), 1.0), 1.0)
        p *= p
        p *= p
        p *= p
        p *= p
        p *= p
        p *= p
        w = p / (squared if squared > 1e-18 else 1e-18)
        f0, f1, f2 = f0 + w * squared, f1 + w * xx, f2 + w * xy
        f3, f4 = f3 + w * ahead, f4 + w * ahead_left
        f5, f6 = f5 + w * left, f6 + w * left_behind
        w *= p * p * p
        n0, n1, n2 = n0 + w * squared, n1 + w * xx, n2 + w * xy
        n3, n4 = n3 + w * ahead, n4 + w * ahead_left
        n5, n6 = n5 + w * left, n6 + w * left_behind
    return Lobes(f0, f1, f2, f3, f4, f5, f6), Lobes(n0, n1, n2, n3, n4, n5, n6)


@njit_internal
def write_lobes(lobes: Lobes, unit: float, densities: Array) -> None:
    """Write the densities of all eight directions."""
    total, xx, xy, ahead, ahead_left, left, left_behind = lobes
    half = 0.5 * total
    write_opposites(ahead, xx, unit, densities, 0)
    write_opposites(ahead_left, half + xy, unit, densities, 1)
    write_opposites(left, total - xx, unit, densities, 2)
    write_opposites(left_behind, half - xy, unit, densities, 3)


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

    So rounding does not decide between cells that are equally near. Four comparisons
    at a time do not wait for each other.
    """
    a = b = c = d = math.inf
    whole = count & -4
    for k in range(0, whole, 4):
        a = values[k] if values[k] < a else a
        b = values[k + 1] if values[k + 1] < b else b
        c = values[k + 2] if values[k + 2] < c else c
        d = values[k + 3] if values[k + 3] < d else d
    for k in range(whole, count):
        a = values[k] if values[k] < a else a
    least = min(a, b, c, d)
    for k in range(count):
        if values[k] <= least + _TIE:
            return k
    return -1


@njit_internal
def write_direction(points: Array, k: int, diagonal: float, direction: Array) -> None:
    """Write cosine, sine, and distance in diagonals of point k; zeros for k = -1."""
    direction[:] = 0.0
    if k >= 0:
        distance = points[DISTANCE, k]
        share = 1.0 / max(distance, 1e-9)
        direction[0] = min(max(points[AHEAD, k] * share, -1.0), 1.0)
        direction[1] = min(max(points[ASIDE, k] * share, -1.0), 1.0)
        direction[2] = min(distance / diagonal, 1.0)


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
