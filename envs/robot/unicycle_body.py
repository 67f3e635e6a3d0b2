"""The robot's body in the physics engine: it drives, turns, and stops at walls.

Symbols
-------
p = (x, y, θ)     true robot pose in the world frame [m, m, rad]
u = (d, α)        command: distance driven, then heading turned [m, rad]
ε = (εx, εy, εα)  slip, in the frame of the old heading [m, m, rad]
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pymunk
from numpy.typing import NDArray

Array = NDArray[np.float64]
Wall = tuple[float, float, float, float]

_SKIN = 1e-6  # distance kept from every wall [m]
_NEAR = 1e-3  # walls farther away than this, after a step, are left out [m]
_ANYTHING = pymunk.ShapeFilter()
_NO_SLIP = (0.0, 0.0, 0.0)


class UnicycleBody:
    """A round body that moves by one displacement and one turn per step.

    The engine's body is kinematic and has no shape: nothing but its velocity moves it,
    so one `Space.step` of unit time is the turn-last motion model to the last bit::

        x += (d + εx) cos θ - εy sin θ
        y += (d + εx) sin θ + εy cos θ
        θ += α + εα

    A disc meets walls alike at every heading, so θ is kept here and not in the engine.
    Walls hold it back through `WallContacts`, asked before each step.

    Parameters
    ----------
    radius : float
        Of the body [m].
    walls : sequence of (x0, y0, x1, y1)
        Ends of straight walls [m].

    Attributes
    ----------
    position : complex ndarray, shape ()
        x + iy [m]; every step overwrites it.
    inverse_heading : complex ndarray, shape ()
        cos θ - i sin θ; every step overwrites it.

    Examples
    --------
    >>> body = UnicycleBody(radius=0.5, walls=[(2.0, -1.0, 2.0, 1.0)])
    >>> body.drive((1.0, 0.3))
    1.0
    >>> body.pose
    array([1. , 0. , 0.3])
    """

    def __init__(self, radius: float, walls: Sequence[Wall] = ()) -> None:
        self._radius = radius
        self._walls = tuple(walls)
        self._space = pymunk.Space()
        self._body = pymunk.Body(body_type=pymunk.Body.KINEMATIC)
        self._space.add(self._body)
        self._contacts = WallContacts(radius, self._walls)
        self.position = np.zeros((), dtype=np.complex128)
        self.inverse_heading = np.zeros((), dtype=np.complex128)
        self.place((0.0, 0.0, 0.0))

    @property
    def pose(self) -> NDArray[np.float64]:
        """(x, y, θ), shape (3,) [m, m, rad], a fresh array; θ is not wrapped."""
        return np.array(self._pose)

    def place(self, pose: Sequence[float]) -> None:
        """Put the body at (x, y, θ) [m, m, rad]."""
        self._body.position = pose[0], pose[1]
        self._arrive(pose[2])

    def drive(
        self, command: Sequence[float], slip: Sequence[float] = _NO_SLIP
    ) -> float:
        """Move along the old heading, then turn.

        Parameters
        ----------
        command : (float, float)
            u = (d, α) [m, rad].
        slip : (float, float, float), default zeros
            ε [m, m, rad].

        Returns
        -------
        float
            Share of the displacement, in [0, 1], that no wall held back. The turn is
            never held back.
        """
        forward, sideways = command[0] + slip[0], slip[1]
        cos, sin = self._cos, self._sin
        dx = forward * cos - sideways * sin
        dy = forward * sin + sideways * cos
        share = 1.0
        if self._walls:
            x, y, _ = self._pose
            share = self._contacts.free_share(x, y, dx, dy)
        if share < 1.0:
            dx, dy = share * dx, share * dy
        self._body.velocity = dx, dy
        self._space.step(1.0)
        self._arrive(self._pose[2] + (command[1] + slip[2]))
        return share

    def _arrive(self, heading: float) -> None:
        """Take the position from the engine, and face the heading."""
        x, y = self._body.position
        cos, sin = float(np.cos(heading)), float(np.sin(heading))
        self._pose = x, y, heading
        self._cos, self._sin = cos, sin
        self.position[()] = complex(x, y)
        self.inverse_heading[()] = complex(cos, -sin)

    def __getstate__(self) -> dict[str, Any]:
        return {"radius": self._radius, "walls": self._walls, "pose": self._pose}

    def __setstate__(self, state: dict[str, Any]) -> None:
        UnicycleBody.__init__(self, state["radius"], state["walls"])
        self.place(state["pose"])


class WallContacts:
    """Tells how far a disc may move before walls hold it back.

    What is queried are walls inflated by the radius of the body (a thick segment with a
    disc at either end), since Chipmunk's own queries with a radius miss contacts.

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
        self._from = ends[:, 0] + 1j * ends[:, 1]
        self._along = ends[:, 2] + 1j * ends[:, 3] - self._from

    def free_share(self, x: float, y: float, dx: float, dy: float) -> float:
        """Find the share of a displacement that ends a skin before first contact.

        A shape that the body moves away from does not hold it back, even if it starts
        inside: so it can always leave a wall.

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
        """Find the shares of many displacements, arrays of shape (B,) [m]."""
        shares = np.ones(len(x))
        asked = np.flatnonzero(self._may_touch(x + 1j * y, np.hypot(dx, dy)))
        moves = np.stack([x, y, dx, dy], axis=1)[asked].tolist()
        shares[asked] = [self.free_share(*move) for move in moves]
        return shares

    def _may_touch(self, position: NDArray[np.complex128], step: Array) -> Any:
        """Tell which discs could reach a wall; with some to spare."""
        apart = position[:, None] - self._from
        squared = self._along.real**2 + self._along.imag**2
        foot = np.clip((apart * self._along.conj()).real / squared, 0.0, 1.0)
        gaps = np.abs(apart - foot * self._along).min(axis=1)
        return gaps <= self._radius + step + _NEAR

    def __getstate__(self) -> dict[str, Any]:
        return {"radius": self._radius, "walls": self._walls}

    def __setstate__(self, state: dict[str, Any]) -> None:
        WallContacts.__init__(self, state["radius"], state["walls"])


def _inflated(wall: Wall, radius: float, ground: pymunk.Body) -> list[pymunk.Shape]:
    """Make the shapes that a point must not enter so that the body avoids a wall."""
    a, b = wall[:2], wall[2:]
    return [
        pymunk.Segment(ground, a, b, radius),
        pymunk.Circle(ground, radius, a),
        pymunk.Circle(ground, radius, b),
    ]


def _outward(
    hit: pymunk.SegmentQueryInfo, start: tuple[float, float]
) -> tuple[float, float]:
    """Correct the normal of a contact: of a path that starts inside, it points in."""
    if hit.alpha > 0.0 or hit.shape is None:
        return hit.normal
    return hit.shape.point_query(start).gradient
