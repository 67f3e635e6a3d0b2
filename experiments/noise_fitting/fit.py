"""Fit the noise of a log: find the noise that makes its readings most likely.

`fit_noise` fits, calibrates the sensor with the true path, and tests the whiteness of
the innovations. `write_noise` writes the noise into the header of the log's file.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.special import chdtrc

from ...arrays import Array, IntArray
from ...estimator.filters.batch import can_batch
from ...estimator.filters.drive_likelihood import GATE, DriveEvents, DriveRecord
from ...estimator.filters.ekf import EkfSlam
from ...estimator.kernels.scan_update import USED
from ...estimator.models.rigid_motion import ErrorFrame
from ...evaluation.hypothesis_tests import (
    autocorrelation,
    chi_square_quantile,
    ljung_box,
)
from ...evaluation.nees import pose_nees
from ..logs import slamlog
from ..logs.ground_truth import hides_identities, true_poses_of
from ..logs.log_lines import read_lines, write_whole
from ..run_and_replay.filter_settings import (
    FilterSettings,
    given_log,
    noise_or_assumed,
    one_blas_thread,
    settings_for,
)
from ..run_and_replay.log_replay import Progress
from . import search
from .scoring import associated_log, events_of

#: Of the gate of the fit, as an option of filters.
GATE_PROBABILITY = float(-np.expm1(-GATE / 2))


class Fitted(NamedTuple):
    """A noise, and the innovations of the log under it."""

    settings: FilterSettings
    log_likelihood: float
    #: Readings beyond the gate.
    rejected: int
    #: Of the innovations in bearing and in range.
    whiteness: tuple[Whiteness, Whiteness]
    #: Of the readings, each by its own standard deviation, (M, 2); nan for the first of
    #: each landmark.
    innovations: Array


@dataclass(frozen=True, eq=False)
class NoiseFit:
    """The noise of a log."""

    log: slamlog.SlamLog
    #: The standard deviations that were fitted.
    noise: tuple[search.FittedNoise, ...]
    before: Fitted
    #: With the most likely noise.
    fitted: Fitted
    #: The same, with the noise of the sensor inflated where innovations are not white,
    #: and without motion noise at zero, see `above_zero`; where neither changes the
    #: noise, it is `fitted` itself.
    suggested: Fitted
    #: The factor of the sensor's noise at which the pose NEES is 1 per degree of
    #: freedom; None if the truth is unknown.
    calibration: Calibration | None
    #: Shape (M,).
    reading_times: Array
    readings: int
    #: Number of times that the log was filtered.
    passes: int
    #: Whether a filter associated the readings; they have its identities in `log`.
    is_associated: bool = False


def fit_noise(
    log: slamlog.SlamLog | str | PathLike[str],
    settings: FilterSettings | None = None,
    *,
    progress: Progress | None = None,
    threads: int | None = None,
) -> NoiseFit:
    """Fit the noise of a log by maximum likelihood of a filter's innovations.

    Parameters
    ----------
    log : SlamLog or path
        With odometry and readings.  If it does not identify all landmarks, the filter
        of the settings associates its readings once, with the noise of the settings.
    settings : FilterSettings, optional
        The noise to begin with, and the filter: one that runs in batches.  Without a
        gate they get that of the fit, `GATE_PROBABILITY`.  By default, the invariant
        filter with the noise in the log, or an assumed one.
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
    >>> from slamgym.experiments.run_and_replay import settings_for
    >>> from slamgym.sim_configs import action_sequence, load_scenario
    >>> world = load_scenario("six_landmarks").with_changes(steps=60)
    >>> driver = OpenLoop(action_sequence(world), world.robot)
    >>> log = record_episode(world, driver, seed=3)
    >>> fit = fit_noise(log, settings_for(log, estimator="invariant"))
    >>> [(noise.name, noise.verdict) for noise in fit.noise][:2]
    [('σx', 'fitted'), ('σy', 'fitted')]
    """
    log = given_log(log)
    if settings is None:
        stds: dict[str, Any] = {**noise_or_assumed(log, {})}
        settings = settings_for(log, **stds)
    if not hides_identities(log):
        options = {"gate_probability": GATE_PROBABILITY, **settings.options}
        return _fit_known(log, replace(settings, options=options), threads)
    known = associated_log(log, settings, progress)
    return replace(_fit_known(known, settings, threads), is_associated=True)


def _fit_known(
    log: slamlog.SlamLog, settings: FilterSettings, threads: int | None
) -> NoiseFit:
    """Fit the noise of a log that identifies its readings."""
    timed = events_of(log)
    slam = _filter(log, settings)
    likelihood = search.LogLikelihood(slam, timed.events, threads=threads)
    with one_blas_thread():
        found = search.most_likely_noise(likelihood.sample(), search.noise_of(settings))
        noise = found.noise
        before = _fitted(likelihood, settings, search.noise_of(settings))
        fitted = _fitted(likelihood, settings, noise)
        inflated = above_zero(noise, found.table)
        bearing, distance = fitted.whiteness
        inflated[[search.BEARING, search.IN_METRES]] *= bearing.inflation
        inflated[[search.RANGE, search.PER_METRE]] *= distance.inflation
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


def above_zero(noise: Array, table: Sequence[search.FittedNoise]) -> Array:
    """Replace motion noise that may be zero by the upper end of its interval.

    A filter without a part of the motion noise soon becomes certain of this part, and
    then rejects readings that contradict it.  The upper end of the 95 % interval still
    agrees with them.  Where it is unknown, the noise is that before the fit.

    Parameters
    ----------
    noise : ndarray, shape (7,)
        The most likely noise.
    table : sequence of FittedNoise
        Its entries, the motion noise first.

    Returns
    -------
    ndarray, shape (7,)
    """
    result = noise.copy()
    for i, entry in enumerate(table[: search.BEARING]):
        if entry.verdict == "zero":
            result[i] = entry.high if np.isfinite(entry.high) else entry.before
    return result


def _filter(log: slamlog.SlamLog, settings: FilterSettings) -> EkfSlam:
    """Return the filter at the start of the log, without landmark management."""
    slam = settings.unmanaged().make(log.start)
    if not (isinstance(slam, EkfSlam) and can_batch(slam)):
        raise ValueError(
            f"the noise cannot be fitted with '{settings.estimator}': take a filter "
            "that runs in batches, such as invariant or ekf"
        )
    return slam


def _fitted(
    likelihood: search.LogLikelihood, settings: FilterSettings, noise: Array
) -> Fitted:
    record = likelihood.record(noise[None])
    return Fitted(
        search.with_noise(settings, noise),
        float(record.log_likelihoods.sum()),
        int(record.rejected[0]),
        whiteness(likelihood.events, record),
        record.innovations[0],
    )


TAILS = (0.025, 0.975)
FACTORS = np.geomspace(0.25, 16.0, 19)


class Calibration(NamedTuple):
    """The factor of the sensor's noise at which the pose NEES is as expected."""

    #: 0 or infinity if none of `FACTORS` is small or large enough; likewise below.
    factor: float
    #: Of its 95 % interval.
    low: float
    high: float


def calibrate(
    likelihood: search.LogLikelihood, log: slamlog.SlamLog, times: Array, noise: Array
) -> Calibration | None:
    """Return the factor of the sensor's noise at which NEES has its expected value.

    The mean NEES of one drive has a large variance, because successive steps are
    correlated. The interval holds the factors whose mean NEES is within `nees_bounds`.

    Parameters
    ----------
    likelihood : LogLikelihood
        Of the log.
    log : SlamLog
        With its truth, if that is known.
    times : ndarray, shape (S,)
        Of the steps.
    noise : ndarray, shape (7,)
        The noise whose sensor part is multiplied.

    Returns
    -------
    Calibration or None
        Where the mean NEES of the pose is 1 per degree of freedom.  None where the true
        poses are unknown.
    """
    truth = true_poses_of(log, times)
    if truth is None or not np.isfinite(truth).all(axis=1).any():
        return None
    noises = np.tile(noise, (len(FACTORS), 1))
    noises[:, search.BEARING :] *= FACTORS[:, None]
    whole = replace(likelihood, most_landmarks=len(likelihood.events.readings))
    record = whole.record(noises)
    nees = [
        _known_nees(truth, poses, covariances, likelihood.filter.frame)
        for poses, covariances in zip(
            record.poses, record.pose_covariances, strict=True
        )
    ]
    usable = [k for k, values in enumerate(nees) if values.sum() > 0]
    if not usable:
        return None
    ratios = np.array([nees[k].mean() / 3 for k in usable])
    bounds = np.array([nees_bounds(nees[k]) for k in usable])
    factors = np.log(FACTORS[usable])
    return Calibration(
        _crossing(factors, np.log(ratios)),
        _crossing(factors, np.log(ratios / bounds[:, 1])),
        _crossing(factors, np.log(ratios / bounds[:, 0])),
    )


def _known_nees(
    truth: Array, poses: Array, covariances: Array, frame: ErrorFrame
) -> Array:
    with np.errstate(invalid="ignore", divide="ignore"):
        values = pose_nees(truth, poses, covariances, frame=frame)
    return values[np.isfinite(values)]


def nees_bounds(nees: Array) -> tuple[float, float]:
    """Return the 95 % interval of the mean NEES per degree if the noise is right.

    It is that of χ²(ν)/ν, with ν ≥ 3 and the autocorrelations about the expected mean
    and variance of the NEES of a pose, 3 and 6::

        ν = 3N / (1 + 2 Σ ρ_k),    ρ_k = Σ_t (ε_t − 3)(ε_{t+k} − 3) / 6N

    About its own mean, a constant series would look white.

    Parameters
    ----------
    nees : ndarray, shape (N,)
        Of one drive, step after step.
    """
    excess = nees - 3
    spectrum = np.abs(np.fft.rfft(excess, 2 * len(nees))) ** 2
    products = np.fft.irfft(spectrum, 2 * len(nees))[1 : len(nees) // 2]
    together = 1 + 2 * positive_sum(products / (6 * len(nees)))
    degrees = max(3.0, 3 * len(nees) / together)
    low, high = chi_square_quantile(TAILS, degrees) / degrees
    return float(low), float(high)


def _crossing(factors: Array, ratios: Array) -> float:
    """Return the factor at which decreasing ratios first reach 1, from logarithms."""
    below = np.flatnonzero(ratios <= 0)
    if not len(below):
        return np.inf
    k = int(below[0])
    if k == 0:
        return 0.0
    share = ratios[k - 1] / (ratios[k - 1] - ratios[k])
    return float(np.exp(factors[k - 1] + share * (factors[k] - factors[k - 1])))


# --------------------------------------------------------------------------------------
# The correlation of innovations in time, and the inflation of the noise for it.

LAGS = 10  # of the test
LONGEST = 50  # lag at which a sum of correlations ends at the latest
SIGNIFICANT = 0.01


class Whiteness(NamedTuple):
    """The correlation in time of innovations, scan by scan and for each landmark."""

    #: Of two Ljung-Box tests, the smaller one twice; nan for too few innovations.
    p_value: float
    #: Correlation of one innovation of a landmark with its next.
    first: float
    #: Suggested factor of the standard deviation, 1 for white ones.
    inflation: float


def whiteness(events: DriveEvents, record: DriveRecord) -> tuple[Whiteness, Whiteness]:
    """Return the whiteness of the bearing and of the range innovations.

    The innovations are those of one pass, each by its own standard deviation.  A filter
    takes N readings for independent ones.  Where their errors are correlated, their sum
    varies as that of more [1]_::

        var Σ ν = N τ,    τ = 1 + 2 Σ ρ_k,    k = 1, 2, … while ρ_k + ρ_{k+1} > 0

    so that σ √τ makes the filter as uncertain as it should be after many of them.  The
    pose depends on the readings of all landmarks together, where errors of single
    landmarks average out; the place of a landmark depends on its own, where they do
    not.  The inflation is the geometric mean of both.

    References
    ----------
    .. [1] C. Geyer, Practical Markov chain Monte Carlo, Statistical Science 7(4), 1992.
    """
    bearing, distance = (_of_axis(events, record, axis) for axis in range(2))
    return bearing, distance


def _of_axis(events: DriveEvents, record: DriveRecord, axis: int) -> Whiteness:
    scans = _judged(scan_series(events, record, axis))
    used = max(int(np.count_nonzero(record.used[0])), 1)
    together = max(float(record.used[0].sum()) / used, 1.0)
    landmarks = _judged(landmark_series(events, record, axis), together)
    p_values = [white.p_value for white in (scans, landmarks)]
    known = [p for p in p_values if np.isfinite(p)]
    return Whiteness(
        min(1.0, 2 * min(known)) if known else np.nan,
        landmarks.first,
        float(np.sqrt(scans.inflation * landmarks.inflation)),
    )


def scan_series(events: DriveEvents, record: DriveRecord, axis: int) -> Array:
    """Return Σ ν/σ / √m of the m readings used of each scan, shape (1, scans)."""
    steps = np.repeat(
        np.arange(len(events.first_readings) - 1), np.diff(events.first_readings)
    )
    used: IntArray = np.flatnonzero(record.outcomes[0] == USED)
    sums = np.bincount(steps[used], record.innovations[0, used, axis])
    counts = np.bincount(steps[used])
    return (sums[counts > 0] / np.sqrt(counts[counts > 0]))[None]


def landmark_series(events: DriveEvents, record: DriveRecord, axis: int) -> Array:
    """Return ν/σ of each landmark, one after the other, (landmarks, most), else nan."""
    used: IntArray = np.flatnonzero(record.outcomes[0] == USED)
    landmarks = events.landmarks[used]
    counts = np.bincount(landmarks, minlength=1)
    order = np.argsort(landmarks, kind="stable")
    places = np.arange(len(used)) - np.repeat(np.cumsum(counts) - counts, counts)
    series = np.full((len(counts), max(int(counts.max()), 1)), np.nan)
    series[landmarks[order], places] = record.innovations[0, used[order], axis]
    return series


def _judged(series: Array, together: float = 1.0) -> Whiteness:
    """Test a series of readings; up to `together` of them share the error of one pose.

    Correlations of landmarks that are seen together are no independent evidence: at
    worst, so many of them count as one.
    """
    steps = series.shape[1]
    if steps < 2 * LAGS or np.isfinite(series).sum() < 4 * LAGS:
        return Whiteness(np.nan, np.nan, 1.0)
    correlations, _ = autocorrelation(series, lags=min(LONGEST, steps // 2))
    statistic = ljung_box(series, lags=LAGS).statistic / together
    p_value = float(chdtrc(LAGS, statistic))
    factor = 1.0
    if p_value < SIGNIFICANT:
        factor = max(1.0, float(np.sqrt(1 + 2 * positive_sum(correlations))))
    return Whiteness(p_value, float(correlations[0]), factor)


def positive_sum(correlations: Array) -> float:
    """Sum pairs of correlations up to the first pair that is not positive."""
    pairs = correlations[: len(correlations) // 2 * 2].reshape(-1, 2).sum(axis=1)
    ends = np.flatnonzero(pairs <= 0)
    return float(pairs[: ends[0] if len(ends) else None].sum())


def refuse_other_formats(path: str | PathLike[str]) -> None:
    """Refuse a log that has no header for a noise.

    Raises
    ------
    LogError
        If the file is no slamlog 1.
    """
    is_file = Path(path).is_file()
    if not is_file or slamlog.format_line_of(read_lines(path)) is None:
        raise slamlog.LogError(
            f"{path}: only the header of a slamlog 1 holds a noise; slamgym replay "
            "writes one of any log, log.csv"
        )


def write_noise(path: str | PathLike[str], settings: FilterSettings) -> None:
    """Put the noise of settings into the header of a slamlog 1.

    Every other line keeps its bytes.  The file is replaced at once or not at all.

    Parameters
    ----------
    path : path
        The file.
    settings : FilterSettings
        Their motion_std, measurement_std, range_std_per_metre and bearing_std_metres.

    Raises
    ------
    LogError
        If the file is no slamlog 1, or cannot be written.
    """
    refuse_other_formats(path)
    values = {
        "motion_std": slamlog.numbers(*settings.motion_std),
        "measurement_std": slamlog.numbers(*settings.measurement_std),
    }
    for key in ("range_std_per_metre", "bearing_std_metres"):
        if key in settings.options:
            values[key] = slamlog.numbers(settings.options[key])
    with Path(path).open(encoding="utf-8", newline="") as stream:
        lines = stream.read().split("\n")
    write_whole(path, "\n".join(_with_header(lines, values)))


def _with_header(lines: list[str], values: dict[str, str]) -> list[str]:
    """Replace the header's lines of some keys; add the others below its first line."""
    keys = [_key(line) for line in lines]
    end = "\r" if any(line.endswith("\r") for line in lines) else ""
    result = [
        f"# {key}: {values[key]}{end}" if key in values else line
        for key, line in zip(keys, lines, strict=True)
    ]
    first = next(k for k, line in enumerate(lines) if line.strip())
    added = [f"# {key}: {values[key]}{end}" for key in values if key not in keys]
    return [*result[: first + 1], *added, *result[first + 1 :]]


def _key(line: str) -> str | None:
    """Return the key of a line of the header, None for another line."""
    text = line.strip()
    return text[1:].partition(":")[0].strip() if text.startswith("#") else None
