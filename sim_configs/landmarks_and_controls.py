"""Landmark layouts and open-loop control sequences as data, and what they describe.

A layout describes the positions of landmarks, and a sequence the commands of a robot. A
command is (d, α): drive d straight ahead [m], then turn by α [rad].
"""

import math
from collections.abc import Iterator
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from ..arrays import Array
from .field_types import (
    Bounds,
    Command,
    Count,
    NotNegative,
    Point,
    Positive,
    ScenarioError,
    ScenarioTable,
    Seed,
    broken_rule,
    kind_in,
    setting,
)

TRIES_PER_LANDMARK = 2000
_LONGEST_CYCLE = 1_000_000  # steps; a typing error must not fill the memory


class _Layout(ScenarioTable):
    @property
    def is_redrawn(self) -> bool:
        """Whether every episode draws new positions."""
        return False


class PointsLayout(_Layout):
    """Landmarks at given positions."""

    layout: Literal["points"] = "points"
    points: tuple[Point, ...] = Field(
        min_length=1, description="positions (x, y) in the world frame [m]"
    )

    @property
    def count(self) -> int:
        """Number of landmarks."""
        return len(self.points)

    def place(self, rng: np.random.Generator) -> Array:
        """Return the positions."""
        return np.array(self.points, dtype=np.float64)


class GridLayout(_Layout):
    """Landmarks on a square grid, row by row."""

    layout: Literal["grid"] = "grid"
    rows: Count = Field(description="number of rows, along y")
    columns: Count = Field(description="number of columns, along x")
    spacing: Positive = Field(description="distance between neighbours [m]")
    origin: Point = setting((0.0, 0.0), "lower left landmark (x, y) [m]")

    @property
    def count(self) -> int:
        """Number of landmarks."""
        return self.rows * self.columns

    def place(self, rng: np.random.Generator) -> Array:
        """Return the positions, row by row."""
        rows, columns = np.divmod(np.arange(self.count), self.columns)
        return self.origin + self.spacing * np.column_stack([columns, rows])


class RingLayout(_Layout):
    """Landmarks evenly spaced on a circle, counter-clockwise from its +x side."""

    layout: Literal["ring"] = "ring"
    count: Count = Field(description="number of landmarks")
    radius: Positive = Field(description="radius of the circle [m]")
    centre: Point = setting((0.0, 0.0), "centre of the circle (x, y) [m]")

    def place(self, rng: np.random.Generator) -> Array:
        """Return the positions, counter-clockwise."""
        angles = 2 * np.pi * np.arange(self.count) / self.count
        directions = np.column_stack([np.cos(angles), np.sin(angles)])
        return self.centre + self.radius * directions


class CorridorLayout(_Layout):
    """Landmarks on alternating sides of a corridor along +x.

    The first is on the left (+y) side above the origin, the last at the far end.
    """

    layout: Literal["corridor"] = "corridor"
    count: Count = Field(description="number of landmarks")
    length: Positive = Field(description="length of the corridor [m]")
    width: Positive = Field(description="distance between the two sides [m]")
    origin: Point = setting(
        (0.0, 0.0), "start of the corridor's centre line (x, y) [m]"
    )

    def place(self, rng: np.random.Generator) -> Array:
        """Return the positions, from the origin on."""
        along = np.linspace(0.0, self.length, self.count)
        across = np.where(np.arange(self.count) % 2 == 0, 0.5, -0.5) * self.width
        return self.origin + np.column_stack([along, across])


class StreetsLayout(_Layout):
    """Landmarks on the fronts of the blocks of a city with a street grid.

    The centre lines of the streets are `side` apart; the first two cross at the origin.
    The blocks are numbered in rows along x. The landmarks of a block are numbered
    counter-clockwise from its lower left corner.
    """

    layout: Literal["streets"] = "streets"
    columns: Count = Field(description="number of blocks along x")
    rows: Count = Field(description="number of blocks along y")
    side: Positive = Field(description="distance between neighbouring streets [m]")
    width: Positive = Field(
        description="distance between the fronts across a street [m]"
    )
    per_front: Count = Field(description="landmarks on each of a block's four fronts")
    origin: Point = setting((0.0, 0.0), "lower left crossing (x, y) [m]")

    @property
    def count(self) -> int:
        """Number of landmarks."""
        return 4 * self.per_front * self.columns * self.rows

    def _broken_rules(self) -> Iterator[str]:
        if self.width >= self.side:
            yield (
                f"width must be < side = {self.side}, to leave room for blocks, "
                f"got {self.width}"
            )

    def place(self, rng: np.random.Generator) -> Array:
        """Return the positions: the four fronts of a block, copied to every block."""
        front = (np.arange(self.per_front) + 0.5) / self.per_front
        low, high = np.zeros_like(front), np.ones_like(front)
        x = np.concatenate([front, high, front[::-1], low])
        y = np.concatenate([low, front, high, front[::-1]])
        block = self.width / 2 + (self.side - self.width) * np.column_stack([x, y])
        rows, columns = np.divmod(np.arange(self.rows * self.columns), self.columns)
        corners = self.side * np.column_stack([columns, rows])
        return self.origin + (corners[:, None] + block).reshape(-1, 2)


class RandomLayout(_Layout):
    """Landmarks uniform in a rectangle, with a minimum distance between them."""

    layout: Literal["random"] = "random"
    count: Count = Field(description="number of landmarks")
    bounds: Bounds = Field(description="rectangle (xmin, ymin, xmax, ymax) [m]")
    min_distance: NotNegative = setting(0.0, "least distance between two landmarks [m]")
    seed: Seed | None = setting(
        None, "seed of the layout; without it every episode draws a new one"
    )

    def _broken_rules(self) -> Iterator[str]:
        left, bottom, right, top = self.bounds
        if not (left < right and bottom < top):
            yield f"bounds must have xmin < xmax and ymin < ymax, got {self.bounds}"

    @property
    def is_redrawn(self) -> bool:
        """Whether every episode draws new positions."""
        return self.seed is None

    def place(self, rng: np.random.Generator) -> Array:
        """Draw the landmarks in turn; reject one that is too near to an earlier one."""
        if not self.is_redrawn:
            rng = np.random.default_rng(self.seed)
        low, high = self.bounds[:2], self.bounds[2:]
        placed = np.empty((self.count, 2))
        for index in range(self.count):
            for _ in range(TRIES_PER_LANDMARK):
                point = rng.uniform(low, high)
                squares = (placed[:index] - point) ** 2
                if (squares.sum(axis=1) >= self.min_distance**2).all():
                    break
            else:
                raise self.no_room(index)
            placed[index] = point
        return placed

    def no_room(self, placed: int) -> ScenarioError:
        """Return the error for a layout that has room for some landmarks only."""
        return ScenarioError(
            "landmarks.min_distance must leave room for "
            f"{self.count} landmarks in {self.bounds}, got {self.min_distance} "
            f"({placed} placed, then {TRIES_PER_LANDMARK} tries failed)"
        )


LandmarkLayout = Annotated[
    PointsLayout
    | GridLayout
    | RingLayout
    | CorridorLayout
    | StreetsLayout
    | RandomLayout,
    Field(discriminator="layout"),
    kind_in("layout"),
]


def place_landmarks(layout: LandmarkLayout, rng: np.random.Generator) -> Array:
    """Compute the positions of the landmarks of a layout.

    Parameters
    ----------
    layout : LandmarkLayout
        The `landmarks` of a scenario.
    rng : numpy.random.Generator
        Used only by a random layout without its own seed.

    Returns
    -------
    ndarray of float64, shape (N, 2)
        Positions (x, y) in the world frame [m], N = ``layout.count``.

    Raises
    ------
    ScenarioError
        If a random layout has no room for its landmarks.

    Examples
    --------
    >>> layout = GridLayout(rows=2, columns=2, spacing=3.0)
    >>> place_landmarks(layout, np.random.default_rng(0)).tolist()
    [[0.0, 0.0], [3.0, 0.0], [0.0, 3.0], [3.0, 3.0]]
    """
    return layout.place(rng)


def possible_positions(layout: LandmarkLayout) -> Array:
    """Return points (K, 2) [m] whose convex hull holds every landmark of a layout.

    They are the landmarks themselves, or the corners of a random layout's rectangle.

    Examples
    --------
    >>> possible_positions(RandomLayout(count=9, bounds=(0.0, 1.0, 2.0, 3.0))).tolist()
    [[0.0, 1.0], [0.0, 3.0], [2.0, 1.0], [2.0, 3.0]]
    """
    if layout.layout == "random":
        left, bottom, right, top = layout.bounds
        return np.array([[left, bottom], [left, top], [right, bottom], [right, top]])
    return place_landmarks(layout, np.random.default_rng(0))  # draws nothing


# --------------------------------------------------------------------------------------
# Control sequences.
#
# Their ``cycle(dt)`` computes one cycle for steps of dt [s]: commands (d, α) [m, rad],
# one row per step, shape (K, 2).


class CommandSequence(ScenarioTable):
    """A list of commands, each repeated a number of times."""

    sequence: Literal["commands"] = "commands"
    commands: tuple[Command, ...] = Field(
        min_length=1, description="rows (d [m], α [rad], times), per step"
    )

    def cycle(self, dt: float) -> Array:
        """Repeat each command."""
        times = [times for _, _, times in self.commands]
        _steps(sum(times), 1.0)  # checks the length
        return np.repeat([command[:2] for command in self.commands], times, axis=0)


class SquareSequence(ScenarioTable):
    """A counter-clockwise square: four sides, each followed by a quarter turn."""

    sequence: Literal["square"] = "square"
    side: Positive = Field(description="length of a side [m]")
    speed: Positive = Field(description="highest speed along a side [m/s]")
    turn_steps: Count = Field(description="steps of each quarter turn")

    def cycle(self, dt: float) -> Array:
        """Drive the four sides.

        Examples
        --------
        >>> square = SquareSequence(side=4.0, speed=1.0, turn_steps=1)
        >>> square.cycle(dt=2.0)[:3].round(4).tolist()
        [[2.0, 0.0], [2.0, 0.0], [0.0, 1.5708]]
        """
        steps = _steps(self.side, self.speed * dt)
        _steps(self.turn_steps, 1.0)  # checks the length
        straight = np.tile([self.side / steps, 0.0], (steps, 1))
        turn = np.tile([0.0, math.pi / 2 / self.turn_steps], (self.turn_steps, 1))
        return np.tile(np.concatenate([straight, turn]), (4, 1))


class CircleSequence(ScenarioTable):
    """A counter-clockwise circle, approximated by an inscribed regular polygon."""

    sequence: Literal["circle"] = "circle"
    radius: Positive = Field(description="radius of the circle [m]")
    speed: Positive = Field(description="highest speed along the circle [m/s]")

    def cycle(self, dt: float) -> Array:
        """Drive the sides of the polygon."""
        return _circle(self.radius, self.speed * dt)


class FigureEightSequence(ScenarioTable):
    """Two circles that touch at the start: counter-clockwise, then clockwise."""

    sequence: Literal["figure_eight"] = "figure_eight"
    radius: Positive = Field(description="radius of both circles [m]")
    speed: Positive = Field(description="highest speed along the circles [m/s]")

    def cycle(self, dt: float) -> Array:
        """Drive the first circle, then its mirror image."""
        left = _circle(self.radius, self.speed * dt)
        return np.concatenate([left, left * (1.0, -1.0)])


class SpiralSequence(ScenarioTable):
    """A counter-clockwise spiral; its radius grows linearly with the angle turned."""

    sequence: Literal["spiral"] = "spiral"
    inner_radius: Positive = Field(description="initial radius of curvature [m]")
    outer_radius: Positive = Field(description="final radius of curvature [m]")
    turns: Positive = Field(description="number of full turns")
    speed: Positive = Field(description="speed along the spiral [m/s]")

    def _broken_rules(self) -> Iterator[str]:
        if self.outer_radius < self.inner_radius:
            yield (
                f"outer_radius must be >= inner_radius = {self.inner_radius}, "
                f"got {self.outer_radius}"
            )

    def cycle(self, dt: float) -> Array:
        """Turn by α = d / r; the radius r grows with the angle turned so far."""
        distance, full_angle = self.speed * dt, 2 * math.pi * self.turns
        growth = (self.outer_radius - self.inner_radius) / full_angle
        _steps(full_angle * self.outer_radius, distance)  # checks the length
        turned, turns = 0.0, []
        while turned < full_angle:
            turns.append(distance / (self.inner_radius + growth * turned))
            turned += turns[-1]
        return np.column_stack([np.full(len(turns), distance), turns])


class BlocksSequence(ScenarioTable):
    """A drive around every block of a city, row by row, alternately east and west.

    The robot follows the four sides of a block back to their start, then drives to
    the next block. It circles the blocks of eastward rows counter-clockwise and those
    of westward rows clockwise.
    """

    sequence: Literal["blocks"] = "blocks"
    columns: Count = Field(description="number of blocks along x")
    rows: Count = Field(description="number of blocks along y")
    side: Positive = Field(description="distance between neighbouring streets [m]")
    speed: Positive = Field(description="highest speed along a street [m/s]")
    turn_steps: Count = Field(description="steps of each quarter turn")

    def cycle(self, dt: float) -> Array:
        """Drive the sides in turn, each preceded by the quarter turn into it."""
        steps, turns = _steps(self.side, self.speed * dt), self.turn_steps
        _steps(self.rows * (5.0 * self.columns + 1) * (steps + turns), 1.0)
        east, north, west, south = 0, 1, 2, 3  # quarter turns
        eastward = [east, north, west, south, east] * self.columns + [north]
        westward = [west, north, east, south, west] * self.columns + [north]
        directions = np.concatenate(
            [westward if row % 2 else eastward for row in range(self.rows)]
        )
        # -1, 0 or 1: never back
        quarters = (np.diff(directions, prepend=east) + 1) % 4 - 1
        straight = np.tile([self.side / steps, 0.0], (steps, 1))
        turn = np.tile([0.0, math.pi / 2 / turns], (turns, 1))
        parts = [
            part
            for quarter in quarters.tolist()
            for part in ([turn * quarter] if quarter else []) + [straight]
        ]
        return np.concatenate(parts)


ControlSequence = Annotated[
    CommandSequence
    | SquareSequence
    | CircleSequence
    | FigureEightSequence
    | SpiralSequence
    | BlocksSequence,
    Field(discriminator="sequence"),
    kind_in("sequence"),
]


def _circle(radius: float, longest_step: float) -> Array:
    """Follow the regular polygon whose corners lie on the circle."""
    steps = max(3, _steps(2 * math.pi * radius, longest_step))
    angle = 2 * math.pi / steps
    return np.tile([2 * radius * math.sin(angle / 2), angle], (steps, 1))


def _steps(length: float, longest_step: float) -> int:
    """Count the equal steps, at most `longest_step` each, that add up to a length."""
    steps = length / longest_step * (1 - 1e-12)
    if steps > _LONGEST_CYCLE:
        raise broken_rule(
            f"controls must come to at most {_LONGEST_CYCLE} steps, got {steps:.6g}"
        )
    return max(1, math.ceil(steps))
