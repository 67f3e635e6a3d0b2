"""``slamgym fit-noise``: the noise of a log, by maximum likelihood."""

from dataclasses import dataclass
from typing import Any

from rich.text import Text

from .. import figures, noise_fitting
from .commands import Reporter, command
from .options import LogFile, Options, declared, takes


@dataclass(frozen=True, kw_only=True)
class FitNoiseOptions(Options):
    """The options of ``slamgym fit-noise``.

    Attributes
    ----------
    write
        Write the suggested noise into the header of LOG, which must be a slamlog.
    """

    write: bool = declared(False, "--write")


@command
@takes(
    "estimator motion_std measurement_std initial_pose_std option_texts "
    "range_std_per_metre noise_at_rest hide_identities robot truth noise_from_file "
    "write out as_json"
)
def fit_noise(log: LogFile, *, given: FitNoiseOptions) -> None:
    """Fit the noise of a log by maximum likelihood.

    Estimate the noise that makes the readings of a log most likely, from the
    innovations of a filter, with 95 % intervals. No truth is needed. If the innovations
    are not white, it suggests a factor for the noise of the sensor. Prints the options
    to paste, and compares the filter with the noise before and after. The search begins
    at the given noise, or at that of the log, which is also used to associate readings
    without identity. If the log breaks a convention, such as degrees or clockwise
    bearings, the command names it and suggests no noise.

    Examples
    --------
    slamgym fit-noise log.csv
    slamgym fit-noise log.csv --write
    slamgym fit-noise MRCLAM_Dataset6 --robot 3 --estimator ekf
    """
    from ..noise_fitting.fit import refuse_other_formats, write_noise
    from ..run_and_replay.filter_settings import noise_or_assumed, settings_for
    from .output_folder import default_folder, output_folder, write_summary
    from .run_files import explaining, mistake_in
    from .tables import written

    reporter = given.reporter()
    drive = given.read(log, reporter)
    if given.write:
        refuse_other_formats(log)
    stated = given.stds()
    with reporter.warnings():
        stds = noise_or_assumed(drive, stated)
    settings = settings_for(
        drive, estimator=given.estimator, **stds, options=given.filter_options()
    )
    place = given.out or default_folder(drive.name, "noise")
    with output_folder(place) as folder:
        with (
            reporter.progress("fitting") as tick,
            reporter.note_if_compiling("the likelihood"),
            explaining(drive, settings),
        ):
            mistake = mistake_in(drive, settings)
            fit = noise_fitting.fit_noise(drive, settings, progress=tick)
        with reporter.progress("replaying") as tick:
            summary = noise_fitting.summarise_fit(fit, progress=tick)
        innovations = noise_fitting.noise_fit_figure(fit)
        figures.save_figure(innovations, folder / "innovations.png")
        if mistake is not None:
            summary |= {"mistake": mistake.as_dict(), "options": None}
        summary = write_summary(folder, summary)
    is_written = given.write and mistake is None
    if is_written:
        write_noise(log, fit.suggested.settings)
    _show_fit(summary, mistake, reporter)
    reporter.show("", written(str(place), summary["files"]))
    if is_written:
        reporter.show(f"Wrote the suggested noise into the header of {log}")
    reporter.finish({**summary, "out": str(place), "written": is_written})


def _show_fit(summary: dict[str, Any], mistake: object, reporter: Reporter) -> None:
    """Print a fit; for a log with a mistake, print the mistake first, and no noise."""
    from ..noise_fitting.search import ENTRIES, noise_of
    from ..run_and_replay.filter_settings import FilterSettings
    from .tables import advice, heading, noise_comparison_table, noise_table

    settings = FilterSettings("", **summary["runs"]["suggested"]["settings"])
    noise = noise_of(settings).tolist()
    suggested = {name: std for (name, _), std in zip(ENTRIES, noise, strict=True)}
    title = heading("Noise of ", summary["log"], ", by ", summary["estimator"])
    if mistake is not None:
        no_noise = "No noise is suggested, because it would hide the mistake."
        reporter.show(title, Text(f"Warning: {mistake} {no_noise}", "yellow"), "")
        title = Text("The fit to the log as it is:", "dim")
    compared = noise_comparison_table(summary)
    reporter.show(title, noise_table(summary, suggested), "", compared, "")
    if mistake is None:
        reporter.show(advice(summary), "")
        reporter.show_verbatim(summary["options"])
