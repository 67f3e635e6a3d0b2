"""An estimator in the loop: its belief becomes part of the observation.

`BeliefObservation` wraps one world, and `BeliefObservationVector` many.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, SupportsFloat, cast

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.error import ResetNeeded
from gymnasium.utils import RecordConstructorArgs
from gymnasium.vector import AutoresetMode, VectorEnv, VectorWrapper
from gymnasium.vector.utils import batch_space

from .. import argument_checks
from ..arrays import AnyArray, Array, BoolArray
from ..envs import LandmarkWorldEnv
from ..envs.vector.landmark_world_vector import final_infos
from ..estimator.filters.batch import BatchBeliefs, BatchSlam, BatchStorage, can_batch
from ..estimator.filters.ekf import EkfSlam
from ..estimator.interface import resume, snapshot
from ..estimator.registry import accepted_models, find_estimator, make_batch, read_label
from ..restorable import Restorable, State
from ..sim_configs import Scenario
from .belief_features import (
    belief_features,
    belief_space,
    belief_storage,
    live_storage,
    world_bounds,
)
from .estimator_choice import (
    BeliefOfMap,
    EstimatorChoice,
    FollowingEstimator,
    checked_belief,
    checked_estimator,
    choose_estimator,
)

Observation = dict[str, Any]

ONE_WORLD = np.ones(1, dtype=np.bool_)


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
        The filter: a registered name or "module:Class", a factory with the keywords of
        `make_estimator`, or an estimator with settings of its own. An ``EnvSpec``
        written as JSON keeps only a name.
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
        rows = count_landmark_rows(self.scenario, max_landmarks)
        self._bounds = world_bounds(self.scenario)
        slam = choose_estimator(estimator, self.scenario, estimator_options, rows=rows)
        self._filters = SeparateFilters(
            [slam], rows, by_id=self.scenario.sensor.identities
        )
        self.observation_space = with_belief(env.observation_space, rows)

    @property
    def belief(self) -> BeliefOfMap:
        """The present belief of the estimator."""
        belief = self._filters.belief(0)
        if belief is None:
            raise ResetNeeded("call reset first: there is no belief")
        return belief

    @property
    def beliefs(self) -> BatchBeliefs:
        """The present belief as arrays of a fixed size, with B = 1."""
        _ = self.belief  # refuses before `reset`
        return self._filters.beliefs()

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start an episode; the estimator starts from the start estimate."""
        observation, info = self.env.reset(seed=seed, options=options)
        estimate = self.env.get_wrapper_attr("start_estimate")
        self._filters.reset(estimate[None], self.scenario.start.std, runs=ONE_WORLD)
        return self._update(observation, moved=False), info

    def step(
        self, action: Any
    ) -> tuple[Observation, SupportsFloat, bool, bool, dict[str, Any]]:
        """Step the world, then predict and update."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        seen = self._update(observation, moved=True)
        return seen, reward, terminated, truncated, info

    def _update(self, observation: Observation, *, moved: bool) -> Observation:
        self._filters.update_one(observation, moved=moved)
        if self.env.render_mode is not None:
            self.env.get_wrapper_attr("show_belief")(self.belief)
        features = belief_features(self._filters.storage(), self._bounds)
        return with_features(observation, {k: row[0] for k, row in features.items()})


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


Observations = dict[str, AnyArray]
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
        env: VectorEnv[Observations, AnyArray, AnyArray],
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
    ) -> tuple[Observations, Infos]:
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
    ) -> tuple[Observations, AnyArray, AnyArray, AnyArray, Infos]:
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

    def _finish(self, observed: Observations, ended: BoolArray, infos: Infos) -> None:
        """Update with the last scan of ended episodes, then with the first new one."""
        last = {key: rows.copy() for key, rows in observed.items()}
        for world in np.flatnonzero(ended).tolist():
            for key, rows in last.items():
                rows[world] = infos["final_obs"][world][key]
        self._update(last, self._all, moved=self._all)
        if not ended.any():
            return
        shown = self._with_beliefs(last)
        infos["final_obs"] = final_infos(shown, {}, ended)["final_obs"]
        self._begin(observed, ended)

    def _begin(self, observations: Observations, worlds: BoolArray) -> None:
        self._restart(worlds)
        self._update(observations, worlds, moved=~worlds)

    def _restart(self, worlds: BoolArray) -> None:
        worlds_of: Any = self.env.unwrapped
        estimates = worlds_of.start_estimates
        self._filters.reset(estimates, self.scenario.start.std, runs=worlds)

    def _update(
        self, observations: Observations, worlds: BoolArray, *, moved: BoolArray
    ) -> None:
        if self._missing_rows:
            longer = {
                key: _padded(observations[key], self._missing_rows)
                for key in ("landmarks", "mask")
            }
            observations = {**observations, **longer}
        update_filters(self._filters, observations, worlds, moved=moved)

    def _with_beliefs(self, observations: Observations) -> Observations:
        features = belief_features(self._filters.storage(), self._bounds)
        return with_features(observations, features)


def _padded(rows: AnyArray, more: int) -> AnyArray:
    """Append empty rows to the second axis."""
    padding = [(0, 0), (0, more), *((0, 0) for _ in rows.shape[2:])]
    return np.pad(rows, padding)


class SeparateFilters(Restorable):
    """Filters side by side: any filter of one world, and all that associate.

    Batches neither associate nor run filters of other libraries.

    Parameters
    ----------
    filters : sequence of FollowingEstimator, length B
        Filter i is that of world i.
    rows : int
        N, the most landmarks in a map.
    by_id : bool
        Whether readings carry identities; see `belief_storage`.
    live : bool
        Whether filters that could run in batches show their own arrays. Then their
        beliefs are neither copied nor checked.
    """

    def __init__(
        self,
        filters: Sequence[FollowingEstimator],
        rows: int,
        *,
        by_id: bool = False,
        live: bool = False,
    ) -> None:
        self.filters = filters
        self._rows, self._by_id = rows, by_id
        self._live = [live and can_batch(slam) for slam in filters]
        self._steps = [0] * len(filters)
        self._beliefs: list[BeliefOfMap | None] = [None] * len(filters)
        self._stored: list[Any] = [None] * len(filters)  # `BatchStorage`, B = 1
        # The slots that are shown of each live filter.
        self._slots: list[Any] = [None] * len(filters)

    def state(self) -> State:
        """Return the states of the filters, for `restore`."""
        needed = "state_dict", "load_state_dict"
        states = [snapshot(checked_estimator(slam, needed)) for slam in self.filters]
        return states, self._steps[:], self._beliefs[:], self._stored[:]

    def restore(self, state: State) -> None:
        """Return to states of these filters."""
        states, *rest = state
        self._steps, self._beliefs, self._stored = (part[:] for part in rest)
        for run, (slam, own) in enumerate(zip(self.filters, states, strict=True)):
            resume(slam, own)
            if not self._live[run]:
                continue
            live = cast("EkfSlam", slam)
            if self._stored[run].means.base is not live.map.block.base:  # it has grown
                self._stored[run] = live_storage(live, self._rows)

    def reset(self, poses: Array, pose_std: Any, *, runs: BoolArray) -> None:
        """Start new runs in some worlds, at poses (B, 3) with deviations (3,)."""
        for run in np.flatnonzero(runs).tolist():
            self.filters[run].reset(poses[run], pose_std)
            self._steps[run] = 0

    def update(
        self, observed: Mapping[str, AnyArray], worlds: BoolArray, *, moved: BoolArray
    ) -> None:
        """Update the filters of some worlds with an observation, batched along B.

        Parameters
        ----------
        observed : mapping
            Batched observations of a landmark world.
        worlds : bool ndarray, shape (B,)
            Worlds whose filters are updated.
        moved : bool ndarray, shape (B,)
            Which of them have moved; the others take the scan from their start.
        """
        for run in np.flatnonzero(worlds).tolist():
            one = {key: observed[key][run] for key in ("landmarks", "mask", "odometry")}
            self.update_one(one, run, moved=bool(moved[run]))

    def update_one(
        self, observation: Observation, run: int = 0, *, moved: bool = True
    ) -> None:
        """Update the filter of one world with the observation of that world."""
        slam = self.filters[run]
        if moved:
            slam.predict(observation["odometry"])
            self._steps[run] += 1
        (seen,) = observation["mask"].nonzero()
        readings, ids = observation["landmarks"].take(seen, axis=0), None
        if self._by_id:  # a filter of another library may need a list
            ids = seen if self._live[run] else seen.tolist()
        slam.update(readings, ids)
        if self._live[run]:
            self._show(run, cast("EkfSlam", slam))
            return
        self._beliefs[run] = belief = checked_belief(slam, self._steps[run])
        self._stored[run] = belief_storage(belief, self._rows, by_id=self._by_id)

    def _show(self, run: int, slam: EkfSlam) -> None:
        """Show the arrays of a filter; a map whose slots changed has a new dict."""
        if self._slots[run] is slam.map.slots:
            _ = slam.map.covariance  # completes it
            return
        self._slots[run] = slam.map.slots
        self._stored[run] = live_storage(slam, self._rows)

    def storage(self) -> BatchStorage:
        """Return the arrays of the beliefs; they change with the next update."""
        if len(self._stored) == 1:
            one: BatchStorage = self._stored[0]
            return one
        return BatchStorage.of(*map(np.concatenate, zip(*self._stored, strict=True)))

    def belief(self, run: int) -> BeliefOfMap | None:
        """Return the belief of one world; None before its first scan."""
        return self._beliefs[run]

    def beliefs(self) -> BatchBeliefs:
        """Return the beliefs of all worlds side by side, as a snapshot."""
        return self.storage().beliefs()


Filters = BatchSlam | SeparateFilters


def choose_filters(
    estimator: str,
    scenario: Scenario,
    runs: int,
    rows: int,
    options: Mapping[str, Any] | None = None,
) -> Filters:
    """Make a batch of filters; where the scenario hides identities, separate ones.

    A batch has one thread: a step takes less time than starting another thread.

    Parameters
    ----------
    estimator : str
        Registered name or "module:Class".
    scenario : Scenario
        Source of the noise settings.
    runs : int
        B, the number of worlds.
    rows : int
        N, the most landmarks in a map.
    options : mapping, optional
        Further options of the filters.

    Raises
    ------
    ValueError
        If the name is unknown, an option does not fit, or the filter cannot run in
        batches and must.
    """
    if not isinstance(estimator, str):
        raise ValueError(
            "estimator must be a name for vector environments, 'module:Class' or one "
            f"that register_estimator gives to a class, got {estimator!r}"
        )
    if not scenario.sensor.identities:
        filters = [
            choose_estimator(estimator, scenario, options, rows=rows)
            for _ in range(runs)
        ]
        return SeparateFilters(filters, rows)
    known = accepted_models(find_estimator(read_label(estimator).name), scenario.models)
    return make_batch(
        estimator,
        runs=runs,
        landmarks=rows,
        motion_std=scenario.motion.std,
        measurement_std=scenario.sensor.std,
        threads=1,
        **{**known, **(options or {})},
    )


def update_filters(
    filters: Filters,
    observations: Mapping[str, AnyArray],
    worlds: BoolArray,
    *,
    moved: BoolArray,
) -> None:
    """Update the filters of some worlds; see `SeparateFilters.update`.

    Raises
    ------
    numpy.linalg.LinAlgError
        If a filter of a batch fails; the message names its world.
    """
    if isinstance(filters, SeparateFilters):
        filters.update(observations, worlds, moved=moved)
        return
    filters.step(
        observations["odometry"],
        observations["landmarks"],
        observations["mask"],
        moved.astype(np.float64),
        runs=worlds,
    )
    failed = filters.failed_at >= 0
    if np.count_nonzero(failed):
        raise np.linalg.LinAlgError(
            f"the filter of world {int(np.argmax(failed))} has failed: its belief or "
            "measurement_std is degenerate, or its observation is not finite"
        )
