"""Write the report of a Monte Carlo as one web page without other files or network."""

import html
import re
from collections.abc import Iterable
from pathlib import Path
from string import Template
from typing import Any

import xarray as xr

from ....evaluation.consistency_report import FEW_AVERAGES
from ....sim_configs.atomic_file import replace_when_written
from ..reproduction import ASSUMED_FILE, python_call
from .figures import report_figures
from .inline_svg import inline_svg
from .table import measures, number, percent
from .verdict import CONSISTENT, KINDS, NEARLY, NOT_CONSISTENT, p_text

_TEMPLATE = Path(__file__).with_name("html_report.html")
_SIGNS = {CONSISTENT: "✓", NEARLY: "≈", NOT_CONSISTENT: "✗"}
_OPEN_SIGN = "?"
_NOTHING = "–"
_OUTCOMES = {True: "accepted", False: "rejected", None: _NOTHING}
_INSIDE = {CONSISTENT: "yes", NOT_CONSISTENT: "no, outside"}
_LARGE = 1e5  # written without three decimals
_FEW = 3  # estimators; a headline counts more of them
_DECISIONS = {
    "final_step": "Final step, χ²",
    "time_average": "Time averages, t",
    "bootstrap": "Time averages, bootstrap",
    "grid": "A grid of steps together, Holm",
    "nis": "NIS over all scans, χ²",
    "whiteness": "Whiteness of the NIS, Ljung-Box",
}


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
    template = Template(_TEMPLATE.read_text(encoding="utf-8"))
    entries = summary["estimators"]
    return template.substitute(
        title=escape(f"{headline(summary)} – slamgym Monte Carlo"),
        headline=escape(headline(summary)),
        facts=escape(
            f"{summary['runs']} runs of {summary['steps']} steps, seed "
            f"{summary['seed']}; the same worlds and readings for all estimators; "
            f"decisions in the {summary['frame']} error frame.{_assumption(summary)}"
        ),
        verdicts="\n".join(_verdict(*item) for item in entries.items()),
        numbers=_numbers(summary),
        decisions="\n".join(_decisions(*item) for item in entries.items()),
        figures=_figures(dataset, summary),
        failures=_failures(summary),
        reproduce=_reproduce(summary),
    )


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


def _assumption(summary: dict[str, Any]) -> str:
    if summary["assumed_toml"] is None:
        return ""
    return " The estimators assume other noise than the world has."


def _verdict(label: str, entry: dict[str, Any]) -> str:
    word = entry["verdict"]
    reason = entry["reason"]
    said = f"{reason[:1].upper()}{reason[1:]}. {entry['heading_sentence']}"
    warnings = "".join(
        f'<p class="warning">{escape(line)}</p>' for line in entry["warnings"]
    )
    return (
        f'<li class="{KINDS[word]}"><h3><span>{escape(label)}</span> '
        f"{_word(word)}</h3><p>{escape(said.strip())}</p>{warnings}</li>"
    )


def _word(word: str) -> str:
    sign = _SIGNS.get(word, _OPEN_SIGN)
    return (
        f'<span class="word"><span aria-hidden="true">{sign}</span> '
        f"{escape(word)}</span>"
    )


def _numbers(summary: dict[str, Any]) -> str:
    entries = summary["estimators"].values()
    heads = "".join(
        f'<th scope="col">{_breakable(label)}</th>' for label in summary["estimators"]
    )
    words = "".join(
        f'<td class="{KINDS[entry["verdict"]]}">{_word(entry["verdict"])}</td>'
        for entry in entries
    )
    rows = [f'<tr><th scope="row">verdict</th><td></td>{words}</tr>']
    for measure in measures(summary):
        cells = "".join(f"<td>{escape(measure.of(entry))}</td>" for entry in entries)
        rows.append(
            f'<tr><th scope="row">{escape(measure.name)}</th>'
            f'<td class="target">{escape(measure.right)}</td>{cells}</tr>'
        )
    return (
        '<table class="numbers"><thead><tr><td></td><th scope="col">should be</th>'
        f"{heads}</tr></thead><tbody>{_lines(rows)}</tbody></table>"
    )


def _breakable(label: str) -> str:
    """Allow line breaks in a long name after its punctuation."""
    return re.sub(r"([_,:=])|(?=\[)", r"\1<wbr>", escape(label))


def _decisions(label: str, entry: dict[str, Any]) -> str:
    found = entry["decisions"]
    if found is None:
        return ""
    rows = [_decision(title, found[key]) for key, title in _DECISIONS.items()]
    equivalence = found["equivalence"]
    needed = ", ".join(
        f"{factor}: {runs}" for factor, runs in found["runs_needed"].items()
    )
    margin = "[{:g},&nbsp;{:g}]".format(*equivalence["margin"])
    inside = _INSIDE.get(equivalence["verdict"], equivalence["verdict"])
    wrongly = percent(equivalence["error_rate"])
    return f"""<details><summary>The decisions on {escape(label)}</summary>
<div class="wide" role="region" aria-label="Decisions on {escape(label)}" tabindex="0">
<table><thead><tr><th class="text" scope="col">decision</th><th scope="col">found</th>
<th scope="col">accepted within</th><th scope="col">p</th><th scope="col">outcome</th>
<th scope="col">rejects wrongly in</th></tr></thead>
<tbody>{_lines(rows)}</tbody></table></div>
<p class="note">Final step, time averages and grid share the error rate: together they
reject where one has p&nbsp;&lt;&nbsp;0.0167; the time averages only from
{FEW_AVERAGES}&nbsp;runs on, the bootstrap, their check, never. Equivalence: the
90&nbsp;% interval of the ratio is {_interval(equivalence["interval"])}; inside
{margin}: {inside} (claims
consistency wrongly in at most {wrongly}). Runs that find covariances too small by a
factor in 90&nbsp;% of cases: {escape(needed)}.</p></details>"""


def _decision(title: str, decision: dict[str, Any]) -> str:
    found = decision["statistic"]
    if isinstance(found, list):
        found = max(found, key=lambda ratio: abs(ratio - 1))
    p_value = _NOTHING
    if decision["p_value"] is not None:
        p_value = p_text(decision["p_value"]).removeprefix("p ").removeprefix("= ")
    return (
        f'<tr><th scope="row">{escape(title)}</th><td>{number(found)}</td>'
        f"<td>{_interval(decision['interval'])}</td><td>{escape(p_value)}</td>"
        f"<td>{_OUTCOMES[decision['accepted']]}</td>"
        f"<td>{percent(decision['error_rate'])}</td></tr>"
    )


def _interval(ends: Iterable[float | None]) -> str:
    """Write an interval of numbers >= 0; a dash where unknown."""
    known = [max(end, 0.0) for end in ends if end is not None]
    if len(known) < 2:
        return _NOTHING
    written = [f"{end:.3f}" if end < _LARGE else number(end) for end in known]
    return f"[{',&nbsp;'.join(written)}]"


def _figures(dataset: xr.Dataset, summary: dict[str, Any]) -> str:
    shown = [
        f"<figure><figcaption><h3>{escape(part.title)}</h3>"
        f"<p>{escape(part.sentence)}</p></figcaption>\n"
        f"{inline_svg(part.figure, part.name, part.title)}</figure>"
        for part in report_figures(dataset, summary)
    ]
    if not shown:
        return "<p>No run went well, so there is nothing to draw.</p>"
    return f'<div class="figures">\n{_lines(shown)}\n</div>'


def _failures(summary: dict[str, Any]) -> str:
    rows = [
        f'<tr><td class="text">{escape(label)}</td><td>{failure["run"]}</td>'
        f"<td>{failure['step'] if failure['step'] >= 0 else '–'}</td>"
        f'<td class="message">{escape(failure["message"])}</td></tr>'
        for label, entry in summary["estimators"].items()
        for failure in entry["failed_runs"]
    ]
    if not rows:
        return ""
    return (
        "<section>\n<h2>Failed runs</h2>\n<p>No figure and no number counts them.</p>\n"
        '<div class="wide" role="region" aria-label="Failed runs" tabindex="0">'
        '<table><thead><tr><th class="text" scope="col">estimator</th>'
        '<th scope="col">run</th><th scope="col">step</th>'
        '<th class="text" scope="col">message</th></tr></thead>'
        f"<tbody>{_lines(rows)}</tbody></table></div>\n</section>"
    )


def _reproduce(summary: dict[str, Any]) -> str:
    command = summary["command"] or python_call(summary)
    versions = ", ".join(
        f"{name} {version}" for name, version in summary["versions"].items()
    )
    estimators = "; ".join(
        _described(label, entry) for label, entry in summary["estimators"].items()
    )
    facts = {
        "seed": f"{summary['seed']}; run i is the world of seed {summary['seed']} + i",
        "estimators": estimators,
        "versions": versions,
    }
    listed = "".join(
        f"<dt>{escape(name)}</dt><dd>{escape(text)}</dd>"
        for name, text in facts.items()
    )
    files = {f"The scenario, {summary['scenario']}.toml": summary["scenario_toml"]}
    if summary["assumed_toml"]:
        title = f"The scenario that the estimators assume, {ASSUMED_FILE}"
        files[title] = summary["assumed_toml"]
    folded = _lines(
        f"<details><summary>{escape(title)}</summary>\n"
        f'<pre tabindex="0"><code>{html.escape(text)}</code></pre></details>'
        for title, text in files.items()
    )
    return (
        '<pre class="command" tabindex="0"><code>'
        f"{html.escape(command)}</code></pre>\n<dl>{listed}</dl>\n{folded}"
    )


def _described(label: str, entry: dict[str, Any]) -> str:
    name, options = entry.get("name", label), entry.get("options") or {}
    told = ", ".join(f"{key} = {value}" for key, value in options.items())
    said = name if name == label else f"{label}: {name}"
    return f"{said} ({told})" if told else said


def escape(text: str) -> str:
    """Write a text as HTML without line breaks before a % or inside an interval.

    Examples
    --------
    >>> escape("<b> at 5 %, [1, 2]")
    '&lt;b&gt; at 5&nbsp;%, [1,&nbsp;2]'
    """
    safe = html.escape(text).replace(" %", "&nbsp;%")
    return re.sub(r"(\[[\d.e+-]+,) ([\d.e+-]+\])", r"\1&nbsp;\2", safe)


def _lines(parts: Iterable[str]) -> str:
    return "\n".join(parts)
