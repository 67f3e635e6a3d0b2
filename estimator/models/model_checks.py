"""Tests of a sensor or a drive that somebody has written."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from ...arrays import Array
from .bearing_range import expected_reading_jit
from .motions import Motion, find_motion
from .sensor_kernels import kernel_parts
from .sensors import Sensor, find_sensor, two_stds


class SensorContractError(AssertionError):
    """Raised for a sensor whose functions contradict each other."""


def check_sensor(
    sensor: str | Sensor, measurement_std: ArrayLike = (0.1, 0.1), trials: int = 200
) -> None:
    """Check slopes, inverse, angles, noise and compiled code of a sensor.

    Parameters
    ----------
    sensor : str or Sensor
        The sensor.
    measurement_std : array_like, shape (1,) or (2,)
        Noise to try.
    trials : int
        Number of landmarks to try, in the field of view, from 0.1 to 100 m away.

    Raises
    ------
    ValueError
        If filters would refuse the noise.
    SensorContractError
        At the first contradiction, naming the number and where it was seen.
    """
    checked = find_sensor(sensor)
    noise = two_stds(checked, measurement_std)
    rng = np.random.default_rng(0)
    r, half = 10 ** rng.uniform(-1, 2, trials), checked.field_of_view / 2
    turn = rng.uniform(-half, half, trials)
    x, y = r * np.cos(turn), r * np.sin(turn)
    _check_arrays(checked, x, y)
    _check_slopes(checked, x, y)
    _check_angles(checked, x, y)
    _check_inverse(checked, x, y)
    _check_std(checked, noise, r)
    _check_compiled(checked, x, y)


def _refuse(sensor: Sensor, what: str) -> None:
    raise SensorContractError(f"sensor '{sensor.name}': {what}")


def _name(sensor: Sensor, column: int) -> str:
    return sensor.columns[column] if column < sensor.size else "the unused number"


def _check_arrays(sensor: Sensor, x: Array, y: Array) -> None:
    """Look for functions of numbers alone, such as those of `math`."""
    name = "h"
    try:
        readings = sensor.read(x, y)
        sensor.slopes(x, y)
        name = "inverse"
        if sensor.inverse is not None:
            sensor.inverse(*readings.T)
    except (TypeError, ValueError) as error:
        _refuse(
            sensor,
            f"{name} must accept arrays: use functions of numpy, not of math, and no "
            f"if ({error})",
        )


def _check_slopes(sensor: Sensor, x: Array, y: Array) -> None:
    given, step = sensor.slopes(x, y), 1e-6 * np.hypot(x, y)
    for axis, (mx, my) in enumerate(((step, 0 * step), (0 * step, step))):
        ahead, behind = sensor.read(x + mx, y + my), sensor.read(x - mx, y - my)
        numeric = sensor.difference(ahead, behind) / (2 * step[:, None])
        scale = 1e-6 * (1 + np.abs(numeric)) + 1e-15 / step[:, None]
        wrong = ~(np.abs(given[:, :, axis] - numeric) <= scale)
        if sensor.size == 1:
            wrong[:, 1] = given[:, 1, axis] != 0
        if wrong.any():
            k, column = np.argwhere(wrong)[0]
            _refuse(
                sensor,
                f"∂{_name(sensor, column)}/∂{'xy'[axis]} at ({x[k]:.3g}, {y[k]:.3g}) "
                f"is {numeric[k, column]:.6g} by finite differences, "
                f"but h returns {given[k, column, axis]:.6g}",
            )


def _check_angles(sensor: Sensor, x: Array, y: Array) -> None:
    """Compare the entries of angles with units, values, and jumps around the robot."""
    spans = np.ptp(sensor.read(x, y), axis=0)
    for column in range(sensor.size):
        unit, span, is_angle = sensor.units[column], spans[column], sensor.wraps[column]
        jumps = _jumps_by_a_turn(sensor, column)
        if jumps and not is_angle:
            what = "jumps by 2π around the robot"
        elif is_angle and not unit.startswith("rad"):
            what = f"has the unit '{unit}', but only radians are wrapped"
        elif is_angle and not jumps and span > 2 * np.pi:
            what = f"varies by {span:.3g} and never jumps by 2π"
        else:
            continue
        what += f": set its entry of angles to {not is_angle}"
        _refuse(sensor, f"{_name(sensor, column)} {what}")


def _jumps_by_a_turn(sensor: Sensor, column: int) -> bool:
    """Return whether a number jumps by 2π, except at a pole, in view at 3 m."""

    def read(turn: Array) -> Array:
        return sensor.read(3 * np.cos(turn), 3 * np.sin(turn))[:, column]

    view = sensor.field_of_view
    first = 0.0 if view == 2 * np.pi else -view / 2  # a circle begins where h is smooth
    ends = np.linspace(first, first + view, 721)
    low, high = ends[:-1], ends[1:]
    for _ in range(30):  # halve each step, keep the half that changes more
        middle = (low + high) / 2
        at_low, at_middle, at_high = read(low), read(middle), read(high)
        later = np.abs(at_high - at_middle) > np.abs(at_middle - at_low)
        low, high = np.where(later, middle, low), np.where(later, high, middle)
    jumps = np.abs(read(high) - read(low))
    return bool((np.abs(jumps - 2 * np.pi) < 1e-3).any())


def _check_inverse(sensor: Sensor, x: Array, y: Array) -> None:
    if sensor.inverse is None:
        return
    found = np.stack(sensor.inverse(*sensor.read(x, y).T), axis=-1)
    off = np.hypot(found[:, 0] - x, found[:, 1] - y) / np.hypot(x, y)
    if not (off <= 1e-6).all():
        k = int(np.argmax(~(off <= 1e-6)))
        _refuse(
            sensor,
            f"inverse of the reading of ({x[k]:.3g}, {y[k]:.3g}) is "
            f"({found[k, 0]:.3g}, {found[k, 1]:.3g})",
        )


def _check_std(sensor: Sensor, noise: Array, distances: Array) -> None:
    for distance in distances.tolist():
        std = sensor.std(sensor.noise(noise), distance)
        used = std[: sensor.size]
        if len(std) != 2 or not all(np.isfinite(std)) or not min(used) > 0:
            _refuse(
                sensor,
                f"std must return two finite numbers > 0 at {distance:.3g} m for "
                f"measurement_std {noise.tolist()}, got {std}",
            )


def _check_compiled(sensor: Sensor, x: Array, y: Array) -> None:
    expected = kernel_parts(sensor)[expected_reading_jit]
    for k in range(len(x)):
        compiled = expected(float(x[k]), float(y[k]), 0.0)
        plain = sensor.read(x[k : k + 1], y[k : k + 1])[0]
        if not np.allclose(sensor.difference(compiled, plain), 0, atol=1e-9):
            _refuse(sensor, f"h returns {compiled} if compiled, but {plain} in numpy")


# --------------------------------------------------------------------------------------
# Test of a drive.


def check_motion(motion: str | Motion, trials: int = 1000) -> None:
    """Test a drive with random odometry.

    It checks that rest moves nothing, that results are finite, that arrays give the
    same as numbers, and that the displacement is smooth: a filter takes its derivative
    by the noise as constant.

    Parameters
    ----------
    motion : str or Motion
        The drive.
    trials : int
        Number of random readings, with both numbers in [−1, 1].

    Raises
    ------
    ValueError
        With the first mistake found.
    """
    model, rng = find_motion(motion), np.random.default_rng(0)
    odometry = np.vstack([np.zeros(2), rng.uniform(-1.0, 1.0, (trials, 2))])
    kept = odometry.copy()
    moved = model.displacements(odometry)
    mistakes = {
        "must not write into its arguments": not np.array_equal(kept, odometry),
        "must return the same values for arrays as for numbers": not np.allclose(
            [model.displacement(*row) for row in odometry.tolist()], moved, atol=1e-12
        ),
        "must be finite": not np.isfinite(moved).all(),
    }
    steps = model.displacements(odometry + 1e-6) - moved
    mistakes[
        "must be smooth: a change of 1e-6 in the odometry changes it by more than 1e-3"
    ] = np.abs(steps).max() > 1e-3
    for mistake, made in mistakes.items():
        if made:
            raise ValueError(f"the displacement of motion '{model.name}' {mistake}")
