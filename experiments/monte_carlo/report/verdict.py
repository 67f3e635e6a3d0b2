"""Reduce a consistency report to one word and one sentence."""

import math
from typing import NamedTuple

import numpy as np

from ....evaluation.consistency_report import FEW_AVERAGES, ConsistencyReport
from ....evaluation.hypothesis_tests import EQUIVALENCE_MARGIN

CONSISTENT = "consistent"
NEARLY = "nearly consistent"
NOT_CONSISTENT = "not consistent"
NOT_SHOWN = "not shown"
KINDS = {CONSISTENT: "good", NEARLY: "good", NOT_CONSISTENT: "bad", NOT_SHOWN: "open"}
"""Rating of each word, which chooses its colour."""

_ERROR_RATE = 0.05
_DECIDING = 3  # final step, time averages and grid share the error rate
_SMALLEST_P = 1e-16
_MARGIN = f"[{EQUIVALENCE_MARGIN.low:g}, {EQUIVALENCE_MARGIN.high:g}]"
_INSIDE = f"lies inside {_MARGIN}"
_TOO_SURE = 0.9
_NOT_REFUSED = "its errors agree with its covariances (5 %)"


class Verdict(NamedTuple):
    """One word and its reason."""

    word: str
    """"consistent": no test rejects, and the ratio is shown to be near 1;
    "nearly consistent": rejected, but shown to be near 1; "not consistent": rejected,
    which happens to a consistent filter in at most 5 % of cases; "not shown": neither,
    or some runs failed."""
    reason: str
    """Continues after the word, without a full stop."""


def judge(report: ConsistencyReport | None, failed: int, runs: int) -> Verdict:
    """Reduce a report to a verdict.

    Parameters
    ----------
    report : ConsistencyReport or None
        None if fewer than 2 runs succeeded, or no test could be done.
    failed, runs : int
        Numbers of failed runs and of all runs.
    """
    if report is None:
        reason = f"{runs - failed} of {runs} runs succeeded: too few to decide"
        return Verdict(NOT_SHOWN, reason)
    verdict = _verdict_on_successes(report)
    if not failed:
        return verdict
    word = verdict.word if verdict.word == NOT_CONSISTENT else NOT_SHOWN
    others = f"{failed} of {runs} runs failed; of the others, {verdict.reason}"
    return Verdict(word, others)


def verdict_sentence(label: str, verdict: Verdict) -> str:
    """Write a verdict as a sentence.

    Examples
    --------
    >>> verdict_sentence("ekf", Verdict("not shown", "1 run of 1 decides nothing"))
    'ekf: not shown: 1 run of 1 decides nothing.'
    """
    return f"{label}: {verdict.word}: {verdict.reason}."


def heading_sentence(claimed: float | None, knowable: float) -> str:
    """Write whether a filter claims to know its heading better than is possible.

    Parameters
    ----------
    claimed : float or None
        Standard deviation of the final heading according to the filter [rad].
    knowable : float
        That of the start, which is the lower bound [rad].

    Returns
    -------
    str
        Empty if it does not.

    Examples
    --------
    >>> heading_sentence(0.05, 0.1)
    'It claims to know its heading to 2.9° at the end, but the start was known to...
    >>> heading_sentence(0.12, 0.1)
    ''
    """
    if claimed is None or claimed >= _TOO_SURE * knowable:
        return ""
    return (
        f"It claims to know its heading to {in_degrees(claimed)} at the end, but the "
        f"start was known to {in_degrees(knowable)} only, which no reading can improve."
    )


def in_degrees(angle: float) -> str:
    """Write the size of an angle [rad] in degrees.

    Examples
    --------
    >>> in_degrees(0.1), in_degrees(1e-4), in_degrees(0.035)
    ('5.7°', '0.0057°', '2.0°')
    """
    degrees = abs(math.degrees(angle))
    size = math.floor(math.log10(degrees)) if degrees else 0
    return f"{degrees:.{min(max(1 - size, 0), 6)}f}°"


def p_text(p_value: float) -> str:
    """Write a p-value with two digits.

    Examples
    --------
    >>> p_text(0.0), p_text(0.0123)
    ('p < 1e-16', 'p = 0.012')
    """
    small = p_value < _SMALLEST_P
    return f"p < {_SMALLEST_P:g}" if small else f"p = {p_value:.2g}"


def _verdict_on_successes(report: ConsistencyReport) -> Verdict:
    """Return the verdict on the successful runs."""
    verdict = report.equivalence
    low, high = max(verdict.interval[0], 0.0), verdict.interval[1]  # of a ratio >= 0
    interval = f"the 90 % interval of the ratio, [{low:.3f}, {high:.3f}]"
    refusal = _refusal(report)
    if refusal and _is_near_everywhere(report):
        return Verdict(
            NEARLY, f"{refusal}, which is certain but small: {interval}, {_INSIDE}"
        )
    if refusal:
        return Verdict(NOT_CONSISTENT, refusal + _outliers(report))
    if verdict.accepted:
        return Verdict(CONSISTENT, f"{_NOT_REFUSED}, and {interval}, {_INSIDE}")
    if verdict.verdict == NOT_CONSISTENT:  # rejects in up to 10 %: not enough
        kept = "no test rejects it (5 %), but"
        lies = f"{interval}, lies outside {_MARGIN}"
    else:
        kept, lies = f"{_NOT_REFUSED}, but", f"{interval}, is not inside {_MARGIN}"
    needed = _runs_needed(report)
    many = f", about {needed:,} in total if its ratio is 1" if needed else ""
    return Verdict(NOT_SHOWN, f"{kept} {lies}: more runs are needed{many}")


def _runs_needed(report: ConsistencyReport) -> int:
    """Return with how many runs a filter of ratio 1 is accepted in 90 % of cases.

    Its 90 % interval must then be about half as wide as the margin.  Its width is in
    proportion to the ratio, and to one over the square root of the number of runs.  0
    if there are too few runs now.
    """
    ratio, (low, high) = report.equivalence.statistic, report.equivalence.interval
    runs = report.runs - len(report.failed_runs)
    if runs < FEW_AVERAGES:
        return 0
    least, most = EQUIVALENCE_MARGIN
    below, above = 1 - low / ratio, high / ratio - 1
    width = max(below / (1 - least), above / (most - 1))
    needed = max(runs * (2 * width) ** 2, runs + 1)
    digit: float = 10.0 ** (math.floor(math.log10(needed)) - 1)
    return int(math.ceil(needed / digit) * digit)


def _refusal(report: ConsistencyReport) -> str:
    """Write how wrong the filter is, if final step, averages or grid reject it."""
    final, average, grid = report.final_step, report.time_average, report.family
    p_value = min(final.p_value, report.average_p_value)
    ratios = [final.statistic, average.statistic]
    claims = "what its covariances claim"
    amounts = "{} times {} at the end, {} times over all steps"
    if p_value * _DECIDING < _ERROR_RATE:
        what = amounts.format(_number(ratios[0]), claims, _number(ratios[1]))
    elif grid.p_value * _DECIDING < _ERROR_RATE:
        worst = int(abs(np.log(grid.statistic[grid.rejected])).argmax())
        step = int(report.family_steps[grid.rejected][worst]) + 1  # it knows no step 0
        ratios, p_value = [float(grid.statistic[grid.rejected][worst])], grid.p_value
        what = f"{_number(ratios[0])} times {claims} at step {step}"
    else:
        return ""
    cautious = ": it is too cautious" if max(ratios) < 1 else ""
    return f"its squared errors are {what} ({p_text(p_value)}){cautious}"


def _is_near_everywhere(report: ConsistencyReport) -> bool:
    low, high = EQUIVALENCE_MARGIN
    ratios = (report.final_step.statistic, *report.family.statistic)
    return report.equivalence.accepted and all(low <= r <= high for r in ratios)


def _outliers(report: ConsistencyReport) -> str:
    """Point out that a few runs dominate the average."""
    most = EQUIVALENCE_MARGIN.high
    if not report.median_ratio <= most < report.mean_ratio:
        return ""
    return (
        f"; few runs make this average: the median is {report.median_ratio:.2f}, "
        f"{report.share_above_3:.1%} of the runs are above 3"
    )


def _number(ratio: float) -> str:
    return f"{ratio:.3g}" if ratio < 1e6 else f"{ratio:.0e}"
