"""Name the cause if a filter is not consistent, from many runs.

The tests answer two questions in this order.

1. Do odometry and readings have the noise that the filter assumes?  With the truth,
   all noise values are known (:mod:`.noise_sums`).  A wrong standard deviation, a bias
   and heavy tails are tested separately (:mod:`.noise_findings`): a bias changes the
   mean, a wrong deviation the variance, and heavy tails the kurtosis.
2. If so, do the covariances agree with the errors?  If not, the cause is in the filter:
   its association if identities are hidden, otherwise its linearisation.  Linearisation
   does not change the size of the innovations.  If the innovations are wrong too, the
   filter does not use the noise that it is given, and the answer is "cannot tell".

The scores of a run are correlated in time.  Every test of the second question therefore
uses one number per run.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import mannwhitneyu
from scipy.stats import t as student

from ..arrays import Array, BoolArray
from ..estimator.support import argument_checks
from .noise_findings import HEAVY_TAILS, Finding, noise_findings
from .noise_sums import CHANNELS, MOMENTS
from .time_average_tests import time_average_test

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
FEWEST_RUNS = 20
_POSE = 3
_LEAST_RATIO = 1.1
_KNOWABLE = 0.9
_FEWEST_OF_A_KIND = 5


class Diagnosis(NamedTuple):
    """The answer of :func:`diagnose`."""

    cause: str
    """One of `CAUSES`."""
    p_value: float
    """Of the test that points to it, adjusted for the number of tests; for "honest" and
    "cannot tell" the smallest adjusted one of all tests."""
    sentence: str
    others: tuple[str, ...] = ()
    """Further causes that the noise shows, the one with the largest effect first."""


class _Errors(NamedTuple):
    """How far the covariances are from the errors."""

    p_value: float
    ratio: float
    """NEES per degree over runs and steps, of pose or heading: farthest from 1."""


def diagnose(
    noise: ArrayLike,
    nees: ArrayLike,
    heading_nees: ArrayLike,
    *,
    nis_ratio: float | None = None,
    heading_knowledge: ArrayLike | None = None,
    mistakes: ArrayLike | None = None,
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
            CANNOT_TELL, 1.0, f"{runs} runs decide nothing: at least {FEWEST_RUNS}."
        )
    findings = noise_findings(sums)
    tests = max(1, len(findings))
    adjusted = [f._replace(p_value=min(1.0, f.p_value * tests)) for f in findings]
    guilty = [f for f in adjusted if f.p_value < NOISE_RATE and f.matters]
    errors = _errors(pose, heading)
    if guilty:
        return _of_the_noise(sorted(guilty, key=lambda f: -f.impact), errors)
    known = None if heading_knowledge is None else np.asarray(heading_knowledge, float)
    wrong = None if mistakes is None else np.asarray(mistakes, float)
    return _of_the_filter(pose, errors, nis_ratio, known, wrong)


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


def _errors(pose: Array, heading: Array) -> _Errors:
    """Test whether the NEES of pose or heading deviates from 1 by more than a tenth.

    The test uses the variance between runs instead of χ²: in a nonlinear world, the
    errors of a consistent filter vary more than Gaussian ones.
    """
    scores = [pose / _POSE] + [heading] * bool(heading.size)
    averages = [score.mean(axis=1) for score in scores]
    p_values = [_beyond_margin(average) for average in averages]
    ratio = max((float(a.mean()) for a in averages), key=lambda x: abs(np.log(x)))
    return _Errors(min(1.0, len(p_values) * min(p_values)), ratio)


def _beyond_margin(averages: Array) -> float:
    """Return the p-value of a mean between 1 / 1.1 and 1.1."""
    mean = averages.mean()
    if 1 / _LEAST_RATIO <= mean <= _LEAST_RATIO:
        return 1.0
    nearest = _LEAST_RATIO if mean > 1 else 1 / _LEAST_RATIO
    return time_average_test(averages / nearest, 1).p_value


def _of_the_noise(guilty: list[Finding], errors: _Errors) -> Diagnosis:
    """Answer by the finding with the largest effect."""
    first = guilty[0]
    others = dict.fromkeys(f.cause for f in guilty[1:] if f.cause != first.cause)
    also = f"; also {', '.join(others)}" if others else ""
    sentence = (
        f"{first.cause}: {first.text} ({_p_text(first.p_value)}){also}; "
        f"{_ratio_text(errors)}."
    )
    return Diagnosis(first.cause, first.p_value, sentence, tuple(others))


def _of_the_filter(
    pose: Array,
    errors: _Errors,
    nis_ratio: float | None,
    knowledge: Array | None,
    mistakes: Array | None,
) -> Diagnosis:
    """Return the answer for a filter that assumes the right noise."""
    spurious, p_value = _both_tests(knowledge, errors.p_value)
    if p_value >= FILTER_RATE:
        sentence = "honest: the noise is what it assumes, and its errors agree."
        return Diagnosis(HONEST, p_value, sentence)
    ratio_text = _ratio_text(errors)
    if errors.ratio < 1:
        sentence = f"cannot tell: the noise is what it assumes, but {ratio_text}."
        return Diagnosis(CANNOT_TELL, p_value, sentence)
    if mistakes is not None and mistakes.any():
        return _of_the_association(pose, mistakes, errors)
    if (nis_ratio or 0.0) > np.sqrt(errors.ratio):
        sentence = (
            f"cannot tell: the noise is what it assumes, but {ratio_text}, and "
            f"squared innovations are {nis_ratio:.3g} times too large: it may not use "
            "the noise that it is given."
        )
        return Diagnosis(CANNOT_TELL, p_value, sentence)
    sentence = (
        f"linearisation: the noise is what it assumes, but {ratio_text} "
        f"({_p_text(p_value)}){_claims(knowledge, spurious)}."
    )
    return Diagnosis(LINEARISATION, p_value, sentence)


def _claims(knowledge: Array | None, spurious: float) -> str:
    """State the share of the least possible variance, if it is too small."""
    if knowledge is None or spurious >= _ERROR_RATE:
        return ""
    share = knowledge.mean()
    return f"; it claims {share:.2g} of the least possible variance of its heading"


def _both_tests(knowledge: Array | None, p_value: float) -> tuple[float, float]:
    """Return the p-value of the claimed variance, and that of both tests together."""
    if knowledge is None:
        return 1.0, p_value
    spurious = _spurious(knowledge)
    return spurious, min(1.0, 2 * min(p_value, spurious))


def _spurious(knowledge: Array) -> float:
    """Test whether the claimed variance is below what any filter can reach."""
    error = knowledge.std(ddof=1) / np.sqrt(len(knowledge))
    score = (knowledge.mean() - _KNOWABLE) / max(error, 1e-12)
    return float(student.cdf(score, len(knowledge) - 1))


def _of_the_association(pose: Array, mistakes: Array, errors: _Errors) -> Diagnosis:
    """Test whether the runs with more mistakes have larger errors."""
    p_value = _worse_with_mistakes(pose.mean(axis=1), mistakes > np.median(mistakes))
    ratio_text = _ratio_text(errors)
    if p_value < _ERROR_RATE:
        sentence = (
            f"association: {np.mean(mistakes > 0):.0%} of the runs give readings to "
            f"wrong landmarks, and those with more mistakes err more "
            f"({_p_text(p_value)}); {ratio_text}."
        )
        return Diagnosis(ASSOCIATION, p_value, sentence)
    sentence = (
        f"cannot tell: the noise is what it assumes, and {ratio_text}, but runs with "
        "more wrong associations err no more than others."
    )
    return Diagnosis(CANNOT_TELL, errors.p_value, sentence)


def _worse_with_mistakes(averages: Array, many: BoolArray) -> float:
    if min(many.sum(), (~many).sum()) < _FEWEST_OF_A_KIND:
        return 1.0
    test = mannwhitneyu(averages[many], averages[~many], alternative="greater")
    return float(test.pvalue)


def _ratio_text(errors: _Errors) -> str:
    return f"its squared errors are {errors.ratio:.3g} times what it claims"


def _p_text(p_value: float) -> str:
    return "p < 1e-16" if p_value < 1e-16 else f"p = {p_value:.2g}"
