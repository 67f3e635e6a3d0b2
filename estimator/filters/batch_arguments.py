"""Checks of the arguments of a batch of runs."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from ...arrays import Array, BoolArray
from ..kernels.batch import StepData
from ..support import argument_checks


def step_data(
    odometry: ArrayLike,
    measurements: ArrayLike,
    visible: ArrayLike,
    dt: ArrayLike,
    shape: tuple[int, int],
) -> tuple[StepData, Array]:
    """Return the data of T steps and their durations (T,), or refuse them.

    ``shape`` is (B, L), the numbers of runs and landmarks.
    """
    (count, landmarks), u = shape, argument_checks.as_floats("odometry", odometry)
    steps = u.shape[1] if u.ndim == 3 else 0
    z = argument_checks.as_floats("measurements", measurements)
    seen = np.ascontiguousarray(visible, dtype=np.bool_)
    for name, array, expected in (
        ("odometry", u, (count, steps, 2)),
        ("measurements", z, (count, steps, landmarks, 2)),
        ("visible", seen, (count, steps, landmarks)),
    ):
        if array.shape != expected:
            raise ValueError(f"{name} must have shape {expected}, got {array.shape}")
    durations = np.ascontiguousarray(
        np.broadcast_to(np.asarray(dt, dtype=np.float64), (steps,))
    )
    if not (np.isfinite(durations) & (durations >= 0)).all():
        raise ValueError(f"dt must be finite numbers >= 0, got {dt!r}")
    return StepData(u, z, seen), durations


def chosen_runs(runs: ArrayLike | None, count: int) -> BoolArray:
    """Return which of the runs are chosen, shape (B,); all for None."""
    if runs is None:
        return np.ones(count, dtype=np.bool_)
    chosen = np.asarray(runs)
    if chosen.shape != (count,) or chosen.dtype != np.bool_:
        raise ValueError(
            f"runs must be {count} booleans, got {chosen.dtype} with shape "
            f"{chosen.shape}"
        )
    return chosen


def first_poses(name: str, poses: ArrayLike, count: int) -> Array:
    """Return the first pose of every run, shape (B, 3), or refuse them."""
    first = argument_checks.as_floats(name, poses)
    if first.shape not in ((3,), (count, 3)) or not np.isfinite(first).all():
        raise ValueError(
            f"{name} must be finite with shape (3,) or ({count}, 3), "
            f"got shape {first.shape}"
        )
    return np.broadcast_to(first, (count, 3))
