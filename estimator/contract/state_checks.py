"""Checks of snapshots, refused arguments, saved states and new runs."""

import pickle
from collections.abc import Callable, Mapping
from io import BytesIO
from typing import Any

import numpy as np

from ..interface import SlamEstimator
from .trial_drive import (
    EstimatorContractError,
    Factory,
    drive,
    expect,
    make,
    same_beliefs,
    scan,
)


def check_snapshots(factory: Factory) -> None:
    """Check that a belief does not change in later steps."""
    estimator = make(factory)
    drive(estimator, steps=2)
    kept = estimator.belief()
    mean, covariance = kept.mean.copy(), kept.covariance.copy()
    estimator.predict((1.0, 0.2))
    estimator.update(scan(np.array([1.0, 0.0, 0.3])), range(4))
    estimator.belief()
    expect(
        np.array_equal(mean, kept.mean) and np.array_equal(covariance, kept.covariance),
        "belief() must return a snapshot: a kept belief changed in later steps",
    )


def check_refusals(factory: Factory) -> None:
    """Check that malformed arguments raise a ValueError and change nothing."""
    estimator = make(factory)
    drive(estimator, steps=2)
    before = estimator.belief()
    bad_calls: dict[str, Callable[[], object]] = {
        "predict((nan, 0))": lambda: estimator.predict((np.nan, 0.0)),
        "update() with a NaN": lambda: estimator.update([(np.nan, 1.0)], [0]),
        "update() with an infinite range": lambda: estimator.update(
            [(0.1, 2.0), (0.0, np.inf)], [0, 1]
        ),
        "update() with an id twice": lambda: estimator.update(
            scan(np.zeros(3)), [0] * 4
        ),
        "update() with 4 readings and 1 id": lambda: estimator.update(
            scan(np.zeros(3)), [0]
        ),
    }
    for name, call in bad_calls.items():
        try:
            call()
        except ValueError:
            expect(
                same_beliefs(before, estimator.belief()),
                f"{name} must leave the belief as it was",
            )
        except Exception as error:
            raise EstimatorContractError(
                f"{name} must raise a ValueError, got {type(error).__name__}: {error}"
            ) from error
        else:
            raise EstimatorContractError(f"{name} must raise a ValueError")


def check_save_and_restore(factory: Factory) -> None:
    """Check that a saved state continues bit for bit."""
    for way, carried in (("pickle", _pickled), ("numpy.savez", _through_npz)):
        estimator, other = make(factory), make(factory)
        drive(estimator, steps=5)
        try:
            other.load_state_dict(carried(estimator.state_dict()))
        except Exception as error:
            raise EstimatorContractError(
                f"load_state_dict() must take what state_dict() returned, after {way}, "
                f"got {type(error).__name__}: {error}"
            ) from error
        for each in (estimator, other):
            drive(each, steps=3, seed=1)
        expect(
            same_beliefs(estimator.belief(), other.belief()),
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


def check_saved_state_is_a_copy(factory: Factory) -> None:
    """Check that a saved state shares no memory with the estimator."""
    estimator, other = make(factory), make(factory)
    for each in (estimator, other):
        drive(each, steps=5)
    _overwrite(estimator.state_dict())
    expect(
        _same_later(estimator, other),
        "state_dict() must return copies: writing into what it returned changed the "
        "estimator",
    )
    state = other.state_dict()
    estimator.load_state_dict(state)
    _overwrite(state)
    expect(
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
    if not same_beliefs(one.belief(), other.belief()):
        return False
    for each in (one, other):
        drive(each, steps=3, seed=1)
    return same_beliefs(one.belief(), other.belief())


def check_reset(factory: Factory) -> None:
    """Check that a reset estimator equals a new one."""
    estimator = make(factory)
    drive(estimator, steps=5)
    estimator.reset((1.0, 2.0, 0.3), (0.0, 0.0, 0.0))
    fresh = make(factory, initial_pose=(1.0, 2.0, 0.3))
    for each in (estimator, fresh):
        drive(each, steps=3)
    expect(
        same_beliefs(estimator.belief(), fresh.belief()),
        "reset() must forget the run: it must equal a new estimator",
    )
