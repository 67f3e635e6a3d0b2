"""``slamgym judge``: whether the estimates of any program agree with their errors."""

import shlex
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.text import Text

from ...sim_configs.field_types import unknown_choice
from .commands import BadInputError, command
from .monte_carlo import show_study
from .options import FilesOfEstimates, Options, declared, takes


@dataclass(frozen=True, kw_only=True)
class JudgeOptions(Options):
    """The options of ``slamgym judge``.

    Attributes
    ----------
    drives
        The folder of slamgym generate that holds the truth.
    truths
        The true path of a drive that generate did not write: TUM, a log with ground
        truth, or a folder of such files. May be repeated.
    covariances
        The error whose covariances the files hold.
    frame
        The error whose NEES decides.
    space
        Judge poses in space, with covariances of this error in six coordinates, the
        translation first, or the rotation first, as in left,rotation-first.
    align
        Move all estimates by this motion. fit moves each path as close to its truth as
        possible, so there is no verdict.
    out
        The folder to write: new, empty, or with earlier output of slamgym.
    """

    drives: Path | None = declared(None, "DIR", "FILES, if generate wrote them")
    truths: list[Path] | None = declared(
        None, "--truth FILE", "the truth in the drives"
    )
    covariances: str | None = declared(
        None, "additive|invariant|right|left", "additive"
    )
    frame: str | None = declared(
        None,
        "invariant|additive",
        "that of --covariances, or the one that rejects less",
    )
    space: str | None = declared(
        None, "left|right|decoupled[,rotation-first]", "poses in the plane"
    )
    align: str | None = declared(None, "fit|X,Y,THETA", "none")
    out: Path | None = declared(None, "DIR", "results/judge-<scenario>")


@command
@takes("drives truths covariances frame space align out as_json")
def judge(files: FilesOfEstimates, *, given: JudgeOptions) -> int:
    """Judge estimates of any program.

    Decide with known error rates whether the covariances of estimates agree with
    their errors, as monte-carlo does for filters of slamgym. Each file holds the poses
    of one drive, with covariances, as csv, TUM or npz. If a file breaks a convention,
    such as radians or the order of entries, it is named. Writes results.nc,
    summary.json and report.html.

    Examples
    --------
    slamgym generate loop --episodes 100 --format slamlog --out drives
    slamgym judge estimates --drives drives
    slamgym judge mine yours --drives drives --covariances left
    slamgym judge path.tum --truth truth.tum --align fit
    """
    from ...estimator.models.rigid_motion import ERROR_FRAMES
    from .. import judging
    from ..monte_carlo_study import summarise_monte_carlo
    from ..monte_carlo_study.report import write_html_report
    from ..monte_carlo_study.results import REPORT, RESULTS
    from .output_folder import default_folder, output_folder, write_summary

    if given.frame not in (None, *ERROR_FRAMES):
        raise BadInputError(unknown_choice("--frame", str(given.frame), ERROR_FRAMES))
    error: Any = given.frame
    reporter = given.reporter()
    if given.space is not None:
        return _judge_in_space(files, given, given.space)
    with reporter.warnings():
        results = judging.judge(
            files,
            given.drives,
            truth=given.truths,
            covariances=given.covariances,
            align=_motion(given.align),
            command=shlex.join(["slamgym", *sys.argv[1:]]),
        )
        summary = summarise_monte_carlo(results, frame=error)
    place = given.out or default_folder("judge", summary["scenario"])
    with output_folder(place) as folder:
        results.to_netcdf(folder / RESULTS)
        write_html_report(results, summary, folder / REPORT)
        summary = write_summary(folder, summary)
    return show_study(reporter, summary, place)


def _judge_in_space(files: FilesOfEstimates, given: JudgeOptions, space: str) -> int:
    """Print the verdict on poses in space, and write summary.json and nees.svg."""
    from ..figures.style import save_figure
    from ..space_poses import ERRORS, ORDERS, judge_in_space, nees_in_space_figure
    from .output_folder import default_folder, output_folder, write_summary
    from .tables import written

    kind, _, order = space.partition(",")
    if kind not in ERRORS or (order and order not in ORDERS):
        raise BadInputError(unknown_choice("--space", space, ERRORS))
    others = given.drives, given.covariances, given.frame, given.align
    if given.truths is None or any(each is not None for each in others):
        raise BadInputError("--space needs --truth, and accepts no option but --out")
    found = judge_in_space(
        files, given.truths, covariances=kind, order=order or ORDERS[0]
    )
    found["command"] = shlex.join(["slamgym", *sys.argv[1:]])
    place = given.out or default_folder("judge", found["estimator"])
    with output_folder(place) as folder:
        save_figure(nees_in_space_figure(found), folder / "nees.svg")
        found = write_summary(folder, found)
    reporter, nees = given.reporter(), found["nees"]
    lines = [
        found["sentence"],
        f"{found['runs']} drives of {found['steps']} poses: NEES per degree of freedom "
        f"{nees['pose']:.3g}, position {nees['position']:.3g}, rotation "
        f"{nees['rotation']:.3g}.",
    ]
    if found["cause"]:
        lines.append(f"cause: {found['cause']}")
    if found["left_out"]:
        lines.append(f"{found['left_out']} poses without truth are left out.")
    reporter.show(*map(Text, lines), "")
    reporter.show(written(str(place), found["files"]))
    reporter.finish({**found, "out": str(place)})
    return 0


def _motion(text: str | None) -> str | list[float] | None:
    """Parse "fit" or three numbers."""
    if text is None or text == "fit":
        return text
    try:
        x, y, turn = (float(part) for part in text.split(","))
    except ValueError:
        raise BadInputError(f"--align must be fit or X,Y,THETA, got {text!r}") from None
    return [x, y, turn]
