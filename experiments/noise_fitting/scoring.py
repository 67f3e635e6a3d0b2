"""Maximum likelihood of positive parameters by scoring, several values at a time.

`maximise` climbs. The data of the likelihood are the events of a log (`events_of`);
`associated_log` first associates readings without identity.

Symbols
-------
θ      logarithms of the p parameters
ℓ_s    log likelihood of step s given those before; ℓ = Σ ℓ_s
g_s    its score ∂ℓ_s/∂θ, by central differences
I      Σ g_s g_sᵀ, the outer product of scores, which estimates the information
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from ...arrays import Array, BoolArray, IntArray
from ...estimator.filters.drive_likelihood import DriveEvents
from ...estimator.interface import SlamEstimator
from ...estimator.map_management.managed_slam import filter_in
from ...estimator.smoother import Drive, RecordedSlam
from ...estimator.smoother.drive import Sightings
from ..logs.recording import predictions, predictions_until, steps_of
from ..logs.slamlog import OdometryRow, Scan, SlamLog
from ..run_and_replay.filter_settings import SMOOTHER, FilterSettings
from ..run_and_replay.log_replay import Progress, replay

#: Of parameters (B, p), the log likelihoods (B, S) of the steps.
Likelihoods = Callable[[Array], Array]

NARROW = 0.01  # step of the differences, in θ
JUMP = 0.1  # in ℓ_s, between both sides of θ: no smooth ℓ_s bends so much
FARTHEST = 2.0  # the most that an iteration changes one θ
SHARES = (8.0, 3.0, 1.5, 1.0, 0.5, 0.15)  # of the step that are tried at once
FAINT = 0.05  # information on θ beside which that of the readings is none
LITTLE = 16.0  # information on θ, that of a standard deviation of ¼
GAIN = 1e-3  # in ℓ, below which a climb ends: a step of .04 standard deviations
BETTER = 1e-2  # in ℓ, from which on one value is more likely than another
MOST = 60  # iterations of a climb
CLIMBS = 8
LEAST, GREATEST = 1e-7, 1e3  # of a parameter
SIZES = 10.0 * 2.0 ** -np.arange(21)  # tried of a poorly determined parameter


class Maximum(NamedTuple):
    """The most likely parameters."""

    #: Shape (p,).
    parameters: Array
    log_likelihood: float
    #: I, shape (p, p).
    information: Array
    converged: bool
    #: Number of values tried.
    passes: int


class Scores(NamedTuple):
    """The log likelihood about one θ."""

    #: ℓ.
    value: float
    #: Σ g_s, shape (p,).
    gradient: Array
    #: I, shape (p, p).
    information: Array


class _Climb(NamedTuple):
    theta: Array
    scores: Scores
    converged: bool
    passes: int


def maximise(
    likelihoods: Likelihoods, starts: Array, *, most: int = MOST, gain: float = GAIN
) -> Maximum:
    """Find the most likely parameters by scoring (Berndt et al. [1]_).

    ::

        θ ← θ + a (I + λ diag I)⁻¹ Σ g_s

    with the best of several a. The damping λ increases if no step improves the
    likelihood. A parameter without effect keeps its value.

    As σ → 0, the slope along log σ vanishes like σ², whether zero is likely or not.
    When a climb ends, each poorly determined parameter is therefore tried with values
    of all sizes, and the climb continues from the best of them.

    Parameters
    ----------
    likelihoods : callable
        See :data:`Likelihoods`.
    starts : ndarray, shape (k, p)
        Parameters > 0; the search begins at the most likely of them.
    most : int
        Iterations of a climb.
    gain : float
        A climb ends where the next step is expected to raise ℓ by less than this, or
        where the last trial has changed it by less, as beside a jump of ℓ.

    Raises
    ------
    numpy.linalg.LinAlgError
        If no start has a finite likelihood.

    References
    ----------
    .. [1] E. Berndt, B. Hall, R. Hall, J. Hausman, Estimation and inference in
       nonlinear structural models, Annals of Economic and Social Measurement 3(4),
       1974.
    """
    values = totals(likelihoods(starts))
    best = int(np.argmax(values))
    if not np.isfinite(values[best]):
        raise np.linalg.LinAlgError("the readings are impossible under every noise")
    theta, passes = np.log(starts[best]), len(starts)
    for _ in range(CLIMBS):
        climb = _climb(likelihoods, theta, most, gain)
        passes += climb.passes
        if not climb.converged:
            break
        tried = _of_other_sizes(climb)
        values = totals(likelihoods(np.exp(tried)))
        passes += len(tried)
        if not (values > climb.scores.value + BETTER).any():
            break
        theta = tried[int(np.argmax(values))]
    value, _, information = climb.scores
    return Maximum(np.exp(climb.theta), value, information, climb.converged, passes)


def _climb(likelihoods: Likelihoods, theta: Array, most: int, gain: float) -> _Climb:
    here, damping, passes = scores(likelihoods, theta), 1e-3, 2 * len(theta) + 1
    for _ in range(most):
        step = _step(here, damping)
        if 0.5 * float(here.gradient @ step) < gain:
            return _Climb(theta, here, True, passes)
        if damping > 1e4:
            break
        steps = np.clip(np.outer(SHARES, step), -FARTHEST, FARTHEST)
        tried = np.clip(theta + steps, np.log(LEAST), np.log(GREATEST))
        by_step = likelihoods(np.exp(tried))
        found = totals(by_step)
        passes += len(tried)
        best = int(np.argmax(found))
        rise = found[best] - here.value
        if rise > 0:
            damping *= 0.2 if SHARES[best] >= 0.5 else 4
            theta = tried[best]
            here = scores(likelihoods, theta, here=by_step[best])
            passes += 2 * len(theta)
        else:
            damping *= 30
        if abs(rise) < gain:
            return _Climb(theta, here, True, passes)
    return _Climb(theta, here, False, passes)


def _of_other_sizes(climb: _Climb) -> Array:
    """Return θ with several values of each poorly determined entry, (B, p)."""
    little = np.flatnonzero(np.diag(climb.scores.information) < LITTLE)
    tried = np.tile(climb.theta, (len(little) * len(SIZES), 1))
    tried[np.arange(len(tried)), np.repeat(little, len(SIZES))] = np.tile(
        np.log(SIZES), len(little)
    )
    return tried


def scores(
    likelihoods: Likelihoods,
    theta: Array,
    *,
    here: Array | None = None,
    beside_jumps: bool = False,
) -> Scores:
    """Return ℓ, its gradient and I at one θ, of 2p + 1 passes, or 2p with ``here``.

    Parameters
    ----------
    likelihoods : callable
    theta : ndarray, shape (p,)
    here : ndarray, shape (S,), optional
        The log likelihoods there, if they are known.
    beside_jumps : bool
        Whether the slope beside a jump is that of the side without it.  ℓ_s jumps where
        a filter begins to linearise a reading once more.
    """
    offsets, p = NARROW * np.eye(len(theta)), len(theta)
    points = [] if here is not None else [theta[None]]
    around = likelihoods(np.exp(np.vstack([*points, theta + offsets, theta - offsets])))
    here = around[0] if here is None else here
    above, below = around[-2 * p : -p], around[-p:]
    usable = np.isfinite(above) & np.isfinite(below)
    slopes = np.zeros_like(above)
    slopes[usable] = (above[usable] - below[usable]) / (2 * NARROW)
    if beside_jumps:
        sides = (above - here) / NARROW, (here - below) / NARROW
        jumps = usable & (np.abs(sides[0] - sides[1]) * NARROW > JUMP)
        nearer = np.where(np.abs(sides[0]) < np.abs(sides[1]), *sides)
        slopes[jumps] = nearer[jumps]
    value = float(totals(here[None])[0])
    return Scores(value, slopes.sum(axis=1), slopes @ slopes.T)


def curvature(likelihoods: Likelihoods, theta: Array, widths: Array) -> Array:
    """Return −∂²ℓ/∂θ², shape (p, p), by differences of these widths (p,)."""
    p, (rows, columns) = len(theta), np.triu_indices(len(theta))
    steps = np.diag(widths)
    both = np.vstack([steps, steps[rows] + steps[columns]])
    around = np.exp(theta + np.vstack([np.zeros(p), both, -both]))
    here, *values = totals(likelihoods(around))
    rises = np.reshape(values, (2, -1)).sum(axis=0) - 2 * here  # of both sides
    result = np.empty((p, p))
    products = rises[p:] - rises[rows] - rises[columns]
    result[rows, columns] = -products / (2 * widths[rows] * widths[columns])
    result[columns, rows] = result[rows, columns]
    np.fill_diagonal(result, -rises[p:][rows == columns] / (2 * widths) ** 2)
    return result


def restricted(
    likelihoods: Likelihoods, parameters: Array, chosen: IntArray
) -> Likelihoods:
    """Return the likelihoods as functions of some parameters, the others as given."""

    def along(some: Array) -> Array:
        whole = np.tile(parameters, (len(some), 1))
        whole[:, chosen] = some
        return likelihoods(whole)

    return along


def totals(likelihoods: Array) -> Array:
    """Return ℓ of each value; -inf if it is not a number."""
    sums = likelihoods.sum(axis=1)
    return np.where(np.isnan(sums), -np.inf, sums)


def _step(here: Scores, damping: float) -> Array:
    weights = damping * np.diag(here.information) + FAINT
    step = np.linalg.solve(here.information + np.diag(weights), here.gradient)
    return np.asarray(step, dtype=np.float64)


def associated_log(
    log: SlamLog, settings: FilterSettings, progress: Progress | None = None
) -> SlamLog:
    """Return a log with the identities on which a filter decides.

    The landmarks are those of the filter's final map, as for the smoother; readings of
    others are left out. The odometry between two scans gets the time of the second one.
    True positions of landmarks are left out, because their ids would be others.

    Parameters
    ----------
    log : SlamLog
        Without identities.
    settings : FilterSettings
        Of the filter, with its landmark management.
    progress : callable, optional
        Called with (steps done, steps).
    """
    options = {**settings.options, "follow": settings.estimator}
    slam = replace(settings, estimator=SMOOTHER, options=options).make(log.start)
    replay(log, slam, progress=progress)
    header = {k: v for k, v in log.header.items() if k != "identities"}
    return replace(
        log,
        header=header,
        motion="turn-last",
        events=tuple(_events(log, _recorded(slam))),
        landmark_ids=np.empty(0, dtype=np.int64),
        landmarks=np.empty((0, 2)),
    )


def _recorded(slam: SlamEstimator) -> Drive:
    """Return the drive that a managed smoother has recorded."""
    inner = filter_in(slam)
    if not isinstance(inner, RecordedSlam):
        raise ValueError(f"{type(inner).__name__} records no associations")
    return inner.recorded()


def _events(log: SlamLog, drive: Drive) -> Iterator[OdometryRow | Scan]:
    """Yield the events of a drive, pose by pose."""
    motions = [motion.steps for motion in drive.motions]
    times = _times_after(log, np.cumsum([len(steps) for steps in motions]))
    for pose, (steps, t) in enumerate(zip(motions, times.tolist(), strict=True)):
        for distance, turn, dt in steps:
            yield OdometryRow(t, distance, turn, dt)
        for readings, ids in drive.sightings(pose).distinct():
            yield Scan(t, readings, ids)


def _times_after(log: SlamLog, counts: IntArray) -> Array:
    """Return the times after these numbers of predictions."""
    times = np.array([step.t for step in steps_of(log)])
    reached = np.searchsorted(predictions_until(log), counts)
    return times[np.minimum(reached, len(times) - 1)]


Motion = tuple[float, float, float]
#: Steps of a drive, from the first to before the second.
Stretch = tuple[int, int]


class TimedEvents(NamedTuple):
    """The events of a log, and the time of each step."""

    events: DriveEvents
    #: Shape (S,).
    times: Array


def events_of(log: SlamLog) -> TimedEvents:
    """Return the events of a log that identifies its readings, one step of each replay.

    Raises
    ------
    ValueError
        If the log has no scan, no motion, or no landmark that is read twice.
    """
    motions: list[Motion] = []
    sightings = [Sightings(np.empty((0, 2)), np.empty(0, dtype=np.int64))]
    until_motions, until_readings, times = [0], [0], []
    for step in steps_of(log):
        for row in step.motions:
            motions += [(*u, dt) for u, dt in predictions(row, log.motion)]
        count, scan = 0, step.scan
        if scan is not None and scan.landmark_ids is not None:
            sightings.append(Sightings(scan.measurements, scan.landmark_ids))
            count = len(scan.landmark_ids)
        until_motions.append(len(motions))
        until_readings.append(until_readings[-1] + count)
        times.append(step.t)
    readings, ids = zip(*sightings, strict=True)
    events = DriveEvents(
        np.array(motions, dtype=np.float64).reshape(-1, 3),
        np.array(until_motions, dtype=np.int64),
        np.concatenate(readings),
        _numbered(np.concatenate(ids)),
        np.array(until_readings, dtype=np.int64),
    )
    _refuse_empty(log, events)
    return TimedEvents(events, np.array(times))


def without_readings(events: DriveEvents, dropped: BoolArray) -> DriveEvents:
    """Return the events without some readings, where ``dropped`` (M,) is True."""
    kept = ~dropped
    counts = np.concatenate([[0], np.cumsum(kept)])
    return events._replace(
        readings=events.readings[kept],
        landmarks=events.landmarks[kept],
        first_readings=counts[events.first_readings],
    )


def scans_of(events: DriveEvents) -> DriveEvents:
    """Return the events with one step per scan, without motions after the last scan."""
    ends = np.append(0, np.flatnonzero(np.diff(events.first_readings)) + 1)
    motions, readings = events.first_motions[ends], events.first_readings[ends]
    return events._replace(
        motions=events.motions[: motions[-1]],
        first_motions=motions,
        first_readings=readings,
    )


def stretches_of(events: DriveEvents, most: int) -> list[Stretch]:
    """Cut a drive into consecutive stretches with at most so many landmarks each.

    A step with more landmarks is a stretch of its own.
    """
    begins, seen = [0], set[int]()
    for s in range(len(events.first_readings) - 1):
        first, end = events.first_readings[s : s + 2]
        read = set(events.landmarks[first:end].tolist())
        if seen and len(seen | read) > most:
            begins.append(s)
            seen = set()
        seen |= read
    return list(pairwise([*begins, len(events.first_readings) - 1]))


def parts_of(
    events: DriveEvents, stretches: Sequence[Stretch]
) -> tuple[DriveEvents, ...]:
    """Return stretches of a drive, the landmarks of each numbered from 0."""
    if len(stretches) == 1:
        return (events,)
    parts = (_joined(events, [stretch]) for stretch in stretches)
    return tuple(part._replace(landmarks=_numbered(part.landmarks)) for part in parts)


def _numbered(ids: IntArray) -> IntArray:
    """Return the numbers of landmarks from 0, in the order of their ids."""
    return np.unique(ids, return_inverse=True)[1].astype(np.int64)


def sample_of(
    events: DriveEvents, stretches: Sequence[Stretch], most_readings: int
) -> tuple[DriveEvents, list[Stretch]]:
    """Return evenly spread stretches of a drive as one drive, and where they are there.

    About as many readings as asked remain.
    """
    every = int(np.ceil(len(events.readings) / most_readings))
    chosen = stretches[every // 2 :: every] if every > 1 else stretches
    ends = np.cumsum([0, *(end - begin for begin, end in chosen)]).tolist()
    return _joined(events, chosen), list(pairwise(ends))


def _joined(events: DriveEvents, stretches: Sequence[Stretch]) -> DriveEvents:
    def rows(first: IntArray) -> tuple[IntArray, IntArray]:
        """Return which rows are in the stretches, and where those of a step begin."""
        spans = [np.arange(first[begin], first[end]) for begin, end in stretches]
        counts = [np.diff(first[begin : end + 1]) for begin, end in stretches]
        until = np.concatenate([[0], np.cumsum(np.concatenate(counts))])
        return np.concatenate(spans), until

    motions, first_motions = rows(events.first_motions)
    readings, first_readings = rows(events.first_readings)
    return DriveEvents(
        events.motions[motions],
        first_motions,
        events.readings[readings],
        events.landmarks[readings],
        first_readings,
    )


def _refuse_empty(log: SlamLog, events: DriveEvents) -> None:
    if not len(events.readings):
        raise ValueError(
            f"{log.name} holds no scan: without readings of landmarks there are no "
            "innovations to fit a noise to"
        )
    if not events.motions[:, :2].any():
        raise ValueError(
            f"{log.name} holds no motion: the noise of a robot at rest cannot be fitted"
        )
    if len(np.unique(events.landmarks)) == len(events.landmarks):
        raise ValueError(
            f"{log.name} reads no landmark twice: there are no innovations to fit a "
            "noise to"
        )
