"""The bearing-range sensor: which landmarks it sees, and its readings.

`BearingRangeSensor` measures the landmarks in view; `LineOfSight` finds those that a
wall hides, and `hide_identities` shuffles readings without identity.

Symbols
-------
p = (x, y, θ)  true robot pose in the world frame [m, m, rad]
l = (lx, ly)   landmark [m, m], as the complex number lx + i ly
z = (β, r)     reading: bearing from the robot's heading, and range [rad, m]

Arrays of worlds that are simulated together have the worlds along the first axis.
"""

import math
from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from ..arrays import Array, BoolArray, ComplexArray, IntArray
from ..jit import fma, jit_in_place, njit_internal
from ..sim_configs import Scenario
from .noise_streams import SensorNoise, SensorSettings, part_of_sensor
from .robot import wrapped_bearing


class AnonymousScan(NamedTuple):
    """Readings without identities, in random order, empty rows last."""

    readings: Array  # (β, r), zeros in empty rows, shape (…, M, 2) [rad, m]
    mask: BoolArray  # rows with a reading, shape (…, M)
    # The true landmark of each row, -1 for clutter and empty rows, shape (…, M).
    landmark_ids: IntArray


class BearingRangeSensor:
    """Simulates the sensor of a scenario.

    The sensor reads a landmark if its true range is in [min_range, max_range], its true
    bearing is within half the field of view, no wall hides it, the reading does not
    drop out, and the noisy range is positive.

    Parameters
    ----------
    scenario : Scenario
        Source of the sensor's settings and the walls.
    """

    def __init__(self, scenario: Scenario) -> None:
        sensor = scenario.sensor
        self._settings = SensorSettings.of(sensor)
        self._reads_places, wraps = _reading_of_places(sensor.kind)
        self._only = {"bearing": 0, "range": 1}.get(sensor.kind)
        faults = scenario.present_faults
        bias = faults.bearing_bias, faults.range_bias
        smallest = math.nextafter(sensor.min_range, -1.0)
        self._constants = np.array([smallest, *bias, *wraps])
        hides = sensor.occlusion and scenario.walls
        self._sight = LineOfSight(scenario.walls) if hides else None
        self._room = _room_for((0, 0))

    def __getstate__(self) -> dict[str, Any]:
        """Return the settings, with new room: views in a copy share no memory."""
        return {**vars(self), "_room": _room_for((0, 0))}

    def scan(
        self,
        landmarks: ComplexArray,
        frame: Array,
        noise: SensorNoise,
        settings: SensorSettings | None = None,
    ) -> tuple[Array, BoolArray]:
        """Measure the landmarks from one pose in each of K worlds.

        ::

            δ = (l - p) (cos θ - i sin θ),   z = (arg δ, |δ|) + ε + bias

        Parameters
        ----------
        landmarks : complex ndarray, shape (K, N)
            l [m].
        frame : ndarray, shape (5, K)
            Rows x, y, θ, cos θ and sin θ.
        noise : SensorNoise
            Noise of this step.
        settings : SensorSettings, optional
            Of each world, where worlds differ.

        Returns
        -------
        measurements : ndarray, shape (K, N, 2)
            (β in [-π, π), r) [rad, m], or the numbers of another kind of sensor, zeros
            where unseen.
        mask : bool ndarray, shape (K, N)
            Landmarks that the sensor reads.
        """
        shape = landmarks.shape
        if self._room[0].shape != shape:
            self._room = _room_for(shape)
        relative, places, y, x = self._room
        _relate(landmarks, frame, relative, places)
        readings = places
        if self._reads_places is not None:
            readings = np.empty(places.shape)
            readings[0], readings[1] = self._reads_places(x, y)
        np.arctan2(y, x, y)
        np.abs(relative, x)
        measurements, mask = np.empty((*shape, 2)), np.empty(shape, np.bool_)
        numbers = self._settings.numbers if settings is None else settings.numbers
        _disturb(
            *(places, readings, noise[0], noise[1], numbers, self._constants),
            *(measurements, mask),
        )
        if self._sight is not None:
            mask &= ~self._sight.blocked(landmarks, frame)
            measurements[~mask] = 0.0
        if self._only is not None:  # the sensor reads one number
            measurements[..., 0] = measurements[..., self._only]
            measurements[..., 1] = 0.0
        return measurements, mask


def _room_for(shape: tuple[int, int]) -> tuple[ComplexArray, Array, Array, Array]:
    """Return room for intermediate results; the last two are rows of the second."""
    places = np.empty((2, *shape))
    return np.empty(shape, np.complex128), places, places[0], places[1]


@jit_in_place
def _relate(
    landmarks: ComplexArray, frame: Array, relative: ComplexArray, places: Array
) -> None:
    """Write the δ of the landmarks of K worlds.

    Parameters
    ----------
    landmarks, frame : ndarray
        See `BearingRangeSensor.scan`.
    relative : complex ndarray, shape (K, N)
        Receives δ [m].
    places : ndarray, shape (2, K, N)
        Receives the imaginary and the real parts of δ: all y, then all x [m].
    """
    for world in range(len(landmarks)):
        cos, sin = frame[3, world], frame[4, world]
        for i in range(landmarks.shape[1]):
            dx = landmarks[world, i].real - frame[0, world]
            dy = landmarks[world, i].imag - frame[1, world]
            x, y = fma(dx, cos, dy * sin), fma(dx, -sin, dy * cos)
            relative[world, i] = complex(x, y)
            places[0, world, i], places[1, world, i] = y, x


@jit_in_place
def _disturb(  # noqa: PLR0917 (numba takes arrays more quickly than tuples of them)
    places: Array,
    readings: Array,
    unit: Array,
    lots: Array,
    settings: Array,
    constants: Array,
    measurements: Array,
    mask: BoolArray,
) -> None:
    """Write what the sensors of K worlds read.

    Parameters
    ----------
    places : ndarray, shape (2, K, N)
        True (β, r) [rad, m].
    readings : ndarray, shape (2, K, N)
        Readings without noise; may be `places`.
    unit, lots : ndarray
        See `SensorNoise`.
    settings : ndarray, shape (K or 1, 7)
        See `SensorSettings`.
    constants : ndarray, shape (5,)
        The sensor reads landmarks above the first number, a range [m]. Two biases
        follow, which are added to the two numbers of a reading. The last two numbers
        are 1 where the number of a reading is an angle, and 0 elsewhere.
    measurements : ndarray, shape (K, N, 2)
        Receives the readings, zeros where unseen.
    mask : bool ndarray, shape (K, N)
        Receives which landmarks the sensors read.
    """
    count, smallest = mask.shape[1], constants[0]
    bias, wraps = constants[1:3], constants[3:]
    has_bias = bias[0] != 0.0 or bias[1] != 0.0
    for world in range(len(mask)):
        row = settings[min(world, len(settings) - 1)]
        std, growth, dropout, reach, view = row[2:7]
        for i in range(count):
            bearing, distance = places[0, world, i], places[1, world, i]
            nearest = _nearest(unit[world, count + i], std, growth, bias[1])
            in_reach = max(nearest, smallest) < distance <= reach
            stays = lots.shape[1] == 0 or lots[world, i] >= dropout
            mask[world, i] = in_reach and stays and abs(bearing) <= view / 2
            for part in range(2):
                reading = 0.0
                if mask[world, i]:
                    error = unit[world, part * count + i] * row[part]
                    if part == 1 and growth > 0.0:
                        error *= std + growth * distance
                    reading = readings[part, world, i] + error
                    if has_bias:
                        reading += bias[part]
                    if wraps[part] > 0.0:
                        reading = wrapped_bearing(reading)
                measurements[world, i, part] = reading


@njit_internal
def _nearest(noise: float, std: float, growth: float, bias: float) -> float:
    """Return the range r above which r + (σr + k r) ε + bias is positive."""
    nearest, slope = -std * noise - bias, 1.0 + growth * noise
    if growth > 0.0:
        nearest = nearest / slope if slope > 0.0 else np.inf
    return nearest


def _reading_of_places(kind: str) -> tuple[Any, tuple[bool, bool]]:
    """Return what maps (x, y) to a reading, and which of its numbers are angles.

    This is None for the sensors of bearings and ranges.  A kind "module:SENSOR" is a
    sensor that the user has written.
    """
    if ":" not in kind:
        of_places = _position if kind == "position" else None
        return of_places, ("bearing" in kind, False)
    h, wraps = (part_of_sensor(kind, part) for part in ("h", "wraps"))
    return partial(_reading_by, h), (bool(wraps[0]), bool(wraps[1]))


# A world that holds these functions can be pickled; lambdas cannot.


def _position(x: Array, y: Array) -> tuple[Array, Array]:
    return x, y


def _reading_by(h: Any, x: Array, y: Array) -> Any:
    reading, _ = h(x, y)
    return reading


def hide_identities(
    measurements: Array, mask: BoolArray, noise: SensorNoise
) -> AnonymousScan:
    """Mix readings with clutter in random order, empty rows last.

    Parameters
    ----------
    measurements : ndarray, shape (…, N, 2)
        (β, r) of each landmark, zeros where unseen [rad, m].
    mask : bool ndarray, shape (…, N)
        Landmarks that the sensor reads.
    noise : SensorNoise
        Noise of this step; only its clutter and order are used.

    Returns
    -------
    AnonymousScan
        With M = N + C rows.
    """
    _, _, clutter, order = noise
    assert clutter is not None
    assert order is not None
    count = mask.shape[-1]
    rows = np.empty((*order.shape, 3))
    rows[..., :count, :2], rows[..., count:, :2] = measurements, clutter
    rows[..., 2] = -1.0
    np.copyto(rows[..., :count, 2], np.arange(count), where=mask)
    places = np.argsort(np.where(rows[..., 1] > 0.0, order, np.inf), axis=-1)
    if places.ndim == 1:
        rows = rows[places]  # 20 µs faster
    else:
        rows = np.take_along_axis(rows, places[..., None], axis=-2)
    ids = rows[..., 2].astype(np.int64)
    return AnonymousScan(rows[..., :2].copy(), rows[..., 1] > 0.0, ids)


_MOUNTED = 1e-6  # a landmark this near to the line of a wall is mounted on it [m]


class LineOfSight:
    """Straight walls without thickness that hide the landmarks behind them.

    A landmark mounted on a wall (within 1 µm of its line) is not hidden by that wall.

    Parameters
    ----------
    walls : sequence of (x0, y0, x1, y1)
        Ends of the W walls [m].

    Examples
    --------
    >>> sight = LineOfSight([(1.0, -1.0, 1.0, 1.0)])
    >>> landmarks = np.array([[2.0 + 0.0j, 0.5 + 0.0j, 2.0 + 5.0j]])
    >>> sight.blocked(landmarks, frame=np.zeros((2, 1)))
    array([[ True, False, False]])
    """

    def __init__(self, walls: Sequence[tuple[float, float, float, float]]) -> None:
        ends = np.array(walls, dtype=np.float64).reshape(-1, 4)
        a, b = ends.view(np.complex128).T
        margins = _MOUNTED * np.abs(b - a)
        self._walls = np.column_stack([ends, margins])

    def blocked(self, landmarks: ComplexArray, frame: Array) -> BoolArray:
        """Return which lines of sight cross a wall; its end points belong to it.

        With δ = l - p, and the ends a and b of a wall relative to p, the line from p
        to l passes between them if δ × a and δ × b differ in sign, and l lies behind
        the wall if δ × (b - a), which grows with δ, exceeds a × b::

            (δ × a)(δ × b) <= 0   and   δ × (b - a) sign(a × b) > |a × b|

        Parameters
        ----------
        landmarks : complex ndarray, shape (K, N)
            l as x + iy [m].
        frame : ndarray, shape (2 or more, K)
            Rows x and y of p [m], and others.

        Returns
        -------
        bool ndarray, shape (K, N)
        """
        blocked = np.zeros(landmarks.shape, dtype=np.bool_)
        _find_blocked(landmarks, frame, self._walls, blocked)
        return blocked


@jit_in_place
def _find_blocked(
    landmarks: ComplexArray, frame: Array, walls: Array, blocked: BoolArray
) -> None:
    """Mark the blocked lines of sight; `walls` has rows (a, b, margin)."""
    for world in range(len(landmarks)):
        x, y = frame[0, world], frame[1, world]
        for w in range(len(walls)):
            ax, ay, bx, by, margin = walls[w]
            robot_side = fma(ax - x, by - y, (y - ay) * (bx - x))
            nearer, sign = abs(robot_side) + margin, np.sign(robot_side)
            for i in range(landmarks.shape[1]):
                dx, dy = landmarks[world, i].real - x, landmarks[world, i].imag - y
                side_a = fma(dx, y - ay, dy * (ax - x))  # a × δ
                side_b = fma(dx, y - by, dy * (bx - x))
                is_behind = (side_a - side_b) * sign > nearer
                blocked[world, i] |= is_behind & (side_a * side_b <= 0.0)
