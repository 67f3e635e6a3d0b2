"""The bodies of many robots in numpy: the vector form of `UnicycleBody`.

Symbols are those of `drive_equation`.
"""

from collections.abc import Sequence

import numpy as np

from ...arrays import Array, BoolArray, ComplexArray, IndexArray
from .drive_equation import displacement
from .wall_contacts import Wall, WallContacts


class UnicycleBodies:
    """B round bodies, each in its own world.

    The results equal those of `UnicycleBody` to the bit: sums, products and queries of
    walls are the same.

    Parameters
    ----------
    count : int
        B.
    radius : float
        Of every body [m].
    walls : sequence of (x0, y0, x1, y1)
        Ends of straight walls, the same in every world [m].

    Attributes
    ----------
    position : complex ndarray, shape (B, 1)
        x + iy [m]; every step overwrites it.
    inverse_heading : complex ndarray, shape (B, 1)
        cos θ - i sin θ; every step overwrites it.

    Examples
    --------
    >>> bodies = UnicycleBodies(2, radius=0.5, walls=[(2.0, -1.0, 2.0, 1.0)])
    >>> bodies.drive(np.array([[1.0, 0.3], [3.0, 0.0]]), np.zeros((2, 3))).round(3)
    array([1. , 0.5])
    >>> bodies.poses().round(3)
    array([[1. , 0. , 0.3],
           [1.5, 0. , 0. ]])
    """

    def __init__(self, count: int, radius: float, walls: Sequence[Wall] = ()) -> None:
        self._contacts = WallContacts(radius, walls) if walls else None
        self._pose = np.zeros((3, count))  # rows x, y, θ
        self.position = np.zeros((count, 1), dtype=np.complex128)
        self.inverse_heading = np.zeros((count, 1), dtype=np.complex128)
        self._arrive(self._pose)

    def poses(self) -> Array:
        """(x, y, θ), shape (B, 3) [m, m, rad], a fresh array; θ is not wrapped."""
        return self._pose.T.copy()

    def place(self, worlds: IndexArray, poses: Array) -> None:
        """Put some bodies at poses, rows (x, y, θ) [m, m, rad]."""
        pose = self._pose.copy()
        pose[:, worlds] = poses.T
        self._arrive(pose)

    def drive(
        self, commands: Array, slip: Array, moving: BoolArray | None = None
    ) -> Array | None:
        """Move along the old headings, then turn.

        Parameters
        ----------
        commands : ndarray, shape (B, 2)
            u = (d, α) [m, rad].
        slip : ndarray, shape (B, 3)
            ε [m, m, rad].
        moving : bool ndarray, shape (B,), optional
            Which bodies move (all).

        Returns
        -------
        ndarray, shape (B,), or None
            Shares of the displacements, in [0, 1], that the walls allowed, 1 for bodies
            that do not move; None without walls.
        """
        change = np.empty(self._pose.shape)
        forward, sideways = commands[:, 0] + slip[:, 0], slip[:, 1]
        change[0], change[1] = displacement(forward, sideways, self._cos, self._sin)
        if moving is not None:
            change[:2] *= moving  # no wall is asked about those that stay
        share = None
        if self._contacts is not None:
            share = self._contacts.free_shares(*self._pose[:2], *change[:2])
            change[:2] *= share
        np.add(commands[:, 1], slip[:, 2], out=change[2])
        change += self._pose
        if moving is not None:
            change = np.where(moving, change, self._pose)
        self._arrive(change)
        return share

    def _arrive(self, pose: Array) -> None:
        """Set positions and headings."""
        self._pose = pose
        self._cos, self._sin = np.cos(pose[2]), np.sin(pose[2])
        _as_pairs(self.position)[...] = pose[:2].T
        heading = _as_pairs(self.inverse_heading)
        heading[:, 0] = self._cos
        np.negative(self._sin, out=heading[:, 1])


def _as_pairs(numbers: ComplexArray) -> Array:
    """View complex numbers, (B, 1), as rows (real, imaginary), (B, 2)."""
    return numbers.view(np.float64)
