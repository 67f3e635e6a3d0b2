"""``slamgym fit-noise``: the noise of a log, by maximum likelihood."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from .. import figures, noise_fitting
from ..logs.slamlog import SlamLog
from ..runs.filter_settings import FilterSettings, noise_or_assumed, settings_for
from .options import LogFile, Options, note_choices, option, takes
from .output_folder import default_folder, output_folder, write_summary
from .program import command
from .reporter import Reporter

if TYPE_CHECKING:
    from ..noise_fitting import NoiseFit


@command
@takes(
    "estimator motion_std measurement_std initial_pose_std option_texts "
    "range_std_per_metre noise_at_rest hide_identities robot truth noise_from_file "
    "write out as_json"
)
def fit_noise(
    log: LogFile,
    *,
    given: Options,
    write: Annotated[
        bool,
        option(
            "--write", "Put the suggested noise into the header of LOG, a slamlog 1."
        ),
    ] = False,
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

    reporter = given.reporter()
    drive = given.read(log)
    if write:
        refuse_other_formats(log)
    note_choices(drive, reporter)
    stated = given.stds()
    with reporter.warnings():
        stds = noise_or_assumed(drive, stated)
    settings = settings_for(
        drive, estimator=given.estimator, **stds, options=given.filter_options()
    )
    place = given.out or default_folder(drive.name, "noise")
    with output_folder(place) as folder:
        result, summary = _fit_and_write(drive, settings, folder, reporter)
    if write:
        write_noise(log, result.suggested.settings)
    _show(summary, place, reporter)
    if write:
        reporter.show(f"Wrote the suggested noise into the header of {log}")
    reporter.finish({**summary, "out": str(place), "written": write})


def _fit_and_write(
    drive: SlamLog, settings: FilterSettings, folder: Path, reporter: Reporter
) -> tuple["NoiseFit", dict[str, Any]]:
    """Fit the noise, replay, and write innovations.png and summary.json."""
    with (
        reporter.progress("fitting") as tick,
        reporter.note_if_compiling("the likelihood"),
    ):
        result = noise_fitting.fit_noise(drive, settings, progress=tick)
    with reporter.progress("replaying") as tick:
        summary = noise_fitting.summarise_fit(result, progress=tick)
    innovations = noise_fitting.noise_fit_figure(result)
    figures.save_figure(innovations, folder / "innovations.png")
    return result, write_summary(folder, summary)


def _show(summary: dict[str, Any], place: Path, reporter: Reporter) -> None:
    from .tables import advice, heading, noise_table, written
    from .tables import noise_comparison_table as comparison_table

    title = heading("Noise of ", summary["log"], ", by ", summary["estimator"])
    reporter.show(title, noise_table(summary), "", comparison_table(summary), "")
    reporter.show(advice(summary), "")
    reporter.show_verbatim(summary["options"])
    reporter.show("", written(str(place), summary["files"]))
