"""The noise study over many runs, with standard errors.

Each σ of `SIGMAS` is multiplied and divided by 10, in turn: in the world and in what
the filters assume ("both", so that they stay right), in the world alone, or in the
filters alone, which then trust their odometry or their sensor too much or too little.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

import numpy as np

from ...estimator.registry import EstimatorFactory
from ...sim_configs import Scenario, load_scenario
from ...suggestions import closest
from ..monte_carlo import monte_carlo
from ..monte_carlo.report.scores import EstimatorScores, labels_of, scores_of
from ..runs.nan_statistics import mean, root_mean_square, standard_error
from .variations import CHANGES, REFERENCE, Variation, scaled_scenario

Changed = Literal["both", "world", "filter"]
CHANGED: tuple[Changed, ...] = get_args(Changed)


class NoiseEffect(NamedTuple):
    """The effect of one change on one estimator: averages over runs and steps.

    A figure is nan where too few runs succeeded.
    """

    changed: str
    """Place of the change: both, world or filter; "nothing" for the reference."""
    sigma: str
    """The noise, one of `SIGMAS`; "none" for the reference."""
    factor: float
    """Its factor; 1 for the reference."""
    estimator: str
    """Label of the estimator."""
    runs: int
    """Number of runs behind the figures."""
    failed: int
    """Runs left out: they failed, or their NEES or NIS is not finite or above 1e100."""
    nees_per_degree: float
    """NEES of the pose divided by 3, in the invariant frame; 1 is expected."""
    nees_per_degree_error: float
    """Its standard error, from the averages of the runs, which are independent."""
    nees_per_degree_median: float
    """Median of the runs' averages, which a few bad runs do not dominate."""
    nis_per_degree: float
    """NIS by its degrees of freedom; 1 is expected."""
    position_rmse: float
    """Root mean square error of the position, not aligned [m]."""
    ate_aligned: float
    """Root mean square error of the path after the best rigid motion [m]."""
    landmark_rmse_aligned: float
    """The same of the final map [m]."""
    pose_area: float
    """Mean area of the final 3σ ellipse of the position [m²]."""
    landmark_area: float
    """Mean area of the landmarks' final 3σ ellipses [m²]."""


def noise_effects(
    scenario: Scenario | Mapping[str, object] | str | Path,
    estimators: str | Iterable[str | EstimatorFactory] | Mapping[str, Any],
    runs: int,
    seed: int = 0,
    *,
    changed: Iterable[Changed] = CHANGED,
    jobs: int | None = None,
    backend: str | None = None,
    progress: Callable[[int, int], object] | None = None,
) -> list[NoiseEffect]:
    """Run a Monte Carlo for each change of each noise, all on the same random numbers.

    Parameters
    ----------
    scenario : Scenario, mapping, str or Path
        The reference.
    estimators, runs, seed, jobs, backend
        As in :func:`~slamgym.experiments.monte_carlo.monte_carlo`.
    changed : iterable of {"both", "world", "filter"}
        Where a noise changes.
    progress : callable, optional
        Called with (runs done, runs).

    Returns
    -------
    list of NoiseEffect
        The reference first, one entry for each estimator; then, for each place of
        change, two factors of each of `SIGMAS`.

    Raises
    ------
    ValueError
        As `monte_carlo` does, or if ``changed`` names another place.

    Examples
    --------
    >>> effects = noise_effects("anchored", "ekf", runs=2, changed=["filter"])
    >>> len(effects), effects[1].sigma, effects[1].factor
    (11, 'σx', 10.0)
    """
    world = load_scenario(scenario)
    jobs_to_do = [("nothing", REFERENCE, world, world), *_changes(world, changed)]
    effects: list[NoiseEffect] = []
    for done, (place, variation, changed_world, assumed) in enumerate(jobs_to_do, 1):
        results = monte_carlo(
            changed_world,
            estimators,
            runs,
            seed,
            assumed=assumed,
            jobs=jobs,
            backend=backend,
        )
        effects += [
            _effect(place, variation, scores_of(results, label, "invariant"))
            for label in labels_of(results)
        ]
        if progress is not None:
            progress(done * runs, len(jobs_to_do) * runs)
    return effects


def _changes(
    world: Scenario, places: Iterable[str]
) -> Iterator[tuple[str, Variation, Scenario, Scenario]]:
    """Yield (place of the change, variation, world, what the filters assume)."""
    for place in places:
        if place not in CHANGED:
            hint = closest(place, CHANGED)
            raise ValueError(
                f"changed must be of {', '.join(CHANGED)}, got '{place}'{hint}"
            )
        for variation in CHANGES:
            scaled = scaled_scenario(world, *variation)
            yield (
                place,
                variation,
                world if place == "filter" else scaled,
                world if place == "world" else scaled,
            )


def _effect(place: str, variation: Variation, scores: EstimatorScores) -> NoiseEffect:
    per_run = scores.ratios("invariant").mean(axis=1)
    found = {
        "nees_per_degree": mean(per_run),
        "nees_per_degree_error": standard_error(per_run),
        "nis_per_degree": scores.nis_per_degree,
        "position_rmse": root_mean_square(scores.over_time("position_error")),
        "pose_area": mean(scores.per_run("pose_area")),
        "landmark_area": mean(scores.per_run("landmark_area")),
    }
    for name in ("ate_aligned", "landmark_rmse_aligned"):
        found[name] = root_mean_square(scores.per_run(name))
    return NoiseEffect(
        place,
        variation.sigma,
        variation.factor,
        scores.label,
        runs=len(per_run),
        failed=len(scores.failures),
        nees_per_degree_median=float(np.median(per_run)) if len(per_run) else np.nan,
        **{name: np.nan if value is None else value for name, value in found.items()},
    )
