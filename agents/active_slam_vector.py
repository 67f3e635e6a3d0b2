"""Active SLAM in many worlds, simulated together and with batched filters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import ArrayLike, NDArray

from ..envs.spaces import action_space
from ..envs.vector import WorldBatch
from ..envs.vector.episodes import (
    checked_reset_mask,
    episode_steps,
    final_infos,
    with_masks,
    world_seeds,
)
from ..estimator.support import argument_checks
from ..sim_configs import Scenario, load_scenario
from .active_slam import split_settings
from .active_slam_task import ActiveSlamTask, Progress
from .belief_arrays import BeliefArrays, beliefs_of_batch, update_filters
from .estimator_choice import choose_batch

Array = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
Observation = dict[str, NDArray[Any]]


class ActiveSlamVectorEnv(VectorEnv[Observation, NDArray[Any], NDArray[Any]]):
    """Many worlds of `ActiveSlamEnv`, whose docstring describes the task.

    World i after ``reset(seed=s)`` equals a single one after ``reset(seed=s + i)``.

    Parameters
    ----------
    num_envs : int
        B, the number of worlds.
    scenario, estimator_options, **settings
        As in `ActiveSlamEnv`.
    estimator : str, default "invariant"
        The registered name of a filter that runs in batches.
    max_episode_steps : int, optional
        Truncates episodes earlier than the scenario's own number of steps.
    autoreset_mode : AutoresetMode or str, default "NextStep"
        Any of Gymnasium's three. "Disabled" needs ``options={"reset_mask": …}``.
    render_mode : None
        Vector environments of active SLAM are not rendered.

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
        if render_mode is not None:
            raise ValueError(
                f"render_mode must be None for vector environments, got {render_mode!r}"
            )
        num_envs = argument_checks.whole("num_envs", num_envs, 1)
        weights, changes = split_settings(settings)
        self.scenario = load_scenario(scenario)
        if changes:
            self.scenario = self.scenario.with_changes(**changes)
        self.num_envs = num_envs
        self.render_mode = None
        self.task = ActiveSlamTask(self.scenario, weights)
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        self.metadata = {"render_modes": [], "autoreset_mode": self.autoreset_mode}
        self.single_action_space = action_space(self.scenario)
        self.single_observation_space = self.task.observation_space
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self._max_steps = episode_steps(self.scenario, max_episode_steps)
        self._worlds = WorldBatch(self.scenario, num_envs)
        self._filters = choose_batch(
            estimator,
            self.scenario,
            num_envs,
            self.scenario.landmarks.count,
            estimator_options,
        )
        self._generators: list[Any] = [None] * num_envs
        self._progress: Progress | None = None
        self._ended = np.zeros(num_envs, dtype=np.bool_)

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Observation, dict[str, Any]]:
        """Start episodes in all worlds, or in those of ``options["reset_mask"]``."""
        mask = checked_reset_mask(options, self.num_envs)
        chosen = np.ones(self.num_envs, dtype=np.bool_) if mask is None else mask.copy()
        for world, each in enumerate(world_seeds(seed, self.num_envs)):
            if chosen[world] and (each is not None or self._generators[world] is None):
                self._generators[world] = seeding.np_random(each)[0]
        self._begin(chosen)
        self._ended &= ~chosen
        observations, infos = self._output(np.zeros_like(chosen))
        return observations, with_masks(infos, mask, self.num_envs)

    def step(
        self, actions: ArrayLike
    ) -> tuple[Observation, Array, BoolArray, BoolArray, dict[str, Any]]:
        """Step every world; see `ActiveSlamEnv.step` and Gymnasium's autoreset modes.

        Raises
        ------
        ValueError
            If an action is not two finite numbers.
        """
        before = self._reached()
        fresh = self._ended
        moving = ~fresh
        if fresh.any() and self.autoreset_mode is AutoresetMode.DISABLED:
            raise ResetNeeded(
                f"call reset with a reset_mask: episodes of worlds "
                f"{np.flatnonzero(fresh).tolist()} have ended"
            )
        self._worlds.step(actions, moving)
        self._filter(moving, moved=True)
        after = self.task.proceed(before, self._beliefs())
        outcome = self.task.reward(
            before,
            after,
            np.where(moving[:, None], actions, 0.0),
            self._worlds.collisions,
        )
        truncated = outcome.truncated | (
            ~outcome.terminated & (after.steps >= self._max_steps)
        )
        self._progress = after
        self._ended = (outcome.terminated | truncated) & moving
        if fresh.any():
            self._begin(fresh)
        rewards = np.where(moving, outcome.rewards, 0.0)
        ends = outcome.terminated & moving, truncated & moving
        return self._finish(rewards, *ends, outcome.success & moving)

    def beliefs(self) -> BeliefArrays:
        """Return the present beliefs of all filters."""
        return self._reached().beliefs

    def _finish(
        self,
        rewards: Array,
        terminated: BoolArray,
        truncated: BoolArray,
        won: BoolArray,
    ) -> tuple[Observation, Array, BoolArray, BoolArray, dict[str, Any]]:
        observations, infos = self._output(won)
        ended, final = self._ended, {}
        if self.autoreset_mode is AutoresetMode.SAME_STEP and ended.any():
            last, last_infos = observations, infos
            self._begin(ended)
            self._ended = np.zeros_like(ended)
            observations, infos = self._output(np.zeros_like(won))
            final = final_infos(last, last_infos, ended)
        infos = {**with_masks(infos, None, self.num_envs), **final}
        return observations, rewards, terminated, truncated, infos

    def _reached(self) -> Progress:
        if self._progress is None:
            raise ResetNeeded("call reset first: there are no episodes yet")
        return self._progress

    def _begin(self, chosen: BoolArray) -> None:
        """Start episodes in the chosen worlds, each with its first scan."""
        self._worlds.reset(self._generators, chosen)
        self._filters.reset(
            self._worlds.start_estimates, self.scenario.start.std, runs=chosen
        )
        self._filter(chosen, moved=False)
        begun = self.task.begin(self._beliefs())
        if self._progress is None:
            self._progress = begun
            return
        old = self._progress
        self._progress = Progress(
            begun.beliefs,
            np.where(chosen[:, None], begun.explored, old.explored),
            np.where(chosen, 0, old.steps),
            begun.uncertainty,
            begun.variances,
            begun.known,
        )

    def _filter(self, worlds: BoolArray, *, moved: bool) -> None:
        observations = {
            "landmarks": self._worlds.measurements,
            "mask": self._worlds.mask,
            "odometry": self._worlds.odometry,
        }
        update_filters(self._filters, observations, worlds, moved=moved)

    def _beliefs(self) -> BeliefArrays:
        return beliefs_of_batch(self._filters)

    def _output(self, success: BoolArray) -> tuple[Observation, dict[str, Any]]:
        progress = self._reached()
        infos: dict[str, Any] = {
            "pose": self._worlds.poses.copy(),
            "collision": self._worlds.collisions.copy(),
            "mapped": progress.beliefs.mapped.sum(axis=1),
            "known": progress.known.sum(axis=1),
            "success": success.copy(),
        }
        return self.task.observe(progress), infos
