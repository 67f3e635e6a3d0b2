"""``slamgym run`` and ``slamgym replay``: get a log, filter it, write all down."""

from pathlib import Path
from typing import Any, NamedTuple

from ...sim_configs import Scenario, save_scenario
from ..logs.importers import read_log
from ..logs.slamlog import SlamLog
from ..logs.steps import steps_of
from ..runs.filter_settings import FilterSettings
from ..runs.replay import replay
from ..runs.summary import summarise
from .errors import BadInputError
from .output_folder import default_folder, output_folder
from .reporter import Reporter
from .run_files import write_figures, write_log, write_summary
from .scenario_options import recorded
from .tables import key_figures, landmark_table, written
from .warm_up import warm_up

_FEW_STEPS = 60  # of a run whose every step is drawn unless told otherwise


class Output(NamedTuple):
    """What a command gives, and where."""

    folder: Path | None
    """None: below results, by the names of log and estimator."""
    every_step: bool | None
    """Whether to draw the map after every step; None: where they are few."""
    as_json: bool

    def draws_steps(self, log: SlamLog) -> bool:
        """Decide whether to draw the map after every step."""
        if self.every_step is not None:
            return self.every_step
        return sum(1 for _ in steps_of(log)) <= _FEW_STEPS + 1


def run_scenario(
    scenario: Scenario,
    settings: FilterSettings,
    *,
    controller: str,
    seed: int,
    output: Output,
) -> None:
    """Drive through a scenario, filter what was read, and write all down."""
    reporter = Reporter(as_json=output.as_json)
    place = output.folder or default_folder(scenario.name, settings.estimator)
    with output_folder(place) as folder:
        with reporter.progress("driving") as tick:
            log = recorded(scenario, controller, seed, tick)
        save_scenario(scenario, folder / "scenario.toml")
        summary = _filter_and_write(log, settings, folder, output, reporter)
    _report(summary, place, reporter)


def replay_log(log: SlamLog, settings: FilterSettings, output: Output) -> None:
    """Filter a log, and write all down."""
    reporter = Reporter(as_json=output.as_json)
    place = output.folder or default_folder(log.name, settings.estimator)
    with output_folder(place) as folder:
        summary = _filter_and_write(log, settings, folder, output, reporter)
    _report(summary, place, reporter)


def read_any_log(path: Path, robot: int | None = None) -> SlamLog:
    """Read a log of any known format.

    Raises
    ------
    BadInputError
        If it cannot be opened.
    LogError
        If it is malformed.
    """
    try:
        return read_log(path, robot=robot)
    except OSError as error:
        reason = error.strerror or error
        raise BadInputError(f"cannot read the log {path}: {reason}") from error


def _filter_and_write(
    log: SlamLog,
    settings: FilterSettings,
    folder: Path,
    output: Output,
    reporter: Reporter,
) -> dict[str, Any]:
    warm_up(settings, reporter)
    every_step = output.draws_steps(log)
    with reporter.progress("filtering") as tick:
        run = replay(
            log,
            settings.make(log.start),
            name=settings.estimator,
            keep_history=every_step,
            progress=tick,
        )
    with reporter.progress("drawing") as tick:
        write_figures(folder, run, every_step=every_step, progress=tick)
    write_log(folder, run)
    return write_summary(folder, summarise(run, settings))


def _report(summary: dict[str, Any], place: Path, reporter: Reporter) -> None:
    title = f"[bold]{summary['log']}[/] filtered by [bold]{summary['estimator']}[/]\n"
    reporter.show(
        title,
        landmark_table(summary),
        "",
        key_figures(summary),
        "",
        written(str(place), summary["files"]),
    )
    reporter.finish({**summary, "out": str(place)})
