"""The rules of active SLAM, for one world or for many: weights, end and scores.

`ActiveSlamTask` advances the episodes, with the reward that `active_slam_kernels`
computes; `AssociationRecord` scores the association of filters without identities.
"""

from collections.abc import Mapping, Sequence
from dataclasses import astuple, dataclass, fields
from itertools import pairwise, starmap
from numbers import Real
from operator import itemgetter
from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.spaces.utils import flatdim, flatten_space
from numpy.typing import ArrayLike

from ..arrays import AnyArray, Array, BoolArray, ComplexArray, IntArray
from ..envs.vector.landmark_world_vector import KEYWORDS
from ..estimator.filters.batch import BatchStorage
from ..estimator.map_management.policy import policy_of
from ..evaluation.association_scores import score_association
from ..restorable import Restorable
from ..sim_configs import Scenario
from ..sim_configs.scenario import refuse_unknown_keywords
from .active_slam_kernels import Episodes, StepResults, advance
from .belief_features import belief_space
from .information_reward import CRITERIA, check_criterion, landmark_prior_std
from .landmark_set import FEATURES, ObservationForm, write_landmark_sets
from .wall_routes import SECTORS, CoverageGrid

_SIZES = {  # of the entries besides the belief
    "goals": 9,
    "progress": 4,
    "uncertain": 2 * SECTORS,
    "unexplored": 2 * SECTORS,
    "walls": SECTORS,
}
_OF_SETS = "landmarks", "mask"  # entries that only observations as sets have


@dataclass(frozen=True)
class RewardWeights:
    """Rewards, costs and accuracy of the task: keywords of the environments."""

    criterion: str = "D"  # criterion of the map's covariance, see `information_reward`
    # A landmark is known when its worst standard deviation is at most this [m].
    accuracy: float = 0.25
    # For knowing every landmark, multiplied by 1 + the share of steps left.
    success_reward: float = 5.0
    crash_cost: float = 5.0  # for touching a wall, which ends the episode
    effort_cost: float = 0.0  # for an `effort` of 1, per step
    step_cost: float = 0.02  # per step

    def __post_init__(self) -> None:
        check_criterion(self.criterion)
        if not (np.isfinite(self.accuracy) and self.accuracy > 0):
            raise ValueError(
                f"accuracy must be a finite number > 0 [m], got {self.accuracy!r}"
            )
        for name in ("success_reward", "crash_cost", "effort_cost", "step_cost"):
            weight = getattr(self, name)
            if not (isinstance(weight, Real) and 0 <= float(weight) < np.inf):
                raise ValueError(f"{name} must be a finite number >= 0, got {weight!r}")


class ActiveSlamTask(Restorable):
    """Computes observations, rewards and ends of the episodes of B worlds.

    Parameters
    ----------
    scenario : Scenario
        With walls. Where it hides identities, row i is landmark i of the map.
    weights : RewardWeights
        Rewards and costs.
    count : int
        B, the number of worlds.
    form : ObservationForm
        Of the observations.

    Attributes
    ----------
    observation_space : gymnasium.spaces.Dict
        Of one world. All arrays are flat, because Stable-Baselines3 treats two axes as
        an image:

        =============== ====== ====================================================
        ``belief_…``           see `belief_features`; rows flattened
        ``goals``       (9,)   bearing (cos, sin) and distance of three: the nearest
                               cell not yet seen, the nearest mapped landmark not yet
                               known, and the landmark known best; zeros where there is
                               none, the first of those that are within 1e-9
        ``progress``    (4,)   shares: of the floor explored, of landmarks mapped, of
                               landmarks known, of time left
        ``uncertain``   (16,)  density of mapped, not yet known landmarks, near and far,
                               in 8 directions from straight ahead counter-clockwise
        ``unexplored``  (16,)  the same of cells not yet seen
        ``walls``       (8,)   distance d to the wall, as d / (d + longest step)
        =============== ====== ====================================================
    episodes : Episodes
        Their progress.
    results : StepResults
        Of the last step.
    begun : bool
        Whether there are episodes.
    """

    changing = ("episodes",)
    replaced = ("results", "_sets", "begun")

    def __init__(
        self,
        scenario: Scenario,
        weights: RewardWeights,
        count: int = 1,
        form: ObservationForm | None = None,
    ) -> None:
        scenario.refuse_models("active SLAM")
        self.scenario, self.weights = scenario, weights
        self._form = form or ObservationForm()
        self.grid = CoverageGrid(scenario)
        self.prior_std = landmark_prior_std(scenario)
        landmarks, cells = scenario.landmarks.count, len(self.grid.cells)
        flat: dict[str, spaces.Space[Any]] = {
            **{key: flatten_space(box) for key, box in belief_space(landmarks).items()},
            **{
                key: spaces.Box(0.0 - (key == "goals"), 1.0, (size,), np.float64)
                for key, size in _SIZES.items()
            },
        }
        self.observation_space = self._form.space(spaces.Dict(flat))
        self._shape = count, landmarks
        scratch = (
            np.zeros((3, max(cells, landmarks))),
            np.zeros(landmarks),
            np.zeros((2 * landmarks, 2 * landmarks)),
        )
        sizes = [
            0 if key == "belief_mask" else flatdim(box) for key, box in flat.items()
        ]
        # Where each entry of one world begins in the array of all numbers.
        starts = np.append(0, np.cumsum(sizes))
        ends = pairwise((count * starts).tolist())
        self._keys, self._split = tuple(flat), itemgetter(*starmap(slice, ends))
        rules = _rules(scenario, weights, self.prior_std)
        self._fixed = starts, self.grid.plan, rules, scratch
        self._size = count * starts[-1]
        self._all, self._at_rest = np.ones(count, dtype=np.bool_), np.zeros((count, 2))
        self.begun = False
        self.episodes = Episodes(
            np.zeros((count, cells), dtype=np.bool_),
            np.zeros(count, dtype=np.int64),
            np.zeros(count),
            np.zeros(self._shape, dtype=np.bool_),
        )
        self.results, self._sets = self._empty_results(), self._empty_sets()

    def begin(
        self, beliefs: BatchStorage, worlds: BoolArray, landmarks: ComplexArray
    ) -> None:
        """Begin episodes in some worlds, (B,), after their first scan.

        The true landmarks x + iy, (B, N), only serve to compute the error of the map.
        """
        last: Any = map(np.copy, self.results)
        self.results = StepResults(*last)
        self._sets = tuple(map(np.copy, self._sets))
        self._advance(beliefs, worlds, ~worlds, (self._at_rest, worlds, landmarks))
        self.begun = True

    def proceed(
        self,
        beliefs: BatchStorage,
        moving: BoolArray,
        actions: ArrayLike,
        collisions: BoolArray,
        landmarks: ComplexArray,
    ) -> StepResults:
        """Take moving worlds, (B,), through a step and its scan.

        The others begin episodes, after their first scan; see `begin`.
        """
        given = np.asarray(actions, dtype=np.float64, order="C")
        self.results, self._sets = self._empty_results(), self._empty_sets()
        self._advance(beliefs, self._all, moving, (given, collisions, landmarks))
        return self.results

    def observations(self) -> dict[str, AnyArray]:
        """Return the observations of all worlds: arrays that no later step changes."""
        mapped, parts = self.results.mapped, self._split(self.results.numbers)
        rows = (part.reshape(len(mapped), -1) for part in parts)
        flat: dict[str, AnyArray] = dict(zip(self._keys, rows, strict=True))
        flat["belief_mask"] = mapped
        return self._form.cast(flat | dict(zip(_OF_SETS, self._sets, strict=False)))

    def observation(self) -> dict[str, AnyArray]:
        """Return the observation of a single world, which no later step changes."""
        parts = self._split(self.results.numbers)
        first: dict[str, AnyArray] = dict(zip(self._keys, parts, strict=True))
        first["belief_mask"] = self.results.mapped[0]
        for key, rows in zip(_OF_SETS, self._sets, strict=False):
            first[key] = rows[0]
        return self._form.cast(first)

    def _advance(
        self,
        beliefs: BatchStorage,
        worlds: BoolArray,
        moving: BoolArray,
        events: tuple[Array, BoolArray, ComplexArray],
    ) -> None:
        held: Any = tuple(beliefs)
        groups = tuple(self.episodes), tuple(self.results), self._fixed
        advance(worlds, moving, *events, held, *groups)
        if self._sets:
            write_landmark_sets(worlds, held, self.episodes.known, *self._sets)

    def _empty_results(self) -> StepResults:
        count = self._shape[0]
        return StepResults(
            np.empty(self._size),
            np.empty(self._shape, np.bool_),
            np.empty((2, count)),
            np.empty((3, count), np.bool_),
            np.empty((2, count), np.int64),
        )

    def _empty_sets(self) -> tuple[AnyArray, ...]:
        """Return arrays for the entries that only observations as sets have."""
        if not self._form.rows:
            return ()
        shape = self._shape[0], self._form.rows
        return np.empty((*shape, len(FEATURES))), np.empty(shape, dtype=np.bool_)


def split_settings(
    settings: Mapping[str, Any],
) -> tuple[RewardWeights, ObservationForm, dict[str, Any]]:
    """Split settings into weights, form of observation and changes of the scenario."""
    rest = dict(settings)
    weights = RewardWeights(**_taken(RewardWeights, rest))
    form = ObservationForm(**_taken(ObservationForm, rest))
    own = [field.name for field in (*fields(weights), *fields(form))]
    others = [*own, *KEYWORDS, "estimator", "estimator_options"]
    refuse_unknown_keywords(rest, others, where="of the task")
    return weights, form, rest


def _taken(
    kind: type[RewardWeights | ObservationForm], rest: dict[str, Any]
) -> dict[str, Any]:
    """Take the settings of a kind out of the rest."""
    names = [field.name for field in fields(kind) if field.name in rest]
    return {name: rest.pop(name) for name in names}


def _rules(
    scenario: Scenario, weights: RewardWeights, prior_std: tuple[float, float]
) -> tuple[Any, ...]:
    robot = scenario.robot
    return (  # a `TaskRules`
        list(CRITERIA).index(weights.criterion),
        *map(float, astuple(weights)[1:]),
        (robot.max_speed, robot.max_turn_rate),
        robot.max_speed * scenario.dt,
        scenario.steps,
        prior_std,
    )


# Entries of `AssociationScores` that `info` reveals.
SCORES = ("precision", "recall", "duplicate", "ghost")


class AssociationRecord(Restorable):
    """Collects the true landmarks of the readings of B worlds, and scores the filters.

    Parameters
    ----------
    worlds : int
        B, the number of worlds.
    """

    changing = ("_true_ids",)

    def __init__(self, worlds: int) -> None:
        self._true_ids: tuple[list[IntArray], ...] = tuple([] for _ in range(worlds))

    def begin(self, worlds: BoolArray) -> None:
        """Forget the readings of some worlds, (B,)."""
        for b in np.flatnonzero(worlds).tolist():
            self._true_ids[b].clear()

    def add(self, worlds: BoolArray, true_ids: IntArray, mask: BoolArray) -> None:
        """Note one scan of some worlds, (B,): rows (B, M), and which are readings."""
        for b in np.flatnonzero(worlds).tolist():
            self._true_ids[b].append(true_ids[b][mask[b]])

    def scores(self, filters: Sequence[Any], ended: BoolArray) -> dict[str, Array]:
        """Return the scores of the episodes that have ended, each (B,); -1 elsewhere.

        Not nan, which would make equal infos differ. -1 also where no reading counts.

        Parameters
        ----------
        filters : sequence, length B
            Those without `decisions` have no scores.
        ended : bool ndarray, shape (B,)
            Worlds whose episode is over.
        """
        table = np.full((len(SCORES), len(filters)), -1.0)
        for b in np.flatnonzero(ended).tolist():
            slam = filters[b]
            if hasattr(type(slam), "decisions"):
                scores = score_association(
                    slam.decisions, self._true_ids[b], confirm=policy_of(slam).confirm
                ).as_dict()
                table[:, b] = [scores[name] for name in SCORES]
        table = np.nan_to_num(table, nan=-1.0)
        return {
            f"association_{name}": row for name, row in zip(SCORES, table, strict=True)
        }
