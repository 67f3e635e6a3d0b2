"""Sensors as values: what a reading of a landmark is, for filters and their kernels.

A `Sensor` holds a measurement function of the landmark in the robot's frame, with its
slopes, in plain Python. From it the library derives the Jacobians, compiles kernels
(`sensor_kernels`), and computes in numpy.  `SENSORS` lists the shipped ones:
``bearing_range``, ``position``, ``bearing`` and ``range``.  `check_sensor` tests one of
your own.

Symbols
-------
(x, y)         landmark in the robot's frame, ahead and to the left [m, m]
h(x, y)        expected reading (z0, z1), in the units of the sensor
D              [∂z0/∂x ∂z0/∂y; ∂z1/∂x ∂z1/∂y]
R              rotation by the heading θ, so that (x, y) = Rᵀ (l − p)

Since the robot's frame moves with the pose::

    ∂h/∂l = D Rᵀ,    ∂h/∂(px, py) = −D Rᵀ,    ∂h/∂θ = D (y, −x)
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ... import argument_checks
from ...arrays import LARGEST_RANGE_GROWTH, Array
from .bearing_range import LandmarkLocation, MeasurementPrediction, wrap_angle
from .rigid_motion import rotation

Real = Any  # a number, or an array of any shape
Numbers = tuple[Real, Real]
Noise = tuple[float, ...]  # the four numbers of a filter, see `Sensor`
Slopes = tuple[Real, Real, Real, Real]


#: Value of ``landmark_init`` that lets readings of new landmarks wait.
DELAYED = "delayed"


def constant_std(noise: Noise, distance: Real) -> Numbers:
    """Return the two standard deviations as given, at any distance."""
    return noise[0] + 0.0 * distance, noise[1] + 0.0 * distance


@dataclass(frozen=True)
class Sensor:
    """A sensor that reads one or two numbers of each landmark.

    The functions are plain Python, of numbers or arrays, within what numba compiles.
    A reading is always a row of two numbers.  The second of a sensor that reads one is
    void: it is 0, with slopes of 0, and filters ignore it.

    Parameters
    ----------
    name : str
        Name to call the sensor by.
    columns, units : tuple of str
        Name and unit of each number.
    h : callable
        ``h(x, y)`` returns the expected reading and its slopes, ((z0, z1), (∂z0/∂x,
        ∂z0/∂y, ∂z1/∂x, ∂z1/∂y)), of a landmark at (x, y) in the robot's frame.
    inverse : callable or None
        ``inverse(z0, z1)`` returns the landmark (x, y) in the robot's frame.  None if
        a reading does not determine it; filters then wait for readings from several
        poses.
    angles : tuple of bool
        Which numbers are angles, whose differences filters wrap; by default none.
    std : callable
        ``std(noise, distance)`` returns the two standard deviations of the reading of a
        landmark at a distance [m].  ``noise`` holds the two numbers of the filter's
        ``measurement_std``, and the next two numbers of this sensor.  By default,
        ``measurement_std`` at every distance.
    range_std_per_metre : float
        k, the third number of `std`.  In the shipped sensors, the part of σr that
        grows with the range: σr(r) = σr + k r.
    bearing_std_metres : float
        b, the fourth number of `std`.  In the shipped sensors, the part of σβ that
        shrinks with the range: σβ(r) = σβ + b / r.  A bearing-range sensor that reads
        positions with the noise σ has σβ = 0, σr = b = σ.
    range_noise_at : {"expected", "reading"}
        The distance that `std` gets: the expected one, or the measured one.  The latter
        is common, but gives more weight to readings that are too short.  For a new
        landmark, it is always the measured one.
    field_of_view : float
        Full angle of view, centred on the heading [rad], by default all around. Worlds
        and `check_sensor` use `h` only inside it.

    Raises
    ------
    ValueError
        If the parts do not fit together.

    Notes
    -----
    Sensors that differ only in the last four parameters are equal: they share kernels.

    Examples
    --------
    >>> BEARING.predict(np.zeros(3), np.array([[0.0, 2.0]])).measurement
    array([[1.57079633, 0.        ]])
    """

    name: str
    columns: tuple[str, ...]
    units: tuple[str, ...]
    h: Callable[[Real, Real], tuple[Numbers, Slopes]]
    inverse: Callable[[Real, Real], Numbers] | None = None
    angles: tuple[bool, ...] = ()
    std: Callable[[Noise, Real], Numbers] = constant_std
    range_std_per_metre: float = field(default=0.0, compare=False)
    bearing_std_metres: float = field(default=0.0, compare=False)
    range_noise_at: str = field(default="expected", compare=False)
    field_of_view: float = field(default=2 * math.pi, compare=False)

    def __post_init__(self) -> None:
        for name in ("h", "inverse", "std"):
            part = getattr(self, name)
            if not (callable(part) or (name == "inverse" and part is None)):
                raise self._refused(f"{name} must be a function, got {part!r}")
        for name in ("columns", "units", "angles"):  # kernels are kept by the sensor
            object.__setattr__(self, name, tuple(getattr(self, name)))
        if self.size not in (1, 2) or len(self.units) != self.size:
            raise self._refused(
                "columns and units must name the same one or two numbers, got "
                f"{self.columns!r} and {self.units!r}"
            )
        if len(self.angles) not in (0, self.size):
            raise self._refused(
                f"angles must have one entry for each column, got {self.angles!r}"
            )
        if self.places and self.size == 1:
            raise self._refused(
                "one number cannot determine a landmark: inverse must be None"
            )
        if not 0 < self.field_of_view <= 2 * math.pi:
            raise self._refused(
                f"field_of_view must be in (0, 2π] [rad], got {self.field_of_view!r}"
            )
        self._check_noise()
        self._check_returns()

    def _check_noise(self) -> None:
        """Refuse numbers of the noise that no reading can have."""
        k, b = self.range_std_per_metre, self.bearing_std_metres
        check = argument_checks.at_least
        check("range_std_per_metre", k, 0.0, LARGEST_RANGE_GROWTH)
        check("bearing_std_metres", b, 0.0)
        if self.std is constant_std and (k or b):
            raise self._refused(
                "range_std_per_metre and bearing_std_metres must be 0: its noise is "
                "the same at every distance"
            )
        places = ("expected", "reading")
        argument_checks.one_of("range_noise_at", self.range_noise_at, places)
        if self.range_noise_at == "reading" and not self.places:
            raise self._refused(
                "range_noise_at must be 'expected': one reading does not locate a "
                "landmark"
            )

    def _check_returns(self) -> None:
        """Refuse functions that return something else, at a place 1 m ahead."""
        try:
            (z0, z1), (_, _, _, _) = self.h(1.0, 0.1)
        except (TypeError, ValueError) as error:
            raise self._refused(
                f"h must return ((z0, z1), (∂z0/∂x, ∂z0/∂y, ∂z1/∂x, ∂z1/∂y)): {error}"
            ) from None
        if self.inverse is not None:
            try:
                (_, _) = self.inverse(z0, z1)
            except (TypeError, ValueError) as error:
                raise self._refused(f"inverse must return (x, y): {error}") from None
        std = np.asarray(self.std(self.noise((0.1, 0.1)), 1.0), dtype=np.float64)
        if std.shape != (2,) or not (np.isfinite(std) & (std > 0)).all():
            raise self._refused(
                "std must return two finite numbers > 0, got "
                f"{std.tolist()} at 1 m for measurement_std (0.1, 0.1)"
            )

    def _refused(self, what: str) -> ValueError:
        return ValueError(f"sensor '{self.name}': {what}")

    def with_noise(self, **numbers: Any) -> Sensor:
        """Return the sensor with other numbers of its noise, by their names.

        Examples
        --------
        >>> BEARING_RANGE.with_noise(range_std_per_metre=0.05).stds((0.02, 0.1), 4.0)
        array([0.02, 0.3 ])
        """
        return replace(self, **numbers)

    def delayed(self) -> Sensor:
        """Return a copy of the sensor whose single readings do not place landmarks."""
        return replace(self, name=f"{self.name} ({DELAYED})", inverse=None)

    def noise(self, measurement_std: ArrayLike) -> Noise:
        """Return the four numbers of `std` for a filter's measurement_std (2,)."""
        first, second = np.asarray(measurement_std, dtype=np.float64).tolist()
        return first, second, self.range_std_per_metre, self.bearing_std_metres

    def stds(self, measurement_std: ArrayLike, distances: ArrayLike) -> Array:
        """Return the standard deviations of readings at distances (...), (..., 2)."""
        std = self.std(self.noise(measurement_std), distances)
        return np.stack(np.broadcast_arrays(distances, *std)[1:], axis=-1)

    @property
    def size(self) -> int:
        """How many numbers the sensor reads of a landmark, 1 or 2."""
        return len(self.columns)

    @property
    def places(self) -> bool:
        """Whether one reading determines where the landmark is."""
        return self.inverse is not None

    @property
    def wraps(self) -> tuple[bool, bool]:
        """Whether each of the two numbers is an angle."""
        first, second, *_ = (*self.angles, False, False)
        return first, second

    def predict(self, pose: Array, landmarks: Array) -> MeasurementPrediction:
        """Predict the readings of landmarks (m, 2) from a pose (3,), in numpy.

        Returns
        -------
        MeasurementPrediction
            Readings (m, 2), not wrapped, and the Jacobians (m, 2, 3) and (m, 2, 2).
        """
        R = rotation(pose[2])
        x, y = ((landmarks - pose[:2]) @ R).T
        D, measurement = self.slopes(x, y), self.read(x, y)
        by_landmark = D @ R.T
        by_heading = D @ np.stack([y, -x], axis=1)[..., None]
        by_pose = np.concatenate([-by_landmark, by_heading], axis=2)
        return MeasurementPrediction(measurement, by_pose, by_landmark)

    def locate(self, pose: Array, readings: Array) -> LandmarkLocation:
        """Place each landmark by its reading, a row of (m, 2), from a pose (3,)."""
        if self.inverse is None:
            raise ValueError(f"one reading of {self.name} does not locate a landmark")
        R, z = rotation(pose[2]), readings.T
        x, y = self.inverse(z[0], z[1])
        offset = np.stack([x, y], axis=1) @ R.T
        by_pose = np.tile(np.eye(2, 3), (len(readings), 1, 1))
        by_pose[:, 0, 2], by_pose[:, 1, 2] = -offset[:, 1], offset[:, 0]
        return LandmarkLocation(
            pose[:2] + offset, by_pose, R @ np.linalg.inv(self.slopes(x, y))
        )

    def difference(self, readings: Array, expected: Array) -> Array:
        """Return readings − expected, shape (..., 2), wrapped where an angle."""
        apart = np.subtract(readings, expected, dtype=np.float64)
        for column, is_angle in enumerate(self.wraps):
            if is_angle:
                apart[..., column] = wrap_angle(apart[..., column])
        if self.size == 1:
            apart[..., 1] = 0.0
        return apart

    def distances(self, readings: Array) -> Array:
        """Return the distances of landmarks by their readings (m, 2), or infinity."""
        if self.inverse is None:
            return np.full(len(readings), np.inf)
        if self == BEARING_RANGE:
            return readings[:, 1]
        x, y = self.inverse(readings[:, 0], readings[:, 1])
        return np.asarray(np.hypot(x, y))

    def slopes(self, x: Array, y: Array) -> Array:
        """Return D of landmarks at (x, y) in the robot's frame, shape (m, 2, 2)."""
        columns = np.broadcast_arrays(x, *self.h(x, y)[1])[1:]
        return np.stack(columns, axis=-1).reshape(-1, 2, 2).astype(np.float64)

    def read(self, x: Array, y: Array) -> Array:
        """Return the readings of landmarks at (x, y) in the robot's frame, (..., 2)."""
        return np.stack(np.broadcast_arrays(x, *self.h(x, y)[0])[1:], axis=-1) * 1.0

    def __reduce__(self) -> Any:
        """Return the registered sensor itself in another process."""
        if SENSORS.get(self.name) != self:
            return super().__reduce__()
        return _shipped, (self.name, *(getattr(self, name) for name in NUMBERS))


# --------------------------------------------------------------------------------------
# The shipped sensors.


def read_bearing_range(x: Real, y: Real) -> tuple[Numbers, Slopes]:
    """Read bearing [rad] and range [m]."""
    squared = x * x + y * y
    r = np.sqrt(squared)
    return (np.arctan2(y, x), r), (-y / squared, x / squared, x / r, y / r)


def from_bearing_range(bearing: Real, distance: Real) -> Numbers:
    """Return the landmark at a bearing and range."""
    return distance * np.cos(bearing), distance * np.sin(bearing)


def bearing_range_std(noise: Noise, distance: Real) -> Numbers:
    """Return σβ + b / r and σr + k r."""
    return noise[0] + noise[3] / distance, noise[1] + noise[2] * distance


def read_position(x: Real, y: Real) -> tuple[Numbers, Slopes]:
    """Read the position in the robot's frame [m, m]."""
    return (x, y), (1.0, 0.0, 0.0, 1.0)


def from_position(x: Real, y: Real) -> Numbers:
    """Return the landmark where it was read."""
    return x, y


def read_bearing(x: Real, y: Real) -> tuple[Numbers, Slopes]:
    """Read the bearing [rad]."""
    squared = x * x + y * y
    return (np.arctan2(y, x), 0.0), (-y / squared, x / squared, 0.0, 0.0)


def read_range(x: Real, y: Real) -> tuple[Numbers, Slopes]:
    """Read the range [m]."""
    r = np.sqrt(x * x + y * y)
    return (r, 0.0), (x / r, y / r, 0.0, 0.0)


def range_std(noise: Noise, distance: Real) -> Numbers:
    """Return σr + k r."""
    return noise[0] + noise[2] * distance, 1.0


BEARING_RANGE = Sensor(
    "bearing_range",
    ("bearing", "range"),
    ("rad", "m"),
    read_bearing_range,
    from_bearing_range,
    (True, False),
    bearing_range_std,
)
POSITION = Sensor("position", ("x", "y"), ("m", "m"), read_position, from_position)
BEARING = Sensor(
    *("bearing", ("bearing",), ("rad",), read_bearing),
    angles=(True,),
    std=bearing_range_std,
)
RANGE = Sensor("range", ("range",), ("m",), read_range, std=range_std)

#: The numbers of a sensor's noise that a filter's ``measurement_std`` does not hold.
NUMBERS = ("range_std_per_metre", "bearing_std_metres", "range_noise_at")

#: The known sensors by name.
SENSORS: dict[str, Sensor] = {
    sensor.name: sensor for sensor in (BEARING_RANGE, POSITION, BEARING, RANGE)
}


def _shipped(name: str, *numbers: Any) -> Sensor:
    return SENSORS[name].with_noise(**dict(zip(NUMBERS, numbers, strict=True)))


def find_sensor(sensor: str | Sensor) -> Sensor:
    """Return a sensor: itself, by its name, or by an import path "module:NAME".

    Raises
    ------
    ValueError
        If there is no such sensor, with the nearest name, or a path names another
        object.
    """
    if isinstance(sensor, Sensor):
        return sensor
    name = str(sensor)
    if name in SENSORS:
        return SENSORS[name]
    from ...suggestions import closest, imported  # noqa: PLC0415 (for other names)

    if ":" in name:
        found = imported(name, f"cannot import sensor '{name}': ", kind=True)
        if isinstance(found, Sensor):
            return found
        raise ValueError(f"'{name}' is a {type(found).__name__}, not a Sensor")
    hint, known = closest(name, SENSORS), ", ".join(SENSORS)
    raise ValueError(f"unknown sensor '{sensor}'{hint} (known: {known})")


def sensor_in(options: Mapping[str, Any]) -> Sensor:
    """Return the sensor that options name, with the numbers of its noise among them."""
    sensor = find_sensor(options.get("sensor", BEARING_RANGE))
    numbers = {name: options[name] for name in NUMBERS if name in options}
    return sensor.with_noise(**numbers) if numbers else sensor


def two_stds(sensor: Sensor, measurement_std: ArrayLike) -> Array:
    """Return the noise as two numbers, the second without use where one is read."""
    if sensor.size == 1 and np.size(measurement_std) == 1:
        given = argument_checks.as_floats("measurement_std", measurement_std)
        measurement_std = np.resize(given, 2)
    return argument_checks.standard_deviations("measurement_std", measurement_std, 2)


def only_bearing_range(sensor: str | Sensor, part: str) -> Sensor:
    """Return the sensor; refuse others, for a part that does not take them."""
    found = find_sensor(sensor)
    if found != BEARING_RANGE:
        raise ValueError(
            f"{part} accepts only sensor 'bearing_range', got '{found.name}'"
        )
    return found


def only_placing(sensor: Sensor, part: str) -> None:
    """Refuse sensors whose readings do not place a landmark one by one."""
    if not sensor.places:
        raise ValueError(
            f"{part} needs a sensor whose single reading locates a landmark, got "
            f"'{sensor.name}'"
        )
