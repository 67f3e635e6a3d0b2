"""Estimators for agents: chosen by name or made by hand, and held to their promises."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, Protocol, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..estimator.filters.batch import BatchSlam
from ..estimator.registry import (
    accepted_options,
    find_estimator,
    make_batch,
    make_estimator,
)
from ..sim_configs import Scenario

Array = NDArray[np.float64]


class BeliefOfMap(Protocol):
    """What an agent reads of a belief; `slamgym.estimator.Belief` is one."""

    @property
    def pose(self) -> Array:
        """Mean of the pose, shape (3,) [m, m, rad]."""

    @property
    def pose_covariance(self) -> Array:
        """Covariance of the pose, shape (3, 3)."""

    @property
    def landmark_ids(self) -> tuple[int, ...]:
        """Identities of the n mapped landmarks, in the order of the state."""

    @property
    def landmarks(self) -> Array:
        """Means of the n mapped landmarks, shape (n, 2) [m]."""

    @property
    def covariance(self) -> Array:
        """Of the additive error of the state, shape (3 + 2n, 3 + 2n)."""


class FollowingEstimator(Protocol):
    """What an agent's loop asks of an estimator: four of `SlamEstimator`'s methods."""

    def reset(self, pose: ArrayLike, pose_std: ArrayLike) -> None:
        """Start a new run, the map empty."""

    def predict(self, odometry: ArrayLike, dt: float = 1.0) -> None:
        """Move by odometry (d, α) [m, rad]."""

    def update(self, measurements: ArrayLike, landmark_ids: Any = None) -> Any:
        """Take in one scan, rows (bearing, range) [rad, m]."""

    def belief(self) -> Any:
        """Return the present belief."""


EstimatorChoice = str | FollowingEstimator | Callable[..., FollowingEstimator]

_METHODS = ("reset", "predict", "update", "belief")
_OF_BELIEF = ("pose", "pose_covariance", "landmark_ids", "landmarks", "covariance")
_ARRAYS = ("pose", "pose_covariance", "landmarks", "covariance")
_ROUNDING = 1e-9  # that a variance may be below 0, as in `check_estimator`


def choose_estimator(
    estimator: EstimatorChoice,
    scenario: Scenario,
    options: Mapping[str, Any] | None = None,
) -> FollowingEstimator:
    """Make an estimator that knows the noise of a world.

    Parameters
    ----------
    estimator : str, callable or object
        A registered name or "module:Class", a factory with the keywords of
        `make_estimator`, or an estimator already made, which keeps its settings.
    scenario : Scenario
        Its noise is told to the estimator.
    options : mapping, optional
        Further options of the estimator's constructor.

    Raises
    ------
    ValueError
        If the name is unknown, or options are given for an estimator already made.
    TypeError
        If the estimator lacks a method, which is named.

    Examples
    --------
    >>> from slamgym.sim_configs import load_scenario
    >>> type(choose_estimator("ekf", load_scenario("loop"))).__name__
    'EkfSlam'
    """
    if isinstance(estimator, str):
        return checked_estimator(_named(estimator, scenario, options or {}))
    if isinstance(estimator, type) or not _has_a_method(estimator):
        factory = cast("Callable[..., FollowingEstimator]", estimator)
        told = told_options(factory, scenario)
        estimator = _made_by(factory, scenario, {**told, **(options or {})})
    elif options:
        raise ValueError(
            "estimator_options must be empty with an estimator already made, "
            f"got {dict(options)!r}"
        )
    return checked_estimator(cast("FollowingEstimator", estimator))


def choose_batch(
    estimator: str,
    scenario: Scenario,
    runs: int,
    landmarks: int,
    options: Mapping[str, Any] | None = None,
) -> BatchSlam:
    """Make a batch of a registered estimator that knows the noise of a world.

    One thread: what one step costs is less than handing it to another.

    Raises
    ------
    ValueError
        If the name is unknown, or the estimator cannot run in batches.
    """
    if not isinstance(estimator, str):
        raise ValueError(
            f"estimator must be a registered name where worlds run side by side, "
            f"got {estimator!r}"
        )
    known = told_options(find_estimator(estimator), scenario)
    return make_batch(
        estimator,
        runs=runs,
        landmarks=landmarks,
        motion_std=scenario.motion.std,
        measurement_std=scenario.sensor.std,
        threads=1,
        **{**known, **(options or {})},
    )


def told_options(factory: Callable[..., Any], scenario: Scenario) -> dict[str, Any]:
    """Collect what a world tells of its noise, as far as the factory takes it."""
    told = {
        "range_std_per_metre": scenario.sensor.range_std_per_metre,
        "noise_at_rest": scenario.motion.noise_at_rest,
    }
    return accepted_options(factory, told)


def checked_estimator(estimator: FollowingEstimator) -> FollowingEstimator:
    """Return the estimator, or name the method of the Protocol that it lacks."""
    for method in _METHODS:
        if not callable(getattr(estimator, method, None)):
            raise TypeError(
                f"estimator must have the methods {', '.join(_METHODS)}, but "
                f"{type(estimator).__name__} has no method {method}()"
            )
    return estimator


def checked_belief(estimator: FollowingEstimator, step: int) -> BeliefOfMap:
    """Ask for the belief, and name what is wrong with it.

    Shapes, finite numbers and variances are looked at in every step. Whether the whole
    covariance is positive semidefinite costs more; `check_estimator` tells that.

    Parameters
    ----------
    estimator : FollowingEstimator
        Whose belief is asked for.
    step : int
        For the message; 0 is the first scan, before any motion.

    Raises
    ------
    TypeError
        If a part is missing or has another shape.
    ValueError
        If a number is not finite or a variance is negative.
    """
    belief = estimator.belief()
    name = type(estimator).__name__
    parts = {part: getattr(belief, part, None) for part in _OF_BELIEF}
    for part, value in parts.items():
        if value is None:
            raise TypeError(
                f"{name}.belief() must return a belief with {', '.join(_OF_BELIEF)}, "
                f"got {type(belief).__name__} without {part}"
            )
    count = len(belief.landmark_ids)
    arrays = {part: np.asarray(parts[part]) for part in _ARRAYS}
    for (part, array), shape in zip(arrays.items(), _shapes(count), strict=True):
        if array.shape != shape and not 0 == array.size == math.prod(shape):
            what = part if part == "landmarks" else f"a {part}"
            raise TypeError(
                f"{name}.belief() must have {what} of shape {shape} with {count} "
                f"landmarks, got {array.shape} at step {step}"
            )
    for part, array in arrays.items():
        problem = _wrong_number(part, array)
        if problem:
            raise ValueError(f"{name}.belief() must {problem} at step {step}")
    checked: BeliefOfMap = belief
    return checked


def _shapes(landmarks: int) -> tuple[tuple[int, ...], ...]:
    size = 3 + 2 * landmarks
    return (3,), (3, 3), (landmarks, 2), (size, size)


def _wrong_number(part: str, values: NDArray[Any]) -> str | None:
    """Tell which rule a part of a belief breaks, and by which number."""
    finite = np.isfinite(values)
    if not finite.all():
        return f"be finite, got {_first(part, values, ~finite)}"
    if part.endswith("covariance") and values.diagonal().min() < -_ROUNDING:
        wrong = np.diag(values.diagonal() < -_ROUNDING)
        return f"have variances >= 0, got {_first(part, values, wrong)}"
    return None


def _first(part: str, values: NDArray[Any], wrong: NDArray[np.bool_]) -> str:
    """Write the first wrong entry, as in "covariance[1, 1] = -0.5"."""
    place = np.argwhere(wrong)[0].tolist()
    return f"{part}{place} = {values[tuple(place)]}"


def _has_a_method(estimator: Any) -> bool:
    return any(hasattr(estimator, method) for method in _METHODS) or not callable(
        estimator
    )


def _named(
    name: str, scenario: Scenario, options: Mapping[str, Any]
) -> FollowingEstimator:
    """Make a registered estimator; it associates where the world hides identities."""
    known: dict[str, Any] = told_options(find_estimator(name), scenario)
    if not scenario.sensor.identities:
        known["management"] = True
    return _made_by(partial(make_estimator, name), scenario, {**known, **options})


def _made_by(
    factory: Any, scenario: Scenario, options: Mapping[str, Any]
) -> FollowingEstimator:
    made: FollowingEstimator = factory(
        motion_std=scenario.motion.std, measurement_std=scenario.sensor.std, **options
    )
    return made
