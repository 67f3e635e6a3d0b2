"""The report of a Monte Carlo: one web page that needs no network, and a table.

`write_html_report` writes the page. `monte_carlo_table` has one row per measure and one
column per estimator, and `inline_svg` draws figures in the page's fonts and colours.
"""

import html
import io
import re
from collections.abc import Iterable
from html import escape
from pathlib import Path
from typing import Any

import xarray as xr
from markupsafe import Markup
from matplotlib import rc_context
from matplotlib.figure import Figure
from rich.table import Table
from rich.text import Text

from ...evaluation.consistency_report import FEW_AVERAGES
from ...evaluation.diagnosis import p_text
from ...sim_configs.scenario_files import replace_when_written
from ...suggestions import counted
from ..figures import style
from ..job_folders import replace_own
from .figures import MOST_DOTS, PURPLE, SKY, grid_steps, report_figures
from .runner import ASSUMED_FILE, python_call
from .summary import NOTHING, measures, number, percent
from .verdict import CONSISTENT, KINDS, NEARLY, NOT_CONSISTENT, names_cause

_LARGE = 1e5  # written without three decimals
_FEW = 3  # estimators; a headline counts more of them


def write_html_report(
    dataset: xr.Dataset, summary: dict[str, Any], path: str | Path
) -> None:
    """Write the report, which appears complete or not at all.

    The same results give the same bytes.

    Parameters
    ----------
    dataset : xarray.Dataset
        Results of ``monte_carlo``.
    summary : dict
        Their summary, of ``summarise_monte_carlo``.
    path : str or Path
        The .html file; its folder must exist.

    Raises
    ------
    FileNotFoundError
        If the folder does not exist.
    """
    page = html_report(dataset, summary)
    with replace_when_written(path) as partial:
        partial.write_text(page, encoding="utf-8")


def html_report(dataset: xr.Dataset, summary: dict[str, Any]) -> str:
    """Return the report's HTML; see :func:`write_html_report`."""
    environment = style.page_environment(Path(__file__).parent, finalize=escaped)
    entries = summary["estimators"]
    page = {
        "headline": headline(summary),
        "command": summary["command"] or python_call(summary),
        "described": "; ".join(_described(*entry) for entry in entries.items()),
        "files": _files(summary),
        "measures": measures(summary),
        "notes": _no_bound(summary) + _bad_run(summary),
        "figures": report_figures(dataset, summary),
        "prints": [file for file in summary.get("files", ()) if "mm." in file],
        "good_runs": max(entry["good_runs"] for entry in entries.values()),
        "tested": grid_steps(summary),
    }
    environment.globals |= {
        "most_dots": MOST_DOTS,
        "few_averages": FEW_AVERAGES,
        "kinds": KINDS,
        "names_cause": names_cause,
        "signs": {CONSISTENT: "✓", NEARLY: "≈", NOT_CONSISTENT: "✗"},
        "outcomes": {True: "accepted", False: "rejected", None: NOTHING},
        "inside": {CONSISTENT: "yes", NOT_CONSISTENT: "no, outside"},
        "breakable": _breakable,
        "extreme": _extreme,
        "interval": _interval,
        "number": number,
        "p_value": _p_value,
        "percent": percent,
        "svg": lambda *part: Markup(inline_svg(*part)),
        "verbatim": lambda text: Markup(html.escape(text)),
    }
    return environment.get_template("html_report.html").render(summary | page)


def write_figures(
    dataset: xr.Dataset, summary: dict[str, Any], folder: Path, suffix: str
) -> list[str]:
    """Write the figures of a report for print, 85 and 170 mm wide; return the names."""
    names = []
    for width in (85, 170):
        for name, figure in report_figures(dataset, summary, width_mm=width).items():
            names.append(f"{name}_{width}mm.{suffix}")
            with replace_own(folder / names[-1]) as partial:
                style.draw_file(figure, partial, suffix)
    return names


def headline(summary: dict[str, Any]) -> str:
    """Write the verdicts in one line.

    Examples
    --------
    >>> entries = {"ekf": {"verdict": "not consistent"}}
    >>> headline({"scenario": "loop", "estimators": entries})
    'loop: ekf not consistent'
    """
    entries = summary["estimators"]
    words = [entry["verdict"] for entry in entries.values()]
    if len(entries) <= _FEW:
        said = "; ".join(f"{k} {entry['verdict']}" for k, entry in entries.items())
    else:
        said = f"{words.count(CONSISTENT)} of {len(words)} estimators consistent"
    return f"{summary['scenario']}: {said}"


def _files(summary: dict[str, Any]) -> dict[str, str]:
    """Return the scenario files that the page shows, by their titles."""
    files = {f"The scenario, {summary['scenario']}.toml": summary["scenario_toml"]}
    if summary["assumed_toml"]:
        title = f"The scenario that the estimators assume, {ASSUMED_FILE}"
        files[title] = summary["assumed_toml"]
    return files


def _described(label: str, entry: dict[str, Any]) -> str:
    name, options = entry.get("name", label), entry.get("options") or {}
    listed = ", ".join(f"{key} = {value}" for key, value in options.items())
    estimator = name if name == label else f"{label}: {name}"
    return f"{estimator} ({listed})" if listed else estimator


def _breakable(label: str) -> Markup:
    """Allow line breaks in a long name after its punctuation."""
    return Markup(re.sub(r"([_,:=])|(?=\[)", r"\1<wbr>", str(escaped(label))))


def _extreme(found: float | list[float]) -> float:
    """Return the ratio of the grid that is farthest from 1."""
    if isinstance(found, list):
        return max(found, key=lambda ratio: abs(ratio - 1))
    return found


def _p_value(p_value: float | None) -> str:
    if p_value is None:
        return NOTHING
    return p_text(p_value).removeprefix("p ").removeprefix("= ")


def _interval(ends: Iterable[float | None]) -> str:
    """Write an interval; a dash where unknown."""
    known = [end for end in ends if end is not None]
    if len(known) < 2:
        return NOTHING
    written = [f"{end:.3f}" if end < _LARGE else number(end) for end in known]
    return f"[{', '.join(written)}]"


def escaped(value: object) -> Markup:
    """Write a value as HTML without line breaks before a % or inside an interval.

    Examples
    --------
    >>> print(escaped("<b> at 5 %, [1, 2]"))
    &lt;b&gt; at 5&nbsp;%, [1,&nbsp;2]
    """
    if isinstance(value, Markup):
        return value
    safe = html.escape(str(value)).replace(" %", "&nbsp;%")
    return Markup(re.sub(r"(\[[\d.e+-]+,) ([\d.e+-]+\])", r"\1&nbsp;\2", safe))


# --------------------------------------------------------------------------------------
# The table.

_STYLES = {"good": "green", "bad": "red", "open": "yellow"}


def monte_carlo_table(summary: dict[str, Any]) -> Table:
    """Lay out a summary for a terminal of 80 columns or more.

    Parameters
    ----------
    summary : dict
        Result of ``summarise_monte_carlo``.
    """
    entries = summary["estimators"]
    headings, key = style.headings_and_key(list(entries))
    note = "Averages over runs and steps; heading and RMSE are root mean squares."
    table = Table(
        title=Text(
            f"{summary['scenario']}: {counted(summary['runs'], 'run')} of "
            f"{summary['steps']} steps, seed {summary['seed']}"
        ),
        caption=Text(f"{key}\n{note}{_no_bound(summary)}{_bad_run(summary)}".strip()),
        caption_justify="left",
        pad_edge=False,
        box=None,
    )
    table.add_column("")
    table.add_column("should be", justify="right", style="dim", no_wrap=True)
    for heading in headings:
        table.add_column(Text(heading), justify="right", overflow="fold", min_width=7)
    verdicts = [entry["verdict"] for entry in entries.values()]
    table.add_row("verdict", "", *(Text(w, _STYLES[KINDS[w]]) for w in verdicts))
    for measure in measures(summary):
        cells = [Text(measure.of(entry)) for entry in entries.values()]
        table.add_row(Text(measure.name), Text(measure.right), *cells)
    return table


def _no_bound(summary: dict[str, Any]) -> str:
    """Write why an efficiency is unknown, after a space; empty if none is."""
    found = [entry["efficiency"] or {} for entry in summary["estimators"].values()]
    if all(value for efficiencies in found for value in efficiencies.values()):
        return ""
    return (
        " An efficiency is – where no bound is known: for sensors other than "
        "bearing_range and position, for the poses of an estimator without NIS, such "
        "as a smoother, and if no run succeeded."
    )


def _bad_run(summary: dict[str, Any]) -> str:
    """Write what a bad run is, after a space; empty where identities are known."""
    scores = [entry["association"] for entry in summary["estimators"].values()]
    if None in scores:
        return ""
    return (
        " A run is bad if it failed, or if its path error is more than "
        f"{scores[0]['bad_runs']['margin']:g} m above that of the same filter with "
        "known identities. A filter raises the alarm where scans show far fewer "
        "landmarks than its map promises. To repair the log of such a run: slamgym "
        "smooth LOG --associate"
    )


#: CSS variables that the page must define, by the colours of the figures.
COLOUR_VARIABLES = {
    style.INK: "--ink",
    "#000000": "--ink",
    style.GREY: "--grey",
    style.PALE: "--pale",
    "#ffffff": "--paper",
    style.BLUE: "--blue",
    style.ORANGE: "--orange",
    style.TEAL: "--teal",
    PURPLE: "--purple",
    SKY: "--sky",
    style.ALARM: "--alarm",
}


def inline_svg(figure: Figure, name: str, text: str) -> str:
    """Return a figure as an ``<svg>`` element without size, font or colour of its own.

    It fills the available width and keeps text as text; the same figure gives the same
    bytes.

    Parameters
    ----------
    figure : Figure
        A figure in the colours of `COLOUR_VARIABLES`.
    name : str
        Prefix of all ids, unique on the page.
    text : str
        Text for screen readers.
    """
    buffer = io.StringIO()
    style.lay_out(figure, 72)
    with rc_context({"svg.fonttype": "none", "svg.hashsalt": name}):
        figure.savefig(buffer, format="svg", transparent=True, metadata={"Date": None})
    svg = buffer.getvalue()
    svg = svg[svg.index("<svg") :].strip()
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg, flags=re.DOTALL)
    svg = re.sub(r"<style[^>]*>.*?</style>", "", svg, flags=re.DOTALL)
    svg = re.sub(r"<!--.*?-->", "", svg, flags=re.DOTALL)
    svg = _use_page_style(_short_numbers(_own_ids(svg, name)))
    box = re.search(r'viewBox="[^"]*"', svg)
    attributes = f'{box[0] if box else ""} role="img" aria-label="{escape(text)}"'
    return re.sub(r"<svg\b[^>]*>", lambda _: f"<svg {attributes}>", svg, count=1)


def _own_ids(svg: str, name: str) -> str:
    """Keep only ids that are referenced, and prefix them with the figure's name."""
    used = set(re.findall(r'(?:url\(#|href="#)([^)"]+)', svg))

    def renamed(match: re.Match[str]) -> str:
        return f' id="{name}-{match[1]}"' if match[1] in used else ""

    svg = re.sub(r'\s+id="([^"]*)"', renamed, svg)
    svg = re.sub(r"url\(#", f"url(#{name}-", svg)
    return re.sub(r'(?:xlink:)?href="#', f'href="#{name}-', svg)


def _short_numbers(svg: str) -> str:
    """Round coordinates to a hundredth of a point."""

    def shortened(match: re.Match[str]) -> str:
        return re.sub(r"(\.\d\d)\d+", r"\1", match[0])

    svg = re.sub(r'\b(?:d|x|y|transform)="[^"]*"', shortened, svg)
    return re.sub(r"\s*\n\s*", "\n", svg)


def _use_page_style(svg: str) -> str:
    """Remove fonts, and take colours from the page's variables."""
    svg = re.sub(r"\bfont: ([\d.]+px) [^;\"]*", r"font-size: \1", svg)
    svg = re.sub(r"font-family: [^;\"]*;?", "", svg)
    for colour, variable in COLOUR_VARIABLES.items():
        svg = re.sub(rf"\b(fill|stroke): {colour}\b", rf"\1: var({variable})", svg)
    return svg
