"""The noise study: each noise times 10 and divided by 10, in turn.

`study_log` and `study_scenario` study one run, as section 3.2 of the CMU 16-833
EKF-SLAM homework asks. For a log, only the filter's assumed noise changes: the readings
stay as they are, so a wrong σ shows as a belief that is too wide or too narrow. For a
scenario, world and filter change together, with the same random numbers: the filter's
assumption stays right, and the study shows what a better or worse robot would achieve.

`noise_effects` studies many runs, with standard errors. A σ changes in the world and in
what the filters assume ("both", so that they stay right), in the world alone, or in the
filters alone, which then trust their odometry or their sensor too much or too little.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, get_args

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from ..estimator.registry import EstimatorFactory
from ..evaluation.trajectory_error import ellipse_areas
from ..sim_configs import Scenario, load_scenario
from ..sim_configs.field_types import unknown_choice
from .figures.style import GREY, INK, dress, legend, new_figure, write_title
from .logs.ground_truth import path_accuracy
from .logs.slamlog import SlamLog
from .run_and_replay.filter_settings import SIGMAS, FilterSettings, settings_for
from .run_and_replay.log_replay import Progress, Replay, replay
from .run_and_replay.summary import map_accuracy, nees_summary, nis_summary, rmse_table
from .run_and_replay.trace import (
    RunTrace,
    finite,
    mean,
    root_mean_square,
    standard_error,
)

if TYPE_CHECKING:
    from .monte_carlo_study.figures import EstimatorLook
    from .monte_carlo_study.verdict import EstimatorScores

_UNITS = dict(zip(SIGMAS, ("m", "m", "rad", "rad", "m"), strict=True))


class NoiseRow(NamedTuple):
    """The numbers of one run of a noise study; None if the truth is unknown."""

    #: The noise that was changed, one of `SIGMAS`; "none" for the reference.
    sigma: str
    #: Its factor; 1 for the reference.
    factor: float
    #: Its value then [m or rad]; None for the reference.
    std: float | None
    #: Area of the last predicted pose's 3σ ellipse, before its update [m²].
    predicted_area: float
    #: Area of the final pose's 3σ ellipse [m²].
    pose_area: float
    #: Mean area of the final landmarks' 3σ ellipses [m²]; None without landmarks.
    landmark_area: float | None
    #: Root mean square error of the final landmarks [m].
    landmark_rmse: float | None
    #: The same after the rigid motion that fits the map best to the truth [m].
    landmark_rmse_aligned: float | None
    #: Root mean square error of the path [m].
    ate: float | None
    #: Mean NEES of the pose divided by 3; 1 is expected of a consistent filter.
    nees_per_degree: float | None
    #: NIS by its degrees of freedom, which needs no truth; 1 is expected.
    nis_per_degree: float | None


class NoiseRun(NamedTuple):
    """One run of a noise study."""

    #: Of its panel, for example "σx × 10 = 2.5 m".
    title: str
    row: NoiseRow
    trace: RunTrace


def study_log(
    log: SlamLog, settings: FilterSettings, *, progress: Progress | None = None
) -> list[NoiseRun]:
    """Replay a log with each of the filter's σ times 10 and divided by 10.

    Parameters
    ----------
    log : SlamLog
        The log.
    settings : FilterSettings
        The filter of the reference.
    progress : callable, optional
        Called with (runs done, runs) after every run.

    Returns
    -------
    list of NoiseRun
        The reference, then two runs for each of `SIGMAS`.
    """
    return _study(lambda variation: (log, settings.scaled(*variation)), progress)


def study_scenario(
    scenario: Scenario,
    record: Callable[[Scenario], SlamLog],
    *,
    estimator: str = "invariant",
    options: Mapping[str, object] | None = None,
    progress: Progress | None = None,
) -> list[NoiseRun]:
    """Run a scenario with each σ of world and filter times 10 and divided by 10.

    Parameters
    ----------
    scenario : Scenario
        The reference.
    record : callable
        Drives one episode of a scenario, always with the same seed, so that the noise
        differs by the factor alone; see
        `record_episode`.
    estimator : str
        Name of the filter; it assumes the noise of the world.
    options : mapping, optional
        Its further options.
    progress : callable, optional
        Called with (runs done, runs) after every run.

    Returns
    -------
    list of NoiseRun
        The reference, then two runs for each of `SIGMAS`.
    """

    def varied(variation: Variation) -> tuple[SlamLog, FilterSettings]:
        log = record(scaled_scenario(scenario, *variation))
        return log, settings_for(log, estimator=estimator, options=options)

    return _study(varied, progress)


def _study(
    varied: Callable[[Variation], tuple[SlamLog, FilterSettings]],
    progress: Progress | None,
) -> list[NoiseRun]:
    runs: list[NoiseRun] = []
    variations = (REFERENCE, *CHANGES)
    for variation in variations:
        log, settings = varied(variation)
        done = replay(log, settings.make(log.start), name=settings.estimator)
        runs.append(_measured(done, variation, settings))
        if progress is not None:
            progress(len(runs), len(variations))
    return runs


def _measured(done: Replay, variation: Variation, settings: FilterSettings) -> NoiseRun:
    stds = (*settings.motion_std, *settings.measurement_std)
    std = dict(zip(SIGMAS, stds, strict=True)).get(variation.sigma)
    value = "" if std is None else f" = {std:.3g} {_UNITS[variation.sigma]}"
    trace = done.trace
    of_map = rmse_table(map_accuracy(trace)) or {}
    of_path = rmse_table(path_accuracy(done.log, trace.t, trace.poses)) or {}
    nees, nis = nees_summary(trace) or {}, nis_summary(trace) or {}
    areas = ellipse_areas(trace.landmark_covariances)
    last = trace.predicted_pose_covariances[-1], trace.pose_covariances[-1]
    predicted_area, pose_area = ellipse_areas(np.stack(last)[:, :2, :2]).tolist()
    row = NoiseRow(
        *variation,
        std=None if std is None else float(f"{std:.12g}"),  # 0.1 × 0.1 is 0.01
        predicted_area=predicted_area,
        pose_area=pose_area,
        landmark_area=finite(areas.mean()) if len(areas) else None,
        landmark_rmse=of_map.get("raw"),
        landmark_rmse_aligned=of_map.get("aligned"),
        ate=of_path.get("raw"),
        nees_per_degree=nees.get("per_degree"),
        nis_per_degree=nis.get("per_degree"),
    )
    return NoiseRun(f"{variation}{value}", row, trace)


Changed = Literal["both", "world", "filter"]
CHANGED: tuple[Changed, ...] = get_args(Changed)


class NoiseEffect(NamedTuple):
    """The effect of one change on one estimator: averages over runs and steps.

    A figure is nan where too few runs succeeded.
    """

    #: Place of the change: both, world or filter; "nothing" for the reference.
    changed: str
    #: The noise, one of `SIGMAS`; "none" for the reference.
    sigma: str
    #: Its factor; 1 for the reference.
    factor: float
    #: Label of the estimator.
    estimator: str
    #: Number of runs behind the figures.
    runs: int
    #: Runs left out: they failed, or their NEES or NIS is not finite or above 1e100.
    failed: int
    #: NEES of the pose divided by 3, in the invariant frame; 1 is expected.
    nees_per_degree: float
    #: Its standard error, from the averages of the runs, which are independent.
    nees_per_degree_error: float
    #: Median of the runs' averages, which a few bad runs do not dominate.
    nees_per_degree_median: float
    #: NIS by its degrees of freedom; 1 is expected.
    nis_per_degree: float
    #: Root mean square error of the position, not aligned [m].
    position_rmse: float
    #: Root mean square error of the path after the best rigid motion [m].
    ate_aligned: float
    #: The same of the final map [m].
    landmark_rmse_aligned: float
    #: Mean area of the final 3σ ellipse of the position [m²].
    pose_area: float
    #: Mean area of the landmarks' final 3σ ellipses [m²].
    landmark_area: float


def noise_effects(
    scenario: Scenario | Mapping[str, object] | str | Path,
    estimators: str | Iterable[str | EstimatorFactory] | Mapping[str, Any],
    runs: int,
    seed: int = 0,
    *,
    changed: Iterable[Changed] = CHANGED,
    jobs: int | None = None,
    backend: str | None = None,
    progress: Progress | None = None,
) -> list[NoiseEffect]:
    """Run a Monte Carlo for each change of each noise, all on the same random numbers.

    Parameters
    ----------
    scenario : Scenario, mapping, str or Path
        The reference.
    estimators, runs, seed, jobs, backend
        As in :func:`~slamgym.experiments.monte_carlo`.
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
    from .monte_carlo_study import monte_carlo
    from .monte_carlo_study.verdict import labels_of, scores_of

    world = load_scenario(scenario)
    jobs_to_do = [("nothing", REFERENCE, world, world), *_changes(world, changed)]
    effects: list[NoiseEffect] = []
    for done, (place, variation, actual, assumed) in enumerate(jobs_to_do, 1):
        results = monte_carlo(
            actual,
            estimators,
            runs,
            seed,
            assumed=assumed,
            jobs=jobs,
            backend=backend,
            progress=False,
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
            raise ValueError(unknown_choice("changed", place, CHANGED))
        for variation in CHANGES:
            scaled = scaled_scenario(world, *variation)
            actual = world if place == "filter" else scaled
            yield place, variation, actual, world if place == "world" else scaled


def _effect(place: str, variation: Variation, scores: EstimatorScores) -> NoiseEffect:
    per_run = scores.ratios("invariant")
    found = {
        "nees_per_degree_median": float(np.median(per_run)) if len(per_run) else None,
        "nees_per_degree": mean(per_run),
        "nees_per_degree_error": standard_error(per_run),
        "nis_per_degree": scores.nis_per_degree,
        "position_rmse": scores.rms("position_error"),
        "pose_area": mean(scores.per_run("pose_area")),
        "landmark_area": mean(scores.per_run("landmark_area")),
    }
    for name in ("ate_aligned", "landmark_rmse_aligned"):
        found[name] = root_mean_square(scores.per_run(name))
    (sigma, factor), label = variation, scores.label
    runs, failed = len(per_run), len(scores.failures)
    figures = {name: np.nan if x is None else x for name, x in found.items()}
    return NoiseEffect(place, sigma, factor, label, runs, failed, **figures)


FACTORS = (10.0, 0.1)


class Variation(NamedTuple):
    """One noise and its factor."""

    #: One of `SIGMAS`; "none" for the reference.
    sigma: str
    #: 1 for the reference.
    factor: float

    def __str__(self) -> str:
        """Return for example "σx × 10"."""
        if self.sigma == "none":
            return "unchanged"
        return f"{self.sigma} {'× 10' if self.factor > 1 else '÷ 10'}"


REFERENCE = Variation("none", 1.0)
CHANGES = tuple(Variation(sigma, factor) for sigma in SIGMAS for factor in FACTORS)


def scaled_scenario(scenario: Scenario, sigma: str, factor: float) -> Scenario:
    """Multiply one of `SIGMAS` of a world by a factor.

    Examples
    --------
    >>> from slamgym.sim_configs import load_scenario
    >>> scaled_scenario(load_scenario("six_landmarks"), "σβ", 10).sensor.std
    (0.1, 0.08)
    """
    settings = FilterSettings("", scenario.motion.std, scenario.sensor.std)
    scaled = settings.scaled(sigma, factor)
    return scenario.with_changes(
        motion={"std": scaled.motion_std}, sensor={"std": scaled.measurement_std}
    )


_TITLES = {
    "both": ("World and filter change", "the filter assumes the right noise"),
    "world": ("Only the world changes", "the filter assumes the old noise"),
    "filter": ("Only the filter changes", "it assumes a wrong noise"),
}
_SHIFT = 0.28  # of the rows, between × 10 and ÷ 10


def noise_effects_figure(effects: Sequence[NoiseEffect]) -> Figure:
    """Draw the NEES per degree of freedom after every change, a panel for each place.

    Bars are one standard error long to either side.

    Parameters
    ----------
    effects : sequence of NoiseEffect
        Of `noise_effects`.
    """
    from .monte_carlo_study.figures import log_ticks, look_of, plain

    places = list(dict.fromkeys(e.changed for e in effects if e.changed in _TITLES))
    labels = dict.fromkeys(effect.estimator for effect in effects)
    looks = {label: look_of(k) for k, label in enumerate(labels)}
    figure = new_figure(1.2 + 3.4 * len(places), 4.6)
    all_axes = figure.subplots(1, len(places), sharey=True, sharex=True, squeeze=False)
    for axes, place in zip(all_axes[0], places, strict=True):
        _draw(axes, [e for e in effects if e.changed in (place, "nothing")], looks)
        write_title(axes, *_TITLES[place])
        log_ticks(axes, "x")
    names = (str(REFERENCE), *SIGMAS)
    all_axes[0, 0].set_yticks(range(len(names)), names)
    all_axes[0, 0].set_ylim(len(names) - 0.5, -0.5)
    figure.supxlabel("mean pose NEES / 3 ± standard error; 1 is expected", fontsize=10)
    keys = [
        Line2D([], [], ls="", marker=look.marker, color=look.colour, label=plain(label))
        for label, look in looks.items()
    ]
    for text, fill in (("σ × 10", INK), ("σ ÷ 10", "white")):
        keys.append(Line2D([], [], ls="", marker="o", color=INK, mfc=fill, label=text))
    legend(figure, keys, len(labels) + 2, place="outside upper left", size=9.5)
    return figure


def _draw(
    axes: Axes, effects: Sequence[NoiseEffect], looks: Mapping[str, EstimatorLook]
) -> None:
    dress(axes)
    axes.axvline(1.0, color=GREY, lw=1.0, ls=(0, (4, 3)))
    rows = {sigma: row for row, sigma in enumerate((REFERENCE.sigma, *SIGMAS))}
    for effect in effects:
        look = looks[effect.estimator]
        shift = 0.0 if effect.factor == 1 else -_SHIFT if effect.factor > 1 else _SHIFT
        row, error = rows[effect.sigma] + shift, effect.nees_per_degree_error
        if math.isfinite(error):
            ends = effect.nees_per_degree + error * np.array([-1.0, 1.0])
            axes.plot(ends, [row, row], color=look.colour, lw=1.6, zorder=1.9)
        (dot,) = axes.plot(effect.nees_per_degree, row, look.marker, color=look.colour)
        fill = look.colour if effect.factor >= 1 else "white"
        dot.set(markersize=6.5, markerfacecolor=fill, markeredgewidth=1.4)
