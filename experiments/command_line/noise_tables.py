"""The results of noise studies as tables for the terminal."""

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from rich.table import Table
from rich.text import Text

from ..monte_carlo.report.headings import headings_and_key
from ..noise_study.variations import Variation
from .tables import significant

if TYPE_CHECKING:
    from ..noise_study.many_runs import NoiseEffect
    from ..noise_study.one_run import NoiseRun

_COLUMNS = {
    "pose_area": "pose\narea\n[m²]",
    "landmark_area": "landmark\narea\n[m²]",
    "landmark_rmse": "map\nerror\n[m]",
    "landmark_rmse_aligned": "map,\naligned\n[m]",
    "ate": "path\nerror\n[m]",
    "nees_per_degree": "NEES\n/ degree",
    "nis_per_degree": "NIS\n/ degree",
}


def runs_table(runs: "Sequence[NoiseRun]") -> Table:
    """Lay out the study of one run, a row for each variation."""
    title = "Final 3σ areas and RMS errors; for NEES and NIS, 1 is expected"
    rows: list[dict[str, Any]] = [run.row._asdict() for run in runs]
    shown = [key for key in _COLUMNS if any(row[key] is not None for row in rows)]
    table = _table("noise", "value", title=title)
    for key in shown:
        table.add_column(Text(_COLUMNS[key]), justify="right", no_wrap=True)
    for run, row in zip(runs, rows, strict=True):
        change, _, value = run.title.partition(" = ")
        table.add_row(change, value, *(significant(row[key]) for key in shown))
    return table


def effects_table(name: str, runs: int, effects: "Sequence[NoiseEffect]") -> Table:
    """Lay out the study over many runs, a column for each estimator."""
    labels = list(dict.fromkeys(effect.estimator for effect in effects))
    headings, key = headings_and_key(labels)
    note = "± is the standard error. noise_study.csv holds further figures."
    table = _table(
        "changed",
        "noise",
        title=f"{name}, {runs} runs each: NEES / 3 of the pose; 1 is expected",
        caption=f"{key}\n{note}".strip(),
    )
    for heading in headings:
        table.add_column(Text(heading), justify="right", overflow="fold")
    rows: dict[tuple[str, Variation], list[str]] = {}
    for effect in effects:
        variation = Variation(effect.sigma, effect.factor)
        rows.setdefault((effect.changed, variation), []).append(_cell(effect))
    for (changed, variation), cells in rows.items():
        table.add_row(changed, "" if changed == "nothing" else str(variation), *cells)
    return table


def _table(*names: str, title: str, caption: str | None = None) -> Table:
    table = Table(
        title=title,
        caption=None if caption is None else Text(caption),
        title_justify="left",
        caption_justify="left",
        box=None,
        pad_edge=False,
    )
    for name in names:
        table.add_column(name, no_wrap=True)
    return table


def _cell(effect: "NoiseEffect") -> str:
    """Write the NEES, its standard error where known, and the failed runs."""
    nees, error = effect.nees_per_degree, effect.nees_per_degree_error
    text = "–" if math.isnan(nees) else f"{nees:.3g}"
    if not math.isnan(error):
        text += f" ± {error:.3g}"
    return f"{text} ({effect.failed} failed)" if effect.failed else text
