"""``slamgym scenarios`` and ``slamgym estimators``: what there is."""

import inspect
from typing import Any

from rich.table import Table

from ...sim_configs import list_presets, load_scenario
from .reporter import Reporter


def show_scenarios(*, as_json: bool) -> None:
    """List the presets."""
    rows = [
        {
            "name": name,
            "landmarks": scenario.landmarks.count,
            "steps": scenario.steps,
            "description": scenario.description,
        }
        for name, scenario in ((name, load_scenario(name)) for name in list_presets())
    ]
    _show("scenarios", rows, as_json=as_json)


def show_estimators(*, as_json: bool) -> None:
    """List the registered estimators by the first lines of their docstrings."""
    from ...estimator.registry import find_estimator, list_estimators  # noqa: PLC0415 (loads numba)

    rows = [
        {"name": name, "description": _first_line(find_estimator(name))}
        for name in list_estimators()
    ]
    _show("estimators", rows, as_json=as_json)


def _show(what: str, rows: list[dict[str, Any]], *, as_json: bool) -> None:
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
