"""The complete description of a simulated world, as one immutable value: `Scenario`.

Its tables stand above it: `Faults`, `MotionTable`, `SensorTable`, `Start`, `Robot`, and
`Randomise`, the ranges from which every episode may draw a world of its own. Noise is
multiplied by factors that are uniform in their logarithm. All other settings are
uniform between two ends. The number of landmarks never changes.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import Field, ValidationError

from ..arrays import LARGEST, LARGEST_EPISODE, LARGEST_MAP, LARGEST_RANGE_GROWTH, Array
from ..suggestions import closest
from .field_types import (
    BOUNDED,
    DIVISIBLE,
    CountOrZero,
    Ends,
    Finite,
    Flag,
    Integer,
    MeasurementStd,
    MotionStd,
    Name,
    NotNegative,
    Number,
    Point,
    Pose,
    PoseStd,
    Positive,
    PositiveOrInfinite,
    Probability,
    ScenarioError,
    ScenarioTable,
    Text,
    UnknownKeywordError,
    Wall,
    error_lines,
    expect,
    setting,
)
from .landmarks_and_controls import (
    CircleSequence,
    ControlSequence,
    LandmarkLayout,
    place_landmarks,
)

_Degrees = Annotated[
    float,
    Field(strict=True, allow_inf_nan=True, gt=2),
    expect("a number > 2, or inf"),
    BOUNDED,
]


class Faults(ScenarioTable):
    """Deviations of the world from its other tables; no filter knows of them.

    A scenario without this table has no faults. No other setting changes, so filters
    assume the nominal noise. Odometry faults act on motion only, not on a robot
    that is commanded to rest.
    """

    odometry_scale: Annotated[
        Number, Field(gt=-1), expect("a finite number > -1"), BOUNDED
    ] = setting(0.0, "s: odometry reads (1 + s) d for a distance d [1]")
    odometry_turn: Finite = setting(
        0.0, "added to every turn of the odometry [rad per step]"
    )
    bearing_bias: Finite = setting(0.0, "added to every bearing [rad]")
    range_bias: Finite = setting(0.0, "added to every range [m]")
    motion_dof: _Degrees = setting(
        math.inf,
        "degrees of freedom of the motion noise, Student's t with scale "
        "motion.std; inf (the default) for normal noise",
    )
    sensor_dof: _Degrees = setting(
        math.inf,
        "degrees of freedom of the sensor noise, Student's t with scale "
        "sensor.std; inf (the default) for normal noise",
    )


_NO_FAULTS = Faults()
# Gymnasium's checker refuses an episode that ends at its first step.
_Steps = Annotated[Integer, Field(ge=2), expect("an integer >= 2")]


class MotionTable(ScenarioTable):
    """The noise of the motion.

    With ``noise_in = "motion"`` the robot slips and the odometry reports the command.
    With ``"odometry"`` the robot follows the command and the encoders have the noise.
    """

    std: MotionStd = Field(
        description="(σx, σy, σα) per step in the robot's frame [m, m, rad]"
    )
    noise_in: Annotated[
        Literal["motion", "odometry"], expect("'motion' or 'odometry'")
    ] = setting("motion", "what the noise disturbs")
    noise_at_rest: Flag = setting(
        True, "whether a step with the command (0, 0) has noise too"
    )

    def _broken_rules(self) -> Iterator[str]:
        if self.noise_in == "odometry" and self.std[1] != 0:
            yield (
                "std must have σy = 0 with noise_in = 'odometry', since encoders read "
                f"no sideways motion, got {self.std}"
            )


Factors = Annotated[
    tuple[Positive, Positive], expect("2 finite factors > 0, low and high")
]


_Angle = Annotated[
    Number, Field(gt=0, le=2 * math.pi), DIVISIBLE, expect("a number in (0, 2π] [rad]")
]
_RangeGrowth = Annotated[
    Number,
    Field(ge=0, le=LARGEST_RANGE_GROWTH),
    expect(f"a number from 0 to {LARGEST_RANGE_GROWTH:g}"),
]


class SensorTable(ScenarioTable):
    """The sensor: what it reads, its noise, its field of view and its failures.

    A sensor of one number has (σ, 0) as its `std`, and 0 as the second number of its
    readings.  A sensor of your own is simulated by its function h.
    """

    kind: Annotated[
        str,
        Field(pattern=r"^(bearing_range|position|bearing|range|[\w.]+:\w+)$"),
        expect("'bearing_range', 'position', 'bearing', 'range' or 'module:SENSOR'"),
    ] = setting(
        "bearing_range",
        "content of one reading: (β, r), (x, y) in the robot's frame, β, r, or the "
        "numbers of your own sensor, 'module:SENSOR'",
    )
    std: MeasurementStd = Field(
        description="of one reading: (σβ, σr) [rad, m], (σx, σy) [m], (σβ, 0), (σr, 0)"
    )
    range_std_per_metre: _RangeGrowth = setting(0.0, "k in σr(r) = σr + k r [m/m]")
    min_range: NotNegative = setting(0.05, "nearest visible landmark [m]")
    max_range: PositiveOrInfinite = setting(
        math.inf, "farthest visible landmark [m]; inf (the default) for all"
    )
    field_of_view: _Angle = setting(
        2 * math.pi, "full angle of view, centred on the heading [rad]"
    )
    occlusion: Flag = setting(False, "whether walls hide landmarks")
    dropout: Probability = setting(0.0, "probability of losing a reading")
    clutter: NotNegative = setting(
        0.0, "mean number of false measurements per step (Poisson)"
    )
    max_clutter: CountOrZero = setting(
        0, "rows reserved for false measurements when identities are hidden"
    )
    identities: Flag = setting(True, "whether readings carry landmark identities")

    def _broken_rules(self) -> Iterator[str]:
        if self.min_range >= self.max_range:
            yield (
                f"min_range must be < max_range = {self.max_range}, "
                f"got {self.min_range}"
            )
        if self.clutter and (self.identities or math.isinf(self.max_range)):
            yield (
                "clutter must be 0 unless identities = false and max_range is finite, "
                f"got {self.clutter}"
            )
        if self.max_clutter < self.clutter:
            yield (
                f"max_clutter must be >= clutter = {self.clutter} "
                f"(better mean + 4 √mean), got {self.max_clutter}"
            )
        yield from self._broken_kind()

    def _broken_kind(self) -> Iterator[str]:
        """Check what only some kinds of sensors have."""
        kind = self.kind
        if not (self.identities or kind == "bearing_range"):
            yield f"identities must be true with kind = '{kind}', got false"
        if kind in ("bearing", "range") and self.std[1] != 0:
            yield f"std must be (σ, 0) with kind = '{kind}', got {self.std}"
        if kind not in ("bearing_range", "range") and self.range_std_per_metre:
            yield (
                f"range_std_per_metre must be 0 with kind = '{kind}', "
                f"got {self.range_std_per_metre}"
            )


_Every = Annotated[Integer, Field(ge=1), expect("an integer >= 1")]


class Compass(ScenarioTable):
    """A sensor of the heading, beside that of the landmarks."""

    std: Positive = Field(description="σθ of one reading [rad]")
    every: _Every = setting(1, "steps from one reading to the next, from step 0 on")


class Gps(ScenarioTable):
    """A sensor of the position, beside that of the landmarks."""

    std: Positive = Field(description="σ of one reading, along x and along y [m]")
    every: _Every = setting(1, "steps from one reading to the next, from step 0 on")


class Start(ScenarioTable):
    """The start pose of the robot and its uncertainty.

    With ``drawn = "truth"`` the true start is drawn around `pose` and a filter starts
    from `pose`. With ``"estimate"`` the true start is `pose` and the filter's first
    pose is drawn around it.
    """

    pose: Pose = setting((0.0, 0.0, 0.0), "(x, y, θ) [m, m, rad]")
    std: PoseStd = setting(
        (0.0, 0.0, 0.0), "standard deviations (σx, σy, σθ) [m, m, rad]"
    )
    drawn: Annotated[Literal["truth", "estimate"], expect("'truth' or 'estimate'")] = (
        setting("truth", "what is drawn around `pose`: the true start or its estimate")
    )


class Randomise(ScenarioTable):
    """The settings that differ from episode to episode, and their ranges.

    A setting without a range keeps its value. `drawn_scenario` draws the scenario of
    one episode.
    """

    motion_std: Factors | None = setting(None, "factor on motion.std")
    measurement_std: Factors | None = setting(
        None, "factor on sensor.std and sensor.range_std_per_metre"
    )
    start_std: Factors | None = setting(None, "factor on start.std")
    dropout: Ends | None = setting(None, "sensor.dropout")
    clutter: Ends | None = setting(None, "sensor.clutter")
    max_range: Ends | None = setting(None, "sensor.max_range [m]")
    field_of_view: Ends | None = setting(None, "sensor.field_of_view [rad]")
    start_x: Ends | None = setting(None, "x of start.pose [m]")
    start_y: Ends | None = setting(None, "y of start.pose [m]")
    start_heading: Ends | None = setting(None, "θ of start.pose [rad]")
    map_scale: Factors | None = setting(
        None, "factor that scales the map about its mean"
    )
    landmark_shift: NotNegative = setting(
        0.0, "largest shift of each landmark along x and along y [m]"
    )

    def _broken_rules(self) -> Iterator[str]:
        for name, ends in self:
            if isinstance(ends, tuple) and ends[0] > ends[1]:
                yield f"{name} must have low <= high, got {ends}"

    def changes(
        self, scenario: "Scenario", shares: Mapping[str, float], directions: Array
    ) -> dict[str, Any]:
        """Compute the changes of a scenario for one point of the ranges.

        Parameters
        ----------
        scenario : Scenario
            The scenario with these ranges.
        shares : mapping of str to float
            u in [0, 1] for each of `RANGES`: 0 is the low end, 1 the high end.
        directions : ndarray, shape (N, 2)
            Shift of each landmark, in [-1, 1] per axis.

        Returns
        -------
        dict
            For `Scenario.with_changes`.
        """
        drawn = {
            name: _between(ends, share, is_factor=name in _FACTORS)
            for name, share in shares.items()
            if (ends := getattr(self, name)) is not None
        }
        scale, shift = drawn.get("map_scale", 1.0), self.landmark_shift
        changes: dict[str, Any] = {
            "randomise": None,
            "motion": {
                "std": _times(scenario.motion.std, drawn.get("motion_std", 1.0))
            },
            "sensor": _sensor_changes(scenario.sensor, drawn),
            "start": _start_changes(scenario.start, drawn),
        }
        if scale != 1.0 or shift != 0.0:
            shifts = shift * directions
            changes["landmarks"] = _map_changes(scenario.landmarks, scale, shifts)
        return changes


_Steering = Annotated[
    Number, Field(gt=0, lt=math.pi / 2), DIVISIBLE, expect("a number in (0, π/2) [rad]")
]
_OF_DRIVE = {
    "track_width": "differential",
    "wheelbase": "bicycle",
    "max_steering": "bicycle",
    "reference": "bicycle",
}


class Robot(ScenarioTable):
    """The body of the robot and the limits of its actions."""

    radius: Positive = setting(0.2, "radius of the round body [m]")
    max_speed: Positive = setting(1.0, "limit of |v| [m/s]")
    max_turn_rate: Positive = setting(1.0, "limit of |ω| [rad/s]")
    drive: Annotated[
        Literal["unicycle", "differential", "bicycle"],
        expect("'unicycle', 'differential' or 'bicycle'"),
    ] = setting("unicycle", "how the robot moves, and what its odometry reports")
    track_width: Positive | None = setting(
        None, "distance between the wheels of a differential drive [m]"
    )
    wheelbase: Positive | None = setting(
        None, "distance between the axles of a bicycle drive [m]"
    )
    max_steering: _Steering | None = setting(
        None, "limit of the steering angle of a bicycle drive [rad]"
    )
    reference: Point | None = setting(
        None,
        "position of the pose and the sensor of a bicycle: distance ahead and to the "
        "left of the middle of the rear axle [m]",
    )

    def _broken_rules(self) -> Iterator[str]:
        for name, drive in _OF_DRIVE.items():
            given, needed = getattr(self, name), self.drive == drive
            if given is None and needed and name != "reference":
                yield f"{name} must be given with drive = '{drive}'"
            if given is not None and not needed:
                yield f"{name} must not be given with drive = '{self.drive}'"


class Scenario(ScenarioTable):
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
    description: Text = setting("", "purpose of the scenario")
    dt: Positive = setting(0.2, "duration of one step [s]")
    steps: _Steps = setting(500, "steps of an episode")
    start: Start = setting(Start(), "start pose of the robot")
    robot: Robot = setting(Robot(), "body and limits of the robot")
    motion: MotionTable = Field(description="noise of the motion")
    sensor: SensorTable = Field(description="sensor of the landmarks")
    compass: Compass | None = setting(None, "sensor of the heading")
    gps: Gps | None = setting(None, "sensor of the position")
    landmarks: LandmarkLayout = Field(description="positions of the landmarks")
    walls: tuple[Wall, ...] = setting((), "(x0, y0, x1, y1) of each [m]")
    controls: ControlSequence = setting(
        CircleSequence(radius=4.0, speed=0.5),
        "open-loop commands of the robot; repeated when short; by default "
        "a circle of 4 m at 0.5 m/s",
    )
    randomise: Randomise | None = setting(
        None, "ranges from which every episode draws its own world"
    )

    faults: Faults | None = setting(None, "faults of the world that no filter knows")

    @property
    def present_faults(self) -> Faults:
        """The faults of the world, all zero where the scenario has none."""
        return self.faults or _NO_FAULTS

    @property
    def models(self) -> dict[str, Any]:
        """Options of `make_estimator`, except the two std, that are not its defaults.

        Examples
        --------
        >>> from slamgym.sim_configs import load_scenario
        >>> load_scenario("differential").models
        {'motion': 'differential[track_width=0.5]'}
        """
        models: dict[str, Any] = {}
        robot = self.robot
        if self.sensor.range_std_per_metre:
            models["range_std_per_metre"] = self.sensor.range_std_per_metre
        if not self.motion.noise_at_rest:
            models["noise_at_rest"] = False
        if self.sensor.kind != "bearing_range":
            models["sensor"] = self.sensor.kind
        if robot.drive == "differential":
            models["motion"] = f"differential[track_width={robot.track_width!r}]"
        if robot.drive == "bicycle":
            x, y = robot.reference or (0.0, 0.0)
            where = f", reference=[{x!r}, {y!r}]" if x or y else ""
            models["motion"] = f"bicycle[wheelbase={robot.wheelbase!r}{where}]"
        return models

    def refuse_models(self, part: str) -> None:
        """Raise a `ScenarioError` if sensor or drive is not the default."""
        for name, usual in ("sensor", "bearing_range"), ("motion", "unicycle"):
            if (label := self.models.get(name, usual)) != usual:
                raise ScenarioError(
                    f"{part} accepts only {name} = '{usual}', got '{label}'"
                )

    def _broken_rules(self) -> Iterator[str]:
        yield from self._broken_sizes()
        yield from self._broken_limits()
        yield from self._broken_models()
        yield from self._broken_ranges()

    def _broken_sizes(self) -> Iterator[str]:
        for index, (x0, y0, x1, y1) in enumerate(self.walls):
            if (x0, y0) == (x1, y1):
                yield f"walls[{index}] must have a length > 0, got {self.walls[index]}"
        for name, count, most in (
            ("steps", self.steps, LARGEST_EPISODE),
            ("landmarks", self.landmarks.count, LARGEST_MAP),
            ("sensor.max_clutter", self.sensor.max_clutter, LARGEST_MAP),
        ):
            if count > most:
                yield f"{name} must be at most {most}, got {count}"
        for name in ("max_speed", "max_turn_rate"):
            limit = getattr(self.robot, name)
            if limit * self.dt > LARGEST:
                yield (
                    f"robot.{name} must not exceed {LARGEST:g} / dt, so that no step "
                    f"is longer, got {limit} with dt = {self.dt}"
                )

    def _broken_limits(self) -> Iterator[str]:
        fastest = np.abs(self.controls.cycle(self.dt)).max(axis=0) / self.dt
        for name, unit, asked in zip(
            ("max_speed", "max_turn_rate"), ("m/s", "rad/s"), fastest, strict=True
        ):
            limit = getattr(self.robot, name)
            if asked > limit * (1 + 1e-9):
                yield (
                    f"controls must stay within robot.{name} = {limit} {unit}, "
                    f"got {asked:.6g} {unit}"
                )

    def _broken_models(self) -> Iterator[str]:
        """Check what only some drives and sensors can do."""
        drive, kind, faults = self.robot.drive, self.sensor.kind, self.present_faults
        if drive != "unicycle" and self.motion.noise_in == "odometry":
            yield f"motion.noise_in must be 'motion' with robot.drive = '{drive}'"
        if drive == "bicycle" and self.walls:
            yield "walls must be empty with robot.drive = 'bicycle'"
        for name, kinds in (("bearing_bias", "bearing"), ("range_bias", "range")):
            if getattr(faults, name) and (kinds not in kind or ":" in kind):
                yield f"faults.{name} must be 0 with sensor.kind = '{kind}'"
        if drive == "bicycle":
            distances, turns = np.abs(self.controls.cycle(self.dt)).T
            most = distances * largest_curvature(self.robot)
            if (turns > most * (1 + 1e-9)).any():
                worst = int(np.argmax(turns - most))
                yield (
                    "controls must turn by at most d tan(max_steering) / wheelbase = "
                    f"{most[worst]:.6g} rad in a step of {distances[worst]:.6g} m, "
                    f"got {turns[worst]:.6g} rad"
                )

    def _broken_ranges(self) -> Iterator[str]:
        """Check both ends of all ranges; every rule is a bound and holds in between."""
        ranges = self.randomise
        if ranges is None:
            return
        if ranges.landmark_shift and self.landmarks.is_redrawn:
            yield (
                "randomise.landmark_shift must be 0 where every episode has new "
                f"landmarks anyway, got {ranges.landmark_shift}"
            )
        for share, end in ((0.0, "low"), (1.0, "high")):
            try:
                self.at_share(share)
            except ValueError as error:
                at = f"at the {end} ends {error}"
                yield f"randomise must give valid scenarios, but {at}"

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
        refuse_unknown_keywords(changes)
        return self.from_table(_merge(self.model_dump(), changes))

    def drawn_at(self, shares: Mapping[str, float], directions: Array) -> Self:
        """Return the scenario at one point of its ranges; see `Randomise.changes`."""
        assert self.randomise is not None
        return self.with_changes(**self.randomise.changes(self, shares, directions))

    def at_share(self, share: float) -> Self:
        """Return the scenario with one share of all its ranges, landmarks unmoved."""
        unmoved = np.zeros((self.landmarks.count, 2))
        return self.drawn_at(dict.fromkeys(RANGES, share), unmoved)

    @classmethod
    def from_table(cls, table: Mapping[str, object]) -> Self:
        """Make a scenario from a mapping of plain values and arrays.

        Raises
        ------
        ScenarioError
            With one line per mistake.
        """
        try:
            return cls.model_validate(plain(table))
        except ValidationError as error:
            raise ScenarioError("\n".join(error_lines(error))) from None


def refuse_unknown_keywords(
    given: Iterable[str], others: Sequence[str] = (), *, where: str = "in the scenario"
) -> None:
    """Refuse keywords that are no field of a scenario; suggest one, or one of others.

    Raises
    ------
    ScenarioError
        Also a `TypeError`.
    """
    fields = Scenario.model_fields
    for key in given:
        if key not in fields:
            raise UnknownKeywordError(
                f"unknown key '{key}' {where}"
                f"{closest(key, [*others, *fields], else_all=True)} "
                f"(unexpected keyword argument '{key}')"
            )


def largest_curvature(robot: Robot) -> float:
    """Return tan(max_steering) / wheelbase of a bicycle [1/m], inf for other drives.

    Examples
    --------
    >>> largest_curvature(Robot())
    inf
    """
    if robot.max_steering is None or robot.wheelbase is None:
        return math.inf
    return math.tan(robot.max_steering) / robot.wheelbase


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
    cycle = scenario.controls.cycle(scenario.dt) / scenario.dt
    return np.resize(cycle, (scenario.steps, 2))


def _merge(table: dict[str, Any], changes: Mapping[str, object]) -> dict[str, Any]:
    merged = dict(table)
    for key, change in changes.items():
        merged[key], old = change, table.get(key)
        if isinstance(change, Mapping) and isinstance(old, dict):
            kind = {"landmarks": "layout", "controls": "sequence"}.get(key, "")
            same = change.get(kind, old.get(kind)) == old.get(kind)
            if key == "sensor" and _is_foreign(change, old):
                old = {name: old[name] for name in old if name != "std"}
            merged[key] = {**old, **change} if same else change
    return merged


def _is_foreign(change: Mapping[str, object], old: Mapping[str, object]) -> bool:
    """Return whether a sensor becomes one of the user, with noise in other units."""
    kind = change.get("kind", old["kind"])
    return ":" in str(kind) and kind != old["kind"]


def plain(value: Any, replaced: Callable[[Any], Any] = lambda value: value) -> Any:
    """Replace arrays, models and other mappings by lists and dicts.

    ``replaced`` replaces each value before, also inside of others.
    """
    value = replaced(value)
    if isinstance(value, ScenarioTable):
        return value.model_dump()
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, Mapping):
        return {key: plain(item, replaced) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item, replaced) for item in value]
    return value


_FACTORS = ("motion_std", "measurement_std", "start_std", "map_scale")


def _between(ends: tuple[float, float], share: float, *, is_factor: bool) -> float:
    low, high = ends
    if share in (0.0, 1.0):
        return high if share else low  # exact
    if is_factor:
        return float(low * (high / low) ** share)
    return low + share * (high - low)


def _map_changes(layout: LandmarkLayout, scale: float, shifts: Array) -> dict[str, Any]:
    if layout.layout == "random" and layout.is_redrawn:
        bounds = _scaled(np.reshape(layout.bounds, (2, 2)), scale).ravel().tolist()
        return {"bounds": tuple(bounds), "min_distance": scale * layout.min_distance}
    positions = place_landmarks(layout, np.random.default_rng(0))  # draws nothing
    points = _scaled(positions, scale) + shifts
    return {"layout": "points", "points": points.tolist()}


def _scaled(points: Array, factor: float) -> Array:
    mean = points.mean(axis=0)
    scaled: Array = mean + factor * (points - mean)
    return scaled


def _sensor_changes(sensor: SensorTable, drawn: dict[str, float]) -> dict[str, Any]:
    names = ("dropout", "clutter", "max_range", "field_of_view")
    changes: dict[str, Any] = {name: drawn[name] for name in names if name in drawn}
    factor = drawn.get("measurement_std", 1.0)
    growth = factor * sensor.range_std_per_metre
    return {**changes, "std": _times(sensor.std, factor), "range_std_per_metre": growth}


def _start_changes(start: Start, drawn: dict[str, float]) -> dict[str, Any]:
    names = ("start_x", "start_y", "start_heading")
    pose = map(drawn.get, names, start.pose)
    return {"pose": tuple(pose), "std": _times(start.std, drawn.get("start_std", 1.0))}


def _times(stds: tuple[float, ...], factor: float) -> tuple[float, ...]:
    return tuple(factor * std for std in stds)


RANGES = tuple(name for name in Randomise.model_fields if name != "landmark_shift")
