"""Read a log of any known format."""

from __future__ import annotations

from dataclasses import replace
from os import PathLike
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from .. import log_lines, slamlog
from . import course, graph, utias, victoria_park

EXPECTED = (
    "a log: slamlog 1, a course data.txt, a Freiburg sensor.dat, "
    "iSAM or g2o text, or a folder of UTIAS MR.CLAM or Victoria Park"
)
READERS = {
    "slamlog": slamlog.read_slamlog,
    "course": course.read_course,
    "freiburg": course.read_freiburg,
    "victoria": victoria_park.read_victoria_park,
}


def read_log(
    path: str | PathLike[str],
    *,
    landmarks: ArrayLike | None = None,
    robot: int | None = None,
    truth: str | PathLike[str] | None = None,
    noise_from_file: bool = False,
) -> slamlog.SlamLog:
    """Read a log of any known format, which is detected from the content.

    Parameters
    ----------
    path : path
        A file in the format ``slamlog 1``, a course ``data.txt``, a Freiburg
        ``sensor.dat`` (with ``world.dat`` beside it), an iSAM or g2o text, or the
        folder of a UTIAS MR.CLAM data set, or that of Victoria Park, with
        ``aa3_dr.mat``, ``aa3_gpsx.mat``, and the trees as ``victoria_park.csv``.
    landmarks : array_like, shape (n, 2), optional
        True positions of the landmarks 0, 1, …, n - 1 [m], in place of those in the
        log.
    robot : int, optional
        Which robot of a UTIAS folder; the lowest by default.
    truth : path, optional
        A graph file of the true poses of an iSAM or g2o text, by their ids: ``VERTEX2``
        or ``VERTEX_SE2`` lines, or exact edges.
    noise_from_file : bool, default False
        Whether the header of an iSAM or g2o text gets the noise that the information
        matrices specify: ``motion_std``, ``measurement_std``, ``bearing_std_metres``.

    Returns
    -------
    SlamLog
        The log.

    Raises
    ------
    LogError
        If the content is no log of a known format, or malformed, or if the truth is not
        of the log's poses.
    OSError
        If a file cannot be opened.
    ValueError
        If ``robot`` is given for a log that is no UTIAS folder, or ``truth`` or
        ``noise_from_file`` for one that is no graph.
    """
    source = Path(path)
    if source.is_dir():
        kind = "victoria" if (source / victoria_park.DRIVE).is_file() else "utias"
    else:
        path = log_lines.ReadFile(path)
        kind = _format_of(log_lines.read_lines(path))
    graph_text = "a graph, iSAM or g2o text"
    for name, is_given, needed, what in (
        ("robot", robot is not None, "utias", "a UTIAS folder"),
        ("truth", truth is not None, "isam", graph_text),
        ("noise_from_file", noise_from_file, "isam", graph_text),
    ):
        if is_given and kind != needed:
            raise ValueError(f"{name} needs {what}, but {source} is none")
    if kind == "utias":
        log = utias.read_utias(source, robot=robot)
    elif kind == "isam":
        log = graph.read_isam(path, truth=truth, noise_from_file=noise_from_file)
    else:
        log = READERS[kind](path)
    if landmarks is None:
        return log
    positions = slamlog.float_array("landmarks", landmarks, columns=2)
    return replace(
        log,
        header={**log.header, "truth": "landmarks given by the caller"},
        landmark_ids=np.arange(len(positions)),
        landmarks=positions,
    )


def _format_of(lines: list[log_lines.LogLine]) -> str:
    """Detect the format from the first line of a file that is no comment."""
    if slamlog.format_line_of(lines) is not None:
        return "slamlog"
    line = log_lines.content_of(lines)[0]
    tag, *fields = line.text.split()
    if "," in line.text:
        return "slamlog"
    if (tag, len(fields)) == ("ODOMETRY", 3) or tag == "SENSOR":
        return "freiburg"
    if tag in graph.GRAPH_TAGS or tag.startswith(graph.PREFIXES):
        return "isam"
    try:
        np.array([tag, *fields], dtype=np.float64)
    except ValueError:
        raise line.error(EXPECTED, log_lines.shown(line.text)) from None
    return "course"
