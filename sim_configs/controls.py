"""Open-loop control sequences as data, and the commands that they describe.

A command is (d, α): drive d straight ahead [m], then turn by α [rad].
"""

import math
from collections.abc import Iterator
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from ..arrays import Array
from .field_types import Command, Count, Part, Positive, broken_rule

_LONGEST_CYCLE = 1_000_000  # steps; a typing error must not fill the memory


class CommandSequence(Part):
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


class SquareSequence(Part):
    """A counter-clockwise square: four sides, each followed by a quarter turn."""

    sequence: Literal["square"] = "square"
    side: Positive = Field(description="length of a side [m]")
    speed: Positive = Field(description="highest speed along a side [m/s]")
    turn_steps: Count = Field(description="steps of each quarter turn")

    def cycle(self, dt: float) -> Array:
        """Drive the four sides."""
        steps = _steps(self.side, self.speed * dt)
        _steps(self.turn_steps, 1.0)  # checks the length
        straight = np.tile([self.side / steps, 0.0], (steps, 1))
        turn = np.tile([0.0, math.pi / 2 / self.turn_steps], (self.turn_steps, 1))
        return np.tile(np.concatenate([straight, turn]), (4, 1))


class CircleSequence(Part):
    """A counter-clockwise circle, approximated by an inscribed regular polygon."""

    sequence: Literal["circle"] = "circle"
    radius: Positive = Field(description="radius of the circle [m]")
    speed: Positive = Field(description="highest speed along the circle [m/s]")

    def cycle(self, dt: float) -> Array:
        """Drive the sides of the polygon."""
        return _circle(self.radius, self.speed * dt)


class FigureEightSequence(Part):
    """Two circles that touch at the start: counter-clockwise, then clockwise."""

    sequence: Literal["figure_eight"] = "figure_eight"
    radius: Positive = Field(description="radius of both circles [m]")
    speed: Positive = Field(description="highest speed along the circles [m/s]")

    def cycle(self, dt: float) -> Array:
        """Drive the first circle, then its mirror image."""
        left = _circle(self.radius, self.speed * dt)
        return np.concatenate([left, left * (1.0, -1.0)])


class SpiralSequence(Part):
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


class BlocksSequence(Part):
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
]


def command_cycle(controls: ControlSequence, dt: float) -> Array:
    """Compute one cycle of a control sequence.

    Parameters
    ----------
    controls : ControlSequence
        The `controls` of a scenario.
    dt : float
        Duration of one step [s].

    Returns
    -------
    ndarray of float64, shape (K, 2)
        Commands (d, α) [m, rad], one row per step.

    Examples
    --------
    >>> square = SquareSequence(side=4.0, speed=1.0, turn_steps=1)
    >>> command_cycle(square, dt=2.0)[:3].round(4).tolist()
    [[2.0, 0.0], [2.0, 0.0], [0.0, 1.5708]]
    """
    return controls.cycle(dt)


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
