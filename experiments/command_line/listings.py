"""``slamgym scenarios`` and ``slamgym estimators``: list what there is."""

import inspect
from typing import Any

from . import options
from .program import command


@command
def scenarios(as_json: options.AsJson = False) -> None:
    """List the worlds there are.

    List the scenarios that come with slamgym, to run, to film, or to vary.
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
    """List the filters there are.

    List the filters that come with slamgym.
    """
    from ...estimator.registry import find_estimator, list_estimators

    rows = [
        {"name": name, "description": _first_line(find_estimator(name))}
        for name in list_estimators()
    ]
    _show("estimators", rows, as_json=as_json)


def _show(what: str, rows: list[dict[str, Any]], *, as_json: bool) -> None:
    from rich.table import Table

    from .reporter import Reporter

    reporter = Reporter(as_json=as_json)
    table = Table(box=None, pad_edge=False)
    for key in rows[0]:
        numeric = isinstance(rows[0][key], int)
        table.add_column(
            key, justify="right" if numeric else "left", no_wrap=key == "name"
        )
    for row in rows:
        table.add_row(*(str(value) for value in row.values()))
    reporter.show(table)
    reporter.finish({what: rows})


def _first_line(factory: object) -> str:
    return (inspect.getdoc(factory) or "").partition("\n")[0]
