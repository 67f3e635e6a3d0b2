"""An estimator inside the loop: what it believes becomes part of the observation."""

from collections.abc import Mapping
from typing import Any, SupportsFloat

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.utils import RecordConstructorArgs
from numpy.typing import NDArray

from ..envs import LandmarkWorldEnv
from ..estimator.support import argument_checks
from ..sim_configs import Scenario
from .belief_arrays import BeliefArrays, belief_in_rows, stored
from .belief_features import belief_features, belief_space, world_bounds
from .estimator_choice import (
    BeliefOfMap,
    EstimatorChoice,
    checked_belief,
    choose_estimator,
)

Observation = dict[str, Any]


class BeliefObservation(
    gymnasium.Wrapper[Observation, NDArray[Any], Observation, NDArray[Any]],
    RecordConstructorArgs,
):
    """Runs an estimator on what a landmark world emits, and shows its belief.

    The belief comes from the observations, the start's estimate and the scenario's
    noise alone; the truth stays in `info`. To the keys of the observation are added
    those of `belief_features`, every value within [-1, 1]; row i is landmark i, or,
    where identities are hidden, the i-th landmark of the estimator's map.

    Parameters
    ----------
    env : Env
        A `LandmarkWorldEnv`, wrapped or not, whose observation is still its Dict.
    estimator : str, callable or object
        Which filter: see `choose_estimator`. Only a name survives in an ``EnvSpec``
        written as JSON.
    estimator_options : mapping, optional
        Further options of the filter.
    max_landmarks : int, optional
        N, the rows for landmarks; as many as the world has where not given.

    Raises
    ------
    TypeError
        If the estimator lacks a method, or its belief a part, which is named.
    ValueError
        If the world has, or the map comes to hold, more landmarks than there are rows,
        or a belief is not finite or has a negative variance; then the step is named.

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
        env: gymnasium.Env[Observation, NDArray[Any]],
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
        self._estimator = choose_estimator(estimator, self.scenario, estimator_options)
        self.observation_space = with_belief(env.observation_space, self._rows)
        self._belief: BeliefOfMap | None = None
        self._beliefs: BeliefArrays | None = None
        self._steps = 0

    @property
    def belief(self) -> BeliefOfMap:
        """What the estimator believes now."""
        if self._belief is None:
            raise gymnasium.error.ResetNeeded("call reset first: there is no belief")
        return self._belief

    @property
    def beliefs(self) -> BeliefArrays:
        """The same in rows of fixed size, with B = 1."""
        if self._beliefs is None:
            raise gymnasium.error.ResetNeeded("call reset first: there is no belief")
        return self._beliefs

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begin an episode: the estimator starts from the start's estimate."""
        observation, info = self.env.reset(seed=seed, options=options)
        world = self.env.get_wrapper_attr("start_estimate")
        self._estimator.reset(world, self.scenario.start.std)
        self._steps = 0
        return self._take_in(observation), info

    def step(
        self, action: Any
    ) -> tuple[Observation, SupportsFloat, bool, bool, dict[str, Any]]:
        """Step the world, then let the estimator predict and update."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        self._estimator.predict(observation["odometry"])
        self._steps += 1
        return self._take_in(observation), reward, terminated, truncated, info

    def _take_in(self, observation: Observation) -> Observation:
        seen = np.flatnonzero(observation["mask"])
        ids = seen.tolist() if self._by_id else None
        self._estimator.update(observation["landmarks"][seen], ids)
        belief = checked_belief(self._estimator, self._steps)
        self._belief = belief
        self._beliefs = belief_in_rows(belief, self._rows, by_id=self._by_id)
        if self.env.render_mode is not None:
            self.env.get_wrapper_attr("show_belief")(belief)
        features = belief_features(stored(self._beliefs), self._bounds)
        return joined(observation, {key: row[0] for key, row in features.items()})


def scenario_of(env: Any) -> Scenario:
    """Read the scenario of a landmark world, or refuse another environment."""
    scenario = getattr(env.unwrapped, "scenario", None)
    if not isinstance(scenario, Scenario):
        raise ValueError(
            f"env must be a landmark world, as {LandmarkWorldEnv.__name__} is, "
            f"got {env.unwrapped}"
        )
    return scenario


def count_landmark_rows(scenario: Scenario, max_landmarks: int | None) -> int:
    """Choose the fixed size: what is asked for, else what the world has."""
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
    """Add the features of a belief to the observation space of a world."""
    if not isinstance(space, spaces.Dict) or "odometry" not in space.spaces:
        raise ValueError(
            f"env must still observe landmarks, mask and odometry, got {space}"
        )
    return spaces.Dict({**space.spaces, **belief_space(rows).spaces})


def joined(observation: Observation, features: Mapping[str, Any]) -> Observation:
    """Add features to an observation; keys in alphabetical order, as in its space."""
    both = {**observation, **features}
    return {key: both[key] for key in sorted(both)}
