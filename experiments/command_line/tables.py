"""The numbers of a run as tables for the terminal."""

import math
import textwrap
from collections.abc import Mapping, Sequence
from typing import Any

from rich.table import Table
from rich.text import Text

from ..monte_carlo.report.headings import headings_and_key

_FATES = (
    ("rejected", "rejected by the gate"),
    ("skipped", "too close"),
    ("tentative", "of unconfirmed ones"),
    ("ambiguous", "ambiguous"),
)
_MOST_ROWS = 10  # landmarks; larger maps show the worst ones
_WORST, _FEWER = 5, 3  # of them; fewer above the table of several filters
_WIDTH = 80  # of a terminal
_TOO_MUCH, _TOO_LITTLE = 0.5, 2.0  # of NIS or NEES per degree, where 1 is expected


def landmark_table(summary: dict[str, Any]) -> Table:
    """Lay out the landmarks and their distances to the truth, the worst of many."""
    rows = summary["landmarks"]
    known = any(row["euclidean"] is not None for row in rows)
    shown, caption = rows, None
    if len(rows) > _MOST_ROWS:
        shown = _worst_rows(summary)
        which = ("first", "largest errors")[known]
        caption = Text(
            f"the {len(shown)} {which} of {len(rows)}; all: summary.json", "dim"
        )
    table = Table(
        title="Landmarks, with their distances from the truth" * known or "Landmarks",
        title_justify="left",
        caption=caption,
        caption_justify="left",
        box=None,
        pad_edge=False,
    )
    headings = ["id", "x [m]", "y [m]"]
    headings += ["Euclidean [m]", "Mahalanobis [σ]"] if known else []
    for heading in headings:
        table.add_column(Text(heading), justify="right")
    for row in shown:
        cells = [str(row["id"]), _number(row["x"], 4), _number(row["y"], 4)]
        distances = [_number(row["euclidean"], 7), _number(row["mahalanobis"], 5)]
        table.add_row(*cells, *(distances if known else []))
    return table


def _worst_rows(summary: dict[str, Any]) -> list[dict[str, Any]]:
    """Return some landmarks with the largest errors, fewer beside other filters."""
    count = _FEWER if summary.get("others") else _WORST
    return sorted(summary["landmarks"], key=_distance, reverse=True)[:count]


def _distance(row: Mapping[str, float | None]) -> tuple[float, float]:
    """Rank a landmark by its error in σ, then in metres; -1 where unknown."""
    sigmas, metres = row["mahalanobis"], row["euclidean"]
    return (-1.0 if sigmas is None else sigmas, -1.0 if metres is None else metres)


def heading(*parts: str) -> Text:
    """Write a title with every second part bold, and an empty line below."""
    text = Text()
    for k, part in enumerate(parts):
        text.append(part, style="bold" if k % 2 else "")
    return text.append("\n")


def key_figures(summary: dict[str, Any]) -> Table:
    """Lay out the few numbers that describe the quality of a run."""
    return named_rows(_figures(summary))


def named_rows(rows: Sequence[tuple[str, str]], title: str | None = None) -> Table:
    """Lay out rows of a name and a text."""
    table = Table(
        title=title, title_justify="left", box=None, show_header=False, pad_edge=False
    )
    table.add_column(style="bold", no_wrap=True)
    table.add_column()
    for name, text in rows:
        table.add_row(name, text)
    return table


def _figures(summary: dict[str, Any]) -> list[tuple[str, str]]:
    readings = summary["readings"]
    rows = [
        ("steps", f"{summary['steps']}, with {summary['scans']} scans"),
        ("readings", _readings(readings)),
        ("map", _map(summary["map_changes"], len(summary["landmarks"]))),
        ("final pose", _pose(summary["pose"], summary["pose_covariance"])),
    ]
    are_compared = bool(summary.get("others"))  # a table of its own has these
    for name, key in (("path error", "ate"), ("map error", "landmark_rmse")):
        if summary[key] is not None and not are_compared:
            rows.append((name, _rmse(summary[key])))
    frame = (summary["nees"] or {}).get("frame", "additive")
    for name, key, hint in (
        (f"pose NEES, {frame}", "nees", ("too cautious", "overconfident")),
        ("NIS", "nis", ("it assumes too much noise", "it assumes too little noise")),
    ):
        if summary[key] is not None:
            rows.append((name, _ratio(summary[key], hint)))
    return rows


def _readings(counts: dict[str, int]) -> str:
    text = f"{counts['associated']} of known landmarks, {counts['added']} of new ones"
    for fate, words in _FATES:
        if counts[fate]:
            text += f", {counts[fate]} {words}"
    return text


def _map(changes: dict[str, int], landmarks: int) -> str:
    text = f"{landmarks} landmarks"
    for change in ("confirmed", "removed", "merged"):
        if changes[change]:
            text += f", {changes[change]} {change}"
    return text


def _pose(pose: Sequence[float | None], covariance: Sequence[Sequence[float]]) -> str:
    parts = []
    for k, (name, unit) in enumerate((("x", "m"), ("y", "m"), ("θ", "rad"))):
        variance = covariance[k][k]
        std = math.sqrt(max(variance, 0.0)) if variance is not None else None
        parts.append(f"{name} {_number(pose[k], 3)} ± {_number(std, 3)} {unit}")
    return ", ".join(parts)


def _rmse(errors: dict[str, float | None]) -> str:
    raw, aligned = (significant(errors[key]) for key in ("raw", "aligned"))
    return f"{raw} m RMS; {aligned} m once best fitted to the truth"


def _ratio(numbers: dict[str, Any], hint: tuple[str, str]) -> str:
    """Rate NEES or NIS per degree of freedom, which is 1 for a consistent filter."""
    ratio = numbers["per_degree"]
    text = f"{significant(ratio)} per degree of freedom; 1 is expected"
    if ratio is None or ratio > _TOO_LITTLE:
        return f"{text}: {hint[1]}"
    return f"{text}: {hint[0]}" if ratio < _TOO_MUCH else text


def written(folder: str, files: Sequence[str]) -> Text:
    """List the written files; the pictures of single steps count as one."""
    steps = [file for file in files if file.startswith("map_steps/")]
    names = sorted(file for file in files if file not in steps)
    if steps:
        names.append(f"map_steps/ ({len(steps)}\N{NO-BREAK SPACE}pictures)")
    listed = textwrap.fill(
        ", ".join(names), _WIDTH, initial_indent="  ", subsequent_indent="  "
    )
    text = Text("Wrote ", style="bold").append(f"{folder}/", style="not bold")
    return text.append(f"\n{listed}", style="not bold")


def _number(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def significant(value: float | None) -> str:
    """Write three significant digits; a dash where unknown."""
    return "-" if value is None else f"{value:.3g}"


def comparison_table(columns: Mapping[str, Mapping[str, Any]]) -> Table:
    """Lay out errors and consistency of several estimates side by side.

    Parameters
    ----------
    columns : mapping
        By the heading, ``ate``, ``landmark_rmse`` and ``nees`` as in a run's summary.
    """
    headings, key_of_headings = headings_and_key(list(columns))
    table = Table(
        caption=Text(key_of_headings) if key_of_headings else None,
        caption_justify="left",
        box=None,
        pad_edge=False,
    )
    table.add_column("")
    for heading in headings:
        table.add_column(Text(heading), justify="right")
    for name, key, kind in (
        ("path error, raw [m RMS]", "ate", "raw"),
        ("path error, aligned [m RMS]", "ate", "aligned"),
        ("map error, raw [m RMS]", "landmark_rmse", "raw"),
        ("map error, aligned [m RMS]", "landmark_rmse", "aligned"),
        ("pose NEES per degree, 1 expected", "nees", "per_degree"),
    ):
        found = [column[key] for column in columns.values()]
        if None not in found:
            cells = (significant(numbers[kind]) for numbers in found)
            table.add_row(Text(name), *cells)
    return table


def smoothing_table(summary: dict[str, Any]) -> Table:
    """Lay out filter and smoother of a log side by side."""
    names = {"filter": summary["follows"], "smoother": "smoother"}
    keys = ("ate", "landmark_rmse", "nees")
    return comparison_table(
        {
            heading: {key: summary[key][side] for key in keys}
            for side, heading in names.items()
        }
    )


def smoothing_figures(summary: dict[str, Any]) -> Table:
    """Lay out what was smoothed, and how well the readings fit."""
    cost = summary["cost"]
    first, last = significant(cost["first"]), significant(cost["last"])
    ratio = significant(cost["per_degree"])
    sizes = "{readings} of {landmarks} landmarks, from {poses} poses"
    return named_rows(
        [
            ("readings", sizes.format(**summary)),
            ("cost", f"{first}, then {last} after {summary['iterations']} steps"),
            ("misfit", f"{ratio} per degree of freedom; 1 is expected"),
        ]
    )
