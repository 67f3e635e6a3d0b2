"""Tables of a scenario: start, robot, motion noise, sensor and faults."""

import math
from typing import Annotated, Any, Literal, Self

from pydantic import Field, model_validator

from ..arrays import LARGEST_RANGE_GROWTH
from .field_types import (
    BOUNDED,
    CountOrZero,
    Finite,
    Flag,
    MeasurementStd,
    MotionStd,
    NotNegative,
    Part,
    Pose,
    PoseStd,
    Positive,
    PositiveOrInfinite,
    Probability,
    broken_rule,
    expect,
)

_Degrees = Annotated[
    float,
    Field(strict=True, allow_inf_nan=True, gt=2),
    expect("a number > 2, or inf"),
    BOUNDED,
]
_Angle = Annotated[Positive, Field(le=2 * math.pi), expect("a number in (0, 2π] [rad]")]
_RangeGrowth = Annotated[
    NotNegative,
    Field(le=LARGEST_RANGE_GROWTH),
    expect(f"a number from 0 to {LARGEST_RANGE_GROWTH:g}"),
]


def _leave_out_default(schema: dict[str, Any]) -> None:
    del schema["default"]  # JSON has no inf


class Start(Part):
    """The start pose of the robot and its uncertainty.

    With ``drawn = "truth"`` the true start is drawn around `pose` and a filter starts
    from `pose`. With ``"estimate"`` the true start is `pose` and the filter's first
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

    With ``noise_in = "motion"`` the robot slips and the odometry reports the command.
    With ``"odometry"`` the robot follows the command and the encoders have the noise.
    """

    std: MotionStd = Field(
        description="(σx, σy, σα) per step in the robot's frame [m, m, rad]"
    )
    noise_in: Annotated[
        Literal["motion", "odometry"], expect("'motion' or 'odometry'")
    ] = Field(default="motion", description="what the noise disturbs")
    noise_at_rest: Flag = Field(
        default=True, description="whether a step with the command (0, 0) has noise too"
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
    """The bearing-range sensor: its noise, its field of view and its failures."""

    std: MeasurementStd = Field(description="(σβ, σr) of one reading [rad, m]")
    range_std_per_metre: _RangeGrowth = Field(
        default=0.0, description="k in σr(r) = σr + k r [m/m]"
    )
    min_range: NotNegative = Field(
        default=0.05, description="nearest visible landmark [m]"
    )
    max_range: PositiveOrInfinite = Field(
        default=math.inf,
        description="farthest visible landmark [m]; inf (the default) for all",
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
        default=True,
        description="whether readings carry landmark identities",
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


class Faults(Part):
    """Deviations of the world from its other tables; no filter knows of them.

    A scenario without this table has no faults. No other setting changes, so filters
    assume the nominal noise. Odometry faults act on motion only, not on a robot
    that is commanded to rest.
    """

    odometry_scale: Annotated[
        float,
        Field(strict=True, allow_inf_nan=False, gt=-1),
        expect("a finite number > -1"),
        BOUNDED,
    ] = Field(
        default=0.0, description="s: odometry reads (1 + s) d for a distance d [1]"
    )
    odometry_turn: Finite = Field(
        default=0.0, description="added to every turn of the odometry [rad per step]"
    )
    bearing_bias: Finite = Field(
        default=0.0, description="added to every bearing [rad]"
    )
    range_bias: Finite = Field(default=0.0, description="added to every range [m]")
    motion_dof: _Degrees = Field(
        default=math.inf,
        description="degrees of freedom of the motion noise, Student's t with scale "
        "motion.std; inf (the default) for normal noise",
        json_schema_extra=_leave_out_default,
    )
    sensor_dof: _Degrees = Field(
        default=math.inf,
        description="degrees of freedom of the sensor noise, Student's t with scale "
        "sensor.std; inf (the default) for normal noise",
        json_schema_extra=_leave_out_default,
    )
