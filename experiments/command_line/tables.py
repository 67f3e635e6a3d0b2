"""The results of all commands as tables for the terminal."""

import math
import textwrap
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal

from rich.table import Table
from rich.text import Text

from ...suggestions import counted
from ..noise_study import Variation
from ..run_and_replay.summary import MOST_REJECTED

if TYPE_CHECKING:
    from ..noise_study import NoiseEffect, NoiseRun


_FATES = {
    "rejected": "rejected by the gate",
    "skipped": "with range ≤ 0 or too near",
    "tentative": "of unconfirmed ones",
    "ambiguous": "ambiguous",
    "waiting": "of ones not placed yet",
}
_CHANGES = {name: name for name in ("confirmed", "removed", "merged")}
_MOST_ROWS = 10  # landmarks; larger maps show the worst ones
_WORST, _FEWER = 5, 3  # of them; fewer above the table of several filters
_WIDTH = 80  # of a terminal
_LARGE_NEES = 1.5  # per degree, with a suggested noise
_TOO_MUCH, _TOO_LITTLE = 0.5, 2.0  # of NIS or NEES per degree, where 1 is expected


def landmark_table(summary: dict[str, Any]) -> Table:
    """Lay out the landmarks and their distances to the truth, the worst of many.

    The distances are aligned ones where the start of the log is not the true one.
    """
    rows = summary["landmarks"]
    are_aligned = summary.get("aligned_landmarks") is not None
    if are_aligned:
        rows = summary["aligned_landmarks"]
    known = any(row["euclidean"] is not None for row in rows)
    shown, caption = rows, None
    if len(rows) > _MOST_ROWS:
        count = _FEWER if summary.get("others") else _WORST
        shown = sorted(rows, key=_distance, reverse=True)[:count]
        which = ("first", "largest errors")[known]
        told = f"the {len(shown)} {which} of {len(rows)}; all: summary.json"
        caption = Text(told, "dim")
    title = "Landmarks, with their distances from the truth" * known or "Landmarks"
    title += " after alignment" * are_aligned
    headings = ["id", "x [m]", "y [m]"]
    headings += ["Euclidean [m]", "Mahalanobis [σ]"] if known else []
    table = _table(headings, title=title, caption=caption)
    for row in shown:
        cells = [str(row["id"]), _number(row["x"], 4), _number(row["y"], 4)]
        distances = [significant(row[k], 4) for k in ("euclidean", "mahalanobis")]
        table.add_row(*cells, *(distances if known else []))
    return table


def _table(
    headings: Sequence[str], texts: Sequence[str] = ("",), **others: Any
) -> Table:
    """Return a table without rows; all columns but `texts` are of numbers."""
    table = Table(
        title_justify="left", caption_justify="left", box=None, pad_edge=False, **others
    )
    for heading in headings:
        side: Literal["left", "right"] = "left" if heading in texts else "right"
        table.add_column(Text(heading), justify=side)
    return table


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


def named_rows(rows: Sequence[tuple[str, str]], title: str | None = None) -> Table:
    """Lay out rows of a name and a text."""
    table = _table((), title=title, show_header=False)
    table.add_column(style="bold", no_wrap=True)
    table.add_column()
    for name, text in rows:
        table.add_row(name, text)
    return table


def key_figures(summary: dict[str, Any]) -> Table:
    """Lay out the few numbers that describe the quality of a run."""
    counts, size = summary["readings"], f"{len(summary['landmarks'])} landmarks"
    used = f"{counts['associated']} of known landmarks, {counts['added']} of new ones"
    if not any(counts.values()):
        used = "the filter reports none"
    rows = [
        ("steps", f"{summary['steps']}, with {summary['scans']} scans"),
        ("readings", _and_counts(used, counts, _FATES)),
        ("map", _and_counts(size, summary["map_changes"], _CHANGES)),
        ("final pose", _pose(summary["pose"], summary["pose_covariance"])),
    ]
    are_compared = bool(summary.get("others"))  # a table of its own has these
    for name, key in (("path error", "ate"), ("map error", "landmark_rmse")):
        if summary[key] is not None and not are_compared:
            raw, aligned = (significant(summary[key][k]) for k in ("raw", "aligned"))
            rows.append((name, f"{raw} m RMS; {aligned} m after alignment"))
    if never := summary["never_placed"]:
        more = ", …" * (len(never) > _MOST_ROWS)
        names = ", ".join(map(str, never[:_MOST_ROWS]))
        rows.insert(3, ("never placed", f"{len(never)} landmarks: {names}{more}"))
    frame = (summary["nees"] or {}).get("frame", "additive")
    for name, key, hint in (
        (f"pose NEES, {frame}", "nees", ("too cautious", "overconfident")),
        ("NIS", "nis", [f"the filter assumes too {w} noise" for w in _MUCH]),
    ):
        if summary[key] is not None:
            text = _ratio(summary[key], hint)
            if summary.get("mistake"):  # and not the noise
                text = text.partition(":")[0]
            rows.append((name, text))
    return named_rows(rows)


_MUCH = ("much", "little")


def _and_counts(text: str, counts: dict[str, int], words: Mapping[str, str]) -> str:
    """Append the counts that are not 0."""
    found = [f"{counts[key]} {word}" for key, word in words.items() if counts[key]]
    return ", ".join([text, *found])


def _pose(
    pose: Sequence[float | None], covariance: Sequence[Sequence[float | None]]
) -> str:
    parts = []
    for k, (name, unit) in enumerate((("x", "m"), ("y", "m"), ("θ", "rad"))):
        variance = covariance[k][k]
        std = math.sqrt(max(variance, 0.0)) if variance is not None else None
        parts.append(f"{name} {_number(pose[k], 3)} ± {_number(std, 3)} {unit}")
    return ", ".join(parts)


def _ratio(numbers: dict[str, Any], hint: Sequence[str]) -> str:
    """Rate NEES or NIS per degree of freedom, which is 1 for a consistent filter."""
    ratio = numbers["per_degree"]
    text = f"{significant(ratio)} per degree of freedom; 1 is expected"
    if singular := numbers.get("singular"):
        poses = counted(singular, "pose")
        text = f"{text}; {poses} without it, whose covariance is singular"
        if ratio is None:
            return f"none: the covariance of {poses} is singular"
    if ratio is None or ratio > _TOO_LITTLE:
        return f"{text}: {hint[1]}"
    return f"{text}: {hint[0]}" if ratio < _TOO_MUCH else text


def written(folder: str, files: Sequence[str]) -> Text:
    """List the written files; the pictures of a folder count as one."""
    names = sorted(file for file in files if "/" not in file)
    folders = Counter(file.partition("/")[0] for file in files if "/" in file)
    for name, count in sorted(folders.items()):
        names.append(f"{name}/ ({count}\N{NO-BREAK SPACE}pictures)")
    listed = textwrap.fill(
        ", ".join(names), _WIDTH, initial_indent="  ", subsequent_indent="  "
    )
    text = Text("Wrote ", style="bold").append(f"{folder}/", style="not bold")
    return text.append(f"\n{listed}", style="not bold")


def _number(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def significant(value: float | None, digits: int = 3) -> str:
    """Write some significant digits; a dash where unknown."""
    return "-" if value is None else f"{value:.{digits}g}"


def comparison_table(columns: Mapping[str, Mapping[str, Any]]) -> Table:
    """Lay out errors and consistency of several estimates, side by side if these fit.

    Parameters
    ----------
    columns : mapping
        By the heading, ``ate``, ``landmark_rmse`` and ``nees`` as in a run's summary.
    """
    from ..figures.style import headings_and_key

    measures = {}
    for name, key, kind in (
        ("path error, raw [m RMS]", "ate", "raw"),
        ("path error, aligned [m RMS]", "ate", "aligned"),
        ("map error, raw [m RMS]", "landmark_rmse", "raw"),
        ("map error, aligned [m RMS]", "landmark_rmse", "aligned"),
        ("pose NEES per degree, 1 expected", "nees", "per_degree"),
    ):
        found = [column[key] for column in columns.values()]
        if None not in found:
            measures[name] = [significant(numbers[kind]) for numbers in found]
    _, are_long = headings_and_key(list(columns))
    if not are_long:
        table = _table(["", *columns])
        for name, cells in measures.items():
            table.add_row(Text(name), *cells)
        return table
    table = _table(["", *measures])
    table.columns[0].overflow = "fold"
    for column in table.columns[1:]:
        column.width = 8  # of 1.23e+04
    for label, *cells in zip(columns, *measures.values(), strict=True):
        table.add_row(Text(label), *cells)
    return table


def smoothing_table(summary: dict[str, Any]) -> Table:
    """Lay out filter and smoother of a log side by side."""
    names = {"filter": summary["follows"], "smoother": "smoother"}
    keys = ("ate", "landmark_rmse", "nees")
    columns = {
        heading: {key: summary[key][side] for key in keys}
        for side, heading in names.items()
    }
    return comparison_table(columns)


def smoothing_figures(summary: dict[str, Any]) -> Table:
    """Lay out what was smoothed, and how well the readings fit."""
    cost = summary["cost"]
    first, last = significant(cost["first"]), significant(cost["last"])
    ratio = significant(cost["per_degree"])
    sizes = "{readings} of {landmarks} landmarks, from {poses} poses"
    rows = [
        ("readings", sizes.format(**summary)),
        ("cost", f"{first}, then {last} after {summary['iterations']} steps"),
        ("misfit", f"{ratio} per degree of freedom; 1 is expected"),
    ]
    if (repair := summary["repair"]) is not None:
        rows.append(("association", _repaired(repair["first"], repair["last"])))
        rows.append(("unused", f"{repair['unused']} readings, given to no landmark"))
    return named_rows(rows)


def _repaired(first: float, last: float) -> str:
    """Write the scores before and after a repair.

    Examples
    --------
    >>> _repaired(177.7, 150.1)
    'score 177.7, then 150.1 (lower is better)'
    >>> _repaired(177.7, 177.7)
    'score 177.7 (lower is better): no better one found'
    """
    if last < first:
        return f"score {first:.1f}, then {last:.1f} (lower is better)"
    return f"score {first:.1f} (lower is better): no better one found"


# --------------------------------------------------------------------------------------
# Association.


def association_table(scores: dict[str, Any]) -> Table:
    """Lay out the ``association`` of a summary.

    Parameters
    ----------
    scores : dict
        As in :func:`slamgym.experiments.run_and_replay.summary.association_summary`.
    """
    title, found = "Association", scores["gospa"]
    if scores["resolution"]:
        title += f", landmarks nearer than {scores['resolution']:g} m counted as one"
    of_the_map = [
        ("GOSPA of the map", _gospa(found["aligned"]) + " after alignment"),
        ("… raw", f"{_gospa(found['raw'])}; cut-off {found['cutoff']:g} m"),
    ]
    if scores["correct"] is None:
        return named_rows(of_the_map, title)
    readings = (
        f"{scores['correct']} correct, {scores['wrong']} wrong, {scores['missed']} "
        f"not used, {scores['clutter_used']} of clutter used"
    )
    new = (
        f"{scores['new_correct']} correct, {scores['duplicate']} duplicates, "
        f"{scores['ghost']} of clutter"
    )
    size = f"{scores['map_size']}; {scores['true_map_size']} were seen often enough"
    shares = f"{_number(scores['precision'], 3)}, recall {_number(scores['recall'], 3)}"
    of_readings = [
        ("readings", readings),
        ("new landmarks", new),
        ("map size", size),
        ("precision", shares),
    ]
    if scores["oracle_errors"] is not None:
        wrong = f"{scores['oracle_errors']:.1%} wrongly"
        bar = f"a filter that knew pose and map would assign {wrong}"
        of_readings.append(("at best", bar))
    return named_rows(of_readings + of_the_map, title)


def _gospa(parts: dict[str, Any]) -> str:
    return (
        f"{significant(parts['distance'])} m: {parts['missed_count']} missed, "
        f"{parts['false_count']} false, localisation "
        f"{significant(parts['localisation'] ** 0.5)} m"
    )


# --------------------------------------------------------------------------------------
# Noise studies.

_COLUMNS = {
    "predicted_area": "prior\narea\n[m²]",
    "pose_area": "pose\narea\n[m²]",
    "landmark_area": "landmark\narea\n[m²]",
    "landmark_rmse": "map\nerror\n[m]",
    "landmark_rmse_aligned": "map,\naligned\n[m]",
    "ate": "path\nerror\n[m]",
    "nees_per_degree": "NEES\n/ degree",
    "nis_per_degree": "NIS\n/ degree",
}


def runs_table(runs: "Sequence[NoiseRun]") -> Table:
    """Lay out the study of one run, a row for each variation."""
    title = "Final 3σ areas and RMS errors; for NEES and NIS, 1 is expected"
    rows: list[dict[str, Any]] = [run.row._asdict() for run in runs]
    shown = [key for key in _COLUMNS if any(row[key] is not None for row in rows)]
    if len(shown) == len(_COLUMNS):  # too wide for 80; the file holds it
        shown.remove("predicted_area")
    table = _table((), title=title, collapse_padding=True)  # fits 80
    for name in ("noise", "value"):
        table.add_column(name, no_wrap=True)
    for key in shown:
        table.add_column(Text(_COLUMNS[key]), justify="right", no_wrap=True)
    for run, row in zip(runs, rows, strict=True):
        change, _, value = run.title.partition(" = ")
        table.add_row(change, value, *(significant(row[key]) for key in shown))
    return table


def effects_table(name: str, runs: int, effects: "Sequence[NoiseEffect]") -> Table:
    """Lay out the study over many runs, a column for each estimator."""
    from ..figures.style import headings_and_key

    labels = list(dict.fromkeys(effect.estimator for effect in effects))
    headings, key = headings_and_key(labels)
    note = "± is the standard error. noise_study.csv holds further figures."
    title = f"{name}, {runs} runs each: NEES / 3 of the pose; 1 is expected"
    table = _table((), title=title, caption=Text(f"{key}\n{note}".strip()))
    for column in ("changed", "noise"):
        table.add_column(column, no_wrap=True)
    for heading in headings:
        table.add_column(Text(heading), justify="right", overflow="fold")
    rows: dict[tuple[str, Variation], list[str]] = {}
    for effect in effects:
        variation = Variation(effect.sigma, effect.factor)
        rows.setdefault((effect.changed, variation), []).append(_cell(effect))
    for (changed, variation), cells in rows.items():
        table.add_row(changed, "" if changed == "nothing" else str(variation), *cells)
    return table


def _cell(effect: "NoiseEffect") -> str:
    """Write the NEES, its standard error where known, and the failed runs."""
    nees, error = effect.nees_per_degree, effect.nees_per_degree_error
    text = "–" if math.isnan(nees) else f"{nees:.3g}"
    if not math.isnan(error):
        text += f" ± {error:.3g}"
    return f"{text} ({effect.failed} failed)" if effect.failed else text


# --------------------------------------------------------------------------------------
# Noise fits.

_VERDICTS = {
    "fitted": "",
    "zero": "may be zero",
    "unknown": "no reading depends on it: not fitted",
}


def noise_table(summary: dict[str, Any], suggested: Mapping[str, float]) -> Table:
    """Lay out the standard deviations with their intervals, and those suggested."""
    table = _table(
        ("noise", "before", "most likely", "95 % interval", "suggested", ""),
        texts=("noise", ""),
    )
    for row in summary["noise"]:
        table.add_row(
            f"{row['name']} [{row['unit']}]".replace("[", "\\["),
            significant(row["before"]),
            "-" if row["verdict"] == "unknown" else significant(row["value"]),
            _interval(row),
            significant(suggested[row["name"]]),
            _VERDICTS[row["verdict"]],
        )
    return table


def noise_comparison_table(summary: dict[str, Any]) -> Table:
    """Lay out the results of filters under each noise."""
    runs = summary["runs"]
    table = _table(("", *runs))
    for name, path in (
        ("log likelihood", ("log_likelihood",)),
        ("readings rejected", ("readings", "rejected")),
        ("NIS per degree, 1 expected", ("nis", "per_degree")),
        ("pose NEES per degree, 1 expected", ("nees", "per_degree")),
        ("path error, raw [m RMS]", ("ate", "raw")),
        ("path error, aligned [m RMS]", ("ate", "aligned")),
        ("map error, aligned [m RMS]", ("landmark_rmse", "aligned")),
        ("bearing innovations white, p", ("whiteness", "bearing", "p")),
        ("range innovations white, p", ("whiteness", "range", "p")),
    ):
        values = [_at(run, path) for run in runs.values()]
        if any(value is not None for value in values):
            table.add_row(name, *map(_figure, values))
    return table


def advice(summary: dict[str, Any]) -> Table:
    """Describe the suggested inflation of the sensor noise, and its reason."""
    factors = summary["inflation"]
    inflated = [
        f"{sigma} × {factors[name]:.3g}"
        for sigma, name in (("σβ", "bearing"), ("σr", "range"))
        if factors[name] > 1
    ]
    lost, count = summary["runs"]["fitted"]["rejected"], summary["readings"]
    text = "none needed"
    if inflated:
        text = f"{', '.join(inflated)}: the errors of readings are correlated in time"
    elif lost > MOST_REJECTED * count:
        text = "not known"
    rows = [("inflation", text)]
    at_zero = [n["name"] for n in summary["noise"][:3] if n["verdict"] == "zero"]
    if at_zero:
        names = ", ".join(at_zero)
        text = f"{names} instead of 0: without it, a filter becomes overconfident"
        rows.append(("upper end", text))
    if lost > MOST_REJECTED * count:
        text = (
            f"{lost} of {count} readings ({lost / count:.0%}), which fit no noise: the "
            "noise is fitted to the others alone"
        )
        rows.append(("given up", text))
    if summary["calibration"] is not None:
        rows.append(("with the true path", _calibration(**summary["calibration"])))
    nees = _at(summary["runs"]["suggested"], ("nees", "per_degree"))
    if nees is not None and nees > _LARGE_NEES:
        text = (
            f"the pose NEES is {nees:.3g} per degree with the suggested noise, where 1 "
            "is expected: the filter stays overconfident"
        )
        rows.append(("remaining", text))
    return named_rows(rows)


def _calibration(
    factor: float | None, low: float, high: float | None, tried: Sequence[float]
) -> str:
    """Write a factor of the sensor's noise with its interval.

    Examples
    --------
    >>> _calibration(1.14, 0.609, None, (0.25, 16))
    'multiply σβ and σr by 1.14 (at least 0.61) for a pose NEES of 1 per degree'
    """
    if factor is None:
        return f"no factor of σβ and σr up to {tried[1]:g} gives a pose NEES of 1"
    if not factor:
        return f"σβ and σr times {tried[0]:g} give a pose NEES below 1"
    if high is not None:
        within = f"{low:.2g} to {high:.2g}" if low else f"at most {high:.2g}"
    else:
        within = f"at least {low:.2g}" if low else "not known better"
    text = f"multiply σβ and σr by {factor:.3g} ({within})"
    return f"{text} for a pose NEES of 1 per degree"


def _interval(row: dict[str, Any]) -> str:
    if row["verdict"] == "unknown" or row["high"] is None:
        return "-"
    return f"{significant(row['low'])} … {significant(row['high'])}"


def _at(run: dict[str, Any], path: tuple[str, ...]) -> Any:
    value: Any = run
    for key in path:
        value = None if value is None else value[key]
    return value


def _figure(value: float | None) -> str:
    if value is None:
        return "-"
    return str(value) if isinstance(value, int) else f"{value:.4g}"
