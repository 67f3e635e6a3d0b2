"""The noise that the information matrices of a graph specify, as a filter assumes it.

An edge with the information Ω claims the standard deviation ``sqrt(uᵀ Ω⁻¹ u)`` along a
unit vector u. For odometry u is along and across the drive, and in the turn; for a
reading it is along and across the line of sight. Correlations are ignored.

Three conventions are in use:

* iSAM's ``ODOMETRY``, ``EDGE2`` and ``LANDMARK`` lines hold the upper triangular R of
  Ω = Rᵀ R by rows, in the frame of pose i.
* g2o's ``EDGE_SE2`` and ``EDGE_SE2_XY`` lines hold the upper triangle of Ω by rows;
  that of an ``EDGE_SE2`` is in the frame of pose j.
* A file with ``VERTEX2`` lines is TORO's, whose ``EDGE2`` lines hold Ω in the order xx,
  xy, yy, θθ, xθ, yθ.
"""

import math
from collections.abc import Sequence

import numpy as np

from ....arrays import Array
from ..lines import LogLine
from ..slamlog import numbers
from .graph import Graph, reals_at

ALIKE = 1e-3
"""Relative difference of standard deviations up to which they count as equal."""

G2O, ISAM, TORO = "g2o", "iSAM", "TORO"
_ROWS = {2: (0, 1, 1, 2), 3: (0, 1, 2, 1, 3, 4, 2, 4, 5)}
_TORO_ROWS = (0, 1, 4, 1, 2, 5, 4, 5, 3)


def noise_header(graph: Graph, chain: Sequence[LogLine]) -> dict[str, str]:
    """Return the noise of a graph as entries of a log's header.

    Each standard deviation is the median over the lines. Readings have the bearing
    noise σβ or, if this fits better, the noise b across the line of sight of a sensor
    of positions, so that σβ = b / r.

    Returns
    -------
    dict of str to str
        ``motion_std``, ``measurement_std`` if the graph has readings,
        ``bearing_std_metres`` for a sensor of positions, and ``noise``, which states
        whether the matrices differ.

    Raises
    ------
    LogError
        If a line has no information, or a singular or indefinite one.
    """
    is_toro = any(line.text.split()[0] == "VERTEX2" for line in graph.vertices)
    motion = np.array([_motion_std(line, is_toro=is_toro) for line in chain])
    header = {"motion_std": numbers(*np.median(motion, axis=0))}
    are_alike = _alike(motion)
    lines = [line for at_pose in graph.readings.values() for line in at_pose]
    if lines:
        sensor, stds = _sensor_noise(lines)
        header |= sensor
        are_alike &= _alike(stds)
    what = "its" if are_alike else "the medians of its differing"
    return {**header, "noise": f"from the file, by {what} information matrices"}


def _sensor_noise(lines: Sequence[LogLine]) -> tuple[dict[str, str], Array]:
    """Return the entries of the readings, and the deviations that they are from."""
    bearing, across, along = np.array([_reading_std(line) for line in lines]).T
    if _spread(across) < _spread(bearing):
        sensor = {"bearing_std_metres": numbers(np.median(across))}
        sensor["measurement_std"] = numbers(0.0, np.median(along))
        return sensor, np.column_stack([across, along])
    stds = numbers(float(np.median(bearing)), np.median(along))
    return {"measurement_std": stds}, np.column_stack([bearing, along])


def _motion_std(line: LogLine, *, is_toro: bool) -> Array:
    """Return (σx, σy, σα) along the drive, across, and of the turn."""
    dx, dy, turn = reals_at(line, 3, 6)
    angle = math.atan(dy / dx) if dx else math.copysign(math.pi / 2, dy) * (dy != 0)
    tag = line.text.split()[0]
    kind = {"EDGE_SE2": G2O, "EDGE2": TORO if is_toro else ISAM}.get(tag, ISAM)
    if kind == G2O:
        angle -= turn
    cos, sin = math.cos(angle), math.sin(angle)
    return _stds(line, 6, kind, np.array([(cos, sin, 0), (-sin, cos, 0), (0, 0, 1)]))


def _reading_std(line: LogLine) -> Array:
    """Return the standard deviations of the bearing, across, and of the range."""
    x, y = reals_at(line, 3, 5)
    distance = math.hypot(x, y)
    if not distance:
        raise line.error("a landmark away from its pose", "distance 0")
    cos, sin = x / distance, y / distance
    kind = ISAM if line.text.split()[0] == "LANDMARK" else G2O
    across, along = _stds(line, 5, kind, np.array([(-sin, cos), (cos, sin)]))
    return np.array([across / distance, across, along])


def _stds(line: LogLine, first: int, kind: str, directions: Array) -> Array:
    """Return the standard deviation along each row of ``directions``."""
    values = np.array(reals_at(line, first))
    if not len(values):
        raise line.error("information at the end of the line", "none")
    size = directions.shape[1]
    rows = _TORO_ROWS if kind == TORO and size == 3 else _ROWS[size]
    matrix = values[list(rows)].reshape(size, size)
    if kind == ISAM:
        upper = np.triu(matrix)
        matrix = upper.T @ upper
    try:
        lower = np.linalg.cholesky(matrix)
    except np.linalg.LinAlgError:
        raise line.error("positive definite information", line.text) from None
    # with Ω = L Lᵀ, uᵀ Ω⁻¹ u = ‖L⁻¹ u‖²
    return np.asarray(np.linalg.norm(np.linalg.solve(lower, directions.T), axis=0))


def _alike(table: Array) -> bool:
    """Whether the rows of a table are equal but for rounding."""
    return bool(np.allclose(table, np.median(table, axis=0), rtol=ALIKE, atol=0))


def _spread(values: Array) -> float:
    """Return how much positive numbers differ, relative to their size."""
    return float(np.std(np.log(values)))
