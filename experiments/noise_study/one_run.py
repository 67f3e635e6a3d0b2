"""What each noise does to a filter: all five times 10 and divided by 10, one by one.

Section 3.2 of the CMU 16-833 EKF-SLAM homework. Of a log, only the filter's assumption
changes: the readings are what they are, so a wrong σ shows as a belief that is too wide
or too sure. Of a scenario, world and filter change together, with the same random
numbers: the filter's assumption stays right, and one sees what a better or worse robot
would achieve.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...sim_configs import Scenario
from ..logs.ground_truth import path_accuracy
from ..logs.slamlog import SlamLog
from ..runs.filter_settings import SIGMAS, FilterSettings, settings_for
from ..runs.replay import Replay, replay
from ..runs.summary import map_accuracy, nees_summary, nis_summary
from ..runs.trace import RunTrace

Progress = Callable[[int, int], object]

FACTORS = (10.0, 0.1)
_UNITS = dict(zip(SIGMAS, ("m", "m", "rad", "rad", "m"), strict=True))


class NoiseRow(NamedTuple):
    """One run of a noise study in numbers; None where the truth is unknown."""

    sigma: str
    """Which noise was changed, one of `SIGMAS`; "none" for the reference."""
    factor: float
    """By how much; 1 for the reference."""
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
    """Mean pose NEES by its 3 degrees of freedom: 1 is expected of a true belief."""
    nis_per_degree: float | None
    """The same of the NIS, which needs no truth."""


class NoiseRun(NamedTuple):
    """One run of a noise study."""

    title: str
    """For its panel, such as "σx × 10 = 2.5 m"."""
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

    def run(sigma: str, factor: float) -> tuple[Replay, FilterSettings]:
        changed = settings.scaled(sigma, factor)
        return replay(log, changed.make(log.start), name=settings.estimator), changed

    return _study(run, progress)


def study_scenario(
    scenario: Scenario,
    record: Callable[[Scenario], SlamLog],
    *,
    estimator: str = "ekf",
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
        :func:`~slamgym.experiments.logs.recording.record_episode`.
    estimator : str
        Name of the filter; its noise is that of the world.
    options : mapping, optional
        Its further options.
    progress : callable, optional
        Called with (runs done, runs) after every run.

    Returns
    -------
    list of NoiseRun
        The reference, then two runs for each of `SIGMAS`.
    """

    def run(sigma: str, factor: float) -> tuple[Replay, FilterSettings]:
        log = record(scaled_scenario(scenario, sigma, factor))
        settings = settings_for(log, estimator=estimator, options=options)
        return replay(log, settings.make(log.start), name=estimator), settings

    return _study(run, progress)


def scaled_scenario(scenario: Scenario, sigma: str, factor: float) -> Scenario:
    """Multiply one of `SIGMAS` of a world by a factor, and keep all else.

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


def ellipse_areas(covariances: NDArray[np.floating]) -> NDArray[np.floating]:
    """Areas 9 π √det P of 3σ ellipses, for covariances (k, 2, 2) [m²].

    Examples
    --------
    >>> ellipse_areas(np.eye(2)[None]) / np.pi
    array([9.])
    """
    determinants = np.maximum(np.linalg.det(covariances), 0.0)
    return np.asarray(9 * np.pi * np.sqrt(determinants))


def _study(
    run: Callable[[str, float], tuple[Replay, FilterSettings]],
    progress: Progress | None,
) -> list[NoiseRun]:
    runs: list[NoiseRun] = []
    variations = list(_variations())
    for sigma, factor in variations:
        done, settings = run(sigma, factor)
        std = _std_of(settings, sigma)
        runs.append(
            NoiseRun(
                _title(sigma, factor, std), _row(done, sigma, factor, std), done.trace
            )
        )
        if progress is not None:
            progress(len(runs), len(variations))
    return runs


def _variations() -> Iterator[tuple[str, float]]:
    yield "none", 1.0
    for sigma in SIGMAS:
        for factor in FACTORS:
            yield sigma, factor


def _std_of(settings: FilterSettings, sigma: str) -> float | None:
    stds: Sequence[float] = (*settings.motion_std, *settings.measurement_std)
    return dict(zip(SIGMAS, stds, strict=True)).get(sigma)


def _title(sigma: str, factor: float, std: float | None) -> str:
    if std is None:
        return "unchanged"
    change = f"× {factor:g}" if factor > 1 else f"÷ {1 / factor:g}"
    return f"{sigma} {change} = {std:.3g} {_UNITS[sigma]}"


def _row(done: Replay, sigma: str, factor: float, std: float | None) -> NoiseRow:
    trace = done.trace
    landmarks, path = map_accuracy(trace), path_accuracy(done.log, trace.t, trace.poses)
    nees, nis = nees_summary(trace), nis_summary(trace)
    areas = ellipse_areas(trace.landmark_covariances)
    return NoiseRow(
        sigma=sigma,
        factor=factor,
        std=std,
        pose_area=float(ellipse_areas(trace.pose_covariances[-1:, :2, :2])[0]),
        landmark_area=_finite(areas.mean()) if len(areas) else None,
        landmark_rmse=_finite(landmarks.raw_rmse) if landmarks else None,
        landmark_rmse_aligned=_finite(landmarks.aligned_rmse) if landmarks else None,
        ate=_finite(path.raw_rmse) if path else None,
        nees_per_degree=nees["per_degree"] if nees else None,
        nis_per_degree=nis["per_degree"] if nis else None,
    )


def _finite(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None
