"""``slamgym replay`` and ``slamgym smooth``: filter or smooth a log, compare, draw."""

from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer

from . import options
from .options import assignments, given_options, standard_deviations
from .program import command


@command
def replay(
    log: Annotated[
        Path,
        typer.Argument(
            metavar="LOG",
            help="A slamlog CSV, a course data.txt, a Freiburg sensor.dat, iSAM or g2o "
            "text, or a UTIAS MR.CLAM folder; the content decides.",
        ),
    ],
    *,
    estimator: options.EstimatorNames = "invariant",
    motion_std: options.MotionStd = None,
    measurement_std: options.MeasurementStd = None,
    initial_pose_std: options.InitialPoseStd = None,
    landmark_init: options.LandmarkInit = None,
    gate_probability: options.GateProbability = None,
    range_std_per_metre: options.RangeStdPerMetre = None,
    noise_at_rest: options.NoiseAtRest = None,
    option: options.EstimatorOptions = None,
    hide_identities: Annotated[
        bool,
        options.option(
            "--hide-identities",
            "Let the filter associate the readings of a log that identifies them, and "
            "score it.",
        ),
    ] = False,
    resolution: options.Resolution = 0.0,
    robot: options.RobotNumber = None,
    truth: options.TruthFile = None,
    noise_from_file: options.NoiseFromFile = False,
    out: options.OutFolder = None,
    every_step: options.EveryStep = None,
    rerun: options.RerunFile = None,
    as_json: options.AsJson = False,
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
    from .options import chosen_filters, note_choices, note_noise, read_any_log
    from .output_folder import default_folder, output_folder
    from .reporter import Reporter
    from .run_files import check_rerun, filter_and_write, show_run

    given = given_options(
        landmark_init=landmark_init,
        gate_probability=gate_probability,
        range_std_per_metre=range_std_per_metre,
        noise_at_rest=noise_at_rest,
    )
    reporter = Reporter(as_json=as_json)
    check_rerun(rerun)
    drive = read_any_log(
        log,
        robot,
        truth=truth,
        noise_from_file=noise_from_file,
        hide_identities=hide_identities,
    )
    note_choices(drive, reporter)
    stds: dict[str, Any] = standard_deviations(
        motion_std, measurement_std, initial_pose_std
    )
    filters = chosen_filters(
        estimator,
        given | assignments("--option", option),
        partial(settings_for, drive, **stds),
    )
    place = out or default_folder(drive.name, *filters)
    with output_folder(place) as folder:
        summary = filter_and_write(
            drive,
            filters,
            folder,
            every_step,
            reporter,
            resolution=resolution,
            rerun=rerun,
        )
    note_noise(drive, next(iter(filters.values())), {*stds, *given}, reporter)
    show_run(summary, place, reporter)


@command
def smooth(
    log: options.LogFile,
    *,
    estimator: options.EstimatorName = "invariant",
    motion_std: options.MotionStd = None,
    measurement_std: options.MeasurementStd = None,
    initial_pose_std: options.InitialPoseStd = None,
    robust: Annotated[
        str | None,
        options.option(
            "huber|cauchy",
            "Give outliers less weight.",
            "all weigh the same",
        ),
    ] = None,
    gate_probability: options.GateProbability = None,
    range_std_per_metre: options.RangeStdPerMetre = None,
    noise_at_rest: options.NoiseAtRest = None,
    option: options.EstimatorOptions = None,
    robot: options.RobotNumber = None,
    truth: options.TruthFile = None,
    noise_from_file: options.NoiseFromFile = False,
    out: options.OutFolder = None,
    as_json: options.AsJson = False,
) -> None:
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
    """
    from ...estimator.registry import read_label
    from ..figures import save_figure, smoothed_figure
    from ..runs.filter_settings import SMOOTHER, noise_or_assumed, settings_for
    from ..runs.log_smoothing import smooth_log, summarise_smoothing
    from .options import note_choices, note_noise, read_any_log
    from .output_folder import default_folder, output_folder, write_summary
    from .reporter import Reporter
    from .tables import heading, smoothing_figures, smoothing_table, written

    name, own = read_label(estimator)
    given = given_options(
        gate_probability=gate_probability,
        range_std_per_metre=range_std_per_metre,
        noise_at_rest=noise_at_rest,
        robust=robust,
    )
    given |= assignments("--option", option) | own | {"follow": name}
    reporter = Reporter(as_json=as_json)
    drive = read_any_log(log, robot, truth=truth, noise_from_file=noise_from_file)
    note_choices(drive, reporter)
    stated = standard_deviations(motion_std, measurement_std, initial_pose_std)
    with reporter.warnings():
        stds = noise_or_assumed(drive, stated)
    settings = settings_for(drive, estimator=SMOOTHER, **stds, options=given)
    place = out or default_folder(drive.name, "smoother")
    with output_folder(place) as folder:
        with (
            reporter.progress("filtering") as tick,
            reporter.note_if_compiling("the smoother"),
        ):
            smoothed = smooth_log(drive, settings, progress=tick)
        save_figure(smoothed_figure(smoothed), folder / "map.png")
        summary = write_summary(folder, summarise_smoothing(smoothed, settings))
    note_noise(drive, settings, {*stds, *given}, reporter)
    title = heading("", summary["log"], " smoothed, following ", estimator)
    files = written(str(place), summary["files"])
    figures = smoothing_figures(summary)
    is_compared = any(summary[key]["filter"] for key in ("ate", "landmark_rmse"))
    compared = (smoothing_table(summary), "") if is_compared else ()
    reporter.show(title, *compared, figures, "", files)
    reporter.finish({**summary, "out": str(place)})
