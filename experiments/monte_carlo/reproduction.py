"""Write the Python call that reproduces the results of a Monte Carlo."""

import tomllib
from typing import Any

from ...sim_configs import load_scenario

ASSUMED_FILE = "assumed.toml"


def python_call(summary: dict[str, Any]) -> str:
    """Write the call of ``monte_carlo`` that made a summary.

    The call reads a scenario that is no preset, or a changed one, from a file, and a
    comment asks to save it first; likewise the scenario whose noise was assumed.

    Parameters
    ----------
    summary : dict
        Result of ``summarise_monte_carlo``.
    """
    preset = _is_preset(summary)
    name = summary["scenario"]
    world = name if preset else f"{name}.toml"
    files = [] if preset else [world]
    arguments = [repr(world), _estimators(summary["estimators"])]
    first = summary["first_run"]
    arguments += [f"runs={first + summary['runs']}", f"seed={summary['seed']}"]
    if summary["assumed_toml"]:
        files.append(ASSUMED_FILE)
        arguments.append(f"assumed={ASSUMED_FILE!r}")
    arguments += [
        f"{option}={summary[option]}"
        for option in ("block_size", "resolution", "first_run")
        if summary[option]
    ]
    note = (
        f"# first save {' and '.join(map(repr, files))}, see below\n" if files else ""
    )
    listed = "".join(f"    {argument},\n" for argument in arguments)
    return (
        "from slamgym.experiments.monte_carlo import monte_carlo\n\n"
        f"{note}monte_carlo(\n{listed})"
    )


def _is_preset(summary: dict[str, Any]) -> bool:
    """Whether the scenario equals the preset of its name."""
    try:
        world = load_scenario(tomllib.loads(summary["scenario_toml"]))
        return bool(world == load_scenario(summary["scenario"]))
    except ValueError:
        return False


def _estimators(entries: dict[str, Any]) -> str:
    """Write names alone where they suffice, else labels with (name, options)."""
    named = {
        label: (entry.get("name", label), entry.get("options") or {})
        for label, entry in entries.items()
    }
    if all(label == name and not options for label, (name, options) in named.items()):
        return repr(list(named))
    return repr(named)
