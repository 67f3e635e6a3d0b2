"""Kernels of a sensor, compiled from its functions.

Kernels are written for bearing and range, entry by entry.  For another sensor they are
compiled again, with functions of that sensor in place of those of bearing and range:
`bearing_range` lists them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cache
from typing import Any

import numpy as np

from ...jit import jit, njit_allocating, njit_inlined
from ...kernel_variants import specialised
from . import bearing_range
from .bearing_range import wrap_angle_jit
from .sensors import BEARING_RANGE, Noise, Numbers, Sensor

Kernel = Callable[..., Any]


@cache
def for_sensor(kernel: Any, sensor: Sensor) -> Any:
    """Return a kernel as it is for another sensor than ``bearing_range``.

    Parameters
    ----------
    kernel : callable
        A kernel for bearing and range.
    sensor : Sensor
        The sensor of its readings.
    """
    if sensor == BEARING_RANGE:
        return kernel
    return specialised(kernel, kernel_parts(sensor), sensor.name)


@cache
def kernel_parts(sensor: Sensor) -> Mapping[Kernel, Kernel]:
    """Return a sensor's counterpart of each function in a kernel that is for readings.

    See :mod:`.bearing_range` for what each of them returns.  They count references,
    because functions of a user may return arrays.
    """
    h, std, (first, second) = njit_allocating(sensor.h), sensor.std, sensor.wraps
    std, is_single, places = njit_allocating(std), sensor.size == 1, sensor.places
    inverse = njit_allocating(sensor.inverse or _nowhere)

    def expected(dx: float, dy: float, heading: float) -> Numbers:
        cos, sin = np.cos(heading), np.sin(heading)
        (z0, z1), _ = h(cos * dx + sin * dy, cos * dy - sin * dx)
        return z0, z1

    def slopes(dx: float, dy: float, heading: float) -> tuple[float, ...]:
        cos, sin = np.cos(heading), np.sin(heading)
        x, y = cos * dx + sin * dy, cos * dy - sin * dx
        _, (ax, ay, bx, by) = h(x, y)
        a = ax * cos - ay * sin, ax * sin + ay * cos
        b = bx * cos - by * sin, bx * sin + by * cos
        return a[0], a[1], b[0], b[1], ax * y - ay * x, bx * y - by * x

    def difference(z0: float, z1: float, e0: float, e1: float) -> Numbers:
        d0, d1 = z0 - e0, z1 - e1
        d0 = wrap_angle_jit(d0) if first else d0
        d1 = wrap_angle_jit(d1) if second else d1
        return d0, 0.0 if is_single else d1

    def distance(z0: float, z1: float) -> float:
        x, y = inverse(z0, z1)
        return float(np.sqrt(x * x + y * y))

    def variances(noise: Noise, distance: float) -> Numbers:
        s0, s1 = std(noise, distance)
        return s0 * s0, 1.0 if is_single else s1 * s1

    def placed(
        pose: tuple[float, float, float], z0: float, z1: float, v0: float, v1: float
    ) -> tuple[float, ...]:
        cos, sin = np.cos(pose[2]), np.sin(pose[2])
        x, y = inverse(z0, z1)
        _, (ax, ay, bx, by) = h(x, y)
        per = 1 / (ax * by - ay * bx)
        ux, uy, wx, wy = by * per, -bx * per, -ay * per, ax * per  # columns of D⁻¹
        ux, uy, wx, wy = (
            *(cos * ux - sin * uy, sin * ux + cos * uy),
            *(cos * wx - sin * wy, sin * wx + cos * wy),
        )
        dx, dy = cos * x - sin * y, sin * x + cos * y
        xy = ux * uy * v0 + wx * wy * v1
        return (
            *(pose[0] + dx, pose[1] + dy, -dy, dx),
            *(ux * ux * v0, wx * wx * v1, xy, uy * uy * v0, wy * wy * v1),
        )

    def places_at_once() -> bool:
        return places

    return {
        bearing_range.expected_reading_jit: jit(expected),
        bearing_range.pose_slopes_jit: jit(slopes),
        bearing_range.difference_jit: njit_inlined(difference),
        bearing_range.read_distance_jit: jit(distance),
        bearing_range.reading_variances_jit: jit(variances),
        bearing_range.placed_jit: jit(placed),
        bearing_range.places_at_once_jit: njit_inlined(places_at_once),
    }


def _nowhere(z0: float, z1: float) -> tuple[float, float]:
    """Return infinity, in place of a landmark that a reading does not determine."""
    return z0 + np.inf, z1 + np.inf
