"""Read the Victoria Park data set by its own drive: speed and steering of the car.

``aa3_dr.mat`` (``time`` [ms], ``speed`` [m/s] of the left rear wheel, ``steering``
[rad]) and ``aa3_gpsx.mat`` (``timeGps`` [ms], ``Lo_m``, ``La_m`` [m]) are those of the
data set. ``victoria_park.csv`` beside them is a `slamlog` whose scans are the trees,
relative to the middle of the rear axle; its own odometry is not used.

References
----------
J. Guivant, E. Nebot, Optimization of the simultaneous localization and map-building
algorithm for real-time implementation, IEEE T-RA 17(3), 2001.
"""

from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from ....arrays import Array
from ....estimator.models.motions import bicycle
from .. import slamlog
from .utias import TIME_DIGITS, odometry_between, there

DRIVE, GPS, TREES = "aa3_dr.mat", "aa3_gpsx.mat", "victoria_park.csv"
EPOCH = 20.967  # [s] on the car's clock: the time 0 of the trees, the first GPS fix
ENCODER = 0.76  # the left rear wheel is so far from the middle of the axle [m]
WHEELBASE = 2.83  # [m]
CAR = bicycle(WHEELBASE)  # the pose is that of the middle of the rear axle
ANTENNA = "3.78,0.5"  # ahead and to the left of it [m]


def read_victoria_park(path: str | PathLike[str]) -> slamlog.SlamLog:
    """Read the drive from the folder of the three files.

    Speed and steering are constant between their stamps. With the distance H of the
    encoder from the middle of the axle and the wheelbase L, the axle moves at
    v = v_encoder / (1 − tan φ H / L). The motion of the bicycle is integrated onto a
    grid of 10 Hz, which is split at each scan.

    Parameters
    ----------
    path : path
        The folder.

    Returns
    -------
    SlamLog
        Motion midpoint, in seconds; the GPS is the ground truth.

    Raises
    ------
    LogError
        If a file is missing or malformed.
    """
    folder = Path(path)
    stamps, speed, steering = _columns(folder / DRIVE, "time", "speed", "steering")
    times, x, y = _columns(folder / GPS, "timeGps", "Lo_m", "La_m")
    trees = slamlog.read_slamlog(there(folder / TREES, " with the trees"))
    if (np.abs(steering) >= np.pi / 4).any():
        raise slamlog.LogError(
            f"{folder / DRIVE}: expected steering within ±π/4, "
            f"got {np.abs(steering).max():g}"
        )
    axle = speed / (1 - np.tan(steering) * ENCODER / WHEELBASE)
    driven = np.column_stack([axle[:-1] * np.diff(stamps), steering[:-1]])
    turned = CAR.displacements(driven)[:, 2]
    end = float(stamps[-1])
    scans = {scan.t: scan for scan in trees.scans if 0 <= scan.t <= end}
    moved = np.column_stack([driven[:, 0], turned])
    events: list[slamlog.Event] = []
    for row in odometry_between(stamps, moved, list(scans)):
        chord = row.d * float(np.sinc(row.alpha / (2 * np.pi)))  # of the arc
        events.append(replace(row, d=chord))
        if row.t in scans:
            events.append(scans[row.t])
    return slamlog.SlamLog(
        name="victoria_park_by_its_drive",
        header={
            "source": f"Victoria Park, {DRIVE} and {GPS}; {TREES}",
            "drive": CAR.name,
            "epoch": repr(EPOCH),
            "groundtruth_kind": "GPS",
            "groundtruth_offset": ANTENNA,
            "left_out": f"{len(trees.scans) - len(scans)} scans not during the drive",
        },
        motion="midpoint",
        events=tuple(events),
        ground_truth=np.column_stack([times, x, y, np.full(len(x), np.nan)]),
    )


def _columns(path: Path, time: str, *names: str) -> list[Array]:
    """Read columns of a MATLAB file; the first one is a time [ms], returned in s."""
    from scipy.io import loadmat  # noqa: PLC0415 (slow to import)

    file = str(there(path))
    try:
        found: dict[str, Any] = loadmat(file, variable_names=(time, *names))
    except Exception as error:  # of many kinds
        raise slamlog.LogError(f"{path}: expected a MATLAB file, {error}") from None
    columns = []
    for name in (time, *names):
        numbers = np.asarray(found.get(name, [])).ravel()
        column = numbers.astype(np.float64, casting="unsafe")
        columns.append(column)
        if len(column) < 2 or len(column) != len(columns[0]):
            raise slamlog.LogError(
                f"{path}: expected columns {time}, {', '.join(names)} of equal length, "
                f"got {len(column)} numbers of {name}"
            )
        if not np.isfinite(column).all():
            raise slamlog.LogError(f"{path}: expected finite numbers in {name}")
    columns[0] = np.round(columns[0] / 1000 - EPOCH, TIME_DIGITS)
    if (np.diff(columns[0]) < 0).any():
        raise slamlog.LogError(f"{path}: expected {time} that never decreases")
    return columns
