"""``slamgym noise-study``: every noise times 10 and divided by 10."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from ... import __version__
from ...sim_configs import Scenario, list_presets
from ...sim_configs.scenario_errors import closest
from ..figures import NoisePanel, noise_study_figure, save_figure
from ..logs.slamlog import SlamLog
from ..noise_study.one_run import NoiseRow, NoiseRun, study_log, study_scenario
from ..runs.filter_settings import FilterSettings
from ..runs.summary import settings_table
from .errors import BadInputError
from .output_folder import default_folder, output_folder
from .reporter import Reporter, Tick
from .run_files import write_summary, write_table
from .scenario_options import driver, recorded
from .tables import noise_table, written
from .warm_up import warm_up


class Study(NamedTuple):
    """A noise study to be run."""

    name: str
    """Of its scenario or log."""
    settings: FilterSettings
    """Of the reference."""
    run: Callable[[Tick], list[NoiseRun]]
    """Runs it, given what is to be told of the progress."""


def is_scenario(source: str) -> bool:
    """Tell a scenario from a log.

    Raises
    ------
    BadInputError
        If there is neither.
    """
    if source in list_presets() or source.endswith(".toml"):
        return True
    if Path(source).exists():
        return False
    raise BadInputError(
        f"no log and no scenario '{source}'{closest(source, list_presets())} "
        f"(there are {', '.join(list_presets())})"
    )


def scenario_study(
    scenario: Scenario, settings: FilterSettings, *, controller: str, seed: int
) -> Study:
    """Prepare the study of a scenario; world and filter change together."""

    def run(tick: Tick) -> list[NoiseRun]:
        return study_scenario(
            scenario,
            lambda changed: recorded(changed, controller, seed),
            estimator=settings.estimator,
            options=settings.options,
            progress=tick,
        )

    driver(controller, scenario, seed)
    return Study(scenario.name, settings, run)


def log_study(log: SlamLog, settings: FilterSettings) -> Study:
    """Prepare the study of a log; only the filter changes."""
    return Study(
        log.name, settings, lambda tick: study_log(log, settings, progress=tick)
    )


def write_study(study: Study, folder: Path | None, *, as_json: bool) -> None:
    """Run a noise study, and write its figure and its table.

    Parameters
    ----------
    study : Study
        The study.
    folder : Path or None
        The folder to write; None chooses one below results.
    as_json : bool
        Whether to print the summary for programs.
    """
    reporter = Reporter(as_json=as_json)
    estimator = study.settings.estimator
    place = folder or default_folder("noise-study", study.name, estimator)
    about = {
        "slamgym": __version__,
        "name": study.name,
        "estimator": estimator,
        "settings": settings_table(study.settings),
    }
    with output_folder(place) as partial:
        warm_up(study.settings, reporter)
        with reporter.progress("filtering") as tick:
            runs = study.run(tick)
        with reporter.progress("drawing"):
            panels = [NoisePanel(run.title, run.trace) for run in runs]
            figure = noise_study_figure(panels)
            save_figure(figure, partial / "noise_study.png", dpi=130)
        table = partial / "noise_study.csv"
        write_table(table, NoiseRow._fields, [run.row for run in runs])
        rows = [{"title": run.title, **run.row._asdict()} for run in runs]
        summary = write_summary(partial, {**about, "rows": rows})
    title = f"[bold]{study.name}[/], noise study of [bold]{estimator}[/]\n"
    files = written(str(place), summary["files"])
    reporter.show(title, noise_table(rows), "", files)
    reporter.finish({**summary, "out": str(place)})
