"""Write the report of a Monte Carlo as one web page without other files or network."""

import html
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import xarray as xr
from markupsafe import Markup

from ....evaluation.consistency_report import FEW_AVERAGES
from ....sim_configs.atomic_file import replace_when_written
from ...figures.web_style import page_environment
from ..reproduction import ASSUMED_FILE, python_call
from .figures import MOST_DOTS, grid_steps, report_figures
from .inline_svg import inline_svg
from .table import bad_run_text, measures, number, percent
from .verdict import CONSISTENT, KINDS, NEARLY, NOT_CONSISTENT, p_text

_NOTHING = "–"
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
    environment = page_environment(Path(__file__).parent, finalize=escape)
    entries = summary["estimators"]
    page = {
        "headline": headline(summary),
        "command": summary["command"] or python_call(summary),
        "described": "; ".join(_described(*entry) for entry in entries.items()),
        "files": _files(summary),
        "measures": measures(summary),
        "bad_run": _bad_run(summary),
        "figures": report_figures(dataset, summary),
        "good_runs": max(entry["good_runs"] for entry in entries.values()),
        "tested": grid_steps(summary),
    }
    environment.globals |= {
        "most_dots": MOST_DOTS,
        "few_averages": FEW_AVERAGES,
        "kinds": KINDS,
        "signs": {CONSISTENT: "✓", NEARLY: "≈", NOT_CONSISTENT: "✗"},
        "outcomes": {True: "accepted", False: "rejected", None: _NOTHING},
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
        said = "; ".join(
            f"{label} {word}" for label, word in zip(entries, words, strict=True)
        )
    else:
        said = f"{words.count(CONSISTENT)} of {len(words)} estimators consistent"
    return f"{summary['scenario']}: {said}"


def _bad_run(summary: dict[str, Any]) -> str:
    scores = [entry["association"] for entry in summary["estimators"].values()]
    return "" if None in scores else f" {bad_run_text(scores[0])}"


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
    return Markup(re.sub(r"([_,:=])|(?=\[)", r"\1<wbr>", str(escape(label))))


def _extreme(found: float | list[float]) -> float:
    """Return the ratio of the grid that is farthest from 1."""
    if isinstance(found, list):
        return max(found, key=lambda ratio: abs(ratio - 1))
    return found


def _p_value(p_value: float | None) -> str:
    if p_value is None:
        return _NOTHING
    return p_text(p_value).removeprefix("p ").removeprefix("= ")


def _interval(ends: Iterable[float | None]) -> str:
    """Write an interval of numbers >= 0; a dash where unknown."""
    known = [max(end, 0.0) for end in ends if end is not None]
    if len(known) < 2:
        return _NOTHING
    written = [f"{end:.3f}" if end < _LARGE else number(end) for end in known]
    return f"[{', '.join(written)}]"


def escape(value: object) -> Markup:
    """Write a value as HTML without line breaks before a % or inside an interval.

    Examples
    --------
    >>> print(escape("<b> at 5 %, [1, 2]"))
    &lt;b&gt; at 5&nbsp;%, [1,&nbsp;2]
    """
    if isinstance(value, Markup):
        return value
    safe = html.escape(str(value)).replace(" %", "&nbsp;%")
    return Markup(re.sub(r"(\[[\d.e+-]+,) ([\d.e+-]+\])", r"\1&nbsp;\2", safe))
