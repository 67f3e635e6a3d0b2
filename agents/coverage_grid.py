"""The floor of a bounded world: its cells and walls, and what the sensor sees of it.

An agent knows the walls but not the landmarks. Poses are estimates.
"""

import math
from functools import cached_property

import numpy as np

from ..arrays import Array, BoolArray, ComplexArray
from ..estimator.kernels.imagine import as_view
from ..sim_configs import Scenario
from .belief_features import Bounds, world_bounds
from .floor_kernels import SECTORS, cells_in_view
from .wall_routes import WallRoutes, wall_clearance

__all__ = ["SECTORS", "CoverageGrid"]

_CELLS_PER_SIDE = 24  # at most
_SMALLEST_CELL = 0.75  # [m]


class CoverageGrid:
    """Cells and walls of a scenario's world.

    Parameters
    ----------
    scenario : Scenario
        With walls around the floor.

    Attributes
    ----------
    bounds : (xmin, ymin, xmax, ymax)
        Rectangle around the walls [m].
    cells : complex ndarray, shape (C,)
        Centres of the cells, row by row from the lower left [m].
    cell_size : float
        Approximate side of a cell [m].

    Raises
    ------
    ValueError
        If the scenario has no walls.

    Examples
    --------
    >>> from slamgym.sim_configs import load_scenario
    >>> grid = CoverageGrid(load_scenario("corridor"))
    >>> grid.cells[0].round(2), len(grid.cells)
    (np.complex128(-0.82-0.82j), 361)
    """

    def __init__(self, scenario: Scenario) -> None:
        if not scenario.walls:
            raise ValueError(
                "scenario must have walls around its floor, got none in "
                f"'{scenario.name}'"
            )
        self.bounds: Bounds = world_bounds(scenario)
        left, bottom, right, top = self.bounds
        width, height = right - left, top - bottom
        self.cell_size = max(_SMALLEST_CELL, max(width, height) / _CELLS_PER_SIDE)
        columns, rows = round(width / self.cell_size), round(height / self.cell_size)
        x = left + (np.arange(columns) + 0.5) * width / columns
        y = bottom + (np.arange(rows) + 0.5) * height / rows
        self.cells: ComplexArray = (x[None, :] + 1j * y[:, None]).ravel()
        self.diagonal = math.hypot(width, height)
        walls = np.array(scenario.walls)
        self._ends: ComplexArray = walls.view(np.complex128)
        sensor = scenario.sensor
        hiding = walls if sensor.occlusion else walls[:0]
        view = as_view(sensor.max_range, sensor.field_of_view, hiding)
        places = np.stack([self.cells.real, self.cells.imag])
        self.plan = places, walls, self.bounds, self.diagonal, tuple(view)
        """A `Floor`, as kernels take it."""
        self._scenario = scenario

    @cached_property
    def routes(self) -> WallRoutes:
        """Routes on the floor, around inner walls."""
        return WallRoutes(self._scenario, self.cells)

    def visible_from(self, poses: Array, chosen: BoolArray | None = None) -> BoolArray:
        """Return which cells are in view from poses, (B, 3) to (B, C).

        Cells nearer than the sensor's smallest range count as seen. With paths
        (B, T, 3), a cell counts that is in view from any of their poses; with a choice
        (C,) of cells, only those are returned, in their order.
        """
        cells, _, _, _, view = self.plan
        if chosen is not None:
            cells = np.ascontiguousarray(cells[:, chosen])
        paths = np.ascontiguousarray(poses).reshape(len(poses), -1, 3)
        seen = np.zeros((len(poses), cells.shape[1]), dtype=np.bool_)
        cells_in_view(paths, cells, view, seen)
        return seen

    def clearance(self, points: Array) -> Array:
        """Return the distance of points (…, 2) from the nearest wall, to (…) [m]."""
        places = points[..., 0] + 1j * points[..., 1]
        return wall_clearance(places, *self._ends.T)
