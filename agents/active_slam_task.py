"""The rules of active SLAM, for one world or for many side by side."""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from ..sim_configs import Scenario
from .belief_arrays import BeliefArrays, stored
from .belief_features import belief_features, belief_space, largest_variances
from .coverage_grid import SECTORS, FloorPlan
from .information_reward import CRITERIA, effort, landmark_prior_std, uncertainty

Array = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

_SOME_CELLS = 8.0  # pull as much as one landmark
_REACHES = (0.1, 0.4)  # of what pulls the robot, in diagonals of the floor


@dataclass(frozen=True)
class Stakes:
    """What is rewarded and what is charged; plain numbers, the keywords of the task."""

    criterion: str = "D"
    """Of the map's covariance, see `information_reward`."""
    accuracy: float = 0.25
    """A landmark is known when its worst standard deviation is at most this [m]."""
    success_reward: float = 5.0
    """For knowing every landmark, times the share of the episode that is left, + 1."""
    crash_cost: float = 5.0
    """For driving into a wall, which ends the episode."""
    effort_cost: float = 0.0
    """For an `effort` of 1, per step."""
    step_cost: float = 0.02
    """Per step."""

    def __post_init__(self) -> None:
        if self.criterion not in CRITERIA:
            raise ValueError(
                f"criterion must be one of {', '.join(CRITERIA)}, "
                f"got {self.criterion!r}"
            )
        if not (np.isfinite(self.accuracy) and self.accuracy > 0):
            raise ValueError(
                f"accuracy must be a finite number > 0 [m], got {self.accuracy!r}"
            )


class Progress(NamedTuple):
    """Where the episodes of B worlds stand."""

    beliefs: BeliefArrays
    explored: BoolArray
    """Cells of the floor that the sensor has read, as believed, shape (B, C)."""
    steps: NDArray[np.int64]
    """Done so far, shape (B,)."""
    uncertainty: Array
    """Of the maps, shape (B,)."""
    variances: Array
    """Of each landmark in its worst direction, 0 where not mapped, (B, N) [m²]."""
    known: BoolArray
    """Landmarks known to the accuracy, shape (B, N)."""


class Verdict(NamedTuple):
    """What one step of B worlds brings."""

    rewards: Array
    terminated: BoolArray
    truncated: BoolArray
    success: BoolArray


class ActiveSlamTask:
    """Observes, rewards and ends episodes of active SLAM; holds nothing of them.

    Parameters
    ----------
    scenario : Scenario
        With walls and with identities.
    stakes : Stakes
        What is rewarded.
    """

    def __init__(self, scenario: Scenario, stakes: Stakes) -> None:
        if not scenario.sensor.identities:
            raise ValueError(
                f"scenario must have sensor.identities = true, got false in "
                f"'{scenario.name}'"
            )
        self.scenario = scenario
        self.stakes = stakes
        self.plan = FloorPlan(scenario)
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
        belief = {key: _flat(box) for key, box in belief_space(count).spaces.items()}
        self.observation_space = spaces.Dict({**belief, **own})

    def begin(self, beliefs: BeliefArrays) -> Progress:
        """Take stock after the first scan."""
        steps = np.zeros(len(beliefs.means), dtype=np.int64)
        return self._progress(beliefs, self.plan.seen_from(beliefs.poses), steps)

    def proceed(self, before: Progress, beliefs: BeliefArrays) -> Progress:
        """Take stock after a step and its scan."""
        explored = before.explored | self.plan.seen_from(beliefs.poses)
        return self._progress(beliefs, explored, before.steps + 1)

    def judge(
        self, before: Progress, after: Progress, actions: Any, collisions: BoolArray
    ) -> Verdict:
        """Reward a step of every world, and tell which episodes end."""
        stakes, robot = self.stakes, self.scenario.robot
        left = 1.0 - after.steps / self.scenario.steps
        success = after.known.all(axis=1) & ~collisions
        limits = robot.max_speed, robot.max_turn_rate
        rewards = before.uncertainty - after.uncertainty
        rewards = rewards - stakes.step_cost
        rewards -= stakes.effort_cost * effort(actions, limits)
        rewards -= stakes.crash_cost * collisions
        rewards += stakes.success_reward * (1.0 + left) * success
        terminated = success | collisions
        truncated = ~terminated & (after.steps >= self.scenario.steps)
        return Verdict(rewards, terminated, truncated, success)

    def observe(self, progress: Progress) -> dict[str, NDArray[Any]]:
        """Show an agent what it knows; the keys of the observation space, each (B, k).

        Stable-Baselines3 takes arrays of two axes for pictures, so all are flat.

        =============== =========== ===============================================
        ``belief_…``                see `belief_features`; rows one after the other
        ``goals``       (B, 9)      bearing (cos, sin) and distance of three: the
                                    nearest cell not yet seen, the nearest mapped
                                    landmark not yet known, and the landmark known best;
                                    zeros where there is none
        ``progress``    (B, 4)      shares: of the floor explored, of landmarks mapped,
                                    of landmarks known, of time left
        ``uncertain``   (B, 16)     pull of mapped landmarks that are not yet known,
                                    near and far, in 8 directions from straight ahead
                                    counter-clockwise
        ``unexplored``  (B, 16)     the same of cells not yet seen
        ``walls``       (B, 8)      way d to the wall, as d / (d + longest step)
        =============== =========== ===============================================
        """
        beliefs, plan = progress.beliefs, self.plan
        belief = belief_features(stored(beliefs), plan.bounds)
        return {
            **{key: rows.reshape(len(rows), -1) for key, rows in belief.items()},
            "goals": self._goals(progress),
            "progress": self._shares(progress),
            "uncertain": self._uncertain(progress),
            "unexplored": self._unexplored(progress),
            "walls": self._walls(beliefs.poses),
        }

    def _progress(
        self, beliefs: BeliefArrays, explored: BoolArray, steps: NDArray[np.int64]
    ) -> Progress:
        spread = beliefs.landmark_covariances
        variance = largest_variances(
            spread[..., 0, 0], spread[..., 0, 1], spread[..., 1, 1]
        )
        known = beliefs.mapped & (variance <= self.stakes.accuracy**2)
        measure = uncertainty(beliefs, self.stakes.criterion, self.prior_std)
        return Progress(beliefs, explored, steps, measure, variance, known)

    def _walls(self, poses: Array) -> Array:
        distances = self.plan.wall_distances(poses)
        return distances / (
            distances + self.scenario.robot.max_speed * self.scenario.dt
        )

    def _goals(self, progress: Progress) -> Array:
        beliefs, cells = progress.beliefs, self.plan.cells
        position = beliefs.poses[:, :1] + 1j * beliefs.poses[:, 1:2]
        places = _as_complex(beliefs.landmarks)
        open_cases = beliefs.mapped & ~progress.known
        costs = [
            np.where(progress.explored, np.inf, np.abs(cells - position)),
            np.where(open_cases, np.abs(places - position), np.inf),
            np.where(beliefs.mapped, progress.variances, np.inf),
        ]
        ways = [
            self.plan.way_to_least(beliefs.poses, points, cost)
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
        open_cases = (beliefs.mapped & ~progress.known).astype(np.float64)
        return self._pulls(beliefs.poses, points, open_cases, unit=1.0)

    def _unexplored(self, progress: Progress) -> Array:
        unseen = (~progress.explored).astype(np.float64)
        poses, cells = progress.beliefs.poses, self.plan.cells
        return self._pulls(poses, cells, unseen, unit=_SOME_CELLS)

    def _pulls(
        self, poses: Array, points: NDArray[np.complex128], weights: Array, unit: float
    ) -> Array:
        """Sum up near and far, squashed to [0, 1): 1/2 at a pull of one unit."""
        sums = np.stack(
            [
                self.plan.pull(poses, points, weights, share * self.plan.diagonal)
                for share in _REACHES
            ],
            axis=1,
        )
        return (sums / (sums + unit)).reshape(len(poses), -1)


def _as_complex(points: Array) -> NDArray[np.complex128]:
    return np.asarray(points[..., 0] + 1j * points[..., 1])


def _flat(box: spaces.Space[Any]) -> spaces.Box:
    assert isinstance(box, spaces.Box)
    kind: Any = box.dtype
    return spaces.Box(box.low.ravel(), box.high.ravel(), dtype=kind)
