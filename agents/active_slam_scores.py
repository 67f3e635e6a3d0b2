"""Scores of policies in active SLAM: episodes on maps of given seeds, and means."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from ..arrays import Array
from .active_slam import ActiveSlamEnv, Observation
from .active_slam_baselines import Baseline

#: Chooses an action from an observation; baselines read ``env.knowledge``.
Policy = Callable[[Observation, ActiveSlamEnv], Array]

#: First seed of the validation maps, up to `HELD_OUT`. Training uses smaller seeds.
VALIDATION = 1_000_000

#: First seed of the maps for the final evaluation. No choice may depend on them.
HELD_OUT = 2_000_000

# Columns of a table of scores, and the entries of `Episode` that they average.
COLUMNS = {
    "return": "total",
    "success": "success",
    "honest success": "honest",
    "landmarks known": "known",
    "steps": "steps",
    "true RMSE [m]": "true_rmse",
    "crashed": "crashed",
}


class Episode(NamedTuple):
    """The result of one episode."""

    #: Sum of the rewards.
    total: float
    #: Whether every landmark became known.
    success: bool
    #: Share of the landmarks known at the end.
    known: float
    #: Length of the episode.
    steps: int
    #: Whether the robot touched a wall.
    crashed: bool
    #: Root mean square error of the map at the end [m]; nan of an empty one.
    true_rmse: float
    #: Whether it was a success, and the truth agrees.
    honest: bool
    #: True positions, shape (steps + 1, 2) [m].
    path: Array


class Mean(NamedTuple):
    """A mean with the half width of its 95 % interval."""

    value: float
    half_width: float

    def __str__(self) -> str:
        return f"{self.value:.2f} ± {self.half_width:.2f}"


def run_episode(env: ActiveSlamEnv, policy: Policy, seed: int) -> Episode:
    """Run a policy for the episode of a seed."""
    observation, info = env.reset(seed=seed)
    path, total, ended = [info["pose"][:2]], 0.0, False
    while not ended:
        action = policy(observation, env)
        observation, reward, terminated, truncated, info = env.step(action)
        path.append(info["pose"][:2])
        total += reward
        ended = terminated or truncated
    share = info["known"] / env.scenario.landmarks.count
    return Episode(
        total,
        info["success"],
        share,
        len(path) - 1,
        info["collision"],
        info["true_rmse"] if info["mapped"] else np.nan,
        info["honest_success"],
        np.array(path),
    )


def run_episodes(
    env: ActiveSlamEnv, policy: Policy, seeds: Iterable[int]
) -> list[Episode]:
    """Run a policy for the episodes of several seeds."""
    return [run_episode(env, policy, seed) for seed in seeds]


def baseline_policy(baseline: Baseline) -> Policy:
    """Return the policy of a baseline."""
    return lambda _, env: baseline.act(env.knowledge)


def score_table(played: Mapping[str, Sequence[Episode]]) -> str:
    """Format a table of means with 95 % intervals, one line per policy."""
    lines = [f"{'':10}" + "".join(f"{title:>18}" for title in COLUMNS)]
    for name, episodes in played.items():
        cells = [f"{mean_of(episodes, measure)!s:>18}" for measure in COLUMNS.values()]
        lines.append(f"{name:10}" + "".join(cells))
    return "\n".join(lines)


def difference_lines(played: Mapping[str, Sequence[Episode]], name: str) -> str:
    """Format the differences of one policy from all others on the same maps.

    Examples
    --------
    >>> low, high = (
    ...     [Episode(x + y, *[True] * 6, np.empty((0, 2))) for x in (1.0, 7.0)]
    ...     for y in (0.0, 2.0)
    ... )
    >>> print(difference_lines({"a": high, "b": low}, "a"))
    a - b: return 2.00 ± 0.00, success 0.00 ± 0.00, steps 0.00 ± 0.00
    """
    measures = {"return": "total", "success": "success", "steps": "steps"}
    lines = []
    for other in played:
        if other != name:
            parts = (
                f"{title} {mean_difference(played[name], played[other], measure)}"
                for title, measure in measures.items()
            )
            lines.append(f"{name} - {other}: {', '.join(parts)}")
    return "\n".join(lines)


def mean_of(episodes: Sequence[Episode], measure: str) -> Mean:
    """Return the mean of an entry of `Episode` over episodes, with its 95 % interval.

    The interval is the normal one, 1.96 s / √n.

    Examples
    --------
    >>> ends = [Episode(x, *[True] * 6, np.empty((0, 2))) for x in (1.0, 3.0)]
    >>> print(mean_of(ends, "total"))
    2.00 ± 1.96
    """
    return _mean(_values(episodes, measure))


def mean_difference(
    episodes: Sequence[Episode], others: Sequence[Episode], measure: str
) -> Mean:
    """Return the mean difference of a measure between episodes on the same maps.

    Examples
    --------
    >>> low, high = (
    ...     [Episode(x + y, *[True] * 6, np.empty((0, 2))) for x in (1.0, 7.0)]
    ...     for y in (0.0, 2.0)
    ... )
    >>> print(mean_difference(high, low, "total"))
    2.00 ± 0.00
    """
    return _mean(_values(episodes, measure) - _values(others, measure))


def _values(episodes: Sequence[Episode], measure: str) -> Array:
    return np.array([getattr(each, measure) for each in episodes], dtype=np.float64)


def _mean(values: Array) -> Mean:
    values = values[~np.isnan(values)]  # an empty map has no error
    spread = values.std(ddof=1) if len(values) > 1 else np.nan
    return Mean(float(values.mean()), float(1.96 * spread / np.sqrt(len(values))))
