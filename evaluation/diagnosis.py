"""Name the cause if a filter is not consistent, from many runs.

The tests answer two questions in this order.

1. Do odometry and readings have the noise that the filter assumes?  With the truth,
   all noise values are known (:mod:`.noise_sums`).  A wrong standard deviation, a bias
   and heavy tails are tested separately (:mod:`.noise_findings`): a bias changes the
   mean, a wrong deviation the variance, and heavy tails the kurtosis.
2. If so, do the covariances agree with the errors?  If not, the cause is in the filter:
   its association if identities are hidden, otherwise its linearisation.  Linearisation
   does not change the size of the innovations, and its errors accumulate.  If the
   innovations are wrong too, or the errors are as wrong in the first steps as later,
   it is not the cause, and the answer is "cannot tell".

The tests of the second question are those of :mod:`.error_findings`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ..arrays import Array
from ..estimator.support import argument_checks
from .error_findings import (
    Blame,
    Early,
    Errors,
    blame_association,
    errors_of,
    smallest_adjusted,
    spurious_knowledge,
    wrong_from_the_start,
)
from .noise_findings import HEAVY_TAILS, Finding, significant_findings
from .noise_sums import CHANNELS, MOMENTS

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
        f"{first.cause}: {first.text} ({_p_text(first.p_value)}){also}; {errors.text}."
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
    ratio_text = errors.text
    if p_value >= FILTER_RATE:
        return _of_consistent_errors(p_value, nis_ratio, blame)
    is_association = blame is not None and blame.p_value < _ERROR_RATE
    if _is_cautious(errors, is_association=is_association):
        sentence = f"cannot tell: the noise is what it assumes, but {ratio_text}."
        return Diagnosis(CANNOT_TELL, p_value, sentence)
    if blame is not None and (is_association or not blame.is_paired):
        return _of_the_association(blame, errors)
    doubt = _doubt(errors, nis_ratio, early)
    return _of_large_errors(p_value, ratio_text, doubt, _claims(knowledge, spurious))


def _is_cautious(errors: Errors, *, is_association: bool) -> bool:
    """Whether the errors are too small, and not only compared with known identities."""
    return errors.ratio < 1 and not (is_association and errors.p_value >= FILTER_RATE)


def _of_large_errors(
    p_value: float, ratio_text: str, doubt: str, claims: str
) -> Diagnosis:
    """Return the answer for errors too large: linearisation, unless in doubt."""
    what = f"the noise is what it assumes, but {ratio_text}"
    if doubt:
        return Diagnosis(CANNOT_TELL, p_value, f"cannot tell: {what}{doubt}.")
    sentence = f"linearisation: {what} ({_p_text(p_value)}){claims}."
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


def _claims(knowledge: Array | None, spurious: float | None) -> str:
    """State the share of the least possible variance, if it is too small."""
    if knowledge is None or spurious is None or spurious >= _ERROR_RATE:
        return ""
    share = f"{knowledge.mean():.2g}"
    return f"; it claims {share} of the least possible variance of its heading"


def _of_the_association(blame: Blame, errors: Errors) -> Diagnosis:
    ratio_text = errors.text
    if blame.p_value < _ERROR_RATE:
        sentence = (
            f"association: {blame.share:.0%} of the runs give readings to wrong "
            f"landmarks, and {blame.text} ({_p_text(blame.p_value)}); {ratio_text}."
        )
        return Diagnosis(ASSOCIATION, blame.p_value, sentence)
    sentence = (
        f"cannot tell: the noise is what it assumes, and {ratio_text}, but runs with "
        "more wrong associations err no more than others."
    )
    return Diagnosis(CANNOT_TELL, errors.p_value, sentence)


def _p_text(p_value: float) -> str:
    return "p < 1e-16" if p_value < 1e-16 else f"p = {p_value:.2g}"
