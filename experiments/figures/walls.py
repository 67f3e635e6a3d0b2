"""The walls of a world in figures."""

from collections.abc import Sequence

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection

from ...arrays import Array
from ...envs.rendering.scene import WALL

Walls = Sequence[Sequence[float]]
"""Rows (x0, y0, x1, y1) [m]."""


def wall_ends(walls: Walls) -> Array:
    """Return the end points of walls, shape (2n, 2) [m]."""
    return np.reshape(np.asarray(walls, dtype=float), (-1, 2))


def draw_walls(axes: Axes, walls: Walls) -> list[Artist]:
    """Draw walls, and return the keys of a legend: none without walls."""
    if not len(walls):
        return []
    lines = LineCollection(
        list(wall_ends(walls).reshape(-1, 2, 2)),
        colors=WALL,
        linewidths=2.2,
        capstyle="round",
        zorder=1.5,
        label="wall",
    )
    axes.add_collection(lines, autolim=False)
    return [lines]
