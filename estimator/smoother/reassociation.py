"""Repair the association of a drive: find the landmark of each reading.

`reassociate` alternates smoothing and association.  A change of the search lowers the
score of the whole drive ::

    J = smoothed cost + ½ ln det S + m ln (A / 2π) + c u − ln L

with the information S of the m landmarks after the poses are eliminated, and the area A
that the readings cover: together the negative logarithm of the evidence, by Laplace's
approximation [1]_.  u readings are given to no landmark, each for the price c of
clutter.  L is the likelihood of the detections: scans show or miss the landmarks that
are well in view, as a Markov chain with two states, whose rates are those of the drive.
Without L, two landmarks in place of one would lower the cost, each with the nearer half
of the readings.  But each of them is then missed whenever the other is shown.

The result must be better by more than chance when both associations explain equally
many readings.  Otherwise, the drive stays as given.  Real readings have errors that no
noise explains, and an additional landmark explains them at the price of a wrong path.

The search begins with the associations given or, if these score lower, with those of
the default filter.  Small changes keep the poses: readings go to the landmarks that
they fit, landmarks that do not pay for themselves leave, and others enter.  Large
changes take landmarks apart where they are seen again after a gap, and match the parts
of the drive anew, by the largest cliques of pairs of landmarks with equal distances.

References
----------
.. [1] D. J. C. MacKay, Information Theory, Inference, and Learning Algorithms,
   chapter 28, Cambridge University Press, 2003.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ...arrays import Array, BoolArray, IntArray
from ...jit import jit
from ..association import constellations
from ..association.constellations import TwoPlaces, largest_clique, tables
from ..kernels.assignment_search import compare_pairs
from ..kernels.scan_update import as_rules, variances
from ..models.bearing_range import wrap_angle, wrap_angle_jit
from ..models.relative_geometry import separation, squared_offsets
from ..models.sensors import only_bearing_range
from ..registry import make_estimator
from .drive import Drive, DriveArrays, Sightings, landmark_order
from .optimiser import (
    Estimate,
    Optimiser,
    ReadingNoise,
    filter_options,
    moved_along,
    start_of,
)

NONE = -1  # the landmark of a reading that has none
#: c: a reading costs no more; half of χ² with two degrees of freedom, 99.75 %.
PRICE = 6.0
#: Readings of the smallest landmark.
LEAST = 3
#: Least decrease of the score that counts in the search.
SIGNIFICANT = 0.1
#: Least decrease for the result, in standard deviations of the cost of n readings: √n,
#: since twice this cost is χ² with 2n degrees of freedom.  It is large, because errors
#: of real sensors that no noise explains reach 8 of them; runs that are lost exceed 15.
CHANCE = 12.0
ROUNDS, BIRTHS, SEEDS = 8, 10, 150  # of small changes
GAP = 30  # scans without a landmark that end a visit
PARTS = 8  # into which the drive is taken apart
LARGEST_TURN = 1.5  # of the later part of a drive [rad]
MATCHES, SMALLEST_CLIQUE, NODES = 2, 3, 20_000
TOLERANCE, ITERATIONS = 0.03, 30  # of smoothing while searching


class Reassociation(NamedTuple):
    """A drive with repaired associations."""

    #: With the readings that are given to landmarks.
    drive: Drive
    #: Its poses to start smoothing from, shape (N, 3) [m, m, rad].
    poses: Array
    #: The landmark of each reading, -1 for none, one array for each scan.
    ids: list[IntArray]
    #: J after the repair.
    score: float
    #: J before.
    first_score: float
    #: Whether another association is better by more than chance; else the association
    #: is the given one, without the landmarks of too few readings.
    changed: bool


def reassociate(
    drive: Drive,
    *,
    start: ArrayLike | None = None,
    progress: Callable[[int, int], object] = lambda done, steps: None,
) -> Reassociation:
    """Improve the association of the readings of a drive, by the score J.

    Parameters
    ----------
    drive : Drive
        With all readings, also those that are believed to be of no landmark: a reading
        with an identity of its own counts as such.
    start : array_like, shape (N, 3), optional
        Poses to start from; by default an invariant filter over the drive.
    progress : callable, optional
        Called with (steps done, steps).

    Returns
    -------
    Reassociation
        Its score is lower than before by more than chance, or its association is that
        of `drive`.

    Raises
    ------
    ValueError
        If the drive holds no landmark with enough readings.
    numpy.linalg.LinAlgError
        If the drive as given cannot be smoothed.

    Examples
    --------
    >>> drive = Drive(motion_std=(0.1, 0.1, 0.05), measurement_std=(0.02, 0.1))
    >>> for k in range(8):  # one landmark by two names
    ...     drive.predict((0.0, 0.0))
    ...     drive.update([(0.0, 5.0)], [k // 4])
    >>> reassociate(drive).changed  # so few readings are no evidence beyond chance
    False
    """
    only_bearing_range(drive.sensor, "the repair of an association")
    search = _Search(drive)
    poses = start_of(drive)[0] if start is None else np.asarray(start, dtype=float)
    first = search.first(poses)
    other = search.followed()
    best = search.settled(other if other and other.score < first.score else first)
    steps = 1 + PARTS
    progress(1, steps)
    trial = search.rebuilt(best, lambda done: progress(1 + done, steps))
    if trial is not None and trial.score < best.score:
        best = trial
    progress(steps, steps)
    changed = first.advantage_of(best) > CHANCE * math.sqrt(min(first.used, best.used))
    return search.result(best if changed else first, first.score, changed)


class _Association(NamedTuple):
    """An association, smoothed."""

    labels: IntArray  # row of `places` of each reading or NONE, shape (M,)
    poses: Array  # (N, 3)
    places: Array  # of the landmarks, shape (m, 2)
    score: float
    cost: float  # of motions and readings
    covariance: Array  # of the landmarks, shape (2m, 2m)

    @property
    def used(self) -> int:
        """How many readings are given to landmarks."""
        return int((self.labels != NONE).sum())

    def advantage_of(self, other: _Association) -> float:
        """Return by how much another state is better with equally many readings.

        The cost of the state that explains more readings is scaled to the number of the
        other one.  The additional readings give no credit.
        """
        mine, others = self.used, other.used
        gain = self.score - PRICE * (len(self.labels) - mine) - self.cost
        gain -= other.score - PRICE * (len(other.labels) - others) - other.cost
        gain += self.cost * min(1.0, others / mine)
        return gain - other.cost * min(1.0, mine / others)


class _Search:
    """Searches for better associations of the readings of one drive."""

    def __init__(self, drive: Drive) -> None:
        self.drive, (self.data, self.order) = drive, drive.arrays()
        self.noise = ReadingNoise(drive.sensor, drive.rules, 0.0, 1.0)
        counts = np.diff(self.data.firsts)
        self.count = len(counts)
        self.empty = counts == 0
        self.owners = np.repeat(np.arange(self.count), counts)
        self.starts = self.data.firsts[:-1][counts > 0]
        self.rows = np.arange(len(self.owners))
        self.rule_values = np.array(drive.rules)
        bearings, ranges = self.data.readings.T
        self.reach = np.quantile(ranges, 0.75)
        self.width = np.quantile(np.abs(wrap_angle(bearings)), 0.95)
        self.log_area = 0.0

    def first(self, poses: Array) -> _Association:
        """Smooth the drive as it is given."""
        ids = self.order[self.data.columns // 2]
        found, labels, counts = np.unique(ids, return_inverse=True, return_counts=True)
        located, places = self.located(poses), np.zeros((len(found), 2))
        np.add.at(places, labels, located)
        places /= counts[:, None]
        labels = np.where(counts[labels] >= LEAST, labels, NONE)
        if (labels == NONE).all():
            raise ValueError(f"no landmark has {LEAST} readings in {self.drive}")
        sides = np.maximum(np.ptp(located, axis=0), 1.0)
        self.log_area = float(np.log(sides).sum())
        starts = self.smoothed(labels, poses, places), self.begun(labels)
        states = [state for state in starts if state is not None]
        if not states:
            raise np.linalg.LinAlgError(
                "the drive cannot be smoothed with its given association"
            )
        return min(states, key=lambda state: state.score)

    def followed(self) -> _Association | None:
        """Smooth with the associations of the default filter; None if that fails."""
        options = filter_options(self.drive)
        slam: Any = make_estimator("invariant", management=True, **options)
        try:
            for readings, _ in moved_along(self.drive, slam):
                slam.update(readings)
        except np.linalg.LinAlgError:
            return None
        found = [i for scan in slam.decisions for i in scan.row_ids]
        return self.begun(np.array([NONE if i is None else i for i in found]))

    def begun(self, labels: IntArray) -> _Association | None:
        """Smooth with associations that are far from those before; None if it fails."""
        try:
            poses, found = start_of(self.relabelled(labels))
        except np.linalg.LinAlgError:
            return None
        places = np.zeros((max(found) + 1, 2))
        places[list(found)] = list(found.values())
        return self.smoothed(labels, poses, places)

    def smoothed(
        self, labels: IntArray, poses: Array, places: Array
    ) -> _Association | None:
        """Smooth with associations; None if that fails."""
        used = labels != NONE
        if not used.any():
            return None
        rows, slots = np.unique(labels[used], return_inverse=True)
        counts = np.bincount(self.owners[used], minlength=len(poses))
        firsts = np.append(0, np.cumsum(counts))
        order, widths = landmark_order(slots, firsts)
        columns = 2 * np.argsort(order)
        arrays = self.data._replace(
            firsts=firsts,
            readings=np.ascontiguousarray(self.data.readings[used]),
            columns=columns[slots],
            widths=widths,
        )
        optimiser = Optimiser(DriveArrays(*arrays), self.noise)
        at = Estimate(poses.copy(), places[rows][order].ravel())
        try:
            found = optimiser.minimise(at, TOLERANCE, ITERATIONS, strict=False)
            information = optimiser.linearised(found)
            inverse = np.linalg.inv(information)
        except np.linalg.LinAlgError:
            return None
        entries = (columns[:, None] + np.arange(2)).ravel()
        places = found.estimate.landmarks[entries].reshape(-1, 2)
        labels = np.full_like(labels, NONE)
        labels[used] = slots
        score = found.cost + PRICE * float((~used).sum())
        score += _surprise(self.detections(found.estimate.poses, places, labels))
        score += len(rows) * (self.log_area - math.log(2 * math.pi))
        score += float(np.linalg.slogdet(information)[1]) / 2
        covariance = inverse[np.ix_(entries, entries)]
        poses = found.estimate.poses
        return _Association(labels, poses, places, score, found.cost, covariance)

    def settled(self, state: _Association) -> _Association:
        """Make small changes until none lowers the score."""
        for _ in range(ROUNDS):
            trials = (move(state) for move in (self.joined, self.rearranged))
            better = (t for t in trials if t and t.score < state.score - SIGNIFICANT)
            new = next(better, None)
            if new is None:
                break
            state = new
        return state

    def rearranged(self, state: _Association) -> _Association | None:
        """Add and remove landmarks, and give readings to those that they fit."""
        places, costs = state.places, self.costs(state.poses, state.places)
        m = len(places)
        own = state.covariance.reshape(m, 2, m, 2)[np.arange(m), :, np.arange(m)]
        information = -float(np.linalg.slogdet(own)[1].mean()) / 2  # of one, at least
        price = self.log_area - math.log(2 * math.pi) + information
        prices = _prices(self.detections(state.poses, places, state.labels))
        for _ in range(BIRTHS):
            born = self.birth(state.poses, costs, price, prices)
            if born is None:
                break
            places = np.vstack([places, born])
            costs = np.hstack([costs, self.costs(state.poses, born[None])])
        labels = self.assigned(costs)
        while len(places) > 1:
            worst = self.death(labels, costs, price)
            if worst is None:
                break
            places, costs = np.delete(places, worst, 0), np.delete(costs, worst, 1)
            labels = self.assigned(costs)
        return self.smoothed(labels, state.poses, places)

    def assigned(self, costs: Array) -> IntArray:
        """Return the landmark of each reading by costs (M, m), one to one in a scan."""
        from scipy.optimize import linear_sum_assignment  # noqa: PLC0415 (slow)

        m = costs.shape[1]
        labels = np.where(costs.min(axis=1) < PRICE, costs.argmin(axis=1), m)
        keys, counts = np.unique(self.owners * (m + 1) + labels, return_counts=True)
        twice = np.unique(keys[(counts > 1) & (keys % (m + 1) < m)] // (m + 1))
        for scan in twice.tolist():
            first, last = np.searchsorted(self.owners, [scan, scan + 1])
            spare = np.full((last - first,) * 2, PRICE)
            table = np.hstack([costs[first:last], spare])
            labels[first:last] = np.minimum(linear_sum_assignment(table)[1], m)
        return np.where(labels == m, NONE, labels)

    def birth(
        self, poses: Array, costs: Array, price: float, prices: Array
    ) -> Array | None:
        """Return the place of a new landmark worth its price, if there is one."""
        labels = self.assigned(costs)
        paid = np.where(labels == NONE, PRICE, costs[self.rows, labels])
        dear = np.flatnonzero(paid > PRICE / 2)
        if len(dear) < LEAST:
            return None
        seeds = dear[:: len(dear) // SEEDS + 1]
        located = self.located(poses)[seeds]
        saved = np.maximum(paid[:, None] - self.costs(poses, located), 0.0)
        gains = np.maximum.reduceat(saved, self.starts, axis=0)
        best = int(gains.sum(axis=0).argmax())
        enough = (gains[:, best] > 0).sum() >= LEAST
        own = np.where(saved[:, best] > 0, 0, NONE)
        seen = self.detections(poses, located[best, None], own)
        price += float((prices * seen).sum())
        worth = gains[:, best].sum() > price
        return located[best] if enough and worth else None

    def death(self, labels: IntArray, costs: Array, price: float) -> int | None:
        """Return a landmark that is not worth its price, if there is one."""
        m, used = costs.shape[1], labels != NONE
        scans, own = self.owners[used], labels[used]
        taken = np.zeros((self.count, m), dtype=np.bool_)
        taken[scans, own] = True
        others = np.where(taken[scans], PRICE, costs[used]).min(axis=1)
        loss = np.minimum(others, PRICE) - costs[used, own]
        losses, counts = np.bincount(own, loss, m), np.bincount(own, minlength=m)
        losses[counts < LEAST] = -np.inf
        worst = int(losses.argmin())
        return worst if losses[worst] < price else None

    def joined(self, state: _Association) -> _Association | None:
        """Merge the landmarks that are likely to be the same, and not in one scan."""
        m = len(state.places)
        every = np.arange(m)
        squared, spread = _offsets(state.places, state.covariance, every, every)
        loss = squared / 2 + np.log(2 * np.pi * spread) - self.log_area
        loss[self.together(state.labels, m) | np.tri(m, dtype=np.bool_)] = np.inf
        rename, free = np.arange(m), np.full(m, True)
        for flat in np.argsort(loss, axis=None).tolist():
            i, j = divmod(flat, m)
            if loss[i, j] >= 0:
                break
            if free[i] and free[j]:
                rename[j], free[i], free[j] = i, False, False
        if free.all():
            return None
        return self.smoothed(_renamed(state.labels, rename), state.poses, state.places)

    def together(self, labels: IntArray, m: int) -> BoolArray:
        """Return which landmarks a scan has shown together, shape (m, m)."""
        shown = np.zeros((self.count, m), dtype=np.float32)
        used = labels != NONE
        shown[self.owners[used], labels[used]] = 1
        return np.asarray(shown.T @ shown > 0)

    def rebuilt(
        self, state: _Association, progress: Callable[[int], object]
    ) -> _Association | None:
        """Take all landmarks apart where they are seen again, and match them anew.

        The drive is taken in successive parts.  The landmarks that a part shows first
        are matched with those before it.
        """
        scans = self.count
        labels, length = self.visits(state.labels), -(-scans // PARTS)
        now = self.begun(labels)
        for cut in range(length, scans, length):
            if now is None:
                return None
            used = now.labels != NONE
            first = np.full(len(now.places), scans)
            np.minimum.at(first, now.labels[used], self.owners[used])
            late = np.flatnonzero((first >= cut) & (first < cut + length))
            early = np.flatnonzero(first < cut)
            best = now
            for pairs in self.matches(now, late, early):
                rename = np.arange(len(now.places))
                rename[pairs[:, 0]] = pairs[:, 1]
                trial = self.begun(_renamed(now.labels, rename))
                if trial is not None and trial.score < best.score:
                    best = trial
            while (trial := self.joined(best)) and trial.score < best.score:
                best = trial
            now = best
            progress(cut // length)
        return None if now is None else self.settled(now)

    def visits(self, labels: IntArray) -> IntArray:
        """Return a label for each series of readings of a landmark without a gap."""
        used = np.flatnonzero(labels != NONE)
        order = used[np.lexsort([self.owners[used], labels[used]])]
        new = np.diff(labels[order]) != 0
        new |= np.diff(self.owners[order]) > GAP
        found = np.full(len(labels), NONE)
        found[order] = np.append(0, np.cumsum(new))
        return found

    def matches(
        self, state: _Association, late: IntArray, early: IntArray
    ) -> Iterator[IntArray]:
        """Yield pairs of landmarks that one rigid motion brings together."""
        if min(len(late), len(early)) < SMALLEST_CLIQUE:
            return
        rows = np.concatenate([late, early])
        entries = (2 * rows[:, None] + np.arange(2)).ravel()
        P = state.covariance[np.ix_(entries, entries)]
        places = TwoPlaces(state.places[late], state.places[early], P, LARGEST_TURN)
        squared, _ = _offsets(state.places, state.covariance, late, early)
        together = self.together(state.labels, len(state.places))
        squared[together[np.ix_(late, early)]] = np.inf
        nearest = np.argsort(squared, axis=None)[: constellations.LARGEST_GRAPH]
        nearest = np.sort(nearest[np.isfinite(squared.ravel()[nearest])])
        pairs = np.column_stack(np.unravel_index(nearest, squared.shape))
        agree = np.zeros((len(pairs),) * 2, dtype=np.bool_)
        compare_pairs(
            pairs, *tables(places), constellations.DISTANCE_GATE, LARGEST_TURN, agree
        )
        for _ in range(MATCHES):
            clique, _ = largest_clique(pairs, agree, SMALLEST_CLIQUE - 1, NODES)
            if not len(clique):
                return
            chosen = pairs[clique]
            yield np.column_stack([late[chosen[:, 0]], early[chosen[:, 1]]])
            left = np.setdiff1d(np.arange(len(pairs)), clique)
            pairs, agree = pairs[left], np.ascontiguousarray(agree[np.ix_(left, left)])

    def located(self, poses: Array) -> Array:
        """Return where the readings put their landmarks, shape (M, 2) [m]."""
        at, (bearing, distance) = poses[self.owners], self.data.readings.T
        ahead = at[:, 2] + bearing
        along = distance[:, None] * np.column_stack([np.cos(ahead), np.sin(ahead)])
        return np.asarray(at[:, :2] + along)

    def detections(self, poses: Array, places: Array, labels: IntArray) -> IntArray:
        """Count how scans show the landmarks that are well in view, shape (2, 2).

        Entry [a, b] counts the scans in which a landmark is missed (b = 0) or shown
        (1), and was so (a) in the scan before that had it in view.
        """
        d = places - poses[:, None, :2]
        ahead = np.arctan2(d[..., 1], d[..., 0]) - poses[:, 2:]
        in_view = np.hypot(d[..., 0], d[..., 1]) <= self.reach
        in_view &= np.abs(wrap_angle(ahead)) <= self.width
        in_view[self.empty] = False
        used, shown = labels != NONE, np.zeros(in_view.shape, dtype=np.int64)
        shown[self.owners[used], labels[used]] = 1
        own, scans = np.nonzero(in_view.T)  # one landmark after the other
        states, same = shown[scans, own], own[1:] == own[:-1]
        pairs = 2 * states[:-1] + states[1:]
        return np.bincount(pairs[same], minlength=4).reshape(2, 2)

    def costs(self, poses: Array, places: Array) -> Array:
        """Return ½ νᵀ Q⁻¹ ν of readings and landmarks, at most c, shape (M, m)."""
        found = np.full((len(self.owners), len(places)), PRICE)
        values = self.rule_values
        fill_costs(poses, self.owners, self.data.readings, places, values, found)
        return found

    def result(self, state: _Association, first: float, changed: bool) -> Reassociation:
        """Return the drive with the associations of a state."""
        drive = self.relabelled(state.labels)
        ids = self.by_scan(state.labels)
        return Reassociation(drive, state.poses, ids, state.score, first, changed)

    def by_scan(self, labels: IntArray) -> list[IntArray]:
        """Return the labels of each scan."""
        lengths = [len(scan.ids) for scan in self.drive.scans]
        return np.split(labels, np.cumsum(lengths)[:-1])

    def relabelled(self, labels: IntArray) -> Drive:
        """Return the drive with other landmarks for its readings."""
        pairs = zip(self.drive.scans, self.by_scan(labels), strict=True)
        return self.drive.with_scans([Sightings(z, i) for (z, _), i in pairs])


@jit
def fill_costs(
    poses: Array,
    owners: IntArray,
    readings: Array,
    places: Array,
    rule_values: Array,
    costs: Array,
) -> None:
    """Lower the costs (M, m) of readings and landmarks to ½ νᵀ Q⁻¹ ν."""
    rules = as_rules(rule_values)
    for i in range(len(owners)):
        pose, z = poses[owners[i]], readings[i]
        for j in range(len(places)):
            dx, dy = places[j, 0] - pose[0], places[j, 1] - pose[1]
            expected = max(math.sqrt(dx * dx + dy * dy), rules.min_range)
            noisy = z[1] if rules.noise_as_read else expected
            to_bearing, to_range = variances(rules, noisy)
            cost = (z[1] - expected) ** 2 / (2 * to_range)
            if cost < costs[i, j]:
                turn = wrap_angle_jit(math.atan2(dy, dx) - pose[2] - z[0])
                cost += turn**2 / (2 * to_bearing)
                costs[i, j] = min(costs[i, j], cost)


def _surprise(counts: IntArray) -> float:
    """Return −ln of the likelihood of detections, with the rates of these counts."""
    rates = counts / np.maximum(counts.sum(axis=1, keepdims=True), 1)
    return -float((counts * np.log(np.where(counts > 0, rates, 1.0))).sum())


def _prices(counts: IntArray) -> Array:
    """Return the price of one more detection or miss after each, shape (2, 2)."""
    rates = (counts + 0.5) / (counts.sum(axis=1, keepdims=True) + 1.0)
    return np.asarray(-np.log(rates))


def _renamed(labels: IntArray, rename: IntArray) -> IntArray:
    """Return labels after each landmark k has become landmark rename[k]."""
    return np.where(labels == NONE, NONE, rename[labels])


def _offsets(
    places: Array, covariance: Array, some: IntArray, others: IntArray
) -> tuple[Array, Array]:
    """Return dᵀ D⁻¹ d and √det D of the offsets of landmarks, both (m, n)."""
    i, j = 2 * some[:, None], 2 * others
    d, D = separation(places.ravel(), covariance, i, j)
    D += 1e-12 * np.eye(2)  # 0 of a landmark and itself, but for rounding
    return squared_offsets(d, D), np.sqrt(np.maximum(np.linalg.det(D), 1e-24))
