"""Active SLAM in many worlds, simulated together and with batched filters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from numpy.typing import ArrayLike

from ..arrays import AnyArray, Array, BoolArray
from ..envs.vector import LandmarkWorldVectorEnv
from ..estimator.filters.batch import BatchBeliefs
from ..sim_configs import Scenario
from .active_slam_task import ActiveSlamTask, split_settings
from .association_record import AssociationRecord
from .map_truth import map_rmse, matched_rmse
from .separate_filters import SeparateFilters, choose_filters, update_filters

Observation = dict[str, AnyArray]


class ActiveSlamVectorEnv(LandmarkWorldVectorEnv):
    """Many worlds of `ActiveSlamEnv`, whose docstring describes the task.

    World i after ``reset(seed=s)`` equals a single one after ``reset(seed=s + i)``.

    Parameters
    ----------
    num_envs : int
        B, the number of worlds.
    scenario, estimator_options, **settings
        As in `ActiveSlamEnv`.
    estimator : str, default "invariant"
        The registered name of a filter that runs in batches. Where the scenario hides
        identities, one that landmark management takes; filters run one by one then.
    max_episode_steps : int, optional
        Truncates episodes earlier than the scenario's own number of steps.
    autoreset_mode : AutoresetMode or str, default "NextStep"
        Any of Gymnasium's three. "Disabled" needs ``options={"reset_mask": …}``.
    render_mode : {"human", "rgb_array"}, optional
        As in `LandmarkWorldVectorEnv`; the frames also show the beliefs.

    Examples
    --------
    >>> envs = ActiveSlamVectorEnv(num_envs=3, scenario="active_easy")
    >>> observations, infos = envs.reset(seed=0)
    >>> observations["walls"].shape
    (3, 8)
    """

    def __init__(
        self,
        num_envs: int = 1,
        scenario: Scenario | Mapping[str, object] | str | Path = "active_medium",
        *,
        estimator: str = "invariant",
        estimator_options: Mapping[str, Any] | None = None,
        max_episode_steps: int | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        render_mode: str | None = None,
        **settings: Any,
    ) -> None:
        weights, form, changes = split_settings(settings)
        super().__init__(
            num_envs,
            scenario,
            max_episode_steps=max_episode_steps,
            autoreset_mode=autoreset_mode,
            render_mode=render_mode,
            **changes,
        )
        self.task = ActiveSlamTask(self.scenario, weights, num_envs, form)
        self.single_observation_space = self.task.observation_space
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        count = self.scenario.landmarks.count
        self._filters = choose_filters(
            estimator, self.scenario, num_envs, count, estimator_options
        )
        by_id = self.scenario.sensor.identities
        self._all = np.ones(num_envs, dtype=np.bool_)
        self._record = None if by_id else AssociationRecord(num_envs)

    def beliefs(self) -> BatchBeliefs:
        """Return the present beliefs of all filters."""
        if not self.task.begun:
            raise ResetNeeded("call reset first: there are no episodes yet")
        return self._filters.beliefs()

    def _reward(self, actions: ArrayLike, moving: BoolArray) -> tuple[Array, BoolArray]:
        if np.count_nonzero(moving) < self.num_envs:
            self._begin_filters(~moving)
        self._filter(self._all, moving)
        outcome = self.task.proceed(
            self._filters.storage(), moving, actions, self._worlds.collisions
        )
        return outcome.rewards, outcome.terminated

    def _begin(self, worlds: BoolArray, seeds: Sequence[int | None] = ()) -> None:
        """Start episodes in some worlds, each with its first scan."""
        super()._begin(worlds, seeds)
        self._begin_filters(worlds)
        self._filter(worlds, ~worlds)
        self.task.begin(self._filters.storage(), worlds)

    def _begin_filters(self, worlds: BoolArray) -> None:
        if self._record is not None:
            self._record.begin(worlds)
        estimates = self._worlds.start_estimates
        self._filters.reset(estimates, self.scenario.start.std, runs=worlds)

    def _filter(self, worlds: BoolArray, moved: BoolArray) -> None:
        observations = super()._observations()
        if self._record is not None:
            true_ids: Any = self._worlds.landmark_ids
            self._record.add(worlds, true_ids, observations["mask"])
        update_filters(self._filters, observations, worlds, moved=moved)
        if self.render_mode is not None:
            self.show_beliefs(list(map(self._filters.belief, range(self.num_envs))))

    def _observations(self) -> Observation:
        observations = self.task.observations()
        if self.autoreset_mode != AutoresetMode.DISABLED:
            return observations
        # a partial reset repeats them: the caller must not write into the originals
        return {key: rows.copy() for key, rows in observations.items()}

    def _infos(self) -> dict[str, Any]:
        beliefs, success = self._filters.storage(), self.task.outcome.success.copy()
        error = map_rmse if self._record is None else matched_rmse
        rmse = error(beliefs, self._worlds.complex_landmarks)
        infos = {
            **super()._infos(),
            "mapped": self.task.mapped,
            "known": self.task.known,
            "success": success,
            "true_rmse": rmse,
            "honest_success": success & (rmse <= self.task.weights.accuracy),
        }
        if self._record is not None and isinstance(self._filters, SeparateFilters):
            infos |= self._record.scores(self._filters.filters, self._ended)
        return infos
