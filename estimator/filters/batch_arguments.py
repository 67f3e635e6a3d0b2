"""Checks of the arguments of a batch of runs."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ...arrays import LARGEST, Array, BoolArray
from ..kernels.batch import RunArrays, StepData
from ..support import argument_checks, saved_states
from .batch_results import BatchBeliefs


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
    durations = argument_checks.as_floats("dt", dt)
    if durations.shape not in ((), (1,), (steps,)):
        raise ValueError(
            f"dt must be one number or {steps}, got shape {durations.shape}"
        )
    durations = np.ascontiguousarray(np.broadcast_to(durations, (steps,)))
    if not (np.isfinite(durations) & (durations >= 0)).all():
        raise ValueError(f"dt must be finite numbers >= 0, got {dt!r}")
    argument_checks.refuse_beyond("dt", durations, dt)
    return StepData(u, z, seen), durations


def step_scans(
    odometry: ArrayLike,
    measurements: ArrayLike,
    visible: ArrayLike,
    dt: ArrayLike,
    shape: tuple[int, int],
) -> tuple[Array, Array, BoolArray, Array]:
    """Return the data of one step and its durations, or refuse them.

    ``shape`` is (B, L), the numbers of runs and landmarks.
    """
    (count, landmarks), u = shape, argument_checks.as_floats("odometry", odometry)
    z = argument_checks.as_floats("measurements", measurements)
    seen = np.ascontiguousarray(visible, dtype=np.bool_)
    durations = argument_checks.as_floats("dt", dt)
    for name, array, expected in (
        ("odometry", u, (count, 2)),
        ("measurements", z, (count, landmarks, 2)),
        ("visible", seen, (count, landmarks)),
        ("dt", durations, (count,)),
    ):
        if array.shape != expected:
            raise ValueError(f"{name} must have shape {expected}, got {array.shape}")
    if not (durations.min() >= 0.0 and durations.max() <= LARGEST):
        raise ValueError(
            f"dt must be finite numbers >= 0 and at most {LARGEST:g}, got {dt!r}"
        )
    return u, z, seen, durations


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


class LoadedBeliefs(NamedTuple):
    """Beliefs that have been checked; arrays as in `BatchBeliefs`."""

    means: Array
    covariances: Array
    references: Array
    mapped: BoolArray

    def write(self, run: int, arrays: RunArrays) -> None:
        """Replace the belief of a run; its landmarks are stored in order of id."""
        ids = np.flatnonzero(self.mapped[run])
        at = [0, 1, 2, *(3 + 2 * i + axis for i in ids.tolist() for axis in (0, 1))]
        size = len(at)
        for array in arrays[:3]:
            array[run] = 0.0
        arrays.means[run, :size] = self.means[run, at]
        arrays.references[run, :size] = self.references[run, at]
        arrays.covariances[run, :size, :size] = self.covariances[run][np.ix_(at, at)]
        arrays.slots[run] = -1
        arrays.slots[run, ids] = np.arange(len(ids))
        arrays.mapped[run] = len(ids)


def checked_beliefs(
    beliefs: BatchBeliefs,
    references: ArrayLike | None,
    runs: BoolArray,
    landmarks: int,
) -> LoadedBeliefs:
    """Return beliefs of B runs over L landmarks, or refuse those of the chosen runs."""
    count, size = len(runs), 3 + 2 * landmarks
    means = argument_checks.as_floats("beliefs.means", beliefs.means)
    covariances = argument_checks.as_floats("beliefs.covariances", beliefs.covariances)
    points = means
    if references is not None:
        points = argument_checks.as_floats("references", references)
    mapped = np.asarray(beliefs.mapped)
    for name, array, shape in (
        ("beliefs.means", means, (count, size)),
        ("beliefs.covariances", covariances, (count, size, size)),
        ("beliefs.mapped", mapped, (count, landmarks)),
        ("references", points, (count, size)),
    ):
        if array.shape != shape:
            raise ValueError(f"{name} must have shape {shape}, got {array.shape}")
    if mapped.dtype != np.bool_:
        raise ValueError(f"beliefs.mapped must be booleans, got {mapped.dtype}")
    for run in np.flatnonzero(runs).tolist():
        problem = _problem(means[run], covariances[run], points[run])
        if problem:
            raise ValueError(f"{problem} in run {run}")
    return LoadedBeliefs(means, covariances, points, mapped)


def _problem(mean: Array, covariance: Array, reference: Array) -> str | None:
    """Return the error of a belief, or None."""
    for name, array in (
        ("beliefs.means", mean),
        ("beliefs.covariances", covariance),
        ("references", reference),
    ):
        if not np.isfinite(array).all():
            return f"{name} must be finite, but is not"
    if not np.array_equal(covariance, covariance.T):
        return "beliefs.covariances must be symmetric, but is not"
    if not saved_states.is_semidefinite(covariance):
        least = float(np.linalg.eigvalsh(covariance)[0])
        return (
            "beliefs.covariances must be positive semidefinite, but has the "
            f"eigenvalue {least:.3g}"
        )
    return None


def first_poses(name: str, poses: ArrayLike, count: int) -> Array:
    """Return the first pose of every run, shape (B, 3), or refuse them."""
    first = argument_checks.as_floats(name, poses)
    if first.shape == (count, 3) and np.abs(first).max() <= LARGEST:
        return first
    if first.shape not in ((3,), (count, 3)) or not np.isfinite(first).all():
        raise ValueError(
            f"{name} must be finite with shape (3,) or ({count}, 3), "
            f"got shape {first.shape}"
        )
    argument_checks.refuse_beyond(name, first, poses)
    return np.broadcast_to(first, (count, 3))
