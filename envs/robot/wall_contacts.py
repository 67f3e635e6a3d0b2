"""Contacts of a round body with straight walls, by queries of the physics engine."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import pymunk

from ...arrays import Array, ComplexArray, IntArray
from ...jit import jit, njit_internal

Wall = tuple[float, float, float, float]

_SKIN = 1e-6  # distance kept from every wall [m]
_NEAR = 1e-3  # walls farther away than this on the whole way are not queried [m]
_ANYTHING = pymunk.ShapeFilter()


def wall_distances(points: ComplexArray, start: ComplexArray, along: Any) -> Array:
    """Compute the distances of points from walls.

    Parameters
    ----------
    points : complex ndarray, shape (…)
        x + iy [m].
    start, along : complex ndarray, shape (W,)
        One end of each wall, and the vector from it to the other end [m].

    Returns
    -------
    ndarray, shape (…, W)
        [m].
    """
    apart = points[..., None] - start
    squared = along.real**2 + along.imag**2
    foot = np.clip((apart * along.conj()).real / squared, 0.0, 1.0)
    return np.asarray(np.abs(apart - foot * along))


class WallContacts:
    """Computes how far a disc can move before walls stop it.

    The queries use walls inflated by the radius of the disc (a thick segment with a
    disc at either end), because Chipmunk's own queries with a radius miss contacts.

    Parameters
    ----------
    radius : float
        Of the disc [m].
    walls : sequence of (x0, y0, x1, y1)
        Ends of straight walls [m].

    Examples
    --------
    >>> contacts = WallContacts(radius=0.5, walls=[(2.0, -1.0, 2.0, 1.0)])
    >>> round(contacts.free_share(0.0, 0.0, dx=3.0, dy=0.0), 6)
    0.5
    """

    def __init__(self, radius: float, walls: Sequence[Wall] = ()) -> None:
        self._radius = radius
        self._walls = tuple(walls)
        self._space = pymunk.Space()
        for wall in self._walls:
            self._space.add(*_inflated(wall, radius, self._space.static_body))
        self._ends = np.array(self._walls, dtype=np.float64).reshape(-1, 4)

    def free_share(self, x: float, y: float, dx: float, dy: float) -> float:
        """Return the share of a displacement up to 1 µm before the first contact.

        A wall does not stop a body that moves away from it, even from inside. So the
        body can always leave a wall.

        Parameters
        ----------
        x, y, dx, dy : float
            Start and displacement [m].

        Returns
        -------
        float
            In [0, 1].
        """
        share = 1.0
        for hit in self._space.segment_query((x, y), (x + dx, y + dy), 0.0, _ANYTHING):
            nx, ny = _outward(hit, (x, y))
            approach = -(dx * nx + dy * ny)
            if approach > 0.0:
                share = min(share, hit.alpha - _SKIN / approach)
        return max(share, 0.0)

    def free_shares(self, x: Array, y: Array, dx: Array, dy: Array) -> Array:
        """Return the shares of B displacements, arrays of shape (B,) [m]."""
        shares = np.ones(len(x))
        near = np.empty(len(x), dtype=np.int64)
        count = _find_near((x, y, dx, dy), self._ends, self._radius + _NEAR, near)
        for k in near[:count].tolist():
            shares[k] = self.free_share(x.item(k), y.item(k), dx.item(k), dy.item(k))
        return shares

    def __getstate__(self) -> dict[str, Any]:
        return {"radius": self._radius, "walls": self._walls}

    def __setstate__(self, state: dict[str, Any]) -> None:
        WallContacts.__init__(self, state["radius"], state["walls"])


def _inflated(wall: Wall, radius: float, ground: pymunk.Body) -> list[pymunk.Shape]:
    """Make the shapes that the centre of the body must not enter."""
    a, b = wall[:2], wall[2:]
    return [
        pymunk.Segment(ground, a, b, radius),
        pymunk.Circle(ground, radius, a),
        pymunk.Circle(ground, radius, b),
    ]


def _outward(
    hit: pymunk.SegmentQueryInfo, start: tuple[float, float]
) -> tuple[float, float]:
    """Return the outward normal; that of a path from inside points inwards."""
    if hit.alpha > 0.0 or hit.shape is None:
        return hit.normal
    return hit.shape.point_query(start).gradient


@jit
def _find_near(
    moves: tuple[Array, Array, Array, Array],
    walls: Array,
    reach: float,
    near: IntArray,
) -> int:
    """List the moves (x, y, dx, dy) that come within reach of a wall; return how many.

    A wall beyond the length of the move from its start is out of reach at once.
    """
    x, y, dx, dy = moves
    count = 0
    for k in range(len(x)):
        way = x[k], y[k], x[k] + dx[k], y[k] + dy[k]
        length = math.sqrt(dx[k] * dx[k] + dy[k] * dy[k])
        if length == 0.0:  # a wall stops only approaches
            continue
        for w in range(len(walls)):
            wall = walls[w, 0], walls[w, 1], walls[w, 2], walls[w, 3]
            if _gap(way[0], way[1], wall) <= reach + length and _meet(way, wall, reach):
                near[count] = k
                count += 1
                break
    return count


@njit_internal
def _meet(way: Wall, wall: Wall, reach: float) -> bool:
    """Return whether two segments come within reach of each other."""
    if _has_ends_apart(way, wall) and _has_ends_apart(wall, way):
        return True
    gap = min(_gap(way[0], way[1], wall), _gap(way[2], way[3], wall))
    return min(gap, _gap(wall[0], wall[1], way), _gap(wall[2], wall[3], way)) <= reach


@njit_internal
def _gap(x: float, y: float, segment: Wall) -> float:
    """Compute the distance of a point from a segment."""
    ax, ay, bx, by = segment
    along_x, along_y, apart_x, apart_y = bx - ax, by - ay, x - ax, y - ay
    squared = along_x * along_x + along_y * along_y
    share = (apart_x * along_x + apart_y * along_y) / squared if squared > 0.0 else 0.0
    share = min(max(share, 0.0), 1.0)
    apart_x, apart_y = apart_x - share * along_x, apart_y - share * along_y
    return math.sqrt(apart_x * apart_x + apart_y * apart_y)


@njit_internal
def _has_ends_apart(segment: Wall, other: Wall) -> bool:
    """Return whether the ends of a segment lie on both sides of another, or on it."""
    ax, ay, bx, by = other
    first = (segment[0] - ax) * (by - ay) - (segment[1] - ay) * (bx - ax)
    last = (segment[2] - ax) * (by - ay) - (segment[3] - ay) * (bx - ax)
    return first * last <= 0.0
