"""Ranges in a scenario from which every episode draws a world of its own.

Noise is multiplied by factors that are uniform in their logarithm. All other settings
are uniform between two ends. The number of landmarks never changes.
"""

from collections.abc import Mapping
from typing import Annotated, Any, Protocol, Self

import numpy as np
from pydantic import Field, model_validator

from ..arrays import Array
from .field_types import BOUNDED, NotNegative, Part, Positive, broken_rule, expect
from .layouts import LandmarkLayout, place_landmarks
from .scenario_parts import Motion, Sensor, Start

_Finite = Annotated[float, Field(strict=True, allow_inf_nan=False)]
Factors = Annotated[
    tuple[Positive, Positive], expect("2 finite factors > 0, low and high")
]
Ends = Annotated[
    tuple[_Finite, _Finite], expect("2 finite numbers, low and high"), BOUNDED
]

_FACTORS = ("motion_std", "measurement_std", "start_std", "map_scale")


class Tables(Protocol):
    """The tables of a scenario to which ranges apply."""

    motion: Motion
    sensor: Sensor
    start: Start
    landmarks: LandmarkLayout


class Randomise(Part):
    """The settings that differ from episode to episode, and their ranges.

    A setting without a range keeps its value. `drawn_scenario` draws the scenario of
    one episode.
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
        default=None, description="factor that scales the map about its mean"
    )
    landmark_shift: NotNegative = Field(
        default=0.0,
        description="largest shift of each landmark along x and along y [m]",
    )

    @model_validator(mode="after")
    def _check_order(self) -> Self:
        for name, ends in self:
            if isinstance(ends, tuple) and ends[0] > ends[1]:
                raise broken_rule(f"{name} must have low <= high, got {ends}")
        return self

    def changes(
        self,
        scenario: Tables,
        shares: Mapping[str, float],
        directions: Array,
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


RANGES = tuple(name for name in Randomise.model_fields if name != "landmark_shift")


def _between(ends: tuple[float, float], share: float, *, is_factor: bool) -> float:
    low, high = ends
    if share in (0.0, 1.0):
        return high if share else low  # exact
    if is_factor:
        return float(low * (high / low) ** share)
    return low + share * (high - low)


def _times(stds: tuple[float, ...], factor: float) -> list[float]:
    return [factor * std for std in stds]


def _sensor_changes(sensor: Sensor, drawn: dict[str, float]) -> dict[str, Any]:
    names = ("dropout", "clutter", "max_range", "field_of_view")
    changes: dict[str, Any] = {name: drawn[name] for name in names if name in drawn}
    factor = drawn.get("measurement_std", 1.0)
    growth = factor * sensor.range_std_per_metre
    return {**changes, "std": _times(sensor.std, factor), "range_std_per_metre": growth}


def _start_changes(start: Start, drawn: dict[str, float]) -> dict[str, Any]:
    names = ("start_x", "start_y", "start_heading")
    pose = [
        drawn.get(name, value) for name, value in zip(names, start.pose, strict=True)
    ]
    return {"pose": pose, "std": _times(start.std, drawn.get("start_std", 1.0))}


def _map_changes(layout: LandmarkLayout, scale: float, shifts: Array) -> dict[str, Any]:
    if layout.layout == "random" and layout.is_redrawn:
        corners = np.reshape(layout.bounds, (2, 2))
        bounds = _scaled(corners, scale).ravel().tolist()
        return {"bounds": bounds, "min_distance": scale * layout.min_distance}
    positions = place_landmarks(layout, np.random.default_rng(0))  # draws nothing
    points = _scaled(positions, scale) + shifts
    return {"layout": "points", "points": points.tolist()}


def _scaled(points: Array, factor: float) -> Array:
    mean = points.mean(axis=0)
    scaled: Array = mean + factor * (points - mean)
    return scaled
