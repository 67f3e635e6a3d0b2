"""The correlation of innovations in time, and the inflation of the noise for it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.special import chdtrc

from ...arrays import Array, IntArray
from ...estimator.kernels.drive_likelihood import DriveEvents, DriveRecord
from ...estimator.kernels.kalman_gain import USED
from ...evaluation.hypothesis_tests import autocorrelation, ljung_box

LAGS = 10  # of the test
LONGEST = 50  # lag at which a sum of correlations ends at the latest
SIGNIFICANT = 0.01


class Whiteness(NamedTuple):
    """The correlation in time of innovations, scan by scan and for each landmark."""

    p_value: float
    """Of two Ljung-Box tests, the smaller one twice; nan for too few innovations."""
    first: float
    """Correlation of one innovation of a landmark with its next."""
    inflation: float
    """Suggested factor of the standard deviation, 1 for white ones."""


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
