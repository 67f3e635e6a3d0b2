"""What to simulate, as one immutable value per scenario."""

import math
from collections.abc import Mapping
from typing import Annotated, Any, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, ValidationError, model_validator

from .controls import ControlSequence, command_cycle
from .field_types import (
    CountOrZero,
    Flag,
    MeasurementStd,
    MotionStd,
    Name,
    NotNegative,
    Part,
    Pose,
    PoseStd,
    Positive,
    PositiveOrInfinite,
    Probability,
    Text,
    Wall,
    broken_rule,
    expect,
)
from .layouts import LandmarkLayout
from .randomisation import Randomise, refuse_impossible_ends
from .scenario_errors import ScenarioError, error_lines

_Angle = Annotated[Positive, Field(le=2 * math.pi), expect("a number in (0, 2π] [rad]")]
_Steps = Annotated[
    int, Field(strict=True, ge=2), expect("an integer >= 2")
]  # Gymnasium's checker refuses an episode that ends at its first step


def _leave_out_default(schema: dict[str, Any]) -> None:
    del schema["default"]  # JSON cannot say inf


class Start(Part):
    """Where the robot starts, and how well that is known.

    With ``drawn = "truth"`` the true start is drawn around `pose` and a filter starts
    from `pose`; with ``"estimate"`` the truth starts at `pose` and the filter's first
    pose is drawn around it.
    """

    pose: Pose = Field(default=(0.0, 0.0, 0.0), description="(x, y, θ) [m, m, rad]")
    std: PoseStd = Field(
        default=(0.0, 0.0, 0.0),
        description="standard deviations (σx, σy, σθ) [m, m, rad]",
    )
    drawn: Annotated[Literal["truth", "estimate"], expect("'truth' or 'estimate'")] = (
        Field(
            default="truth",
            description="which of the two starts is drawn around `pose`",
        )
    )


class Robot(Part):
    """The body of the robot and the limits of its actions."""

    radius: Positive = Field(default=0.2, description="radius of the round body [m]")
    max_speed: Positive = Field(default=1.0, description="limit of |v| [m/s]")
    max_turn_rate: Positive = Field(default=1.0, description="limit of |ω| [rad/s]")


class Motion(Part):
    """The noise of the motion.

    With ``noise_in = "motion"`` the robot slips and the odometry reports the command;
    with ``"odometry"`` the robot obeys and the encoders err.
    """

    std: MotionStd = Field(
        description="(σx, σy, σα) per step in the robot's frame [m, m, rad]"
    )
    noise_in: Annotated[
        Literal["motion", "odometry"], expect("'motion' or 'odometry'")
    ] = Field(default="motion", description="what the noise disturbs")
    noise_at_rest: Flag = Field(
        default=True, description="whether a step commanded (0, 0) has noise too"
    )

    @model_validator(mode="after")
    def _check_encoders(self) -> Self:
        if self.noise_in == "odometry" and self.std[1] != 0:
            raise broken_rule(
                "std must have σy = 0 with noise_in = 'odometry', since encoders read "
                f"no sideways motion, got {self.std}"
            )
        return self


class Sensor(Part):
    """The bearing-range sensor: its noise, its reach and its failures."""

    std: MeasurementStd = Field(description="(σβ, σr) of one reading [rad, m]")
    range_std_per_metre: NotNegative = Field(
        default=0.0, description="k in σr(r) = σr + k r [m/m]"
    )
    min_range: NotNegative = Field(
        default=0.05, description="nearest landmark it sees [m]"
    )
    max_range: PositiveOrInfinite = Field(
        default=math.inf,
        description="farthest landmark it sees [m], inf (the default) for all",
        json_schema_extra=_leave_out_default,
    )
    field_of_view: _Angle = Field(
        default=2 * math.pi,
        description="full angle of view, centred on the heading [rad]",
    )
    occlusion: Flag = Field(default=False, description="whether walls hide landmarks")
    dropout: Probability = Field(
        default=0.0, description="probability of losing a reading"
    )
    clutter: NotNegative = Field(
        default=0.0, description="mean number of false measurements per step (Poisson)"
    )
    max_clutter: CountOrZero = Field(
        default=0,
        description="rows reserved for false measurements when identities are hidden",
    )
    identities: Flag = Field(
        default=True, description="whether a reading tells which landmark it is of"
    )

    @model_validator(mode="after")
    def _check_reach(self) -> Self:
        if self.min_range >= self.max_range:
            raise broken_rule(
                f"min_range must be < max_range = {self.max_range}, "
                f"got {self.min_range}"
            )
        return self

    @model_validator(mode="after")
    def _check_clutter(self) -> Self:
        if self.clutter == 0:
            return self
        if self.identities or math.isinf(self.max_range):
            raise broken_rule(
                "clutter must be 0 unless identities = false and max_range is finite, "
                f"got {self.clutter}"
            )
        if self.max_clutter < self.clutter:
            raise broken_rule(
                f"max_clutter must be >= clutter = {self.clutter} "
                f"(better mean + 4 √mean), got {self.max_clutter}"
            )
        return self


class Scenario(Part):
    """A robot, its sensor, the landmarks and walls around it, and what it is told.

    A value: frozen, comparable, hashable. Read one with `load_scenario`, vary it with
    `with_changes`. The constructor itself raises pydantic's ``ValidationError``.
    """

    name: Name = Field(description="short name, for titles and files")
    description: Text = Field(default="", description="what the scenario is good for")
    dt: Positive = Field(description="duration of one step [s]")
    steps: _Steps = Field(description="steps of an episode")
    start: Start = Field(default=Start(), description="where the robot starts")
    robot: Robot = Field(default=Robot(), description="body and limits of the robot")
    motion: Motion = Field(description="noise of the motion")
    sensor: Sensor = Field(description="bearing-range sensor")
    landmarks: LandmarkLayout = Field(description="where the landmarks stand")
    walls: tuple[Wall, ...] = Field(
        default=(), description="(x0, y0, x1, y1) of each [m]"
    )
    controls: ControlSequence = Field(
        description="what the robot is told, open loop; cycled when short"
    )
    randomise: Randomise | None = Field(
        default=None, description="ranges from which every episode draws its own world"
    )

    @model_validator(mode="after")
    def _check_walls(self) -> Self:
        for index, (x0, y0, x1, y1) in enumerate(self.walls):
            if (x0, y0) == (x1, y1):
                raise broken_rule(
                    f"walls[{index}] must have a length > 0, got {self.walls[index]}"
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
        refuse_impossible_ends(self)
        return self

    def with_changes(self, **changes: object) -> Self:
        """Return a scenario with some fields replaced.

        Parameters
        ----------
        **changes : object
            New values by field; a mapping changes only the keys it names, unless it
            chooses another layout or sequence, which it then describes in full.

        Raises
        ------
        ScenarioError
            If a key is unknown or the result is not a valid scenario.

        Examples
        --------
        >>> from slamgym.sim_configs import load_scenario
        >>> scenario = load_scenario("six_landmarks")
        >>> scenario.with_changes(sensor={"max_range": 4.0}, steps=10).sensor.std
        (0.01, 0.08)
        """
        return self.from_table(_merge(self.model_dump(), changes))

    @classmethod
    def from_table(cls, table: Mapping[str, object]) -> Self:
        """Validate a mapping of plain values (also arrays) as a scenario.

        Raises
        ------
        ScenarioError
            With one line per mistake.
        """
        try:
            return cls.model_validate(_plain(table))
        except ValidationError as error:
            raise ScenarioError("\n".join(error_lines(error))) from None


def action_sequence(scenario: Scenario) -> NDArray[np.float64]:
    """Compute the open-loop actions of an episode from the scenario's controls.

    Returns
    -------
    ndarray of float64, shape (steps, 2)
        Rows (v, ω) [m/s, rad/s]; v dt and ω dt are the commanded (d, α). A sequence
        shorter than the episode starts again.

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
