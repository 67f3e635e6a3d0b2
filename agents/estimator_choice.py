"""Estimators in the loop of an agent: construction, and checks of their beliefs."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, Literal, Protocol, cast

import numpy as np
from numpy.typing import ArrayLike

from ..arrays import AnyArray, BoolArray
from ..envs.rendering import BeliefLike
from ..estimator import registry
from ..estimator.map_management.policy import LandmarkPolicy, as_policy
from ..sim_configs import Scenario


class BeliefOfMap(BeliefLike, Protocol):
    """The parts of a belief that agents use; `slamgym.estimator.Belief` has them."""

    @property
    def landmark_ids(self) -> tuple[int, ...]:
        """Identities of the n mapped landmarks, in the order of the state."""


class FollowingEstimator(Protocol):
    """The four methods of `SlamEstimator` that an agent's loop needs."""

    def reset(self, pose: ArrayLike, pose_std: ArrayLike) -> None:
        """Start a new run with an empty map."""

    def predict(self, odometry: ArrayLike, dt: float = 1.0) -> None:
        """Predict with odometry (d, α) [m, rad]."""

    def update(self, measurements: ArrayLike, landmark_ids: Any = None) -> Any:
        """Update with one scan, rows (bearing, range) [rad, m]."""

    def belief(self) -> Any:
        """Return the present belief."""


EstimatorChoice = str | FollowingEstimator | Callable[..., FollowingEstimator]

_METHODS = ("reset", "predict", "update", "belief")
_OF_BELIEF = ("pose", "pose_covariance", "landmark_ids", "landmarks", "covariance")
_ARRAYS = ("pose", "pose_covariance", "landmarks", "covariance")
_ROUNDING = 1e-9  # tolerance of a negative variance, as in `check_estimator`


def choose_estimator(
    estimator: EstimatorChoice,
    scenario: Scenario,
    options: Mapping[str, Any] | None = None,
    *,
    rows: int | None = None,
) -> FollowingEstimator:
    """Make an estimator with the noise settings of a world.

    Parameters
    ----------
    estimator : str, callable or object
        A registered name or "module:Class", a factory with the keywords of
        `make_estimator`, or an existing estimator, which keeps its settings.
    scenario : Scenario
        Source of the noise settings.
    options : mapping, optional
        Further options of the estimator's constructor.
    rows : int, optional
        In a world that hides identities, the most landmarks that landmark management
        keeps in the map, unless its policy has a capacity.

    Raises
    ------
    ValueError
        If the name is unknown, or there are options for an existing estimator.
    TypeError
        If the estimator lacks a method.

    Examples
    --------
    >>> from slamgym.sim_configs import load_scenario
    >>> type(choose_estimator("ekf", load_scenario("loop"))).__name__
    'EkfSlam'
    """
    settings = dict(options or {})
    factory: Any
    if isinstance(estimator, str):
        factory = partial(registry.make_estimator, estimator)
        own = registry.find_estimator(registry.read_label(estimator).name)
        known = registry.accepted_models(own, scenario.models)
        if not scenario.sensor.identities:
            settings["management"] = _bounded(settings.get("management", True), rows)
    elif isinstance(estimator, type) or not _has_a_method(estimator):
        factory = estimator
        known = registry.accepted_models(factory, scenario.models)
        known = registry.with_sensor(factory, known)
    elif options:
        raise ValueError(
            "estimator_options must be empty with an estimator already made, "
            f"got {settings!r}"
        )
    else:
        return checked_estimator(cast("FollowingEstimator", estimator))
    stds = {"motion_std": scenario.motion.std, "measurement_std": scenario.sensor.std}
    return checked_estimator(factory(**stds, **{**known, **settings}))


def _bounded(management: Any, rows: int | None) -> LandmarkPolicy | Literal[False]:
    """Return a policy that keeps at most this many landmarks; False for none."""
    if management is False or management is None:
        return False
    policy = as_policy(management)
    return replace(policy, capacity=rows) if policy.capacity is None else policy


def checked_estimator(
    estimator: FollowingEstimator, methods: Sequence[str] = _METHODS
) -> FollowingEstimator:
    """Return the estimator, or raise a `TypeError` if it lacks a method."""
    for method in methods:
        if not callable(getattr(estimator, method, None)):
            raise TypeError(
                f"estimator must have the methods {', '.join(methods)}, but "
                f"{type(estimator).__name__} has no method {method}()"
            )
    return estimator


def checked_belief(estimator: FollowingEstimator, step: int) -> BeliefOfMap:
    """Return the belief of an estimator after checking its shapes and numbers.

    `check_estimator` has the more expensive check that the whole covariance is positive
    semidefinite.

    Parameters
    ----------
    estimator : FollowingEstimator
        Source of the belief.
    step : int
        For the error message; 0 is the first scan, before any motion.

    Raises
    ------
    TypeError
        If a part is missing or has another shape.
    ValueError
        If a number is not finite or a variance is negative.
    """
    belief = estimator.belief()
    name = f"{type(estimator).__name__}.belief()"
    parts = {part: getattr(belief, part, None) for part in _OF_BELIEF}
    missing = [part for part, value in parts.items() if value is None]
    if missing:
        raise TypeError(
            f"{name} must return a belief with {', '.join(_OF_BELIEF)}, "
            f"got {type(belief).__name__} without {missing[0]}"
        )
    arrays = {part: np.asarray(parts[part]) for part in _ARRAYS}
    count = len(belief.landmark_ids)
    size = 3 + 2 * count
    shapes = ((3,), (3, 3), (count, 2), (size, size))
    for (part, array), shape in zip(arrays.items(), shapes, strict=True):
        if array.shape != shape and not 0 == array.size == math.prod(shape):
            what = part if part == "landmarks" else f"a {part}"
            raise TypeError(
                f"{name} must have {what} of shape {shape} with {count} landmarks, "
                f"got {array.shape} at step {step}"
            )
    for part, array in arrays.items():
        problem = _wrong_number(part, array)
        if problem:
            raise ValueError(f"{name} must {problem} at step {step}")
    checked: BeliefOfMap = belief
    return checked


def _wrong_number(part: str, values: AnyArray) -> str | None:
    """Return the message for a wrong number in a part of a belief, or None."""
    finite = np.isfinite(values)
    if not finite.all():
        return f"be finite, got {_first(part, values, ~finite)}"
    if part.endswith("covariance") and values.diagonal().min() < -_ROUNDING:
        wrong = np.diag(values.diagonal() < -_ROUNDING)
        return f"have variances >= 0, got {_first(part, values, wrong)}"
    return None


def _first(part: str, values: AnyArray, wrong: BoolArray) -> str:
    """Format the first wrong entry, as in "covariance[1, 1] = -0.5"."""
    place = np.argwhere(wrong)[0].tolist()
    return f"{part}{place} = {values[tuple(place)]}"


def _has_a_method(estimator: Any) -> bool:
    return any(hasattr(estimator, name) for name in _METHODS) or not callable(estimator)
