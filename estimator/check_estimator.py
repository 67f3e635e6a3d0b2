"""Hold anybody's estimator against the contract of :class:`SlamEstimator`."""

import pickle
from collections.abc import Callable, Mapping
from io import BytesIO
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .interface import Belief, SlamEstimator, UpdateReport
from .models.angles import wrap_angle

Array = NDArray[np.float64]
Factory = Callable[..., SlamEstimator]

LANDMARKS = np.array([[4.0, 1.0], [2.0, -3.0], [-1.0, 4.0], [6.0, 5.0]])
NOISE = {"motion_std": (0.05, 0.02, 0.02), "measurement_std": (0.02, 0.05)}


class EstimatorContractError(AssertionError):
    """An estimator breaks the contract; the message says where and how."""


def check_estimator(factory: Factory) -> None:
    """Check that an estimator can stand wherever slamgym uses one.

    Drives a small known world and looks at interface, beliefs, reports, independence
    of snapshots, refusal of bad input, and save and restore.

    Parameters
    ----------
    factory : callable
        Makes the estimator from the keywords ``motion_std``, ``measurement_std``,
        ``initial_pose``, ``initial_pose_std``; a class will do.

    Raises
    ------
    EstimatorContractError
        At the first breach, naming the method and what is expected of it.

    Examples
    --------
    >>> from slamgym.estimator import EkfSlam
    >>> check_estimator(EkfSlam)
    """
    for check in (
        _check_interface,
        _check_start,
        _check_motion,
        _check_mapping,
        _check_update,
        _check_second_reading,
        _check_empty_scan,
        _check_snapshots,
        _check_refusals,
        _check_save_and_restore,
        _check_saved_state_is_a_copy,
        _check_reset,
    ):
        check(factory)


def _expect(condition: bool, message: str) -> None:
    if not condition:
        raise EstimatorContractError(message)


def _make(factory: Factory, **changes: Any) -> SlamEstimator:
    try:
        return factory(**NOISE, **changes)
    except TypeError as error:
        raise EstimatorContractError(
            "the factory must accept the keywords motion_std, measurement_std, "
            f"initial_pose and initial_pose_std: {error}"
        ) from error


def _scan(pose: Array, rng: np.random.Generator | None = None) -> Array:
    """Read all landmarks, (n, 2), with noise when an rng is given."""
    offset = LANDMARKS - pose[:2]
    bearing = wrap_angle(np.arctan2(offset[:, 1], offset[:, 0]) - pose[2])
    readings = np.stack([bearing, np.hypot(offset[:, 0], offset[:, 1])], axis=1)
    if rng is not None:
        readings += rng.standard_normal(readings.shape) * NOISE["measurement_std"]
    return readings


def _drive(estimator: SlamEstimator, steps: int, seed: int = 0) -> Array:
    """Drive a noisy arc; return the true pose at its end."""
    rng = np.random.default_rng(seed)
    pose = np.zeros(3)
    ids = list(range(len(LANDMARKS)))
    for _ in range(steps):
        d, turn = np.array([0.3, 0.1]) + rng.standard_normal(2) * (0.05, 0.02)
        pose += [d * np.cos(pose[2]), d * np.sin(pose[2]), turn]
        estimator.predict((0.3, 0.1))
        estimator.update(_scan(pose, rng), ids)
    return pose


def _check_interface(factory: Factory) -> None:
    estimator = _make(factory, initial_pose=(0, 0, 0), initial_pose_std=(0, 0, 0))
    for method in (
        "reset",
        "predict",
        "update",
        "belief",
        "state_dict",
        "load_state_dict",
    ):
        _expect(
            callable(getattr(estimator, method, None)),
            f"{type(estimator).__name__} has no method {method}()",
        )


def _check_start(factory: Factory) -> None:
    pose, std = (1.0, -2.0, 0.5), (0.1, 0.2, 0.3)
    estimator = _make(factory, initial_pose=pose, initial_pose_std=std)
    belief = _checked_belief(estimator)
    _expect(
        np.allclose(belief.pose, pose) and belief.landmark_ids == (),
        f"belief() of a new estimator must be initial_pose and no landmark, got "
        f"{belief.pose} and landmarks {belief.landmark_ids}",
    )
    _expect(
        np.allclose(belief.pose_covariance, np.diag(np.square(std))),
        "belief().pose_covariance of a new estimator must be diag(initial_pose_std²)",
    )


def _check_motion(factory: Factory) -> None:
    estimator = _make(factory, initial_pose=(0, 0, np.pi / 2))
    estimator.predict((2.0, 0.5))
    pose = _checked_belief(estimator).pose
    _expect(
        np.allclose(pose, (0, 2, np.pi / 2 + 0.5), atol=1e-6),
        "predict((d, α)) must drive d along the old heading, then turn by α: from "
        f"(0, 0, π/2), (2, 0.5) leads to (0, 2, π/2 + 0.5), got {pose}",
    )
    once, twice = _make(factory), _make(factory)
    once.predict((0.0, 0.0), dt=2.0)
    twice.predict((0.0, 0.0))
    twice.predict((0.0, 0.0))
    _expect(
        np.allclose(once.belief().pose_covariance, twice.belief().pose_covariance),
        "predict(…, dt=2) must add the noise variance of two steps of dt=1",
    )
    _expect(
        once.belief().pose_covariance[2, 2] > 0,
        "predict() must add motion noise to the covariance of the pose",
    )


def _check_mapping(factory: Factory) -> None:
    estimator = _make(factory)
    report = estimator.update(_scan(np.zeros(3))[[2, 0]], [9, 4])
    _expect(
        isinstance(report, UpdateReport),
        f"update() must return an UpdateReport, got {type(report).__name__}",
    )
    belief = _checked_belief(estimator)
    _expect(
        set(report.added_ids) == set(belief.landmark_ids) == {9, 4},
        "update() of ids 9 and 4 must map them and report them in added_ids, got map "
        f"{belief.landmark_ids} and added_ids {report.added_ids}",
    )
    order = [belief.landmark_ids.index(9), belief.landmark_ids.index(4)]
    _expect(
        np.allclose(belief.landmarks[order], LANDMARKS[[2, 0]], atol=1e-3),
        "a landmark read exactly from a known pose must be mapped where it is: l = "
        f"(x + r cos(θ + β), y + r sin(θ + β)), got {belief.landmarks[order].tolist()}",
    )


def _check_update(factory: Factory) -> None:
    estimator = _make(factory)
    pose = _drive(estimator, steps=20)
    belief = _checked_belief(estimator)
    error = belief.pose - pose
    error[2] = wrap_angle(error[2])
    nees = float(error @ np.linalg.solve(belief.pose_covariance, error))
    _expect(
        nees < 30,
        "after 20 easy steps the error of the pose must fit its covariance: NEES "
        f"below 30 (3 is expected), got {nees:.1f}",
    )
    report = estimator.update(_scan(pose), range(4))
    _expect(
        report.degrees_of_freedom == 8 and set(report.associated_ids) == set(range(4)),
        "update() must report the 4 readings used: associated_ids and 8 degrees of "
        f"freedom, got {report.associated_ids} and {report.degrees_of_freedom}",
    )
    _expect(
        0 <= report.nis < 60,
        f"update().nis must be νᵀ S⁻¹ ν of 8 plausible readings, got {report.nis}",
    )
    after = estimator.belief()
    _expect(
        np.trace(after.covariance) <= np.trace(belief.covariance) + 1e-12,
        "update() must not make the belief less certain",
    )


def _check_second_reading(factory: Factory) -> None:
    """Read a landmark behind the robot from both sides of the jump of the bearing."""
    for bearing in (3.13, -3.13):
        estimator = _make(factory)
        estimator.update([(bearing, 3.0)], [0])
        variance = np.trace(estimator.belief().covariance)
        nis = estimator.update([(-bearing, 3.0)], [0]).nis
        belief = estimator.belief()
        error = float(np.linalg.norm(belief.landmarks - (-3.0, 0.0)))
        _expect(
            nis < 10 and error < 0.1,
            f"bearings {bearing} and {-bearing} rad are next to each other: update() "
            f"must wrap the innovation to [-π, π), got NIS {nis:.2g} and a landmark "
            f"{error:.2g} m off",
        )
        _expect(
            np.trace(belief.covariance) < variance,
            "update() must make the belief more certain: a second reading of a "
            "landmark must shrink its covariance",
        )


def _check_empty_scan(factory: Factory) -> None:
    estimator = _make(factory)
    _drive(estimator, steps=2)
    before = estimator.belief()
    no_ids: tuple[list[int] | None, ...] = ([], None)
    for ids in no_ids:
        report = estimator.update(np.empty((0, 2)), ids)
        _expect(
            _same(before, estimator.belief()) and report.degrees_of_freedom == 0,
            f"update() with no reading (ids {ids}) must leave the belief as it was",
        )


def _check_snapshots(factory: Factory) -> None:
    estimator = _make(factory)
    _drive(estimator, steps=2)
    kept = estimator.belief()
    mean, covariance = kept.mean.copy(), kept.covariance.copy()
    estimator.predict((1.0, 0.2))
    estimator.update(_scan(np.array([1.0, 0.0, 0.3])), range(4))
    estimator.belief()
    _expect(
        np.array_equal(mean, kept.mean) and np.array_equal(covariance, kept.covariance),
        "belief() must return a snapshot: a kept belief changed in later steps",
    )


def _check_refusals(factory: Factory) -> None:
    estimator = _make(factory)
    _drive(estimator, steps=2)
    before = estimator.belief()
    bad_calls: dict[str, Callable[[], object]] = {
        "predict((nan, 0))": lambda: estimator.predict((np.nan, 0.0)),
        "update() with a NaN": lambda: estimator.update([(np.nan, 1.0)], [0]),
        "update() with an infinite range": lambda: estimator.update(
            [(0.1, 2.0), (0.0, np.inf)], [0, 1]
        ),
        "update() with an id twice": lambda: estimator.update(
            _scan(np.zeros(3)), [0] * 4
        ),
        "update() with 4 readings and 1 id": lambda: estimator.update(
            _scan(np.zeros(3)), [0]
        ),
    }
    for name, call in bad_calls.items():
        try:
            call()
        except ValueError:
            _expect(
                _same(before, estimator.belief()),
                f"{name} must leave the belief as it was",
            )
        except Exception as error:
            raise EstimatorContractError(
                f"{name} must raise a ValueError, got {type(error).__name__}: {error}"
            ) from error
        else:
            raise EstimatorContractError(f"{name} must raise a ValueError")


def _check_save_and_restore(factory: Factory) -> None:
    for way, carried in (("pickle", _pickled), ("numpy.savez", _through_npz)):
        estimator, other = _make(factory), _make(factory)
        _drive(estimator, steps=5)
        try:
            other.load_state_dict(carried(estimator.state_dict()))
        except Exception as error:
            raise EstimatorContractError(
                f"load_state_dict() must take what state_dict() returned, after {way}, "
                f"got {type(error).__name__}: {error}"
            ) from error
        for each in (estimator, other):
            _drive(each, steps=3, seed=1)
        _expect(
            _same(estimator.belief(), other.belief()),
            "load_state_dict(state_dict()) must restore the estimator bit for bit: "
            f"after {way} and three steps the beliefs differ",
        )


def _pickled(state: Mapping[str, Any]) -> Mapping[str, Any]:
    carried: Mapping[str, Any] = pickle.loads(pickle.dumps(state))
    return carried


def _through_npz(state: Mapping[str, Any]) -> Mapping[str, Any]:
    """Save as arrays and load them without trusting any pickle."""
    file = BytesIO()
    np.savez(file, **state)
    file.seek(0)
    with np.load(file) as saved:
        return dict(saved)


def _check_saved_state_is_a_copy(factory: Factory) -> None:
    estimator, other = _make(factory), _make(factory)
    for each in (estimator, other):
        _drive(each, steps=5)
    _overwrite(estimator.state_dict())
    _expect(
        _same_later(estimator, other),
        "state_dict() must return copies: writing into what it returned changed the "
        "estimator",
    )
    state = other.state_dict()
    estimator.load_state_dict(state)
    _overwrite(state)
    _expect(
        _same_later(estimator, other),
        "load_state_dict() must copy: writing into what it was given changed the "
        "estimator",
    )


def _overwrite(state: Mapping[str, Any]) -> None:
    """Spoil every number in the arrays of a saved state."""
    for value in state.values():
        numbers = isinstance(value, np.ndarray) and value.dtype.kind in "biuf"
        if numbers and value.flags.writeable:
            value[...] = 77


def _same_later(one: SlamEstimator, other: SlamEstimator) -> bool:
    """Whether two estimators agree now, and after the same three steps."""
    if not _same(one.belief(), other.belief()):
        return False
    for each in (one, other):
        _drive(each, steps=3, seed=1)
    return _same(one.belief(), other.belief())


def _check_reset(factory: Factory) -> None:
    estimator = _make(factory)
    _drive(estimator, steps=5)
    estimator.reset((1.0, 2.0, 0.3), (0.0, 0.0, 0.0))
    fresh = _make(factory, initial_pose=(1.0, 2.0, 0.3))
    for each in (estimator, fresh):
        _drive(each, steps=3)
    _expect(
        _same(estimator.belief(), fresh.belief()),
        "reset() must forget the run: it must equal a new estimator",
    )


def _checked_belief(estimator: SlamEstimator) -> Belief:
    belief = estimator.belief()
    _expect(
        isinstance(belief, Belief),
        f"belief() must return a Belief, got {type(belief).__name__}",
    )
    P = belief.covariance
    _expect(bool(np.isfinite(P).all()), "belief().covariance must be finite")
    _expect(
        np.allclose(P, P.T, rtol=0, atol=1e-9), "belief().covariance must be symmetric"
    )
    _expect(
        bool(np.linalg.eigvalsh(P).min() > -1e-9),
        "belief().covariance must be positive semidefinite",
    )
    return belief


def _same(one: Belief, other: Belief) -> bool:
    return (
        one.landmark_ids == other.landmark_ids
        and np.array_equal(one.mean, other.mean)
        and np.array_equal(one.covariance, other.covariance)
    )
