"""The robot's body in the physics engine: it drives, turns, and stops at walls."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pymunk
from numpy.typing import NDArray

Wall = tuple[float, float, float, float]

_SKIN = 1e-6  # distance kept from every wall [m]
_ANYTHING = pymunk.ShapeFilter()
_NO_SLIP = (0.0, 0.0, 0.0)


class UnicycleBody:
    """A round body that moves by one displacement and one turn per step.

    The body is kinematic and has no shape: nothing but its velocity moves it, so one
    `Space.step` of unit time is the turn-last motion model to the last bit::

        x += (d + εx) cos θ - εy sin θ
        y += (d + εx) sin θ + εy cos θ
        θ += α + εα

    Walls hold it back through queries, made before each step, for the first contact
    along the displacement. What is queried are walls inflated by the radius of the
    body (a thick segment with a disc at either end), since Chipmunk's own queries with
    a radius miss contacts.

    Parameters
    ----------
    radius : float
        Of the body [m].
    walls : sequence of (x0, y0, x1, y1)
        Ends of straight walls [m].

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
        for x0, y0, x1, y1 in self._walls:
            ground, a, b = self._space.static_body, (x0, y0), (x1, y1)
            self._space.add(
                pymunk.Segment(ground, a, b, radius),
                pymunk.Circle(ground, radius, a),
                pymunk.Circle(ground, radius, b),
            )
        self.position = np.empty((), complex); self.inverse = np.empty((), complex)
        self.place((0.0, 0.0, 0.0))

    @property
    def pose(self) -> NDArray[np.float64]:
        """(x, y, θ), shape (3,) [m, m, rad], a fresh array; θ is not wrapped."""
        return np.array([self.x, self.y, self.heading])

    def place(self, pose: Sequence[float]) -> None:
        """Put the body at (x, y, θ) [m, m, rad]."""
        x, y, heading = pose
        self._body.position = x, y
        self._body.angle = heading
        self._arrive()

    def drive(self, command: Sequence[float], slip: Sequence[float] = _NO_SLIP) -> float:
        """Move along the old heading, then turn.

        Parameters
        ----------
        command : (float, float)
            (d, α), distance and change of heading [m, rad]; no wall prevents a turn.
        slip : (float, float, float), default zeros
            (εx, εy, εα) added to the motion, in the frame of the old heading
            [m, m, rad].

        Returns
        -------
        float
            Share of the displacement, in [0, 1], that no wall held back.
        """
        forward, sideways = command[0] + slip[0], slip[1]
        dx = forward * self.cos - sideways * self.sin
        dy = forward * self.sin + sideways * self.cos
        share = self._free_share(dx, dy) if self._walls else 1.0
        if share < 1.0:
            dx, dy = share * dx, share * dy
        body = self._body
        body.velocity = dx, dy
        body.angular_velocity = command[1] + slip[2]
        self._space.step(1.0)
        self._arrive()
        return share

    def _arrive(self) -> None:
        body = self._body
        self.x, self.y = x, y = body.position
        self.heading = heading = body.angle
        self.cos, self.sin = cos, sin = float(np.cos(heading)), float(np.sin(heading))
        self.position[()] = complex(x, y)
        self.inverse[()] = complex(cos, -sin)

    def _free_share(self, dx: float, dy: float) -> float:
        """Find the share of a displacement that ends a skin before first contact.

        A shape that the body moves away from does not hold it back, even if it starts
        inside: so it can always leave a wall.
        """
        start, end = (self.x, self.y), (self.x + dx, self.y + dy)
        share = 1.0
        for hit in self._space.segment_query(start, end, 0.0, _ANYTHING):
            inside = hit.alpha == 0.0  # where Chipmunk's normal points the wrong way
            assert hit.shape is not None
            nx, ny = hit.shape.point_query(start).gradient if inside else hit.normal
            approach = -(dx * nx + dy * ny)
            if approach > 0.0:
                share = min(share, hit.alpha - _SKIN / approach)
        return max(share, 0.0)

    def __getstate__(self) -> dict[str, Any]:
        pose = (self.x, self.y, self.heading)
        return {"radius": self._radius, "walls": self._walls, "pose": pose}

    def __setstate__(self, state: dict[str, Any]) -> None:
        UnicycleBody.__init__(self, state["radius"], state["walls"])
        self.place(state["pose"])
