"""Types of scenario fields: strict numbers whose error messages name the expectation.

Number types refuse strings, booleans and NaN; they accept integers for floats. The
mistakes of a scenario become one `ScenarioError`.
"""

import math
from collections.abc import Iterable, Mapping
from reprlib import repr as short_repr
from typing import Annotated, Any, Self, cast

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    StrictBool,
    StrictStr,
    ValidationError,
    ValidationInfo,
    ValidatorFunctionWrapHandler,
    WrapValidator,
    model_validator,
)
from pydantic_core import PydanticCustomError

from ..arrays import LARGEST, SMALLEST
from ..suggestions import closest


class ScenarioTable(BaseModel):
    """A frozen table of a scenario that refuses unknown keys with a suggestion."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    @model_validator(mode="before")
    @classmethod
    def _refuse_unknown_keys(cls, table: Any) -> Any:
        if isinstance(table, dict):
            for key in table:
                if key not in cls.model_fields:
                    suggestion = closest(str(key), cls.model_fields, else_all=True)
                    raise PydanticCustomError(
                        "unknown_key",
                        "unknown key '{key}'{suggestion}",
                        {"key": str(key), "suggestion": suggestion},
                    )
        return table

    @model_validator(mode="after")
    def _check_rules(self) -> Self:
        for message in self._broken_rules():
            raise broken_rule(message)
        return self

    def _broken_rules(self) -> Iterable[str]:
        """Yield a message for each broken rule between fields; the first is raised."""
        return ()

    def difference(self, other: Self) -> str:
        """Name the first setting that differs in another table, with both values."""
        for name, value in self:
            if (found := getattr(other, name, None)) != value:
                if isinstance(found, ScenarioTable) and type(value) is type(found):
                    return f"{name}.{value.difference(found)}"
                return f"{name} must be {short_repr(value)}, got {short_repr(found)}"
        return ""


def setting(default: Any, description: str) -> Any:
    """Declare a field of a scenario by its default and its description."""
    extra = _leave_out_default if default == math.inf else None
    return Field(default=default, description=description, json_schema_extra=extra)


def _leave_out_default(schema: dict[str, Any]) -> None:
    del schema["default"]  # JSON has no inf


def broken_rule(message: str) -> PydanticCustomError:
    """Make the error of a rule between fields; `message` starts with a field's name."""
    return PydanticCustomError("rule", "{message}", {"message": message})


def expect(expectation: str) -> WrapValidator:
    """Replace every error inside a field by one message with the expectation."""
    return WrapValidator(lambda value, handler: _expected(value, handler, expectation))


def _expected(
    value: Any, handler: ValidatorFunctionWrapHandler, expectation: str
) -> Any:
    try:
        return handler(value)
    except ValidationError:
        raise PydanticCustomError(
            "expected",
            "must be {expected}, got {got}",
            {"expected": expectation, "got": short_repr(value)},
        ) from None


def kind_in(key: str) -> BeforeValidator:
    """Refuse a table without its kind as one of an unknown kind, which lists all."""
    return BeforeValidator(
        lambda value: {key: "", **value} if isinstance(value, Mapping) else value
    )


def _within_bounds(value: Any) -> Any:
    """Refuse finite numbers whose products with others could overflow."""
    numbers = value if isinstance(value, tuple) else (value,)
    largest = max(map(abs, numbers))
    if largest > LARGEST and largest != math.inf:
        raise _out_of_bounds("not exceed", LARGEST, value)
    return value


def _divisible(value: float) -> float:
    """Refuse positive numbers whose products or quotients could overflow."""
    if value < SMALLEST:
        raise _out_of_bounds("be at least", SMALLEST, value)
    return cast("float", _within_bounds(value))


def _out_of_bounds(rule: str, bound: float, value: object) -> PydanticCustomError:
    return PydanticCustomError(
        "expected",
        "must {rule} {bound}, got {got}",
        {"rule": rule, "bound": f"{bound:g}", "got": short_repr(value)},
    )


# One of them to a type: older versions of pydantic keep the last one alone.
BOUNDED, DIVISIBLE = AfterValidator(_within_bounds), AfterValidator(_divisible)

Number = Annotated[float, Field(strict=True, allow_inf_nan=False)]
_NotNegative = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=0)]
Integer = Annotated[int, Field(strict=True)]

Text = Annotated[StrictStr, expect("a string")]
Name = Annotated[StrictStr, Field(min_length=1), expect("a string that is not empty")]
Flag = Annotated[StrictBool, expect("true or false")]

Positive = Annotated[Number, Field(gt=0), expect("a finite number > 0"), DIVISIBLE]
NotNegative = Annotated[_NotNegative, expect("a finite number >= 0"), BOUNDED]
Finite = Annotated[Number, expect("a finite number"), BOUNDED]
PositiveOrInfinite = Annotated[
    float,
    Field(strict=True, allow_inf_nan=True, gt=0),
    expect("a number > 0, or inf"),
    DIVISIBLE,
]
Probability = Annotated[_NotNegative, Field(le=1), expect("a number from 0 to 1")]
Count = Annotated[Integer, Field(ge=1), expect("an integer >= 1"), BOUNDED]
CountOrZero = Annotated[Integer, Field(ge=0), expect("an integer >= 0"), BOUNDED]

Seed = Annotated[Integer, Field(ge=0), expect("an integer >= 0")]

_Two = tuple[Number, Number]
_Three = tuple[Number, Number, Number]
_Four = tuple[Number, Number, Number, Number]
_ThreeStds = tuple[_NotNegative, _NotNegative, _NotNegative]
_TwoStds = tuple[_NotNegative, _NotNegative]

Point = Annotated[_Two, expect("2 finite numbers (x, y) [m]"), BOUNDED]
Pose = Annotated[_Three, expect("3 finite numbers (x, y, θ) [m, m, rad]"), BOUNDED]
Bounds = Annotated[
    _Four, expect("4 finite numbers (xmin, ymin, xmax, ymax) [m]"), BOUNDED
]
Wall = Annotated[_Four, expect("4 finite numbers (x0, y0, x1, y1) [m]"), BOUNDED]
PoseStd = Annotated[
    _ThreeStds, expect("3 finite numbers >= 0 (σx, σy, σθ) [m, m, rad]"), BOUNDED
]
MotionStd = Annotated[
    _ThreeStds, expect("3 finite numbers >= 0 (σx, σy, σα) [m, m, rad]"), BOUNDED
]


def _expect_stds(
    value: Any, handler: ValidatorFunctionWrapHandler, info: ValidationInfo
) -> Any:
    """Name the numbers that the sensor's kind, an earlier field, reads."""
    kind = info.data.get("kind", "bearing_range")
    expected = _STDS.get(kind, f"in the units of '{kind}'")
    return _expected(value, handler, f"2 finite numbers >= 0 {expected}")


_STDS = {
    "bearing_range": "(σβ, σr) [rad, m]",
    "position": "(σx, σy) [m, m]",
    "bearing": "(σβ, 0) [rad]",
    "range": "(σr, 0) [m]",
}
MeasurementStd = Annotated[_TwoStds, WrapValidator(_expect_stds), BOUNDED]
Ends = Annotated[_Two, expect("2 finite numbers, low and high"), BOUNDED]
Command = Annotated[
    tuple[Number, Number, Annotated[Integer, Field(ge=1)]],
    expect("(d [m], α [rad], times): 2 finite numbers and an integer >= 1"),
    BOUNDED,
]


# --------------------------------------------------------------------------------------
# Error messages of invalid scenarios: one line per mistake, with the field's name.

_CONTAINERS = {
    "tuple_type": "a list",
    "model_type": "a table",
    "too_short": "a list that is not empty",
}


class ScenarioError(ValueError):
    """Raised for an invalid scenario; the message has one line per mistake."""


class UnknownKeywordError(ScenarioError, TypeError):
    """Raised for a keyword that is no field of a scenario.

    It is a `TypeError` too, as for any function that gets a keyword it does not have:
    libraries that try keywords of other environments rely on it.
    """


def unknown_choice(name: str, value: object, choices: Iterable[str]) -> str:
    """Return the message that a value is none of the choices.

    Examples
    --------
    >>> unknown_choice("format", "npy", ["npz", "tum"])
    "format must be one of npz, tum, got 'npy'; did you mean 'npz'?"
    """
    known = list(choices)
    suggestion = closest(str(value), known)
    return f"{name} must be one of {', '.join(known)}, got {value!r}{suggestion}"


def error_lines(error: ValidationError) -> list[str]:
    """Convert a validation error of pydantic to one line per mistake.

    Parameters
    ----------
    error : ValidationError
        Raised by the validation of a `Scenario`.

    Returns
    -------
    list of str
        For example ``"sensor.std must be 2 numbers >= 0, got [-1, 0.1]"``.
    """
    return [
        _line(dict(details))
        for details in error.errors()
        # a list with invalid items counts as too short, too
        if not (details["type"] == "too_short" and len(details["input"]) > 0)
    ]


def _line(details: dict[str, Any]) -> str:
    kind, path = details["type"], _path(details["loc"])
    context = details.get("ctx", {})
    match kind:
        case "unknown_key":
            where, suggestion = path or "the scenario", context["suggestion"]
            return f"unknown key '{context['key']}' in {where}{suggestion}"
        case "missing":
            return f"{path} must be given"
        case "expected":
            return f"{path} {details['msg']}"
        case "rule":
            return f"{path}.{details['msg']}" if path else str(details["msg"])
        case "union_tag_invalid":
            return _unknown_tag(path, context)
    expected = _CONTAINERS.get(kind, f"valid ({details['msg']})")
    return f"{path or 'scenario'} must be {expected}, got {details['input']!r}"


def _unknown_tag(path: str, context: dict[str, Any]) -> str:
    field = f"{path}.{context['discriminator'].strip(chr(39))}"
    names = [name.strip().strip("'") for name in context["expected_tags"].split(",")]
    if not context["tag"]:
        return f"{field} must be given, one of {', '.join(names)}"
    return unknown_choice(field, context["tag"], names)


def _path(location: tuple[str | int, ...]) -> str:
    """Format a location as in the file: ``walls[2]``, ``landmarks.radius``."""
    if len(location) > 1 and location[0] in ("landmarks", "controls"):
        location = (location[0], *location[2:])  # pydantic adds the layout's own name
    path = ""
    for step in location:
        path += f"[{step}]" if isinstance(step, int) else f".{step}"
    return path.removeprefix(".")
