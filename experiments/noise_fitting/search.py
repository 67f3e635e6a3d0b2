"""Search for the most likely noise, with rejected readings and noises at zero.

`most_likely_noise` searches. The noise that a filter assumes is a vector of seven
standard deviations (`ENTRIES`), and `LogLikelihood` is the likelihood of a log's
readings as a function of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from typing import NamedTuple

import numpy as np

from ...arrays import Array, BoolArray
from ...estimator.filters.drive_likelihood import (
    GATE,
    DriveEvents,
    DriveRecord,
    drive_likelihood,
)
from ...estimator.filters.ekf import EkfSlam
from ...estimator.kernels.scan_update import GATED
from ..run_and_replay.filter_settings import FilterSettings
from . import scoring
from .intervals import NOT_ZERO, Verdict, intervals

ROUNDS = 12  # of rejecting readings and fitting the others
COARSE = 6  # iterations of a round after which readings are rejected anew
ROUGH = 0.1  # gain in ℓ that ends a climb until the fitted entries are decided
FACTORS = 4.0 ** np.arange(-3, 3)  # of motion and of sensor noise, tried at the start


BEARING, RANGE, PER_METRE, IN_METRES = 3, 4, 5, 6  # columns of the sensor's noise


#: Entries of the sensor's noise, and those that can replace them.
NEEDLESS = ((PER_METRE, RANGE), (IN_METRES, BEARING))
EXACT = 1e-6  # [rad, m] below which readings have no noise
WORTH = 3.0  # by which a part of σβ in metres must raise the log likelihood (p = .014)
PLAIN = 0.15  # standard deviation of log σ below which it is certainly not zero


class FittedNoise(NamedTuple):
    """One standard deviation, before and after the fit."""

    name: str
    unit: str
    before: float
    value: float
    #: Of its 95 % interval.
    low: float
    high: float
    #: Fitted; zero: the interval begins at zero; unknown: nothing depends on it.
    verdict: Verdict


class _NoiseFit(NamedTuple):
    """A noise during the search."""

    #: Shape (7,).
    noise: Array
    #: Which entries are fitted, shape (7,); the others are zero.
    free: BoolArray
    #: Its logarithm.
    likelihood: float
    #: Information about the logarithms of the fitted entries; empty at the start.
    information: Array
    converged: bool
    passes: int


class Found(NamedTuple):
    """The most likely noise."""

    #: Shape (7,).
    noise: Array
    table: tuple[FittedNoise, ...]
    passes: int


def most_likely_noise(likelihood: LogLikelihood, before: Array) -> Found:
    """Return the noise that makes the readings most likely.

    The search alternates between rejecting readings beyond the gate and fitting the
    noise to the others, until the rejected readings stay the same. Some entries of the
    sensor's noise can replace each other, such as the part of σr that grows with the
    range, and the part of σβ that shrinks with it. Such an entry is zero unless it
    makes the readings significantly more likely.

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
    start = _coarse_start(likelihood, before)
    smooth, found = _in_turns(likelihood, start, ROUGH)
    if not found.free[IN_METRES]:
        metres = _in_metres(smooth, found)
        if metres.likelihood > found.likelihood + WORTH:
            found = metres
    smooth, found = _in_turns(likelihood, found, scoring.GAIN)
    at = np.flatnonzero(found.free)
    found = _without_zeros(smooth, _without_needless(smooth, found))
    _refuse_diverged(found)
    _refuse_exact(found.noise, _typical_range(smooth))
    noise = found.noise
    along = scoring.restricted(smooth.of, noise, at)
    each = intervals(along, noise[at], found.likelihood, found.information)
    judged = dict(zip(at.tolist(), each, strict=True))
    for i, interval in judged.items():
        if interval.verdict == "unknown":
            noise[i] = before[i]
    table = tuple(
        FittedNoise(*ENTRIES[i], float(before[i]), float(noise[i]), low, high, verdict)
        for i, (verdict, low, high) in judged.items()
    )
    return Found(noise, table, found.passes)


def _in_turns(
    likelihood: LogLikelihood, found: _NoiseFit, gain: float
) -> tuple[LogLikelihood, _NoiseFit]:
    """Alternate between rejecting readings and fitting, until nothing changes."""
    rejected = likelihood.rejected(found.noise)
    for round_ in range(ROUNDS):
        smooth = likelihood.without(rejected)
        most = COARSE if round_ <= 2 else scoring.MOST
        found = _fit(smooth, found, most=most, gain=gain)
        again = likelihood.rejected(found.noise)
        _refuse_most(again)
        if found.converged and (again == rejected).all():
            return smooth, found
        rejected = again
    smooth = likelihood.without(rejected)
    return smooth, _fit(smooth, found)


def _in_metres(smooth: LogLikelihood, found: _NoiseFit) -> _NoiseFit:
    """Fit again with half of σβ as a part in metres, as of a sensor of positions."""
    noise, free = found.noise.copy(), found.free.copy()
    noise[IN_METRES] = 0.5 * max(noise[BEARING], EXACT) * _typical_range(smooth)
    noise[BEARING] *= 0.5
    free[IN_METRES] = True
    return _fit(smooth, found._replace(noise=noise, free=free), gain=ROUGH)


def _coarse_start(likelihood: LogLikelihood, before: Array) -> _NoiseFit:
    """Return the most likely of some multiples of motion and of sensor noise."""
    start = positive_start(before, _typical_range(likelihood))
    free = np.ones(len(ENTRIES), dtype=np.bool_)
    free[IN_METRES] = start[IN_METRES] > 0  # otherwise only if ℓ rises by `WORTH`
    factors = np.array(list(product(FACTORS, FACTORS)))
    tried = start * np.repeat(factors, (3, len(start) - 3), axis=1)
    values = scoring.totals(likelihood.of(tried))
    if not np.isfinite(values).any():
        raise np.linalg.LinAlgError("the fit diverges: no noise explains the readings")
    k = int(np.argmax(values))
    return _NoiseFit(tried[k], free, float(values[k]), np.eye(0), False, len(tried))


def _typical_range(likelihood: LogLikelihood) -> float:
    return max(float(np.median(np.abs(likelihood.events.readings[:, 1]))), 1e-3)


def _fit(
    smooth: LogLikelihood,
    found: _NoiseFit,
    *,
    most: int = scoring.MOST,
    gain: float = scoring.GAIN,
) -> _NoiseFit:
    """Fit the free entries from their present values on; see `scoring.maximise`."""
    free = np.flatnonzero(found.free)
    along = scoring.restricted(smooth.of, found.noise, free)
    fit = scoring.maximise(along, found.noise[None, free], most=most, gain=gain)
    noise = found.noise.copy()
    noise[free] = fit.parameters
    return found._replace(
        noise=noise,
        likelihood=fit.log_likelihood,
        information=fit.information,
        converged=fit.converged,
        passes=found.passes + fit.passes,
    )


def _fixed_at_zero(found: _NoiseFit, entry: int) -> _NoiseFit:
    noise, free = found.noise.copy(), found.free.copy()
    noise[entry], free[entry] = 0.0, False
    return found._replace(noise=noise, free=free)


def _without_needless(smooth: LogLikelihood, found: _NoiseFit) -> _NoiseFit:
    """Fit again without the part of σr per metre, or of σβ in metres, if possible."""
    for entry, instead in NEEDLESS:
        if not found.free[entry] or _is_plain(found, entry):
            continue
        fewer = _fixed_at_zero(found, entry)
        away = _typical_range(smooth)
        if entry == PER_METRE:
            fewer.noise[instead] += found.noise[entry] * away
        else:
            fewer.noise[instead] += found.noise[entry] / away
        simpler = _fit(smooth, fewer)
        if simpler.likelihood > found.likelihood - NOT_ZERO:
            found = simpler
    return found


def _is_plain(found: _NoiseFit, entry: int) -> bool:
    """Return whether an entry is significantly above zero."""
    at = int(np.count_nonzero(found.free[:entry]))
    faint = scoring.FAINT * np.eye(len(found.information))
    covariance = np.linalg.inv(found.information + faint)
    return bool(covariance[at, at] < PLAIN**2)


def _without_zeros(smooth: LogLikelihood, found: _NoiseFit) -> _NoiseFit:
    """Set entries to zero, one by one, if the readings do not become less likely."""
    for _ in range(int(np.count_nonzero(found.free)) - 1):
        free = np.flatnonzero(found.free)
        tried = [_fixed_at_zero(found, entry) for entry in free.tolist()]
        values = scoring.totals(smooth.of(np.array([one.noise for one in tried])))
        best = int(np.argmax(values))
        if values[best] < found.likelihood - scoring.BETTER:
            break
        found = _fit(smooth, tried[best])
    return found


def _refuse_most(rejected: BoolArray) -> None:
    count = int(np.count_nonzero(rejected))
    if count > 0.5 * len(rejected):
        raise np.linalg.LinAlgError(
            f"the fit diverges: under the most likely noise, {count} of "
            f"{len(rejected)} readings are beyond the gate"
        )


def _refuse_diverged(found: _NoiseFit) -> None:
    if not found.converged or found.noise.max() > 0.5 * scoring.GREATEST:
        values = ", ".join(
            f"{name} {value:.3g}"
            for (name, _), value in zip(ENTRIES, found.noise, strict=True)
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


#: Name and unit of each standard deviation; of a motion, per unit of the log's time.
ENTRIES = (
    ("σx", "m"),
    ("σy", "m"),
    ("σα", "rad"),
    ("σβ", "rad"),
    ("σr", "m"),
    ("σr per metre", "m/m"),
    ("σβ in metres", "m"),
)

SMALL = 0.1  # share of its neighbours at which the search for a zero begins


def noise_of(settings: FilterSettings) -> Array:
    """Return the noise of settings, shape (7,)."""
    options = settings.options
    more = (options.get(k, 0.0) for k in ("range_std_per_metre", "bearing_std_metres"))
    return np.array([*settings.motion_std, *settings.measurement_std, *more])


def with_noise(settings: FilterSettings, noise: Array) -> FilterSettings:
    """Return settings with another noise (7,), rounded to 4 significant digits."""
    values = [float(f"{value:.4g}") for value in noise]
    more = {"range_std_per_metre": values[PER_METRE]}
    if "bearing_std_metres" in settings.options or values[IN_METRES]:
        more["bearing_std_metres"] = values[IN_METRES]
    return replace(
        settings,
        motion_std=tuple(values[:3]),
        measurement_std=tuple(values[BEARING:PER_METRE]),
        options={**settings.options, **more},
    )


def positive_start(noise: Array, typical_range: float) -> Array:
    """Replace zeros of a noise (7,) by small numbers, with which a search can begin.

    Examples
    --------
    >>> positive_start(np.array([0.1, 0, 0.05, 0.02, 0.1, 0, 0]), 5.0)
    array([0.1  , 0.01 , 0.05 , 0.02 , 0.1  , 0.002, 0.   ])
    """
    metres = max(typical_range, 1e-3)
    along, turning = noise[:2].max(), noise[2]
    range_std = max(noise[RANGE], noise[PER_METRE] * metres, 1e-3)
    bearing_std = max(noise[BEARING], noise[IN_METRES] / metres, 1e-3)
    instead = (
        *((SMALL * along or 0.01),) * 2,
        SMALL * (turning or along or 0.01),
        SMALL * bearing_std,
        SMALL * range_std,
        SMALL * range_std / metres,
        0.0,
    )
    return np.where(noise > 0, noise, instead)


MOST_LANDMARKS = 100  # of one map
MOST_READINGS = 12_000  # of a sample
SAMPLED_LANDMARKS = 40  # of one map of a sample


@dataclass(frozen=True, eq=False)
class LogLikelihood:
    """The log likelihood of a drive's readings under a noise, from the innovations.

    A pass of a filter takes a time that grows with the square of its map.  A drive past
    many landmarks is therefore cut into parts, and each begins with an empty map.
    """

    #: At its start.
    filter: EkfSlam
    events: DriveEvents
    gate: float = GATE
    threads: int | None = None
    #: Of one part.
    most_landmarks: int = MOST_LANDMARKS
    #: The parts, if they are given.
    stretches: Sequence[scoring.Stretch] = ()

    @cached_property
    def parts(self) -> tuple[DriveEvents, ...]:
        """The parts of the drive."""
        stretches = self.stretches or scoring.stretches_of(
            self.events, self.most_landmarks
        )
        return scoring.parts_of(self.events, stretches)

    def sample(self, most_readings: int = MOST_READINGS) -> LogLikelihood:
        """Return the likelihood of evenly spread parts of a drive with many readings.

        A drive with fewer readings is returned whole.
        """
        if len(self.events.readings) <= most_readings:
            return self
        stretches = scoring.stretches_of(self.events, SAMPLED_LANDMARKS)
        if len(stretches) == 1:
            return self
        events, chosen = scoring.sample_of(self.events, stretches, most_readings)
        return replace(self, events=events, stretches=chosen)

    @cached_property
    def _scans(self) -> tuple[DriveEvents, ...]:
        return tuple(map(scoring.scans_of, self.parts))

    def of(self, noises: Array) -> Array:
        """Return the log likelihoods of the scans (B, S) under noises (B, 7)."""
        passes = self._passes(self._scans, noises, keep_beliefs=False)
        return np.concatenate([each.log_likelihoods for each in passes], axis=1)

    def record(self, noises: Array) -> DriveRecord:
        """Return the records of the passes under noises (B, 7); see `drive_likelihood`.

        The poses of each part begin where the filter does.
        """
        records = self._passes(self.parts, noises, keep_beliefs=True)
        if len(records) == 1:
            return records[0]
        rejected = np.sum([record.rejected for record in records], axis=0)
        joined = (
            entries[0] if entries[0].ndim == 1 else np.concatenate(entries, axis=1)
            for entries in zip(*records, strict=True)
        )
        return DriveRecord(*joined)._replace(rejected=rejected)

    def _passes(
        self, parts: Sequence[DriveEvents], noises: Array, *, keep_beliefs: bool
    ) -> list[DriveRecord]:
        """Filter each part under each noise."""
        return [
            drive_likelihood(
                self.filter,
                part,
                noises,
                gate=self.gate,
                keep_beliefs=keep_beliefs,
                threads=self.threads,
            )
            for part in parts
        ]

    def rejected(self, noise: Array) -> BoolArray:
        """Return which readings the gate rejects under a noise (7,), shape (M,)."""
        return np.asarray(self.record(noise[None]).outcomes[0] == GATED)

    def without(self, dropped: BoolArray) -> LogLikelihood:
        """Return the likelihood of all but some readings, without a gate.

        It is smooth: no reading is rejected here and accepted there.
        """
        kept = scoring.without_readings(self.events, dropped)
        return replace(self, events=kept, gate=np.inf)
