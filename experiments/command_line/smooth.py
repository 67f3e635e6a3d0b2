"""``slamgym smooth``: smooth a log, compare with the truth, draw."""

from dataclasses import dataclass

from rich.text import Text

from .. import figures, run_and_replay
from . import commands, options


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


@commands.command
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
    from ..run_and_replay.filter_settings import (
        SMOOTHER,
        noise_or_assumed,
        settings_for,
    )
    from .output_folder import folder_of_log, output_folder, write_summary
    from .run_files import explaining, mistake_in
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
    place = given.out or folder_of_log(drive.name, "smoother")
    with output_folder(place) as folder:
        with (
            reporter.progress("filtering") as tick,
            reporter.note_if_compiling("the smoother"),
            explaining(drive, settings),
        ):
            smoothed = run_and_replay.smooth_log(
                drive,
                settings,
                associate=given.associate,
                progress=tick,
                repairing=tick,
            )
        figures.save_figure(figures.smoothed_figure(smoothed), folder / "map.png")
        mistake = mistake_in(drive, settings)
        summary = {
            **run_and_replay.summarise_smoothing(smoothed, settings),
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
