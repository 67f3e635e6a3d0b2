"""Parse the values of options."""

import math
import tomllib
from collections.abc import Iterable
from typing import Any

from .errors import BadInputError


def given_options(**values: Any) -> dict[str, Any]:
    """Return the options that the user gave.

    Examples
    --------
    >>> given_options(gate_probability=0.99, noise_at_rest=None)
    {'gate_probability': 0.99}
    """
    return {name: value for name, value in values.items() if value is not None}


def standard_deviations(
    motion_std: str | None, measurement_std: str | None, initial_pose_std: str | None
) -> dict[str, tuple[float, ...]]:
    """Parse the standard deviations that the user gave, by the names of their options.

    Examples
    --------
    >>> standard_deviations("0.2,.1,1e-2", None, None)
    {'motion_std': (0.2, 0.1, 0.01)}
    >>> standard_deviations(None, "0.2,-1", None)
    Traceback (most recent call last):
    slamgym.experiments.command_line.errors.BadInputError: --measurement-std must be \
2 numbers >= 0 with commas between, got '0.2,-1'
    """
    texts = {
        "motion_std": (motion_std, 3),
        "measurement_std": (measurement_std, 2),
        "initial_pose_std": (initial_pose_std, 3),
    }
    return {
        name: _numbers(f"--{name.replace('_', '-')}", text, count)
        for name, (text, count) in texts.items()
        if text is not None
    }


def _numbers(option: str, text: str, count: int) -> tuple[float, ...]:
    try:
        values = tuple(float(part) for part in text.split(","))
    except ValueError:
        values = ()
    if len(values) != count or not all(0 <= value < math.inf for value in values):
        raise BadInputError(
            f"{option} must be {count} numbers >= 0 with commas between, got {text!r}"
        )
    return values


def assignments(option: str, texts: Iterable[str] | None) -> dict[str, Any]:
    """Parse "key=value" with the value as in TOML; a bare word is a string.

    Examples
    --------
    >>> assignments("--option", ["gate_probability=0.99", "landmark_init=full"])
    {'gate_probability': 0.99, 'landmark_init': 'full'}
    """
    values: dict[str, Any] = {}
    for text in texts or ():
        key, equals, value = (part.strip() for part in text.partition("="))
        if not (equals and key and value):
            raise BadInputError(f"{option} must be KEY=VALUE, got {text!r}")
        if key in values:
            raise BadInputError(f"{option} must name each key once, got {key} twice")
        values[key] = _toml_value(value)
    return values


def changes(option: str, texts: Iterable[str] | None) -> dict[str, Any]:
    """Parse "part.key=value" into nested mappings.

    Examples
    --------
    >>> changes("--set", ["sensor.max_range=4", "sensor.dropout=0.1", "steps=9"])
    {'sensor': {'max_range': 4, 'dropout': 0.1}, 'steps': 9}
    """
    nested: dict[str, Any] = {}
    for path, value in assignments(option, texts).items():
        *parts, key = path.split(".")
        place = nested
        for part in parts:
            place = place.setdefault(part, {})
            if not isinstance(place, dict):
                raise BadInputError(f"{option} sets {part} and a part of it, {path}")
        place[key] = value
    return nested


def _toml_value(text: str) -> Any:
    try:
        table = tomllib.loads(f"value = {text}")
    except (tomllib.TOMLDecodeError, RecursionError):
        return text
    return table["value"] if len(table) == 1 else text
