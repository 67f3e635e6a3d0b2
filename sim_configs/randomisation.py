"""Ranges in a scenario from which every episode draws a world of its own.

Noise is multiplied by factors, drawn uniform in their logarithm; everything else is
drawn uniform between two ends. The number of landmarks never changes.
"""

from typing import TYPE_CHECKING, Annotated, Any, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from .field_types import NotNegative, Part, broken_rule, expect
from .layouts import place_landmarks
from .scenario_errors import ScenarioError

if TYPE_CHECKING:
    from .scenario import Scenario

_Finite = Annotated[float, Field(strict=True, allow_inf_nan=False)]
_Factor = Annotated[float, Field(strict=True, allow_inf_nan=False, gt=0)]
Factors = Annotated[
    tuple[_Factor, _Factor], expect("2 finite factors > 0, low and high")
]
Ends = Annotated[tuple[_Finite, _Finite], expect("2 finite numbers, low and high")]


class Randomise(Part):
    """What differs from episode to episode, and between which ends.

    What is left out stays as it is. `drawn_scenario` makes the scenario of an episode.
    """

    motion_std: Factors | None = Field(default=None, description="factor on motion.std")
    measurement_std: Factors | None = Field(
        default=None, description="factor on sensor.std and sensor.range_std_per_metre"
    )
    start_std: Factors | None = Field(default=None, description="factor on start.std")
    dropout: Ends | None = Field(default=None, description="sensor.dropout")
    clutter: Ends | None = Field(default=None, description="sensor.clutter")
    max_range: Ends | None = Field(default=None, description="sensor.max_range [m]")
    field_of_view: Ends | None = Field(
        default=None, description="sensor.field_of_view [rad]"
    )
    start_x: Ends | None = Field(default=None, description="x of start.pose [m]")
    start_y: Ends | None = Field(default=None, description="y of start.pose [m]")
    start_heading: Ends | None = Field(
        default=None, description="θ of start.pose [rad]"
    )
    map_scale: Factors | None = Field(
        default=None, description="factor that stretches the landmarks about their mean"
    )
    landmark_shift: NotNegative = Field(
        default=0.0,
        description="each landmark moves by up to so much along x and along y [m]",
    )

    @model_validator(mode="after")
    def _check_order(self) -> Self:
        for name, ends in self:
            if isinstance(ends, tuple) and ends[0] > ends[1]:
                raise broken_rule(f"{name} must have low <= high, got {ends}")
        return self


_FACTORS = ("motion_std", "measurement_std", "start_std", "map_scale")
_DRAWN = tuple(name for name in Randomise.model_fields if name != "landmark_shift")


def drawn_scenario(scenario: "Scenario", rng: np.random.Generator) -> "Scenario":
    """Draw the scenario of one episode.

    Every field has its own random number, so that no range changes what another one
    gives::

        factor = low (high / low)^u,    value = low + u (high - low),    u ~ U[0, 1)

    Parameters
    ----------
    scenario : Scenario
        With or without ``randomise``.
    rng : numpy.random.Generator
        Where the numbers come from.

    Returns
    -------
    Scenario
        Without ``randomise``; where there was none, the scenario itself. A map that is
        stretched or shifted becomes a layout of points.

    Examples
    --------
    >>> from slamgym.sim_configs import load_scenario
    >>> ranges = {"motion_std": [0.5, 2.0], "start_heading": [-3.0, 3.0]}
    >>> scenario = load_scenario("six_landmarks").with_changes(randomise=ranges)
    >>> drawn = drawn_scenario(scenario, np.random.default_rng(0))
    >>> [round(std / 0.1, 3) for std in drawn.motion.std]
    [3.023, 1.209, 1.209]
    >>> drawn == drawn_scenario(scenario, np.random.default_rng(0))
    True
    """
    if scenario.randomise is None:
        return scenario
    shares = dict(zip(_DRAWN, rng.random(len(_DRAWN)).tolist(), strict=True))
    directions = rng.uniform(-1.0, 1.0, (scenario.landmarks.count, 2))
    return _at(scenario, shares, directions)


def refuse_ranges(scenario: "Scenario") -> None:
    """Raise where a world is asked for that is still to be drawn.

    Raises
    ------
    ScenarioError
        If the scenario has ``randomise``.
    """
    if scenario.randomise is not None:
        raise ScenarioError(
            f"scenario '{scenario.name}' has ranges (randomise): draw a scenario from "
            "them with drawn_scenario, as slamgym generate does for every episode"
        )


def refuse_impossible_ends(scenario: "Scenario") -> None:
    """Raise a broken rule unless both ends of all ranges give valid scenarios.

    The rules of a scenario are bounds, so what holds at both ends holds between.
    """
    ranges = scenario.randomise
    if ranges is None:
        return
    if _is_new_in_every_episode(scenario) and ranges.landmark_shift:
        raise broken_rule(
            "randomise.landmark_shift must be 0 where every episode has new landmarks "
            f"anyway, got {ranges.landmark_shift}"
        )
    still = np.zeros((scenario.landmarks.count, 2))
    for share, end in ((0.0, "low"), (1.0, "high")):
        try:
            _at(scenario, dict.fromkeys(_DRAWN, share), still)
        except ValueError as error:
            raise broken_rule(
                f"randomise must give valid scenarios, but at the {end} ends {error}"
            ) from None


def _at(
    scenario: "Scenario", shares: dict[str, float], directions: NDArray[np.float64]
) -> "Scenario":
    """Make the scenario at these shares of the ways from low to high."""
    ranges = scenario.randomise
    assert ranges is not None
    drawn = {
        name: _between(ends, share, is_factor=name in _FACTORS)
        for name, share in shares.items()
        if (ends := getattr(ranges, name)) is not None
    }
    stretch, shift = drawn.get("map_scale", 1.0), ranges.landmark_shift
    changes: dict[str, Any] = {
        "randomise": None,
        "motion": {"std": _times(scenario.motion.std, drawn.get("motion_std", 1.0))},
        "sensor": _sensor(scenario, drawn),
        "start": _start(scenario, drawn),
    }
    if stretch != 1.0 or shift != 0.0:
        changes["landmarks"] = _map(scenario, stretch, shift * directions)
    return scenario.with_changes(**changes)


def _between(ends: tuple[float, float], share: float, *, is_factor: bool) -> float:
    low, high = ends
    if share in (0.0, 1.0):
        return high if share else low  # to the last bit
    if is_factor:
        return float(low * (high / low) ** share)
    return low + share * (high - low)


def _times(stds: tuple[float, ...], factor: float) -> list[float]:
    return [factor * std for std in stds]


def _sensor(scenario: "Scenario", drawn: dict[str, float]) -> dict[str, Any]:
    names = ("dropout", "clutter", "max_range", "field_of_view")
    changes: dict[str, Any] = {name: drawn[name] for name in names if name in drawn}
    factor = drawn.get("measurement_std", 1.0)
    growth = factor * scenario.sensor.range_std_per_metre
    std = _times(scenario.sensor.std, factor)
    return {**changes, "std": std, "range_std_per_metre": growth}


def _start(scenario: "Scenario", drawn: dict[str, float]) -> dict[str, Any]:
    names = ("start_x", "start_y", "start_heading")
    start = scenario.start
    pose = [
        drawn.get(name, value) for name, value in zip(names, start.pose, strict=True)
    ]
    return {"pose": pose, "std": _times(start.std, drawn.get("start_std", 1.0))}


def _map(
    scenario: "Scenario", stretch: float, shifts: NDArray[np.float64]
) -> dict[str, Any]:
    layout = scenario.landmarks
    if layout.layout == "random" and layout.seed is None:
        corners = np.reshape(layout.bounds, (2, 2))
        bounds = _stretched(corners, stretch).ravel().tolist()
        return {"bounds": bounds, "min_distance": stretch * layout.min_distance}
    positions = place_landmarks(layout, np.random.default_rng(0))  # has its own seed
    points = _stretched(positions, stretch) + shifts
    return {"layout": "points", "points": points.tolist()}


def _stretched(points: NDArray[np.float64], factor: float) -> NDArray[np.float64]:
    middle = points.mean(axis=0)
    stretched: NDArray[np.float64] = middle + factor * (points - middle)
    return stretched


def _is_new_in_every_episode(scenario: "Scenario") -> bool:
    layout = scenario.landmarks
    return layout.layout == "random" and layout.seed is None
