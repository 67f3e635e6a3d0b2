"""The program ``slamgym`` with all its commands.

Each command is a function in a module of its own. Its parameters are its options, and
it imports what is heavy when it runs, so that help answers at once.
"""

import inspect
from typing import Any

from . import (
    fit_noise,
    generate,
    monte_carlo,
    noise_study,
    options,
    render_video,
    replay,
    run,
)
from .program import command, main

__all__ = [
    "fit_noise",
    "generate",
    "main",
    "monte_carlo",
    "noise_study",
    "render_video",
    "replay",
    "run",
]


@command
def scenarios(as_json: options.AsJson = False) -> None:
    """List the scenarios.

    List the scenarios that come with slamgym. Use their names in other commands.

    Examples
    --------
    slamgym scenarios
    slamgym scenarios --json
    """
    from ...sim_configs import list_presets, load_scenario

    each = [(name, load_scenario(name)) for name in list_presets()]
    rows = [
        {
            "name": name,
            "landmarks": scenario.landmarks.count,
            "steps": scenario.steps,
            "description": scenario.description,
        }
        for name, scenario in each
    ]
    _show("scenarios", rows, as_json=as_json)


@command
def estimators(as_json: options.AsJson = False) -> None:
    """List the filters.

    List the filters of slamgym, and those of other libraries, which you install with
    pip install 'slamgym[peers]'.

    Examples
    --------
    slamgym estimators
    slamgym estimators --json
    """
    from ...estimator.peers.catalogue import list_peers
    from ...estimator.registry import find_estimator, list_estimators

    rows = [
        _entry(name, "slamgym", _first_line(find_estimator(name)), installed=True)
        for name in list_estimators()
    ]
    rows += [
        _entry(peer.name, peer.library, peer.description, installed=peer.installed)
        for peer in list_peers()
    ]
    _show("estimators", rows, as_json=as_json)


def _entry(
    name: str, library: str, description: str, *, installed: bool
) -> dict[str, Any]:
    return {
        "name": name,
        "library": library,
        "installed": installed,
        "description": description,
    }


def _show(what: str, rows: list[dict[str, Any]], *, as_json: bool) -> None:
    from rich.table import Table

    from .reporter import Reporter

    reporter = Reporter(as_json=as_json)
    table = Table(box=None, pad_edge=False)
    for key in rows[0]:
        numeric = type(rows[0][key]) is int
        table.add_column(
            key, justify="right" if numeric else "left", no_wrap=key == "name"
        )
    for row in rows:
        table.add_row(*(_cell(value) for value in row.values()))
    reporter.show(table)
    reporter.finish({what: rows})


def _cell(value: object) -> str:
    return {True: "yes", False: "no"}[value] if isinstance(value, bool) else str(value)


def _first_line(factory: object) -> str:
    return (inspect.getdoc(factory) or "").partition("\n")[0]
