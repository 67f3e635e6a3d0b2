"""The events of a log: odometry rows, and scans of simultaneous readings."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ...arrays import Array, IntArray
from ...estimator.models.bearing_range import wrap_angle
from .lines import LogLine

NO_LANDMARK = -1
"""The true id of a reading that is of no landmark."""


@dataclass(frozen=True)
class OdometryRow:
    """One odometry reading u = (d, α) and the time at its end.

    Attributes
    ----------
    t : float
        Time at the end of the motion [s, or steps].
    d, alpha : float
        Distance driven [m] and heading turned, counter-clockwise [rad].
    dt : float
        Duration for the motion noise: noise variances grow with dt, and a row with
        dt = 0 has none.
    """

    t: float
    d: float
    alpha: float
    dt: float


@dataclass(frozen=True, eq=False)
class Scan:
    """Simultaneous readings of m >= 1 landmarks.

    Attributes
    ----------
    t : float
        Time of the readings [s, or steps].
    measurements : ndarray, shape (m, 2)
        Rows (β, r): bearing from the heading, and range [rad, m].
    landmark_ids : ndarray of int64, shape (m,), or None
        Landmark of each row, without repetition; None if unknown.
    sizes : ndarray, shape (m,), or None
        Diameters of the seen objects [m], if the sensor measures them.
    true_ids : ndarray of int64, shape (m,), or None
        The true landmark of each row, -1 for none, where it is known but hidden: for
        scores, not for filters.

    Raises
    ------
    ValueError
        If the shapes do not match, or there is no reading.
    """

    t: float
    measurements: Array
    landmark_ids: IntArray | None = None
    sizes: Array | None = None
    true_ids: IntArray | None = None

    def __post_init__(self) -> None:
        readings = float_array("measurements", self.measurements, columns=2)
        if not len(readings):
            raise ValueError("measurements must be m >= 1 rows (bearing, range), got 0")
        object.__setattr__(self, "measurements", readings)
        columns = {"landmark_ids": np.int64, "sizes": np.float64, "true_ids": np.int64}
        for name, dtype in columns.items():
            value = getattr(self, name)
            if value is None:
                continue
            column = np.asarray(value, dtype=dtype)
            if column.shape != (len(readings),):
                raise ValueError(
                    f"{name} must have one entry per measurement, "
                    f"got shape {column.shape} for {len(readings)}"
                )
            object.__setattr__(self, name, column)


def float_array(name: str, value: ArrayLike, *, columns: int) -> Array:
    """Return a table of numbers as an array of shape (n, columns), or raise ValueError.

    Examples
    --------
    >>> float_array("landmarks", [(3, 6)], columns=2)
    array([[3., 6.]])
    """
    array = np.asarray(value, dtype=np.float64)
    if array.ndim != 2 or array.shape[1] != columns:
        raise ValueError(f"{name} must be shape (n, {columns}), got {array.shape}")
    return array


class Reading(NamedTuple):
    """One measurement row of a log, before it becomes part of a scan."""

    t: float
    landmark_id: int | None
    bearing: float
    range: float
    size: float | None = None
    true_id: int | None = None


def wrap_bearing(angle: float) -> float:
    """Wrap an angle into [-π, π); an angle inside keeps its bits.

    Examples
    --------
    >>> wrap_bearing(0.1), wrap_bearing(0.1 + 2 * math.pi)
    (0.1, 0.09999999999999964)
    """
    return angle if -math.pi <= angle < math.pi else wrap_angle(angle)


class EventRecorder:
    """Collect rows in their order; consecutive readings of equal time form one scan.

    Each row comes with its line in the file, which errors name.

    Examples
    --------
    >>> line = LogLine("drive.csv", 1, "")
    >>> recorder = EventRecorder()
    >>> recorder.add_odometry(line, OdometryRow(1.0, 3.0, 0.0, dt=1.0))
    >>> recorder.add_reading(line, Reading(1.0, 0, 0.1, 2.0))
    >>> recorder.add_reading(line, Reading(1.0, 4, 0.2, 5.0))
    >>> row, scan = recorder.finish()
    >>> scan.landmark_ids
    array([0, 4])
    """

    def __init__(self) -> None:
        self._events: list[OdometryRow | Scan] = []
        self._readings: list[Reading] = []
        self._seen: set[int] = set()
        self._time = -math.inf

    def add_odometry(self, line: LogLine, row: OdometryRow) -> None:
        """Append an odometry row; raise LogError if t or dt runs backwards."""
        if row.dt < 0:
            raise line.error("dt >= 0", str(row.dt))
        self._advance(line, row.t)
        self._close_scan()
        self._events.append(row)

    def add_turn_drive_turn(
        self, line: LogLine, step: int, *, before: float, d: float, after: float
    ) -> None:
        """Append a motion of one step as two turn-last rows, the first with dt = 0."""
        self.add_odometry(line, OdometryRow(float(step), 0.0, before, dt=0.0))
        self.add_odometry(line, OdometryRow(float(step), d, after, dt=1.0))

    def add_reading(self, line: LogLine, reading: Reading) -> None:
        """Append a reading; raise LogError if it contradicts the rows before it."""
        self._advance(line, reading.t)
        if self._readings and self._readings[-1].t != reading.t:
            self._close_scan()
        if self._readings:
            self._check_same_kind(line, reading)
        if reading.landmark_id is not None:
            if reading.landmark_id in self._seen:
                raise line.error(
                    "each landmark once per scan", f"id {reading.landmark_id} again"
                )
            self._seen.add(reading.landmark_id)
        self._readings.append(reading)

    def finish(self) -> tuple[OdometryRow | Scan, ...]:
        """Return the events recorded so far."""
        self._close_scan()
        return tuple(self._events)

    def _advance(self, line: LogLine, t: float) -> None:
        if t < self._time:
            raise line.error(f"t >= {self._time}, the time before", str(t))
        self._time = t

    def _check_same_kind(self, line: LogLine, reading: Reading) -> None:
        first = self._readings[0]
        if (first.landmark_id is None) != (reading.landmark_id is None):
            raise line.error("ids in all rows of a scan or in none", "both")
        if (first.size is None) != (reading.size is None):
            raise line.error("sizes in all rows of a scan or in none", "both")
        if (first.true_id is None) != (reading.true_id is None):
            raise line.error("true ids in all rows of a scan or in none", "both")

    def _close_scan(self) -> None:
        if not self._readings:
            return
        times, ids, bearings, ranges, sizes, true = zip(*self._readings, strict=True)
        self._events.append(
            Scan(
                t=times[0],
                measurements=np.column_stack([bearings, ranges]),
                landmark_ids=None if ids[0] is None else np.array(ids, dtype=np.int64),
                sizes=None if sizes[0] is None else np.array(sizes, dtype=np.float64),
                true_ids=None if true[0] is None else np.array(true, dtype=np.int64),
            )
        )
        self._readings.clear()
        self._seen.clear()
