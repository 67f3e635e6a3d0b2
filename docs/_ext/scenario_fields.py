"""The page of a scenario's fields, made from the schema."""

import json
import re
from typing import Any

from slamgym.sim_configs import Scenario

INTRODUCTION = """# Fields of a scenario

A scenario is a TOML file, a mapping or a `Scenario`; the names of the fields are the
same. Only `name`, `motion.std`, `sensor.std` and `landmarks` are required, so this file
is complete:

```toml
name = "my_world"
[motion]
std = [0.02, 0.0, 0.02]
[sensor]
std = [0.02, 0.1]
[landmarks]
layout = "ring"
count = 8
radius = 6.0
```

`slamgym run my_world.toml` drives through it. `Scenario.with_changes`, or
`--set sensor.max_range=5` on the command line, replaces single fields. Fields without a
unit are numbers, texts or truth values. [Conventions](conventions.md) defines the
frames and the symbols.
"""
CHOICES = {
    "landmarks": ("layout", "The positions of the landmarks: one of these layouts."),
    "controls": (
        "sequence",
        "The open-loop commands: one of these sequences, repeated if it is short.",
    ),
}
UNIT = re.compile(r"\s*\[([^\]]+)\]")


def page() -> str:
    """Return the Markdown page: one table for the scenario and one for each part."""
    schema = Scenario.model_json_schema()
    fields = _fields(schema)
    sections = [INTRODUCTION, f"## The file itself\n\n{_table(schema)}"]
    for name, field in fields.items():
        parts = _parts(schema, field)
        if name in CHOICES:
            sections += _choices(name, parts)
        elif parts:
            sections.append(
                f"## `[{name}]`\n\n{_about(parts[0])}\n\n{_table(parts[0])}"
            )
    return "\n\n".join(sections) + "\n"


def _choices(name: str, parts: list[dict[str, Any]]) -> list[str]:
    """Return the sections of a part that has one of several forms."""
    key, about = CHOICES[name]
    sections = [f"## `[{name}]`\n\n{about}"]
    for part in parts:
        title = f'### `{key} = "{_fields(part)[key]["const"]}"`'
        sections.append(f"{title}\n\n{_about(part)}\n\n{_table(part, but=key)}")
    return sections


def _fields(part: dict[str, Any]) -> dict[str, Any]:
    fields: dict[str, Any] = part["properties"]
    return fields


def _parts(schema: dict[str, Any], field: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the models that a field may hold."""
    text = json.dumps(field)
    names = dict.fromkeys(re.findall(r'"\$ref": "#/\$defs/(\w+)"', text))
    return [schema["$defs"][name] for name in names]


def _about(part: dict[str, Any]) -> str:
    about = str(part["description"]).split("\n\nExamples\n")[0]
    return about.replace("``", "`")


def _table(part: dict[str, Any], *, but: str = "") -> str:
    required = part.get("required", [])
    rows = ["| field | default | unit | meaning |", "|---|---|---|---|"]
    for name, field in _fields(part).items():
        if name == but:
            continue
        default = "required" if name in required else _default(field)
        meaning, unit = _meaning(field)
        rows.append(f"| `{name}` | {default} | {unit} | {meaning} |")
    return "\n".join(rows)


def _meaning(field: dict[str, Any]) -> tuple[str, str]:
    """Return the description of a field without its unit, and the unit."""
    text = str(field.get("description", "")).replace("|", "\\|")
    if "enum" in field:
        text += ": " + " or ".join(f'`"{choice}"`' for choice in field["enum"])
    if len(units := UNIT.findall(text)) != 1:
        return text, ""
    return UNIT.sub("", text), units[0]


def _default(field: dict[str, Any]) -> str:
    default = field.get("default", "inf")
    if isinstance(default, dict):
        return "see below"
    if default in (None, "", []):
        return "none"
    return f"`{json.dumps(default).strip(chr(34))}`"
