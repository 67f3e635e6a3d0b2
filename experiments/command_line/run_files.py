"""Filter a log for a command: `filter_and_write` writes and prints a run's results."""

import shlex
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.text import Text

from ...leaves import leaf
from .. import figures
from ..figures.accuracy import entries
from ..figures.style import sign
from ..logs.recording import steps_of
from ..logs.slamlog import SlamLog, write_slamlog
from ..run_and_replay.filter_settings import FilterSettings
from ..run_and_replay.log_replay import Replay, replay
from ..run_and_replay.summary import association_failure, summarise
from ..run_and_replay.trace import RunTrace
from . import commands, options, tables
from .commands import Reporter
from .output_folder import write_csv, write_summary

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from ...sim_configs import Scenario


#: Largest map whose covariance is written: 32 MB.
_MOST_LANDMARKS = 1000
#: Largest map whose covariances are also written as text.
_FEW_LANDMARKS = 20
_FEW_STEPS = 60  # of a run whose every step is drawn by default


def check_rerun(path: Path | None) -> None:
    """Check before the work that a recording for rerun can be written.

    Raises
    ------
    BadInputError
        If the path does not end in .rrd, or its folder does not exist.
    ImportError
        If rerun-sdk is not installed.
    """
    if path is None:
        return
    if path.suffix != ".rrd":
        raise commands.BadInputError(f"--rerun must end in .rrd, got {path}")
    if not path.absolute().parent.is_dir():
        raise commands.BadInputError(f"--rerun: the folder of {path} does not exist")
    viewers = leaf("experiments.viewers.rerun_recording")
    if viewers is None:
        raise commands.BadInputError("--rerun: this installation has no viewers")
    viewers.import_rerun()


def filter_and_write(
    log: SlamLog,
    filters: Mapping[str, FilterSettings],
    folder: Path,
    given: options.Options,
    reporter: Reporter,
    *,
    world: "Scenario | None" = None,
) -> dict[str, Any]:
    """Filter a log, and write figures, run.html, log.csv, belief.npz and summary.json.

    The page run.html and comparison.png show all filters side by side; the other files
    are those of the first one.

    Parameters
    ----------
    log : SlamLog
        The log.
    filters : mapping from label to FilterSettings
        The filters, at least one.
    folder : Path
        The folder to write to.
    given : Options
        ``every_step``, ``resolution`` and ``rerun``.
    reporter : Reporter
        Shows the progress.
    world : Scenario, optional
        The world of a simulated log, which breaks no convention; its walls are drawn.

    Returns
    -------
    dict
        The summary that was written; ``others`` holds those of the further filters.
    """
    walls = world.walls if world else ()
    every_step = given.every_step
    if every_step is None:
        every_step = sum(1 for _ in steps_of(log)) <= _FEW_STEPS + 1
    runs, frames = _filtered(log, filters, bool(every_step), reporter)
    traces = [run.trace for run in runs]
    with reporter.progress("drawing") as tick:
        write_figures(
            folder,
            traces[0],
            world=log.name,
            every_step=every_step,
            progress=tick,
            walls=walls,
        )
        if len(traces) > 1:
            compared = figures.comparison_figure(traces, walls)
            sign(compared, log.name)
            figures.save_figure(compared, folder / "comparison.png", dpi=150)
    if viewers := leaf("experiments.viewers"):
        viewed = [*map(viewers.ViewedRun, traces, frames)]
        viewers.write_run_page(folder / "run.html", log, viewed, walls=walls)
        if given.rerun is not None:
            viewers.write_rerun(given.rerun, log, viewed, walls=walls)
    write_slamlog(runs[0].log, folder / "log.csv")
    write_belief(folder / "belief.npz", runs[0])
    if len(traces[0].landmark_ids) <= _FEW_LANDMARKS:
        write_covariances(folder, traces[0])
    summaries = [
        summarise(run, settings, resolution=given.resolution)
        for run, settings in zip(runs, filters.values(), strict=True)
    ]
    mistake = None if world else mistake_in(log, next(iter(filters.values())))
    if mistake is not None:  # not a matter of noise
        for summary in summaries:
            summary["warnings"] = [str(mistake)]
    named = {"mistake": None if mistake is None else mistake.as_dict()}
    return write_summary(folder, {**summaries[0], **named, "others": summaries[1:]})


def _filtered(
    log: SlamLog,
    filters: Mapping[str, FilterSettings],
    every_step: bool,
    reporter: Reporter,
) -> tuple[list[Replay], list[Any]]:
    """Run filters over a log; also return the frames for the viewers, or None."""
    viewers = leaf("experiments.viewers")
    runs, kept = [], []
    for label, settings in filters.items():
        frames = viewers and viewers.RunFrames(log)
        warm_up(settings, reporter)
        with reporter.progress("filtering") as tick, explaining(log, settings):
            run = replay(
                log,
                settings.make(log.start),
                name=label,
                keep_history=every_step,
                progress=tick,
                watch=frames and frames.watch,
            )
        runs.append(run)
        kept.append(frames)
    return runs, kept


def mistake_in(log: SlamLog, settings: FilterSettings) -> Any:
    """Return the convention that a log breaks; None if it is unknown."""
    conventions = leaf("experiments.log_conventions")
    return conventions and conventions.mistake_in_log(log, settings)


@contextmanager
def explaining(log: SlamLog, settings: FilterSettings) -> Iterator[None]:
    """Name the mistake of a log beside the numerical failure that it causes."""
    try:
        yield
    except np.linalg.LinAlgError as error:
        mistake = mistake_in(log, settings)
        if mistake is None:
            raise
        raise np.linalg.LinAlgError(f"{error}. {mistake}") from error


def write_belief(path: Path, run: Replay) -> None:
    """Write the poses of a run with their covariances, and its final belief.

    The arrays are ``t`` (K + 1,), ``poses`` (K + 1, 3), ``pose_covariances``
    (K + 1, 3, 3), ``landmark_ids`` (n,), ``mean`` (3 + 2n,) and, for a map of up to
    1,000 landmarks, ``covariance`` (3 + 2n, 3 + 2n), both of the state (x, y, θ, l1x,
    l1y, …) [s or steps, m, rad].
    """
    trace, belief = run.trace, run.belief
    arrays: dict[str, Any] = {
        "t": trace.t,
        "poses": trace.poses,
        "pose_covariances": trace.pose_covariances,
        "landmark_ids": trace.landmark_ids,
        "mean": belief.mean,
    }
    if len(trace.landmark_ids) <= _MOST_LANDMARKS:
        arrays["covariance"] = belief.covariance
    np.savez(path, **arrays)


def write_covariances(folder: Path, trace: RunTrace) -> None:
    """Write the two covariances of covariance.png as text.

    In covariance_first.csv, of the first map, and covariance_final.csv, a row holds the
    covariances of one entry of the state (x, y, θ, l1x, l1y, …) with all [m, rad].
    """
    first = trace.step_of_first_map()
    for name, step, covariance in (
        ("first", first, trace.first_covariance),
        ("final", trace.last_step, trace.final_covariance),
    ):
        names = entries(trace.map_at(step).ids)
        rows = zip(names, covariance.tolist(), strict=True)
        path = folder / f"covariance_{name}.csv"
        write_csv(path, ["", *names], ([entry, *row] for entry, row in rows))


def write_figures(
    folder: Path,
    trace: RunTrace,
    *,
    world: str,
    every_step: bool,
    progress: Callable[[int, int], object],
    walls: Sequence[Sequence[float]] = (),
) -> None:
    """Draw map.png, truth.png, covariance.png, errors.png and map_steps/.

    Parameters
    ----------
    folder : Path
        The folder to write to.
    trace : RunTrace
        The run; it holds every map where every step is drawn.
    world : str
        Name of the log, which the figures show with that of the filter.
    every_step : bool
        Whether to draw the map after every step too.
    progress : callable
        Called with (figures done, figures).
    walls : sequence of (x0, y0, x1, y1)
        Walls to draw [m].
    """
    drawn: dict[str, Callable[[RunTrace], Figure]] = {
        "map": partial(figures.map_figure, walls=walls),
        "covariance": figures.covariance_figure,
        "errors": figures.errors_figure,
    }
    if trace.true_poses is not None or trace.true_landmarks is not None:
        drawn["truth"] = partial(figures.truth_figure, walls=walls)
    count = len(drawn) + every_step
    for done, (name, draw) in enumerate(drawn.items()):
        progress(done, count)
        figure = sign(draw(trace), f"{world} · {trace.estimator}")
        figures.save_figure(figure, folder / f"{name}.png")
    if every_step:
        progress(count - 1, count)
        figures.map_sequence(trace, folder / "map_steps", walls=walls)
    progress(count, count)


def show_run(
    summary: dict[str, Any], place: Path, given: options.Options, reporter: Reporter
) -> None:
    """Print a run's landmarks, key figures and files."""
    title = tables.heading("", summary["log"], " filtered by ", summary["estimator"])
    reporter.show(
        title, tables.landmark_table(summary), "", tables.key_figures(summary), ""
    )
    if summary["others"]:
        runs = (summary, *summary["others"])
        reporter.show(tables.comparison_table({r["estimator"]: r for r in runs}), "")
    if summary["association"] is not None:
        reporter.show(tables.association_table(summary["association"]), "")
    if summary["warnings"]:
        warnings = (Text(f"Warning: {text}", "yellow") for text in summary["warnings"])
        reporter.show(*warnings, "")
    if reason := association_failure(summary):
        log = str(place / "log.csv")
        repair = ["slamgym", "smooth", log, "--associate", *given.noise_arguments()]
        reporter.show(f"The association failed: {reason}. Repair it with")
        reporter.show_verbatim(f"{shlex.join(repair)}\n")
    reporter.show(tables.written(str(place), summary["files"]))
    reporter.finish({**summary, "out": str(place)})


def warm_up(settings: FilterSettings, reporter: Reporter) -> None:
    """Take a filter's first steps, and print a note if it compiles.

    Raises
    ------
    ValueError
        If the estimator refuses its settings.
    """
    origin = (0.0, 0.0, 0.0)
    settings.make(origin)
    usual = replace(settings, motion_std=(0.1,) * 3, measurement_std=(0.1,) * 2)
    with reporter.note_if_compiling("the filter"):
        estimator = usual.make(origin)
        try:
            for _ in range(2):
                estimator.predict((0.1, 0.0))
                estimator.update([(0.0, 5.0)], [0])
            if settings.options.get("management"):
                estimator.update([(0.0, 5.0)])
        finally:
            estimator.reset(origin, (0.0, 0.0, 0.0))  # deletes the files it wrote
