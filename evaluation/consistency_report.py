"""Is a filter consistent?  The decisions on many runs, in words and with error rates.

NEES pooled over time is not offered: the errors of successive steps are correlated, so
their sum is not chi-square, and a consistent filter is refused far more often than
stated.  Here only independent numbers are added: one per run, or innovations.
"""

from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..estimator.error_frames import ErrorFrame
from ..estimator.support import argument_checks
from .hypothesis_tests import (
    Decision,
    FamilyDecision,
    family_decision,
    final_step_decision,
    nis_decision,
    runs_to_detect,
    whiteness_decision,
)
from .nees import Array
from .time_average_tests import (
    EQUIVALENCE_MARGIN,
    Equivalence,
    bootstrap_decision,
    equivalence_decision,
    time_average_decision,
)

FEW_RUNS = 20
FEW_AVERAGES = 10
"""Runs below which the t-test refuses too often to share the 5 %, and has no say."""
FACTORS = (1.1, 1.2, 1.5)
_GRID = 10
_LAGS = 10
_ERROR_RATE = 0.05
_MOST_NAMES = 10


@dataclass(frozen=True, eq=False)
class ConsistencyReport:
    """What many runs say about a filter; made by :func:`consistency_report`.

    Ratios are NEES divided by its degrees of freedom, 1 for a consistent filter.
    """

    frame: str
    """Error coordinates of the NEES."""
    degrees_of_freedom: int
    runs: int
    """All of them, failed ones included."""
    failed_runs: tuple[int, ...]
    """Rows that hold nan where NEES or NIS should be; no decision counts them."""
    undefined_steps: int
    """Leading steps at which no run has a NEES, as at a start known for certain."""
    final_step: Decision
    time_average: Decision
    bootstrap: Decision
    family: FamilyDecision
    family_steps: NDArray[np.int64]
    """Steps of the grid of ``family``."""
    nis: Decision
    whiteness: Decision
    equivalence: Equivalence
    mean_ratio: float
    """Of the runs' time averages."""
    median_ratio: float
    share_above_3: float
    """Share of the runs whose time average is above 3."""
    runs_needed: tuple[tuple[float, int], ...]
    """(factor, runs with which the final step finds it in 90 % of cases)."""

    @property
    def accepted(self) -> bool:
        """Whether no run failed and no NEES decision refuses, wrongly 5 % at most.

        Final step, time averages and grid share the 5 %, after Bonferroni; below 10
        runs, the time averages, whose test is not exact, have no say.  NIS is left out:
        pooled over 10⁵ scans it refuses departures of a few thousandths, which say
        nothing about the errors; so is the bootstrap, which repeats the t-test.
        """
        p = (self.final_step.p_value, self.average_p_value, self.family.p_value)
        return not self.failed_runs and min(p) * len(p) >= _ERROR_RATE

    @property
    def used_runs(self) -> int:
        """Runs that did not fail."""
        return self.runs - len(self.failed_runs)

    @property
    def average_p_value(self) -> float:
        """The time averages' p as `accepted` counts it: 1 below 10 runs."""
        return 1.0 if self.used_runs < FEW_AVERAGES else self.time_average.p_value

    def warnings(self) -> tuple[str, ...]:
        """Say what weakens the report: failed runs, few runs."""
        found = []
        if self.failed_runs:
            count = len(self.failed_runs)
            names = ", ".join(map(str, self.failed_runs[:_MOST_NAMES]))
            if count > _MOST_NAMES:
                names += f" and {count - _MOST_NAMES} more"
            found.append(
                f"{count} of {self.runs} runs failed and are left out: {names}."
            )
        if self.used_runs < FEW_RUNS:
            found.append(
                f"Only {self.used_runs} runs: below {FEW_RUNS} little can be shown."
            )
        return tuple(found)

    def sentences(self) -> tuple[str, ...]:
        """Say each decision in a sentence with its error rate, warnings first."""
        grid, verdict = self.family, self.equivalence
        low, high = EQUIVALENCE_MARGIN
        needed = ", ".join(f"{factor:g}: {runs}" for factor, runs in self.runs_needed)
        return (
            *self.warnings(),
            _sentence(f"Final step, {self.frame} frame, χ²", "ratio", self.final_step),
            _sentence(
                f"Time averages, {self.frame} frame, t", "ratio", self.time_average
            ),
            _sentence(
                f"Time averages, {self.frame} frame, bootstrap", "ratio", self.bootstrap
            ),
            f"Grid of {len(grid.statistic)} steps, {self.frame} frame, Holm: "
            f"{grid.rejected.sum()} refused; band [{grid.interval.low:.3f}, "
            f"{grid.interval.high:.3f}]: {_word(grid.accepted)} "
            f"(refuses a consistent filter in at most {grid.error_rate:.0%}).",
            _sentence("NIS over all scans, χ²", "ratio", self.nis),
            _sentence("NIS whiteness, Ljung-Box", "Q", self.whiteness),
            f"Equivalence, {self.frame} frame: the 90 % interval of the ratio is "
            f"[{verdict.interval.low:.3f}, {verdict.interval.high:.3f}]; inside "
            f"[{low:g}, {high:g}]: {verdict.verdict} (claims consistency wrongly in at "
            f"most {verdict.error_rate:.0%}).",
            f"Per-run ratios, {self.frame} frame: mean {self.mean_ratio:.3f}, median "
            f"{self.median_ratio:.3f}, {self.share_above_3:.1%} of the runs above 3.",
            f"Runs that find covariances too small by a factor in 90 %: {needed}.",
        )


def consistency_report(
    nees: ArrayLike,
    nis: ArrayLike,
    nis_dof: ArrayLike,
    *,
    dof: int = 3,
    frame: ErrorFrame,
    rng: np.random.Generator,
) -> ConsistencyReport:
    """Decide on many independent runs of a filter.

    Parameters
    ----------
    nees : array_like, shape (runs, steps)
        Not divided by ``dof``; nan where a run failed, and at leading steps at which no
        run has one.
    nis, nis_dof : array_like, shape (runs, steps)
        NIS of each scan and its degrees of freedom, 0 where nothing was corrected.
    dof : int
        Degrees of freedom of one NEES.
    frame : {"additive", "invariant"}
        Error coordinates in which the NEES was taken.
    rng : numpy.random.Generator
        Draws the bootstrap.

    Raises
    ------
    ValueError
        Where shapes do not fit, or fewer than 2 runs did not fail.
    """
    argument_checks.one_of("frame", frame, ("additive", "invariant"))
    scores, scans, freedom = _same_shape(nees, nis, nis_dof)
    first, failed = _gaps(scores, scans, freedom)
    scores, scans, freedom = scores[~failed, first:], scans[~failed], freedom[~failed]
    averages = scores.mean(axis=1)
    steps = np.linspace(0, scores.shape[1] - 1, _GRID + 1).round()[1:]
    grid = np.unique(steps.astype(np.int64))
    return ConsistencyReport(
        frame=frame,
        degrees_of_freedom=dof,
        runs=len(failed),
        failed_runs=tuple(np.flatnonzero(failed).tolist()),
        undefined_steps=first,
        final_step=final_step_decision(scores[:, -1], dof),
        time_average=time_average_decision(averages, dof),
        bootstrap=bootstrap_decision(averages, dof, rng=rng),
        family=family_decision(scores[:, grid], dof),
        family_steps=grid + first,
        nis=nis_decision(scans, freedom),
        whiteness=whiteness_decision(
            scans, freedom, lags=min(_LAGS, scans.shape[1] - 1)
        ),
        equivalence=equivalence_decision(averages, dof),
        mean_ratio=float(averages.mean() / dof),
        median_ratio=float(np.median(averages) / dof),
        share_above_3=float(np.mean(averages > 3 * dof)),
        runs_needed=_runs_needed(dof),
    )


def assert_consistent(report: ConsistencyReport) -> None:
    """Raise AssertionError, with the report's sentences, unless it is accepted.

    A consistent filter is refused in at most 5 % of cases; with a fixed seed the
    outcome is always the same.
    """
    if not report.accepted:
        raise AssertionError("not consistent\n" + "\n".join(report.sentences()))


@cache
def _runs_needed(dof: int) -> tuple[tuple[float, int], ...]:
    return tuple((factor, runs_to_detect(factor, dof)) for factor in FACTORS)


class _Scores(NamedTuple):
    nees: Array
    nis: Array
    degrees_of_freedom: NDArray[np.int64]


def _same_shape(nees: ArrayLike, nis: ArrayLike, nis_dof: ArrayLike) -> _Scores:
    scores = argument_checks.as_floats("nees", nees)
    if scores.ndim != 2 or scores.shape[1] < 2:
        raise ValueError(f"nees must be shape (runs, steps >= 2), got {scores.shape}")
    scans = argument_checks.as_floats("nis", nis)
    freedom = np.asarray(nis_dof, dtype=np.int64)
    for name, array in (("nis", scans), ("nis_dof", freedom)):
        if array.shape != scores.shape:
            raise ValueError(f"{name} must be shape {scores.shape}, got {array.shape}")
    return _Scores(scores, scans, freedom)


def _gaps(
    nees: Array, nis: Array, freedom: NDArray[np.int64]
) -> tuple[int, NDArray[np.bool_]]:
    """Return the first step at which any run has a NEES, and which runs failed."""
    known = np.isfinite(nees)
    first = int(known.any(axis=0).argmax())
    no_nees = ~known[:, first:].all(axis=1)
    no_nis = (~np.isfinite(nis) & (freedom > 0)).any(axis=1)
    failed = np.asarray(no_nees | no_nis)
    if (~failed).sum() < 2:
        raise ValueError(
            "nees must hold at least 2 runs that did not fail, "
            f"got {failed.sum()} failed of {len(failed)}"
        )
    return first, failed


def _sentence(title: str, name: str, decision: Decision) -> str:
    low, high = decision.interval
    if np.isnan(decision.p_value):
        return (
            f"{title}: {name} {decision.statistic:.3f}, nothing decided: too few runs, "
            "or all equal."
        )
    return (
        f"{title}: {name} {decision.statistic:.3f}, accepted within "
        f"[{low:.3f}, {high:.3f}], p = {decision.p_value:.2g}: "
        f"{_word(decision.accepted)} "
        f"(refuses a consistent filter in {decision.error_rate:.0%})."
    )


def _word(accepted: bool) -> str:
    return "accepted" if accepted else "refused"
