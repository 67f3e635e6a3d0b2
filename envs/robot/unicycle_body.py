"""The robot's body in the physics engine: it drives, turns and stops at walls.

Symbols are those of `drive_equation`.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pymunk

from ...arrays import Array
from .drive_equation import displacement
from .wall_contacts import Wall, WallContacts

_NO_SLIP = (0.0, 0.0, 0.0)


class UnicycleBody:
    """A round body that moves by one displacement and one turn per step.

    The engine's body is kinematic and has no shape. Only its velocity moves it, so one
    `Space.step` of unit time adds the displacement of the drive equation exactly. The
    contacts of a disc do not depend on its heading, so θ is kept here and not in the
    engine. `WallContacts` shortens the displacement before each step.

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
    def pose(self) -> Array:
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
            Share of the displacement, in [0, 1], that the walls allowed. Walls do not
            affect the turn.
        """
        dx, dy = displacement(command[0] + slip[0], slip[1], self._cos, self._sin)
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
        """Read the position from the engine and set the heading."""
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
