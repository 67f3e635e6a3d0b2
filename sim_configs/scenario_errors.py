"""Error messages of invalid scenarios: one line per mistake, with the field's name."""

from collections.abc import Iterable
from typing import Any

from pydantic import ValidationError

from ..suggestions import closest

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
    mistakes = error.errors(include_url=False)
    return [_line(dict(details)) for details in mistakes if not _is_echo(dict(details))]


def _is_echo(details: dict[str, Any]) -> bool:
    """Report whether a list counts as too short only because its items are invalid."""
    return details["type"] == "too_short" and len(details["input"]) > 0


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
        case "union_tag_not_found" | "union_tag_invalid":
            return _unknown_tag(path, context)
    expected = _CONTAINERS.get(kind, f"valid ({details['msg']})")
    return f"{path or 'scenario'} must be {expected}, got {details['input']!r}"


def _unknown_tag(path: str, context: dict[str, Any]) -> str:
    field = f"{path}.{context['discriminator'].strip(chr(39))}"
    if "tag" not in context:
        return f"{field} must be given"
    names = [name.strip().strip("'") for name in context["expected_tags"].split(",")]
    return unknown_choice(field, context["tag"], names)


def _path(location: tuple[str | int, ...]) -> str:
    """Format a location as in the file: ``walls[2]``, ``landmarks.radius``."""
    if len(location) > 1 and location[0] in ("landmarks", "controls"):
        location = (location[0], *location[2:])  # pydantic adds the layout's own name
    path = ""
    for step in location:
        path += f"[{step}]" if isinstance(step, int) else f".{step}"
    return path.removeprefix(".")
