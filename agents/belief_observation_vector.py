"""Filters in the loop of many worlds: beliefs become part of the observations."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode, VectorEnv, VectorWrapper
from gymnasium.vector.utils import batch_space

from ..arrays import AnyArray, BoolArray
from ..envs.vector.landmark_world_vector import final_infos
from ..estimator.filters.batch import BatchBeliefs
from .belief_features import belief_features, world_bounds
from .belief_observation import (
    count_landmark_rows,
    scenario_of,
    with_belief,
    with_features,
)
from .separate_filters import choose_filters, update_filters

Observation = dict[str, AnyArray]
Infos = dict[str, Any]


class BeliefObservationVector(VectorWrapper):  # see FlattenBatch
    """Runs one filter per world on the observations, and adds the beliefs.

    Row i of every array equals that of `BeliefObservation` in world i, to the bit. The
    wrapper supports every autoreset mode; ``infos["final_obs"]`` has the last beliefs.

    Parameters
    ----------
    env : VectorEnv
        A `LandmarkWorldVectorEnv`, as ``gymnasium.make_vec`` makes it.
    estimator : str, default "invariant"
        The registered name of a filter that runs in batches. Where the world hides
        identities, one that landmark management takes; filters run one by one then.
    estimator_options : mapping, optional
        Further options of the filter.
    max_landmarks : int, optional
        N, the number of landmark rows. The default is that of the world.

    Raises
    ------
    ValueError
        If the filter cannot run in batches, or if the worlds have more landmarks than
        there are rows.

    Examples
    --------
    >>> import gymnasium, slamgym
    >>> worlds = gymnasium.make_vec("slamgym/LandmarkWorld-v0", 3, scenario="loop")
    >>> worlds = BeliefObservationVector(worlds, estimator="ekf")
    >>> observations, infos = worlds.reset(seed=0)
    >>> observations["belief_landmarks"].shape
    (3, 20, 2)
    """

    def __init__(
        self,
        env: VectorEnv[Observation, AnyArray, AnyArray],
        estimator: str = "invariant",
        *,
        estimator_options: Mapping[str, Any] | None = None,
        max_landmarks: int | None = None,
    ) -> None:
        super().__init__(env)
        self.scenario = scenario_of(env)
        if not hasattr(type(env.unwrapped), "start_estimates"):
            raise ValueError(
                "env must be a LandmarkWorldVectorEnv, which has start_estimates, "
                f"got {type(env.unwrapped).__name__}"
            )
        rows = count_landmark_rows(self.scenario, max_landmarks)
        is_hidden = not self.scenario.sensor.identities
        self._missing_rows = 0 if is_hidden else rows - self.scenario.landmarks.count
        self._bounds = world_bounds(self.scenario)
        self._filters = choose_filters(
            estimator, self.scenario, self.num_envs, rows, estimator_options
        )
        self._mode = env.metadata["autoreset_mode"]
        single = with_belief(env.single_observation_space, rows)
        self.single_observation_space = single
        self.observation_space = batch_space(single, self.num_envs)
        self._ended = np.zeros(self.num_envs, dtype=np.bool_)
        self._all = np.ones(self.num_envs, dtype=np.bool_)
        self._begun = False

    @property
    def beliefs(self) -> BatchBeliefs:
        """The present beliefs of the filters."""
        if not self._begun:
            raise ResetNeeded("call reset first: there are no beliefs")
        return self._filters.beliefs()

    def reset(
        self, *, seed: Any = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, Infos]:
        """Start episodes in the worlds, with a new map in each filter."""
        mask = (options or {}).get("reset_mask")
        worlds = np.ones(self.num_envs, dtype=np.bool_) if mask is None else mask.copy()
        observations, infos = self.env.reset(seed=seed, options=options)
        self._begin(observations, worlds)
        self._begun = True
        self._ended = self._ended & ~worlds
        return self._with_beliefs(observations), infos

    def step(
        self, actions: AnyArray
    ) -> tuple[Observation, AnyArray, AnyArray, AnyArray, Infos]:
        """Step the worlds, then predict and update."""
        observations, rewards, terminated, truncated, infos = self.env.step(actions)
        ended = terminated | truncated
        if self._mode == AutoresetMode.SAME_STEP:
            self._finish(observations, ended, infos)
        else:
            begun = self._ended & (self._mode == AutoresetMode.NEXT_STEP)
            if np.count_nonzero(begun):
                self._restart(begun)
            self._update(observations, self._all, moved=~begun)
            self._ended = ended
        return self._with_beliefs(observations), rewards, terminated, truncated, infos

    def _finish(
        self, observations: Observation, ended: BoolArray, infos: Infos
    ) -> None:
        """Update with the last scan of ended episodes, then with the first new one."""
        last = {key: rows.copy() for key, rows in observations.items()}
        for world in np.flatnonzero(ended).tolist():
            for key, rows in last.items():
                rows[world] = infos["final_obs"][world][key]
        self._update(last, self._all, moved=self._all)
        if not ended.any():
            return
        shown = self._with_beliefs(last)
        infos["final_obs"] = final_infos(shown, {}, ended)["final_obs"]
        self._begin(observations, ended)

    def _begin(self, observations: Observation, worlds: BoolArray) -> None:
        self._restart(worlds)
        self._update(observations, worlds, moved=~worlds)

    def _restart(self, worlds: BoolArray) -> None:
        worlds_of: Any = self.env.unwrapped
        estimates = worlds_of.start_estimates
        self._filters.reset(estimates, self.scenario.start.std, runs=worlds)

    def _update(
        self, observations: Observation, worlds: BoolArray, *, moved: BoolArray
    ) -> None:
        if self._missing_rows:
            longer = {
                key: _padded(observations[key], self._missing_rows)
                for key in ("landmarks", "mask")
            }
            observations = {**observations, **longer}
        update_filters(self._filters, observations, worlds, moved=moved)

    def _with_beliefs(self, observations: Observation) -> Observation:
        features = belief_features(self._filters.storage(), self._bounds)
        return with_features(observations, features)


def _padded(rows: AnyArray, more: int) -> AnyArray:
    """Append empty rows to the second axis."""
    padding = [(0, 0), (0, more), *((0, 0) for _ in rows.shape[2:])]
    return np.pad(rows, padding)
