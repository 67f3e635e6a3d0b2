"""The verdict on a study that grows: one that runs until it is decided, or is extended.

A first verdict on a number of runs that was chosen beforehand needs no more than the
tests of :func:`.verdict.judge`, and `verdict_of` returns theirs. If runs are added
after a look at the verdict, these tests would reject an honest filter more often than
in 5 % of cases. Later verdicts therefore follow from the tests of
:mod:`slamgym.evaluation.sequential_tests`, which hold their error rates at all looks
together: :class:`Watch` applies them to the runs in their order. If a study is
extended, its first verdict has 4 % of the 5 %, and all later ones have 1 % together.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from ...arrays import AnyArray, BoolArray, IntArray
from ...estimator.models.rigid_motion import ErrorFrame
from ...evaluation.consistency_report import FEW_RUNS, ConsistencyReport
from ...evaluation.diagnosis import p_text
from ...evaluation.hypothesis_tests import EQUIVALENCE_MARGIN, Band
from ...evaluation.sequential_tests import (
    FEWEST_SHOWN,
    SHOWN_ERROR_RATE,
    ConfidenceSequence,
    EProcess,
    average_of,
)
from ...suggestions import counted
from .run_measures import Block, gaps_of
from .verdict import (
    CONSISTENT,
    NEARLY,
    NOT_CONSISTENT,
    NOT_SHOWN,
    POSE_FREEDOM,
    POSE_ONLY,
    EstimatorScores,
    Verdict,
    judge,
    map_refusal,
    report_of,
    squared_errors,
    with_failures,
)

#: Value of ``until`` of a study that runs until every estimator is decided.
DECIDED = "decided"
#: Shares of the 5 % of a study that is extended: of its first verdict, and of all later
#: ones together.
_FIRST_SHARE, _LATER_SHARE = 0.04, 0.01
_STEPS = 10
_MARGIN = f"[{EQUIVALENCE_MARGIN.low:g}, {EQUIVALENCE_MARGIN.high:g}]"
_INTERVAL = f"{1 - SHOWN_ERROR_RATE:.0%} confidence sequence".replace("%", " %")


class Look(NamedTuple):
    """A number of runs at which a study gave a verdict."""

    #: Numbers of the first run, and of the one after the last.
    first: int
    stop: int
    #: `DECIDED`, or "" where the number of runs was chosen beforehand.
    until: str

    @property
    def runs(self) -> int:
        """Number of runs."""
        return self.stop - self.first


def earlier_looks(looks: Sequence[Look], look: Look) -> list[Look]:
    """Return the looks at the same runs before a look, which may be a repeated one.

    Examples
    --------
    >>> looks = [Look(0, 50, ""), Look(0, 100, "")]
    >>> [each.stop for each in earlier_looks(looks, Look(0, 200, ""))]
    [50, 100]
    >>> [each.stop for each in earlier_looks(looks, Look(0, 100, ""))]
    [50]
    """
    before = looks[: looks.index(look)] if look in looks else looks
    return [each for each in before if each.first == look.first]


def error_rate_after(looks: Sequence[Look]) -> float:
    """Return the error rate that earlier verdicts leave to an anytime-valid test.

    A first verdict on a number of runs that was chosen beforehand keeps 4 %. Others
    follow from the same anytime-valid test, and take nothing.
    """
    return _LATER_SHARE if looks and not looks[0].until else 0.05


class Watch:
    """The state of the sequential tests of one estimator, to which runs are added."""

    def __init__(self, error_rate: float = 0.05) -> None:
        self._limit = -np.log(error_rate)
        #: Numbers of runs after which a test rejected, or the interval was inside the
        #: margin, for the first time; None as long as it has not happened.
        self.rejected_after: int | None = None
        self.shown_after: int | None = None
        #: Largest e-value so far, as a logarithm.
        self.log_evidence = 0.0
        #: That of the ratio, at the first time inside the margin, else the last one.
        self.interval = Band(0.0, np.inf)
        self._runs = self._good = 0
        self._steps: IntArray | None = None
        self._evidence, self._ratios = EProcess(), ConfidenceSequence()

    @property
    def decided(self) -> bool:
        """Whether more runs are not needed: decided, or all runs so far failed."""
        decided = (self.rejected_after or self.shown_after) is not None
        return decided or (self._good < 2 and self._runs >= FEW_RUNS)

    def add_block(self, block: Block) -> None:
        """Add the runs of a block of results, by their NEES in the invariant frame."""
        first, gaps = gaps_of(block)
        good = ~(block["failed"].astype(bool) | gaps.any(axis=1))
        self.update(block["pose_nees_invariant"], good, first)

    def update(self, nees: AnyArray, good: BoolArray, first: int) -> None:
        """Add runs.

        Parameters
        ----------
        nees : ndarray, shape (runs, steps + 1)
            NEES of the pose.
        good : ndarray, shape (runs,)
            Which runs succeeded; others do not count.
        first : int
            First step that has a NEES.
        """
        numbers = self._runs + 1 + np.flatnonzero(good)
        self._runs += len(good)
        if not len(numbers):
            return
        self._good += len(numbers)
        if self._steps is None:
            grid = np.linspace(first, nees.shape[1] - 1, _STEPS + 1).round()[1:]
            self._steps = np.unique(grid.astype(np.int64))
        values = nees[good]
        logs = self._evidence.update(values[:, self._steps], POSE_FREEDOM)
        evidence = average_of([logs])
        self.log_evidence = max(self.log_evidence, float(evidence.max()))
        if self.rejected_after is None:
            rejected = np.flatnonzero(evidence >= self._limit)
            self.rejected_after = int(numbers[rejected[0]]) if len(rejected) else None
        low, high = self._ratios.update(values[:, first:].mean(axis=1) / POSE_FREEDOM)
        if self.shown_after is None:
            inside = (low >= EQUIVALENCE_MARGIN.low) & (high <= EQUIVALENCE_MARGIN.high)
            at = int(inside.argmax()) if inside.any() else -1
            self.interval = Band(float(low[at]), float(high[at]))
            self.shown_after = int(numbers[at]) if inside.any() else None


def verdict_of(scores: EstimatorScores, frame: ErrorFrame) -> Verdict:
    """Return the verdict on one estimator, which holds 5 % over all looks together.

    Parameters
    ----------
    scores : EstimatorScores
        Results of the estimator. Their attributes ``until`` and ``looks`` list earlier
        looks; without them, this is the verdict of :func:`.verdict.judge`.
    frame : {"invariant", "additive"}
        Error coordinates of the NEES.
    """
    failed, runs = len(scores.failures), len(scores.good)
    report = report_of(scores, frame) if scores.good.sum() > 1 else None
    if report is None or not is_sequential(scores):
        return judge(report, failed, runs)
    verdict = _sequential_verdict(scores, frame, report)
    return with_failures(verdict, failed, runs)


def is_sequential(scores: EstimatorScores) -> bool:
    """Whether the number of runs may depend on what earlier ones have shown."""
    attrs = scores.results.attrs
    return bool(attrs.get("until") or attrs.get("looks"))


def looks_summary(scores: EstimatorScores, frame: ErrorFrame) -> dict[str, Any]:
    """Return the sequential decision as plain JSON types.

    Returns
    -------
    dict
        ``rejected_after`` and ``shown_after``, numbers of runs or None; ``e_value``,
        the largest one, and ``interval``, see :class:`Watch`; ``earlier_looks``, the
        numbers of runs of earlier verdicts.
    """
    watch = _watched(scores, frame)
    ends = [end if np.isfinite(end) else None for end in watch.interval]
    return {
        "rejected_after": watch.rejected_after,
        "shown_after": watch.shown_after,
        "e_value": float(np.exp(min(watch.log_evidence, 700.0))),
        "interval": ends,
        "earlier_looks": [look.runs for look in _looks(scores)],
    }


def _looks(scores: EstimatorScores) -> list[Look]:
    return [Look(*look) for look in json.loads(scores.results.attrs.get("looks", "[]"))]


def _watched(scores: EstimatorScores, frame: ErrorFrame) -> Watch:
    watch = Watch(error_rate_after(_looks(scores)))
    nees = np.asarray(scores.results[f"pose_nees_{frame}"].values)
    watch.update(nees, scores.good, scores.first)
    return watch


def _sequential_verdict(
    scores: EstimatorScores, frame: ErrorFrame, report: ConsistencyReport
) -> Verdict:
    watch, looks = _watched(scores, frame), _looks(scores)
    low, high = watch.interval
    inside = low >= EQUIVALENCE_MARGIN.low and high <= EQUIVALENCE_MARGIN.high
    lies = f"lies inside {_MARGIN}" if inside else f"is not inside {_MARGIN}"
    interval = f"the {_INTERVAL} of the ratio, [{low:.3f}, {high:.3f}], {lies}"
    if not np.isfinite(high):
        interval = f"{counted(FEWEST_SHOWN, 'run')} or more are needed to show it"
    refusal, by_map = _refusal(scores, frame, report, watch, looks)
    if by_map:
        return Verdict(NOT_CONSISTENT, refusal, by_map)
    if refusal:
        steps = (report.final_step.statistic, *report.family.statistic)
        least, most = EQUIVALENCE_MARGIN
        if inside and all(least <= ratio <= most for ratio in steps):
            return Verdict(NEARLY, f"{refusal}; the difference is small: {interval}")
        return Verdict(NOT_CONSISTENT, refusal)
    evidence = f"{_evidence(watch.log_evidence)}; 5 % over all looks"
    only = f"; {POSE_ONLY}"
    kept = f"no anytime-valid test rejects the pose ({evidence}), "
    if inside:
        after = f"after {counted(watch.shown_after or 0, 'run')}, "
        return Verdict(CONSISTENT, f"{after}{kept}and {interval}{_after(looks)}{only}")
    more = "more runs are needed"
    return Verdict(NOT_SHOWN, f"{kept}but {interval}: {more}{_after(looks)}{only}")


def _refusal(
    scores: EstimatorScores,
    frame: ErrorFrame,
    report: ConsistencyReport,
    watch: Watch,
    looks: Sequence[Look],
) -> tuple[str, bool]:
    """Write which look rejects the filter, and how wrong it is; "" for none.

    Also return whether the first verdict rejected the map alone.
    """
    what = squared_errors(report)
    if watch.rejected_after is not None:
        values = f"{_evidence(watch.log_evidence)}; 5 % over all looks"
        after = counted(watch.rejected_after, "run")
        return (
            f"after {after}, an anytime-valid test rejects it ({values}); {what}",
            False,
        )
    if looks and not looks[0].until:
        part = np.arange(len(scores.good)) < looks[0].runs
        first = scores._replace(good=scores.good & part)
        found = report_of(first, frame) if first.good.sum() > 1 else None
        if found is not None and found.p_value < _FIRST_SHARE:
            after = counted(looks[0].runs, "run")
            by_map = found.pose_p_value >= _FIRST_SHARE
            if found.map is not None and by_map:
                what = f"of the map, {map_refusal(found.map)}"
            else:
                what = f"{p_text(found.p_value)}; 5 % over all looks); {what}"
            start = f"the first verdict, after {after}, rejected it, and stands"
            return f"{start}{': ' if by_map else ' ('}{what}", by_map
    return "", False


def _after(looks: Sequence[Look]) -> str:
    """Write how many verdicts came before.

    Examples
    --------
    >>> _after([Look(0, 50, ""), Look(0, 1000, "")])
    ' (look 3, after verdicts on 50 and 1,000 runs)'
    """
    if not looks:
        return ""
    *others, last = [f"{look.runs:,}" for look in looks]
    numbers = f"{', '.join(others)} and {last}" if others else last
    verdicts = "verdicts" if others else "a verdict"
    return f" (look {len(looks) + 1}, after {verdicts} on {numbers} runs)"


def _evidence(log_evidence: float) -> str:
    """Write an e-value and its p-value.

    Examples
    --------
    >>> _evidence(0.0), _evidence(3.5), _evidence(1000.0)
    ('e = 1, p = 1/e = 1', 'e = 33.1, p = 1/e = 0.03', 'e > 1e6, p = 1/e < 1e-6')
    """
    if log_evidence > np.log(1e6):
        return "e > 1e6, p = 1/e < 1e-6"
    return f"e = {np.exp(log_evidence):.3g}, p = 1/e = {np.exp(-log_evidence):.2g}"
