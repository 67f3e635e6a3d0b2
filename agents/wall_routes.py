"""Routes around walls, for agents that drive to goals, and what they know of the floor.

The shortest way between two points of a floor with inner walls passes ends of walls. A
robot keeps a distance from them, so the `WallRoutes` run over points around the ends: a
visibility graph. On a floor without inner walls every route is straight. The
`AgentKnowledge` of an agent is its belief and a `CoverageGrid`: it knows the walls, but
neither the landmarks nor its true pose.

Symbols
-------
a, b            ends of a way [m]
e               end of a wall [m]
"""

import math
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.sparse.csgraph import shortest_path

from ..arrays import Array, BoolArray, ComplexArray
from ..envs.robot import wall_distances
from ..estimator.kernels.imagine import as_view
from ..sim_configs import Scenario
from .active_slam_kernels import SECTORS, cells_in_view
from .belief_features import Bounds, world_bounds
from .estimator_choice import BeliefOfMap, FollowingEstimator

CLEARANCE = 1.0  # of goals on a floor without inner walls [m]
_GAP = 0.5  # kept between the robot and walls on a route [m]
_CORNERS = np.exp(2j * np.pi * np.arange(8) / 8) / math.cos(math.pi / 8)
_WIDER = 1.2  # way round an end of a wall: the robot does not drive exactly


class WallRoutes:
    """Shortest routes on the floor of a scenario.

    Parameters
    ----------
    scenario : Scenario
        With walls around the floor.
    cells : complex ndarray, shape (C,)
        Points of the floor [m].

    Examples
    --------
    >>> from slamgym.sim_configs import load_scenario
    >>> scenario = load_scenario("active_easy").with_changes(
    ...     walls=[[-6, -6, 6, -6], [6, -6, 6, 6], [6, 6, -6, 6], [-6, 6, -6, -6],
    ...            [0, -6, 0, 3]])
    >>> routes = WallRoutes(scenario, np.array([-3.0 - 3.0j, 3.0 - 3.0j]))
    >>> routes.legs(np.array([-3.0, 0.0]), np.array([3.0, 0.0])).round(1).tolist()
    [[-0.6, 3.6], [0.0, 3.9], [0.6, 3.6], [3.0, 0.0]]
    """

    def __init__(self, scenario: Scenario, cells: ComplexArray) -> None:
        self._bounds, self._cells = world_bounds(scenario), cells
        walls = np.array(scenario.walls).view(np.complex128)
        self._starts, self._ends = walls[:, 0], walls[:, 1]
        self._margin = scenario.robot.radius + _GAP
        #: Whether every way is straight.
        self.is_open = not has_inner_walls(scenario)
        #: Which cells the robot can get to from its start, shape (C,).
        self.reachable: BoolArray = np.ones(len(cells), dtype=np.bool_)
        if self.is_open:
            return
        rings = np.unique(walls)[:, None] + _WIDER * self._margin * _CORNERS
        self._nodes: ComplexArray = rings[self._is_free(rings)]
        self._kept = self._clearance(self._nodes)
        between = self._to_nodes(self._nodes)
        np.fill_diagonal(between, 0.0)
        self._between, self._before = shortest_path(
            np.where(np.isfinite(between), between, 0.0), return_predecessors=True
        )
        start = np.array(scenario.start.pose[:2])
        self.reachable = np.isfinite(self.distances(start[None], as_points(cells))[0])
        self._free = cells[self.reachable & self._is_free(cells)]

    @cached_property
    def _by_cell(self) -> Array:
        """Distances between all cells, shape (C, C) [m]."""
        return self.distances(as_points(self._cells), as_points(self._cells))

    def distances(self, points: Array, goals: Array) -> Array:
        """Return the lengths of the routes from points (S, 2) to goals (G, 2) [m].

        Shape (S, G); inf where there is no way.
        """
        here, there = _numbers(points), _numbers(goals)
        if self.is_open:
            return np.asarray(np.abs(there - here[:, None]))
        direct = self._lengths(here, there)
        around = _min_plus(self._to_nodes(here), self._between)
        around = _min_plus(around, self._to_nodes(there).T)
        return np.minimum(direct, around)

    def to_cells(self, points: Array) -> Array:
        """Return the distances of points (S, 2) from all cells, (S, C) [m].

        Around inner walls, those of the cells that the points are in.
        """
        x, y = points.T[..., None]
        straight = np.hypot(self._cells.real - x, self._cells.imag - y)
        if self.is_open:
            return np.asarray(straight)
        return np.asarray(self._by_cell[straight.argmin(axis=1)])

    def legs(self, point: Array, goal: Array) -> Array:
        """Return the corners of the route to a goal, which is the last, (L, 2) [m].

        Where there is no way, the route is straight.
        """
        if self.is_open:
            return goal[None]
        return self._legs(np.stack([point, goal]), {(0, 1)})[0, 1]

    def _legs(
        self, points: Array, pairs: set[tuple[int, int]]
    ) -> dict[tuple[int, int], Array]:
        """Return the routes of pairs of points (P, 2) [m], by index, as in `legs`."""
        numbers = _numbers(points)
        is_straight = np.isfinite(self._lengths(numbers, numbers))
        to_nodes, routes = self._to_nodes(numbers), {}
        for a, b in pairs:
            corners: list[int] = []
            if not is_straight[a, b]:
                length = to_nodes[a][:, None] + self._between + to_nodes[b]
                start, node = np.unravel_index(int(length.argmin()), length.shape)
                if np.isfinite(length[start, node]):
                    corners = [int(node)]
                    while corners[-1] != start:
                        corners.append(int(self._before[start, corners[-1]]))
            nodes = as_points(self._nodes[corners[::-1]])
            routes[a, b] = np.concatenate([nodes, points[[b]]])
        return routes

    def tours(self, point: Array, tours: Array) -> Array:
        """Return the routes of tours (K, 2, 2) from a point, to one goal and another.

        Shape (K, L, 2) [m]; the last point is repeated where a route is shorter.
        """
        if self.is_open or not len(tours):
            return tours
        stops = np.concatenate([point[None], tours.reshape(-1, 2)])
        points, places = np.unique(stops, axis=0, return_inverse=True)
        here, *goals = places.ravel().tolist()
        ways = list(zip(goals[::2], goals[1::2], strict=True))
        legs = self._legs(points, {*ways, *((here, first) for first, _ in ways)})
        routes = [
            np.concatenate([legs[here, first], legs[first, second]])
            for first, second in ways
        ]
        steps = np.arange(max(map(len, routes)))
        return np.array([each[np.minimum(steps, len(each) - 1)] for each in routes])

    def kept_clear(self, goals: Array) -> Array:
        """Return goals (G, 2) moved to where the robot can stand, off the walls [m].

        Goals of a robot that walls leave no such cell stay where they are.
        """
        left, bottom, right, top = self._bounds
        low, high = np.array([left, bottom]), np.array([right, top])
        if self.is_open:
            return np.clip(goals, low + CLEARANCE, high - CLEARANCE)
        if not self._free.size:
            return goals
        points = _numbers(goals)
        nearest = self._free[np.abs(points[:, None] - self._free).argmin(axis=1)]
        return as_points(np.where(self._is_free(points), points, nearest))

    def _is_free(self, points: ComplexArray) -> BoolArray:
        """Return which points are inside the bounds and off the walls."""
        left, bottom, right, top = self._bounds
        inside = (left < points.real) & (points.real < right)
        inside &= (bottom < points.imag) & (points.imag < top)
        return np.asarray(inside & (self._clearance(points) >= self._margin))

    def _clearance(self, points: ComplexArray) -> Array:
        return wall_clearance(points, self._starts, self._ends)

    def _to_nodes(self, points: ComplexArray) -> Array:
        """Return the lengths of straight ways to the nodes, shape (P, nodes)."""
        return self._lengths(points, self._nodes, self._kept)

    def _lengths(
        self, a: ComplexArray, b: ComplexArray, kept_by_b: Array | None = None
    ) -> Array:
        """Return |b - a| of straight ways, (A, B); inf where a wall is in the way.

        A way keeps the margin, or what its own ends keep: `kept_by_b`, if given.
        """
        if kept_by_b is None:
            kept_by_b = self._clearance(b)
        way, start = b - a[:, None], a[:, None]
        kept = np.minimum(self._clearance(a)[:, None], kept_by_b)
        kept = np.minimum(kept, self._margin) * (1 - 1e-6)
        square = np.maximum(np.abs(way) ** 2, 1e-12)
        free = np.ones(way.shape, dtype=np.bool_)
        for e, f in zip(self._starts, self._ends, strict=True):
            wall = f - e
            crosses = _cross(way, e - start) * _cross(way, f - start) <= 0
            crosses &= _cross(wall, start - e) * _cross(wall, b - e) <= 0
            free &= ~crosses
            for end in (e, f):
                share = np.clip((np.conj(way) * (end - start)).real / square, 0, 1)
                free &= np.abs(start + share * way - end) >= kept
        return np.where(free, np.abs(way), np.inf)


def has_inner_walls(scenario: Scenario) -> bool:
    """Return whether a wall is not on the rectangle around the floor."""
    left, bottom, right, top = world_bounds(scenario)
    return not all(
        (x0 == x1 and x0 in (left, right)) or (y0 == y1 and y0 in (bottom, top))
        for x0, y0, x1, y1 in scenario.walls
    )


def _min_plus(a: Array, b: Array) -> Array:
    """Return min over k of a[i, k] + b[k, j], row by row."""
    return np.array([(row[:, None] + b).min(axis=0) for row in a])


def _cross(a: ComplexArray, b: ComplexArray) -> Array:
    return np.asarray(a.real * b.imag - a.imag * b.real)


def _numbers(points: Array) -> ComplexArray:
    return np.asarray(points[..., 0] + 1j * points[..., 1])


def as_points(numbers: ComplexArray) -> Array:
    """Return complex numbers x + iy, (K,), as points (K, 2)."""
    return np.column_stack([numbers.real, numbers.imag])


def wall_clearance(
    points: ComplexArray, starts: ComplexArray, ends: ComplexArray
) -> Array:
    """Return the distances of points (…) from the nearest wall of (W,) [m]."""
    return np.asarray(wall_distances(points, starts, ends - starts).min(axis=-1))


__all__ = ["SECTORS", "CoverageGrid"]
__dir__ = __all__.copy

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
        #: A `Floor`, as kernels take it.
        self.plan = places, walls, self.bounds, self.diagonal, tuple(view)
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
        return wall_clearance(_numbers(points), *self._ends.T)


class AgentKnowledge(NamedTuple):
    """What an agent may know at one step, for policies that plan."""

    scenario: Scenario
    grid: CoverageGrid
    # For predictions. A policy that changes its state must restore it.
    estimator: FollowingEstimator
    belief: BeliefOfMap
    explored: BoolArray  # cells of the grid seen so far, as believed, shape (C,)
    # Landmarks known to the required accuracy, shape (N,); with hidden identities in
    # the order of the map.
    known: BoolArray
    accuracy: float  # required standard deviation of a landmark [m]
    # Standard deviations of the coordinates of an unmapped landmark [m].
    prior_std: tuple[float, float]
    step: int  # steps so far

    @property
    def known_in_map(self) -> BoolArray:
        """Which landmarks of the belief are known, in its order, shape (n,)."""
        ids = list(self.belief.landmark_ids)
        rows = ids if self.scenario.sensor.identities else list(range(len(ids)))
        return self.known[rows]

    @property
    def missing(self) -> int:
        """How many landmarks are not yet mapped."""
        return len(self.known) - len(self.belief.landmark_ids)

    @property
    def to_explore(self) -> BoolArray:
        """Which cells are unseen and within the robot's reach, shape (C,)."""
        return ~self.explored & self.grid.routes.reachable

    def goals(self) -> Array:
        """Return the positions worth a visit, shape (K, 2) [m].

        These are the mapped landmarks that are not yet known and, while a landmark is
        not yet mapped, the unexplored cells that the robot can get to.
        """
        landmarks: Array = self.belief.landmarks[~self.known_in_map]
        if not self.missing:
            return landmarks
        return np.concatenate([landmarks, as_points(self.grid.cells[self.to_explore])])
