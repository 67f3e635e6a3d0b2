"""The bearing-range sensor: which landmarks it sees, and its readings.

`BearingRangeSensor` measures the landmarks in view; `LineOfSight` finds those that a
wall hides, and `hide_identities` shuffles readings without identity.

Symbols
-------
p = (x, y, θ)  true robot pose in the world frame [m, m, rad]
l = (lx, ly)   landmark [m, m], as the complex number lx + i ly
z = (β, r)     reading: bearing from the robot's heading, and range [rad, m]

Here readings are stored as (all bearings, all ranges), so that both are contiguous.
Every function accepts leading axes for worlds that are simulated together.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from ..arrays import Array, BoolArray, ComplexArray, IntArray
from ..jit import jit
from ..sim_configs import Scenario
from ..suggestions import imported
from .noise_streams import SensorNoise, SensorSettings
from .robot import wrapped_bearing

_LAST = np.array(np.inf)  # sorts after every other row


class AnonymousScan(NamedTuple):
    """Readings without identities, in random order, empty rows last."""

    readings: Array  # (β, r), zeros in empty rows, shape (2, …, M) [rad, m]
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
        self._reads_places, self._wraps = _reading_of_places(sensor.kind)
        self._reads_ranges = sensor.kind == "range"
        self._reads_one = sensor.kind in ("bearing", "range")
        faults = scenario.present_faults
        self._bias = faults.bearing_bias, faults.range_bias
        hides = sensor.occlusion and scenario.walls
        self._sight = LineOfSight(scenario.walls) if hides else None

    def scan(
        self,
        landmarks: ComplexArray,
        position: ComplexArray,
        inverse_heading: ComplexArray,
        noise: SensorNoise,
        settings: SensorSettings | None = None,
    ) -> tuple[Array, BoolArray]:
        """Measure the landmarks from one pose per world.

        ::

            δ = (l - p) (cos θ - i sin θ),   z = (arg δ, |δ|) + ε + bias

        Parameters
        ----------
        landmarks : complex ndarray, shape (…, N)
            l [m].
        position : complex ndarray, shape () or (…, 1)
            x + iy [m].
        inverse_heading : complex ndarray, shape () or (…, 1)
            cos θ - i sin θ.
        noise : SensorNoise
            Noise of this step.
        settings : SensorSettings, optional
            Of each world, where worlds differ.

        Returns
        -------
        readings : ndarray, shape (2, …, N)
            (β in [-π, π), r) [rad, m], or the numbers of another kind of sensor, zeros
            where unseen.
        mask : bool ndarray, shape (…, N)
            Landmarks that the sensor reads.
        """
        error, nearest, _, _ = noise
        relative = (landmarks - position) * inverse_heading
        readings = np.empty(error.shape)  # without noise at first
        mask = np.empty(nearest.shape, dtype=np.bool_)
        y, x = relative.imag, relative.real
        if y.ndim > 1:  # contiguous copies are twice as fast for many
            y, x = y.copy(), x.copy()
        np.arctan2(y, x, readings[0])
        np.abs(relative, readings[1])
        places = readings
        if self._reads_places is not None:
            places, readings = readings, np.empty(error.shape)
            readings[0], readings[1] = self._reads_places(x, y)
        at = np.s_[..., None, :] if mask.ndim == 1 else np.s_[...]  # one world or more
        _disturb(
            *(places[at], readings[at], error[at], nearest[at], mask[at]),
            *((settings or self._settings).numbers, self._bias, self._wraps),
        )
        if self._sight is not None:
            mask &= ~self._sight.blocked(landmarks, position)
            readings = np.where(mask, readings, 0.0)
        if self._reads_one:
            if self._reads_ranges:
                readings[0] = readings[1]
            readings[1] = 0.0
        return readings, mask


@jit
def _disturb(  # noqa: PLR0917 (numba takes arrays more quickly than tuples of them)
    places: Array,
    readings: Array,
    error: Array,
    nearest: Array,
    mask: BoolArray,
    settings: Array,
    bias: tuple[float, float],
    wraps: tuple[bool, bool],
) -> None:
    """Turn readings without noise into what the sensors of K worlds read, in place.

    Parameters
    ----------
    places : ndarray, shape (2, K, N)
        True (β, r) [rad, m]; may be `readings`.
    readings, error : ndarray, shape (2, K, N)
        Without noise, and what is added; zeros where unseen.
    nearest : ndarray, shape (K, N)
        See `SensorNoise`.
    mask : bool ndarray, shape (K, N)
        Receives which landmarks the sensors read.
    settings : ndarray, shape (K or 1, 7)
        See `SensorSettings`.
    bias : (float, float)
        Added to the readings.
    wraps : (bool, bool)
        Which numbers of a reading are angles.
    """
    for world in range(len(mask)):
        std, growth, _, reach, view = settings[min(world, len(settings) - 1), 2:]
        for i in range(mask.shape[1]):
            bearing, distance = places[0, world, i], places[1, world, i]
            in_reach = nearest[world, i] < distance <= reach
            mask[world, i] = in_reach and abs(bearing) <= view / 2
            for part in range(2):
                reading = 0.0
                if mask[world, i]:
                    add = error[part, world, i]
                    if part == 1 and growth > 0.0:
                        add *= std + growth * distance
                    reading = readings[part, world, i] + add
                    if bias[0] != 0.0 or bias[1] != 0.0:
                        reading += bias[part]
                    if wraps[part]:
                        reading = wrapped_bearing(reading)
                readings[part, world, i] = reading


def _reading_of_places(kind: str) -> tuple[Any, tuple[bool, bool]]:
    """Return what maps (x, y) to a reading, and which of its numbers are angles.

    This is None for the sensors of bearings and ranges.  A kind "module:SENSOR" is a
    sensor that the user has written.
    """
    if ":" not in kind:
        of_places = (lambda x, y: (x, y)) if kind == "position" else None
        return of_places, ("bearing" in kind, False)
    refusal = f"cannot import sensor.kind = '{kind}': "
    h, wraps = (imported(f"{kind}.{part}", refusal) for part in ("h", "wraps"))
    return (lambda x, y: h(x, y)[0]), (bool(wraps[0]), bool(wraps[1]))


def hide_identities(
    readings: Array, mask: BoolArray, noise: SensorNoise
) -> AnonymousScan:
    """Mix readings with clutter in random order, empty rows last.

    Parameters
    ----------
    readings : ndarray, shape (2, …, N)
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
    rows = np.zeros((3, *order.shape))
    rows[:2, ..., :count] = readings
    rows[:2, ..., count:] = clutter
    rows[2] = -1.0
    np.copyto(rows[2, ..., :count], np.arange(count), where=mask)
    places = np.argsort(np.where(rows[1] > 0.0, order, _LAST), axis=-1)
    if places.ndim == 1:
        packed = rows[:, places]  # 20 µs faster
    else:
        packed = np.take_along_axis(rows, places[None], axis=-1)
    return AnonymousScan(packed[:2], packed[1] > 0.0, packed[2].astype(np.int64))


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
    >>> landmarks = np.array([2.0 + 0.0j, 0.5 + 0.0j, 2.0 + 5.0j])
    >>> sight.blocked(landmarks, position=np.array(0j))
    array([ True, False, False])
    """

    def __init__(self, walls: Sequence[tuple[float, float, float, float]]) -> None:
        ends = np.array(walls, dtype=np.float64).reshape(-1, 2, 2)
        a, b = np.moveaxis(ends[..., 0] + 1j * ends[..., 1], 1, 0)
        self._conjugate_ends = np.conj(np.concatenate([a, b]))
        self._count = len(a)
        self._along = b - a
        self._origin_side = _cross(a, b)
        self._mounted = _MOUNTED * np.abs(self._along)

    def blocked(self, landmarks: ComplexArray, position: ComplexArray) -> BoolArray:
        """Return which lines of sight cross a wall; its end points belong to it.

        With δ = l - p, and the ends a and b of a wall relative to p, the line from p
        to l passes between them if δ × a and δ × b differ in sign, and l lies behind
        the wall if δ × (b - a), which grows with δ, exceeds a × b::

            (δ × a)(δ × b) <= 0   and   δ × (b - a) sign(a × b) > |a × b|

        Parameters
        ----------
        landmarks : complex ndarray, shape (…, N)
            l as x + iy [m].
        position : complex ndarray, shape () or (…, 1)
            p as x + iy [m].

        Returns
        -------
        bool ndarray, shape (…, N)
        """
        p = position[..., None]
        ends = self._conjugate_ends - np.conj(p)
        sides = ((landmarks - position)[..., None] * ends).imag  # a × δ, then b × δ
        side_a, side_b = sides[..., : self._count], sides[..., self._count :]
        robot_side = self._origin_side - _cross(p, self._along)
        nearer = np.abs(robot_side) + self._mounted
        behind = (side_a - side_b) * np.sign(robot_side) > nearer
        behind &= side_a * side_b <= 0.0
        blocked: BoolArray = np.logical_or.reduce(behind, axis=-1)
        return blocked


def _cross(u: ComplexArray, v: ComplexArray) -> Array:
    product: Array = (np.conj(u) * v).imag
    return product
