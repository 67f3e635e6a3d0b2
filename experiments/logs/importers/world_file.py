"""Files ``world.dat``: true landmark positions, lines ``id x y``."""

from os import PathLike
from pathlib import Path

import numpy as np

from ....arrays import Array, IntArray
from ..lines import read_lines


def read_world(
    path: str | PathLike[str],
) -> tuple[IntArray, Array]:
    """Read landmark ids (n,) and positions (n, 2) [m].

    Raises
    ------
    LogError
        If a line is not ``id x y``, or an id comes twice.
    OSError
        If the file cannot be opened.
    """
    positions: dict[int, tuple[float, float]] = {}
    for line in read_lines(path):
        fields = line.text.split()
        line.check_count(fields, (3,), "id x y")
        landmark_id = line.to_id(fields[0])
        if landmark_id in positions:
            raise line.error("each landmark once", f"id {landmark_id} again")
        positions[landmark_id] = (line.to_real(fields[1]), line.to_real(fields[2]))
    return np.array(list(positions), dtype=np.int64), np.array(list(positions.values()))


def world_beside(path: str | PathLike[str]) -> Path | None:
    """Return the ``world.dat`` in the folder of a log, if there is one.

    Examples
    --------
    >>> world_beside("nowhere/data.txt") is None
    True
    """
    world = Path(path).parent / "world.dat"
    return world if world.is_file() else None
