"""Contacts of a round body with straight walls, by queries of the physics engine."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pymunk

from ...arrays import Array, ComplexArray

Wall = tuple[float, float, float, float]

_SKIN = 1e-6  # distance kept from every wall [m]
_NEAR = 1e-3  # walls farther away than this after a step are not queried [m]
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
        ends = np.array(self._walls, dtype=np.float64).reshape(-1, 4)
        self._start = ends[:, 0] + 1j * ends[:, 1]
        self._along = ends[:, 2] + 1j * ends[:, 3] - self._start

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
        gaps = wall_distances(x + 1j * y, self._start, self._along).min(axis=1)
        near = np.flatnonzero(gaps <= self._radius + np.hypot(dx, dy) + _NEAR)
        moves = np.stack([x, y, dx, dy], axis=1)[near].tolist()
        shares[near] = [self.free_share(*move) for move in moves]
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
