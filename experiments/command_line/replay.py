"""``slamgym replay``: filter a log, compare with the truth, draw."""

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from . import commands, options


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


@commands.command
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
    from ..run_and_replay.filter_settings import settings_for
    from .output_folder import folder_of_log, output_folder
    from .run_files import check_rerun, filter_and_write, show_run

    reporter = given.reporter()
    check_rerun(given.rerun)
    drive = given.read(log, reporter)
    stds = given.stds()
    filters = given.filters(partial(settings_for, drive, **stds))
    place = given.out or folder_of_log(drive.name, *filters)
    with output_folder(place) as folder:
        summary = filter_and_write(drive, filters, folder, given, reporter)
    chosen = {*stds, *given.named_options()}
    options.note_noise(drive, next(iter(filters.values())), chosen, reporter)
    show_run(summary, place, given, reporter)
