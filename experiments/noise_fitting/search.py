"""Search for the most likely noise, with rejected readings and noises at zero."""

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
    BETTER,
    FAINT,
    GREATEST,
    maximise,
    restricted,
    scores,
    totals,
)

ROUNDS = 12  # of rejecting readings and fitting the others
COARSE = 6  # iterations of a round after which readings are rejected anew
FACTORS = 4.0 ** np.arange(-3, 3)  # of motion and of sensor noise, tried at the start
NEEDLESS = (PER_METRE, IN_METRES)
EXACT = 1e-6  # [rad, m] below which readings have no noise
PLAIN = 0.15  # standard deviation of log σ below which it is certainly not zero


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


class _Fit(NamedTuple):
    """A noise during the search."""

    noise: Array
    """Shape (7,)."""
    free: BoolArray
    """Which entries are fitted, shape (7,); the others are zero."""
    likelihood: float
    """Its logarithm."""
    converged: bool
    passes: int


class Found(NamedTuple):
    """The most likely noise."""

    noise: Array
    """Shape (7,)."""
    table: tuple[FittedNoise, ...]
    passes: int


def most_likely_noise(likelihood: LogLikelihood, before: Array) -> Found:
    """Return the noise that makes the readings most likely.

    The search alternates between rejecting readings beyond the gate and fitting the
    noise to the others, until the rejected readings stay the same. Some entries of the
    sensor's noise can replace each other, such as the part of σr that grows with the
    range. Such an entry is zero unless it makes the readings significantly more likely.

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
    smooth, found = _in_turns(likelihood, start, chosen)
    found = _without_zeros(smooth, _without_needless(smooth, found))
    _refuse_diverged(found)
    _refuse_exact(found.noise, _typical_range(smooth))
    noise, at = found.noise, np.flatnonzero(chosen)
    along = restricted(smooth.of, noise, at)
    judged = dict(
        zip(at.tolist(), intervals(along, noise[at], found.likelihood), strict=True)
    )
    for i, interval in judged.items():
        if interval.verdict == "unknown":
            noise[i] = before[i]
    return Found(noise, _table(before, noise, judged), found.passes)


def _in_turns(
    likelihood: LogLikelihood, start: Array, chosen: BoolArray
) -> tuple[LogLikelihood, _Fit]:
    """Alternate between rejecting readings and fitting, until nothing changes."""
    found = _coarse_start(likelihood, start, chosen)
    rejected = likelihood.rejected(found.noise)
    for round_ in range(ROUNDS):
        smooth = likelihood.without(rejected)
        found = _fit(smooth, found, most=None if round_ > 2 else COARSE)
        again = likelihood.rejected(found.noise)
        _refuse_most(again)
        if found.converged and (again == rejected).all():
            return smooth, found
        rejected = again
    smooth = likelihood.without(rejected)
    return smooth, _fit(smooth, found)


def _coarse_start(likelihood: LogLikelihood, start: Array, chosen: BoolArray) -> _Fit:
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
    best = int(np.argmax(values))
    return _Fit(tried[best], chosen, float(values[best]), False, len(tried))


def _typical_range(likelihood: LogLikelihood) -> float:
    return max(float(np.median(np.abs(likelihood.events.readings[:, 1]))), 1e-3)


def _fit(smooth: LogLikelihood, found: _Fit, *, most: int | None = None) -> _Fit:
    """Fit the free entries, starting from their present values."""
    free = np.flatnonzero(found.free)
    along = restricted(smooth.of, found.noise, free)
    fit = maximise(along, found.noise[None, free], most=most)
    noise = found.noise.copy()
    noise[free] = fit.parameters
    passes = found.passes + fit.passes
    return _Fit(noise, found.free, fit.log_likelihood, fit.converged, passes)


def _fixed_at_zero(found: _Fit, entry: int) -> _Fit:
    noise, free = found.noise.copy(), found.free.copy()
    noise[entry], free[entry] = 0.0, False
    return found._replace(noise=noise, free=free)


def _without_needless(smooth: LogLikelihood, found: _Fit) -> _Fit:
    """Fit again without the part of σr per metre, or of σβ in metres, if possible."""
    for entry in NEEDLESS:
        if not (found.free[entry] and replaceable_by_zero(found.noise)[entry]):
            continue
        if _is_plain(smooth, found, entry):
            continue
        fewer = _fixed_at_zero(found, entry)
        away = _typical_range(smooth)
        if entry == PER_METRE:
            fewer.noise[RANGE] += found.noise[entry] * away
        else:
            fewer.noise[BEARING] += found.noise[entry] / away
        simpler = _fit(smooth, fewer)
        if simpler.likelihood > found.likelihood - NOT_ZERO:
            found = simpler
    return found


def _is_plain(smooth: LogLikelihood, found: _Fit, entry: int) -> bool:
    """Return whether an entry is significantly above zero."""
    free = np.flatnonzero(found.free)
    along = restricted(smooth.of, found.noise, free)
    information = scores(along, np.log(found.noise[free])).information
    at = int(np.flatnonzero(free == entry)[0])
    covariance = np.linalg.inv(information + FAINT * np.eye(len(free)))
    return bool(covariance[at, at] < PLAIN**2)


def _without_zeros(smooth: LogLikelihood, found: _Fit) -> _Fit:
    """Set entries to zero, one by one, if the readings do not become less likely."""
    for _ in range(int(np.count_nonzero(found.free)) - 1):
        free = np.flatnonzero(found.free)
        tried = [_fixed_at_zero(found, entry) for entry in free.tolist()]
        values = totals(smooth.of(np.array([one.noise for one in tried])))
        best = int(np.argmax(values))
        if values[best] < found.likelihood - BETTER:
            break
        found = _fit(smooth, tried[best])
    return found


def _refuse_most(rejected: BoolArray) -> None:
    count = int(np.count_nonzero(rejected))
    if count > 0.5 * len(rejected):
        raise np.linalg.LinAlgError(
            f"the fit diverges: under the most likely noise {count} of {len(rejected)} "
            "readings are beyond the gate"
        )


def _refuse_diverged(found: _Fit) -> None:
    if not found.converged or found.noise.max() > 0.5 * GREATEST:
        values = ", ".join(
            f"{entry.name} {value:.3g}"
            for entry, value in zip(ENTRIES, found.noise, strict=True)
        )
        raise np.linalg.LinAlgError(
            f"the fit diverges, after {found.passes} passes it is at {values}"
        )


def _refuse_exact(noise: Array, typical_range: float) -> None:
    """Refuse readings without any noise, which no filter can use."""
    bearing = noise[BEARING] + noise[IN_METRES] / typical_range
    distance = noise[RANGE] + noise[PER_METRE] * typical_range
    for name, std in (("bearing", bearing), ("range", distance)):
        if std < EXACT:
            raise np.linalg.LinAlgError(
                f"the fit diverges: the readings seem to have no noise in {name}, so "
                "that there is nothing to fit; is the log exact, or very short?"
            )


def _table(
    before: Array, noise: Array, judged: dict[int, Interval]
) -> tuple[FittedNoise, ...]:
    """Return a row of each fitted entry."""
    return tuple(
        FittedNoise(
            ENTRIES[i].name,
            ENTRIES[i].unit,
            float(before[i]),
            float(noise[i]),
            interval.low,
            interval.high,
            interval.verdict,
        )
        for i, interval in judged.items()
    )
