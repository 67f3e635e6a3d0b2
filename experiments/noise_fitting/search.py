"""Search the most likely noise, readings rejected and zeros decided."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ...arrays import Array, BoolArray
from .intervals import NOT_ZERO, Interval, Verdict, intervals
from .likelihood import LogLikelihood
from .noise_vector import (
    BEARING,
    ENTRIES,
    IN_METRES,
    PER_METRE,
    RANGE,
    fitted_entries,
    positive_start,
    replaceable_by_zero,
)
from .scoring import (
    FAINT,
    GREATEST,
    LEAST,
    Likelihoods,
    Maximum,
    maximise,
    scores,
    totals,
)

ROUNDS = 12  # of rejecting readings and fitting the others
COARSE = 6  # iterations of a round after which readings are rejected anew
FACTORS = 4.0 ** np.arange(-3, 3)  # of motion and of sensor noise, tried at the start
NEEDLESS = (PER_METRE, IN_METRES)
PLAIN = 0.15  # standard deviation of log σ below which it is certainly not zero
NONE = 1e-3  # of its start, below which a fitted noise is zero


class FittedNoise(NamedTuple):
    """One standard deviation, before and after the fit."""

    name: str
    unit: str
    before: float
    value: float
    low: float
    """Of its 95 % interval."""
    high: float
    verdict: Verdict
    """Fitted; zero: the interval begins at zero; unknown: nothing depends on it."""


class Found(NamedTuple):
    """The most likely noise."""

    noise: Array
    """Shape (7,)."""
    table: tuple[FittedNoise, ...]
    passes: int


def most_likely_noise(likelihood: LogLikelihood, before: Array) -> Found:
    """Return the noise under which the readings are most likely.

    Readings beyond the gate are rejected and the noise is fitted to the others, in
    turns, until the same readings are rejected.  An entry of the sensor's noise that
    another one can stand in for, such as the part of σr that grows with the range, is
    zero unless the readings are significantly more likely with it.

    Parameters
    ----------
    likelihood : LogLikelihood
        With a gate.
    before : ndarray, shape (7,)
        The noise to begin with.

    Raises
    ------
    numpy.linalg.LinAlgError
        If the fit diverges.
    """
    start = positive_start(before, _typical_range(likelihood))
    chosen = fitted_entries(start)
    passes, noise = 0, _coarse_start(likelihood, start)
    rejected = likelihood.rejected(noise)
    for round_ in range(ROUNDS):
        smooth = likelihood.without(rejected)
        fit = _fit(smooth, noise, chosen, None if round_ > 2 else COARSE)
        noise, passes = _filled(noise, chosen, fit), passes + fit.passes
        again = likelihood.rejected(noise)
        if fit.converged and (again == rejected).all():
            break
        rejected = again
    smooth = likelihood.without(rejected)
    fit = _fit(smooth, noise, chosen, None)
    noise, chosen, more = _without_needless(
        smooth, _filled(noise, chosen, fit), chosen, fit
    )
    passes += fit.passes + more + len(FACTORS) ** 2
    _refuse_diverged(noise, chosen, fit)
    at = np.flatnonzero(chosen)
    found = intervals(_along(smooth, noise, chosen), noise[chosen])
    judged = dict(zip(at.tolist(), found, strict=True))
    for i, interval in judged.items():
        if interval.verdict == "unknown":
            noise[i] = before[i]
        elif noise[i] < NONE * start[i]:
            noise[i] = 0.0
    return Found(noise, _table(before, noise, judged, start), passes)


def _coarse_start(likelihood: LogLikelihood, start: Array) -> Array:
    """Return the most likely of some multiples of motion and of sensor noise."""
    tried = np.array(
        [
            np.concatenate([start[:3] * a, start[3:] * b])
            for a in FACTORS
            for b in FACTORS
        ]
    )
    values = totals(likelihood.of(tried))
    if not np.isfinite(values).any():
        raise np.linalg.LinAlgError("the fit diverges: no noise explains the readings")
    return np.asarray(tried[int(np.argmax(values))])


def _typical_range(likelihood: LogLikelihood) -> float:
    return max(float(np.median(np.abs(likelihood.events.readings[:, 1]))), 1e-3)


def _fit(
    smooth: LogLikelihood, noise: Array, chosen: BoolArray, most: int | None
) -> Maximum:
    along = _along(smooth, noise, chosen)
    return maximise(along, noise[None, chosen], most=most)


def _along(smooth: LogLikelihood, noise: Array, chosen: BoolArray) -> Likelihoods:
    """Return the likelihoods as functions of the chosen entries alone."""

    def likelihoods(parameters: Array) -> Array:
        noises = np.tile(noise, (len(parameters), 1))
        noises[:, chosen] = parameters
        return smooth.of(noises)

    return likelihoods


def _filled(noise: Array, chosen: BoolArray, fit: Maximum) -> Array:
    result = noise.copy()
    result[chosen] = fit.parameters
    return result


def _without_needless(
    smooth: LogLikelihood, noise: Array, chosen: BoolArray, fit: Maximum
) -> tuple[Array, BoolArray, int]:
    """Fit again without the part of σr per metre, or of σβ in metres, if needless."""
    passes = 0
    for entry in NEEDLESS:
        if not (chosen[entry] and replaceable_by_zero(noise)[entry]):
            continue
        if _is_plain(smooth, noise, chosen, entry):
            continue
        fewer, tried = chosen.copy(), noise.copy()
        fewer[entry], tried[entry] = False, 0.0
        instead = RANGE if entry == PER_METRE else BEARING
        away = _typical_range(smooth)
        tried[instead] += noise[entry] * (away if entry == PER_METRE else 1 / away)
        simpler = _fit(smooth, tried, fewer, None)
        passes += simpler.passes
        if simpler.log_likelihood > fit.log_likelihood - NOT_ZERO:
            noise, chosen, fit = _filled(tried, fewer, simpler), fewer, simpler
    return noise, chosen, passes


def _is_plain(
    smooth: LogLikelihood, noise: Array, chosen: BoolArray, entry: int
) -> bool:
    """Return whether an entry is so well known that it cannot be zero."""
    theta = np.log(np.maximum(noise[chosen], LEAST))
    information = scores(_along(smooth, noise, chosen), theta)[1]
    at = int(np.count_nonzero(chosen[:entry]))
    covariance = np.linalg.inv(information + FAINT * np.eye(len(theta)))
    return bool(covariance[at, at] < PLAIN**2)


def _refuse_diverged(noise: Array, chosen: BoolArray, fit: Maximum) -> None:
    largest = noise[chosen].max()
    if not fit.converged or largest > 0.5 * GREATEST:
        values = ", ".join(
            f"{entry.name} {value:.3g}"
            for entry, value in zip(ENTRIES, noise, strict=True)
        )
        raise np.linalg.LinAlgError(
            f"the fit diverges, after {fit.passes} passes it is at {values}"
        )


def _table(
    before: Array, noise: Array, judged: dict[int, Interval], start: Array
) -> tuple[FittedNoise, ...]:
    """Return a row of each fitted entry; one that was needless is zero."""
    rows = []
    for i, entry in enumerate(ENTRIES):
        if not fitted_entries(start)[i]:
            continue
        interval = judged.get(i, Interval("zero", 0.0, float("nan")))
        rows.append(
            FittedNoise(
                entry.name,
                entry.unit,
                float(before[i]),
                float(noise[i]),
                interval.low,
                interval.high,
                interval.verdict,
            )
        )
    return tuple(rows)
