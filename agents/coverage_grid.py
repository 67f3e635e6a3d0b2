"""The floor of a bounded world: its cells and walls, and what the sensor sees of it.

An agent knows the walls but not the landmarks. Poses are estimates.

Symbols
-------
p = (x, y, θ)   believed pose [m, m, rad]
c               centre of a cell as x + iy [m]; δ = (c - p) e^{-iθ} in the robot's frame
"""

import math

import numpy as np

from ..arrays import Array, BoolArray, ComplexArray
from ..envs.robot.wall_contacts import wall_distances
from ..envs.sensors.bearing_range import BearingRangeSensor
from ..sim_configs import Scenario
from .belief_features import Bounds, world_bounds

SECTORS = 8
"""Number of directions around the robot, the first straight ahead."""

_CELLS_PER_SIDE = 24  # at most
_SMALLEST_CELL = 0.75  # [m]
_DIRECTIONS = np.exp(2j * np.pi * np.arange(SECTORS) / SECTORS)


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
        self._sensor = BearingRangeSensor(scenario)
        ends = np.reshape(scenario.walls, (-1, 2, 2))
        self._ends: ComplexArray = ends[..., 0] + 1j * ends[..., 1]

    def visible_from(self, poses: Array) -> BoolArray:
        """Return which cells are in view from poses, (B, 3) to (B, C).

        Cells nearer than the sensor's smallest range count as seen.
        """
        position, inverse_heading = _complex_poses(poses)
        shape = (len(poses), len(self.cells))
        nothing = np.zeros((2, *shape)), np.full(shape, -1.0), None, None
        _, mask = self._sensor.scan(self.cells, position, inverse_heading, nothing)
        return mask

    def wall_distances(self, poses: Array) -> Array:
        """Return the distance to the wall in `SECTORS` directions, to (B, 8) [m].

        It is at most the diagonal of the floor.
        """
        position, inverse_heading = _complex_poses(poses)
        ray = np.conj(inverse_heading) * _DIRECTIONS  # (B, 8)
        start = self._ends[:, 0] - position  # (B, W)
        along = self._ends[:, 1] - self._ends[:, 0]  # (W,)
        across = _cross(ray[:, :, None], along)  # (B, 8, W)
        parallel = np.abs(across) < 1e-12
        safe = np.where(parallel, 1.0, across)
        distance = _cross(start, along)[:, None] / safe
        share = _cross(start[:, None], ray[:, :, None]) / safe
        margin = 1e-9  # a ray through a corner hits one of its walls
        hits = ~parallel & (distance >= 0) & (share >= -margin) & (share <= 1 + margin)
        nearest = np.where(hits, distance, self.diagonal).min(axis=2)
        return np.asarray(np.minimum(nearest, self.diagonal))

    def clearance(self, points: Array) -> Array:
        """Return the distance of points (…, 2) from the nearest wall, to (…) [m]."""
        start, along = self._ends[:, 0], self._ends[:, 1] - self._ends[:, 0]
        away = wall_distances(points[..., 0] + 1j * points[..., 1], start, along)
        return np.asarray(away.min(axis=-1))

    def direction_to_cheapest(
        self, poses: Array, points: ComplexArray, costs: Array
    ) -> Array:
        """Return the direction from the robot to the point of least cost, (B, 3).

        Parameters
        ----------
        poses : ndarray, shape (B, 3)
            Believed [m, m, rad].
        points : complex ndarray, shape (C,) or (B, C)
            As x + iy [m].
        costs : ndarray, shape (B, C)
            inf excludes a point.

        Returns
        -------
        ndarray
            Cosine and sine of the bearing, and the distance in diagonals of the floor
            (at most 1); zeros if all points are excluded.
        """
        position, inverse_heading = _complex_poses(poses)
        world = np.arange(len(poses))
        cheapest = np.argmin(costs, axis=1)
        target = np.broadcast_to(points, costs.shape)[world, cheapest]
        relative = (target - position[:, 0]) * inverse_heading[:, 0]
        distance = np.abs(relative)
        unit = relative / np.maximum(distance, 1e-9)
        far = np.minimum(distance / self.diagonal, 1.0)
        there = np.isfinite(costs[world, cheapest])
        direction = np.stack([unit.real, unit.imag, far], axis=1)
        return np.asarray(np.clip(direction * there[:, None], -1.0, 1.0))

    def sector_sums(
        self, poses: Array, points: ComplexArray, weights: Array, reach: float
    ) -> Array:
        """Sum weights of points in `SECTORS` directions around the robot, to (B, 8).

        ::

            Σ_c  w_c  e^{-|δ_c| / reach}  max(0, cos(arg δ_c - φ_k))²  / 2

        in direction φ_k. The lobes of all directions add up to one. A point at the
        position of the robot has no direction and no weight.

        Parameters
        ----------
        poses : ndarray, shape (B, 3)
            Believed [m, m, rad].
        points : complex ndarray, shape (C,) or (B, C)
            As x + iy [m].
        weights : ndarray, shape (B, C)
            w >= 0.
        reach : float
            Distance over which a weight decays to 1 / e [m].
        """
        position, inverse_heading = _complex_poses(poses)
        relative = (points - position) * inverse_heading
        distance = np.abs(relative)
        unit = relative / np.maximum(distance, 1e-9)
        share = weights * np.exp(-distance / reach)
        sums = [
            np.sum(share * _lobe(unit, direction), axis=-1)
            for direction in _DIRECTIONS.tolist()
        ]
        return 0.5 * np.stack(sums, axis=-1)


def _lobe(unit: ComplexArray, direction: complex) -> Array:
    cosine = unit.real * direction.real + unit.imag * direction.imag
    return np.asarray(np.maximum(cosine, 0.0) ** 2)


def _complex_poses(poses: Array) -> tuple[ComplexArray, ComplexArray]:
    """Return x + iy and cos θ - i sin θ, each of shape (B, 1)."""
    heading = poses[:, 2:3]
    return poses[:, 0:1] + 1j * poses[:, 1:2], np.cos(heading) - 1j * np.sin(heading)


def _cross(u: ComplexArray, v: ComplexArray) -> Array:
    product: Array = u.real * v.imag - u.imag * v.real
    return product
