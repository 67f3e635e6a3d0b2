"""Fit the noise of a log: find the noise that makes its readings most likely."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from ...arrays import Array
from ...estimator.filters.batch import can_batch
from ...estimator.filters.drive_likelihood import GATE
from ...estimator.filters.ekf import EkfSlam
from ..logs.anonymous import hides_identities
from ..logs.slamlog import SlamLog
from ..runs.blas_threads import one_blas_thread
from ..runs.filter_settings import FilterSettings
from ..runs.log_replay import Progress
from .associated_log import associated_log
from .calibration import Calibration, calibrate
from .inflation import Whiteness, whiteness
from .likelihood import LogLikelihood
from .log_events import events_of
from .noise_vector import (
    BEARING,
    IN_METRES,
    PER_METRE,
    RANGE,
    noise_of,
    with_noise,
)
from .search import FittedNoise, most_likely_noise

GATE_PROBABILITY = float(-np.expm1(-GATE / 2))
"""Of the gate of the fit, as an option of filters."""


class Fitted(NamedTuple):
    """A noise, and the innovations of the log under it."""

    settings: FilterSettings
    log_likelihood: float
    rejected: int
    """Readings beyond the gate."""
    whiteness: tuple[Whiteness, Whiteness]
    """Of the innovations in bearing and in range."""
    innovations: Array
    """Of the readings, each by its own standard deviation, (M, 2); nan for the first of
    each landmark."""


@dataclass(frozen=True, eq=False)
class NoiseFit:
    """The noise of a log."""

    log: SlamLog
    noise: tuple[FittedNoise, ...]
    """The standard deviations that were fitted."""
    before: Fitted
    fitted: Fitted
    """With the most likely noise."""
    suggested: Fitted
    """The same, the noise of the sensor inflated where innovations are not white; where
    all are white, it is `fitted` itself."""
    calibration: Calibration | None
    """The factor of the sensor's noise at which the pose NEES is 1 per degree of
    freedom; None if the truth is unknown."""
    reading_times: Array
    """Shape (M,)."""
    readings: int
    passes: int
    """Number of times that the log was filtered."""
    is_associated: bool = False
    """Whether a filter associated the readings; they have its identities in `log`."""


def fit_noise(
    log: SlamLog,
    settings: FilterSettings,
    *,
    progress: Progress | None = None,
    threads: int | None = None,
) -> NoiseFit:
    """Fit the noise of a log by maximum likelihood of a filter's innovations.

    Parameters
    ----------
    log : SlamLog
        With odometry and readings.  If it does not identify all landmarks, the filter
        of the settings associates its readings once, with the noise of the settings.
    settings : FilterSettings
        The noise to begin with, and the filter: one that runs in batches.  Without a
        gate they get that of the fit, `GATE_PROBABILITY`.
    progress : callable, optional
        Called with (steps done, steps) while a filter associates readings.
    threads : int, optional
        By default, the number of cores.

    Returns
    -------
    NoiseFit
        A noise on which no reading depends keeps its value.

    Raises
    ------
    ValueError
        If the log has no scan, no motion or no landmark that is read twice, or the
        filter does not run in batches.
    numpy.linalg.LinAlgError
        If the fit diverges.

    Examples
    --------
    >>> from slamgym.envs.controllers import OpenLoop
    >>> from slamgym.experiments.logs import record_episode
    >>> from slamgym.experiments.runs import settings_for
    >>> from slamgym.sim_configs import action_sequence, load_scenario
    >>> world = load_scenario("six_landmarks").with_changes(steps=60)
    >>> driver = OpenLoop(action_sequence(world), world.robot)
    >>> log = record_episode(world, driver, seed=3)
    >>> fit = fit_noise(log, settings_for(log, estimator="invariant"))
    >>> [(noise.name, noise.verdict) for noise in fit.noise][:2]
    [('σx', 'fitted'), ('σy', 'fitted')]
    """
    if not hides_identities(log):
        options = {"gate_probability": GATE_PROBABILITY, **settings.options}
        return _fit_known(log, replace(settings, options=options), threads)
    known = associated_log(log, settings, progress)
    return replace(_fit_known(known, settings, threads), is_associated=True)


def _fit_known(log: SlamLog, settings: FilterSettings, threads: int | None) -> NoiseFit:
    """Fit the noise of a log that identifies its readings."""
    timed = events_of(log)
    slam = _filter(log, settings)
    likelihood = LogLikelihood(slam, timed.events, threads=threads)
    with one_blas_thread():
        found = most_likely_noise(likelihood.sample(), noise_of(settings))
        noise = found.noise
        before = _fitted(likelihood, settings, noise_of(settings))
        fitted = _fitted(likelihood, settings, noise)
        inflated = noise.copy()
        bearing, distance = fitted.whiteness
        inflated[[BEARING, IN_METRES]] *= bearing.inflation
        inflated[[RANGE, PER_METRE]] *= distance.inflation
        same = np.array_equal(inflated, noise)
        suggested = fitted if same else _fitted(likelihood, settings, inflated)
        calibration = calibrate(likelihood, log, timed.times, noise)
    steps = np.diff(timed.events.first_readings)
    return NoiseFit(
        log,
        found.table,
        before,
        fitted,
        suggested,
        calibration,
        np.repeat(timed.times, steps),
        len(timed.events.readings),
        found.passes,
    )


def _filter(log: SlamLog, settings: FilterSettings) -> EkfSlam:
    """Return the filter at the start of the log, without landmark management."""
    options = {k: v for k, v in settings.options.items() if k != "management"}
    slam = replace(settings, options=options).make(log.start)
    if not (isinstance(slam, EkfSlam) and can_batch(slam)):
        raise ValueError(
            f"the noise cannot be fitted with '{settings.estimator}': take a filter "
            "that runs in batches, such as invariant or ekf"
        )
    return slam


def _fitted(
    likelihood: LogLikelihood, settings: FilterSettings, noise: Array
) -> Fitted:
    record = likelihood.record(noise[None])
    return Fitted(
        with_noise(settings, noise),
        float(record.log_likelihoods.sum()),
        int(record.rejected[0]),
        whiteness(likelihood.events, record),
        record.innovations[0],
    )
