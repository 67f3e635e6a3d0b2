"""Active SLAM: explore an unknown map until every landmark is known accurately."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

import numpy as np
from gymnasium.error import ResetNeeded
from numpy.typing import ArrayLike

from ..arrays import BoolArray
from ..envs import LandmarkWorldEnv
from ..envs.rendering import RENDER_MODES
from ..estimator.filters.batch import BatchStorage, can_batch
from ..estimator.filters.ekf import EkfSlam
from ..sim_configs import Scenario
from .active_slam_task import ActiveSlamTask, split_settings
from .agent_knowledge import AgentKnowledge
from .association_record import AssociationRecord
from .belief_arrays import belief_storage, live_storage
from .estimator_choice import EstimatorChoice, checked_belief, choose_estimator
from .map_truth import map_rmse, matched_rmse

Observation = dict[str, Any]

_ONE_WORLD = np.ones(1, dtype=np.bool_)


class ActiveSlamEnv(LandmarkWorldEnv):
    """A robot explores a walled floor until it knows every landmark.

    ## Description
    The walls of the floor are known. The landmarks are not, and every episode places
    new ones. An estimator runs in the loop, and the agent observes its belief. The pose
    becomes uncertain while the robot explores, and so do the landmarks that it maps
    there. Revisiting well-known landmarks reduces the uncertainty. The agent has to
    explore, to revisit, and to avoid the walls, in few steps.

    ## Action Space
    ``Box(float32, (2,))``: (v, ω), speed [m/s] and turn rate [rad/s], as in
    `LandmarkWorldEnv`.

    ## Observation Space
    ``Dict`` of float64 arrays within [-1, 1] and a bool mask; see
    `ActiveSlamTask` and `belief_features`. All values derive from the belief
    and the walls. N is the number of landmarks, row i is landmark i. Positions of
    landmarks are in the robot's frame, ahead along the heading and aside to the left,
    in diagonals of the floor; zeros where not mapped.

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
    | ``goals`` | (9,) | directions to the nearest unseen, nearest unknown, best known |
    | ``progress`` | (4,) | shares: explored, mapped, known, time left |
    | ``uncertain`` | (16,) | density of mapped, not yet known landmarks, by direction |
    | ``unexplored`` | (16,) | density of unseen cells, by direction |
    | ``walls`` | (8,) | distance to the wall, by direction |

    `info` has the same keys in `reset` and `step`: the truth, ``pose`` (x, y, θ) and
    ``collision``; the counts ``mapped`` and ``known``; ``success``; ``true_rmse``, the
    root mean square error of the mapped landmarks [m], 0 without any; and
    ``honest_success``: a success with a ``true_rmse`` of at most ``accuracy``.

    ## Rewards
    Per step, with U = ½ log det Σ / N the uncertainty of the map in nats per landmark,
    where an unmapped landmark is uniform on the floor (σ = side / √12)::

        U_before - U_after
        - step_cost - effort_cost effort(v, ω)
        - crash_cost                            if a wall is touched
        + success_reward (1 + time left)        if every landmark is known

    The information terms add up to U at the first scan minus U at the end, at most
    about 8 to 12. The return of an episode is within about [-13, 20]. ``criterion`` "A"
    or "E" measures U by the mean squared or the worst error instead [m²].

    | mean return (success) | active_easy | active_medium | active_hard |
    |---|---|---|---|
    | random | 0.8 (0.14) | -0.8 (0.01) | -4.4 (0.00) |
    | coverage | 12.3 (0.85) | 13.7 (0.85) | 5.5 (0.32) |
    | revisit | 10.4 (0.72) | 11.5 (0.75) | 1.9 (0.22) |

    ## Starting State
    The robot is at the scenario's start, known to the estimator with
    ``scenario.start.std``, and has taken one scan.

    ## Episode End
    Terminated when every landmark is known, that is, its worst standard deviation is
    at most ``accuracy``, or when the robot touches a wall. Truncated after
    ``scenario.steps``.

    ## Arguments
    scenario : Scenario, mapping, str or Path, default "active_medium"
        "active_easy", "active_medium", "active_hard", or any with walls. Where it hides
        identities, landmark management associates (``management`` in
        `estimator_options`), a map has at most N landmarks, and row i is landmark i of
        the map. ``true_rmse`` then compares with the nearest match of map and truth,
        and ``association_precision``, ``…_recall``, ``…_duplicate`` and ``…_ghost`` in
        `info` score the episode at its end; -1 before.
    estimator : str, callable or object, default "invariant"
        The filter, see `choose_estimator`. The reward depends on its covariance, so an
        overconfident filter collects reward for information that it does not have.
    estimator_options : mapping, optional
        Further options of the filter.
    criterion, accuracy, success_reward, crash_cost, effort_cost, step_cost
        See `RewardWeights`.
    observation, max_landmarks, dtype
        Form of the observation, see `ObservationForm`. With ``observation="set"`` the
        rows per landmark are replaced by ``landmarks`` (R, 15), one row of
        `landmark_set.FEATURES` per mapped landmark, and ``mask`` (R,).
    render_mode : {"human", "rgb_array"}, optional
        As in `LandmarkWorldEnv`; the frames also show the belief.
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
        weights, form, changes = split_settings(settings)
        super().__init__(scenario, render_mode=render_mode, **changes)
        self.task = ActiveSlamTask(self.scenario, weights, form=form)
        self.observation_space = self.task.observation_space
        self._by_id = self.scenario.sensor.identities
        self._record = None if self._by_id else AssociationRecord(1)
        self._estimator = choose_estimator(
            estimator,
            self.scenario,
            estimator_options,
            rows=self.scenario.landmarks.count,
        )

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start an episode with a new map, and take the first scan."""
        observation, info = super().reset(seed=seed, options=options)
        self._estimator.reset(self.start_estimate, self.scenario.start.std)
        if self._record is not None:
            self._record.begin(_ONE_WORLD)
        beliefs = self._update(observation, info, step=0)
        self.task.begin(beliefs, _ONE_WORLD)
        return self._output(beliefs, info, ~_ONE_WORLD)

    def step(
        self, action: ArrayLike
    ) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Drive one step, take a scan, and compute the reward.

        Raises
        ------
        ValueError
            If the action is not two finite numbers. The world does not change.
        """
        step = self._steps() + 1
        observation, _, _, _, info = super().step(action)
        self._estimator.predict(observation["odometry"])
        beliefs = self._update(observation, info, step=step)
        actions = np.asarray(action, dtype=np.float64)[None]
        collision = np.array([info["collision"]])
        outcome = self.task.proceed(beliefs, _ONE_WORLD, actions, collision)
        ended = outcome.terminated | outcome.truncated
        seen, info = self._output(beliefs, info, ended)
        ends = bool(outcome.terminated[0]), bool(outcome.truncated[0])
        return seen, float(outcome.rewards[0]), *ends, info

    @property
    def knowledge(self) -> AgentKnowledge:
        """The knowledge of an agent at this step, for policies that plan."""
        step, episodes = self._steps(), self.task.episodes
        return AgentKnowledge(
            self.scenario,
            self.task.grid,
            getattr(self._estimator, "filter", self._estimator),  # of managed ones
            self._estimator.belief(),
            episodes.explored[0].copy(),
            episodes.known[0].copy(),
            self.task.weights.accuracy,
            self.task.prior_std,
            step,
        )

    def _steps(self) -> int:
        if not self.task.begun:
            raise ResetNeeded("call reset first: there is no episode yet")
        return int(self.task.episodes.steps[0])

    def _update(
        self, observation: Observation, info: Mapping[str, Any], *, step: int
    ) -> BatchStorage:
        """Update the estimator with one scan; return its belief."""
        mask = observation["mask"]
        seen = np.flatnonzero(mask)
        if self._record is not None:
            self._record.add(_ONE_WORLD, info["landmark_ids"][None], mask[None])
        ids = seen.tolist() if self._by_id else None
        self._estimator.update(observation["landmarks"][seen], ids)
        count = self.scenario.landmarks.count
        if self.render_mode is None and can_batch(self._estimator):
            return live_storage(cast("EkfSlam", self._estimator), count)
        belief = checked_belief(self._estimator, step)
        self.show_belief(belief)
        return belief_storage(belief, count, by_id=self._by_id)

    def _output(
        self, beliefs: BatchStorage, info: dict[str, Any], ended: BoolArray
    ) -> tuple[Observation, dict[str, Any]]:
        rows = self.task.observations()
        error = map_rmse if self._by_id else matched_rmse
        rmse = float(error(beliefs, self._landmarks[None])[0])
        success = bool(self.task.outcome.success[0])
        counts: dict[str, Any] = {
            "mapped": int(self.task.mapped[0]),
            "known": int(self.task.known[0]),
            "success": success,
            "true_rmse": rmse,
            "honest_success": success and rmse <= self.task.weights.accuracy,
        }
        if self._record is not None:
            scores = self._record.scores([self._estimator], ended)
            counts |= {key: float(score[0]) for key, score in scores.items()}
        return {key: row[0] for key, row in rows.items()}, {**info, **counts}
