"""The tests on many runs of one filter, collected in a report.

No test pools NEES over time: the errors of successive steps are correlated, so their
sum is not chi-square, and such a test rejects a consistent filter far more often than
stated.  Every sum here is over independent numbers: one per run, or innovations.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import ArrayLike

from .. import argument_checks
from ..arrays import Array, BoolArray, IntArray
from ..estimator.models.rigid_motion import ErrorFrame
from ..suggestions import counted
from . import hypothesis_tests as tests
from . import map_consistency

#: Number of runs below which the report warns that it finds large errors only.
FEW_RUNS = 20
#: Number of runs below which the t-test rejects too often to count in the verdict.
FEW_AVERAGES = 10
FACTORS = (1.1, 1.2, 1.5)
_GRID = 10
_LAGS = 10
_ERROR_RATE = 0.05
_DECIDING = 3  # final step, time averages and grid
_MOST_NAMES = 10
#: The outcome of a test without data.
_NOTHING = tests.HypothesisTest(np.nan, tests.Band(np.nan, np.nan), np.nan, _ERROR_RATE)


@dataclass(frozen=True, eq=False, repr=False)
class ConsistencyReport:
    """Results of all tests on many runs of a filter; see :func:`evaluate_consistency`.

    A ratio is NEES divided by its degrees of freedom, 1 for a consistent filter.
    ``str(report)`` gives one sentence per test.
    """

    #: Error coordinates of the NEES.
    frame: str
    degrees_of_freedom: int
    #: Number of runs, failed ones included.
    runs: int
    #: Rows with nan in place of a NEES or NIS; no test counts them.
    failed_runs: tuple[int, ...]
    #: Leading steps at which no run has a NEES, as at a start known for certain.
    undefined_steps: int
    final_step: tests.HypothesisTest
    time_average: tests.HypothesisTest
    bootstrap: tests.HypothesisTest
    family: tests.FamilyTest
    #: Steps of the grid of ``family``.
    family_steps: IntArray
    nis: tests.HypothesisTest
    whiteness: tests.HypothesisTest
    equivalence: tests.EquivalenceTest
    #: Mean of the runs' time averages.
    mean_ratio: float
    #: Median of the runs' time averages.
    median_ratio: float
    #: Share of the runs whose time average is above 3.
    share_above_3: float
    #: Fewest runs without which the mean of the others is inside the margin, 0 if it is
    #: anyway.
    deciding_runs: int
    #: Mean without these runs.
    ratio_of_others: float
    #: (factor, number of runs with which the final step finds it in 90 % of cases).
    runs_needed: tuple[tuple[float, int], ...]
    #: Of the maps at the end; None where the pose alone is tested.
    map: map_consistency.MapReport | None = None

    def __repr__(self) -> str:
        return (
            f"<ConsistencyReport: {_outcome(self.accepted)}, {self.runs} runs, "
            f"{self.frame} frame, mean NEES ratio {self.mean_ratio:.3f}>"
        )

    def __str__(self) -> str:
        return "\n".join(self.sentences())

    @property
    def accepted(self) -> bool:
        """Whether no run failed and no test of the NEES of pose or map rejects.

        A consistent filter is rejected in at most 5 % of cases.

        The final step, the time averages and the grid share the 5 % (Bonferroni), or
        4.5 % if the tests of the map use .5 %.
        Below 10 runs the time averages do not count, because their test is not exact.
        NIS does not count: pooled over 10⁵ scans it rejects deviations of a few
        thousandths, which say nothing about the errors.  The bootstrap does not count,
        because it repeats the t-test.
        """
        return not self.failed_runs and self.p_value >= _ERROR_RATE

    @property
    def p_value(self) -> float:
        """p-value of all deciding tests together: those of pose and map."""
        if self.map is None:
            return self.pose_p_value
        of_map = self.map.p_value * _ERROR_RATE / map_consistency.ERROR_RATE
        return min(self.pose_p_value, of_map)

    @property
    def pose_p_value(self) -> float:
        """p-value of final step, time averages and grid, to compare with 5 %."""
        p = (self.final_step.p_value, self.average_p_value, self.family.p_value)
        return min(p) * _ERROR_RATE / self.deciding_rate

    @property
    def deciding_rate(self) -> float:
        """Share of the error rate of each of the three tests of the pose."""
        of_map = 0.0 if self.map is None else map_consistency.ERROR_RATE
        return (_ERROR_RATE - of_map) / _DECIDING

    @property
    def used_runs(self) -> int:
        """Number of runs that succeeded."""
        return self.runs - len(self.failed_runs)

    @property
    def average_p_value(self) -> float:
        """p-value of the time averages that `accepted` uses: 1 below 10 runs."""
        return 1.0 if self.used_runs < FEW_AVERAGES else self.time_average.p_value

    def warnings(self) -> tuple[str, ...]:
        """Return what weakens the report: failed runs, few runs."""
        found = []
        if self.failed_runs:
            n = len(self.failed_runs)
            names = ", ".join(map(str, self.failed_runs[:_MOST_NAMES]))
            if n > _MOST_NAMES:
                names += f" and {n - _MOST_NAMES} more"
            found.append(f"{n} of {self.runs} runs failed and are left out: {names}.")
        if self.used_runs < FEW_RUNS:
            found.append(few_runs(self.used_runs))
        return tuple(found)

    def sentences(self) -> tuple[str, ...]:
        """Return the warnings, then one sentence per test with its error rate."""
        frame, grid, near = f"{self.frame} frame", self.family, self.equivalence
        low, high = tests.EQUIVALENCE_MARGIN
        needed = ", ".join(f"{factor:g}: {runs}" for factor, runs in self.runs_needed)
        innovations = (
            _sentence("NIS over all scans, χ²", "ratio", self.nis),
            _sentence("NIS whiteness, Ljung-Box", "Q", self.whiteness),
        )
        return (
            *self.warnings(),
            _sentence(f"Final step, {frame}, χ²", "ratio", self.final_step),
            _sentence(f"Time averages, {frame}, t", "ratio", self.time_average),
            _sentence(f"Time averages, {frame}, bootstrap", "ratio", self.bootstrap),
            f"Grid of {len(grid.statistic)} steps, {frame}, Holm: "
            f"{grid.rejected.sum()} rejected; band [{grid.interval.low:.3f}, "
            f"{grid.interval.high:.3f}]: {_outcome(grid.accepted)} "
            f"(rejects a consistent filter in at most {grid.error_rate:.0%}).",
            *(() if self.nis is _NOTHING else innovations),
            *(() if self.map is None else (self.map.sentence(),)),
            f"Equivalence, {frame}: the 90 % interval of the ratio is "
            f"[{near.interval.low:.3f}, {near.interval.high:.3f}]; inside "
            f"[{low:g}, {high:g}]: {near.verdict} (claims consistency wrongly in at "
            f"most {near.error_rate:.0%}).",
            f"Per-run ratios, {frame}: mean {self.mean_ratio:.3f}, median "
            f"{self.median_ratio:.3f}, {self.share_above_3:.1%} of the runs above 3.",
            "Runs needed to detect, in 90 % of cases, covariances that are too small "
            f"by a factor: {needed}.",
        )


def evaluate_consistency(
    nees: ArrayLike,
    nis: ArrayLike,
    nis_dof: ArrayLike,
    *,
    dof: int = 3,
    frame: ErrorFrame,
    rng: np.random.Generator,
    landmarks: ArrayLike | None = None,
    map_nees: ArrayLike | None = None,
    map_dof: ArrayLike | None = None,
    landmark_nees: ArrayLike | None = None,
) -> ConsistencyReport:
    """Test on many independent runs whether a filter is consistent.

    Parameters
    ----------
    nees : array_like, shape (runs, steps)
        Not divided by ``dof``; nan from the step at which a run failed, and at leading
        steps at which no run has a NEES.
    nis, nis_dof : array_like, shape (runs, steps)
        NIS of each scan and its degrees of freedom, 0 if the scan corrected nothing; a
        smoother has none.
    dof : int
        Degrees of freedom of one NEES.
    frame : {"additive", "invariant"}
        Error coordinates of the NEES.
    rng : numpy.random.Generator
        Draws the bootstrap.
    landmarks, map_nees, map_dof, landmark_nees : array_like, optional
        Of the final maps, see ``map_consistency.map_test``. Without ``landmarks``,
        the pose alone is tested.

    Raises
    ------
    ValueError
        If shapes do not fit, or if fewer than 2 runs succeeded.
    """
    argument_checks.one_of("frame", frame, ("additive", "invariant"))
    scores, scans, freedom = _same_shape(nees, nis, nis_dof)
    first, failed = _gaps(scores, scans, freedom)
    maps = None
    if landmarks is not None:
        maps = map_consistency.map_test(
            np.asarray(landmarks)[~failed],
            *(
                None if part is None else np.asarray(part)[~failed]
                for part in (map_nees, map_dof, landmark_nees)
            ),
        )
    part = scores[~failed, first:], scans[~failed], freedom[~failed]
    return evaluate_in_parts(
        lambda: [part], first, failed, maps=maps, dof=dof, frame=frame, rng=rng
    )


def evaluate_in_parts(
    parts: Callable[[], Iterable[tuple[Array, Array, IntArray]]],
    first: int,
    failed: BoolArray,
    *,
    maps: map_consistency.MapReport | None,
    dof: int,
    frame: ErrorFrame,
    rng: np.random.Generator,
) -> ConsistencyReport:
    """Do the same as `evaluate_consistency` for some runs at a time, to limit memory.

    Parameters
    ----------
    parts : callable
        Yields, for some successful runs at a time, NEES from the step ``first`` on, and
        NIS and degrees of freedom of all steps.
    first : int
        First step with a NEES.
    failed : ndarray, shape (runs,)
        Which of all runs failed.
    maps : MapReport, optional
        Of the successful runs.
    dof, frame, rng
        As in :func:`evaluate_consistency`.
    """
    each, has_nis = [], False
    for nees, scans, freedom in parts():
        steps = np.linspace(0, nees.shape[1] - 1, _GRID + 1).round()[1:]
        grid = np.unique(steps.astype(np.int64))
        lags, has_nis = min(_LAGS, scans.shape[1] - 1), has_nis or bool(freedom.any())
        each.append((nees.mean(axis=1), nees[:, grid]))
    averages, scores = map(np.concatenate, zip(*each, strict=True))
    deciding, others = _deciding_runs(averages / dof)

    def nis() -> Iterable[tuple[Array, IntArray]]:
        return ((scans, freedom) for _, scans, freedom in parts())

    return ConsistencyReport(
        frame=frame,
        degrees_of_freedom=dof,
        runs=len(failed),
        failed_runs=tuple(np.flatnonzero(failed).tolist()),
        undefined_steps=first,
        final_step=tests.final_step_test(scores[:, -1], dof),
        time_average=tests.time_average_test(averages, dof),
        bootstrap=tests.bootstrap_test(averages, dof, rng=rng),
        family=tests.family_test(scores, dof),
        family_steps=grid + first,
        nis=tests.nis_test_in_parts(nis) if has_nis else _NOTHING,
        whiteness=tests.whiteness_test_in_parts(nis, lags=lags)
        if has_nis
        else _NOTHING,
        equivalence=tests.equivalence_test(averages, dof),
        mean_ratio=float(averages.mean() / dof),
        median_ratio=float(np.median(averages) / dof),
        share_above_3=float(np.mean(averages > 3 * dof)),
        deciding_runs=deciding,
        ratio_of_others=others,
        runs_needed=_runs_needed(dof),
        map=maps,
    )


def _deciding_runs(ratios: Array) -> tuple[int, float]:
    """Return how many of the largest ratios lift the mean, and that of the others."""
    smallest = np.sort(ratios)
    means = np.cumsum(smallest) / np.arange(1, len(smallest) + 1)
    inside = np.flatnonzero(means <= tests.EQUIVALENCE_MARGIN.high)
    kept = int(inside[-1]) + 1 if len(inside) else len(means)
    return len(means) - kept, float(means[kept - 1])


def assert_consistent(report: ConsistencyReport) -> None:
    """Raise AssertionError with the report's sentences unless the report accepts.

    The call rejects a consistent filter in at most 5 % of cases.  With a fixed seed the
    outcome is always the same.
    """
    if not report.accepted:
        raise AssertionError(f"not consistent\n{report}")


@cache
def _runs_needed(dof: int) -> tuple[tuple[float, int], ...]:
    return tuple((factor, tests.runs_to_detect(factor, dof)) for factor in FACTORS)


def _same_shape(
    nees: ArrayLike, nis: ArrayLike, nis_dof: ArrayLike
) -> tuple[Array, Array, IntArray]:
    scores = argument_checks.as_floats("nees", nees)
    if scores.ndim != 2 or scores.shape[1] < 2:
        raise ValueError(f"nees must have shape (runs, steps >= 2), got {scores.shape}")
    scans = argument_checks.shaped("nis", nis, scores.shape)
    freedom = np.asarray(nis_dof, dtype=np.int64)
    argument_checks.shaped("nis_dof", freedom, scores.shape)
    return scores, scans, freedom


def _gaps(nees: Array, nis: Array, freedom: IntArray) -> tuple[int, BoolArray]:
    """Return the first step at which any run has a NEES, and which runs failed."""
    known = np.isfinite(nees)
    first = int(known.any(axis=0).argmax())
    no_nees = ~known[:, first:].all(axis=1)
    no_nis = (~np.isfinite(nis) & (freedom > 0)).any(axis=1)
    failed = np.asarray(no_nees | no_nis)
    if (~failed).sum() < 2:
        raise ValueError(
            "nees must hold at least 2 runs that succeeded, "
            f"got {(~failed).sum()} of {len(failed)}"
        )
    return first, failed


def _sentence(title: str, name: str, test: tests.HypothesisTest) -> str:
    found = f"{title}: {name} {test.statistic:.3f}"
    if np.isnan(test.p_value):
        return f"{found}, nothing decided: too few runs, or all equal."
    low, high = test.interval
    return (
        f"{found}, accepted within [{low:.3f}, {high:.3f}], p = {test.p_value:.2g}: "
        f"{_outcome(test.accepted)} "
        f"(rejects a consistent filter in {test.error_rate:.0%})."
    )


def _outcome(accepted: bool) -> str:
    return "accepted" if accepted else "rejected"


def few_runs(runs: int) -> str:
    """Warn of a study with fewer than FEW_RUNS runs."""
    needed = f"at least {FEW_RUNS} are needed to find more than large errors"
    return f"Only {counted(runs, 'run')}: {needed}."
