"""The verdict on a study that grows: one that runs until it is decided, or is extended.

A first verdict on a number of runs that was chosen beforehand needs no more than the
tests of :func:`.verdict.verdict_of_report`, and `verdict_of` returns theirs. If runs
are added after a look at the verdict, these tests would reject an honest filter more
often than in 5 % of cases. Later verdicts therefore follow from the tests of
:mod:`slamgym.evaluation.sequential_tests`, which hold their error rates at all looks
together: :class:`Watch` applies them to the runs in their order. If a study is
extended, its first verdict has 4 % of the 5 %, and all later ones have 1 % together.

Both cover the pose and, where it is known, the map. The evidence against the map has
the weight 0.1.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from ...arrays import AnyArray, Array, BoolArray, IntArray
from ...estimator.models.rigid_motion import ErrorFrame
from ...evaluation.consistency_report import FEW_RUNS, ConsistencyReport
from ...evaluation.diagnosis import p_text
from ...evaluation.hypothesis_tests import EQUIVALENCE_MARGIN, Band
from ...evaluation.map_consistency import ERROR_RATE as MAP_ERROR_RATE
from ...evaluation.map_consistency import MapEvidence, MapReport
from ...evaluation.sequential_tests import (
    FEWEST_SHOWN,
    SHOWN_ERROR_RATE,
    ConfidenceSequence,
    EProcess,
    average_of,
)
from ...suggestions import counted
from ..run_and_replay.trace import finite
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
    map_not_shown,
    map_refusal,
    map_scores,
    parts_of,
    report_of,
    squared_errors,
    verdict_of_report,
    with_failures,
)

#: Value of ``until`` of a study that runs until every estimator is decided.
DECIDED = "decided"
#: Shares of the 5 % of a study that is extended: of its first verdict, and of all later
#: ones together.
_FIRST_SHARE, _LATER_SHARE = 0.04, 0.01
_ERROR_RATE = 0.05
#: Weight of the evidence against the map.
MAP_SHARE = MAP_ERROR_RATE / _ERROR_RATE
_STEPS = 10
_MOST_NUMBERS = 2**14  # NEES that are processed at once, to limit the memory
_LARGEST_LOG = 700.0
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
    return _LATER_SHARE if looks and not looks[0].until else _ERROR_RATE


class _Shown:
    """Whether a ratio was shown to be near 1, and after how many runs."""

    def __init__(self) -> None:
        #: Number of runs after which the interval was inside the margin for the first
        #: time; None as long as it has not happened.
        self.after: int | None = None
        #: The interval at this time, else the last one.
        self.interval = Band(0.0, np.inf)
        #: Number of ratios.
        self.runs = 0
        self._sequence = ConfidenceSequence()

    def update(self, ratios: Array, numbers: IntArray) -> None:
        """Add the ratios of some runs, which have these numbers."""
        self.runs += len(ratios)
        if self.after is not None or not len(ratios):
            return
        low, high = self._sequence.update(ratios)
        inside = (low >= EQUIVALENCE_MARGIN.low) & (high <= EQUIVALENCE_MARGIN.high)
        at = int(inside.argmax()) if inside.any() else -1
        self.interval = Band(float(low[at]), float(high[at]))
        self.after = int(numbers[at]) if inside.any() else None

    def text(self) -> str:
        """Write the interval."""
        low, high = self.interval
        return f"[{low:.3f}, {high:.3f}]"


class Watch:
    """The state of the sequential tests of one estimator, to which runs are added."""

    def __init__(self, error_rate: float = _ERROR_RATE) -> None:
        self._limit = -np.log(error_rate)
        #: Number of runs after which the tests rejected; None as long as they have not.
        self.rejected_after: int | None = None
        #: Largest e-value so far, as a logarithm: of all tests, and of the map.
        self.log_evidence = self.log_map_evidence = 0.0
        #: The ratios of pose and map.
        self.pose, self.map = _Shown(), _Shown()
        self._runs = self._good = 0
        self._steps: IntArray | None = None
        self._on_pose, self._on_map = EProcess(), MapEvidence()
        #: Whether any run has a map.
        self.has_map = False
        #: Whether the evidence against pose or map alone suffices.
        self.rejects_pose = self.rejects_map = False

    @property
    def shown_after(self) -> int | None:
        """Number of runs after which both ratios were shown to be near 1, if they are.

        Only the ratio of the pose counts if fewer than 2 runs have a NEES of the map.
        """
        is_undefined = self._has_maps and self._on_map.undefined
        if is_undefined or not self._is_settled:
            return None
        return max(self.pose.after or 0, self.map.after or 0)

    @property
    def decided(self) -> bool:
        """Whether more runs are not needed: decided, or all runs so far failed."""
        if self._good < 2:
            return self._runs >= FEW_RUNS
        return self.rejected_after is not None or self._is_settled

    @property
    def _has_maps(self) -> bool:
        return self.map.runs > 1  # as a report of the maps needs

    @property
    def _is_settled(self) -> bool:
        is_shown = self.map.after is not None or not self._has_maps
        return self.pose.after is not None and is_shown

    def add_block(self, block: Block) -> None:
        """Add the runs of a block of results, by their NEES in the invariant frame."""
        first, gaps = gaps_of(block)
        good = ~(block["failed"].astype(bool) | gaps.any(axis=1))
        maps = map_scores(block, "invariant")
        self.update(block["pose_nees_invariant"], good, first, **maps)

    def update(
        self, nees: AnyArray, good: BoolArray, first: int, **maps: AnyArray
    ) -> None:
        """Add runs.

        Parameters
        ----------
        nees : ndarray, shape (runs, steps + 1)
            NEES of the pose.
        good : ndarray, shape (runs,)
            Which runs succeeded; others do not count.
        first : int
            First step that has a NEES.
        **maps : ndarray
            Result of :func:`.verdict.map_scores`: empty if the pose alone is judged.
        """
        width = max(nees.shape[1], *(each[0].size for each in maps.values()), 1)
        size = max(1, _MOST_NUMBERS // width)
        for start in range(0, len(good), size):
            part = slice(start, start + size)
            chosen = {name: each[part] for name, each in maps.items()}
            self._add(nees[part], good[part], first, chosen)

    def _add(
        self, nees: AnyArray, good: BoolArray, first: int, maps: dict[str, AnyArray]
    ) -> None:
        numbers = self._runs + 1 + np.flatnonzero(good)
        self._runs += len(good)
        if not len(numbers):
            return
        self._good += len(numbers)
        if self._steps is None:
            grid = np.linspace(first, nees.shape[1] - 1, _STEPS + 1).round()[1:]
            self._steps = np.unique(grid.astype(np.int64))
        values = nees[good]
        logs = self._on_pose.update(values[:, self._steps], POSE_FREEDOM)
        self.pose.update(values[:, first:].mean(axis=1) / POSE_FREEDOM, numbers)
        share = 0.0
        if maps:
            share = MAP_SHARE
            self.has_map |= bool((maps["map_dof"][good] > 0).any())
            of_map, ratios = self._on_map.update(
                *(each[good] for each in maps.values())
            )
            known = ~np.isnan(ratios)
            self.map.update(ratios[known], numbers[known])
            self.log_map_evidence = max(self.log_map_evidence, float(of_map.max()))
            self.rejects_map |= bool((of_map + np.log(share) >= self._limit).any())
        evidence = average_of([logs, of_map], [1 - share, share]) if maps else logs
        self.log_evidence = max(self.log_evidence, float(evidence.max()))
        self.rejects_pose |= bool((logs + np.log1p(-share) >= self._limit).any())
        rejected = np.flatnonzero(evidence >= self._limit)
        if self.rejected_after is None and len(rejected):
            self.rejected_after = int(numbers[rejected[0]])


def verdict_of(
    scores: EstimatorScores,
    frame: ErrorFrame,
    watch: Watch | None = None,
    report: ConsistencyReport | None = None,
) -> Verdict:
    """Return the verdict on one estimator, which holds 5 % over all looks together.

    Parameters
    ----------
    scores : EstimatorScores
        Results of the estimator. Their attributes ``until`` and ``looks`` list earlier
        looks; without them, this is the verdict of :func:`.verdict.verdict_of_report`.
    frame : {"invariant", "additive"}
        Error coordinates of the NEES.
    watch : Watch, optional
        Result of :func:`watched`, if it is known.
    report : ConsistencyReport, optional
        Result of :func:`.verdict.report_of`, if it is known.
    """
    failed, runs = len(scores.failures), len(scores.good)
    if report is None and scores.good.sum() > 1:
        report = report_of(scores, frame)
    if report is None or not is_sequential(scores):
        return verdict_of_report(report, failed, runs)
    watch = watch or watched(scores, frame)
    verdict = _sequential_verdict(scores, frame, report, watch)
    return with_failures(verdict, failed, runs)


def is_sequential(scores: EstimatorScores) -> bool:
    """Whether the number of runs may depend on what earlier ones have shown."""
    attrs = scores.results.attrs
    return bool(attrs.get("until") or attrs.get("looks"))


def watched(scores: EstimatorScores, frame: ErrorFrame) -> Watch:
    """Apply the sequential tests to all runs of an estimator."""
    watch = Watch(error_rate_after(_looks(scores)))
    maps = map_scores(scores.results, frame)
    for rows, [nees] in parts_of(scores.results, [f"pose_nees_{frame}"]):
        some = {name: each[rows] for name, each in maps.items()}
        watch.update(nees, scores.good[rows], scores.first, **some)
    return watch


def looks_summary(scores: EstimatorScores, watch: Watch) -> dict[str, Any]:
    """Return the sequential decision as plain JSON types.

    Returns
    -------
    dict
        ``rejected_after`` and ``shown_after``, numbers of runs or None; ``e_value`` and
        ``map_e_value``, the largest ones; ``interval`` and ``map_interval``, see
        :class:`Watch`; ``earlier_looks``, the numbers of runs of earlier verdicts. The
        entries of the map are None if only the pose is judged.
    """
    map_ends = watch.map.interval if watch.has_map else Band(np.nan, np.nan)
    return {
        "rejected_after": watch.rejected_after,
        "shown_after": watch.shown_after,
        "e_value": float(np.exp(min(watch.log_evidence, _LARGEST_LOG))),
        "map_e_value": float(np.exp(min(watch.log_map_evidence, _LARGEST_LOG)))
        if watch.has_map
        else None,
        "interval": [finite(end) for end in watch.pose.interval],
        "map_interval": [finite(end) for end in map_ends],
        "earlier_looks": [look.runs for look in _looks(scores)],
    }


def _looks(scores: EstimatorScores) -> list[Look]:
    return [Look(*look) for look in json.loads(scores.results.attrs.get("looks", "[]"))]


def _sequential_verdict(
    scores: EstimatorScores, frame: ErrorFrame, report: ConsistencyReport, watch: Watch
) -> Verdict:
    looks, maps = _looks(scores), report.map
    refusal = _refusal(scores, frame, report, watch)
    intervals = _intervals(watch, maps)
    if refusal is not None:
        steps = (report.final_step.statistic, *report.family.statistic)
        least, most = EQUIVALENCE_MARGIN
        is_near = watch.pose.after is not None and not refusal.of_map
        if not is_near or not all(least <= ratio <= most for ratio in steps):
            by_map = not refusal.of_pose
            return Verdict(NOT_CONSISTENT, refusal.reason, by_map)
        word = NOT_CONSISTENT if watch.shown_after is None else NEARLY
        small = f"{refusal.reason}; the difference is small: {intervals}"
        return Verdict(word, small)
    what = "the pose" if maps is None else "pose or map"
    evidence = f"{_evidence(watch.log_evidence)}; 5 % over all looks"
    kept = f"no anytime-valid test rejects {what} ({evidence}), "
    only = f"; {POSE_ONLY}" if maps is None else ""
    if watch.shown_after is not None:
        after = f"after {counted(watch.shown_after, 'run')}, "
        return Verdict(CONSISTENT, f"{after}{kept}and {intervals}{_after(looks)}{only}")
    return Verdict(NOT_SHOWN, f"{kept}but {intervals}{_after(looks)}{only}")


def _intervals(watch: Watch, maps: MapReport | None) -> str:
    """Write whether the ratios of pose and map are shown to be near 1."""
    if watch.pose.after is None:
        lies = f"{watch.pose.text()}, is not inside {_MARGIN}"
        interval = f"the {_INTERVAL} of the ratio, {lies}"
        if not np.isfinite(watch.pose.interval.high):
            interval = f"{counted(FEWEST_SHOWN, 'run')} or more are needed to show it"
        return f"{interval}: more runs are needed"
    interval = (
        f"the {_INTERVAL} of the ratio, {watch.pose.text()}, lies inside {_MARGIN}"
    )
    if maps is None:
        return interval
    if maps.undefined:
        return f"{interval}; {map_not_shown(maps)}"
    if watch.map.after is not None:
        return f"{interval}, as does that of the map, {watch.map.text()}"
    of_map = f"that of the map, {watch.map.text()}, does not"
    return f"{interval}, but {of_map}: more runs are needed"


class _Refusal(NamedTuple):
    """Which look rejects the filter, and how wrong it is."""

    reason: str
    of_pose: bool
    of_map: bool


def _refusal(
    scores: EstimatorScores, frame: ErrorFrame, report: ConsistencyReport, watch: Watch
) -> _Refusal | None:
    if watch.rejected_after is None:
        return _first_refusal(scores, frame, report)
    after = f"after {counted(watch.rejected_after, 'run')}, an anytime-valid test"
    of_pose, of_map = watch.rejects_pose or not watch.rejects_map, watch.rejects_map
    how = f"{_evidence(watch.log_map_evidence)}; 5 % over all looks"
    errors = f"({how})" if report.map is None else map_refusal(report.map, how)
    if not of_pose:
        return _Refusal(f"{after} rejects the map: {errors}", of_pose, of_map)
    also = f"; of the map, {errors}" if of_map else ""
    how = f"{_evidence(watch.log_evidence)}; 5 % over all looks"
    reason = f"{after} rejects it ({how}); {squared_errors(report)}{also}"
    return _Refusal(reason, of_pose, of_map)


def _first_refusal(
    scores: EstimatorScores, frame: ErrorFrame, report: ConsistencyReport
) -> _Refusal | None:
    """Return the rejection by a first verdict on a chosen number of runs, if any."""
    looks = _looks(scores)
    if not looks or looks[0].until:
        return None
    part = np.arange(len(scores.good)) < looks[0].runs
    first = scores._replace(good=scores.good & part)
    found = report_of(first, frame) if first.good.sum() > 1 else None
    if found is None or found.p_value >= _FIRST_SHARE:
        return None
    after = counted(looks[0].runs, "run")
    start = f"the first verdict, after {after}, rejected it, and stands"
    of_pose = found.pose_p_value < _FIRST_SHARE
    of_map = found.map is not None and found.map.p_value < MAP_SHARE * _FIRST_SHARE
    errors = "" if found.map is None else f"of the map, {map_refusal(found.map)}"
    if not of_pose:
        return _Refusal(f"{start}: {errors}", of_pose, of_map)
    how = f"{p_text(found.p_value)}; 5 % over all looks"
    also = f"; {errors}" if of_map else ""
    return _Refusal(f"{start} ({how}); {squared_errors(report)}{also}", of_pose, of_map)


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
