"""Name the cause if a filter is not consistent, from many runs.

The tests answer two questions in this order.

1. Do odometry and readings have the noise that the filter assumes?  With the truth,
   all noise values are known (:mod:`.noise_findings`).  A wrong standard deviation, a
   bias and heavy tails are tested separately: a bias changes the
   mean, a wrong deviation the variance, and heavy tails the kurtosis.
2. If so, do the covariances agree with the errors?  If not, the cause is in the filter:
   its association if identities are hidden, otherwise its linearisation.  Linearisation
   does not change the size of the innovations, and its errors accumulate.  If the
   innovations are wrong too, or the errors are as wrong in the first steps as later,
   it is not the cause, and the answer is "cannot tell".

The tests of the second question are those of :mod:`.verdict`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import binom, chi2, mannwhitneyu, wilcoxon
from scipy.stats import t as student

from ..arrays import Array, BoolArray
from ..estimator.support import argument_checks
from .hypothesis_tests import time_average_test
from .noise_findings import (
    CHANNELS,
    HEAVY_TAILS,
    MOMENTS,
    Finding,
    significant_findings,
)

HONEST, CANNOT_TELL = "honest", "cannot tell"
LINEARISATION, ASSOCIATION = "linearisation", "association"
CAUSES = (
    HONEST,
    *(
        f"{noise} noise too {size}"
        for noise in ("motion", "bearing", "range")
        for size in ("small", "large")
    ),
    "odometry scale",
    "odometry turn",
    "bearing bias",
    "range bias",
    HEAVY_TAILS,
    LINEARISATION,
    ASSOCIATION,
    CANNOT_TELL,
)
"""All answers of :func:`diagnose`."""
NOISE_RATE, FILTER_RATE = 0.02, 0.02
"""Probabilities of a false answer about the noise, and about the filter."""
_ERROR_RATE = 0.05
LARGEST_NIS = 1.15
"""NIS per degree from which on a filter does not use the noise that it is given."""
FEWEST_RUNS = 20


class Diagnosis(NamedTuple):
    """The answer of :func:`diagnose`."""

    cause: str
    """One of `CAUSES`."""
    p_value: float
    """Of the test that points to it, or the smallest; adjusted for their number."""
    sentence: str
    others: tuple[str, ...] = ()
    """Further causes that the noise shows, the one with the largest effect first."""


def diagnose(
    noise: ArrayLike,
    nees: ArrayLike,
    heading_nees: ArrayLike,
    *,
    nis_ratio: float | None = None,
    heading_knowledge: ArrayLike | None = None,
    mistakes: ArrayLike | None = None,
    known_nees: ArrayLike | None = None,
) -> Diagnosis:
    """Name why a filter is not consistent.

    For a consistent filter, the answer is wrong in at most 5 % of Monte Carlos.

    Parameters
    ----------
    noise : array_like, shape (M, 5, 7)
        Of :func:`~slamgym.evaluation.noise_sums`, of M runs.
    nees, heading_nees : array_like, shape (M, K)
        NEES of the pose (3 degrees) in the filter's own error frame, and of the
        heading (1 degree), after each of K steps; nan at leading steps without one. A
        step at which a heading has none does not count for headings.
    nis_ratio : float, optional
        Sum of all NIS divided by their degrees of freedom.
    heading_knowledge : array_like, shape (M,), optional
        Variance of the last heading that the filter claims, divided by the least
        possible one (:func:`~slamgym.evaluation.posterior_bound`).
    mistakes : array_like, shape (M,), optional
        Number of readings that a run gave to a wrong landmark, where identities are
        hidden.
    known_nees : array_like, shape (M, K), optional
        NEES of the pose of the same filter on the same readings with known identities.
        With it, the effect of wrong associations is found in single runs.

    Returns
    -------
    Diagnosis

    Raises
    ------
    ValueError
        If shapes do not fit, or a number is not finite.

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> w = 1.3 * rng.standard_normal((40, 5, 50))  # noise as assumed, but for σα
    >>> w[:, [0, 1, 3, 4]] /= 1.3
    >>> sums = np.stack([(w**k).sum(axis=2) for k in (0, 1, 2, 3, 4, 1, 0)], axis=2)
    >>> nees = rng.chisquare(3, (40, 20))
    >>> diagnose(sums, nees, rng.chisquare(1, (40, 20))).cause
    'motion noise too small'
    """
    sums, pose, heading = _checked(noise, nees, heading_nees)
    runs = len(pose)
    if runs < FEWEST_RUNS:
        return Diagnosis(
            CANNOT_TELL, 1.0, f"{runs} runs are too few; {FEWEST_RUNS} are needed."
        )
    errors, guilty = errors_of(pose, heading), significant_findings(sums, NOISE_RATE)
    if guilty:
        return _of_the_noise(guilty, errors)
    known = None if heading_knowledge is None else np.asarray(heading_knowledge, float)
    blame = None
    if mistakes is not None and np.any(mistakes):
        paired = None if known_nees is None else _paired(known_nees, nees, pose)
        blame = blame_association(pose, np.asarray(mistakes, float), paired)
    early = wrong_from_the_start(pose)
    return _of_the_filter(errors, nis_ratio or 0.0, known, blame, early)


def _paired(known_nees: ArrayLike, nees: ArrayLike, pose: Array) -> Array:
    """Return the NEES with known identities, at the steps that count."""
    known = argument_checks.as_floats("known_nees", known_nees)
    if known.shape != np.shape(nees):
        raise ValueError(
            f"known_nees must be shape {np.shape(nees)}, got {known.shape}"
        )
    return known[:, known.shape[1] - pose.shape[1] :]


def _checked(
    noise: ArrayLike, nees: ArrayLike, heading_nees: ArrayLike
) -> tuple[Array, Array, Array]:
    sums = argument_checks.as_floats("noise", noise)
    pose = argument_checks.as_floats("nees", nees)
    heading = argument_checks.as_floats("heading_nees", heading_nees)
    if pose.ndim != 2 or not pose.shape[1]:
        raise ValueError(f"nees must be shape (runs, steps), got {pose.shape}")
    for name, array, shape in (
        ("noise", sums, (len(pose), len(CHANNELS), len(MOMENTS))),
        ("heading_nees", heading, pose.shape),
    ):
        if array.shape != shape:
            raise ValueError(f"{name} must be shape {shape}, got {array.shape}")
    if not np.isfinite(sums).all():
        raise ValueError("noise must be finite: leave out runs that failed")
    known = np.isfinite(pose)
    first = int(known.all(axis=0).argmax())
    if not known[:, first:].all():
        raise ValueError("nees must be finite from its first step on: leave out runs "
                         "that failed")  # fmt: skip
    return sums, pose[:, first:], heading[:, np.isfinite(heading).all(axis=0)]


def _of_the_noise(guilty: list[Finding], errors: Errors) -> Diagnosis:
    """Answer by the finding with the largest effect."""
    first = guilty[0]
    others = dict.fromkeys(f.cause for f in guilty[1:] if f.cause != first.cause)
    also = f"; also {', '.join(others)}" if others else ""
    sentence = (
        f"{first.cause}: {first.text} ({p_text(first.p_value)}){also}; {errors.text}."
    )
    return Diagnosis(first.cause, first.p_value, sentence, tuple(others))


def _of_the_filter(
    errors: Errors,
    nis_ratio: float,
    knowledge: Array | None,
    blame: Blame | None,
    early: Early | None,
) -> Diagnosis:
    """Return the answer for a filter that assumes the right noise."""
    spurious = None if knowledge is None else spurious_knowledge(knowledge)
    p_value = smallest_adjusted(errors, spurious, blame)
    if p_value >= FILTER_RATE:
        return _of_consistent_errors(p_value, nis_ratio, blame)
    what = f"the noise is what it assumes, but {errors.text}"
    is_association = blame is not None and blame.p_value < _ERROR_RATE
    only_by_comparison = is_association and errors.p_value >= FILTER_RATE
    if errors.ratio < 1 and not only_by_comparison:
        return Diagnosis(CANNOT_TELL, p_value, f"cannot tell: {what}.")
    if blame is not None and (is_association or not blame.is_paired):
        return _of_the_association(blame, errors)
    if doubt := _doubt(errors, nis_ratio, early):
        return Diagnosis(CANNOT_TELL, p_value, f"cannot tell: {what}{doubt}.")
    claims = ""
    if knowledge is not None and spurious is not None and spurious < _ERROR_RATE:
        share = f"{knowledge.mean():.2g}"
        claims = f"; it claims {share} of the least possible variance of its heading"
    sentence = f"linearisation: {what} ({p_text(p_value)}){claims}."
    return Diagnosis(LINEARISATION, p_value, sentence)


def _of_consistent_errors(
    p_value: float, nis_ratio: float, blame: Blame | None
) -> Diagnosis:
    """Return the answer for errors that no test rejects: honest, if the NIS agrees."""
    if blame is not None or nis_ratio <= LARGEST_NIS:
        sentence = "honest: the noise is what it assumes, and its errors agree."
        return Diagnosis(HONEST, p_value, sentence)
    sentence = (
        "cannot tell: the noise is what it assumes, and its errors agree, but "
        f"{_innovations_text(nis_ratio)}."
    )
    return Diagnosis(CANNOT_TELL, p_value, sentence)


def _doubt(errors: Errors, nis_ratio: float, early: Early | None) -> str:
    """State what linearisation does not explain; empty if there is nothing."""
    if nis_ratio > np.sqrt(errors.ratio):
        return f", and {_innovations_text(nis_ratio)}"
    if early is None:
        return ""
    return (
        f", and {early.ratio:.3g} times in the first {early.steps} steps, where errors "
        "of linearisation are small: its covariance may be scaled, or it may not use "
        "the noise that it is given"
    )


def _innovations_text(nis_ratio: float) -> str:
    return (
        f"squared innovations are {nis_ratio:.3g} times too large: it may not use the "
        "noise that it is given"
    )


def _of_the_association(blame: Blame, errors: Errors) -> Diagnosis:
    if blame.p_value < _ERROR_RATE:
        sentence = (
            f"association: {blame.share:.0%} of the runs give readings to wrong "
            f"landmarks, and {blame.text} ({p_text(blame.p_value)}); {errors.text}."
        )
        return Diagnosis(ASSOCIATION, blame.p_value, sentence)
    sentence = (
        f"cannot tell: the noise is what it assumes, and {errors.text}, but runs with "
        "more wrong associations err no more than others."
    )
    return Diagnosis(CANNOT_TELL, errors.p_value, sentence)


def p_text(p_value: float) -> str:
    """Write a p-value with two digits.

    Examples
    --------
    >>> p_text(0.0), p_text(0.0123)
    ('p < 1e-16', 'p = 0.012')
    """
    return "p < 1e-16" if p_value < 1e-16 else f"p = {p_value:.2g}"


# --------------------------------------------------------------------------------------
# Tests of the errors of a filter whose noise is as assumed, one number per run.
#
# The scores of a run are correlated in time.  Every test therefore uses the time
# average of a run, or its number of wrong associations.

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
