"""``slamgym noise-study``: every noise times 10 and divided by 10."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer

from ...sim_configs import Scenario, list_presets
from ...sim_configs.field_types import unknown_choice
from ...suggestions import closest
from .. import figures
from . import commands, options
from .commands import BadInputError, Reporter

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from ..noise_study import NoiseEffect, NoiseRow, NoiseRun
    from ..run_and_replay.filter_settings import FilterSettings

_LOG, _SCENARIO = "a log", "a scenario"
_ONE_RUN, _MANY_RUNS = "one run of a scenario", "a scenario with --runs above 1"
#: Parameters that have an effect on one kind of study alone.
_ONLY_FOR = {
    _LOG: (
        *("motion_std", "measurement_std", "initial_pose_std"),
        *("range_std_per_metre", "noise_at_rest", "hide_identities"),
        *("robot", "truth", "noise_from_file"),
    ),
    _SCENARIO: ("seed", "steps", "set_", "runs"),
    _ONE_RUN: ("controller",),
    _MANY_RUNS: ("change", "jobs"),
}


@dataclass(frozen=True, kw_only=True)
class NoiseStudyOptions(options.Options):
    """The options of ``slamgym noise-study``.

    Attributes
    ----------
    estimator
        A filter, as for replay; with --runs, several filters separated by commas.
    runs
        Runs of a scenario; if more than one, each change is a Monte Carlo.
    change
        With --runs: change the noise in world and filter, in the world alone, or in the
        assumptions of the filter alone.
    """

    estimator: str = options.declared("invariant", "--estimator -e NAME")
    runs: int = options.declared(1, "")
    change: str = options.declared("all", "both|world|filter|all")


@commands.command
@options.takes(
    "estimator motion_std measurement_std initial_pose_std landmark_init "
    "gate_probability range_std_per_metre noise_at_rest option_texts hide_identities "
    "robot truth noise_from_file seed steps controller set_ runs change jobs out "
    "as_json"
)
def noise_study(
    source: Annotated[
        str,
        typer.Argument(
            metavar="SCENARIO|LOG", help="A preset, a .toml file, or a log."
        ),
    ],
    *,
    context: typer.Context,
    given: NoiseStudyOptions,
) -> None:
    """Every noise times 10 and divided by 10.

    Multiply and divide each of σx, σy, σα, σβ, σr by 10, one by one. For a log, only
    the filter's assumed noise changes, and the row "unchanged" is what replay reports
    with the same options; for a scenario, world and filter change together, with the
    same random numbers. Draws all maps in one figure, and lists
    the areas of the final 3σ ellipses, the errors, and the NEES and NIS, which are 1
    per degree of freedom for a consistent filter.

    Examples
    --------
    slamgym noise-study data.txt
    slamgym noise-study data.txt -e ekf --landmark-init independent
    slamgym noise-study six_landmarks --seed 3 --out study
    slamgym noise-study loop -e 'invariant[iterations=3]'
    slamgym noise-study six_landmarks --runs 100 -e ekf,invariant
    """
    from ..noise_study import study_log, study_scenario
    from ..run_and_replay.filter_settings import settings_for, settings_for_scenario

    many = given.runs != 1
    is_scenario, estimator = _is_scenario(source), given.estimator
    kinds = (_SCENARIO, _MANY_RUNS if many else _ONE_RUN) if is_scenario else (_LOG,)
    _refuse_without_effect(context, *kinds)
    chosen = given.filter_options()
    options.refuse_broken(estimator, chosen)
    reporter = given.reporter()
    if not is_scenario:
        log = given.read(Path(source), reporter)
        stds = given.stds()
        settings = settings_for(log, estimator=estimator, options=chosen, **stds)
        run = partial(study_log, log, settings)
        study = one_run_study(log.name, estimator, settings, run)
        write_study(study, given.out, reporter)
        options.note_noise(log, settings, {*stds, *given.named_options()}, reporter)
        return
    world = given.scenario(source)
    if many:
        study = effects_study(world, given)
    else:
        settings = settings_for_scenario(world, estimator=estimator, options=chosen)
        given.driver(world)  # refuses a wrong name
        run = partial(study_scenario, world, given.record)
        run = partial(run, estimator=estimator, options=chosen)
        study = one_run_study(world.name, estimator, settings, run)
    write_study(study, given.out, reporter)


class Results(NamedTuple):
    """The results of a noise study."""

    rows: "Sequence[NoiseRow] | Sequence[NoiseEffect]"
    #: Of the rows in the summary; empty where they have none.
    titles: Sequence[str]
    figure: "Figure"
    dpi: int
    #: Map of each row, by the name of its file; empty where a row has many runs.
    maps: "dict[str, Figure]"
    #: What to print, one below the other.
    shown: Sequence[Any]


class PreparedStudy(NamedTuple):
    """A noise study to run and to write."""

    #: Of its folder, by default; the first is the name of the study.
    names: tuple[str, str]
    #: What the head of its summary says beside the name.
    about: dict[str, Any]
    run: Callable[[Reporter], Results]


def one_run_study(
    name: str,
    estimator: str,
    settings: "FilterSettings",
    study: "Callable[..., list[NoiseRun]]",
) -> PreparedStudy:
    """Prepare the study of a log or of one run of a scenario."""
    from ..run_and_replay.summary import settings_table

    def run(reporter: Reporter) -> Results:
        from .run_files import warm_up
        from .tables import heading, runs_table

        warm_up(settings, reporter)
        with reporter.progress("filtering") as tick:
            runs = study(progress=tick)
        with reporter.progress("drawing"):
            drawn = figures.noise_study_figure([(run.title, run.trace) for run in runs])
            maps = {_file_name(run): figures.map_figure(run.trace) for run in runs}
        title = heading("", name, ", noise study of ", estimator)
        rows, titles = [run.row for run in runs], [run.title for run in runs]
        return Results(rows, titles, drawn, 130, maps, (title, runs_table(runs)))

    about = {"estimator": estimator, "settings": settings_table(settings)}
    return PreparedStudy((name, estimator), about, run)


def effects_study(world: Scenario, given: NoiseStudyOptions) -> PreparedStudy:
    """Prepare the study of a scenario over many runs."""
    from ...estimator.registry import split_labels
    from ..noise_study import CHANGED, noise_effects, noise_effects_figure
    from .tables import effects_table

    runs, seed, change = given.runs, given.seed, given.change
    texts = [f"{key}={value}" for key, value in given.named_options().items()]
    texts += given.option_texts or []
    labels = [options.with_options(one, texts) for one in split_labels(given.estimator)]
    if change != "all" and change not in CHANGED:
        raise BadInputError(unknown_choice("--change", change, ("all", *CHANGED)))
    places = [place for place in CHANGED if change in ("all", place)]
    study = partial(noise_effects, world, ",".join(labels), runs, seed, jobs=given.jobs)

    def run(reporter: Reporter) -> Results:
        with reporter.progress("running", unit="runs") as tick:
            effects = study(changed=places, progress=tick)
        shown = [effects_table(world.name, runs, effects)]
        return Results(effects, (), noise_effects_figure(effects), 150, {}, shown)

    return PreparedStudy(
        (world.name, f"{runs}-runs"), {"runs": runs, "seed": seed}, run
    )


def write_study(study: PreparedStudy, out: Path | None, reporter: Reporter) -> None:
    """Run a study, write its figure, table and summary, and print its results."""
    from ... import __version__
    from ..figures.style import sign
    from .output_folder import default_folder, output_folder, write_csv, write_summary
    from .tables import written

    head = {"slamgym": __version__, "name": study.names[0], **study.about}
    place = out or default_folder("noise-study", *study.names)
    with output_folder(place) as folder:
        found = study.run(reporter)
        figure = sign(found.figure, " · ".join(study.names))
        figures.save_figure(figure, folder / "noise_study.png", dpi=found.dpi)
        for name, drawn in found.maps.items():
            (folder / "maps").mkdir(exist_ok=True)
            sign(drawn, " · ".join((*study.names, name)))
            figures.save_figure(drawn, folder / "maps" / f"{name}.png", dpi=100)
        columns = found.rows[0]._fields
        write_csv(folder / "noise_study.csv", columns, found.rows)
        rows = [_plain(row) for row in found.rows]
        if found.titles:
            titles = zip(found.titles, rows, strict=True)
            rows = [{"title": title, **row} for title, row in titles]
        summary = write_summary(folder, {**head, "rows": rows})
    reporter.show(*found.shown, "", written(str(place), summary["files"]))
    reporter.finish({**summary, "out": str(place)})


def _file_name(run: "NoiseRun") -> str:
    """Name the map of a run, as in unchanged, sigma_x_times_10 and sigma_x_by_10."""
    row = run.row
    if row.factor == 1:
        return "unchanged"
    letter = {"α": "alpha", "β": "beta"}.get(row.sigma[1:], row.sigma[1:])
    return f"sigma_{letter}_{'times' if row.factor > 1 else 'by'}_10"


def _plain(row: "NoiseRow | NoiseEffect") -> dict[str, Any]:
    """Return a row for JSON, with None for nan."""
    return {
        name: None if isinstance(value, float) and math.isnan(value) else value
        for name, value in row._asdict().items()
    }


def _is_scenario(source: str) -> bool:
    """Whether a source is a scenario; refuse what is neither scenario nor log."""
    if source in list_presets() or source.endswith(".toml"):
        return True
    if Path(source).exists():
        return False
    raise BadInputError(
        f"no log and no scenario '{source}'{closest(source, list_presets())} "
        f"(there are {', '.join(list_presets())})"
    )


def _refuse_without_effect(context: typer.Context, *kinds: str) -> None:
    """Refuse the options that the user gave and a study of these kinds ignores."""
    for kind, names in _ONLY_FOR.items():
        for name in names if kind not in kinds else ():
            source = context.get_parameter_source(name)
            if source is not None and source.name == "COMMANDLINE":
                option = f"--{name.strip('_').replace('_', '-')}"
                hint = commands.way_to_set(option)
                raise BadInputError(f"{option} is for the noise study of {kind}{hint}")
