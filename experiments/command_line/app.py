"""The program ``slamgym`` with all its commands.

Each command is a function in a module of its own, which takes options by name, and
it imports what is heavy when it runs, so that help answers at once.
"""
# ruff: noqa: I001 (the order of the imports is the order of the commands in the help)

import inspect
from collections.abc import Sequence
from typing import Any

from . import run, replay, fit_noise, monte_carlo, generate  # noqa: F401
from . import judge, noise_study, render_video  # noqa: F401 (each adds its command)
from .options import Options, takes
from .program import command, main
from .program import Reporter

__all__ = ["main"]
__dir__ = __all__.copy


@command
@takes("as_json")
def scenarios(*, given: Options) -> None:
    """List the scenarios.

    List the scenarios that come with slamgym. Use their names in other commands.

    Examples
    --------
    slamgym scenarios
    slamgym scenarios --json
    """
    from ...sim_configs import list_presets, load_scenario

    each = [(name, load_scenario(name)) for name in list_presets()]
    rows = [(name, x.landmarks.count, x.steps, x.description) for name, x in each]
    _show("scenarios", "name landmarks steps description", rows, given.reporter())


@command
@takes("as_json")
def estimators(*, given: Options) -> None:
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

    each = [
        (name, "slamgym", True, inspect.getdoc(find_estimator(name)) or "")
        for name in list_estimators()
    ]
    each += [(p.name, p.library, p.installed, p.description) for p in list_peers()]
    rows = [(*facts, text.partition("\n")[0]) for *facts, text in each]
    _show("estimators", "name library installed description", rows, given.reporter())


def _show(what: str, keys: str, facts: Sequence[Any], reporter: Reporter) -> None:
    """Print facts as a table with the keys as headings, or as one JSON object."""
    from rich.table import Table

    rows = [dict(zip(keys.split(), each, strict=True)) for each in facts]
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
