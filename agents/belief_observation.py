"""An estimator in the loop: its belief becomes part of the observation."""

from collections.abc import Mapping
from typing import Any, SupportsFloat

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.utils import RecordConstructorArgs

from ..arrays import AnyArray
from ..envs import LandmarkWorldEnv
from ..estimator.filters.batch import BatchBeliefs, BatchStorage
from ..estimator.support import argument_checks
from ..sim_configs import Scenario
from .belief_arrays import belief_storage
from .belief_features import belief_features, belief_space, world_bounds
from .estimator_choice import (
    BeliefOfMap,
    EstimatorChoice,
    checked_belief,
    choose_estimator,
)

Observation = dict[str, Any]


class BeliefObservation(
    gymnasium.Wrapper[Observation, AnyArray, Observation, AnyArray],
    RecordConstructorArgs,
):
    """Runs an estimator on the observations of a landmark world, and adds its belief.

    The estimator uses the observations, the start estimate and the scenario's noise
    settings; the truth stays in `info`. The observation has the additional keys of
    `belief_features`, with values within [-1, 1]. Row i is landmark i. With hidden
    identities it is landmark i of the estimator's map.

    Parameters
    ----------
    env : Env
        A `LandmarkWorldEnv`, wrapped or not, whose observation is still its Dict.
    estimator : str, callable or object
        The filter, see `choose_estimator`. An ``EnvSpec`` written as JSON keeps only a
        name.
    estimator_options : mapping, optional
        Further options of the filter.
    max_landmarks : int, optional
        N, the number of landmark rows. The default is that of the world.

    Raises
    ------
    TypeError
        If the estimator lacks a method, or its belief a part.
    ValueError
        If the world or the map has more landmarks than there are rows, or a belief is
        not finite or has a negative variance.

    Examples
    --------
    >>> import gymnasium, slamgym
    >>> env = gymnasium.make("slamgym/LandmarkWorld-v0", scenario="loop")
    >>> env = BeliefObservation(env, estimator="invariant")
    >>> observation, info = env.reset(seed=0)
    >>> bool((observation["belief_mask"] == observation["mask"]).all())
    True
    >>> float(observation["belief_pose_std"].max()) <= 1.0
    True
    """

    def __init__(
        self,
        env: gymnasium.Env[Observation, AnyArray],
        estimator: EstimatorChoice = "invariant",
        *,
        estimator_options: Mapping[str, Any] | None = None,
        max_landmarks: int | None = None,
    ) -> None:
        RecordConstructorArgs.__init__(
            self,
            estimator=estimator,
            estimator_options=estimator_options,
            max_landmarks=max_landmarks,
        )
        super().__init__(env)
        self.scenario = scenario_of(env)
        self._rows = count_landmark_rows(self.scenario, max_landmarks)
        self._by_id = self.scenario.sensor.identities
        self._bounds = world_bounds(self.scenario)
        self._estimator = choose_estimator(
            estimator, self.scenario, estimator_options, rows=self._rows
        )
        self.observation_space = with_belief(env.observation_space, self._rows)
        self._belief: BeliefOfMap | None = None
        self._storage: BatchStorage | None = None
        self._steps = 0

    @property
    def belief(self) -> BeliefOfMap:
        """The present belief of the estimator."""
        if self._belief is None:
            raise gymnasium.error.ResetNeeded("call reset first: there is no belief")
        return self._belief

    @property
    def beliefs(self) -> BatchBeliefs:
        """The present belief as arrays of a fixed size, with B = 1."""
        if self._storage is None:
            raise gymnasium.error.ResetNeeded("call reset first: there is no belief")
        return self._storage.beliefs()

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start an episode; the estimator starts from the start estimate."""
        observation, info = self.env.reset(seed=seed, options=options)
        world = self.env.get_wrapper_attr("start_estimate")
        self._estimator.reset(world, self.scenario.start.std)
        self._steps = 0
        return self._update(observation), info

    def step(
        self, action: Any
    ) -> tuple[Observation, SupportsFloat, bool, bool, dict[str, Any]]:
        """Step the world, then predict and update."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        self._estimator.predict(observation["odometry"])
        self._steps += 1
        return self._update(observation), reward, terminated, truncated, info

    def _update(self, observation: Observation) -> Observation:
        seen = np.flatnonzero(observation["mask"])
        ids = seen.tolist() if self._by_id else None
        self._estimator.update(observation["landmarks"][seen], ids)
        belief = checked_belief(self._estimator, self._steps)
        self._belief = belief
        self._storage = belief_storage(belief, self._rows, by_id=self._by_id)
        if self.env.render_mode is not None:
            self.env.get_wrapper_attr("show_belief")(belief)
        features = belief_features(self._storage, self._bounds)
        return with_features(
            observation, {key: row[0] for key, row in features.items()}
        )


def scenario_of(env: Any) -> Scenario:
    """Return the scenario of a landmark world; raise for another environment."""
    scenario = getattr(env.unwrapped, "scenario", None)
    if not isinstance(scenario, Scenario):
        raise ValueError(
            f"env must be a landmark world, as {LandmarkWorldEnv.__name__} is, "
            f"got {env.unwrapped}"
        )
    return scenario


def count_landmark_rows(scenario: Scenario, max_landmarks: int | None) -> int:
    """Return the number of landmark rows: `max_landmarks`, or that of the world."""
    count = scenario.landmarks.count
    if max_landmarks is None:
        return count
    rows = argument_checks.whole("max_landmarks", max_landmarks, 1)
    if scenario.sensor.identities and rows < count:
        raise ValueError(
            f"max_landmarks must be >= the {count} landmarks of the world, got {rows}"
        )
    return rows


def with_belief(space: spaces.Space[Any], rows: int) -> spaces.Dict:
    """Add the space of belief features to the observation space of a world."""
    if not isinstance(space, spaces.Dict) or "odometry" not in space.spaces:
        raise ValueError(
            f"env must still observe landmarks, mask and odometry, got {space}"
        )
    return spaces.Dict({**space.spaces, **belief_space(rows).spaces})


def with_features(observation: Observation, features: Mapping[str, Any]) -> Observation:
    """Add features to an observation, with the keys in alphabetical order."""
    both = {**observation, **features}
    return {key: both[key] for key in sorted(both)}
