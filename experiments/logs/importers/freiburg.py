"""The log of the Freiburg robot mapping course (``sensor.dat`` and ``world.dat``).

Lines ``ODOMETRY r1 t r2`` (turn r1, drive t, turn r2) and ``SENSOR id range bearing``.
"""

from os import PathLike
from pathlib import Path

import numpy as np

from ..events import EventRecorder, Reading, wrap_bearing
from ..lines import read_lines, shown
from ..slamlog import SlamLog
from .world_file import read_world, world_beside

ROW_FORMS = {"ODOMETRY": "ODOMETRY r1 t r2", "SENSOR": "SENSOR id range bearing"}


def read_freiburg(path: str | PathLike[str]) -> SlamLog:
    """Read a Freiburg log, and its landmarks if ``world.dat`` is in the same folder.

    Each step becomes two turn-last rows, (0, r1) with dt = 0 and (t, r2) with dt = 1,
    which is the same motion. Bearings are wrapped into [-π, π).

    Parameters
    ----------
    path : path
        The file of ODOMETRY and SENSOR lines.

    Returns
    -------
    SlamLog
        Motion turn-last, one unit of time per step, starting at the origin.

    Raises
    ------
    LogError
        If a line is of another kind.
    OSError
        If the file cannot be opened.
    """
    recorder, step = EventRecorder(), 0
    for line in read_lines(path):
        kind, *fields = line.text.split()
        if kind not in ROW_FORMS:
            raise line.error(" or ".join(ROW_FORMS.values()), shown(line.text))
        line.check_count(fields, (3,), ROW_FORMS[kind])
        if kind == "ODOMETRY":
            step += 1
            before, d, after = map(line.to_real, fields)
            recorder.add_turn_drive_turn(line, step, before=before, d=d, after=after)
        else:
            bearing = wrap_bearing(line.to_real(fields[2]))
            landmark_id, distance = line.to_id(fields[0]), line.to_real(fields[1])
            recorder.add_reading(
                line, Reading(float(step), landmark_id, bearing, distance)
            )
    world = world_beside(path)
    ids, landmarks = read_world(world) if world else (np.arange(0), np.empty((0, 2)))
    return SlamLog(
        name=Path(path).stem,
        header={
            "source": "Freiburg robot mapping course",
            "truth": world.name if world else "none",
        },
        landmark_ids=ids,
        landmarks=landmarks,
        events=recorder.finish(),
    )
