"""The complete description of a simulated world, as one immutable value."""

from collections.abc import Mapping
from typing import Annotated, Any, Self

import numpy as np
from pydantic import Field, ValidationError, model_validator

from ..arrays import LARGEST, LARGEST_EPISODE, LARGEST_MAP, Array
from ..suggestions import closest
from .controls import CircleSequence, ControlSequence, command_cycle
from .field_types import Name, Part, Positive, Text, Wall, broken_rule, expect
from .layouts import LandmarkLayout
from .randomisation import RANGES, Randomise
from .scenario_errors import (
    ScenarioError,
    UnknownKeywordError,
    error_lines,
)
from .scenario_parts import Faults, Motion, Robot, Sensor, Start

_NO_FAULTS = Faults()
_Steps = Annotated[
    int,
    Field(strict=True, ge=2),
    expect("an integer >= 2"),
]  # Gymnasium's checker refuses an episode that ends at its first step


class Scenario(Part):
    """A robot, its sensor, the landmarks and walls around it, and its controls.

    A scenario is a value: frozen, comparable and hashable. `load_scenario` reads one,
    `with_changes` derives another. The constructor raises pydantic's
    ``ValidationError``.

    Examples
    --------
    >>> from slamgym.sim_configs import load_scenario
    >>> load_scenario("six_landmarks")
    <Scenario 'six_landmarks': 6 landmarks, 0 walls, 29 steps of 3 s>
    """

    name: Name = Field(description="short name, for titles and files")
    description: Text = Field(default="", description="purpose of the scenario")
    dt: Positive = Field(default=0.2, description="duration of one step [s]")
    steps: _Steps = Field(default=500, description="steps of an episode")
    start: Start = Field(default=Start(), description="start pose of the robot")
    robot: Robot = Field(default=Robot(), description="body and limits of the robot")
    motion: Motion = Field(description="noise of the motion")
    sensor: Sensor = Field(description="bearing-range sensor")
    landmarks: LandmarkLayout = Field(description="positions of the landmarks")
    walls: tuple[Wall, ...] = Field(
        default=(), description="(x0, y0, x1, y1) of each [m]"
    )
    controls: ControlSequence = Field(
        default=CircleSequence(radius=4.0, speed=0.5),
        description="open-loop commands of the robot; repeated when short; by default "
        "a circle of 4 m at 0.5 m/s",
    )
    randomise: Randomise | None = Field(
        default=None, description="ranges from which every episode draws its own world"
    )

    faults: Faults | None = Field(
        default=None, description="faults of the world that no filter knows"
    )

    @property
    def present_faults(self) -> Faults:
        """The faults of the world, all zero where the scenario has none."""
        return self.faults or _NO_FAULTS

    @model_validator(mode="after")
    def _check_walls(self) -> Self:
        for index, (x0, y0, x1, y1) in enumerate(self.walls):
            if (x0, y0) == (x1, y1):
                raise broken_rule(
                    f"walls[{index}] must have a length > 0, got {self.walls[index]}"
                )
        return self

    @model_validator(mode="after")
    def _check_sizes(self) -> Self:
        for name, count, most in (
            ("steps", self.steps, LARGEST_EPISODE),
            ("landmarks", self.landmarks.count, LARGEST_MAP),
            ("sensor.max_clutter", self.sensor.max_clutter, LARGEST_MAP),
        ):
            if count > most:
                raise broken_rule(f"{name} must be at most {most}, got {count}")
        for name in ("max_speed", "max_turn_rate"):
            limit = getattr(self.robot, name)
            if limit * self.dt > LARGEST:
                raise broken_rule(
                    f"robot.{name} must not exceed {LARGEST:g} / dt, so that no step "
                    f"is longer, got {limit} with dt = {self.dt}"
                )
        return self

    @model_validator(mode="after")
    def _check_limits(self) -> Self:
        fastest = np.abs(command_cycle(self.controls, self.dt)).max(axis=0) / self.dt
        for name, unit, asked in zip(
            ("max_speed", "max_turn_rate"), ("m/s", "rad/s"), fastest, strict=True
        ):
            limit = getattr(self.robot, name)
            if asked > limit * (1 + 1e-9):
                raise broken_rule(
                    f"controls must stay within robot.{name} = {limit} {unit}, "
                    f"got {asked:.6g} {unit}"
                )
        return self

    @model_validator(mode="after")
    def _check_ranges(self) -> Self:
        """Check both ends of all ranges; every rule is a bound and holds in between."""
        ranges = self.randomise
        if ranges is None:
            return self
        if ranges.landmark_shift and self.landmarks.is_redrawn:
            raise broken_rule(
                "randomise.landmark_shift must be 0 where every episode has new "
                f"landmarks anyway, got {ranges.landmark_shift}"
            )
        unmoved = np.zeros((self.landmarks.count, 2))
        for share, end in ((0.0, "low"), (1.0, "high")):
            try:
                self.drawn_at(dict.fromkeys(RANGES, share), unmoved)
            except ValueError as error:
                raise broken_rule(
                    "randomise must give valid scenarios, but at the "
                    f"{end} ends {error}"
                ) from None
        return self

    def __repr__(self) -> str:
        return (
            f"<Scenario {self.name!r}: {self.landmarks.count} landmarks, "
            f"{len(self.walls)} walls, {self.steps} steps of {self.dt:g} s>"
        )

    __str__ = __repr__

    def with_changes(self, **changes: object) -> Self:
        """Return a scenario with some fields replaced.

        Parameters
        ----------
        **changes : object
            New values by field. A mapping replaces only the keys that it holds. A
            mapping with another layout or sequence replaces the whole table.

        Raises
        ------
        ScenarioError
            If a key is unknown (also a `TypeError`) or the result is not a valid
            scenario.

        Examples
        --------
        >>> from slamgym.sim_configs import load_scenario
        >>> scenario = load_scenario("six_landmarks")
        >>> scenario.with_changes(sensor={"max_range": 4.0}, steps=10).sensor.std
        (0.01, 0.08)
        """
        if not changes:
            return self
        fields = type(self).model_fields
        for key in changes:
            if key not in fields:
                raise UnknownKeywordError(
                    f"unexpected keyword argument '{key}': unknown key '{key}' in the "
                    f"scenario{closest(key, fields)}"
                )
        return self.from_table(_merge(self.model_dump(), changes))

    def drawn_at(self, shares: Mapping[str, float], directions: Array) -> Self:
        """Return the scenario at one point of its ranges; see `Randomise.changes`."""
        assert self.randomise is not None
        return self.with_changes(**self.randomise.changes(self, shares, directions))

    @classmethod
    def from_table(cls, table: Mapping[str, object]) -> Self:
        """Make a scenario from a mapping of plain values and arrays.

        Raises
        ------
        ScenarioError
            With one line per mistake.
        """
        try:
            return cls.model_validate(_plain(table))
        except ValidationError as error:
            raise ScenarioError("\n".join(error_lines(error))) from None


def action_sequence(scenario: Scenario) -> Array:
    """Compute the open-loop actions of an episode from the scenario's controls.

    Returns
    -------
    ndarray of float64, shape (steps, 2)
        Rows (v, ω) [m/s, rad/s]; the commands are (d, α) = (v dt, ω dt). A sequence
        that is shorter than the episode is repeated.

    Examples
    --------
    >>> from slamgym.sim_configs import load_scenario
    >>> action_sequence(load_scenario("six_landmarks")).shape
    (29, 2)
    """
    cycle = command_cycle(scenario.controls, scenario.dt) / scenario.dt
    return np.resize(cycle, (scenario.steps, 2))


def _merge(table: dict[str, Any], changes: Mapping[str, object]) -> dict[str, Any]:
    merged = dict(table)
    for key, change in changes.items():
        old = table.get(key)
        if isinstance(change, Mapping) and isinstance(old, dict):
            kind = {"landmarks": "layout", "controls": "sequence"}.get(key, "")
            same = change.get(kind, old.get(kind)) == old.get(kind)
            merged[key] = {**old, **change} if same else change
        else:
            merged[key] = change
    return merged


def _plain(value: Any) -> Any:
    """Replace arrays, models and other mappings by lists and dicts."""
    if isinstance(value, Part):
        return value.model_dump()
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, Mapping):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return value
