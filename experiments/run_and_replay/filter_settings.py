"""Set up an estimator for a log, from the header of the log and the user's choices.

`settings_for` returns the settings of one filter, and `estimator_choices` those that a
Monte Carlo compares. `refuse_large_map` checks the size of the final belief first.
"""

from __future__ import annotations

import hashlib
import inspect
import marshal
import warnings
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field, replace
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from threadpoolctl import threadpool_limits

from ... import argument_checks
from ...estimator import interface, registry
from ...estimator.models.sensors import Sensor, sensor_in
from ...public_names import is_here
from ...sim_configs import Scenario
from ...suggestions import closest
from ..logs.ground_truth import hides_identities
from ..logs.recording import log_header
from ..logs.slamlog import UNICYCLES, LogError, SlamLog

if TYPE_CHECKING:
    pass


#: Import path of the smoother; its option ``follow`` names the filter that it follows,
#: and whose options it takes too.
SMOOTHER = "slamgym.estimator.smoother.recorded_slam:SmoothingSlam"
#: Estimators of whole drives, which no step-by-step experiment knows by name.
OFFLINE = {"smoother": SMOOTHER} if is_here("estimator.smoother") else {}
#: The five noises: three of the motion in the robot's frame, two of the sensor.
SIGMAS = ("σx", "σy", "σα", "σβ", "σr")

_COURSE_SOURCE = "course data.txt"
_COURSE_NOISE = {  # as the homework publishes it
    "motion_std": "0.25,0.1,0.1",
    "measurement_std": "0.01,0.08",
    "start_sigma": "0.02,0.02,0.1",
}

#: Keys of a log's header that :func:`settings_for` reads.
NOISE_KEYS = (
    "motion_std",
    "measurement_std",
    "start_sigma",
    "range_std_per_metre",
    "bearing_std_metres",
    "noise_at_rest",
)

_GROWING = "range_std_per_metre", "bearing_std_metres"
_ASSUMED_NOISE = {"motion_std": (0.1, 0.1, 0.03), "measurement_std": (0.026, 0.3)}


@dataclass(frozen=True)
class FilterSettings:
    """An estimator by name, with the noise it assumes and its options.

    Examples
    --------
    >>> settings = FilterSettings("ekf", (0.2, 0.1, 0.1), (0.01, 0.08))
    >>> settings.scaled("σr", 10).measurement_std
    (0.01, 0.8)
    """

    #: Registered name or "module:Class".
    estimator: str
    #: (σx, σy, σα) per unit of the log's time [m, m, rad].
    motion_std: tuple[float, ...]
    #: (σβ, σr) [rad, m].
    measurement_std: tuple[float, ...]
    #: (σx, σy, σθ) of the first pose [m, m, rad].
    initial_pose_std: tuple[float, ...] = (0.0, 0.0, 0.0)
    #: Further arguments of the estimator's constructor.
    options: Mapping[str, Any] = field(default_factory=dict)

    @property
    def sensor(self) -> Sensor:
        """The sensor with its noise."""
        return sensor_in(self.options)

    def make(self, initial_pose: ArrayLike) -> interface.SlamEstimator:
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
        """Return settings with one of `SIGMAS` times a factor; "none" keeps all."""
        stds = (*self.motion_std, *self.measurement_std)
        scaled = tuple(
            std * factor if name == sigma else std
            for name, std in zip(SIGMAS, stds, strict=True)
        )
        return replace(self, motion_std=scaled[:3], measurement_std=scaled[3:])

    def unmanaged(self) -> FilterSettings:
        """Return the settings of the same filter without landmark management."""
        options = {k: v for k, v in self.options.items() if k != "management"}
        return replace(self, options=options)


def given_log(log: SlamLog | str | PathLike[str]) -> SlamLog:
    """Return a log, or read the log at a path, in any known format.

    Raises
    ------
    TypeError
        If it is neither.
    """
    if isinstance(log, SlamLog):
        return log
    from ..logs.importers.any_format import read_log  # noqa: PLC0415 (all formats)

    if isinstance(log, str | PathLike):
        return read_log(log)
    raise TypeError(f"log must be a SlamLog or the path of one, got {log!r}")


def settings_for(
    log: SlamLog | str | PathLike[str],
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
    log : SlamLog or path
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
        unknown, or does not accept the noise of the log.
    LogError
        If a value in the header is malformed.
    """
    log = given_log(log)
    name, own = registry.read_label(estimator)
    estimator = OFFLINE.get(name, name)
    factory = registry.find_estimator(estimator)
    header = {"start_sigma": "0,0,0"} | _noise_header(log)
    needed = _GROWING if measurement_std is None else ()
    if measurement_std is not None:
        header.pop("bearing_std_metres", None)
    identified = _flag(log.name, "identities", header.get("identities", "true"))
    managed = {} if identified and not hides_identities(log) else {"management": True}
    return FilterSettings(
        estimator=estimator,
        motion_std=_std(log.name, header, "motion_std", motion_std),
        measurement_std=_std(log.name, header, "measurement_std", measurement_std),
        initial_pose_std=_std(log.name, header, "start_sigma", initial_pose_std),
        options={
            **_header_options(log.name, header, factory, needed),
            **registry.accepted_models(factory, _models(log)),
            **managed,
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
    motion = scenario.models.get("motion", "turn-last")
    log = SlamLog(scenario.name, log_header(scenario, seed=0), motion)
    return settings_for(log, estimator=estimator, options=options)


def _models(log: SlamLog) -> dict[str, str]:
    """Return the sensor and the drive of a log as filters take them."""
    models = {} if log.motion in UNICYCLES else {"motion": log.motion}
    if "sensor" in log.header:
        models["sensor"] = log.header["sensor"]
    return models


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
    name: str,
    header: Mapping[str, str],
    factory: registry.EstimatorFactory,
    needed: Collection[str],
) -> dict[str, Any]:
    """Return the options in the header that the estimator accepts.

    An estimator that does not accept a noise among those needed is refused.
    """
    options: dict[str, Any] = {}
    if not _flag(name, "noise_at_rest", header.get("noise_at_rest", "false")):
        options["noise_at_rest"] = False
    for key in _GROWING:
        if key in header:
            options[key] = _number(name, key, header[key])
    accepted = registry.accepted_options(factory, options)
    for key in needed:
        if options.get(key) and key not in accepted:
            raise ValueError(
                f"the noise of {name} contains {key}, an argument that the estimator "
                "does not have; for a log, another --measurement-std replaces it"
            )
    return accepted


def _number(name: str, key: str, text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise LogError(f"{name}: {key} must be numbers, got {text.strip()!r}") from None


def _flag(name: str, key: str, text: str) -> bool:
    if text not in ("true", "false"):
        raise LogError(f"{name}: {key} must be true or false, got {text!r}")
    return text == "true"


_PACKAGE = Path(registry.__file__).resolve().parents[1]
#: Names that stay those of slamgym's own estimators.
OWN_NAMES = frozenset(registry.list_estimators())


class EstimatorChoice(NamedTuple):
    """An estimator and its label in the results."""

    label: str
    #: Registered name or "module:Class".
    name: str
    #: Arguments of its constructor other than the noise.
    options: Mapping[str, Any] = {}

    def code(self) -> str:
        """Return a digest of the user's own source; empty for slamgym's estimators."""
        estimator = registry.find_estimator(self.name)
        try:
            source = inspect.getsourcefile(estimator)
        except TypeError:
            return ""
        except OSError:  # written in a notebook or an interpreter: no file
            return _digest(_code_of_methods(estimator))
        if source is None or Path(source).resolve().is_relative_to(_PACKAGE):
            return ""
        return _digest(Path(source).read_bytes())

    def settings(self, scenario: Scenario) -> FilterSettings:
        """Return its settings for the noise of a world."""
        return settings_for_scenario(
            scenario, estimator=self.name, options=self.options
        )


def _digest(code: bytes) -> str:
    return hashlib.sha256(code).hexdigest()[:12]


def _code_of_methods(estimator: object) -> bytes:
    """Return the compiled code of a class's own methods."""
    return b"".join(
        marshal.dumps(member.__code__)
        for _, member in sorted(vars(estimator).items())
        if inspect.isfunction(member)
    )


def estimator_choices(
    estimators: str | Iterable[str | registry.EstimatorFactory] | Mapping[str, Any],
) -> tuple[EstimatorChoice, ...]:
    """Parse estimators from names, classes or labels.

    Parameters
    ----------
    estimators : str, iterable of str, or mapping
        Names separated by commas, with optional options in brackets; or several such
        texts or classes; or a mapping from labels to a name, a class, or a pair (name,
        options).

    Raises
    ------
    ValueError
        If there is none, one is unknown or malformed, or a label occurs twice.

    Examples
    --------
    >>> for choice in estimator_choices("ekf,invariant[iterations=3]"):
    ...     print(choice)
    EstimatorChoice(label='ekf', name='ekf', options={})
    EstimatorChoice(label='invariant[iterations=3]', name='invariant', \
options={'iterations': 3})
    """
    if not isinstance(estimators, Iterable):
        raise ValueError(
            "estimators must be names, labels, or labels mapped to classes, "
            f"got {estimators!r}"
        )
    if isinstance(estimators, Mapping):
        choices = [_labelled(label, what) for label, what in estimators.items()]
    else:
        several = [estimators] if isinstance(estimators, str) else estimators
        choices = [choice for one in several for choice in _unlabelled(one)]
    if not choices:
        raise ValueError("estimators must name at least one, got none")
    labels = [choice.label for choice in choices]
    for choice in choices:
        if labels.count(choice.label) > 1:
            raise ValueError(f"estimators must differ, got '{choice.label}' twice")
    for choice in choices:
        registry.find_estimator(choice.name)
    return tuple(choices)


def _unlabelled(what: Any) -> list[EstimatorChoice]:
    """Read names separated by commas, or a class, whose name is then its label."""
    if isinstance(what, str):
        return [_labelled(label, label) for label in registry.split_labels(what)]
    label = getattr(what, "__name__", None)
    if not (callable(what) and label):
        raise ValueError(f"estimators must be names or classes, got {what!r}")
    return [_labelled(label, what)]


def _labelled(label: str, what: Any) -> EstimatorChoice:
    options: Mapping[str, Any] = {}
    if isinstance(what, str):
        what, options = registry.read_label(what)
    elif isinstance(what, tuple) and len(what) == 2:
        what, options = what
    return EstimatorChoice(label, _name_of(label, what), options)


def _name_of(label: str, what: str | Callable[..., Any]) -> str:
    """Return the import path of a class, or register what cannot be imported."""
    if isinstance(what, str):
        return OFFLINE.get(what, what)
    module, name = getattr(what, "__module__", ""), getattr(what, "__qualname__", "")
    if module != "__main__" and name.isidentifier():
        return f"{module}:{name}"
    name = label if label not in OWN_NAMES else f"{label} of yours"
    registry.register_estimator(name, what)
    return name


def refuse_large_map(landmarks: int, estimator: interface.SlamEstimator) -> None:
    """Refuse more landmarks than the final belief of this filter may hold.

    Raises
    ------
    ValueError
        If they exceed the filter's ``belief_limit``.
    """
    if hasattr(estimator, "belief_limit"):
        most: int = estimator.belief_limit
        argument_checks.refuse_large_belief(landmarks, most, "take fewer steps")


_LARGEST = 2**63 - 1  # of int64


def integer(name: str, value: object, least: int) -> int:
    """Check an integer that fits int64, and return it as int.

    Raises
    ------
    ValueError
        If it is none, or is too small or too large.

    Examples
    --------
    >>> integer("seed", np.int64(3), 0)
    3
    """
    whole = int(value) if isinstance(value, int | np.integer) else None
    if whole is None or isinstance(value, bool) or whole < least:
        raise ValueError(f"{name} must be an integer >= {least}, got {value!r}")
    if whole > _LARGEST:
        raise ValueError(f"{name} must be at most {_LARGEST}, got {whole}")
    return whole


def one_blas_thread() -> AbstractContextManager[Any]:
    """Run linear algebra on one thread within the context.

    Several threads are many times slower on shared cores, and the last bits of a
    product depend on their number.

    Examples
    --------
    >>> from threadpoolctl import threadpool_info
    >>> with one_blas_thread():
    ...     pools = [pool for pool in threadpool_info() if pool["user_api"] == "blas"]
    >>> {pool["num_threads"] for pool in pools}
    {1}
    """
    import scipy.linalg  # noqa: F401, PLC0415 (loads the BLAS to be limited)

    limits: AbstractContextManager[Any] = threadpool_limits(1, user_api="blas")
    return limits
