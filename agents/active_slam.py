"""Active SLAM: explore an unknown map until every landmark is known accurately.

`ActiveSlamEnv` is the task in one world, and `ActiveSlamVectorEnv` in many, simulated
together and with batched filters.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from numpy.typing import ArrayLike
from scipy.optimize import linear_sum_assignment

from ..arrays import AnyArray, Array, BoolArray, ComplexArray, IntArray
from ..envs import LandmarkWorldEnv
from ..envs.rendering import RENDER_MODES
from ..envs.vector import LandmarkWorldVectorEnv
from ..estimator.filters.batch import BatchBeliefs, BatchStorage
from ..restorable import Restorable
from ..sim_configs import Scenario
from .active_slam_kernels import ERROR, REWARD, SUCCESS, TERMINATED
from .active_slam_task import ActiveSlamTask, AssociationRecord, split_settings
from .belief_observation import (
    ONE_WORLD,
    Filters,
    SeparateFilters,
    choose_filters,
    update_filters,
)
from .estimator_choice import EstimatorChoice, choose_estimator
from .wall_routes import AgentKnowledge

Observation = dict[str, Any]


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
    ``Dict`` of float64 arrays within [-1, 1] and a bool mask. All values derive from
    the belief and the walls. A value v of a standard deviation on the log scale means
    10^(4v - 3) m or rad. N is the number of landmarks, row i is landmark i. Positions
    of landmarks are in the robot's frame, ahead along the heading and aside to the
    left, in diagonals of the floor; zeros where not mapped.

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
        A registered name or "module:Class", a factory with the keywords of
        `make_estimator`, or an estimator with settings of its own. The reward depends
        on its covariance, so an overconfident filter collects reward for information
        that it does not have.
    estimator_options : mapping, optional
        Further options of the filter.
    criterion : {"D", "A", "E"}, default "D"
        Measure of the uncertainty U.
    accuracy : float, default 0.25
        Largest worst standard deviation of a known landmark [m].
    success_reward, crash_cost : float, default 5.0
    effort_cost, step_cost : float, defaults 0.0 and 0.02
    observation : {"flat", "set"}, default "flat"
        With "set", the rows per landmark are replaced by ``landmarks`` (R, 15), one row
        of `landmark_set.FEATURES` per mapped landmark, and ``mask`` (R,).
    max_landmarks : int, default 32
        R of a set; the nearest landmarks have a row.
    dtype : {"float64", "float32"}, default "float64"
        Type of the numbers.
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
    changing = (*LandmarkWorldEnv.changing, "task", "_explorers")
    fixed = (*LandmarkWorldEnv.fixed, "walls")

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
        rows, by_id = self.scenario.landmarks.count, self.scenario.sensor.identities
        self._estimator = choose_estimator(
            estimator, self.scenario, estimator_options, rows=rows
        )
        self._filters = SeparateFilters(
            [self._estimator], rows, by_id=by_id, live=render_mode is None
        )
        self._explorers = Explorers(self._filters, self.task)
        self._driven = np.empty((1, 2)), np.empty(1, np.bool_)  # action and collision

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start an episode with a new map, and take the first scan."""
        observation, info = super().reset(seed=seed, options=options)
        self._explorers.begin(self.start_estimate[None], ONE_WORLD)
        self._scan(observation, info, moved=False)
        self.task.begin(self._filters.storage(), ONE_WORLD, self._landmarks)
        return self._output(info, ended=False)

    def step(
        self, action: ArrayLike
    ) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Drive one step, take a scan, and compute the reward.

        Raises
        ------
        ValueError
            If the action is not two finite numbers. The world does not change.
        """
        self._refuse_before_episode()
        observation, _, _, _, info = super().step(action)
        self._scan(observation, info, moved=True)
        beliefs, (actions, collisions) = self._filters.storage(), self._driven
        actions[0], collisions[0] = action, info["collision"]
        events = actions, collisions, self._landmarks
        results = self.task.proceed(beliefs, ONE_WORLD, *events)
        (terminated,), (truncated,), _ = results.ends.tolist()
        seen, info = self._output(info, ended=terminated or truncated)
        return seen, results.scores.item(REWARD), terminated, truncated, info

    @property
    def knowledge(self) -> AgentKnowledge:
        """The knowledge of an agent at this step, for policies that plan."""
        self._refuse_before_episode()
        episodes = self.task.episodes
        return AgentKnowledge(
            self.scenario,
            self.task.grid,
            getattr(self._estimator, "filter", self._estimator),  # of managed ones
            self._estimator.belief(),
            episodes.explored[0].copy(),
            episodes.known[0].copy(),
            self.task.weights.accuracy,
            self.task.prior_std,
            int(episodes.steps[0]),
        )

    def _refuse_before_episode(self) -> None:
        if not self.task.begun:
            raise ResetNeeded("call reset first: there is no episode yet")

    def _scan(
        self, observation: Observation, info: Mapping[str, Any], *, moved: bool
    ) -> None:
        """Update the filter with one scan."""
        if "landmark_ids" in info:
            ids, mask = info["landmark_ids"][None], observation["mask"][None]
            self._explorers.note(ONE_WORLD, ids, mask)
        self._filters.update_one(observation, moved=moved)
        if self.render_mode is not None:
            self.show_belief(self._filters.belief(0))

    def _output(
        self, info: dict[str, Any], *, ended: bool
    ) -> tuple[Observation, dict[str, Any]]:
        more = self._explorers.info(self._landmarks, ended=ended)
        return self.task.observation(), info | more


Observations = dict[str, AnyArray]


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

    changing = (*LandmarkWorldVectorEnv.changing, "task", "_explorers")

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
        rows = self.scenario.landmarks.count
        self._filters = choose_filters(
            estimator, self.scenario, num_envs, rows, estimator_options
        )
        self._explorers = Explorers(self._filters, self.task)

    def beliefs(self) -> BatchBeliefs:
        """Return the present beliefs of all filters."""
        if not self.task.begun:
            raise ResetNeeded("call reset first: there are no episodes yet")
        return self._filters.beliefs()

    def _reward(self, actions: ArrayLike, moving: BoolArray) -> tuple[Array, BoolArray]:
        if np.count_nonzero(moving) < self.num_envs:
            self._explorers.begin(self._worlds.start_estimates, ~moving)
        self._scan(self._all, moving)
        collisions, landmarks = self._worlds.collisions, self._worlds.complex_landmarks
        beliefs, events = self._filters.storage(), (actions, collisions, landmarks)
        results = self.task.proceed(beliefs, moving, *events)
        return results.scores[REWARD], results.ends[TERMINATED]

    def _follow(self, worlds: BoolArray) -> None:
        """Start the filters of some worlds, each with its first scan."""
        self._explorers.begin(self._worlds.start_estimates, worlds)
        self._scan(worlds, ~worlds)
        landmarks = self._worlds.complex_landmarks
        self.task.begin(self._filters.storage(), worlds, landmarks)

    def _scan(self, worlds: BoolArray, moved: BoolArray) -> None:
        """Update the filters of some worlds with one scan each."""
        true_ids = self._worlds.landmark_ids
        self._explorers.scan(self._worlds.observations, worlds, moved, true_ids)
        if self.render_mode is not None:
            self.show_beliefs(list(map(self._filters.belief, range(self.num_envs))))

    def _seen(self) -> Observations:
        return self.task.observations()

    def _more_infos(self) -> dict[str, Any]:
        return self._explorers.infos(self._worlds.complex_landmarks, self._ended)


# --------------------------------------------------------------------------------------
# What the single and the vector environment share.


class Explorers(Restorable):
    """The filters of B worlds, and what `info` reveals about them.

    Parameters
    ----------
    filters : Filters
        Filter i is that of world i.
    task : ActiveSlamTask
        The task of these worlds.
    """

    changing = ("_filters", "_record")

    def __init__(self, filters: Filters, task: ActiveSlamTask) -> None:
        self._filters, self._task = filters, task
        by_id, worlds = task.scenario.sensor.identities, task.results.scores.shape[1]
        self._record = None if by_id else AssociationRecord(worlds)

    def begin(self, estimates: Array, worlds: BoolArray) -> None:
        """Start the filters of some worlds, (B,), at estimates (B, 3)."""
        if self._record is not None:
            self._record.begin(worlds)
        self._filters.reset(estimates, self._task.scenario.start.std, runs=worlds)

    def scan(
        self,
        observations: Mapping[str, AnyArray],
        worlds: BoolArray,
        moved: BoolArray,
        true_ids: IntArray | None,
    ) -> None:
        """Update the filters of some worlds; see `SeparateFilters.update`."""
        if true_ids is not None:
            self.note(worlds, true_ids, observations["mask"])
        update_filters(self._filters, observations, worlds, moved=moved)

    def note(self, worlds: BoolArray, true_ids: IntArray, mask: BoolArray) -> None:
        """Record the true landmarks of a scan of some worlds, if scores need them."""
        if self._record is not None:
            self._record.add(worlds, true_ids, mask)

    def infos(self, landmarks: ComplexArray, ended: BoolArray) -> dict[str, AnyArray]:
        """Return the entries of `info` besides those of the world, each (B,).

        Parameters
        ----------
        landmarks : complex ndarray, shape (B, N)
            True positions x + iy [m].
        ended : bool ndarray, shape (B,)
            Worlds whose episode is over.
        """
        results, rmse = self._task.results, self._task.results.scores[ERROR]
        if self._record is not None:
            rmse = matched_rmse(self._filters.storage(), landmarks)
        infos = self._named(results.counts, results.ends[SUCCESS], rmse)
        if self._record is not None and isinstance(self._filters, SeparateFilters):
            infos |= self._record.scores(self._filters.filters, ended)
        return infos

    def info(self, landmarks: ComplexArray, *, ended: bool) -> dict[str, Any]:
        """Return the same entries of a single world, as plain numbers."""
        if self._record is not None:
            infos = self.infos(landmarks, np.array([ended]))
            return {key: values.item() for key, values in infos.items()}
        counts, ends = self._task.results.counts, self._task.results.ends
        success, rmse = ends.item(SUCCESS), self._task.results.scores.item(ERROR)
        return self._named(counts.ravel().tolist(), success, rmse)

    def _named(self, counts: Any, success: Any, rmse: Any) -> dict[str, Any]:
        mapped, known = counts
        return {
            "mapped": mapped,
            "known": known,
            "success": success,
            "true_rmse": rmse,
            "honest_success": success & (rmse <= self._task.weights.accuracy),
        }


# --------------------------------------------------------------------------------------
# How far maps are from the truth: for `info`, never for an observation or a reward.


def matched_rmse(beliefs: BatchStorage, landmarks: ComplexArray) -> Array:
    """Compute the `map_error` of maps that assign their own identities, (B,) [m].

    Landmarks of map and truth are matched one to one, so that the sum of the squared
    distances is smallest. A duplicate is therefore compared with another landmark.

    Parameters
    ----------
    beliefs : BatchStorage
        Of B worlds.
    landmarks : complex ndarray, shape (B, N)
        True positions x + iy [m].

    Examples
    --------
    >>> beliefs = BatchStorage(
    ...     np.array([[0.0, 0.0, 0.0, 3.0, 4.0, 3.0, 4.1]]),
    ...     np.zeros((1, 7, 7)),
    ...     np.array([[0, 1]]),
    ... )
    >>> matched_rmse(beliefs, np.array([[3.0 + 4.0j, 3.0 + 0.1j]])).round(3)
    array([2.759])
    """
    errors = np.zeros(len(landmarks))
    for b, slots in enumerate(beliefs.slots):
        places = beliefs.means[b, 3 : 3 + 2 * np.count_nonzero(slots >= 0)]
        if len(places):
            mapped = places[::2] + 1j * places[1::2]
            squares = np.abs(mapped[:, None] - landmarks[b]) ** 2
            errors[b] = math.sqrt(squares[linear_sum_assignment(squares)].mean())
    return errors
