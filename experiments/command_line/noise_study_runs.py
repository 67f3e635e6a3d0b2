"""``slamgym noise-study SCENARIO --runs N``: every noise changed, over many runs."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.table import Table
from rich.text import Text

from ... import __version__
from ...sim_configs import Scenario
from ..figures.style import save_figure
from ..noise_study.figures import noise_effects_figure
from ..noise_study.many_runs import CHANGED, NoiseEffect, noise_effects
from .errors import BadInputError
from .output_folder import default_folder, output_folder
from .reporter import Reporter
from .run_files import write_summary, write_table
from .tables import written


def study_effects(
    scenario: Scenario,
    estimators: str,
    *,
    runs: int,
    seed: int,
    changed: str,
    jobs: int | None,
    out: Path | None,
    as_json: bool,
) -> None:
    """Run the study, and write its figure, its table and its summary.

    Parameters
    ----------
    scenario : Scenario
        The reference.
    estimators : str
        Which, as in `estimator_choices`.
    runs, seed : int
        Of each Monte Carlo.
    changed : {"both", "world", "filter", "all"}
        Where noises change.
    jobs : int or None
        Worker processes.
    out : Path or None
        The folder to write; None chooses one below results.
    as_json : bool
        Whether to print the summary for programs.
    """
    if changed != "all" and changed not in CHANGED:
        raise BadInputError(
            f"--change must be all, {', '.join(CHANGED)}, got '{changed}'"
        )
    places = [place for place in CHANGED if changed in ("all", place)]
    reporter = Reporter(as_json=as_json)
    folder = out or default_folder("noise-study", scenario.name, f"{runs}-runs")
    with output_folder(folder) as partial:
        with reporter.progress("running", unit="runs") as tick:
            effects = noise_effects(
                scenario,
                estimators,
                runs,
                seed,
                changed=places,
                jobs=jobs,
                progress=tick,
            )
        save_figure(noise_effects_figure(effects), partial / "noise_study.png", dpi=150)
        write_table(partial / "noise_study.csv", NoiseEffect._fields, effects)
        about = {"slamgym": __version__, "name": scenario.name, "runs": runs}
        rows = [_plain(effect) for effect in effects]
        summary = write_summary(partial, {**about, "seed": seed, "rows": rows})
    reporter.show(_table(scenario, runs, effects), "")
    reporter.show(written(str(folder), summary["files"]))
    reporter.finish({**summary, "out": str(folder)})


def _table(scenario: Scenario, runs: int, effects: Sequence[NoiseEffect]) -> Table:
    labels = list(dict.fromkeys(effect.estimator for effect in effects))
    table = Table(
        title=f"{scenario.name}, {runs} runs each: NEES / 3 of the pose; 1 is right",
        caption="± is the standard error. What is more lies in noise_study.csv.",
        title_justify="left",
        box=None,
        pad_edge=False,
    )
    table.add_column("changed", no_wrap=True)
    table.add_column("noise", no_wrap=True)
    for label in labels:
        table.add_column(Text(label), justify="right", overflow="fold")
    rows: dict[tuple[str, str, float], list[str]] = {}
    for effect in effects:
        cells = rows.setdefault((effect.changed, effect.sigma, effect.factor), [])
        failed = f" ({effect.failed} failed)" if effect.failed else ""
        cells.append(f"{_with_error(effect)}{failed}")
    for (changed, sigma, factor), cells in rows.items():
        change = f"{sigma} {'× 10' if factor > 1 else '÷ 10'}"
        table.add_row(changed, "" if changed == "nothing" else change, *cells)
    return table


def _with_error(effect: NoiseEffect) -> str:
    """Write the NEES, and how far it is off where that is known."""
    if math.isnan(effect.nees_per_degree):
        return "–"
    error = effect.nees_per_degree_error
    known = "" if math.isnan(error) else f" ± {error:.3g}"
    return f"{effect.nees_per_degree:.3g}{known}"


def _plain(effect: NoiseEffect) -> dict[str, Any]:
    return {
        name: None if isinstance(value, float) and math.isnan(value) else value
        for name, value in effect._asdict().items()
    }
