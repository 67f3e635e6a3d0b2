"""What each noise does to filters, over many runs: the noise study with error bars.

Every σ of `SIGMAS` times 10 and divided by 10, one by one: in the world and in what the
filters are told of it ("both", so that they stay right), in the world alone, or in the
filters alone, which then trust their odometry or their sensor too much or too little.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

import numpy as np

from ...sim_configs import Scenario, load_scenario
from ...sim_configs.scenario_errors import closest
from ..monte_carlo import monte_carlo
from ..monte_carlo.report.nan_statistics import mean, root_mean_square, standard_error
from ..monte_carlo.report.scores import EstimatorScores, labels_of, scores_of
from ..runs.filter_settings import SIGMAS
from .one_run import FACTORS, scaled_scenario

Changed = Literal["both", "world", "filter"]
CHANGED: tuple[Changed, ...] = get_args(Changed)


class NoiseEffect(NamedTuple):
    """What an estimator made of one change; averages over runs and steps.

    nan where too few runs did not fail.
    """

    changed: str
    """Where: both, world or filter; "nothing" for the reference."""
    sigma: str
    """Which noise, one of `SIGMAS`; "none" for the reference."""
    factor: float
    """By how much; 1 for the reference."""
    estimator: str
    """Its label."""
    runs: int
    """That the figures are made of."""
    failed: int
    """That failed, or whose NEES or NIS is not finite or above 1e100: left out."""
    nees_per_degree: float
    """Of the pose, invariant frame; 1 is right."""
    nees_per_degree_error: float
    """Its standard error: of the mean of the runs' own averages, which alone are
    independent."""
    nees_per_degree_median: float
    """Of the runs' own averages, which a few bad runs do not rule."""
    nis_per_degree: float
    """1 is expected."""
    position_rmse: float
    """Not aligned [m]."""
    ate_aligned: float
    """Root mean square error of the path after the best rigid motion [m]."""
    landmark_rmse_aligned: float
    """The same of the final map [m]."""
    pose_area: float
    """Of the final 3σ ellipse [m²]."""
    landmark_area: float
    """Mean of the landmarks' final 3σ ellipses [m²]."""


class _Variation(NamedTuple):
    changed: str
    sigma: str
    factor: float
    world: Scenario
    told: Scenario


def noise_effects(
    scenario: Scenario | Mapping[str, object] | str | Path,
    estimators: str | Iterable[str] | Mapping[str, Any],
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
    variations = list(_variations(load_scenario(scenario), list(changed)))
    effects: list[NoiseEffect] = []
    for done, variation in enumerate(variations):
        results = monte_carlo(
            variation.world,
            estimators,
            runs,
            seed,
            assumed=variation.told,
            jobs=jobs,
            backend=backend,
        )
        effects += [
            _effect(variation, scores_of(results, label, "invariant"))
            for label in labels_of(results)
        ]
        if progress is not None:
            progress((done + 1) * runs, len(variations) * runs)
    return effects


def _variations(world: Scenario, changed: list[Changed]) -> Iterator[_Variation]:
    for place in changed:
        if place not in CHANGED:
            hint = closest(place, CHANGED)
            raise ValueError(
                f"changed must be of {', '.join(CHANGED)}, got '{place}'{hint}"
            )
    yield _Variation("nothing", "none", 1.0, world, world)
    for place in changed:
        for sigma in SIGMAS:
            for factor in FACTORS:
                scaled = scaled_scenario(world, sigma, factor)
                yield _Variation(
                    place,
                    sigma,
                    factor,
                    world if place == "filter" else scaled,
                    world if place == "world" else scaled,
                )


def _effect(variation: _Variation, scores: EstimatorScores) -> NoiseEffect:
    per_run = scores.ratios("invariant").mean(axis=1)
    return NoiseEffect(
        *variation[:3],
        estimator=scores.label,
        runs=len(per_run),
        failed=len(scores.failures),
        nees_per_degree=_known(mean(per_run)),
        nees_per_degree_error=_known(standard_error(per_run)),
        nees_per_degree_median=float(np.median(per_run)) if len(per_run) else np.nan,
        nis_per_degree=_known(scores.nis_per_degree),
        position_rmse=_known(root_mean_square(scores.over_time("position_error"))),
        ate_aligned=_known(root_mean_square(scores.per_run("ate_aligned"))),
        landmark_rmse_aligned=_known(
            root_mean_square(scores.per_run("landmark_rmse_aligned"))
        ),
        pose_area=_known(mean(scores.per_run("pose_area"))),
        landmark_area=_known(mean(scores.per_run("landmark_area"))),
    )


def _known(value: float | None) -> float:
    return np.nan if value is None else value
