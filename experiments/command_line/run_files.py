"""The files of a run: figures, the log, the numbers."""

import csv
import json
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

from ..figures import (
    covariance_figure,
    errors_figure,
    map_figure,
    map_sequence,
    save_figure,
    truth_figure,
)
from ..logs.slamlog import write_slamlog
from ..runs.replay import Replay
from .output_folder import SUMMARY, files_in


def write_figures(
    folder: Path,
    replay: Replay,
    *,
    every_step: bool,
    progress: Callable[[int, int], object],
) -> None:
    """Draw the run: map.png, truth.png, covariance.png, errors.png, map_steps/.

    Parameters
    ----------
    folder : Path
        Where to.
    replay : Replay
        The run; with its history kept where every step is drawn.
    every_step : bool
        Whether to draw the map after every step too.
    progress : callable
        Called with (figures done, figures).
    """
    trace = replay.trace
    figures = {"map": map_figure, "covariance": covariance_figure}
    figures["errors"] = errors_figure
    if trace.true_poses is not None or trace.true_landmarks is not None:
        figures["truth"] = truth_figure
    count = len(figures) + every_step
    for done, (name, draw) in enumerate(figures.items()):
        progress(done, count)
        save_figure(draw(trace), folder / f"{name}.png")
    if every_step:
        progress(count - 1, count)
        map_sequence(trace, folder / "map_steps")
    progress(count, count)


def write_log(folder: Path, replay: Replay) -> None:
    """Write what the estimator was driven through, as log.csv in slamlog 1."""
    write_slamlog(replay.log, folder / "log.csv")


def write_summary(folder: Path, summary: dict[str, Any]) -> dict[str, Any]:
    """Write summary.json, which also lists the files of the folder.

    Returns
    -------
    dict
        The summary with ``files``.
    """
    complete = {**summary, "files": sorted([*files_in(folder), SUMMARY])}
    (folder / SUMMARY).write_text(as_json_text(complete), encoding="utf-8")
    return complete


def write_table(
    path: Path, columns: Sequence[str], rows: Iterable[Sequence[object]]
) -> None:
    """Write rows as CSV below the names of their columns, empty where None."""
    with path.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(columns)
        writer.writerows(rows)


def as_json_text(summary: dict[str, Any]) -> str:
    """Write a summary as people and programs can read it."""
    return json.dumps(summary, indent=2, allow_nan=False, ensure_ascii=False) + "\n"
