"""The actual noise of a world, divided by the noise that a filter assumes.

If the truth is known, all noise values are known: the motion noise is the true motion
minus the odometry, and the sensor noise is the reading minus the true bearing or range.
Each is divided by the standard deviation that the filter assumes. In a world without
faults, the resulting numbers are independent and standard normal, over time as well as
over runs.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ..arrays import Array, BoolArray, IntArray
from ..estimator.models.bearing_range import wrap_angle
from ..estimator.support import argument_checks

CHANNELS = ("along", "sideways", "turn", "bearing", "range")
"""The five noises: εx, εy, εα of the motion, εβ, εr of the readings."""
MOMENTS = ("count", "first", "second", "third", "fourth", "slope", "leverage")
"""Sums over w, the standardised noise of a channel in a run: 1, w, w², w³, w⁴, and
g w, g², where a bias b adds b g: g = d/σx along, so that b is a scale, else 1/σ. That
of d which has no noise counts, odometry or true distance."""
_ROUNDING = 1e-9
_LEAST_STD = 1e-6  # in place of 0, where the world has noise


class _Noise(NamedTuple):
    """Numbers of one channel, all runs; each is of the run in ``runs``."""

    values: Array
    std: Array | float
    lever: Array | float
    runs: IntArray


def noise_sums(
    true_poses: ArrayLike,
    landmarks: ArrayLike,
    odometry: ArrayLike,
    measurements: ArrayLike,
    visible: ArrayLike,
    *,
    motion_std: ArrayLike,
    measurement_std: ArrayLike,
    range_std_per_metre: float = 0.0,
    noise_in: Literal["motion", "odometry"] = "motion",
    noisy_steps: ArrayLike | None = None,
) -> Array:
    """Sum powers of the standardised noise of B runs of T scans among L landmarks.

    With Δ the true displacement and d, α the odometry::

        (εx, εy) = R(θ)ᵀ Δ − (d, 0),    εα = Δθ − α,    (εβ, εr) = z − h(x, l)

    Parameters
    ----------
    true_poses : array_like, shape (B, T, 3)
        At each scan [m, m, rad].
    landmarks : array_like, shape (B, L, 2)
        True positions [m].
    odometry : array_like, shape (B, T, 2)
        (d, α) before each scan [m, rad]; that before the first is not used.
    measurements : array_like, shape (B, T, L, 2)
        Rows (β, r) [rad, m].
    visible : array_like of bool, shape (B, T, L)
        Which of them are readings.
    motion_std, measurement_std, range_std_per_metre
        What the filter assumes, as in :func:`~slamgym.estimator.make_estimator`.
    noise_in : {"motion", "odometry"}
        Whether the robot slips, or its encoders err: the other one is exact.
    noisy_steps : array_like of bool, shape (B, T), optional
        Steps whose motion noise counts; all by default.

    Returns
    -------
    ndarray, shape (B, 5, 7)
        By run, `CHANNELS` and `MOMENTS`.  A channel has zeros if it has no noise and
        the filter assumes none.

    Raises
    ------
    ValueError
        If shapes do not fit, or a deviation is negative.
    """
    argument_checks.one_of("noise_in", noise_in, ("motion", "odometry"))
    poses = argument_checks.as_floats("true_poses", true_poses)
    if poses.ndim != 3 or poses.shape[-1] != 3:
        raise ValueError(f"true_poses must be shape (B, T, 3), got {poses.shape}")
    shape = poses.shape[:2]
    points = argument_checks.as_floats("landmarks", landmarks)
    seen = np.asarray(visible, dtype=np.bool_)
    moved = _shaped("odometry", odometry, (*shape, 2))
    if seen.shape != (*shape, points.shape[1]) or len(points) != len(poses):
        raise ValueError(
            f"visible must be shape {(*shape, points.shape[1])}, got {seen.shape}"
        )
    readings = _shaped("measurements", measurements, (*seen.shape, 2))
    motion = argument_checks.standard_deviations("motion_std", motion_std, 3)
    sensor = argument_checks.standard_deviations("measurement_std", measurement_std, 2)
    steps = np.ones(shape, bool) if noisy_steps is None else np.asarray(noisy_steps)
    channels = [
        *_motion_noise(poses, moved, steps, motion, noise_in == "motion"),
        *_sensor_noise(poses, points, readings, seen, sensor, range_std_per_metre),
    ]
    return np.stack([_summed(noise, len(poses)) for noise in channels], axis=1)


def _shaped(name: str, value: ArrayLike, shape: tuple[int, ...]) -> Array:
    array = argument_checks.as_floats(name, value)
    if array.shape != shape:
        raise ValueError(f"{name} must be shape {shape}, got {array.shape}")
    return array


def _motion_noise(
    poses: Array, odometry: Array, steps: BoolArray, std: Array, slips: bool
) -> list[_Noise]:
    run, step = np.nonzero(steps[:, 1:])
    before, after = poses[run, step], poses[run, step + 1]
    driven, turned = odometry[run, step + 1].T
    dx, dy = (after - before)[:, :2].T
    cos, sin = np.cos(before[:, 2]), np.sin(before[:, 2])
    ahead = cos * dx + sin * dy
    errors = (
        ahead - driven,
        cos * dy - sin * dx,
        wrap_angle(after[:, 2] - before[:, 2] - turned),
    )
    levers = driven if slips else ahead, 1.0, 1.0
    return [
        _Noise(error, sigma, lever, run)
        for error, sigma, lever in zip(errors, std.tolist(), levers, strict=True)
    ]


def _sensor_noise(
    poses: Array,
    landmarks: Array,
    readings: Array,
    visible: BoolArray,
    std: Array,
    per_metre: float,
) -> list[_Noise]:
    run, step, landmark = np.nonzero(visible)
    dx, dy = (landmarks[run, landmark] - poses[run, step, :2]).T
    bearing, distance = readings[run, step, landmark].T
    expected = np.arctan2(dy, dx) - poses[run, step, 2], np.hypot(dx, dy)
    bearing_error = wrap_angle(bearing - expected[0])
    range_std = std[1] + per_metre * expected[1]
    return [
        _Noise(bearing_error, float(std[0]), 1.0, run),
        _Noise(distance - expected[1], range_std, 1.0, run),
    ]


def _summed(noise: _Noise, count: int) -> Array:
    """Sum the moments of a channel by run, shape (count, 7)."""
    std = np.broadcast_to(noise.std, noise.values.shape)
    if not std.any() and (np.abs(noise.values) < _ROUNDING).all():
        return np.zeros((count, len(MOMENTS)))
    std = np.where(std > 0, std, _LEAST_STD)
    w, g = noise.values / std, noise.lever / std
    terms = (np.ones_like(w), w, w**2, w**3, w**4, g * w, g**2)
    return np.stack(
        [np.bincount(noise.runs, term, minlength=count) for term in terms], axis=1
    )
