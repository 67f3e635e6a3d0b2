"""What nobody should miss: too few runs, and runs that failed, in a few sentences."""

import textwrap
from collections.abc import Iterable, Mapping
from typing import Any

from ....evaluation.consistency_report import FEW_RUNS
from .scores import FailedRun

_MOST_GROUPS = 3
_LETTERS = 160  # of a message


def failure_groups(failures: Iterable[FailedRun]) -> list[dict[str, Any]]:
    """Count the failures by what they say.

    Returns
    -------
    list of dict
        ``{count, message, run, step}`` with the first run of each message and the step
        at which it failed, -1 where unknown; the most frequent first.

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


def notes_of(entries: Mapping[str, Mapping[str, Any]], runs: int) -> list[str]:
    """Say how far the numbers of a Monte Carlo can be trusted.

    Parameters
    ----------
    entries : mapping
        By label, each with ``good_runs`` and ``failure_groups``.
    runs : int
        All runs.

    Returns
    -------
    list of str
        Sentences, each one line, without markup of their own; up to 3 different
        failures of an estimator are told.

    Examples
    --------
    >>> groups = [{"count": 2, "message": "boom", "run": 0, "step": 3}]
    >>> for note in notes_of({"ekf": {"good_runs": 3, "failure_groups": groups}}, 5):
    ...     print(note)
    ekf: 2 of 5 runs failed: 2 × boom (first: run 0, step 3).
    Only 5 runs: below 20 little can be shown.
    """
    failed = {label: _failed(label, entry, runs) for label, entry in entries.items()}
    found = [sentence for sentence in failed.values() if sentence]
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


def _failed(label: str, entry: Mapping[str, Any], runs: int) -> str:
    groups = entry["failure_groups"]
    if not groups:
        return ""
    told = [_group(group) for group in groups[:_MOST_GROUPS]]
    if len(groups) > _MOST_GROUPS:
        others = sum(group["count"] for group in groups[_MOST_GROUPS:])
        told.append(f"{others} × other messages")
    return f"{label}: {runs - entry['good_runs']} of {runs} runs failed: " + (
        "; ".join(told) + "."
    )


def _group(group: Mapping[str, Any]) -> str:
    message = textwrap.shorten(group["message"], _LETTERS, placeholder=" …")
    at = f", step {group['step']}" if group["step"] >= 0 else ""
    return f"{group['count']} × {message} (first: run {group['run']}{at})"
