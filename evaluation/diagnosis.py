"""Name the cause if a filter is not consistent, from many runs: `diagnose`.

The tests answer three questions in this order.

1. Do odometry and readings have the noise that the filter assumes?  With the truth,
   all noise values are known (:mod:`.noise_findings`).  A wrong standard deviation, a
   bias, heavy tails and a correlation in time are tested separately.
2. If so, do the covariances agree with the errors (`errors_of`)?  If not, and if
   identities are hidden, do wrong associations make the errors larger?
3. Otherwise, what is left of the excess if all noise in the same worlds is a tenth of
   what it was, and the filter knows this (`excess_of`)?  An excess that vanishes is of
   the linearisation.  One that stays is of a wrong Jacobian or covariance: both
   scale with the noise.  One that grows is of a wrong model, whose errors do not.
   With a hundredth of the noise, nearly every filter is linear: these runs decide.

A cause is named only if it explains what the errors show: its sign and its size must
agree with them, and an interval must show that an excess vanishes.
"""

from __future__ import annotations

import math
from typing import NamedTuple, TypeGuard

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import bdtrc, chdtri, stdtr, stdtrit

from .. import argument_checks
from ..arrays import SMALLEST, Array, BoolArray
from ..suggestions import counted
from . import noise_findings
from .hypothesis_tests import equivalence_test, time_average_test

HONEST, CANNOT_TELL = "honest", "cannot tell"
LINEARISATION, ASSOCIATION = "linearisation", "association"
WRONG_COVARIANCE, WRONG_MODEL = "wrong covariance", "wrong model"
#: All answers of :func:`diagnose`.
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
    noise_findings.HEAVY_TAILS,
    noise_findings.CORRELATED,
    LINEARISATION,
    WRONG_COVARIANCE,
    WRONG_MODEL,
    ASSOCIATION,
    CANNOT_TELL,
)
#: Probabilities of a false answer about the noise, and about the filter.
NOISE_RATE, FILTER_RATE = 0.02, 0.02
_ERROR_RATE = 0.05
_OF_DISTANCES = 3  # the last moments
#: NIS per degree from which on a filter does not use the noise that it is given.
LARGEST_NIS = 1.15
FEWEST_RUNS = 20
_WITHOUT_SMALL_NOISE = (
    "The cause is the linearisation, a wrong model or a wrong covariance; the same "
    "runs with a tenth of the noise would show it."
)


class Diagnosis(NamedTuple):
    """The answer of :func:`diagnose`."""

    #: One of `CAUSES`.
    cause: str
    #: Of the test that points to it, or the smallest; adjusted for their number.
    p_value: float
    sentence: str
    #: Further causes that the noise shows, the one with the largest effect first.
    others: tuple[str, ...] = ()
    #: How many of the first runs to repeat with less noise (`SmallNoise`), 0 for none:
    #: they name the cause, as far as it can be named.
    repeat: int = 0


class SmallNoise(NamedTuple):
    """The same runs with less noise in the world, and in what the filter assumes."""

    #: Time average of the NEES of the pose in each run, (M,); nan where not run.
    nees: ArrayLike
    #: That of the heading, (M,).
    heading_nees: ArrayLike
    #: Of all noises, and of the deviations of the first pose.
    factor: float = 0.1
    #: The same runs with more noise than this but less than in the world, if they were
    #: repeated before.
    larger: SmallNoise | None = None
    #: Time average of the position error in each run, (M,) [m].
    position_error: ArrayLike | None = None


def diagnose(
    noise: ArrayLike | None,
    nees: ArrayLike,
    heading_nees: ArrayLike,
    *,
    nis_ratio: float | None = None,
    heading_knowledge: ArrayLike | None = None,
    mistakes: ArrayLike | None = None,
    known_nees: ArrayLike | None = None,
    small_noise: SmallNoise | None = None,
    rejected: bool = False,
) -> Diagnosis:
    """Name why a filter is not consistent.

    For a consistent filter, the answer is wrong in at most 5 % of Monte Carlos.

    Parameters
    ----------
    noise : array_like, shape (M, 5, 12), or None
        Of :func:`~slamgym.evaluation.noise_sums`, of M runs; None if it is not known.
        The last three may be missing: then the noise is not compared with distances.
    nees, heading_nees : array_like, shape (M, K)
        NEES of the pose (3 degrees) in the filter's own error frame, and of the
        heading (1 degree), after each of K steps; nan at leading steps without one. A
        step at which a heading has none does not count for headings.
    nis_ratio : float, optional
        Sum of all NIS divided by their degrees of freedom.
    heading_knowledge : array_like, shape (M,), optional
        Variance of the last heading that the filter reports, divided by the least
        possible one (:func:`~slamgym.evaluation.posterior_bound`).
    mistakes : array_like, shape (M,), optional
        Number of readings that a run gave to a wrong landmark, where identities are
        hidden.
    known_nees : array_like, shape (M, K), optional
        NEES of the pose of the same filter on the same readings with known identities.
        With it, the effect of wrong associations is found in single runs.
    small_noise : SmallNoise, optional
        Without it, linearisation, a wrong model and a wrong covariance look alike, and
        the answer is "cannot tell".
    rejected : bool
        Whether another test has rejected the filter, so that it is not "honest".

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
    >>> sums = [(w**k).sum(axis=2) for k in (0, 1, 2, 3, 4, 1, 0, 0, 1)]
    >>> nees = rng.chisquare(3, (40, 20))
    >>> diagnose(np.stack(sums, 2), nees, rng.chisquare(1, (40, 20))).cause
    'motion noise too small'
    """
    pose, heading = _checked(nees, heading_nees)
    runs = len(pose)
    sums = None if noise is None else _checked_sums(noise, runs)
    if runs < FEWEST_RUNS:
        good = f"{counted(runs, 'run')} succeeded"
        text = f"cannot tell: {good}, and {FEWEST_RUNS} are needed."
        return Diagnosis(CANNOT_TELL, 1.0, text)
    errors = errors_of(pose, heading)
    findings = noise_findings.significant_findings
    guilty = [] if sums is None else findings(sums, NOISE_RATE)
    agreeing = [f for f in guilty if _explains(f, errors)]
    most = max((f.at_most for f in agreeing), default=1.0)
    if agreeing and not _exceeds(pose, heading, _SLACK * most):
        return _of_the_noise(agreeing, guilty, errors)
    others = tuple(dict.fromkeys(f.cause for f in guilty))
    before = "" if sums is None else _before(agreeing or guilty, errors)
    blame = _blamed(pose, nees, mistakes, known_nees)
    knowledge = np.asarray(
        [] if heading_knowledge is None else heading_knowledge, float
    )
    spurious = spurious_knowledge(knowledge) if knowledge.size else None
    p_value = smallest_adjusted(errors, spurious, blame)
    nis = nis_ratio or 0.0
    if p_value >= FILTER_RATE and not rejected:
        return _of_consistent_errors(before, p_value, nis)
    if _is_of_the_association(blame, errors):
        return _of_the_association(before, blame, errors)
    claims = _spurious_text(knowledge, spurious)
    is_off = errors.p_value < FILTER_RATE
    shown = errors.p_value if is_off else errors.p_of_one
    is_near = 1 / LEAST_RATIO < errors.ratio < LEAST_RATIO
    if shown >= FILTER_RATE or (is_near and not is_off):
        why = claims or "a test rejects the filter"
        text = f"{before}{why}, although on average {errors.text}"
        sentence = f"cannot tell: {text} ({p_text(errors.p_of_one)})."
        return Diagnosis(CANNOT_TELL, p_value, sentence, others)
    cause, text, repeat = _of_less_noise(pose, heading, small_noise, nis, most)
    if cause == WRONG_COVARIANCE and p_value >= FILTER_RATE:
        # The repeated runs have the same random numbers: what is chance stays, too.
        cause, text = CANNOT_TELL, f"{text} It may be chance: try another seed."
    what = f"{before}{errors.text} ({p_text(shown)}){_also(claims, nis)}"
    return Diagnosis(cause, shown, f"{cause}: {what}. {text}", others, repeat)


def _of_less_noise(
    pose: Array, heading: Array, small: SmallNoise | None, nis_ratio: float, most: float
) -> tuple[str, str, int]:
    """Return what runs with less noise show, and how many to repeat with still less."""
    cause, text = CANNOT_TELL, _WITHOUT_SMALL_NOISE
    if small is not None:
        cause, text = excess_of(pose, heading, small, nis_ratio, most)
    return cause, text, runs_to_repeat(pose, heading, small, cause)


def _also(claims: str, nis_ratio: float) -> str:
    """Write what else is wrong with a filter."""
    text = f"; {claims}" if claims else ""
    if nis_ratio > LARGEST_NIS:
        text += f"; the squared innovations are {nis_ratio:.3g} times too large"
    return text


def _blamed(
    pose: Array, nees: ArrayLike, mistakes: ArrayLike | None, known: ArrayLike | None
) -> Blame | None:
    if mistakes is None or not np.any(mistakes):
        return None
    paired = None
    if known is not None:  # at the steps that count
        paired = argument_checks.shaped("known_nees", known, np.shape(nees))
        paired = paired[:, paired.shape[1] - pose.shape[1] :]
    return blame_association(pose, np.asarray(mistakes, float), paired)


def _spurious_text(knowledge: Array, spurious: float | None) -> str:
    """Write that a filter reports to know its heading too well, "" if it does not."""
    if spurious is None or spurious >= _ERROR_RATE:
        return ""
    return (
        f"the filter reports {100 * knowledge.mean():.2g} % of the smallest heading "
        f"variance that any filter can reach ({p_text(spurious)})"
    )


def _checked_sums(noise: ArrayLike, runs: int) -> Array:
    shape = runs, len(noise_findings.CHANNELS), len(noise_findings.MOMENTS)
    sums = argument_checks.as_floats("noise", noise)
    if sums.shape != (*shape[:2], shape[2] - _OF_DISTANCES):
        sums = argument_checks.shaped("noise", sums, shape)
    if not np.isfinite(sums).all():
        raise ValueError("noise must be finite: leave out runs that failed")
    return sums


def _checked(nees: ArrayLike, heading_nees: ArrayLike) -> tuple[Array, Array]:
    pose = argument_checks.as_floats("nees", nees)
    if pose.ndim != 2 or not pose.shape[1]:
        raise ValueError(f"nees must have shape (runs, steps), got {pose.shape}")
    heading = argument_checks.shaped("heading_nees", heading_nees, pose.shape)
    known = np.isfinite(pose)
    first = int(known.all(axis=0).argmax())
    if not known[:, first:].all():
        raise ValueError("nees must be finite from its first step on: leave out runs "
                         "that failed")  # fmt: skip
    return pose[:, first:], heading[:, np.isfinite(heading).all(axis=0)]


#: Factor by which errors of nonlinear filters may exceed what the noise explains.
_SLACK = 2.0


def _explains(finding: noise_findings.NoiseFinding, errors: Errors) -> bool:
    """Whether a fault of the noise changes the errors in the observed direction."""
    if errors.p_value >= FILTER_RATE:
        return True
    return finding.sign != (-1 if errors.ratio > 1 else 1)


def _exceeds(pose: Array, heading: Array, most: float) -> bool:
    """Whether the squared errors significantly exceed a multiple of those stated."""
    return math.isfinite(most) and any(
        score.mean() > most
        and _beyond_margin(score.mean(axis=1) / most) < FILTER_RATE / 2
        for score in [pose / POSE] + [heading] * bool(heading.size)
    )


def _before(findings: list[noise_findings.NoiseFinding], errors: Errors) -> str:
    """Write what is known about the noise, which does not explain the errors."""
    if not findings:
        return "the noise is as assumed, but "
    first = findings[0]
    found = f"{first.text} ({p_text(first.p_value)})"
    if not _explains(first, errors):
        change = "smaller" if errors.ratio > 1 else "larger"
        return f"{found}, which makes errors {change} than stated, but "
    return f"{found}, which explains at most {first.at_most:.3g} times, but "


def _of_the_noise(
    agreeing: list[noise_findings.NoiseFinding],
    guilty: list[noise_findings.NoiseFinding],
    errors: Errors,
) -> Diagnosis:
    """Answer by the largest finding of those that explain the errors."""
    first = agreeing[0]
    others = dict.fromkeys(f.cause for f in guilty if f.cause != first.cause)
    also = f"; also {', '.join(others)}" if others else ""
    found = f"{first.cause}: {first.text} ({p_text(first.p_value)})"
    unseen = errors.p_value >= FILTER_RATE
    shown = f"the errors do not show it: {errors.text}" if unseen else errors.text
    sentence = f"{found}{also}; {shown}."
    return Diagnosis(first.cause, first.p_value, sentence, tuple(others))


def _of_consistent_errors(before: str, p_value: float, nis_ratio: float) -> Diagnosis:
    """Return the answer for errors that no test rejects, whatever the NIS is.

    The NIS of a reading that is far from linear is large even if the filter corrects
    its belief well.
    """
    agree = before.removesuffix(", but ") + ", and " if before else ""
    agree += "the errors agree with the covariances"
    if nis_ratio > LARGEST_NIS:
        agree += (
            f", although the reported squared innovations are {nis_ratio:.3g} times "
            "what is expected"
        )
    return Diagnosis(HONEST, p_value, f"honest: {agree}.")


def _is_of_the_association(blame: Blame | None, errors: Errors) -> TypeGuard[Blame]:
    """Whether wrong associations are the cause, or may be and cannot be excluded."""
    if blame is None:
        return False
    if errors.ratio <= 1 and errors.p_value < FILTER_RATE:
        return False
    return blame.p_value < _ERROR_RATE or not blame.is_paired


def _of_the_association(before: str, blame: Blame, errors: Errors) -> Diagnosis:
    if blame.p_value < _ERROR_RATE:
        sentence = (
            f"association: {blame.share:.0%} of the runs give readings to wrong "
            f"landmarks, and {blame.text} ({p_text(blame.p_value)}); {errors.text}."
        )
        return Diagnosis(ASSOCIATION, blame.p_value, sentence)
    sentence = (
        f"cannot tell: {before}{errors.text}, and runs with more wrong associations "
        "err no more than others."
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
#: Least NEES per degree of an overconfident filter.
LEAST_RATIO = 1.1
#: A variance is false if it is below this share of the smallest possible variance.
KNOWABLE = 0.9
#: A run has diverged if its NEES has a smaller p-value than the first number. The
#: second is the accepted share of such runs.
DIVERGED_LEVEL, DIVERGED_RATE = 1e-4, 1e-3
#: An excess that vanishes with the noise falls below this share. What is left of it
#: is at most a quarter, or .25, and never more than .5.
SHRINKS = 0.5
_LEFT, _LEAST_LEFT, _MOST_LEFT = 0.25, 0.25, 0.5
SMALLEST_NOISE = 0.01
_CLEARLY, _MOST = 2.0, 0.75
_FEWEST_OF_A_KIND = 5
_FEWEST_DIVERGED = 2
_FEW_LOST = 0.05  # share of diverged runs that do not count with less noise


class Errors(NamedTuple):
    """How far the covariances are from the errors."""

    p_value: float
    #: NEES per degree over runs and steps, of pose or heading: the one farther from 1.
    ratio: float
    #: Number of diverged runs.
    diverged: int
    #: "pose" or "heading".
    of: str
    #: p-value that their averages are 1, without the margin of a tenth.
    p_of_one: float

    @property
    def text(self) -> str:
        """The finding, for a sentence."""
        diverged = f", and {self.diverged} runs diverged" if self.diverged > 1 else ""
        return (
            f"the squared errors of the {self.of} are {self.ratio:.3g} times what the "
            f"covariances state{diverged}"
        )


class Blame(NamedTuple):
    """Whether wrong associations make the errors larger."""

    p_value: float
    #: Of the runs with a wrong association.
    share: float
    #: The finding, if it is significant.
    text: str
    #: Whether the errors with known identities are known.
    is_paired: bool


def errors_of(pose: Array, heading: Array) -> Errors:
    """Test whether a filter is consistent, up to a tenth.

    Does the average NEES of pose or heading deviate from 1 by more than a tenth?  The
    test uses the variance between runs instead of χ²: in a nonlinear world, the errors
    of a consistent filter vary more than Gaussian ones.  If a few runs have very large
    errors, this variance is so large that the test cannot reject.  A second test
    therefore counts the diverged runs.

    Parameters
    ----------
    pose : ndarray, shape (M, K)
        NEES of the pose, 3 degrees.
    heading : ndarray, shape (M, L)
        NEES of the heading, 1 degree; it may have no steps.
    """
    scores = [pose / POSE] + [heading] * bool(heading.size)
    averages = [score.mean(axis=1) for score in scores]
    lost = diverged_runs(pose)
    diverged = int(lost.sum())
    p_values = [_beyond_margin(average) for average in averages]
    p_values.append(float(bdtrc(diverged - 1, len(lost), DIVERGED_RATE)))
    ratios = [float(average.mean()) for average in averages]
    ratio = max(ratios, key=lambda x: abs(np.log(x)))
    of = ("pose", "heading")[ratios.index(ratio)]
    p_of_one = len(averages) * min(time_average_test(a, 1).p_value for a in averages)
    p_value = min(1.0, len(p_values) * min(p_values))
    return Errors(p_value, ratio, diverged, of, min(1.0, p_of_one))


def diverged_runs(pose: Array) -> BoolArray:
    """Return which runs have an average NEES that no consistent filter has, (M,).

    The average of a run varies most if its NEES does not change over time; it then has
    the distribution of one NEES.  Beyond its quantile 1 − 10⁻⁴, ten times as many runs
    are accepted as Gaussian errors would give.
    """
    return np.asarray(pose.mean(axis=1) > chdtri(POSE, DIVERGED_LEVEL))


def runs_to_repeat(
    pose: Array, heading: Array, small: SmallNoise | None = None, cause: str = ""
) -> int:
    """Return how many of the first runs to repeat with less noise, 0 for none.

    At first, they are a tenth of the runs, at least 10, where most runs err clearly;
    otherwise as many as show half of the excess in 90 % of cases, or five diverged
    runs.  An excess that does not vanish is repeated with still less noise; one that
    seems to vanish then needs as many runs as show it in 90 % of cases.

    Parameters
    ----------
    pose, heading : ndarray, shape (M, K), (M, L)
        As for `errors_of`.
    small : SmallNoise, optional
        The runs that were repeated before.
    cause : str
        The cause that they suggest.
    """
    if small is not None and cause == LINEARISATION:
        return 0
    score = _averages(pose, heading)
    few = max(10, len(score) // 10)
    diverged = np.flatnonzero(diverged_runs(pose))
    if np.median(score) > _CLEARLY:
        needed = few
    elif len(diverged) > 1:
        needed = int(diverged[:5][-1]) + 1
    else:
        excess = max(abs(float(score.mean()) - 1), LEAST_RATIO - 1)
        needed = math.ceil((3.5 * float(score.std()) / excess) ** 2)
    if small is not None:
        if small.factor <= SMALLEST_NOISE and cause != CANNOT_TELL:
            return 0
        needed = max(needed, _runs_to_show(pose, heading, small))
        known = int(np.isfinite(np.asarray(small.nees, float)).sum())
        if small.factor <= SMALLEST_NOISE and min(needed, len(score)) <= known:
            return 0
    return min(max(needed, few), len(score))


def _runs_to_show(pose: Array, heading: Array, small: SmallNoise) -> int:
    """Return how many runs show in 90 % of cases that an excess vanishes."""
    needed = 0.0
    for _, before, after in _pairs(pose, heading, small):
        left, known = _left(before), after[np.isfinite(after)]
        if len(known) >= _FEWEST_OF_A_KIND and np.median(known) < _CLEARLY:
            needed = max(needed, (3.0 * float(known.std()) / left) ** 2)
    return math.ceil(needed)


def _left(ratio: float) -> float:
    """Return the largest excess that counts as none, after a ratio with all noise."""
    return float(np.clip(_LEFT * (ratio - 1), _LEAST_LEFT, _MOST_LEFT))


def excess_of(
    pose: Array,
    heading: Array,
    small: SmallNoise,
    nis_ratio: float,
    of_the_noise: float,
) -> tuple[str, str]:
    """Compare the errors of the same runs with much and with little noise.

    With the average NEES per degree a of a run and b with less noise, the excess b − 1
    is tested against shares of a − 1 (t-test over runs): `SHRINKS`, and one over the
    factor by which the noise is smaller, the mean of the shares that a wrong covariance
    and a wrong model give.  If there are runs with two factors, a is that of the larger
    one, because a filter that diverges with all noise gives no reference.  If most runs
    err clearly, or if some diverged, the answer is what most of these runs show,
    because a few of them determine the average.

    An excess vanishes only if a t-test shows that little of it is left.

    Parameters
    ----------
    pose, heading : ndarray, shape (M, K), (M, L)
        As for `errors_of`.
    small : SmallNoise
        Of the same runs.
    nis_ratio : float
        Sum of all NIS divided by their degrees of freedom.  Linearisation hardly
        changes the size of innovations.
    of_the_noise : float
        Ratio that wrong sizes of the noise explain, >= 1.

    Returns
    -------
    cause : str
        `LINEARISATION`, `WRONG_COVARIANCE`, `WRONG_MODEL` or `CANNOT_TELL`.
    sentence : str
    """
    errors, diverged = errors_of(pose, heading), diverged_runs(pose)
    pairs = _pairs(pose, heading, small)
    after = {name: values / of_the_noise for name, _, values in pairs}
    is_known = np.isfinite(after[errors.of])
    if is_known.sum() < _FEWEST_OF_A_KIND:
        return CANNOT_TELL, "Too few runs succeed with less noise."
    sign = 1.0 if errors.ratio > 1 else -1.0
    rest = _rest_of(after, is_known, errors.of, sign)
    found = rest.text(small.factor, of_the_noise)
    many, factor = _averages(pose, heading), small.factor
    of_all = _change(many, after[errors.of], diverged, sign)
    if small.larger is not None:
        many = _averages_of(small.larger)[errors.of]
        factor /= small.larger.factor
        share = _share(small.larger.factor)
        found += f", and with {share} {np.nanmean(many):.3g} times"
    if _change(many, after[errors.of], diverged, sign, 1 / factor) == "grows":
        return _of_growth(found, _shrunk_errors(small), factor)
    is_off = rest.remains or (rest.low > 1 if sign > 0 else rest.high < 1)
    is_left = rest.remains and small.factor <= SMALLEST_NOISE
    if (of_all == "stays" and is_off) or (of_all == "shrinks" and is_left):
        left = "the excess stays" if of_all == "stays" else "some of the excess stays"
        return WRONG_COVARIANCE, (
            f"{found}, so {left}: a Jacobian or a covariance of the filter is wrong."
        )
    is_small = all(
        _is_small(before, after[name][rest.kept], sign) for name, before, _ in pairs
    )
    if of_all != "shrinks" or rest.remains or not is_small:
        return CANNOT_TELL, f"{found}, which does not show the cause."
    if nis_ratio > np.sqrt(max(errors.ratio, 1.0)):
        return CANNOT_TELL, (
            f"{found}, but the innovations are too large for linearisation: is an "
            "angle not wrapped?"
        )
    return LINEARISATION, f"{found}, so the excess vanishes with the noise."


def _of_growth(found: str, shrunk: float, factor: float) -> tuple[str, str]:
    """Return the answer for a NEES that grows as the noise falls by a factor."""
    if shrunk < np.sqrt(factor):
        return WRONG_COVARIANCE, (
            f"{found}, but the errors themselves shrink to {shrunk:.3g} times: the "
            "claimed variance shrinks even faster, so a Jacobian or a covariance "
            "is wrong."
        )
    return WRONG_MODEL, (
        f"{found}, and thus do not shrink with it: a model of the filter is wrong, "
        "such as a bias, a sign, an offset or a delay."
    )


def _shrunk_errors(small: SmallNoise) -> float:
    """Return the factor of the position error when the noise falls, or inf."""
    larger = small.larger
    if larger is None or larger.position_error is None or small.position_error is None:
        return math.inf
    before = np.asarray(larger.position_error, float)
    after = np.asarray(small.position_error, float)
    both = np.isfinite(before) & np.isfinite(after) & (before > 0)
    return float(np.median(after[both] / before[both])) if both.any() else math.inf


class _Rest(NamedTuple):
    """The errors that remain with less noise, as NEES per degree."""

    #: "pose" or "heading".
    of: str
    ratio: float
    #: 90 % interval of the ratio.
    low: float
    high: float
    #: Whether they still differ from 1, in the same direction.
    remains: bool
    #: Runs that count.
    kept: BoolArray
    #: Number of diverged runs, and whether these few do not count.
    diverged: int
    few_diverged: bool

    def text(self, factor: float, times: float) -> str:
        """Write the finding, with the ratios multiplied by ``times``."""
        ratio, low, high = (times * x for x in (self.ratio, self.low, self.high))
        found = (
            f"With {_share(factor)} of the noise, the squared errors of the {self.of} "
            f"are {ratio:.3g} times"
        )
        if self.remains and self.low < 1 < self.high:  # a few runs make the average
            return f"{found}, and {self.diverged} of {self.kept.sum()} runs diverged"
        found += f" (90 % interval {low:.3g} to {high:.3g})"
        if self.diverged and self.few_diverged:
            found += f" but for {counted(self.diverged, 'diverged run')}"
        return found


def _rest_of(
    after: dict[str, Array], is_known: BoolArray, of: str, sign: float
) -> _Rest:
    """Summarise the errors with less noise; a few runs that diverge do not count."""
    lost = is_known & diverged_runs(POSE * after["pose"][:, None])
    few_lost = lost.sum() <= _FEW_LOST * is_known.sum()
    kept = is_known & ~lost if few_lost else is_known
    off = {
        name: abs(math.log(max(float(values[kept].mean()), SMALLEST)))
        for name, values in after.items()
        if (values[kept].mean() - 1) * sign > 0
        and _beyond_margin(values[kept]) < _ERROR_RATE / len(after)
    }
    remains = bool(off) or bool(sign > 0 and not few_lost)
    of = max(off, key=lambda name: off[name], default=of)
    mean = equivalence_test(after[of][kept], 1)
    return _Rest(
        of,
        mean.statistic,
        *mean.interval,
        remains,
        kept,
        int(lost.sum()),
        bool(few_lost),
    )


def _share(factor: float) -> str:
    return "a tenth" if factor == 0.1 else f"{100 * factor:.0f} %"


def _averages_of(small: SmallNoise) -> dict[str, Array]:
    """Return NEES per degree with less noise, (M,), of pose and heading."""
    return {
        "pose": np.asarray(small.nees, float) / POSE,
        "heading": np.asarray(small.heading_nees, float),
    }


def _pairs(
    pose: Array, heading: Array, small: SmallNoise
) -> list[tuple[str, float, Array]]:
    """Return name, NEES per degree, and that of each run with less noise."""
    after = _averages_of(small)
    found = [("pose", float(pose.mean()) / POSE, after["pose"])]
    if heading.size and np.isfinite(after["heading"]).any():
        found.append(("heading", float(heading.mean()), after["heading"]))
    return found


def _is_small(before: float, after: Array, sign: float) -> bool:
    """Whether a t-test shows that little is left of an excess.

    It is not corrected for skewness.  The skewness of few runs is mostly chance, and
    the correction would leave a quarter of the clear cases open.
    """
    error = after.std(ddof=1) / np.sqrt(len(after))
    excess = sign * (float(after.mean()) - 1)
    return bool(excess + stdtrit(len(after) - 1, 0.95) * error <= _left(before))


def _change(
    many: Array, few: Array, diverged: BoolArray, sign: float, grows: float = math.inf
) -> str:
    """Return whether the excess "grows", "shrinks" or "stays", else ""."""
    known = np.isfinite(many) & np.isfinite(few)
    many, few, diverged = many[known], few[known], diverged[known]
    if known.sum() < _FEWEST_OF_A_KIND:
        return ""
    before, after = sign * (many - 1), sign * (few - 1)
    chosen = np.ones_like(diverged)
    if np.median(many) <= _CLEARLY and diverged.sum() >= _FEWEST_DIVERGED:
        chosen = diverged
    if np.median(many[chosen]) > _CLEARLY:
        share = after[chosen] / before[chosen]
        shows = {
            "grows": share > grows,
            "shrinks": share < SHRINKS,
            "stays": (share >= SHRINKS) & (share <= grows),
        }
        for change, runs in shows.items():
            if runs.mean() > _MOST:
                return change
    if math.isfinite(grows) and _is_positive(few - 1 - grows * abs(before.mean())):
        return "grows"
    if _is_positive(after - SHRINKS * before):
        return "stays"
    return "shrinks" if _is_positive(SHRINKS * before - after) else ""


def _averages(pose: Array, heading: Array) -> Array:
    """Return the average NEES per degree of each run, of pose or heading."""
    of_heading = errors_of(pose, heading).of == "heading"
    return np.asarray(heading.mean(axis=1) if of_heading else pose.mean(axis=1) / POSE)


def _is_positive(values: Array) -> bool:
    spread = values.std(ddof=1) / np.sqrt(len(values))
    return bool(stdtr(len(values) - 1, -values.mean() / max(spread, SMALLEST)) < 0.05)


def spurious_knowledge(knowledge: Array) -> float:
    """Return the p-value of a variance that some filter can reach, from claims (M,)."""
    error = knowledge.std(ddof=1) / np.sqrt(len(knowledge))
    score = (knowledge.mean() - KNOWABLE) / max(error, SMALLEST)
    return float(stdtr(len(knowledge) - 1, score))


def blame_association(pose: Array, mistakes: Array, known: Array | None) -> Blame:
    """Test whether wrong associations make the errors larger.

    With known identities for comparison, two tests on the same runs: is the NEES larger
    than with known identities (Wilcoxon's signed-rank test), by a tenth or more on
    average, and do more runs diverge than with known identities?  Otherwise: do the
    runs with more mistakes than the median have larger errors, and do the diverged runs
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
    share, diverged = float(np.mean(mistakes > 0)), diverged_runs(pose)
    if known is None:
        many = mistakes > np.median(mistakes)
        larger = _larger(pose.mean(axis=1), many, _FEWEST_OF_A_KIND)
        more = _larger(mistakes, diverged, _FEWEST_DIVERGED)
        text = "those with more mistakes err more"
        return Blame(min(1.0, 2 * min(larger, more)), share, text, is_paired=False)
    excess = (pose - known).mean(axis=1) / POSE
    ratio = float(known.mean()) / POSE
    larger = 1.0
    if excess.mean() >= (LEAST_RATIO - 1) * max(1.0, ratio):
        from scipy.stats import wilcoxon  # noqa: PLC0415 (slow to import)

        larger = float(wilcoxon(excess, alternative="greater").pvalue)
    more_diverged = int(diverged.sum()) - int(diverged_runs(known).sum())
    more = float(bdtrc(more_diverged - 1, len(excess), DIVERGED_RATE))
    text = f"its NEES would be {ratio:.3g} per degree with known identities"
    return Blame(min(1.0, 2 * min(larger, more)), share, text, is_paired=True)


def _larger(values: Array, chosen: BoolArray, fewest: int) -> float:
    """Return the p-value of the chosen values being no larger than the others."""
    if min(chosen.sum(), (~chosen).sum()) < fewest:
        return 1.0
    from scipy.stats import mannwhitneyu  # noqa: PLC0415 (slow to import)

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
    blamed = blame.p_value if blame is not None and blame.is_paired else None
    tests = [p for p in (errors.p_value, spurious, blamed) if p is not None]
    return min(1.0, len(tests) * min(tests))
