"""Levenberg-Marquardt over all poses and landmarks of a drive: `Optimiser`.

`filter_drive` provides the initial values by an invariant filter, and `relocate` moves
landmarks out of local minima.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from ...arrays import Array, IntArray
from ...jit import jit, njit_internal
from ..beliefs import Belief, part_of
from ..filters.ekf import InvariantEkfSlam
from ..kernels.scan_update import Rules, as_rules, variances
from ..models.bearing_range import (
    difference_jit,
    expected_reading_jit,
    placed_jit,
    read_distance_jit,
    wrap_angle,
)
from ..models.sensor_kernels import for_sensor
from ..models.sensors import Sensor
from . import elimination
from .drive import Drive, DriveArrays, Sightings

KINDS = {
    None: elimination.SQUARED,
    "huber": elimination.HUBER,
    "cauchy": elimination.CAUCHY,
}
SLACK = 1e-12  # of the cost, in rounding
REWEIGHTED = 30  # iterations; from then on the noise is fixed
SHRINKING = 0.5  # steps that shrink by this factor converge linearly
NOTHING = 0.02  # of the cost; further steps then move less than a fifth of a σ
SETTLED = 1e-6  # smaller undamped steps show convergence [m, rad]
SEARCHES = 5  # for better places of landmarks
RELOCATED = 5  # iterations from one to the next
FIRST_DAMPING, MOST_DAMPING = 1e-4, 1e10


class ReadingNoise(NamedTuple):
    """The noise of the sensor, and how much an outlier counts."""

    sensor: Sensor
    rules: Rules  # of a filter, which hold the noise
    kind: float  # of the robust kernel, one of `KINDS`
    scale: float  # of the robust kernel, in standard deviations


class Estimate(NamedTuple):
    """Poses and landmarks."""

    poses: Array  # (N, 3), heading not wrapped
    landmarks: Array  # (2n,), in the order of the elimination


class Solution(NamedTuple):
    """Poses and landmarks whose cost no small step lowers."""

    estimate: Estimate
    cost: float
    first_cost: float  # of the start
    iterations: int
    # Whether the last step was damped, so that its system may be singular.
    is_damped: bool


class _Iterate:
    """An estimate on its way to the solution."""

    def __init__(self, estimate: Estimate, stds: Array) -> None:
        self.estimate, self.stds = estimate, stds
        self.cost, self.moved, self.error = np.inf, np.inf, np.inf
        self.damping, self.is_damped, self.searches = 0.0, False, SEARCHES
        self.fall, self.remaining = np.inf, np.inf

    def move(self, estimate: Estimate, cost: float) -> None:
        """Take an accepted step; later ones are expected to shrink as this one did."""
        moved = _distance(self.estimate, estimate)
        rate = moved / self.moved if 0 < self.moved < np.inf else 1.0
        self.error = moved * (rate / (1 - rate) if rate < SHRINKING else 1.0)
        fall = self.cost - cost
        shrinks = fall / self.fall if 0 < self.fall < np.inf else 1.0
        self.remaining = fall * shrinks / (1 - shrinks) if shrinks < 1 else np.inf
        self.estimate, self.cost, self.moved, self.fall = estimate, cost, moved, fall
        self.is_damped = self.damping > 0
        lower = self.damping / 10
        self.damping = lower if lower >= FIRST_DAMPING else 0.0


class Optimiser:
    """Minimise the cost of a drive.

    Noise that depends on the range is that at the latest estimate, and fixed within an
    iteration, as in a filter's update.
    """

    def __init__(self, drive: DriveArrays, noise: ReadingNoise) -> None:
        self._drive, self._sensor = drive, noise.sensor
        poses, landmarks = len(drive.increments), int(drive.widths[0]) // 2
        self._room = elimination.new_elimination(poses, landmarks)
        self._parts = range(len(self._room.ends.slope))[::-1]
        self._still = np.zeros(2 * landmarks)  # a zero step of the landmarks
        rules = noise.rules
        self._rule_values = np.array(rules)
        self._robust = noise.kind, noise.scale
        std = rules.first_std, rules.second_std
        near, far = noise.sensor.stds(std, np.array([1.0, 2.0]))
        self._varies = bool((near != far).any()) and not rules.noise_as_read
        self._owners = np.repeat(np.arange(poses), np.diff(drive.firsts))
        self._by_landmark = np.argsort(drive.columns, kind="stable")

    @property
    def plausible_cost(self) -> float:
        """Largest cost that is plausible for a correct solution.

        Twice the cost of the correct solution is about χ², with a degree of freedom
        for each number read less two for each landmark, and one for each component of a
        reading of a pose.
        """
        freedom = self._sensor.size * len(self._drive.readings) - len(self._room.right)
        freedom += int(self._drive.fixes.whiteners.any(axis=2).sum())
        return 0.6 * freedom + 6 * float(np.sqrt(freedom / 2)) + 1

    def minimise(
        self, start: Estimate, tolerance: float, most: int, *, strict: bool = True
    ) -> Solution:
        """Iterate until no pose or landmark will move more than the tolerance [m, rad].

        If readings contradict each other, the steps may shrink slowly.  After ``most``
        iterations, the estimate is also a solution if the further decrease of its cost,
        by the last two decreases, is insignificant, or if a step without damping hardly
        moves it, and in any case unless ``strict``.

        Raises
        ------
        numpy.linalg.LinAlgError
            If that takes more iterations, or no step lowers the cost.
        """
        state = _Iterate(start, self.reading_stds(start))
        state.cost = first_cost = self.cost(start, state.stds)
        # A start that contradicts a motion without noise is no bound of the cost.
        if not self._drive.factors[1:].any(axis=1).all():
            state.cost = np.inf
        for iteration in range(1, most + 1):
            self._descend(state)
            if self._is_found(state, tolerance, iteration):
                return self._solution(state, first_cost, iteration)
            if self._varies and iteration < REWEIGHTED:
                self._reweight(state)
        is_settled = state.moved < SETTLED and not state.is_damped
        if is_settled or state.remaining < NOTHING or not strict:
            return self._solution(state, first_cost, most)
        raise np.linalg.LinAlgError(
            f"smoothing did not converge in {most} iterations: the last one moved a "
            f"pose or landmark by {state.moved:.3g}, the cost fell from "
            f"{first_cost:.4g} to {state.cost:.4g}; a better start, another noise or a "
            "robust kernel may help"
        )

    def _solution(
        self, state: _Iterate, first_cost: float, iterations: int
    ) -> Solution:
        cost = self.cost(state.estimate, self.reading_stds(state.estimate))
        return Solution(state.estimate, cost, first_cost, iterations, state.is_damped)

    def _is_found(self, state: _Iterate, tolerance: float, iteration: int) -> bool:
        """Whether the last step was small, and no landmark belongs elsewhere."""
        is_found = state.error <= tolerance and state.damping <= FIRST_DAMPING
        if state.searches and (is_found or iteration % RELOCATED == 0):
            state.searches -= 1
            is_found &= self._relocate(state) == 0
        return is_found

    def linearised(self, solution: Solution) -> Array:
        """Return the information of the landmarks at a solution, (2n, 2n)."""
        stds = self.reading_stds(solution.estimate)
        return self._linearise(solution.estimate, stds, 0.0)

    def sensitivity(self, solution: Solution) -> elimination.Sensitivity:
        """Return the sensitivity of the poses to the landmarks, after `linearised`."""
        estimate, room = solution.estimate, self._room
        stds = self.reading_stds(estimate)
        again = partial(self._eliminate, self._drive, estimate, stds, 0.0, self._still)
        return elimination.Sensitivity(estimate.poses, room, again)

    def reading_stds(self, estimate: Estimate) -> Array:
        """Return (σβ, σr) of each reading, shape (M, 2), at its expected range."""
        deviations = for_sensor(elimination.reading_stds, self._sensor)
        stds: Array = deviations(*estimate, self._drive, self._rule_values)
        return stds

    def cost(self, estimate: Estimate, stds: Array) -> float:
        """Return the cost, with the noise of every reading given."""
        total = for_sensor(elimination.total_cost, self._sensor)
        return float(total(*estimate, self._drive, stds, *self._robust))

    def _linearise(self, estimate: Estimate, stds: Array, damping: float) -> Array:
        """Eliminate the poses; return the information of the landmarks, (2n, 2n)."""
        room, drive, n = self._room, self._drive, len(self._room.blocks)
        room.blocks[:], room.right[:], information = 0.0, 0.0, np.zeros((2 * n, 2 * n))
        for part in self._parts:
            self._eliminate(drive, estimate, stds, damping, self._still, part)
            first = part * elimination.PART
            rows = room.rows[: len(estimate.poses) - first].reshape(-1, 2 * n)
            met = rows[:, : drive.widths[first]]
            information[: met.shape[1], : met.shape[1]] -= met.T @ met
        at = np.arange(n)
        information.reshape(n, 2, n, 2)[at, :, at, :] += room.blocks
        return information

    def _eliminate(
        self,
        drive: DriveArrays,
        estimate: Estimate,
        stds: Array,
        damping: float,
        landmark_step: Array,
        part: int,
    ) -> None:
        """Eliminate one part of the poses."""
        rest = drive, stds, self._robust, damping, self._room
        eliminate = for_sensor(elimination.eliminate, self._sensor)
        eliminate(part, tuple(estimate), landmark_step, *rest)

    def _descend(self, state: _Iterate) -> None:
        """Take one step that does not raise the cost."""
        while state.damping <= MOST_DAMPING:
            moved = self._step(state.estimate, state.stds, state.damping)
            cost = self.cost(moved, state.stds)
            if cost <= state.cost * (1 + SLACK) + SLACK:
                return state.move(moved, cost)
            state.damping = max(FIRST_DAMPING, 10 * state.damping)
        raise np.linalg.LinAlgError(
            f"smoothing diverged: no step lowers the cost of {state.cost:.4g}"
        )

    def _relocate(self, state: _Iterate) -> int:
        """Move landmarks out of local minima, in place; return how many."""
        if not self._sensor.places:
            return 0
        moved: int = for_sensor(relocate, self._sensor)(
            *state.estimate,
            self._drive,
            self._by_landmark,
            self._owners,
            self._rule_values,
            self._robust,
        )
        if moved:
            self._reweight(state)
        return moved

    def _reweight(self, state: _Iterate) -> None:
        """Update the noise of the readings for the present estimate."""
        state.stds = self.reading_stds(state.estimate)
        state.cost = self.cost(state.estimate, state.stds)

    def _step(self, estimate: Estimate, stds: Array, damping: float) -> Estimate:
        factor = factorised(self._linearise(estimate, stds, damping))
        landmark_step = cho_solve(factor, self._room.right)
        alone = self._drive._replace(widths=np.zeros_like(self._drive.widths))
        for part in self._parts:
            self._eliminate(alone, estimate, stds, damping, landmark_step, part)
        poses = elimination.substitute(estimate.poses, self._drive, self._room)
        return Estimate(poses, estimate.landmarks + landmark_step)


def _distance(one: Estimate, other: Estimate) -> float:
    """Return the largest difference of a coordinate; headings are wrapped."""
    turns = wrap_angle(one.poses[:, 2] - other.poses[:, 2])
    gaps = one.poses[:, :2] - other.poses[:, :2], one.landmarks - other.landmarks
    return max(float(abs(part).max()) for part in (turns, *gaps))


def factorised(information: Array) -> tuple[Array, bool]:
    """Return the Cholesky factor of the landmarks' information.

    Raises
    ------
    numpy.linalg.LinAlgError
        If it is not positive definite.
    """
    if not np.isfinite(information).all():
        raise np.linalg.LinAlgError("smoothing diverged: its system is not finite")
    try:
        factor, lower = cho_factor(information, lower=True, check_finite=False)
    except np.linalg.LinAlgError:
        raise np.linalg.LinAlgError(
            "the readings do not determine all landmarks: their information is not "
            "positive definite"
        ) from None
    return factor, lower


# --------------------------------------------------------------------------------------
# Move landmarks out of local minima, compiled.
#
# A landmark close to the path may be estimated on the wrong side of it. All bearings
# then have large errors, but no small step reduces the cost. Single readings place it
# on the right side.

CANDIDATES = 12  # of a landmark, from readings spread evenly over the drive

GAIN = 4.0  # by which the cost must fall


@jit
def relocate(
    poses: Array,
    landmarks: Array,
    drive: DriveArrays,
    by_landmark: IntArray,
    owners: IntArray,
    rule_values: Array,
    robust: tuple[float, float],
) -> int:
    """Move each landmark to where one of its readings puts it, if that costs far less.

    The poses are fixed, and σβ and σr are those at the range read, so that places
    compare.
    Landmarks whose readings cost no more than they should are passed over.

    Parameters
    ----------
    by_landmark : ndarray of int64, shape (M,)
        The readings ordered by their landmark's column.
    owners : ndarray of int64, shape (M,)
        Pose of each reading.
    robust
        Kind and scale of the robust kernel.

    Returns
    -------
    int
        How many landmarks have moved, in place.
    """
    rules, moved, first = as_rules(rule_values), 0, 0
    place = np.empty(2)
    while first < len(by_landmark):
        c = drive.columns[by_landmark[first]]
        last = first
        while last < len(by_landmark) and drive.columns[by_landmark[last]] == c:
            last += 1
        own = by_landmark[first:last]
        place[0], place[1] = landmarks[c], landmarks[c + 1]
        least = _cost_at(place, own, poses, drive, owners, rules, robust) - GAIN
        bound, first = least, last
        if least < len(own) + 3 * np.sqrt(len(own)):  # the mean, and 3 σ more
            continue
        for i in range(0, len(own), max(len(own) // CANDIDATES, 1)):
            j = own[i]
            pose, z = poses[owners[j]], drive.readings[j]
            found = placed_jit((pose[0], pose[1], pose[2]), z[0], z[1], 0.0, 0.0)
            place[0], place[1] = found[0], found[1]
            cost = _cost_at(place, own, poses, drive, owners, rules, robust)
            if cost < least:
                least = cost
                landmarks[c], landmarks[c + 1] = place[0], place[1]
        moved += least < bound
    return moved


@njit_internal
def _cost_at(
    place: Array,
    own: IntArray,
    poses: Array,
    drive: DriveArrays,
    owners: IntArray,
    rules: Rules,
    robust: tuple[float, float],
) -> float:
    """Return what the readings of one landmark cost if it is at a place."""
    total = 0.0
    for j in own:
        pose, z = poses[owners[j]], drive.readings[j]
        h = expected_reading_jit(place[0] - pose[0], place[1] - pose[1], pose[2])
        nu, nu_below = difference_jit(z[0], z[1], h[0], h[1])
        variance, below = variances(rules, read_distance_jit(z[0], z[1]))
        squared = nu**2 / variance + nu_below**2 / below
        total += elimination.robust_loss(squared, robust[0], robust[1])
    return total


def filter_drive(
    drive: Drive, known: Belief | None = None, *, iterations: int = 1
) -> tuple[Array, Belief]:
    """Follow a drive with an invariant filter.

    Parameters
    ----------
    drive : Drive
        Motions and scans.
    known : Belief, optional
        A map that the filter has from the beginning.
    iterations : int
        Of each update of the filter.

    Returns
    -------
    poses : ndarray, shape (N, 3)
        After each scan [m, m, rad].
    belief : Belief
        At the end.
    """
    slam = InvariantEkfSlam(**filter_options(drive), iterations=iterations)
    if known is not None:
        _take_map(slam, drive, known)
    poses = np.empty((drive.poses, 3))
    for k, seen in enumerate(moved_along(drive, slam)):
        for readings, ids in seen.distinct():
            slam.update(readings, ids)
        poses[k] = slam.map.mean[:3]
    return poses, slam.belief()


def filter_options(drive: Drive) -> dict[str, Any]:
    """Return the arguments of a filter with the noise and the start of a drive."""
    rules, noise = drive.rules, drive.motion_noise
    return {
        "motion_std": np.sqrt(noise.variance),
        "measurement_std": (rules.first_std, rules.second_std),
        "initial_pose": drive.initial_pose,
        "initial_pose_std": drive.initial_pose_std,
        "sensor": drive.sensor,
        "noise_at_rest": noise.at_rest,
        "min_range": rules.min_range,
        "motion": noise.motion,
    }


def moved_along(drive: Drive, slam: Any) -> Iterator[Sightings]:
    """Move a filter along a drive, and yield what it is to see at each pose."""
    for k, motion in enumerate(drive.motions):
        for distance, turn, dt in motion.steps:
            slam.predict((distance, turn), dt)
        for given in drive.pose_readings(k):
            slam.observe_pose(*given)
        yield drive.sightings(k)


def start_of(
    drive: Drive, belief: Belief | None = None, *, iterations: int = 1
) -> tuple[Array, dict[int, Array]]:
    """Return poses (N, 3) that fit a filter's final map, and that map.

    The poses that a filter estimates during the drive do not fit it: each uses only the
    readings until then, and they jump when a loop is closed. A second pass, which has
    the map from the beginning, counts all readings twice, but its poses have no jumps.

    Parameters
    ----------
    drive : Drive
        Motions and scans.
    belief : Belief, optional
        Of a filter at the end of the drive; an invariant one where not given.
    iterations : int
        Of each update of that.
    """
    if belief is None:
        _, belief = filter_drive(drive, iterations=iterations)
    poses, again = filter_drive(drive, belief)
    return poses, dict(zip(again.landmark_ids, again.landmarks, strict=True))


def _take_map(slam: InvariantEkfSlam, drive: Drive, known: Belief) -> None:
    """Give a filter at its start the landmarks of a belief that a drive reads."""
    read = set(drive.landmark_ids)
    part = part_of(known, [i for i in known.landmark_ids if i in read], known.frame)
    mean, covariance = part.mean.copy(), part.covariance.copy()
    mean[:3], covariance[:3], covariance[:, :3] = drive.initial_pose, 0.0, 0.0
    covariance[:3, :3] = np.diag(drive.initial_pose_std**2)
    slam.load_state_dict(
        slam.state_dict()
        | {
            "mean": mean,
            "covariance": covariance,
            "landmark_ids": np.array(part.landmark_ids, dtype=np.int64),
            "reference": mean,
        }
    )
