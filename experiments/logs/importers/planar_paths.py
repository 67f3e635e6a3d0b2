"""True paths in the files of other programs: `path_format_of`, `path_of`.

TUM has rows ``t x y z qx qy qz qw``, KITTI the twelve entries of the 3 × 4 matrix [R t]
by rows, without times, and EuRoC rows ``t [ns], x, y, z, qw, qx, qy, qz, …``. Four
numbers in a row are ``t x y θ``, as in UTIAS. Poses in space are projected onto the
plane in which the robot turns.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ....arrays import Array, BoolArray
from .. import log_lines, slamlog

#: Tilt up to which a pose counts as one in the plane [rad]: steep roads stay below it.
MOST_TILT = np.deg2rad(30)
_UNIT = 5e-2  # how far a quaternion or a rotation may be from its unit length


#: Numbers of a covariance after the pose of TUM, which have no meaning for a truth.
TUM_SIZES = (0, 6, 9, 21, 36)


class TruePath(NamedTuple):
    """The true path of a robot."""

    #: Rows (t, x, y, θ), shape (n, 4) [s, m, m, rad]; θ nan where unknown.
    rows: Array
    #: Whether t is a time, or only counts the poses.
    has_times: bool = True


def numeric_rows(lines: list[log_lines.LogLine]) -> Array | None:
    """Return the numbers of a file whose rows have equal length; None for other files.

    The result is also None for numbers beyond `log_lines.LARGEST`.
    """
    rows = [log_lines.split_fields(line.text) for line in lines]
    if len({len(row) for row in rows}) > 1:
        return None
    try:
        table = np.array(rows, dtype=np.float64)
    except ValueError:
        return None
    return table if (abs(table) <= log_lines.LARGEST).all() else None


def path_format_of(table: Array) -> str:
    """Return which format of true paths a table of numbers has; empty if none."""
    columns = table.shape[1]
    if columns == 12 and _are_rotations(table.reshape(-1, 3, 4)[:, :, :3]):
        return "KITTI"
    if columns >= 8 and _have_unit_length(table[:, 4:8]).all():
        if columns != 8 and float(np.abs(table[:, 0]).min()) > 1e14:
            return "EuRoC"
        return "TUM" if columns - 8 in TUM_SIZES else ""
    return ""


def _have_unit_length(quaternions: Array) -> BoolArray:
    return np.asarray(abs(np.linalg.norm(quaternions, axis=1) - 1) < _UNIT)


def _are_rotations(matrices: Array) -> bool:
    products = matrices @ matrices.swapaxes(1, 2)
    return bool((abs(products - np.eye(3)) < _UNIT).all())


def path_of(table: Array, kind: str, lines: Sequence[log_lines.LogLine]) -> TruePath:
    """Return the path in a table of a known format, given the line of each row."""
    if kind == "KITTI":
        poses = _planar_matrices(table.reshape(-1, 3, 4), lines)
        return TruePath(np.column_stack([np.arange(len(poses)), poses]), False)
    quaternions = table[:, [5, 6, 7, 4]] if kind == "EuRoC" else table[:, 4:8]
    headings = heading_of(quaternions, lines)
    times = table[:, 0] * (1e-9 if kind == "EuRoC" else 1.0)
    return TruePath(np.column_stack([times, table[:, 1:3], headings]))


def heading_of(quaternions: Array, lines: Sequence[log_lines.LogLine]) -> Array:
    """Return the headings of unit quaternions (n, 4), in the order x, y, z, w.

    Parameters
    ----------
    quaternions : ndarray, shape (n, 4)
        Unit quaternions, except for rounding.
    lines : sequence of LogLine
        The line of each quaternion.

    Raises
    ------
    LogError
        If a quaternion is far from unit length, or a pose is tilted, so that it has no
        heading in the plane.
    """
    strange = ~_have_unit_length(quaternions)
    if strange.any():
        k = int(strange.argmax())
        raise lines[k].error(
            "a quaternion (x, y, z, w) of unit length",
            f"{tuple(quaternions[k].tolist())}: divide it by its length, or remove its "
            "columns",
        )
    qx, qy, qz, qw = quaternions.T
    squares = qw * qw + qx * qx + qy * qy + qz * qz
    tilts = qw * qw - qx * qx - qy * qy + qz * qz < np.cos(MOST_TILT) * squares
    if tilts.any():
        raise _tilted(lines, int(tilts.argmax()))
    sine, cosine = 2 * (qw * qz + qx * qy), qw * qw + qx * qx - qy * qy - qz * qz
    return np.asarray(np.arctan2(sine, cosine))


def _planar_matrices(matrices: Array, lines: Sequence[log_lines.LogLine]) -> Array:
    """Project matrices [R t] onto the plane about whose normal they turn.

    With z up it is that of x and y. A camera looks along z with x to the right and y
    down, so that its plane has the axes z and -x.
    """
    about_z, about_y = (matrices[:, k, k].min() for k in (2, 1))
    _, y, z = np.ptp(matrices[:, :, 3], axis=0)
    is_camera = about_y > about_z if min(about_y, about_z) < 0.999 else z > y
    if max(about_z, about_y) < np.cos(MOST_TILT):
        normal = 1 if is_camera else 2
        raise _tilted(lines, int(matrices[:, normal, normal].argmin()))
    if is_camera:
        headings = np.arctan2(-matrices[:, 0, 2], matrices[:, 2, 2])
        return np.column_stack([matrices[:, 2, 3], -matrices[:, 0, 3], headings])
    headings = np.arctan2(matrices[:, 1, 0], matrices[:, 0, 0])
    return np.column_stack([matrices[:, 0, 3], matrices[:, 1, 3], headings])


def _tilted(lines: Sequence[log_lines.LogLine], pose: int) -> slamlog.LogError:
    degrees = round(float(np.rad2deg(MOST_TILT)))
    return lines[pose].error(
        "poses of a robot in the plane",
        f"pose {pose} tilted by more than {degrees}°: convert the poses to a frame of "
        "the robot with z up",
    )
