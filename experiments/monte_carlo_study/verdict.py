"""Reduce a consistency report to one word and one sentence: `verdict_of_report`.

Warnings about the results, and the cause of an inconsistency, are entries of the
summary and sentences. `scores_of` selects the results that count.
"""

from __future__ import annotations

import functools
import json
import math
import operator
import re
import textwrap
import tomllib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ...argument_checks import one_of
from ...arrays import AnyArray, Array, BoolArray, IntArray
from ...estimator.models.rigid_motion import ERROR_FRAMES, ErrorFrame
from ...estimator.models.sensors import DELAYED
from ...evaluation.consistency_report import (
    FEW_AVERAGES,
    FEW_RUNS,
    ConsistencyReport,
    evaluate_in_parts,
    few_runs,
)
from ...evaluation.diagnosis import (
    CANNOT_TELL,
    FEWEST_RUNS,
    HONEST,
    Diagnosis,
    SmallNoise,
    diagnose,
    diverged_runs,
    p_text,
)
from ...evaluation.hypothesis_tests import EQUIVALENCE_MARGIN, EquivalenceTest
from ...evaluation.map_consistency import BIAS_MARGIN, TESTS, MapReport, map_test
from ...evaluation.map_consistency import ERROR_RATE as MAP_ERROR_RATE
from ...suggestions import counted
from ..run_and_replay.summary import (
    MOST_REJECTED,
    NIS_RANGE,
    coarse_suspicion,
    nis_suspicion,
)
from ..run_and_replay.trace import finite
from .run_measures import (
    DEVIATIONS,
    KNOWN_IDS_ATE,
    KNOWN_IDS_NEES,
    LARGER,
    LARGEST_SCORE,
    PREFIX,
    SMALL_NOISE,
    first_step,
    gaps,
)

if TYPE_CHECKING:
    import xarray as xr

CONSISTENT = "consistent"
NEARLY = "nearly consistent"
NOT_CONSISTENT = "not consistent"
NOT_SHOWN = "not shown"
#: Rating of each word, which chooses its colour.
KINDS = {CONSISTENT: "good", NEARLY: "good", NOT_CONSISTENT: "bad", NOT_SHOWN: "open"}

#: Follows a verdict where no map is judged.
POSE_ONLY = "this covers the pose only"

_MARGIN = f"[{EQUIVALENCE_MARGIN.low:g}, {EQUIVALENCE_MARGIN.high:g}]"
_INSIDE = f"lies inside {_MARGIN}"
_TOO_SURE = 0.9
_CERTAIN = 1e-12  # p-value below which others add nothing
_FEW = 0.1  # share of the runs that may make an average
_BOOTSTRAP_SEED = 0  # the same for each estimator, independent of the others
_NOT_REFUSED = "the errors of the pose agree with the covariances (5 %)"


class Verdict(NamedTuple):
    """One word and its reason."""

    #: "consistent": no test rejects, and the ratio is shown to be near 1; "nearly
    #: consistent": rejected, but shown to be near 1; "not consistent": rejected, which
    #: happens to a consistent filter in at most 5 % of cases; "not shown": neither, or
    #: some runs failed.
    word: str
    #: Continues after the word, without a full stop.
    reason: str
    #: Whether tests reject the map alone.
    by_map: bool = False


#: In place of a verdict on estimates that are aligned.
FITTED = Verdict(
    NOT_SHOWN,
    "each path is aligned with its truth, and an alignment fitted to the errors "
    "makes them smaller: their NEES is not χ²",
)


def verdict_of_report(
    report: ConsistencyReport | None, failed: int, runs: int
) -> Verdict:
    """Reduce a report to a verdict.

    Parameters
    ----------
    report : ConsistencyReport or None
        None if fewer than 2 runs succeeded, or no test could be done.
    failed, runs : int
        Numbers of failed runs and of all runs.
    """
    if report is None:
        good = f"{runs - failed} of {counted(runs, 'run')} succeeded"
        reason = f"{good}: too few to decide"
        return Verdict(NOT_SHOWN, reason)
    return with_failures(_verdict_on_successes(report), failed, runs)


def with_failures(verdict: Verdict, failed: int, runs: int) -> Verdict:
    """Turn a verdict on the runs that succeeded into one on all runs."""
    if not failed:
        return verdict
    word = verdict.word if verdict.word == NOT_CONSISTENT else NOT_SHOWN
    reason = (
        f"{failed} of {counted(runs, 'run')} failed; of the others, {verdict.reason}"
    )
    return verdict._replace(word=word, reason=reason)


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


def _verdict_on_successes(report: ConsistencyReport) -> Verdict:
    """Return the verdict on the successful runs: that on the pose, then on the map."""
    pose, maps = _verdict_on_poses(report), report.map
    if maps is None:
        return pose._replace(reason=f"{pose.reason}; {POSE_ONLY}")
    if not maps.accepted:
        agree = pose.word != NOT_CONSISTENT
        join = f"{_NOT_REFUSED}, but those of the map do not: " if agree else ""
        if pose.word == NEARLY or not agree:
            join = f"{pose.reason}; of the map, "
        return Verdict(NOT_CONSISTENT, join + map_refusal(maps), agree)
    if pose.word in (NOT_CONSISTENT, NOT_SHOWN):
        return pose
    if maps.shown:
        low, high = maps.equivalence.interval
        both = f"that of the map, [{low:.3f}, {high:.3f}]"
        return Verdict(pose.word, f"{pose.reason}, as does {both}")
    return Verdict(NOT_SHOWN, f"{pose.reason}; {map_not_shown(maps)}")


def map_not_shown(maps: MapReport) -> str:
    """Write why a map that no test rejects is not shown to be consistent."""
    if maps.undefined:
        singular = "its covariance is singular or no covariance"
        runs = counted(maps.undefined, "run")
        return f"the map has no NEES at the end of {runs}: {singular}"
    low, high = maps.equivalence.interval
    needed = _runs_needed(maps.equivalence, maps.runs)
    many = f", about {needed:,} in total if its ratio is 1" if needed else ""
    return (
        "no test rejects the map, but the 90 % interval of its ratio, "
        f"[{low:.3f}, {high:.3f}], is not inside {_MARGIN}: more runs are needed{many}"
    )


def map_refusal(maps: MapReport, evidence: str = "") -> str:
    """Write how wrong a rejected map is, by the test that shows it best.

    By default, the evidence is the p-value of this test.
    """
    evidence, ratio = evidence or p_text(maps.p_value), maps.equivalence.statistic
    if maps.indefinite:
        return f"its covariance has a negative eigenvalue in {_of_runs(maps)}"
    each = np.append(maps.landmark_p_values, 1.0)
    if maps.joint_p_value <= max(each.min(), _CERTAIN):
        cautious = ": the map is too cautious" if ratio < 1 else ""
        times = f"{_number(ratio)} times what the covariances state"
        return f"the squared errors are {times} ({evidence}){cautious}"
    worst = int(each.argmin())
    name, many = maps.landmarks[worst], np.count_nonzero(TESTS * each < MAP_ERROR_RATE)
    others = f", the worst of {many} landmarks" if many > 1 else ""
    if each[worst] == maps.mean_p_values[worst]:
        size = np.hypot(*maps.means[worst])
        what = f"landmark {name} is off by {size:.2f} deviations on average"
    else:
        from_robot = each[worst] == maps.p_values[worst]
        ratios = maps.ratios if from_robot else maps.map_ratios
        seen = "seen from the robot" if from_robot else "in the frame of the map"
        what = (
            f"the squared errors of landmark {name} {seen} are "
            f"{_number(ratios[worst])} times what its covariances state"
        )
    return f"{what}{others} ({evidence})"


def _verdict_on_poses(report: ConsistencyReport) -> Verdict:
    verdict = report.equivalence
    low, high = verdict.interval
    interval = f"the 90 % interval of the ratio, [{low:.3f}, {high:.3f}]"
    refusal = _refusal(report)
    if refusal and _is_near_everywhere(report):
        small = f"which is certain but small: {interval}, {_INSIDE}"
        return Verdict(NEARLY, f"{refusal}, {small}")
    if refusal:
        return Verdict(NOT_CONSISTENT, refusal + _outliers(report))
    if verdict.accepted:
        return Verdict(CONSISTENT, f"{_NOT_REFUSED}, and {interval}, {_INSIDE}")
    if verdict.verdict == NOT_CONSISTENT:  # rejects in up to 10 %: not enough
        kept = "no test rejects it (5 %), but"
        lies = f"{interval}, lies outside {_MARGIN}"
    else:
        kept, lies = f"{_NOT_REFUSED}, but", f"{interval}, is not inside {_MARGIN}"
    needed = _runs_needed(verdict, report.used_runs)
    many = f", about {needed:,} in total if its ratio is 1" if needed else ""
    return Verdict(NOT_SHOWN, f"{kept} {lies}: more runs are needed{many}")


def _runs_needed(verdict: EquivalenceTest, runs: int) -> int:
    """Return with how many runs a filter of ratio 1 is accepted in 90 % of cases.

    Its 90 % interval must then be about half as wide as the margin.  Its width is in
    proportion to the ratio, and to one over the square root of the number of runs.  0
    if there are too few runs now.
    """
    ratio, (low, high) = verdict.statistic, verdict.interval
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
    claims = "what the covariances state"
    amounts = "{} times {} at the end, {} times over all steps"
    if p_value < report.deciding_rate:
        what = amounts.format(_number(ratios[0]), claims, _number(ratios[1]))
    elif grid.p_value < report.deciding_rate:
        worst = int(abs(np.log(grid.statistic[grid.rejected])).argmax())
        step = int(report.family_steps[grid.rejected][worst]) + 1  # it knows no step 0
        ratios, p_value = [float(grid.statistic[grid.rejected][worst])], grid.p_value
        what = f"{_number(ratios[0])} times {claims} at step {step}"
    else:
        return ""
    cautious = ": the filter is too cautious" if max(ratios) < 1 else ""
    return f"the squared errors of the pose are {what} ({p_text(p_value)}){cautious}"


def squared_errors(report: ConsistencyReport) -> str:
    """Write the ratios at the end, over all steps, and at the worst step of the grid.

    The errors of a filter that is rejected may be wrong at some steps only.
    """
    ratios = report.final_step.statistic, report.time_average.statistic
    end, average = map(_number, ratios)
    worst = int(abs(np.log(np.maximum(report.family.statistic, 1e-300))).argmax())
    step, ratio = report.family_steps[worst] + 1, float(report.family.statistic[worst])
    cautious = ": the filter is too cautious" if max(*ratios, ratio) < 1 else ""
    amounts = f"{end} times what the covariances state at the end"
    if step < report.family_steps[-1] + 1:
        amounts += f", {_number(ratio)} times at step {step}"
    return (
        f"the squared errors of the pose are {amounts} and {average} times over all "
        f"steps{cautious}"
    )


def _is_near_everywhere(report: ConsistencyReport) -> bool:
    low, high = EQUIVALENCE_MARGIN
    ratios = (report.final_step.statistic, *report.family.statistic)
    return report.equivalence.accepted and all(low <= r <= high for r in ratios)


def _outliers(report: ConsistencyReport) -> str:
    """Point out that a few runs make the average."""
    few, runs = report.deciding_runs, report.used_runs
    if not 0 < few <= _FEW * runs:
        return ""
    make, them = ("makes", "it") if few == 1 else ("make", "them")
    return (
        f"; {few} of {runs} runs {make} this average: without {them}, it is "
        f"{report.ratio_of_others:.2f}"
    )


def _number(ratio: float) -> str:
    return f"{ratio:.3g}" if ratio < 1e6 else f"{ratio:.0e}"


# --------------------------------------------------------------------------------------
# Warnings about the results of a Monte Carlo: too few runs, and failed runs.

#: Ratio of map sizes above which a map is split.
LARGE_MAP = 1.2

_MOST_GROUPS = 3
_MOST_SEEDS = 5
_LETTERS = 240  # of a message


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
        groups.setdefault(_kind(message), new)["count"] += 1
    return sorted(groups.values(), key=lambda group: -int(group["count"]))


def _kind(message: str) -> str:
    """Return a message about a covariance without its numbers, and others as is."""
    if not message.startswith("the covariance of the pose "):
        return message
    return re.sub(r"-?\d[\d.]*(e[+-]\d+)?", "", message.partition(";")[0])


def coarse_bearings(scenario: str, entries: Mapping[str, Mapping[str, Any]]) -> str:
    """Write whether bearings are too coarse for filters, at the maximum range.

    Parameters
    ----------
    scenario : str
        The TOML text of the world.
    entries : mapping
        By label, each with ``verdict``, and ``options`` where known.

    Returns
    -------
    str
        See `coarse_suspicion`. Empty if no filter that places landmarks by one reading
        is rejected, or if the sensor has no maximum range.

    Examples
    --------
    >>> world = "sensor = {std = [0.3, 0.1], max_range = 5.0}"
    >>> coarse_bearings(world, {"ekf": {"verdict": "not consistent"}})
    'A bearing error of σβ = 0.3 rad moves a reading at 5 m by 0.225 m off its ...
    >>> coarse_bearings(world, {"ekf": {"verdict": "consistent"}})
    ''
    """
    sensor = tomllib.loads(scenario).get("sensor", {})
    farthest = float(sensor.get("max_range", math.inf))
    refused = any(
        entry.get("verdict") == NOT_CONSISTENT
        and (entry.get("options") or {}).get("landmark_init") != DELAYED
        for entry in entries.values()
    )
    has_both = sensor.get("kind", "bearing_range") == "bearing_range"
    if not refused or not has_both or math.isinf(farthest) or "std" not in sensor:
        return ""
    bearing, fixed = map(float, sensor["std"])
    range_std = fixed + farthest * float(sensor.get("range_std_per_metre", 0.0))
    return coarse_suspicion(bearing, range_std, farthest)


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
    Only 5 runs: at least 20 are needed to find more than large errors.
    """
    failed = {label: _failed(label, entry, runs) for label, entry in entries.items()}
    found = [sentence for sentence in failed.values() if sentence]
    for label, entry in entries.items():
        found += [f"{label}: {text}" for text in _suspicions(entry) if text]
    if runs < FEW_RUNS:
        return [*found, few_runs(runs)]
    for label, entry in entries.items():
        if (good := entry["good_runs"]) < FEW_RUNS:
            some = f"only {counted(good, 'run')}" if good else "no run"
            found.append(f"{label}: {some} succeeded; at least {FEW_RUNS} are needed.")
    return found


def _suspicions(entry: Mapping[str, Any]) -> Iterator[str]:
    """Yield suspicions from the numbers of an estimator, empty for none."""
    unused, nis = entry.get("unused_readings") or 0.0, entry.get("nis")
    is_managed = "management" in entry.get("options", {})  # it may leave readings out
    if unused > MOST_REJECTED and not is_managed and nis is None:
        yield "its reports list no reading that corrected the belief: it has no NIS."
    elif unused > MOST_REJECTED and not is_managed:
        yield (
            f"{100 * unused:.0f} % of the readings corrected nothing, rejected by a "
            "gate or too near: the filter may diverge."
        )
    if nis is not None and not NIS_RANGE[0] <= nis <= NIS_RANGE[1]:
        associates = is_managed or bool(entry.get("association"))
        if entry.get("verdict") == CONSISTENT:
            yield (
                f"its NIS is {nis:.3g} per degree of freedom, where 1 is expected, but "
                "its errors agree with its covariances: the NIS may be that of "
                "readings far from linear, or reported wrongly."
            )
        else:
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
    named = []
    for group in groups[:_MOST_GROUPS]:
        message = textwrap.shorten(group["message"], _LETTERS, placeholder=" …")
        at = f", step {group['step']}" if group["step"] >= 0 else ""
        named.append(f"{group['count']} × {message} (first: run {group['run']}{at})")
    if len(groups) > _MOST_GROUPS:
        others = sum(group["count"] for group in groups[_MOST_GROUPS:])
        named.append(f"{others} × other messages")
    failed = runs - entry["good_runs"]
    return f"{label}: {failed} of {counted(runs, 'run')} failed: {'; '.join(named)}."


# --------------------------------------------------------------------------------------
# The cause of an inconsistency, as an entry of the summary and as a sentence.

#: The cause for estimates in another convention than their files should have.
CONVENTION = "convention"
#: The cause where the map alone is rejected.
MAP = "map"
_WRONGLY = "; the filter computes or reports these covariances wrongly"
_MOSTLY = 0.5  # share of the squared errors that an offset makes
_NEARLY = 1.5  # ratio of a landmark that agrees, beside others that do not
_ALIKE = 2.0  # largest by smallest ratio of landmarks with one scale
_MISTAKES = ("wrong", "duplicate", "ghost", "clutter_used")


def diagnosis_summary(
    scores: EstimatorScores,
    frame: ErrorFrame,
    verdict: Verdict,
    maps: MapReport | None = None,
) -> dict[str, Any] | None:
    """Name the cause for which an estimator is not consistent.

    Returns
    -------
    dict or None
        ``cause``, one of :data:`slamgym.evaluation.CAUSES`, its ``p``, a ``sentence``,
        and ``others``, further causes; see :func:`slamgym.evaluation.diagnose`. The
        cause is "convention" for estimates that break one, and "map" if the map alone
        is rejected. None for results without
        noise, and for estimates that are fitted to the truth.
    """
    mistakes = json.loads(scores.results.attrs.get("mistakes", "{}"))
    if mistake := mistakes.get(scores.label):
        sentence = f"{CONVENTION}: {mistake}"
        return {"cause": CONVENTION, "p": None, "sentence": sentence, "others": []}
    if "noise_sums" not in scores.results or scores.is_fitted:
        return None
    found = diagnosis_of(scores, frame, verdict)
    entry = {
        "cause": found.cause,
        "p": finite(found.p_value),
        "sentence": found.sentence,
        "others": list(found.others),
    }
    if maps is None or (maps.accepted and not verdict.by_map):
        return entry
    named = f"{MAP}: {_map_cause(maps)}"
    if verdict.by_map and found.cause in (HONEST, CANNOT_TELL):
        return {"cause": MAP, "p": maps.p_value, "sentence": named, "others": []}
    return entry  # errors of the pose make those of the map


def _map_cause(maps: MapReport) -> str:
    """Write what is wrong about the covariances or the positions of a rejected map."""
    whole = f"those of the whole map {_number(maps.equivalence.statistic)} times"
    if maps.indefinite:
        return f"the covariance has a negative eigenvalue in {_of_runs(maps)}."
    if not len(maps.ratios):
        return f"of the squared errors, {whole} what the covariances state."
    alone = maps.ratios if np.isnan(maps.map_ratios).any() else maps.map_ratios
    lone = maps.landmark_p_values * TESTS < MAP_ERROR_RATE
    if not 0 < 3 * lone.sum() <= len(lone):
        return _common_cause(maps, alone, whole)
    names = ", ".join(map(str, maps.landmarks[lone]))
    few = "one landmark" if lone.sum() == 1 else "some landmarks"
    sizes = np.hypot(*maps.means[lone].T)
    return (
        f"{few}: the squared errors of {names} are {_range(alone[lone])} times what "
        f"the covariances state, with a mean error of {_range(sizes)} deviations; "
        f"those of the other {len(lone) - lone.sum()} are {_range(alone[~lone])} times."
    )


def _common_cause(maps: MapReport, alone: Array, whole: str) -> str:
    """Write what is wrong about a map as a whole, or that nothing single is."""
    low, high = EQUIVALENCE_MARGIN
    ratios, sizes = maps.ratios, np.hypot(*maps.means.T)
    share = float(np.median(sizes**2 / 2 / ratios))
    if sizes.min() > BIAS_MARGIN and share > _MOSTLY:
        return (
            f"offset: the landmarks are off by {_range(sizes)} deviations on average, "
            f"which makes {100 * share:.0f} % of their squared errors (median "
            "landmark)."
        )
    if alone.max() <= _ALIKE * alone.min() and not low < np.median(alone) < high:
        size = "large" if np.median(alone) < 1 else "small"
        return (
            f"scale: the covariances are too {size}; the squared errors of the "
            f"landmarks are {_range(alone)} times what they state, {whole}{_WRONGLY}."
        )
    agree = f"the squared errors of each landmark are {_range(alone)} times what"
    if alone.min() <= 1 / _NEARLY or alone.max() >= _NEARLY:
        return (
            f"{agree} the covariances state, {whole}: no single scale, offset or "
            "landmark explains this."
        )
    if low <= ratios.min() and ratios.max() <= high:
        between = "covariances between the landmarks"
        return f"{between}: {agree} they state, {whole}{_WRONGLY}."
    from_robot = f"seen from the robot, they are {_range(ratios)} times"
    between = "covariances between pose and map"
    return f"{between}: {agree} they state, but {from_robot}{_WRONGLY}."


def _of_runs(maps: MapReport) -> str:
    return f"{maps.indefinite} of {counted(maps.all_runs, 'run')}"


def _range(values: Array) -> str:
    """Write the smallest and the largest of some numbers."""
    least, most = _number(values.min()), _number(values.max())
    return least if least == most else f"{least} to {most}"


def names_cause(entry: Mapping[str, Any]) -> bool:
    """Whether the diagnosis in an entry of the summary names a problem.

    "cannot tell" names none if no test rejects the errors and no run has failed.
    """
    found = entry.get("diagnosis")
    if found is None or found["cause"] == HONEST:
        return False
    nothing = entry.get("verdict") == NOT_SHOWN and not entry.get("failed_runs")
    return not (nothing and found["cause"] == CANNOT_TELL)


def diagnosis_lines(label: str, entry: Mapping[str, Any]) -> tuple[str, ...]:
    """Write the cause in an entry of the summary, and what helps to find it, as lines.

    These are findings of `check_estimator` and seeds to look at.

    Examples
    --------
    >>> found = {"cause": "clutter", "sentence": "clutter: it is used."}
    >>> diagnosis_lines("ekf", {"diagnosis": found})
    ('ekf: cause: clutter: it is used.',)
    """
    found, lines = entry.get("diagnosis"), []
    if found is not None and names_cause(entry):
        word = "note" if entry.get("verdict") == CONSISTENT else "cause"
        lines.append(f"{word}: {found['sentence']}")
    lines += [f"check_estimator finds: {text}" for text in entry.get("check", ())]
    if seeds := entry.get("seeds_sentence"):
        lines.append(seeds)
    return tuple(f"{label}: {line}" for line in lines)


def seeds_sentence(scores: EstimatorScores, frame: ErrorFrame, errors: Array) -> str:
    """Name up to five failed, bad or diverged runs by seeds or files; "" for none.

    Parameters
    ----------
    scores : EstimatorScores
        Results of the estimator.
    frame : {"invariant", "additive"}
        Error coordinates of the NEES.
    errors : ndarray, shape (M,)
        Path error of each bad run [m], 0 of the others.
    """
    nees = POSE_FREEDOM * scores.ratios(frame)
    diverged = nees * (diverged_runs(nees[:, None]) & (not scores.is_fitted))
    worst = np.lexsort((-diverged, -errors))[: np.count_nonzero(errors + diverged)]
    rows = [*np.flatnonzero(~scores.good), *np.flatnonzero(scores.good)[worst]]
    if not rows:
        return ""
    kind, names = "drives", scores.results["run"].values
    if names.dtype.kind == "i":
        kind, names = "seeds", names + int(scores.results.attrs["seed"])
    others = len(rows) - _MOST_SEEDS
    more = f" and {others} more" if others > 0 else ""
    named = ", ".join(map(str, names[rows[:_MOST_SEEDS]]))
    return f"failed, bad or diverged runs, the worst first: {kind} {named}{more}."


def diagnosis_of(
    scores: EstimatorScores, frame: ErrorFrame, verdict: Verdict
) -> Diagnosis:
    """Diagnose the runs that succeeded; the noise of all runs counts.

    The answer is "honest" only if the verdict is "consistent".
    """
    found = diagnose(
        scores.per_run("noise_sums"),
        scores.time_averages(f"pose_nees_{frame}")[:, None],
        scores.time_averages("heading_nees")[:, None],
        nis_ratio=scores.nis_per_degree,
        heading_knowledge=_heading_knowledge(scores),
        mistakes=_mistakes(scores),
        known_nees=_known_nees(scores, frame),
        small_noise=_small_noise(scores, frame),
        rejected=verdict.word == NOT_CONSISTENT and not verdict.by_map,
    )
    if found.cause != HONEST or verdict.word == CONSISTENT:
        return found
    failed, runs = len(scores.failures), len(scores.good)
    why = "no test shows a cause so far, and more runs are needed"
    if failed:
        why = f"{failed} of {runs} runs failed; the others are honest"
    elif verdict.word == NEARLY:
        why = "the errors differ too little from the covariances to show a cause"
    return Diagnosis(CANNOT_TELL, found.p_value, f"cannot tell: {why}.")


def _small_noise(scores: EstimatorScores, frame: ErrorFrame) -> SmallNoise | None:
    """Return the errors of the runs that were repeated with less noise, if any."""
    found = None
    for prefix in (LARGER, ""):
        name = f"{prefix}small_noise_nees_{frame}"
        if name in scores.results and not np.isnan(scores.per_run(name)).all():
            factor = float(np.nanmin(scores.per_run(f"{prefix}small_noise_factor")))
            heading = scores.per_run(f"{prefix}small_noise_heading_nees")
            distance = f"{prefix}small_noise_position_error"
            known = distance in scores.results  # not in results of before
            errors = scores.per_run(distance) if known else None
            found = SmallNoise(scores.per_run(name), heading, factor, found, errors)
    return found


def runs_to_repeat(scores: EstimatorScores, verdict: Verdict) -> int:
    """Return how many of all runs to repeat with less noise, 0 if that shows nothing.

    See :class:`~slamgym.evaluation.diagnosis.Diagnosis`.
    """
    if scores.good.sum() < FEWEST_RUNS:
        return 0
    count = diagnosis_of(scores, "invariant", verdict).repeat
    return int(np.flatnonzero(scores.good)[count - 1]) + 1 if count else 0


def averages_of(scores: EstimatorScores) -> dict[str, Array]:
    """Average NEES over the steps of each run, nan for runs that failed.

    Returns
    -------
    dict
        Those of `SMALL_NOISE`, shape (runs,).
    """
    found = {}
    for name in (name for name in SMALL_NOISE if not name.startswith(LARGER)):
        source = name.replace("small_noise_nees", "pose_nees")
        source = source.removeprefix("small_noise_")
        if source in scores.results:
            found[name] = np.full(len(scores.good), np.nan)
            found[name][scores.good] = scores.time_averages(source)
    return found


def _heading_knowledge(scores: EstimatorScores) -> Array | None:
    """Divide the variance of the last heading by the least possible one."""
    bound = scores.at_end("heading_bound")
    if scores.nis_per_degree is None or not (bound > 0).all():
        return None
    return np.asarray(scores.at_end("heading_std") ** 2 / bound)


def _mistakes(scores: EstimatorScores) -> Array | None:
    if KNOWN_IDS_ATE not in scores.results:
        return None
    counts = [scores.per_run(f"{PREFIX}{name}") for name in _MISTAKES]
    return np.asarray(np.nan_to_num(np.sum(counts, axis=0)))


def _known_nees(scores: EstimatorScores, frame: ErrorFrame) -> Array | None:
    """Return the NEES of the same filter with known identities, if it failed nowhere.

    Results that an older version wrote have none.
    """
    name = f"{KNOWN_IDS_NEES}_{frame}"
    if name not in scores.results:
        return None
    known = scores.each(lambda nees: nees.mean(axis=1), name, begin=scores.first)
    return known[:, None] if np.isfinite(known).all() else None


# --------------------------------------------------------------------------------------
# The results that count: successful runs, after the start.
#
# The first step is a scan before any motion. If the start is certain, further leading
# steps have no NEES; they are left out as well.

POSE_FREEDOM, POINT_FREEDOM = 3, 2
_FIRST = 1
_NO_MESSAGE = "its NEES or NIS is not finite, or above 1e100"


class FailedRun(NamedTuple):
    """A run that is left out of all figures, and the reason."""

    run: int | str
    #: -1 where unknown.
    step: int
    message: str


#: Numbers of a variable that are read together, to limit the memory.
_AT_ONCE = 2**18


def parts_of(
    results: xr.Dataset, names: Sequence[str], begin: int = 0
) -> Iterator[tuple[slice, list[AnyArray]]]:
    """Yield variables (run, step) of one estimator from a step on, some runs at a time.

    If the results are in a file, only these runs are loaded.
    """
    size = max(1, _AT_ONCE // results.sizes["step"])
    for first in range(0, results.sizes["run"], size):
        rows = slice(first, first + size)
        some = [results.variables[name][rows, begin:] for name in names]
        yield rows, [np.asarray(each.values) for each in some]


class EstimatorScores(NamedTuple):
    """One estimator's results: M successful runs, K steps after the start.

    Variables with a number per step are read for some runs at a time.
    """

    label: str
    #: First step that has a NEES, >= 1.
    first: int
    #: Which of all runs succeeded, shape (runs,).
    good: BoolArray
    failures: tuple[FailedRun, ...]
    #: Of all runs and steps.
    results: xr.Dataset

    @property
    def steps(self) -> IntArray:
        """Numbers of the steps after the start, shape (K,)."""
        return np.arange(_FIRST, self.results.sizes["step"])

    def per_run(self, name: str) -> Array:
        """Return a variable with one number per run, or landmark, of those that count.

        Returns
        -------
        ndarray, shape (M, ...)
        """
        return np.asarray(self.results[name].values[self.good])

    def at_end(self, name: str) -> Array:
        """Return a variable at the last step of the runs that count, shape (M,)."""
        return np.asarray(self.results.variables[name][:, -1].values[self.good])

    def parts(self, *names: str, begin: int = _FIRST) -> Iterator[tuple[Any, ...]]:
        """Yield variables of some runs that count, from a step on, (m, K) each."""
        for rows, values in parts_of(self.results, names, begin):
            yield tuple(each[self.good[rows]] for each in values)

    def each(
        self, compute: Callable[..., Array], *names: str, begin: int = _FIRST
    ) -> Array:
        """Compute something of every run that counts, shape (M, ...)."""
        parts = self.parts(*names, begin=begin)
        return np.concatenate([compute(*part) for part in parts])

    def total(
        self, compute: Callable[..., Any], *names: str, begin: int = _FIRST
    ) -> Any:
        """Add up what a function computes from some runs."""
        found = (compute(*part) for part in self.parts(*names, begin=begin))
        return functools.reduce(operator.add, found)

    def average(self, name: str, compute: Callable[..., Any] = np.asarray) -> Any:
        """Average over all runs and steps that count; None if none is finite."""

        def known(values: Array) -> Array:
            computed = np.asarray(compute(values))
            finite_ones = computed[np.isfinite(computed)]
            return np.array([finite_ones.sum(), len(finite_ones)])

        total, count = self.total(known, name)
        return finite(total / count) if count else None

    def rms(self, name: str) -> float | None:
        """Take the root mean square over all runs and steps that count."""
        with np.errstate(over="ignore"):
            square = self.average(name, np.square)
        return None if square is None else math.sqrt(square)

    def ratios(self, frame: ErrorFrame) -> Array:
        """Average NEES / 3 of the pose over the steps of each run, shape (M,)."""
        name = f"pose_nees_{frame}"
        return self.each(_average_ratio, name, begin=self.first)

    def anees(self, frame: ErrorFrame) -> Array:
        """Average NEES / 3 over the runs at each step from the first on."""
        total = self.total(_sum_of_ratios, f"pose_nees_{frame}", begin=self.first)
        return np.asarray(total / self.good.sum())

    @property
    def is_fitted(self) -> bool:
        """Whether the estimates are aligned with the truth."""
        return bool(self.results.attrs.get("alignment") == "fitted")

    @property
    def nis_per_degree(self) -> float | None:
        """Sum of NIS divided by that of degrees of freedom; None without readings."""
        total, freedom = self.total(_sums_of_nis, "nis", "nis_dof")
        return finite(total / freedom) if freedom else None

    def time_averages(self, name: str) -> Array:
        """Average a NEES or an error over time, from the first step with a NEES on.

        A step at which any run has no finite value does not count.

        Returns
        -------
        ndarray, shape (M,)
            nan if no step counts.
        """
        unknown = self.total(_unknown_steps, name, begin=self.first)
        known = unknown == 0
        if not known.any():
            return np.full(int(self.good.sum()), np.nan)
        return self.each(lambda x: x[:, known].mean(axis=1), name, begin=self.first)


def _average_ratio(nees: Array) -> Array:
    return np.asarray((nees / POSE_FREEDOM).mean(axis=1))


def _sum_of_ratios(nees: Array) -> Array:
    return np.asarray((nees / POSE_FREEDOM).sum(axis=0))


def _sums_of_nis(nis: Array, freedom: IntArray) -> Array:
    nis = np.where(freedom > 0, nis, 0.0)
    known = np.isfinite(nis)
    return np.array([nis[known].sum(), freedom[known].sum()])


def _unknown_steps(values: Array) -> IntArray:
    return np.asarray((~np.isfinite(values)).sum(axis=0))


def scores_of(dataset: xr.Dataset, label: str, frame: ErrorFrame) -> EstimatorScores:
    """Select one estimator's results, and find its failed runs.

    Parameters
    ----------
    dataset : xarray.Dataset
        Results of ``monte_carlo``.
    label : str
        Label of the estimator.
    frame : {"additive", "invariant"}
        Error coordinates whose NEES must be finite, and below 1e100.
    """
    one_of("frame", frame, ERROR_FRAMES)
    results, pose_nees = dataset.sel(estimator=label), f"pose_nees_{frame}"
    known = [
        (x < LARGEST_SCORE).any(axis=0) for _, [x] in parts_of(results, [pose_nees])
    ]
    first = first_step(np.any(known, axis=0))
    found = []
    for _, part in parts_of(results, [pose_nees, "nis", "nis_dof"]):
        without = gaps(first, *part)
        found.append((without.any(axis=1), without.argmax(axis=1)))
    has_gap, gap = map(np.concatenate, zip(*found, strict=True))
    flagged = results["failed"].values.astype(bool)
    good = ~(flagged | has_gap)
    at = np.where(flagged, results["failed_at"].values, gap)
    runs, messages = dataset["run"].values.tolist(), results["message"].values
    failures = [
        FailedRun(runs[row], int(at[row]), str(messages[row]) or _NO_MESSAGE)
        for row in np.flatnonzero(~good)
    ]
    return EstimatorScores(label, first, good, tuple(failures), results)


def report_of(scores: EstimatorScores, frame: ErrorFrame) -> ConsistencyReport:
    """Decide about the runs of one estimator; at least 2 must have succeeded."""
    first, names = scores.first - _FIRST, (f"pose_nees_{frame}", "nis", "nis_dof")

    def parts() -> Iterator[tuple[Array, Array, IntArray]]:
        for nees, nis, freedom in scores.parts(*names):
            yield nees[:, first:], nis, freedom

    return evaluate_in_parts(
        parts,
        first,
        ~scores.good,
        maps=maps_of(scores, frame),
        dof=POSE_FREEDOM,
        frame=frame,
        rng=np.random.default_rng(_BOOTSTRAP_SEED),
    )


def maps_of(scores: EstimatorScores, frame: ErrorFrame) -> MapReport | None:
    """Decide about the maps of one estimator as :func:`report_of` does."""
    found = map_scores(scores.results, frame)
    return map_test(*(each[scores.good] for each in found.values())) if found else None


def map_scores(results: Any, frame: ErrorFrame) -> dict[str, Array]:
    """Return what the verdict on the maps needs, of all runs of one estimator.

    Parameters
    ----------
    results : mapping or Dataset
        Results by name, of one estimator.
    frame : {"invariant", "additive"}
        Error coordinates of the NEES.

    Returns
    -------
    dict
        Empty where identities are hidden, and for results of an older version.
    """
    if KNOWN_IDS_ATE in results or not {*DEVIATIONS} <= {*results}:
        return {}
    return {
        "landmarks": np.stack([np.asarray(results[k]) for k in DEVIATIONS], axis=-1),
        "map_nees": np.asarray(results["relative_map_nees"]),
        "map_dof": np.asarray(results["relative_map_dof"]),
        "landmark_nees": np.asarray(results[f"landmark_nees_{frame}"]),
    }


def labels_of(dataset: xr.Dataset) -> tuple[str, ...]:
    """Return the labels of the estimators in their order."""
    return tuple(str(label) for label in dataset["estimator"].values)


def estimators_of(dataset: xr.Dataset) -> dict[str, Any]:
    """Return name and options of each estimator by its label."""
    return dict(json.loads(dataset.attrs.get("estimators", "{}")))


def start_heading_std(dataset: xr.Dataset) -> float:
    """Return the standard deviation of the heading at the start [rad].

    Readings are relative to the robot and no landmark is known beforehand, so they hold
    no information about the orientation of the map: no later heading is known better.
    """
    table = tomllib.loads(dataset.attrs["scenario"])
    return float(table.get("start", {}).get("std", (0.0, 0.0, 0.0))[2])
