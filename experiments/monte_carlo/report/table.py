"""The table of a Monte Carlo: one row per measure, one column per estimator."""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

from rich.table import Table
from rich.text import Text

from .headings import headings_and_key
from .verdict import KINDS, in_degrees

Entry = dict[str, Any]
_NOTHING = "–"
_STYLES = {"good": "green", "bad": "red", "open": "yellow"}
_LEAST_BOUND = math.radians(0.1)  # of a heading that is shown


class Measure(NamedTuple):
    """One row of the table."""

    name: str
    right: str
    """Value of a consistent filter, or lower bound; else empty."""
    of: Callable[[Entry], str]
    """Writes the cell of one estimator from its entry in the summary."""


def measures(summary: dict[str, Any]) -> list[Measure]:
    """List the rows that follow the verdict.

    Parameters
    ----------
    summary : dict
        Result of ``summarise_monte_carlo``.
    """
    frame, runs = summary["frame"], summary["runs"]
    other = "additive" if frame == "invariant" else "invariant"
    knowable = summary["knowable_heading_std"]
    least = f"≥ {in_degrees(knowable)}" if knowable >= _LEAST_BOUND else ""

    def at(
        *keys: str, write: Callable[[float], str] = number
    ) -> Callable[[Entry], str]:
        return lambda entry: _cell(entry, keys, write)

    return [
        Measure(f"NEES / 3, {frame} frame", "1", at("pose_nees", frame, "mean")),
        Measure("… at the end", "1", at("pose_nees", frame, "end")),
        Measure("… of the median run", "≲ 1", at("median_run")),
        Measure("… runs above 3", "few", at("share_above_3", write=percent)),
        Measure(
            "… steps in the 95 % band",
            "varies",
            at("pose_nees", frame, "share_inside_band", write=percent),
        ),
        Measure(f"NEES / 3, {other} frame", "", at("pose_nees", other, "mean")),
        Measure("NEES of the heading", "1", at("heading_nees", "mean")),
        Measure("NIS / degrees of freedom", "1", at("nis")),
        Measure(
            "heading at the end, claimed",
            least,
            at("heading_std_end", "claimed", write=in_degrees),
        ),
        Measure(
            "… true error",
            "= claimed",
            at("heading_std_end", "true", write=in_degrees),
        ),
        Measure("… RMSE over all steps", "", at("rmse", "heading", write=in_degrees)),
        *(
            Measure(f"efficiency of the {name}", "≤ 1", _efficiency(key))
            for name, key in (("position", "pose"), ("heading",) * 2, ("map",) * 2)
        ),
        Measure("path (ATE), raw [m]", "", at("ate", "raw")),
        Measure("… aligned [m]", "", at("ate", "aligned")),
        Measure("landmark RMSE, raw [m]", "", at("landmark_rmse", "raw")),
        Measure("… aligned [m]", "", at("landmark_rmse", "aligned")),
        *_association_measures(summary),
        Measure(
            f"failed runs of {runs}", "0", lambda entry: str(len(entry["failed_runs"]))
        ),
    ]


def _efficiency(key: str) -> Callable[[Entry], str]:
    """Return what writes bound by mean squared error, with its 95 % interval."""

    def write(entry: Entry) -> str:
        found = (entry.get("efficiency") or {}).get(key)
        if found is None:
            return _NOTHING
        reach = found["interval"][1]
        spread = "" if reach is None else f" ± {reach - found['value']:.2f}"
        return f"{found['value']:.2f}{spread}"

    return write


def _association_measures(summary: dict[str, Any]) -> list[Measure]:
    """List the rows of a world that hides identities."""
    entries = [entry["association"] for entry in summary["estimators"].values()]
    if None in entries:
        return []

    def at(
        *keys: str, write: Callable[[float], str] = number
    ) -> Callable[[Entry], str]:
        return lambda entry: _cell(entry["association"], keys, write)

    cutoff, runs = entries[0]["gospa"]["cutoff"], summary["runs"]
    size = entries[0]["true_map_size"]
    true_size = "" if size is None else number(size)
    return [
        Measure("path (ATE), median run, raw [m]", "", at("median_ate", "hidden")),
        Measure("… with known identities [m]", "", at("median_ate", "known")),
        Measure(f"GOSPA of the map, {cutoff:g} m, raw [m]", "", _gospa("raw")),
        Measure("… aligned [m]", "", _gospa("aligned")),
        Measure("… landmarks missed, false", "0, 0", _missed_and_false),
        Measure("landmarks in the map", true_size, at("map_size")),
        Measure("… new ones correct", true_size, at("new_correct")),
        Measure("… duplicates", "0", at("duplicate")),
        Measure("… of clutter", "0", at("ghost")),
        Measure("readings given right", "", at("correct")),
        Measure("… wrong", "0", at("wrong")),
        Measure("… not used", "0", at("missed")),
        Measure("… clutter used", "0", at("clutter_used")),
        Measure("precision", "1", at("precision", write=share)),
        Measure("recall", "1", at("recall", write=share)),
        Measure(
            f"bad runs of {runs}",
            "0",
            lambda entry: str(entry["association"]["bad_runs"]["count"]),
        ),
    ]


def _gospa(which: str) -> Callable[[Entry], str]:
    keys = ("association", "gospa", which, "distance")
    return lambda entry: _cell(entry, keys, number)


def _missed_and_false(entry: Entry) -> str:
    found = entry["association"]["gospa"]["aligned"]
    keys = ("missed_count", "false_count")
    return ", ".join(_cell(found, (key,), number) for key in keys)


def share(value: float) -> str:
    """Write a share that should be 1.

    Examples
    --------
    >>> share(0.98765), share(1.0)
    ('.988', '1.000')
    """
    return f"{value:.3f}".removeprefix("0")


def monte_carlo_table(summary: dict[str, Any]) -> Table:
    """Lay out a summary for a terminal of 80 columns or more.

    Parameters
    ----------
    summary : dict
        Result of ``summarise_monte_carlo``.
    """
    entries = summary["estimators"]
    headings, key = headings_and_key(list(entries))
    table = Table(
        title=Text(
            f"{summary['scenario']}: {summary['runs']} runs of {summary['steps']} "
            f"steps, seed {summary['seed']}"
        ),
        caption=Text(f"{key}\n{_caption(entries)}".strip()),
        caption_justify="left",
        pad_edge=False,
        box=None,
    )
    table.add_column("")
    table.add_column("should be", justify="right", style="dim", no_wrap=True)
    for heading in headings:
        table.add_column(Text(heading), justify="right", overflow="fold", min_width=7)
    verdicts = [entry["verdict"] for entry in entries.values()]
    table.add_row(
        "verdict", "", *(Text(word, _STYLES[KINDS[word]]) for word in verdicts)
    )
    for measure in measures(summary):
        cells = [Text(measure.of(entry)) for entry in entries.values()]
        table.add_row(Text(measure.name), Text(measure.right), *cells)
    return table


def _caption(entries: dict[str, Entry]) -> str:
    text = "Averages over runs and steps; heading and RMSE are root mean squares."
    scores = next((entry["association"] for entry in entries.values()), None)
    if scores is None:
        return text
    return f"{text} {bad_run_text(scores)}"


def bad_run_text(scores: dict[str, Any]) -> str:
    """Write what a bad run is."""
    return (
        "A run is bad if it failed, or if its path error is more than "
        f"{scores['bad_runs']['margin']:g} m above that of the same filter with known "
        "identities."
    )


def number(value: float) -> str:
    """Write a number with three digits.

    Examples
    --------
    >>> number(1.0), number(0.01234), number(12345.6), number(1e9)
    ('1.00', '0.0123', '12346', '1e+09')
    """
    if abs(value) >= 1e6:
        return f"{value:.0e}"
    size = math.floor(math.log10(abs(value))) if value else 0
    return f"{value:.{min(max(2 - size, 0), 6)}f}"


def percent(share: float) -> str:
    """Write a share as a percentage.

    Examples
    --------
    >>> percent(0.0), percent(0.005), percent(0.7303)
    ('0 %', '0.5 %', '73 %')
    """
    shown = 100 * share
    return f"{shown:.2g} %" if shown < 99.5 else f"{shown:.0f} %"


def _cell(entry: Entry, keys: tuple[str, ...], write: Callable[[float], str]) -> str:
    value: Any = entry
    for key in keys:
        value = value[key]
    return _NOTHING if value is None else write(value)
