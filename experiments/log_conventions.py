"""Name the convention that a log breaks: `mistake_in_log`.

A log with clockwise bearings, degrees or shifted rows looks like a log with much noise.
`mistake_in_log` reads a part of the log in each of the conventions that are often
confused, and names the one in which its readings agree with its odometry. If they agree
as given, a longer part of the log can still show that the robot turns before it drives,
or that the scans stand one row too late. It names nothing if no convention explains the
log. No truth is needed.

Symbols
-------
d, α   odometry: distance driven, and turn [m, rad]
β, r   bearing and range of a reading [rad, m]
θ      heading by the odometry alone [rad]
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import islice, product
from typing import Any, NamedTuple

import numpy as np

from ..arrays import Array, BoolArray, IntArray
from ..estimator.filters.drive_likelihood import GATE, DriveEvents, drive_likelihood
from ..estimator.filters.ekf import EkfSlam
from ..estimator.models.bearing_range import wrap_angle
from ..evaluation.trajectory_error import position_accuracy
from .logs import ground_truth, recording, slamlog
from .noise_fitting import search
from .run_and_replay.filter_settings import NOISE_KEYS, FilterSettings, one_blas_thread
from .run_and_replay.summary import MOST_REJECTED

#: Size of the part of a log that is read in other conventions: its first landmarks and
#: rows of odometry, and blocks of scans spread over them.
_LANDMARKS, _ROWS, _READINGS, _BLOCK = 40, 8000, 800, 12
_UNREAD = -1  # id of all other landmarks
_FEWEST = 30  # readings that are enough to recognise a convention
#: Gain in log likelihood per reading [nats], and in all, that names a mistake; and by
#: how much it leads over the next one.
_GAIN, _TOTAL, _LEAD = 0.2, 20.0, 0.05
#: NIS per degree of freedom that is no reason to look at other conventions.
_USUAL = (0.6, 1.4)
#: Loss by the noise as given that is no reason to look at other conventions [nats].
_LOSS = 0.1
_SKIPPED = 10.0  # loss by an unusable reading, such as one of range ≤ 0 [nats]
_TWIN = 1e-3  # largest difference of two mirror images [nats]
_NEARER = 2.0  # factor of errors by which the truth separates mirror images
#: Factors of the noise as given, of motion and of sensor; of `_FEW`, a few of them.
_SIZES = (1 / 16, 1 / 4, 1.0, 4.0, 16.0)
_FACTORS = np.array(list(product(_SIZES, _SIZES)))
_FEW = np.array([(1, 1), (4, 4), (0.25, 0.25), (1, 0.25), (4, 1), (0.25, 0.0625)])
_FINALISTS = 3
_LARGEST = 4.0  # factor of the noise with which a mistake explains a log
#: For mistakes that the noise hides: number of readings of a longer part, number of its
#: pieces, least rise of the log likelihood per reading [nats], least number of standard
#: errors of this rise, and least share of the pieces in which the likelihood rises.
_MANY, _PIECES, _RISE, _ERRORS, _MOST = 6000, 30, 0.08, 3.0, 0.95
_NOTABLE = 2.0  # change of a piece that counts [nats]
_APART = 2.0  # standard errors beyond which two hidden mistakes differ
_FINE, _SEARCHES = np.array(list(product((0.5, 1.0, 2.0), repeat=2))), 3
_DEGREE = np.pi / 180
#: Durations of a step that turn velocities into increments where rows hold none [s].
_DURATIONS = (0.5, 0.25, 0.2, 0.1, 0.05, 0.04, 1 / 30, 0.02, 0.01)


class WrongConvention(NamedTuple):
    """A convention of a log other than the documented one, and its remedy."""

    #: What the log has, as a sentence without an end.
    name: str
    #: What to change in the log.
    remedy: str
    #: Rise of the log likelihood per reading, each with its best noise [nats].
    gain: float
    #: NIS per degree of freedom as read in this convention, and as given; that of a
    #: rejected reading counts as the gate.
    nis: tuple[float, float]
    #: Share of the readings that the gate rejects, likewise.
    rejected: tuple[float, float]
    #: Factors of the noise of motion and sensor under which both hold.
    factors: tuple[float, float] = (1.0, 1.0)

    def as_dict(self) -> dict[str, Any]:
        """Return plain JSON types; each pair is in this convention, and as given."""
        return {**self._asdict(), "text": str(self)}

    def __str__(self) -> str:
        noise = ""
        if self.factors != (1, 1):
            noise = (
                " and with {:g} × the noise of the motion, {:g} × that of the sensor"
            )
        (nis, was), (lost, were) = self.nis, self.rejected
        return (
            f"The log breaks a convention: {self.name}. Without this mistake"
            f"{noise.format(*self.factors)}, NIS is {nis:.2g} per degree of freedom, "
            f"not {was:.3g}, {lost:.0%} of the readings are rejected, not {were:.0%}, "
            f"and the log likelihood rises by {self.gain:.2g} per reading. "
            f"Remedy: {self.remedy}."
        )


class LogAsRead(NamedTuple):
    """A part of a log, as read in some convention."""

    #: Rows (d, α, dt) of odometry, (K, 3), and the step of each, (K,).
    rows: Array
    row_steps: IntArray
    #: Rows (β, r), (M, 2), the landmark of each (M,), and its step (M,).
    measurements: Array
    landmarks: IntArray
    steps: IntArray
    #: Steps whose scans are read.
    is_read: BoolArray
    #: Where a row turns: "turn-last", "midpoint" or "turn-first".
    motion: str
    #: Heading at the start.
    start: float
    #: Logarithm of the volume of a measurement as read, by that in the file.
    log_volume: float = 0.0
    #: Rows of odometry by which the scans are moved.
    moved: int = 0


def mistake_in_log(
    log: slamlog.SlamLog, settings: FilterSettings
) -> WrongConvention | None:
    """Return the convention that a log breaks, or None if it is not known.

    The log is compared by the likelihood of its readings, each with the best of several
    noises. Another convention is named only if it explains the log: the likelihood
    rises far, few readings are rejected, and no other convention does the same.

    Parameters
    ----------
    log : SlamLog
        Bearings and ranges with identities; other logs give None.
    settings : FilterSettings
        Settings of a filter for the log, which state its noise.

    Examples
    --------
    >>> from slamgym.envs.controllers import OpenLoop
    >>> from slamgym.experiments.logs import record_episode
    >>> from slamgym.experiments.run_and_replay import settings_for
    >>> from slamgym.sim_configs import action_sequence, load_scenario
    >>> world = load_scenario("loop").with_changes(steps=60)
    >>> driver = OpenLoop(action_sequence(world), world.robot)
    >>> log = record_episode(world, driver, seed=0)
    >>> mistake_in_log(log, settings_for(log)) is None
    True
    >>> for scan in log.scans:
    ...     scan.measurements[:] = scan.measurements[:, ::-1]  # range first
    >>> mistake_in_log(log, settings_for(log)).name
    'the range stands before the bearing'
    """
    is_usual = log.motion in slamlog.UNICYCLES and "sensor" not in log.header
    if not is_usual or ground_truth.hides_identities(log) or not log.scans:
        return None
    given = part_of(log)
    if given is None or is_used(given).sum() < _FEWEST or not len(given.rows):
        return None
    with one_blas_thread():
        return _Comparison(log, settings, given).mistake()


def part_of(log: slamlog.SlamLog) -> LogAsRead | None:
    """Return the part of a log that is read in other conventions, as it is given.

    The part ends before the first scan that shows none of its landmarks. Landmarks
    outside the part get the id `_UNREAD`. The result is None if the part has no scan,
    because the first one comes late.
    """
    rows: list[tuple[float, float, float]] = []
    row_steps, scans, steps, sizes = [], [], [], []
    known = dict[int, int]()
    count = 0
    for step in recording.steps_of(log):
        scan = step.scan
        ids = None if scan is None else scan.landmark_ids
        named = [] if ids is None else ids.tolist()
        room = _LANDMARKS - len(known)
        known |= {i: i for i in [i for i in named if i not in known][:room]}
        shown = sum(i in known for i in named)
        if len(rows) > _ROWS or (named and not shown):
            break
        rows += [(row.d, row.alpha, row.dt) for row in step.motions]
        row_steps += [count] * len(step.motions)
        if scan is not None:
            scans.append(scan)
            steps.append(count)
            sizes.append(shown)
        count += 1
    if not scans:
        return None
    every = -(-sum(sizes) // _READINGS)
    is_read = np.zeros(count, dtype=bool)
    is_read[np.array(steps)[np.arange(len(steps)) // _BLOCK % max(every, 1) == 0]] = (
        True
    )
    ids = np.concatenate([scan.landmark_ids for scan in scans])
    return LogAsRead(
        np.array(rows, dtype=np.float64).reshape(-1, 3),
        np.array(row_steps, dtype=np.int64),
        np.concatenate([scan.measurements for scan in scans]),
        np.where(np.isin(ids, list(known)), ids, _UNREAD),
        np.repeat(
            np.array(steps, dtype=np.int64), [len(scan.measurements) for scan in scans]
        ),
        is_read,
        log.motion,
        float(log.start[2]),
    )


def unbroken(given: LogAsRead) -> LogAsRead:
    """Return a part of a log with its first readings, without gaps between them."""
    read = np.flatnonzero(given.landmarks != _UNREAD)[:_MANY]
    last = given.steps[read[-1]]
    return given._replace(is_read=np.arange(len(given.is_read)) <= last)


def events_of(reading: LogAsRead) -> DriveEvents:
    """Return the input of a filter for a part of a log."""
    d, alpha, dt = reading.rows.T
    zero = np.zeros_like(d)
    motions = {
        "turn-last": [(d, alpha, dt)],
        "turn-first": [(zero, alpha, zero), (d, zero, dt)],
        "midpoint": [(zero, alpha / 2, zero), (d, alpha / 2, dt)],
    }[reading.motion]
    table = np.stack([np.column_stack(motion) for motion in motions], axis=1)
    kept, until = is_used(reading), np.arange(len(reading.is_read) + 1)
    return DriveEvents(
        np.ascontiguousarray(table.reshape(-1, 3)),
        np.searchsorted(reading.row_steps, until) * len(motions),
        reading.measurements[kept],
        np.unique(reading.landmarks[kept], return_inverse=True)[1].astype(np.int64),
        np.searchsorted(reading.steps[kept], until),
    )


def is_used(reading: LogAsRead) -> BoolArray:
    """Return which measurements are read, each landmark once in a scan, (M,)."""
    steps = reading.steps
    used = (steps >= 0) & (steps < len(reading.is_read))
    used &= reading.landmarks != _UNREAD
    used[used] = reading.is_read[steps[used]]
    named = np.column_stack([steps, reading.landmarks])
    is_first = np.zeros(len(used), dtype=bool)
    is_first[np.unique(named, axis=0, return_index=True)[1]] = True
    return np.asarray(used & is_first)


# --------------------------------------------------------------------------------------
# How well readings and odometry agree.


class _LogFit(NamedTuple):
    """How well a part of a log agrees with itself under several noises."""

    #: Mean log likelihood of a reading under each noise.
    likelihoods: Array
    #: NIS per degree of freedom; that of a rejected reading is the gate.
    nis: Array
    #: Share of the readings.
    rejected: Array
    #: Log likelihood of the scan of each step, at its place in the log, (B, S).
    by_step: Array

    @property
    def best(self) -> int:
        """The noise of the largest likelihood."""
        return int(np.argmax(self.likelihoods))

    @property
    def most(self) -> float:
        """The largest likelihood."""
        return float(self.likelihoods.max())


@dataclass(frozen=True)
class _Comparison:
    """The readings of a part of a log in several conventions."""

    log: slamlog.SlamLog
    settings: FilterSettings
    given: LogAsRead

    def mistake(self) -> WrongConvention | None:
        """Return the mistake that explains the log, or None."""
        before = self.fit(self.given, _FACTORS)
        found = self.plain_mistake(before) if _is_far_off(before) else None
        return found or self.hidden_mistake(_FACTORS[before.best])

    def plain_mistake(self, before: _LogFit) -> WrongConvention | None:
        """Return the mistake that explains a log whose NIS is far off."""
        screened = [(self.fit(it.reading, _FEW).most, it) for it in others(self.given)]
        screened.sort(key=lambda pair: -pair[0])
        fits = [(self.fit(it.reading, _FACTORS), it) for _, it in screened[:_FINALISTS]]
        best = max(fit.most for fit, _ in fits)
        near = self.told_apart([pair for pair in fits if pair[0].most > best - _LEAD])
        after, k = near[0][0], near[0][0].best
        explains = after.rejected[k] <= max(MOST_REJECTED, before.rejected[k] / 2)
        if not explains or _FACTORS[k].max() > _LARGEST:
            return None
        gain = after.most - before.most
        if gain < max(_GAIN, _TOTAL / is_used(self.given).sum()):
            return None
        return _named(near, before, _FACTORS[k])

    def hidden_mistake(self, factors: Array) -> WrongConvention | None:
        """Return a mistake that the noise hides from NIS, but the log likelihood shows.

        Two conventions are compared on each piece of a longer part. Both use the noise
        near some factors that fits the log as given best; a larger noise would hide any
        mistake. The rise of the log likelihood must be significant compared with its
        scatter over the pieces [1]_. This test is also valid for wrong noise.

        References
        ----------
        .. [1] Q. H. Vuong, Likelihood ratio tests for model selection and non-nested
           hypotheses, Econometrica 57(2), 1989.
        """
        whole = unbroken(self.given)
        for _ in range(_SEARCHES):
            near_by = np.minimum(factors * _FINE, _LARGEST)
            start, factors = factors, near_by[self.fit(whole, near_by).best]
            if np.array_equal(factors, start):
                break
        before = self.fit(whole, factors[None])
        fits = [(self.fit(it.reading, factors[None]), it) for it in hidden(whole)]
        better = [pair for pair in fits if self.is_better(pair[0], before)]
        better.sort(key=lambda pair: -pair[0].most)
        near = [it for it in better if not _rise(better[0][0], it[0])[0] > _APART]
        if not near or near[0][0].rejected[0] > MOST_REJECTED:
            return None
        return _named(near, before, factors)

    def is_better(self, after: _LogFit, before: _LogFit) -> bool:
        """Return whether the log likelihood rises far enough, and nearly everywhere."""
        errors, share = _rise(after, before)
        least = max(_RISE, _TOTAL / is_used(self.given).sum())
        is_far = after.most - before.most >= least and errors >= _ERRORS
        return is_far and share >= _MOST

    def fit(self, reading: LogAsRead, factors: Array) -> _LogFit:
        """Compare the readings with the odometry, under multiples of the noise."""
        events = events_of(reading)
        record = drive_likelihood(self.filter, events, self.noises(factors))
        count = max(len(events.readings) - int(events.landmarks.max(initial=0)) - 1, 1)
        used = record.used.sum(axis=1)
        lost = np.maximum(count - used, record.rejected)
        skipped = lost - record.rejected
        total = record.log_likelihoods.sum(axis=1) - _SKIPPED * skipped
        return _LogFit(
            np.where(np.isnan(total), -np.inf, total / count + reading.log_volume),
            (record.nis.sum(axis=1) + GATE * lost) / (2 * count),
            lost / count,
            np.roll(record.log_likelihoods, -reading.moved, axis=1),
        )

    @cached_property
    def filter(self) -> EkfSlam:
        """A filter at the start of the log, without a gate and options of its own."""
        options = {k: v for k, v in self.settings.options.items() if k in NOISE_KEYS}
        slam = replace(self.settings, estimator="invariant", options=options).make(
            self.log.start
        )
        assert isinstance(slam, EkfSlam)
        return slam

    def noises(self, factors: Array) -> Array:
        """Return multiples (B, 2) of the noise of motion and sensor, (B, 7)."""
        away = float(np.median(np.abs(self.given.measurements[:, 1])))
        noise = search.positive_start(search.noise_of(self.settings), away)
        return noise * np.repeat(
            factors, (search.BEARING, len(noise) - search.BEARING), axis=1
        )

    def told_apart(
        self, near: list[tuple[_LogFit, Other]]
    ) -> list[tuple[_LogFit, Other]]:
        """Return the mistakes that agree with the truth, where it is known.

        A log with clockwise bearings is the mirror image of one with clockwise turns.
        """
        if len(near) < 2:
            return near
        errors = [self.error(it.reading, _FACTORS[fit.best]) for fit, it in near]
        least = min(errors)
        return [
            pair
            for pair, error in zip(near, errors, strict=True)
            if not error > _NEARER * least
        ]

    def error(self, reading: LogAsRead, factors: Array) -> float:
        """Return the aligned error of landmarks, or path [m]; nan if not known."""
        events = events_of(reading)
        record = drive_likelihood(
            self.filter, events, self.noises(factors[None]), keep_beliefs=True
        )
        poses = record.poses[0]
        steps = np.repeat(np.arange(len(poses)), np.diff(events.first_readings))
        (x, y, heading), (bearing, distance) = poses[steps].T, events.readings.T
        angle = heading + bearing
        seen = x + distance * np.cos(angle), y + distance * np.sin(angle)
        ids = reading.landmarks[is_used(reading)].tolist()
        truth = ground_truth.TrueLandmarks(self.log.landmark_ids, self.log.landmarks)
        times = [step.t for step in islice(recording.steps_of(self.log), len(poses))]
        true_path = ground_truth.true_poses_of(self.log, np.array(times))
        true_seen = truth.of(ids)
        pairs = [(np.column_stack(seen), true_seen), (poses[:, :2], true_path)]
        known = [(each, true[:, :2]) for each, true in pairs if true is not None]
        if not known:
            return np.nan
        estimate, true = (np.concatenate(side) for side in zip(*known, strict=True))
        finite = np.isfinite(true).all(axis=1) & np.isfinite(estimate).all(axis=1)
        if not finite.any():
            return np.nan
        return position_accuracy(estimate[finite], true[finite]).aligned_rmse


def _named(
    found: list[tuple[_LogFit, Other]], before: _LogFit, factors: Array
) -> WrongConvention:
    """Combine mistakes that have the same effect into one."""
    after = found[0][0]
    k = after.best
    return WrongConvention(
        " or ".join(it.name for _, it in found),
        ", or ".join(it.remedy for _, it in found),
        after.most - before.most,
        (float(after.nis[k]), float(before.nis[k])),
        (float(after.rejected[k]), float(before.rejected[k])),
        (float(factors[0]), float(factors[1])),
    )


def _rise(after: _LogFit, before: _LogFit) -> tuple[float, float]:
    """Return the rise of the log likelihood over the pieces of a log.

    Returns
    -------
    errors : float
        Sum of the rises, divided by its standard error.
    share : float
        The share of pieces in which it rises, among those in which it changes notably.
    """
    scans = np.flatnonzero(before.by_step[0])
    with np.errstate(invalid="ignore"):  # where a pass failed
        rises = after.by_step[0, scans] - before.by_step[0, scans]
    if not np.isfinite(rises).all():
        return 0.0, 0.0
    pieces = np.array([part.sum() for part in np.array_split(rises, _PIECES)])
    error = float(pieces.std()) * math.sqrt(_PIECES)
    differ = pieces[abs(pieces) > _NOTABLE]
    share = float((differ > 0).mean()) if len(differ) else 0.0
    return float(rises.sum()) / error if error else 0.0, share


def _is_far_off(fit: _LogFit) -> bool:
    """Return whether a log as given disagrees with its noise."""
    at = int(np.flatnonzero((_FACTORS == 1).all(axis=1))[0])
    low, high = _USUAL
    is_usual = low <= fit.nis[at] <= high and fit.rejected[at] <= MOST_REJECTED
    return not (is_usual and fit.most - fit.likelihoods[at] <= _LOSS)


# --------------------------------------------------------------------------------------
# The conventions.


class Other(NamedTuple):
    """A log as read in another convention."""

    #: What the log has, where this is the right one.
    name: str
    remedy: str
    reading: LogAsRead


def others(given: LogAsRead) -> Iterator[Other]:
    """Yield a part of a log as read in the conventions that are often confused."""
    yield from _of_measurements(given)
    yield from _of_odometry(given)
    yield from _shifted(given)


def _of_measurements(given: LogAsRead) -> Iterator[Other]:
    bearing, distance = given.measurements.T

    def read(b: Array, r: Array = distance, volume: float = 1.0) -> LogAsRead:
        measured = np.column_stack([wrap_angle(b), r])
        return given._replace(measurements=measured, log_volume=float(np.log(volume)))

    in_radians = read(bearing * _DEGREE, volume=_DEGREE)
    right = np.pi / 2
    yield Other(
        "the bearings are clockwise", "multiply the bearings by -1", read(-bearing)
    )
    remedy = "multiply the bearings by π / 180"
    yield Other("the bearings are in degrees", remedy, in_radians)
    remedy = "multiply bearings and turns by π / 180"
    yield Other(
        "bearings and turns are in degrees",
        remedy,
        in_radians._replace(rows=given.rows * (1, _DEGREE, 1)),
    )
    name = "the range stands before the bearing"
    yield Other(name, "exchange the two fields", read(distance, bearing))
    for name, remedy, b in (
        (
            "are measured from the left of the robot",
            "add π/2 to the bearings",
            bearing + right,
        ),
        (
            "are measured from the right of the robot",
            "subtract π/2 from the bearings",
            bearing - right,
        ),
        (
            "are measured from the rear of the robot",
            "add π to the bearings",
            bearing + np.pi,
        ),
        (
            "are clockwise from the left of the robot, its y axis",
            "replace each bearing β by π/2 - β",
            right - bearing,
        ),
        (
            "are measured from the x axis of the world",
            "subtract the heading of the robot from the bearings",
            bearing - _headings(given)[given.steps],
        ),
    ):
        yield Other(f"the bearings {name}", remedy, read(b))
    for unit, size in (("centimetres", 0.01), ("millimetres", 0.001)):
        remedy = f"multiply the lengths by {size:g}"
        metres = read(bearing, distance * size, size)
        yield Other(f"the ranges are in {unit}", remedy, metres)
        driven = given._replace(rows=given.rows * (size, 1, 1))
        yield Other(f"the distances driven are in {unit}", remedy, driven)


def _headings(given: LogAsRead) -> Array:
    """Return the heading after each step, by the odometry alone."""
    turned = np.concatenate([[0.0], np.cumsum(given.rows[:, 1])])
    ends = np.searchsorted(given.row_steps, np.arange(len(given.is_read)), "right")
    return np.asarray(given.start + turned[ends])


_MOTIONS = {
    "turn-last": ("the robot turns after it has driven", "set motion: turn-last"),
    "midpoint": ("the robot drives arcs", "set motion: midpoint"),
    "turn-first": (
        "the robot turns before it drives",
        "write each row of odometry as two, (0, alpha) with dt = 0, and (d, 0)",
    ),
}


def _of_odometry(given: LogAsRead) -> Iterator[Other]:
    d, alpha, dt = given.rows.T

    def read(distance: Array = d, turn: Array = alpha) -> LogAsRead:
        return given._replace(rows=np.column_stack([distance, turn, dt]))

    name = "the turns of the odometry are clockwise"
    yield Other(name, "multiply alpha by -1", read(turn=-alpha))
    name = "the turns of the odometry are in degrees"
    yield Other(name, "multiply alpha by π / 180", read(turn=alpha * _DEGREE))
    name = "the odometry holds headings in place of turns"
    turns = wrap_angle(np.diff(alpha, prepend=given.start))
    yield Other(name, "write alpha as the difference of headings", read(turn=turns))
    name = "the odometry holds velocities in place of increments"
    if np.isin(dt, (0, 1)).all():
        for s in _DURATIONS:
            remedy = f"multiply d and alpha by {s:.3g}, the duration of a step"
            yield Other(name, remedy, read(d * s, alpha * s))
    else:
        yield Other(name, "multiply d and alpha by dt", read(d * dt, alpha * dt))
    yield from _of_motion(given)
    is_first = (d[::2] == 0) & (dt[::2] == 0)
    if len(d) % 2 or not is_first.all() or not dt[1::2].all():
        return
    before = given.start + np.cumsum(alpha[::2] + alpha[1::2])
    before = np.concatenate([[given.start], before[:-1]])
    seen = alpha + np.column_stack([-before, before]).ravel()
    name = "the increments are in the frame of the world"
    remedy = "rotate each increment by minus the heading before it"
    yield Other(name, remedy, read(turn=wrap_angle(seen)))
    name = "the rows of a turn stand before those of the drive that it follows"
    swapped = given.rows.reshape(-1, 2, 3)[:, ::-1].reshape(-1, 3)
    yield Other(name, "exchange the two rows", given._replace(rows=swapped))


def _of_motion(given: LogAsRead) -> Iterator[Other]:
    """Yield a part of a log with turns at other places of its rows.

    Rows that turn alone state the order of turn and drive themselves.
    """
    d, _, dt = given.rows.T
    if ((d == 0) & (dt == 0)).any():
        return
    for motion, (name, remedy) in _MOTIONS.items():
        if motion != given.motion:
            yield Other(name, remedy, given._replace(motion=motion))


def _shifted(given: LogAsRead) -> Iterator[Other]:
    """Yield a part of a log with the ids, or the scans, of the rows beside them."""
    early, late = slice(None, -1), slice(1, None)
    for word, back, of, to in (
        ("late", "up", early, late),
        ("early", "down", late, early),
    ):
        moved = given._replace(
            measurements=given.measurements[of],
            steps=given.steps[of],
            landmarks=given.landmarks[to],
        )
        name = f"the ids stand one row too {word}"
        yield Other(name, f"move the ids of the measurements one row {back}", moved)
    yield from _moved(given)


def _moved(given: LogAsRead) -> Iterator[Other]:
    """Yield a part of a log, with its scans one row of odometry earlier or later."""
    for word, back, by in (("late", "up", -1), ("early", "down", 1)):
        moved = given._replace(
            steps=given.steps + by, is_read=np.roll(given.is_read, by), moved=by
        )
        name = f"the measurements stand one row of odometry too {word}"
        yield Other(name, f"move the scans one row of odometry {back}", moved)


def hidden(given: LogAsRead) -> Iterator[Other]:
    """Yield a part of a log in the conventions that large noise hides."""
    yield from _of_motion(given)
    yield from _moved(given)
