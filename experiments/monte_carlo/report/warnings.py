"""Warnings about the results of a Monte Carlo: too few runs, and failed runs."""

import textwrap
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from ....evaluation.consistency_report import FEW_RUNS
from ...runs.run_warnings import MOST_REJECTED, NIS_RANGE, nis_suspicion
from .scores import FailedRun

LARGE_MAP = 1.2
"""Ratio of map sizes above which a map is split."""

_MOST_GROUPS = 3
_LETTERS = 160  # of a message


def failure_groups(failures: Iterable[FailedRun]) -> list[dict[str, Any]]:
    """Group failures by their message.

    Returns
    -------
    list of dict
        ``{count, message, run, step}``, the most frequent first, with the first run of
        each message and the step at which it failed, -1 where unknown.

    Examples
    --------
    >>> failure_groups([FailedRun(0, 3, "boom"), FailedRun(4, 7, "boom")])
    [{'count': 2, 'message': 'boom', 'run': 0, 'step': 3}]
    """
    groups: dict[str, dict[str, Any]] = {}
    for run, step, message in failures:
        new = {"count": 0, "message": message, "run": run, "step": step}
        groups.setdefault(message, new)["count"] += 1
    return sorted(groups.values(), key=lambda group: -int(group["count"]))


def run_warnings(entries: Mapping[str, Mapping[str, Any]], runs: int) -> list[str]:
    """List why the numbers of a Monte Carlo should be used with caution.

    Parameters
    ----------
    entries : mapping
        By label, each with ``good_runs`` and ``failure_groups``, and perhaps ``nis``,
        ``unused_readings`` and ``association``.
    runs : int
        Number of all runs.

    Returns
    -------
    list of str
        Sentences of one line without markup; they name up to 3 different failures per
        estimator.

    Examples
    --------
    >>> groups = [{"count": 2, "message": "boom", "run": 0, "step": 3}]
    >>> entry = {"good_runs": 3, "failure_groups": groups}
    >>> for line in run_warnings({"ekf": entry}, 5):
    ...     print(line)
    ekf: 2 of 5 runs failed: 2 × boom (first: run 0, step 3).
    Only 5 runs: below 20 little can be shown.
    """
    failed = {label: _failed(label, entry, runs) for label, entry in entries.items()}
    found = [sentence for sentence in failed.values() if sentence]
    for label, entry in entries.items():
        found += [f"{label}: {text}" for text in _suspicions(entry) if text]
    if runs < FEW_RUNS:
        found.append(f"Only {runs} runs: below {FEW_RUNS} little can be shown.")
        return found
    for label, entry in entries.items():
        if entry["good_runs"] < FEW_RUNS:
            found.append(
                f"{label}: only {entry['good_runs']} runs did not fail: below "
                f"{FEW_RUNS} little can be shown."
            )
    return found


def _suspicions(entry: Mapping[str, Any]) -> Iterator[str]:
    """Yield suspicions from the numbers of an estimator, empty for none."""
    unused, nis = entry.get("unused_readings") or 0.0, entry.get("nis")
    is_managed = "management" in entry.get("options", {})  # it may leave readings out
    if unused > MOST_REJECTED and not is_managed and nis is None:
        yield "its reports list no reading that corrected the belief: it has no NIS."
    elif unused > MOST_REJECTED and not is_managed:
        yield (
            f"{unused:.0%} of the readings corrected nothing, rejected by a gate or "
            "too near: the filter may diverge."
        )
    if nis is not None and not NIS_RANGE[0] <= nis <= NIS_RANGE[1]:
        associates = is_managed or bool(entry.get("association"))
        yield f"the {nis_suspicion(nis, associates=associates)}"
    yield from _split_map(entry.get("association") or {})


def _split_map(scores: Mapping[str, float | None]) -> Iterator[str]:
    size, true_size = scores.get("map_size"), scores.get("true_map_size")
    if size and true_size and size > LARGE_MAP * true_size:
        yield (
            f"the map has {size:.1f} landmarks on average, but {true_size:.1f} were "
            "seen: it is split."
        )


def _failed(label: str, entry: Mapping[str, Any], runs: int) -> str:
    groups = entry["failure_groups"]
    if not groups:
        return ""
    named = [_group(group) for group in groups[:_MOST_GROUPS]]
    if len(groups) > _MOST_GROUPS:
        others = sum(group["count"] for group in groups[_MOST_GROUPS:])
        named.append(f"{others} × other messages")
    return f"{label}: {runs - entry['good_runs']} of {runs} runs failed: " + (
        "; ".join(named) + "."
    )


def _group(group: Mapping[str, Any]) -> str:
    message = textwrap.shorten(group["message"], _LETTERS, placeholder=" …")
    at = f", step {group['step']}" if group["step"] >= 0 else ""
    return f"{group['count']} × {message} (first: run {group['run']}{at})"
