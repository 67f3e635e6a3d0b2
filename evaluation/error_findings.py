"""Tests of the errors of a filter whose noise is as assumed, one number per run.

The scores of a run are correlated in time.  Every test therefore uses the time average
of a run, or its number of wrong associations.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.stats import binom, chi2, mannwhitneyu, wilcoxon
from scipy.stats import t as student

from ..arrays import Array, BoolArray
from .time_average_tests import time_average_test

POSE = 3
LEAST_RATIO = 1.1
"""NEES per degree from which on a filter is overconfident."""
KNOWABLE = 0.9
"""Share of the least possible variance below which a claim is spurious."""
LOST_LEVEL, LOST_RATE = 1e-4, 1e-3
"""Quantile of χ²(3) beyond which a run is lost, and its rate that is accepted."""
EARLY_SHARE, FEWEST_EARLY = 0.1, 5
"""Which share of all steps is early, and at least how many steps."""
_EARLY_RATE = 0.01
_GROWTH = 2.0  # by which linearisation errors grow after the early steps
_FEWEST_OF_A_KIND = 5
_FEWEST_LOST = 2


class Errors(NamedTuple):
    """How far the covariances are from the errors."""

    p_value: float
    ratio: float
    """NEES per degree over runs and steps, of pose or heading: farthest from 1."""
    lost: int
    """Number of lost runs."""

    @property
    def text(self) -> str:
        """The finding, for a sentence."""
        lost = f", and {self.lost} runs are lost" if self.lost > 1 else ""
        return f"its squared errors are {self.ratio:.3g} times what it claims{lost}"


class Early(NamedTuple):
    """How far the covariances are from the errors in the early steps."""

    steps: int
    ratio: float
    """NEES of the pose per degree."""


class Blame(NamedTuple):
    """Whether wrong associations make the errors larger."""

    p_value: float
    share: float
    """Of the runs with a wrong association."""
    text: str
    """The finding, if it is significant."""
    is_paired: bool
    """Whether the errors with known identities are known."""


def errors_of(pose: Array, heading: Array) -> Errors:
    """Test whether a filter is consistent, up to a tenth.

    Does the average NEES of pose or heading deviate from 1 by more than a tenth?  The
    test uses the variance between runs instead of χ²: in a nonlinear world, the errors
    of a consistent filter vary more than Gaussian ones.  If a few runs have very large
    errors, this variance is so large that the test cannot reject.  A second test
    therefore counts the lost runs.

    Parameters
    ----------
    pose : ndarray, shape (M, K)
        NEES of the pose, 3 degrees.
    heading : ndarray, shape (M, L)
        NEES of the heading, 1 degree; it may have no steps.
    """
    scores = [pose / POSE] + [heading] * bool(heading.size)
    averages = [score.mean(axis=1) for score in scores]
    lost = int(lost_runs(pose).sum())
    p_values = [_beyond_margin(average) for average in averages]
    p_values.append(float(binom.sf(lost - 1, len(pose), LOST_RATE)))
    ratio = max((float(a.mean()) for a in averages), key=lambda x: abs(np.log(x)))
    return Errors(min(1.0, len(p_values) * min(p_values)), ratio, lost)


def lost_runs(pose: Array) -> BoolArray:
    """Return which runs have an average NEES that no consistent filter has, (M,).

    The average of a run varies most if its NEES does not change over time; it then has
    the distribution of one NEES.  Beyond its quantile 1 − 10⁻⁴, ten times as many runs
    are accepted as Gaussian errors would give.
    """
    return np.asarray(pose.mean(axis=1) > chi2.isf(LOST_LEVEL, POSE))


def wrong_from_the_start(pose: Array) -> Early | None:
    """Return the errors of the early steps, if they are as inconsistent as later ones.

    Errors of linearisation accumulate.  If the NEES is significantly above 1 in the
    first tenth of the steps, and its excess over 1 does not double after them, and not
    after the first step, the covariance is too small for another reason.

    Parameters
    ----------
    pose : ndarray, shape (M, K)
        NEES of the pose, 3 degrees.
    """
    steps = max(int(EARLY_SHARE * pose.shape[1]), FEWEST_EARLY)
    if steps >= pose.shape[1]:
        return None
    averages = pose[:, :steps].mean(axis=1) / POSE
    early, overall = float(averages.mean()), float(pose.mean()) / POSE
    least = min(early, float(pose[:, 0].mean()) / POSE)
    has_grown = overall - 1 >= _GROWTH * (least - 1)
    if least <= 1 or has_grown:
        return None
    is_certain = time_average_test(averages, 1).p_value < _EARLY_RATE
    return Early(steps, early) if is_certain else None


def spurious_knowledge(knowledge: Array) -> float:
    """Return the p-value of a variance that some filter can reach, from claims (M,)."""
    error = knowledge.std(ddof=1) / np.sqrt(len(knowledge))
    score = (knowledge.mean() - KNOWABLE) / max(error, 1e-12)
    return float(student.cdf(score, len(knowledge) - 1))


def blame_association(pose: Array, mistakes: Array, known: Array | None) -> Blame:
    """Test whether wrong associations make the errors larger.

    With known identities for comparison, two tests on the same runs: is the NEES larger
    than with known identities (Wilcoxon's signed-rank test), by a tenth or more on
    average, and are more runs lost than with known identities?  Otherwise: do the
    runs with more mistakes than the median have larger errors, and do the lost runs
    have more mistakes than others?

    Parameters
    ----------
    pose : ndarray, shape (M, K)
        NEES.
    mistakes : ndarray, shape (M,)
        Number of wrong associations of each run.
    known : ndarray, shape (M, K), optional
        NEES of the same filter with known identities.
    """
    share, lost = float(np.mean(mistakes > 0)), lost_runs(pose)
    if known is None:
        many = mistakes > np.median(mistakes)
        larger = _larger(pose.mean(axis=1), many, _FEWEST_OF_A_KIND)
        more = _larger(mistakes, lost, _FEWEST_LOST)
        text = "those with more mistakes err more"
        return Blame(min(1.0, 2 * min(larger, more)), share, text, is_paired=False)
    excess = (pose - known).mean(axis=1) / POSE
    ratio = float(known.mean()) / POSE
    matters = excess.mean() >= (LEAST_RATIO - 1) * max(1.0, ratio)
    larger = float(wilcoxon(excess, alternative="greater").pvalue) if matters else 1.0
    more_lost = int(lost.sum()) - int(lost_runs(known).sum())
    more = float(binom.sf(more_lost - 1, len(pose), LOST_RATE))
    text = f"its NEES would be {ratio:.3g} per degree with known identities"
    return Blame(min(1.0, 2 * min(larger, more)), share, text, is_paired=True)


def _larger(values: Array, chosen: BoolArray, fewest: int) -> float:
    """Return the p-value of the chosen values being no larger than the others."""
    if min(chosen.sum(), (~chosen).sum()) < fewest:
        return 1.0
    test = mannwhitneyu(values[chosen], values[~chosen], alternative="greater")
    return float(test.pvalue)


def _beyond_margin(averages: Array) -> float:
    """Return the p-value of a mean between 1 / 1.1 and 1.1."""
    mean = averages.mean()
    if 1 / LEAST_RATIO <= mean <= LEAST_RATIO:
        return 1.0
    nearest = LEAST_RATIO if mean > 1 else 1 / LEAST_RATIO
    return time_average_test(averages / nearest, 1).p_value


def smallest_adjusted(
    errors: Errors, spurious: float | None, blame: Blame | None
) -> float:
    """Return the smallest p-value of the tests of a filter, times their number."""
    tests = [errors.p_value]
    if spurious is not None:
        tests.append(spurious)
    if blame is not None and blame.is_paired:
        tests.append(blame.p_value)
    return min(1.0, len(tests) * min(tests))
