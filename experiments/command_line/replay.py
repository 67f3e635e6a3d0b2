"""``slamgym replay`` and ``slamgym smooth``: filter or smooth a log, compare, draw."""

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated

import typer
from rich.text import Text

from .. import figures, runs
from . import options, program


@dataclass(frozen=True, kw_only=True)
class ReplayOptions(options.Options):
    """The options of ``slamgym replay``.

    Attributes
    ----------
    hide_identities
        Let the filter associate the readings of a log that identifies them, and score
        it.
    """

    hide_identities: bool = options.declared(False, "--hide-identities")


@dataclass(frozen=True, kw_only=True)
class SmoothOptions(options.Options):
    """The options of ``slamgym smooth``.

    Attributes
    ----------
    robust
        Give outliers less weight.
    associate
        Use the whole drive to repair the association of readings without identity.
    """

    robust: str | None = options.declared(None, "huber|cauchy", "equal weights")
    associate: bool = options.declared(False, "--associate")


@program.command
@options.takes(
    "labels motion_std measurement_std initial_pose_std landmark_init gate_probability "
    "range_std_per_metre noise_at_rest option_texts hide_identities resolution robot "
    "truth noise_from_file out every_step rerun as_json"
)
def replay(
    log: Annotated[
        Path,
        typer.Argument(
            metavar="LOG",
            help="A slamlog CSV, a course data.txt, a Freiburg sensor.dat, iSAM or g2o "
            "text, or a folder of csv files with named columns, UTIAS MR.CLAM or "
            "Victoria Park; the content decides.",
        ),
    ],
    *,
    given: ReplayOptions,
) -> None:
    """Filter a log, compare with the truth, draw.

    Filter a log, and compare with the truth if it is known. Prints every landmark with
    its Euclidean and Mahalanobis distance to its true position. Writes
    run.html, a page that plays the run, pictures and the numbers.

    Examples
    --------
    slamgym replay data.txt
    slamgym replay data.txt -e ekf --landmark-init independent --out homework
    slamgym replay sensor.dat --motion-std .1,.1,.01 --measurement-std .1,.1
    slamgym replay results/loop-invariant/log.csv --estimator ekf,invariant
    slamgym replay graph.txt --truth true.g2o --noise-from-file
    """
    from ..runs.filter_settings import settings_for
    from .output_folder import default_folder, output_folder
    from .run_files import check_rerun, filter_and_write, show_run

    reporter = given.reporter()
    check_rerun(given.rerun)
    drive = given.read(log, reporter)
    stds = given.stds()
    filters = given.filters(partial(settings_for, drive, **stds))
    place = given.out or default_folder(drive.name, *filters)
    with output_folder(place) as folder:
        summary = filter_and_write(drive, filters, folder, given, reporter)
    chosen = {*stds, *given.named_options()}
    options.note_noise(drive, next(iter(filters.values())), chosen, reporter)
    show_run(summary, place, given, reporter)


@program.command
@options.takes(
    "estimator motion_std measurement_std initial_pose_std robust associate "
    "gate_probability range_std_per_metre noise_at_rest option_texts robot truth "
    "noise_from_file out as_json"
)
def smooth(log: options.LogFile, *, given: SmoothOptions) -> None:
    """Smooth a log: estimate all poses and landmarks at once.

    Filter a log, then find the most likely poses and landmarks given all of its
    readings, with their covariances. The filter associates readings without identity,
    and readings outside its gate are omitted. Compare both with the truth. If neither
    the log nor an option specifies a noise, the command assumes one and says so.

    Examples
    --------
    slamgym smooth data.txt
    slamgym smooth sensor.dat --motion-std .1,.1,.01 --measurement-std .1,.1
    slamgym smooth log.csv -e 'invariant[gate_probability=0.999]' --robust huber
    slamgym smooth log.csv --associate
    """
    from ...estimator.registry import read_label
    from ..log_conventions import explaining, mistake_in
    from ..runs.filter_settings import SMOOTHER, noise_or_assumed, settings_for
    from .output_folder import default_folder, output_folder, write_summary
    from .tables import heading, smoothing_figures, smoothing_table, written

    name, own = read_label(given.estimator)
    robust = {} if given.robust is None else {"robust": given.robust}
    chosen = robust | given.filter_options() | own | {"follow": name}
    reporter = given.reporter()
    drive = given.read(log, reporter)
    stated = given.stds()
    with reporter.warnings():
        stds = noise_or_assumed(drive, stated)
    settings = settings_for(drive, estimator=SMOOTHER, **stds, options=chosen)
    place = given.out or default_folder(drive.name, "smoother")
    with output_folder(place) as folder:
        with (
            reporter.progress("filtering") as tick,
            reporter.note_if_compiling("the smoother"),
            explaining(drive, settings),
        ):
            smoothed = runs.smooth_log(
                drive,
                settings,
                associate=given.associate,
                progress=tick,
                repairing=tick,
            )
        figures.save_figure(figures.smoothed_figure(smoothed), folder / "map.png")
        mistake = mistake_in(drive, settings)
        summary = {
            **runs.summarise_smoothing(smoothed, settings),
            "mistake": None if mistake is None else mistake.as_dict(),
        }
        summary = write_summary(folder, summary)
    options.note_noise(drive, settings, {*stds, *chosen}, reporter)
    title = heading("", summary["log"], " smoothed, following ", given.estimator)
    files = written(str(place), summary["files"])
    is_compared = any(summary[key]["filter"] for key in ("ate", "landmark_rmse"))
    compared = (smoothing_table(summary), "") if is_compared else ()
    told = summary["warnings"] if mistake is None else [str(mistake)]
    warned = [Text(f"Warning: {text}", "yellow") for text in told]
    warned += [Text()] * bool(warned)
    reporter.show(title, *compared, smoothing_figures(summary), "", *warned, files)
    reporter.finish({**summary, "out": str(place)})
