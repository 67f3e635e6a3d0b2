"""The noise study of one run: each noise times 10 and divided by 10, in turn.

Section 3.2 of the CMU 16-833 EKF-SLAM homework. For a log, only the filter's assumed
noise changes: the readings stay as they are, so a wrong σ shows as a belief that is too
wide or too narrow. For a scenario, world and filter change together, with the same
random numbers: the filter's assumption stays right, and the study shows what a better
or worse robot would achieve.
"""

from collections.abc import Callable, Mapping
from typing import NamedTuple

from ...evaluation.trajectory_error import ellipse_areas
from ...sim_configs import Scenario
from ..logs.ground_truth import path_accuracy
from ..logs.slamlog import SlamLog
from ..runs.filter_settings import SIGMAS, FilterSettings, settings_for
from ..runs.log_replay import Replay, replay
from ..runs.nan_statistics import finite
from ..runs.summary import map_accuracy, nees_summary, nis_summary
from ..runs.trace import RunTrace
from .variations import CHANGES, REFERENCE, Variation, scaled_scenario

Progress = Callable[[int, int], object]

_UNITS = dict(zip(SIGMAS, ("m", "m", "rad", "rad", "m"), strict=True))


class NoiseRow(NamedTuple):
    """The numbers of one run of a noise study; None if the truth is unknown."""

    sigma: str
    """The noise that was changed, one of `SIGMAS`; "none" for the reference."""
    factor: float
    """Its factor; 1 for the reference."""
    std: float | None
    """Its value then [m or rad]; None for the reference."""
    pose_area: float
    """Area of the final pose's 3σ ellipse [m²]."""
    landmark_area: float | None
    """Mean area of the final landmarks' 3σ ellipses [m²]; None without landmarks."""
    landmark_rmse: float | None
    """Root mean square error of the final landmarks [m]."""
    landmark_rmse_aligned: float | None
    """The same after the rigid motion that fits the map best to the truth [m]."""
    ate: float | None
    """Root mean square error of the path [m]."""
    nees_per_degree: float | None
    """Mean NEES of the pose divided by 3; 1 is expected of a consistent filter."""
    nis_per_degree: float | None
    """NIS by its degrees of freedom, which needs no truth; 1 is expected."""


class NoiseRun(NamedTuple):
    """One run of a noise study."""

    title: str
    """Of its panel, for example "σx × 10 = 2.5 m"."""
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

    def varied(variation: Variation) -> tuple[SlamLog, FilterSettings]:
        return log, settings.scaled(*variation)

    return _study(varied, progress)


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
    landmarks, path = map_accuracy(trace), path_accuracy(done.log, trace.t, trace.poses)
    nees, nis = nees_summary(trace), nis_summary(trace)
    areas = ellipse_areas(trace.landmark_covariances)
    row = NoiseRow(
        *variation,
        std=std,
        pose_area=float(ellipse_areas(trace.pose_covariances[-1:, :2, :2])[0]),
        landmark_area=finite(areas.mean()) if len(areas) else None,
        landmark_rmse=finite(landmarks.raw_rmse) if landmarks else None,
        landmark_rmse_aligned=finite(landmarks.aligned_rmse) if landmarks else None,
        ate=finite(path.raw_rmse) if path else None,
        nees_per_degree=nees["per_degree"] if nees else None,
        nis_per_degree=nis["per_degree"] if nis else None,
    )
    return NoiseRun(f"{variation}{value}", row, trace)
