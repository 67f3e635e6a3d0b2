"""``slamgym fit-noise``: the noise of a log, by maximum likelihood."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from . import options
from .options import assignments, given_options, standard_deviations
from .program import command

if TYPE_CHECKING:
    from ..logs.slamlog import SlamLog
    from ..noise_fitting import NoiseFit
    from ..runs.filter_settings import FilterSettings
    from .reporter import Reporter


@command
def fit_noise(
    log: options.LogFile,
    *,
    estimator: options.EstimatorName = "invariant",
    motion_std: options.MotionStd = None,
    measurement_std: options.MeasurementStd = None,
    initial_pose_std: options.InitialPoseStd = None,
    option: options.EstimatorOptions = None,
    range_std_per_metre: options.RangeStdPerMetre = None,
    noise_at_rest: options.NoiseAtRest = None,
    hide_identities: options.HideIdentities = False,
    robot: options.RobotNumber = None,
    truth: options.TruthFile = None,
    noise_from_file: options.NoiseFromFile = False,
    write: Annotated[
        bool,
        options.option(
            "--write", "Put the suggested noise into the header of LOG, a slamlog 1."
        ),
    ] = False,
    out: options.OutFolder = None,
    as_json: options.AsJson = False,
) -> None:
    """Fit the noise of a log by maximum likelihood.

    Estimate the noise that makes the readings of a log most likely, from the
    innovations of a filter, with 95 % intervals. No truth is needed. If the innovations
    are not white, it suggests a factor for the noise of the sensor. Prints the options
    to paste, and compares the filter with the noise before and after. The search begins
    at the given noise, or at that of the log, which is also used to associate readings
    without identity.

    Examples
    --------
    slamgym fit-noise log.csv
    slamgym fit-noise log.csv --write
    slamgym fit-noise MRCLAM_Dataset6 --robot 3 --estimator ekf
    """
    from ..noise_fitting.fit import refuse_other_formats, write_noise
    from ..runs.filter_settings import noise_or_assumed, settings_for
    from .options import note_choices, read_any_log
    from .output_folder import default_folder, output_folder
    from .reporter import Reporter

    reporter = Reporter(as_json=as_json)
    drive = read_any_log(
        log,
        robot,
        truth=truth,
        noise_from_file=noise_from_file,
        hide_identities=hide_identities,
    )
    if write:
        refuse_other_formats(log)
    note_choices(drive, reporter)
    stated = standard_deviations(motion_std, measurement_std, initial_pose_std)
    with reporter.warnings():
        stds = noise_or_assumed(drive, stated)
    given = given_options(
        range_std_per_metre=range_std_per_metre, noise_at_rest=noise_at_rest
    )
    settings = settings_for(
        drive,
        estimator=estimator,
        **stds,
        options=given | assignments("--option", option),
    )
    place = out or default_folder(drive.name, "noise")
    with output_folder(place) as folder:
        result, summary = _fit_and_write(drive, settings, folder, reporter)
    if write:
        write_noise(log, result.suggested.settings)
    _show(summary, place, reporter)
    if write:
        reporter.show(f"Wrote the suggested noise into the header of {log}")
    reporter.finish({**summary, "out": str(place), "written": write})


def _fit_and_write(
    drive: "SlamLog", settings: "FilterSettings", folder: Path, reporter: "Reporter"
) -> tuple["NoiseFit", dict[str, Any]]:
    """Fit the noise, replay, and write innovations.png and summary.json."""
    from ..figures import save_figure
    from ..noise_fitting import fit_noise as fit
    from ..noise_fitting import noise_fit_figure, summarise_fit
    from .output_folder import write_summary

    with (
        reporter.progress("fitting") as tick,
        reporter.note_if_compiling("the likelihood"),
    ):
        result = fit(drive, settings, progress=tick)
    with reporter.progress("replaying") as tick:
        summary = summarise_fit(result, progress=tick)
    save_figure(noise_fit_figure(result), folder / "innovations.png")
    return result, write_summary(folder, summary)


def _show(summary: dict[str, Any], place: Path, reporter: "Reporter") -> None:
    from .tables import advice, heading, noise_table, written
    from .tables import noise_comparison_table as comparison_table

    title = heading("Noise of ", summary["log"], ", by ", summary["estimator"])
    reporter.show(title, noise_table(summary), "", comparison_table(summary), "")
    reporter.show(advice(summary), "")
    reporter.show_verbatim(summary["options"])
    reporter.show("", written(str(place), summary["files"]))
