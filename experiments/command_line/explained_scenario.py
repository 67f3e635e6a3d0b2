"""A scenario as a file to read and to change: `explained`."""

from collections.abc import Iterator
from typing import get_args

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from ...sim_configs import Scenario
from ...sim_configs.scenario_files import assignment, toml_value

_WIDTH = 100  # of a line, unless its value is longer


def explained(scenario: Scenario) -> str:
    """Return a scenario as TOML with the meaning, unit and default of every field.

    What the scenario does not set is commented out.

    Examples
    --------
    >>> from slamgym.sim_configs import load_scenario
    >>> text = explained(load_scenario("loop"))
    >>> print(text[text.index("dt =") : text.index("walls =")].rstrip())
    dt = 1.0  # duration of one step [s]; default 0.2
    steps = 1005  # steps of an episode; default 500
    """
    fields = Scenario.model_fields
    parts = {name for name, field in fields.items() if _models(field)}
    lines = [
        '# Fields after "# " are not set: give them a value without "# " to set them.'
    ]
    for name, field in fields.items():
        if name not in parts:
            lines += _lines(name, field, getattr(scenario, name))
    for name, field in fields.items():
        if name in parts:
            lines += ["", *_part(name, field, getattr(scenario, name))]
    return "\n".join([*lines, ""])


def _part(name: str, field: FieldInfo, part: BaseModel | None) -> Iterator[str]:
    """Write a table of the scenario; without it, a commented one."""
    kinds = _models(field)
    kind, off = (kinds[0], "# ") if part is None else (type(part), "")
    yield f"{off}[{name}]  # {field.description}"
    for key, each in kind.model_fields.items():
        value = None if part is None else getattr(part, key)
        if key in ("layout", "sequence"):
            known = sorted(
                get_args(one.model_fields[key].annotation)[0] for one in kinds
            )
            yield f"{assignment(key, value)}  # one of {', '.join(known)}"
        else:
            yield from _lines(key, each, value)


def _lines(name: str, field: FieldInfo, value: object) -> Iterator[str]:
    """Write a field with its meaning, beside it or above."""
    default = field.default
    meaning = field.description or ""
    if field.is_required():
        meaning += "; required"
    elif default is not None and "default" not in meaning:
        meaning += f"; default {toml_value(default)}"
    line = f"# {name} =" if value is None else assignment(name, value)
    if len(line) + len(meaning) < _WIDTH:
        yield f"{line}  # {meaning}"
    else:
        yield from (f"# {meaning}", line)


def _models(field: FieldInfo) -> list[type[BaseModel]]:
    """Return the tables that a field may be, none if it is a value."""
    kinds = get_args(field.annotation) or (field.annotation,)
    return [
        one for one in kinds if isinstance(one, type) and issubclass(one, BaseModel)
    ]
