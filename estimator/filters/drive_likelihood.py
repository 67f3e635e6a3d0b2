"""Likelihood of a drive's readings under given noises, from a filter's innovations."""

from __future__ import annotations

from functools import partial

import numpy as np
from numpy.typing import ArrayLike

from ...arrays import LARGEST, Array, IntArray
from ..kernels import drive_likelihood as kernel
from ..kernels.batch import share_out
from ..kernels.kalman_gain import SKIPPED
from ..models.bearing_range import wrap_angle
from ..models.sensors import only_bearing_range
from ..support import argument_checks
from ..support.argument_checks import aligned_zeros, usable_cores
from .batch import can_batch
from .ekf import EkfSlam
from .gaussian_map import GaussianMap, workspace_for

# NIS beyond which a reading is rejected: a share e⁻¹⁵ of them if the noise is right.
GATE = 30.0


def drive_likelihood(
    estimator: EkfSlam,
    events: kernel.DriveEvents,
    noises: ArrayLike,
    *,
    gate: float = GATE,
    keep_beliefs: bool = False,
    threads: int | None = None,
) -> kernel.DriveRecord:
    """Filter a drive under several noises; return how likely its readings are [1]_.

    ::

        log p(z) = −½ Σ (νᵀ S⁻¹ ν + log det S + 2m log 2π)

    over the scans, of the m readings in use.  The sum has a robust tail: a reading
    whose own NIS is beyond the gate is rejected, and counts as one at the gate.  The
    first reading of a landmark does not count.  A pass that fails has -inf from there.

    Parameters
    ----------
    estimator : EkfSlam
        Filter at its start, for its rules and its first belief; one that can run in
        batches.
    events : DriveEvents
        The drive; see :func:`check_events`.
    noises : array_like, shape (B, 7)
        Standard deviations σx, σy, σα per step of dt = 1 [m, m, rad], σβ [rad], σr [m],
        the part of σr that grows with the range [m/m], and the part of σβ that shrinks
        with it [m].
    gate : float
        The largest NIS of one reading.
    keep_beliefs : bool
        Whether the record holds poses, their covariances, and the innovation of every
        reading too.
    threads : int, optional
        By default, the number of cores.

    Returns
    -------
    DriveRecord
        Of the B passes; each has the same bits as alone.

    References
    ----------
    .. [1] F. C. Schweppe, Evaluation of likelihood functions for Gaussian signals, IEEE
       Trans. Information Theory 11(1), 1965.

    Examples
    --------
    >>> from slamgym.estimator import EkfSlam
    >>> from slamgym.estimator.kernels.drive_likelihood import DriveEvents
    >>> events = DriveEvents(
    ...     motions=np.array([[2.0, 0.0, 1.0]]),
    ...     first_motions=np.array([0, 0, 1]),
    ...     readings=np.array([[0.0, 5.0], [0.0, 3.2]]),
    ...     landmarks=np.array([0, 0]),
    ...     first_readings=np.array([0, 1, 2]),
    ... )
    >>> slam = EkfSlam(motion_std=(0.1,) * 3, measurement_std=(0.1, 0.1))
    >>> noises = [(0.1, 0.1, 0.1, 0.1, sigma, 0.0, 0.0) for sigma in (0.01, 0.1)]
    >>> record = drive_likelihood(slam, events, noises)
    >>> record.log_likelihoods.sum(axis=1).round(2)
    array([0.  , 0.76])
    """
    if not can_batch(estimator):
        raise ValueError(
            f"{type(estimator).__name__} is not one of the filters on the shared "
            "kernels, which can compute innovations for many noises at once"
        )
    only_bearing_range(estimator.sensor, "drive_likelihood")
    values = argument_checks.as_floats("noises", noises)
    if values.ndim != 2 or values.shape[1] != kernel.NOISE_WIDTH:
        raise ValueError(
            f"noises must have shape (B, {kernel.NOISE_WIDTH}), got "
            f"shape {values.shape}"
        )
    check_events(events)
    record = _new_record(len(values), events, keep_beliefs)
    work = partial(_follow, estimator, events, values, gate, record)
    share_out(work, len(values), threads or usable_cores())
    record.poses[..., 2] = wrap_angle(record.poses[..., 2])
    return record


def check_events(events: kernel.DriveEvents) -> None:
    """Refuse events of a drive that the kernels cannot process.

    Raises
    ------
    ValueError
        If a number is not usable, or the parts do not fit together.
    """
    _refuse_numbers("motions", events.motions, 3)
    _refuse_numbers("readings", events.readings, 2)
    _refuse_firsts("first_motions", events.first_motions, len(events.motions))
    _refuse_firsts("first_readings", events.first_readings, len(events.readings))
    if len(events.first_motions) != len(events.first_readings):
        raise ValueError("first_motions and first_readings must have one length")
    if len(events.landmarks) != len(events.readings):
        raise ValueError("landmarks must have one entry for each reading")
    if len(events.landmarks) and events.landmarks.min() < 0:
        raise ValueError("landmarks must be numbered from 0")


def _refuse_numbers(name: str, numbers: Array, columns: int) -> None:
    if numbers.ndim != 2 or numbers.shape[1] != columns:
        raise ValueError(f"{name} must have {columns} columns, got {numbers.shape}")
    usable = (np.abs(numbers) <= LARGEST).all(axis=1)
    if not usable.all():
        row = int(np.argmin(usable))
        raise ValueError(
            f"{name} must be finite numbers, at most {LARGEST:g}, "
            f"got {numbers[row].tolist()} in row {row}"
        )


def _refuse_firsts(name: str, firsts: IntArray, rows: int) -> None:
    is_whole = len(firsts) > 0 and firsts[0] == 0 and firsts[-1] == rows
    if not is_whole or (np.diff(firsts) < 0).any():
        raise ValueError(f"{name} must rise from 0 to {rows}, got {firsts.tolist()}")


def _new_record(
    count: int, events: kernel.DriveEvents, keep_beliefs: bool
) -> kernel.DriveRecord:
    steps = len(events.first_motions) - 1
    kept, readings = (steps, len(events.readings)) if keep_beliefs else (0, 0)
    return kernel.DriveRecord(
        np.zeros((count, steps)),
        np.zeros((count, steps)),
        np.zeros((count, steps), dtype=np.int64),
        np.zeros(count, dtype=np.int64),
        np.full((count, kept, 3), np.nan),
        np.full((count, kept, 3, 3), np.nan),
        np.full((count, readings, 2), np.nan),
        np.full((count, readings), SKIPPED, dtype=np.int64),
    )


def _follow(
    estimator: EkfSlam,
    events: kernel.DriveEvents,
    noises: Array,
    gate: float,
    record: kernel.DriveRecord,
    part: slice,
) -> None:
    """Fill a part of a record, with room of its own."""
    landmarks = int(events.landmarks.max(initial=-1)) + 1
    capacity = GaussianMap.capacity_for(landmarks)
    most = int(np.diff(events.first_readings).max(initial=0))
    belief = np.zeros(capacity), aligned_zeros(capacity, capacity), np.zeros(capacity)
    first, motion = estimator.map, estimator.motion_values
    rules = estimator.rules._replace(gate=gate)
    *odometry, dt = events.motions.T
    moved = estimator.motion.displacements(np.column_stack(odometry))
    events = events._replace(motions=np.column_stack([moved, dt]))
    kernel.follow_drive(
        tuple(events),  # numba checks the type of a named one at every call
        noises[part],
        bool(motion[3] > 0),
        np.array(rules),
        (first.mean[:3].copy(), first.covariance[:3, :3].copy()),
        belief,
        tuple(workspace_for(rules, most, capacity)),
        np.empty(landmarks, dtype=np.int64),
        tuple(array[part] for array in record),
    )
