"""Read the UTIAS multi-robot data sets (MR.CLAM): one folder of .dat files per drive.

``Robot<k>_Odometry.dat`` (t, v, ω), ``Robot<k>_Measurement.dat`` (t, barcode, range,
bearing), ``Robot<k>_Groundtruth.dat`` (t, x, y, θ; optional), ``Barcodes.dat``
(subject, barcode) and ``Landmark_Groundtruth.dat`` (subject, x, y, σx, σy). Subjects 1
to 5 are the robots, the others are landmarks.

References
----------
K. Leung, Y. Halpern, T. Barfoot, H. Liu, The UTIAS multi-robot cooperative localization
and mapping dataset, International Journal of Robotics Research 30(8), 2011.
"""

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ....arrays import Array, IntArray
from ....evaluation.trajectory_error import poses_at
from .. import log_lines, slamlog

ODOMETRY_STEP = 0.1  # [s]
LONGEST = 1e6  # [s]: 10 million rows
TRUTH_STEP = 0.2  # [s]
LAST_ROBOT = 5
TIME_DIGITS = 6  # float64 resolves stamps near 1.25e9 s to 2.4e-7 s
ODOMETRY_NAME = re.compile(r"Robot(\d+)_Odometry\.dat")
MERGED = log_lines.LogLine("merged odometry", 0, "")

TimedReadings = list[tuple[log_lines.LogLine, slamlog.Reading]]


def read_utias(folder: Path, *, robot: int | None = None) -> slamlog.SlamLog:
    """Read the drive of one robot.

    Velocities are constant between their stamps and integrated onto a grid of 10 Hz,
    which is split at each scan. Barcodes become subject numbers. Readings of other
    robots, of unknown barcodes, and outside the time of the odometry are left out and
    counted in the header (``left_out``). Time starts at the first odometry (``epoch``
    in the header), and the ground truth is interpolated every 0.2 s.

    Parameters
    ----------
    folder : Path
        The folder of a data set.
    robot : int, optional
        Number of the robot; the lowest one with odometry by default.

    Returns
    -------
    SlamLog
        Motion midpoint, in seconds; the start is the true pose at the first odometry,
        or the origin if that is unknown (``start_from`` in the header).

    Raises
    ------
    LogError
        If a file of the folder is missing or malformed.
    """
    number = _choose_robot(folder, robot)
    odometry = _timed_table(folder / f"Robot{number}_Odometry.dat", "t v ω")
    epoch = float(odometry[0, 0])
    odometry[:, 0] = np.round(odometry[:, 0] - epoch, TIME_DIGITS)
    end = float(odometry[-1, 0])
    if end > LONGEST:
        raise ValueError(
            f"{folder}: the odometry of robot {number} must end within {LONGEST:g} s "
            f"of its start, got {end:g} s: a time stamp is damaged"
        )
    readings, left_out = _read_measurements(folder, number, epoch=epoch, end=end)
    truth = _read_truth(folder / f"Robot{number}_Groundtruth.dat", epoch)
    start = poses_at([0.0], truth)[0]
    is_known = bool(np.isfinite(start).all())
    ids, landmarks = _read_landmarks(folder)
    return slamlog.SlamLog(
        name=f"{folder.resolve().name}_r{number}",
        header={
            "source": f"UTIAS MR.CLAM, robot {number}",
            "epoch": repr(epoch),
            "left_out": left_out,
            "start_from": "ground truth" if is_known else "origin (no truth then)",
        },
        motion="midpoint",
        start=start if is_known else np.zeros(3),
        landmark_ids=ids,
        landmarks=landmarks,
        events=_merge(odometry, readings),
        ground_truth=_resample(truth, end),
    )


def robots_in(folder: Path) -> list[int]:
    """Return the robots whose odometry is in a folder."""
    matches = (ODOMETRY_NAME.fullmatch(file.name) for file in folder.iterdir())
    return sorted(int(match[1]) for match in matches if match)


def _choose_robot(folder: Path, robot: int | None) -> int:
    robots = robots_in(folder)
    if not robots:
        log = folder / "log.csv"
        tables = sorted(file.name for file in folder.glob("*.csv"))
        hint = f" with {', '.join(tables[:4])}: rename their columns" if tables else ""
        hint = f"; did you mean {log}?" if log.is_file() else hint
        raise slamlog.LogError(
            f"{folder}: expected a log, or a folder with Robot<k>_Odometry.dat (UTIAS "
            "MR.CLAM), aa3_dr.mat (Victoria Park) or csv files with named columns "
            "(odometry.csv with t, d, alpha or t, v, omega; measurements.csv with t, "
            f"id, bearing, range), got another folder{hint}"
        )
    if robot is None:
        return robots[0]
    if robot not in robots:
        numbers = ", ".join(map(str, robots))
        raise slamlog.LogError(
            f"{folder}: expected one of the robots {numbers}, got {robot}"
        )
    return robot


def _read_measurements(
    folder: Path, robot: int, *, epoch: float, end: float
) -> tuple[TimedReadings, str]:
    """Read the robot's readings of landmarks, and count those left out."""
    subjects = _read_barcodes(folder)
    readings: TimedReadings = []
    robots = unknown = outside = 0
    path = folder / f"Robot{robot}_Measurement.dat"
    for line in _timed_lines(path, "t barcode range bearing"):
        stamp, code, distance, bearing = line.text.split()
        t = round(line.to_real(stamp) - epoch, TIME_DIGITS)
        subject = subjects.get(line.to_id(code))
        if subject is None:
            unknown += 1
        elif subject <= LAST_ROBOT:
            robots += 1
        elif not 0 <= t <= end:
            outside += 1
        else:
            angle = slamlog.wrap_bearing(line.to_real(bearing))
            reading = slamlog.Reading(t, subject, angle, line.to_real(distance))
            readings.append((line, reading))
    return readings, (
        f"{robots} readings of robots, {unknown} of unknown barcodes, "
        f"{outside} outside the time of the odometry"
    )


def _read_barcodes(folder: Path) -> dict[int, int]:
    """Read the subject of each barcode."""
    lines = _lines(folder / "Barcodes.dat", "subject barcode")
    pairs = ((line, line.text.split()) for line in lines)
    return {line.to_id(code): line.to_id(subject) for line, (subject, code) in pairs}


def _read_landmarks(folder: Path) -> tuple[IntArray, Array]:
    """Read subject numbers (n,) and true positions (n, 2) [m]."""
    lines = _lines(folder / "Landmark_Groundtruth.dat", "subject x y σx σy")
    rows = [(line, line.text.split()) for line in lines]
    ids = [line.to_id(fields[0]) for line, fields in rows]
    for place, (line, fields) in enumerate(rows):
        if ids[place] in ids[:place]:
            raise line.error("each subject once", fields[0])
    positions = [[line.to_real(x) for x in fields[1:3]] for line, fields in rows]
    return np.array(ids, dtype=np.int64), np.array(positions)


def _read_truth(path: Path, epoch: float) -> Array:
    """Read the true path (n, 4), rows (t, x, y, θ), t since the epoch."""
    if not path.is_file():
        return np.empty((0, 4))
    truth = _timed_table(path, "t x y θ")
    truth[:, 0] = np.round(truth[:, 0] - epoch, TIME_DIGITS)
    return truth


def _merge(odometry: Array, readings: TimedReadings) -> tuple[slamlog.Event, ...]:
    """Integrate the velocities between the times of grid and readings."""
    stamps = odometry[:, 0]
    moved = odometry[:-1, 1:] * np.diff(stamps)[:, None]
    seen: dict[float, TimedReadings] = {}
    for line, reading in readings:
        seen.setdefault(reading.t, []).append((line, reading))
    recorder = slamlog.EventRecorder()
    for row in odometry_between(stamps, moved, [reading.t for _, reading in readings]):
        recorder.add_row(MERGED, row)
        for line, reading in seen.get(row.t, []):
            recorder.add_reading(line, reading)
    return recorder.finish()


def odometry_between(
    stamps: Array, moved: Array, others: Sequence[float]
) -> list[slamlog.OdometryRow]:
    """Return the odometry between the times of a grid of 10 Hz and other times.

    Parameters
    ----------
    stamps : ndarray, shape (n,)
        Times of the odometry [s]; the last one is the end.
    moved : ndarray, shape (n - 1, 2)
        (d, α) between them [m, rad]; each is constant in time.
    others : sequence of float
        Further times at which a row must end, such as those of the scans.
    """
    end = float(stamps[-1])
    travelled = np.concatenate([np.zeros((1, 2)), np.cumsum(moved, axis=0)])
    grid = np.round(np.arange(0, end, ODOMETRY_STEP), TIME_DIGITS)
    times = np.unique([*grid, *others, end])
    path = [np.interp(times, stamps, column) for column in travelled.T]
    dt, *steps = np.diff([times, *path], axis=1, prepend=0)
    rows = np.column_stack([times, *steps, dt])
    return [slamlog.OdometryRow(*row) for row in rows.tolist()]


def _resample(truth: Array, end: float) -> Array:
    """Interpolate the true path on a grid within the time of the odometry."""
    times = np.round(np.arange(0, end + TRUTH_STEP / 2, TRUTH_STEP), TIME_DIGITS)
    poses = poses_at(times, truth)
    return np.column_stack([times, poses])[np.isfinite(poses).all(axis=1)]


def _timed_table(path: Path, form: str) -> Array:
    """Read rows of numbers (n, fields of the form), the first one a time."""
    lines = _timed_lines(path, form)
    return np.array([[line.to_real(x) for x in line.text.split()] for line in lines])


def _timed_lines(path: Path, form: str) -> list[log_lines.LogLine]:
    """Read lines whose first field is a time that does not decrease."""
    lines, before = _lines(path, form), -np.inf
    for line in lines:
        stamp = line.to_real(line.text.split()[0])
        if stamp < before:
            raise line.error(f"t >= {before}, the time before", str(stamp))
        before = stamp
    return lines


def _lines(path: Path, form: str) -> list[log_lines.LogLine]:
    """Read all lines except comments; refuse other numbers of fields than `form`."""
    lines = log_lines.content_of(log_lines.read_lines(there(path)))
    for line in lines:
        line.check_count(line.text.split(), (len(form.split()),), form)
    return lines


def there(path: Path, what: str = "") -> Path:
    """Return the path of an existing file; raise a `LogError` if there is none."""
    if not path.is_file():
        name = f"{path.name}{what}"
        raise slamlog.LogError(f"{path.parent}: expected {name}, got no such file")
    return path
