"""The page of a scenario's fields, made from the schema."""

from typing import Any

from slamgym.sim_configs import Scenario

INTRODUCTION = """# Fields of a scenario

Every field with unit, default and meaning. TOML files and `Scenario` have the
same names. `Scenario.with_changes`, or `--set sensor.max_range=5` on the command line,
replaces single fields.
"""


def page() -> str:
    """Return the Markdown page: one table for the scenario and one for each part."""
    schema = Scenario.model_json_schema()
    parts = schema["$defs"]
    tables = [_table("scenario", schema)]
    tables += [_table(_title(part), part) for part in parts.values() if _fields(part)]
    return "\n\n".join([INTRODUCTION, *tables]) + "\n"


def _fields(part: dict[str, Any]) -> dict[str, Any]:
    fields: dict[str, Any] = part.get("properties", {})
    return fields


def _title(part: dict[str, Any]) -> str:
    return str(part.get("title", "part"))


def _table(title: str, part: dict[str, Any]) -> str:
    required = part.get("required", [])
    about = str(part.get("description", "")).split("\n\n")[0].replace("\n", " ")
    rows = ["| field | default | meaning |", "|---|---|---|"]
    for name, field in _fields(part).items():
        default = "required" if name in required else _default(field)
        meaning = str(field.get("description", "")).replace("|", "\\|")
        rows.append(f"| `{name}` | {default} | {meaning} |")
    return f"## {title}\n\n{about}\n\n" + "\n".join(rows)


def _default(field: dict[str, Any]) -> str:
    if "const" in field:
        return f"`{field['const']!r}`"
    default = field.get("default", "∞")
    if isinstance(default, dict):
        return "its own defaults"
    return "none" if default is None else f"`{default}`".replace("``", "empty")
