"""Active SLAM: explore an unknown map of landmarks, and come to know it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium
import numpy as np
from gymnasium.error import ResetNeeded
from numpy.typing import ArrayLike, NDArray

from ..envs import LandmarkWorldEnv
from ..envs.rendering import RENDER_MODES
from ..sim_configs import Scenario
from .active_slam_task import ActiveSlamTask, Progress, Stakes
from .belief_arrays import belief_in_rows
from .coverage_grid import FloorPlan
from .estimator_choice import (
    BeliefOfMap,
    EstimatorChoice,
    FollowingEstimator,
    checked_belief,
    choose_estimator,
)

Array = NDArray[np.float64]
Observation = dict[str, Any]


class Situation(NamedTuple):
    """All that an agent may know at one moment; nothing of the truth."""

    scenario: Scenario
    plan: FloorPlan
    estimator: FollowingEstimator
    """To ask what would be; whoever changes its state restores it."""
    belief: BeliefOfMap
    explored: NDArray[np.bool_]
    """Cells of the plan seen so far, as believed, shape (C,)."""
    known: NDArray[np.bool_]
    """Landmarks known to the accuracy, shape (N,)."""
    accuracy: float
    """That a landmark has to be known to [m]."""
    prior_std: tuple[float, float]
    """Of the coordinates of a landmark not yet mapped [m]."""
    step: int
    """Steps done so far."""


class ActiveSlamEnv(gymnasium.Env[Observation, NDArray[Any]]):
    """A robot explores a walled floor until it knows where every landmark is.

    ## Description
    The floor's plan is known, its landmarks are not: they stand elsewhere in every
    episode. An estimator follows the robot, and the agent observes what it believes.
    Its pose decays while it drives into the unknown, and with it every landmark it
    maps from there; seeing landmarks again that are known well makes up for it. So the
    agent has to explore, to look again, and not to touch a wall, in few steps.

    ## Action Space
    ``Box(float32, (2,))``: (v, ω), speed [m/s] and turn rate [rad/s], as in
    `LandmarkWorldEnv`.

    ## Observation Space
    ``Dict`` of float64 arrays within [-1, 1] and a bool mask; see
    `ActiveSlamTask.observe` and `belief_features`. All of it comes from the belief and
    the plan. N is the number of landmarks, row i is landmark i. Where landmarks are
    believed is told in the robot's frame, ahead along the heading and aside to the
    left, in diagonals of the floor; zeros where they are not mapped.

    | key | shape | content |
    |---|---|---|
    | ``belief_pose`` | (4,) | x, y on the floor's scale; cos θ, sin θ |
    | ``belief_pose_std`` | (3,) | σ ahead, aside, of the heading; log scale |
    | ``belief_pose_correlation`` | (3,) | of the three |
    | ``belief_landmarks`` | (2N,) | landmark 0 ahead, aside; 1 ahead, aside; … |
    | ``belief_landmark_std`` | (2N,) | σ of the same, log scale |
    | ``belief_landmark_correlation`` | (N,) | of the two |
    | ``belief_landmark_map_std`` | (N,) | worst σ in the map's frame, log scale |
    | ``belief_mask`` | (N,) bool | which landmarks are mapped |
    | ``goals`` | (9,) | ways to the nearest unseen, nearest unknown, best known |
    | ``progress`` | (4,) | shares: explored, mapped, known, time left |
    | ``uncertain`` | (16,) | pull of mapped landmarks not yet known, by direction |
    | ``unexplored`` | (16,) | pull of the floor not yet seen, by direction |
    | ``walls`` | (8,) | way to the wall, by direction |

    `info` has the same keys in `reset` and `step`: the truth, ``pose`` (x, y, θ) and
    ``collision``; the counts ``mapped`` and ``known``; and ``success``.

    ## Rewards
    Per step, with U = ½ log det Σ / N the uncertainty of the map in nats per landmark,
    where a landmark not yet mapped may be anywhere on the floor (σ = side / √12)::

        U_before - U_after
        - step_cost - effort_cost effort(v, ω)
        - crash_cost                            if a wall is touched
        + success_reward (1 + time left)        if every landmark is known

    The information terms add up to U at the first scan minus U at the end, some 8 to
    12 at most; all rewards of an episode lie within about [-13, 20]. ``criterion`` "A"
    or "E" measures U by the mean squared or the worst error instead [m²].

    | mean return (success) | active_easy | active_medium | active_hard |
    |---|---|---|---|
    | random | 0.6 (0.10) | -1.3 (0.01) | -4.7 (0.00) |
    | coverage | 12.6 (0.90) | 13.7 (0.84) | 4.9 (0.25) |
    | greedy | 12.9 (0.83) | 10.9 (0.57) | 1.4 (0.00) |
    | revisit | 10.9 (0.76) | 11.4 (0.72) | 2.0 (0.22) |
    | PPO, 2 million steps | | 14.7 (0.90) | |

    ## Starting State
    The robot stands at the scenario's start, which the estimator knows to
    ``scenario.start.std``; it has taken one scan.

    ## Episode End
    Terminated when every landmark is known: its worst standard deviation is at most
    ``accuracy``. Terminated on touching a wall. Truncated after ``scenario.steps``.

    ## Arguments
    scenario : Scenario, mapping, str or Path, default "active_medium"
        "active_easy", "active_medium", "active_hard", or any with walls and identities.
    estimator : str, callable or object, default "invariant"
        Which filter: see `choose_estimator`. The reward is its own opinion, so an
        overconfident filter is paid for what it does not know.
    estimator_options : mapping, optional
        Further options of the filter.
    criterion, accuracy, success_reward, crash_cost, effort_cost, step_cost
        See `Stakes`.
    render_mode : {"human", "rgb_array"}, optional
        As in `LandmarkWorldEnv`; the frames show the belief too.
    **changes
        Fields of the scenario to replace, as in `Scenario.with_changes`.

    ## Version History
    * v0: initial version

    Examples
    --------
    >>> import gymnasium, slamgym
    >>> env = ActiveSlamEnv("active_easy")
    >>> observation, info = env.reset(seed=0)
    >>> observation["belief_landmarks"].shape
    (12,)
    """

    metadata = {"render_modes": list(RENDER_MODES), "render_fps": 10}  # noqa: RUF012

    def __init__(
        self,
        scenario: Scenario | Mapping[str, object] | str | Path = "active_medium",
        *,
        estimator: EstimatorChoice = "invariant",
        estimator_options: Mapping[str, Any] | None = None,
        render_mode: str | None = None,
        **settings: Any,
    ) -> None:
        stakes, changes = split_settings(settings)
        self._world = LandmarkWorldEnv(scenario, render_mode=render_mode, **changes)
        self.scenario = self._world.scenario
        self.render_mode = render_mode
        self.task = ActiveSlamTask(self.scenario, stakes)
        self.action_space = self._world.action_space
        self.observation_space = self.task.observation_space
        self._estimator = choose_estimator(estimator, self.scenario, estimator_options)
        self._progress: Progress | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begin an episode with a new map, and take the first scan."""
        super().reset(seed=seed)
        self._world.np_random = self.np_random
        observation, info = self._world.reset(options=options)
        self._estimator.reset(self._world.start_estimate, self.scenario.start.std)
        self._progress = self.task.begin(self._take_in(observation, step=0))
        return self._answer(info, success=False)

    def step(
        self, action: ArrayLike
    ) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Drive one step, look, and be rewarded for what that told.

        Raises
        ------
        ValueError
            If the action is not two finite numbers; the world stays as it is.
        """
        before = self._reached()
        observation, _, _, _, info = self._world.step(action)
        self._estimator.predict(observation["odometry"])
        step = int(before.steps[0]) + 1
        after = self.task.proceed(before, self._take_in(observation, step=step))
        self._progress = after
        collision = np.array([info["collision"]])
        actions = np.asarray(action, dtype=np.float64)[None]
        verdict = self.task.judge(before, after, actions, collision)
        seen, info = self._answer(info, success=bool(verdict.success[0]))
        ends = bool(verdict.terminated[0]), bool(verdict.truncated[0])
        return seen, float(verdict.rewards[0]), *ends, info

    def render(self) -> NDArray[np.uint8] | None:
        """Return a frame in mode "rgb_array", else None."""
        return self._world.render()

    def close(self) -> None:
        """Close the window, if there is one."""
        self._world.close()

    @property
    def situation(self) -> Situation:
        """What an agent may know now, for those that plan instead of learn."""
        progress = self._reached()
        return Situation(
            self.scenario,
            self.task.plan,
            self._estimator,
            self._belief,
            progress.explored[0],
            progress.known[0],
            self.task.stakes.accuracy,
            self.task.prior_std,
            int(progress.steps[0]),
        )

    @property
    def landmarks(self) -> Array:
        """True positions of this episode's landmarks, (N, 2) [m], for pictures."""
        return self._world.landmarks

    def _reached(self) -> Progress:
        if self._progress is None:
            raise ResetNeeded("call reset first: there is no episode yet")
        return self._progress

    def _take_in(self, observation: Observation, *, step: int) -> Any:
        """Let the estimator see one scan; return its belief in rows."""
        seen = np.flatnonzero(observation["mask"])
        self._estimator.update(observation["landmarks"][seen], seen.tolist())
        self._belief = checked_belief(self._estimator, step)
        if self.render_mode is not None:
            self._world.show_belief(self._belief)
        return belief_in_rows(self._belief, self.scenario.landmarks.count, by_id=True)

    def _answer(
        self, info: dict[str, Any], *, success: bool
    ) -> tuple[Observation, dict[str, Any]]:
        progress = self._reached()
        rows = self.task.observe(progress)
        counts = {
            "mapped": int(progress.beliefs.mapped.sum()),
            "known": int(progress.known.sum()),
            "success": success,
        }
        return {key: row[0] for key, row in rows.items()}, {**info, **counts}


def split_settings(settings: Mapping[str, Any]) -> tuple[Stakes, dict[str, Any]]:
    """Tell the stakes from changes of the scenario."""
    own = {field.name for field in fields(Stakes)}
    stakes = Stakes(**{key: settings[key] for key in settings if key in own})
    return stakes, {key: settings[key] for key in settings if key not in own}
