"""The rules of active SLAM, for one world or for many."""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces
from gymnasium.spaces.utils import flatten_space

from ..arrays import AnyArray, Array, BoolArray, ComplexArray, IntArray
from ..sim_configs import Scenario
from .belief_arrays import BeliefArrays, as_storage
from .belief_features import belief_features, belief_space, largest_variances
from .coverage_grid import SECTORS, CoverageGrid
from .information_reward import check_criterion, effort, landmark_prior_std, uncertainty

_CELLS_PER_LANDMARK = 8.0  # cells that weigh as much as one landmark
_REACHES = (0.1, 0.4)  # near and far, in diagonals of the floor


@dataclass(frozen=True)
class RewardWeights:
    """Rewards, costs and accuracy of the task: keywords of the environments."""

    criterion: str = "D"
    """Criterion of the map's covariance, see `information_reward`."""
    accuracy: float = 0.25
    """A landmark is known when its worst standard deviation is at most this [m]."""
    success_reward: float = 5.0
    """For knowing every landmark, multiplied by 1 + the share of steps left."""
    crash_cost: float = 5.0
    """For touching a wall, which ends the episode."""
    effort_cost: float = 0.0
    """For an `effort` of 1, per step."""
    step_cost: float = 0.02
    """Per step."""

    def __post_init__(self) -> None:
        check_criterion(self.criterion)
        if not (np.isfinite(self.accuracy) and self.accuracy > 0):
            raise ValueError(
                f"accuracy must be a finite number > 0 [m], got {self.accuracy!r}"
            )


class Progress(NamedTuple):
    """The progress of episodes in B worlds."""

    beliefs: BeliefArrays
    explored: BoolArray
    """Cells seen so far, as believed, shape (B, C)."""
    steps: IntArray
    """Steps so far, shape (B,)."""
    uncertainty: Array
    """Of the map, see `information_reward.uncertainty`, shape (B,)."""
    variances: Array
    """Worst variance of each landmark, 0 where not mapped, shape (B, N) [m²]."""
    known: BoolArray
    """Landmarks known to the required accuracy, shape (B, N)."""


class StepOutcome(NamedTuple):
    """The outcome of one step in B worlds; arrays of shape (B,)."""

    rewards: Array
    terminated: BoolArray
    truncated: BoolArray
    success: BoolArray


class ActiveSlamTask:
    """Computes observations, rewards and ends of episodes; has no state of its own.

    Parameters
    ----------
    scenario : Scenario
        With walls and with identities.
    weights : RewardWeights
        Rewards and costs.
    """

    def __init__(self, scenario: Scenario, weights: RewardWeights) -> None:
        if not scenario.sensor.identities:
            raise ValueError(
                f"scenario must have sensor.identities = true, got false in "
                f"'{scenario.name}'"
            )
        self.scenario = scenario
        self.weights = weights
        self.grid = CoverageGrid(scenario)
        self.prior_std = landmark_prior_std(scenario)
        count = scenario.landmarks.count
        sizes = {
            "goals": 9,
            "progress": 4,
            "uncertain": 2 * SECTORS,
            "unexplored": 2 * SECTORS,
            "walls": SECTORS,
        }
        own = {
            key: spaces.Box(-float(key == "goals"), 1.0, (size,), dtype=np.float64)
            for key, size in sizes.items()
        }
        belief = {key: flatten_space(box) for key, box in belief_space(count).items()}
        self.observation_space = spaces.Dict({**belief, **own})

    def begin(self, beliefs: BeliefArrays) -> Progress:
        """Return the progress after the first scan."""
        steps = np.zeros(len(beliefs.means), dtype=np.int64)
        return self._progress(beliefs, self.grid.visible_from(beliefs.poses), steps)

    def proceed(self, before: Progress, beliefs: BeliefArrays) -> Progress:
        """Return the progress after a step and its scan."""
        explored = before.explored | self.grid.visible_from(beliefs.poses)
        return self._progress(beliefs, explored, before.steps + 1)

    def reward(
        self, before: Progress, after: Progress, actions: Any, collisions: BoolArray
    ) -> StepOutcome:
        """Compute the rewards of a step, and which episodes end."""
        weights, robot = self.weights, self.scenario.robot
        left = 1.0 - after.steps / self.scenario.steps
        success = after.known.all(axis=1) & ~collisions
        limits = robot.max_speed, robot.max_turn_rate
        rewards = before.uncertainty - after.uncertainty
        rewards = rewards - weights.step_cost
        rewards -= weights.effort_cost * effort(actions, limits)
        rewards -= weights.crash_cost * collisions
        rewards += weights.success_reward * (1.0 + left) * success
        terminated = success | collisions
        truncated = ~terminated & (after.steps >= self.scenario.steps)
        return StepOutcome(rewards, terminated, truncated, success)

    def observe(self, progress: Progress) -> dict[str, AnyArray]:
        """Compute the observation; the keys of the observation space, each (B, k).

        All arrays are flat, because Stable-Baselines3 treats two axes as an image.

        =============== =========== ===============================================
        ``belief_…``                see `belief_features`; rows flattened
        ``goals``       (B, 9)      bearing (cos, sin) and distance of three: the
                                    nearest cell not yet seen, the nearest mapped
                                    landmark not yet known, and the landmark known best;
                                    zeros where there is none
        ``progress``    (B, 4)      shares: of the floor explored, of landmarks mapped,
                                    of landmarks known, of time left
        ``uncertain``   (B, 16)     density of mapped, not yet known landmarks,
                                    near and far, in 8 directions from straight ahead
                                    counter-clockwise
        ``unexplored``  (B, 16)     the same of cells not yet seen
        ``walls``       (B, 8)      distance d to the wall, as d / (d + longest step)
        =============== =========== ===============================================
        """
        beliefs, grid = progress.beliefs, self.grid
        belief = belief_features(as_storage(beliefs), grid.bounds)
        return {
            **{key: rows.reshape(len(rows), -1) for key, rows in belief.items()},
            "goals": self._goals(progress),
            "progress": self._shares(progress),
            "uncertain": self._uncertain(progress),
            "unexplored": self._unexplored(progress),
            "walls": self._walls(beliefs.poses),
        }

    def _progress(
        self, beliefs: BeliefArrays, explored: BoolArray, steps: IntArray
    ) -> Progress:
        variance = largest_variances(beliefs.landmark_covariances)
        known = beliefs.mapped & (variance <= self.weights.accuracy**2)
        measure = uncertainty(beliefs, self.weights.criterion, self.prior_std)
        return Progress(beliefs, explored, steps, measure, variance, known)

    def _walls(self, poses: Array) -> Array:
        distances = self.grid.wall_distances(poses)
        return distances / (
            distances + self.scenario.robot.max_speed * self.scenario.dt
        )

    def _goals(self, progress: Progress) -> Array:
        beliefs, cells = progress.beliefs, self.grid.cells
        position = beliefs.poses[:, :1] + 1j * beliefs.poses[:, 1:2]
        places = _as_complex(beliefs.landmarks)
        unknown = beliefs.mapped & ~progress.known
        costs = [
            np.where(progress.explored, np.inf, np.abs(cells - position)),
            np.where(unknown, np.abs(places - position), np.inf),
            np.where(beliefs.mapped, progress.variances, np.inf),
        ]
        ways = [
            self.grid.direction_to_cheapest(beliefs.poses, points, cost)
            for points, cost in zip((cells, places, places), costs, strict=True)
        ]
        return np.concatenate(ways, axis=1)

    def _shares(self, progress: Progress) -> Array:
        return np.stack(
            [
                progress.explored.mean(axis=1),
                progress.beliefs.mapped.mean(axis=1),
                progress.known.mean(axis=1),
                1.0 - np.minimum(progress.steps / self.scenario.steps, 1.0),
            ],
            axis=1,
        )

    def _uncertain(self, progress: Progress) -> Array:
        beliefs = progress.beliefs
        points = _as_complex(beliefs.landmarks)
        unknown = (beliefs.mapped & ~progress.known).astype(np.float64)
        return self._sector_features(beliefs.poses, points, unknown, unit=1.0)

    def _unexplored(self, progress: Progress) -> Array:
        unseen = (~progress.explored).astype(np.float64)
        poses, cells = progress.beliefs.poses, self.grid.cells
        return self._sector_features(poses, cells, unseen, unit=_CELLS_PER_LANDMARK)

    def _sector_features(
        self, poses: Array, points: ComplexArray, weights: Array, unit: float
    ) -> Array:
        """Compute near and far sums s, scaled to s / (s + unit) in [0, 1)."""
        sums = np.stack(
            [
                self.grid.sector_sums(
                    poses, points, weights, share * self.grid.diagonal
                )
                for share in _REACHES
            ],
            axis=1,
        )
        return (sums / (sums + unit)).reshape(len(poses), -1)


def _as_complex(points: Array) -> ComplexArray:
    return np.asarray(points[..., 0] + 1j * points[..., 1])
