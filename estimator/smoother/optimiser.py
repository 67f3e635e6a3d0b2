"""Levenberg-Marquardt over all poses and landmarks of a drive."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from ...arrays import Array
from ..kernels.kalman_gain import Rules
from ..models.bearing_range import wrap_angle
from ..support.memory_limit import refuse_beyond_memory
from .cost import CAUCHY, HUBER, SQUARED, reading_stds, total_cost
from .drive_arrays import DriveArrays
from .elimination import Elimination, eliminate, new_elimination
from .relocation import relocate
from .substitution import substitute

KINDS = {None: SQUARED, "huber": HUBER, "cauchy": CAUCHY}
SLACK = 1e-12  # of the cost, in rounding
REWEIGHTED = 30  # iterations; from then on the noise is fixed
SHRINKING = 0.5  # steps that shrink by this factor converge linearly
NOTHING = 0.02  # of the cost; further steps then move less than a fifth of a σ
SEARCHES = 5  # for better places of landmarks
RELOCATED = 5  # iterations from one to the next
FIRST_DAMPING, MOST_DAMPING = 1e-4, 1e10


class Noise(NamedTuple):
    """The noise of the sensor, and how much an outlier counts."""

    rules: Rules
    """Of a filter, which hold the noise."""
    kind: float
    """Of the robust kernel, one of `KINDS`."""
    scale: float
    """Of the robust kernel, in standard deviations."""


class Estimate(NamedTuple):
    """Poses and landmarks."""

    poses: Array
    """Shape (N, 3), heading not wrapped."""
    landmarks: Array
    """Shape (2n,), in the order of the elimination."""


class Solution(NamedTuple):
    """Poses and landmarks whose cost no small step lowers."""

    estimate: Estimate
    cost: float
    first_cost: float
    """Of the start."""
    iterations: int
    is_damped: bool
    """Whether the last step was damped, so that its system may be singular."""


class Minimum(NamedTuple):
    """A solution with the system linearised there."""

    solution: Solution
    elimination: Elimination
    information: Array
    """Of the landmarks, shape (2n, 2n)."""


class _State:
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

    def __init__(self, drive: DriveArrays, noise: Noise) -> None:
        self._drive = drive
        poses, landmarks = len(drive.increments), int(drive.widths[0]) // 2
        refuse_beyond_memory(
            f"smoothing {poses} poses among {landmarks} landmarks",
            8 * (6 * poses * 2 * landmarks + 3 * (2 * landmarks) ** 2),
            "smooth a part of the drive, or a drive with fewer landmarks",
        )
        self._room = new_elimination(poses, landmarks)
        rules = noise.rules
        self._rule_values = np.array(rules)
        self._robust = noise.kind, noise.scale
        varies = max(rules.range_std_per_metre, rules.bearing_std_metres) > 0
        self._varies = varies and not rules.noise_as_read
        self._owners = np.repeat(np.arange(poses), np.diff(drive.firsts))
        self._by_landmark = np.argsort(drive.columns, kind="stable")

    @property
    def plausible_cost(self) -> float:
        """Largest cost that is plausible for a correct solution.

        Twice the cost of the correct solution is about χ², with two degrees of freedom
        for each reading less two for each landmark.
        """
        freedom = 2 * len(self._drive.readings) - len(self._room.right)
        return 0.6 * freedom + 6 * float(np.sqrt(freedom / 2)) + 1

    def minimise(self, start: Estimate, tolerance: float, most: int) -> Solution:
        """Iterate until no pose or landmark will move more than the tolerance [m, rad].

        If readings contradict each other, the steps may shrink slowly.  After ``most``
        iterations, the estimate is also a solution if the further decrease of its cost,
        by the last two decreases, is insignificant.

        Raises
        ------
        numpy.linalg.LinAlgError
            If that takes more iterations, or no step lowers the cost.
        """
        state = _State(start, self.reading_stds(start))
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
        if state.remaining < NOTHING:
            return self._solution(state, first_cost, most)
        raise np.linalg.LinAlgError(
            f"smoothing did not converge in {most} iterations: the last one moved a "
            f"pose or landmark by {state.moved:.3g}, the cost fell from "
            f"{first_cost:.4g} to {state.cost:.4g}; a better start, another noise or a "
            "robust kernel may help"
        )

    def _solution(self, state: _State, first_cost: float, iterations: int) -> Solution:
        cost = self.cost(state.estimate, self.reading_stds(state.estimate))
        return Solution(state.estimate, cost, first_cost, iterations, state.is_damped)

    def _is_found(self, state: _State, tolerance: float, iteration: int) -> bool:
        """Whether the last step was small, and no landmark belongs elsewhere."""
        is_found = state.error <= tolerance and state.damping <= FIRST_DAMPING
        if state.searches and (is_found or iteration % RELOCATED == 0):
            state.searches -= 1
            is_found &= self._relocate(state) == 0
        return is_found

    def linearised(self, solution: Solution) -> Minimum:
        """Return a solution with its system, which the next call overwrites."""
        stds = self.reading_stds(solution.estimate)
        information = self.linearise(solution.estimate, stds)
        return Minimum(solution, self._room, information)

    def reading_stds(self, estimate: Estimate) -> Array:
        """Return (σβ, σr) of each reading, shape (M, 2), at its expected range."""
        return reading_stds(*estimate, self._drive, self._rule_values)

    def cost(self, estimate: Estimate, stds: Array) -> float:
        """Return the cost, with the noise of every reading given."""
        return total_cost(*estimate, self._drive, stds, *self._robust)

    def linearise(self, estimate: Estimate, stds: Array, damping: float = 0.0) -> Array:
        """Eliminate the poses; return the information of the landmarks, (2n, 2n)."""
        room, drive = self._room, self._drive
        eliminate(*estimate, drive, stds, self._robust, damping, room)
        rows = room.rows.reshape(-1, len(room.right))
        information = -(rows.T @ rows)
        n = len(room.blocks)
        at = np.arange(n)
        information.reshape(n, 2, n, 2)[at, :, at, :] += room.blocks
        return information

    def _descend(self, state: _State) -> None:
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

    def _relocate(self, state: _State) -> int:
        """Move landmarks out of local minima, in place; return how many."""
        moved = relocate(
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

    def _reweight(self, state: _State) -> None:
        """Update the noise of the readings for the present estimate."""
        state.stds = self.reading_stds(state.estimate)
        state.cost = self.cost(state.estimate, state.stds)

    def _step(self, estimate: Estimate, stds: Array, damping: float) -> Estimate:
        information = self.linearise(estimate, stds, damping)
        factor = factorised(information)
        landmark_step = cho_solve(factor, self._room.right)
        poses = substitute(estimate.poses, self._drive, landmark_step, self._room)
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
