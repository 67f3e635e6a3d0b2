"""Set up an estimator for a log, from the header of the log and the user's choices."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from numpy.typing import ArrayLike

from ...estimator import registry
from ...estimator.interface import SlamEstimator
from ...estimator.registry import read_label
from ...sim_configs import Scenario
from ...suggestions import closest
from ..logs.events import Scan
from ..logs.lines import LogError
from ..logs.recording import log_header
from ..logs.slamlog import SlamLog

SMOOTHER = "slamgym.estimator.smoother.recorded_slam:SmoothingSlam"
"""Import path of the smoother; its option ``follow`` names the filter that it follows,
and whose options it takes too."""
OFFLINE = {"smoother": SMOOTHER}
"""Estimators of whole drives, which no step-by-step experiment knows by name."""
SIGMAS = ("σx", "σy", "σα", "σβ", "σr")
"""The five noises: three of the motion in the robot's frame, two of the sensor."""

_COURSE_SOURCE = "course data.txt"
_COURSE_NOISE = {  # as the homework publishes it
    "motion_std": "0.25,0.1,0.1",
    "measurement_std": "0.01,0.08",
    "start_sigma": "0.02,0.02,0.1",
}

NOISE_KEYS = (
    "motion_std",
    "measurement_std",
    "start_sigma",
    "range_std_per_metre",
    "bearing_std_metres",
    "noise_at_rest",
)
"""Keys of a log's header that :func:`settings_for` reads."""

_ASSUMED_NOISE = {
    "motion_std": (0.1, 0.1, 0.03),
    "measurement_std": (0.026, 0.3),
}


@dataclass(frozen=True)
class FilterSettings:
    """An estimator by name, with the noise it assumes and its options.

    Examples
    --------
    >>> settings = FilterSettings("ekf", (0.2, 0.1, 0.1), (0.01, 0.08))
    >>> settings.scaled("σr", 10).measurement_std
    (0.01, 0.8)
    """

    estimator: str
    """Registered name or "module:Class"."""
    motion_std: tuple[float, ...]
    """(σx, σy, σα) per unit of the log's time [m, m, rad]."""
    measurement_std: tuple[float, ...]
    """(σβ, σr) [rad, m]."""
    initial_pose_std: tuple[float, ...] = (0.0, 0.0, 0.0)
    """(σx, σy, σθ) of the first pose [m, m, rad]."""
    options: Mapping[str, Any] = field(default_factory=dict)
    """Further arguments of the estimator's constructor."""

    def make(self, initial_pose: ArrayLike) -> SlamEstimator:
        """Make the estimator at an initial pose (3,) [m, m, rad].

        Raises
        ------
        ValueError
            If the name is unknown, or the estimator refuses a value or an option.
        """
        try:
            return registry.make_estimator(
                self.estimator,
                motion_std=self.motion_std,
                measurement_std=self.measurement_std,
                initial_pose=initial_pose,
                initial_pose_std=self.initial_pose_std,
                **self.options,
            )
        except registry.UnknownOptionError:
            raise
        except TypeError as error:
            raise ValueError(
                f"estimator '{self.estimator}' refuses its options: {error}"
            ) from error

    def scaled(self, sigma: str, factor: float) -> FilterSettings:
        """Return settings with one of `SIGMAS` multiplied by a factor."""
        scaled = [
            std * factor if name == sigma else std
            for name, std in zip(
                SIGMAS, (*self.motion_std, *self.measurement_std), strict=True
            )
        ]
        return replace(
            self, motion_std=tuple(scaled[:3]), measurement_std=tuple(scaled[3:])
        )


def settings_for(
    log: SlamLog,
    *,
    estimator: str = "invariant",
    motion_std: Sequence[float] | None = None,
    measurement_std: Sequence[float] | None = None,
    initial_pose_std: Sequence[float] | None = None,
    options: Mapping[str, Any] | None = None,
) -> FilterSettings:
    """Set up an estimator for a log: by the arguments, else by the log's header.

    A log's header may hold ``motion_std``, ``measurement_std``, ``start_sigma``,
    ``range_std_per_metre``, ``bearing_std_metres`` and ``noise_at_rest``; logs of the
    simulator do, and for the course log the published values are used. A given
    ``measurement_std`` replaces ``bearing_std_metres`` too. By default, a log starts at
    a known pose, and its robot has no noise while it reports to be at rest.

    Parameters
    ----------
    log : SlamLog
        The log.
    estimator : str
        Registered name or "module:Class", with or without options in brackets, which
        override `options`.
    motion_std, initial_pose_std : sequence of 3 floats, optional
        See :class:`FilterSettings`.
    measurement_std : sequence of 2 floats, optional
        See :class:`FilterSettings`.
    options : mapping, optional
        Further options of the estimator, which override those of the header.

    Raises
    ------
    ValueError
        If neither the caller nor the log specifies a noise, or the estimator is
        unknown.
    LogError
        If a value in the header is malformed.
    """
    name, own = read_label(estimator)
    estimator = OFFLINE.get(name, name)
    factory = registry.find_estimator(estimator)
    header = _noise_header(log)
    if measurement_std is not None:
        header.pop("bearing_std_metres", None)
    return FilterSettings(
        estimator=estimator,
        motion_std=_std(log.name, header, "motion_std", motion_std),
        measurement_std=_std(log.name, header, "measurement_std", measurement_std),
        initial_pose_std=_std(
            log.name, {"start_sigma": "0,0,0"} | header, "start_sigma", initial_pose_std
        ),
        options={
            **_header_options(log.name, header, factory),
            **_needed_options(log, header),
            **(options or {}),
            **own,
        },
    )


def noise_or_assumed(
    log: SlamLog, stds: Mapping[str, Sequence[float]]
) -> dict[str, Sequence[float]]:
    """Add an assumed noise to what is given, where the log specifies none.

    Warns with the values: those of a car with a laser scanner, per √s, which are larger
    than those of most robots.
    """
    known = {**_noise_header(log), **stds}
    missing = {key: std for key, std in _ASSUMED_NOISE.items() if key not in known}
    for key, std in missing.items():
        values = ",".join(map(str, std))
        warnings.warn(
            f"{log.name} does not specify its {key}: {values} is assumed"
            f"{_meant(log.header, key)}",
            stacklevel=2,
        )
    return {**missing, **stds}


def settings_for_scenario(
    scenario: Scenario,
    *,
    estimator: str = "invariant",
    options: Mapping[str, Any] | None = None,
) -> FilterSettings:
    """Set up an estimator with the noise of a world.

    Raises
    ------
    ValueError
        If the estimator is unknown.

    Examples
    --------
    >>> from slamgym.sim_configs import load_scenario
    >>> settings_for_scenario(load_scenario("six_landmarks")).motion_std
    (0.25, 0.1, 0.1)
    """
    log = SlamLog(scenario.name, log_header(scenario, seed=0))
    return settings_for(log, estimator=estimator, options=options)


def _noise_header(log: SlamLog) -> dict[str, str]:
    """Return the header of a log; that of the course log with its published noise."""
    is_course = log.header.get("source") == _COURSE_SOURCE
    return {**(_COURSE_NOISE if is_course else {}), **log.header}


def _std(
    name: str, header: Mapping[str, str], key: str, given: Sequence[float] | None
) -> tuple[float, ...]:
    if given is not None:
        return tuple(map(float, given))
    if key in header:
        return tuple(_number(name, key, part) for part in header[key].split(","))
    example = "0.1,0.1,0.05" if key == "motion_std" else "0.02,0.1"
    raise ValueError(
        f"{name} does not specify its {key}: give it, for example "
        f"--{key.replace('_', '-')} {example}, or estimate it by slamgym fit-noise"
        f"{_meant(header, key)}"
    )


def _meant(header: Mapping[str, str], key: str) -> str:
    """Name the known keys, if another key of a header seems to hold a noise."""
    others = [
        other
        for other in header
        if other not in NOISE_KEYS and ("noise" in other or closest(other, [key]))
    ]
    if not others:
        return ""
    return (
        f" (of its header, {', '.join(map(repr, others))} is not read; known keys are "
        f"{', '.join(NOISE_KEYS)})"
    )


def _header_options(
    name: str, header: Mapping[str, str], factory: registry.EstimatorFactory
) -> dict[str, Any]:
    """Return the options in the header that the estimator accepts."""
    options: dict[str, Any] = {}
    if not _flag(name, "noise_at_rest", header.get("noise_at_rest", "false")):
        options["noise_at_rest"] = False
    if "range_std_per_metre" in header:
        key = "range_std_per_metre"
        options[key] = _number(name, key, header[key])
    if "bearing_std_metres" in header:
        key = "bearing_std_metres"
        options[key] = _number(name, key, header[key])
    accepted = registry.accepted_options(factory, options)
    if options.get("bearing_std_metres") and "bearing_std_metres" not in accepted:
        raise ValueError(
            f"the noise of {name} needs bearing_std_metres, which the estimator does "
            "not have: give it another --measurement-std"
        )
    return accepted


def _needed_options(log: SlamLog, header: Mapping[str, str]) -> dict[str, Any]:
    """Turn management on if the log does not identify all readings."""
    identified = _flag(log.name, "identities", header.get("identities", "true"))
    scans = (event for event in log.events if isinstance(event, Scan))
    if identified and all(scan.landmark_ids is not None for scan in scans):
        return {}
    return {"management": True}


def _number(name: str, key: str, text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise LogError(f"{name}: {key} must be numbers, got {text.strip()!r}") from None


def _flag(name: str, key: str, text: str) -> bool:
    if text not in ("true", "false"):
        raise LogError(f"{name}: {key} must be true or false, got {text!r}")
    return text == "true"
