"""Read a log for a command, and note what its importer chose."""

from pathlib import Path

from ..logs.importers import read_log
from ..logs.slamlog import SlamLog
from .errors import BadInputError
from .reporter import Reporter


def read_any_log(
    path: Path,
    robot: int | None = None,
    *,
    truth: Path | None = None,
    noise_from_file: bool = False,
) -> SlamLog:
    """Read a log of any known format, with its truth if that is in another file.

    Raises
    ------
    BadInputError
        If a file cannot be opened.
    LogError
        If one is malformed.
    """
    try:
        return read_log(path, robot=robot, truth=truth, noise_from_file=noise_from_file)
    except OSError as error:
        reason, file = error.strerror or error, error.filename or path
        raise BadInputError(f"cannot read the log {file}: {reason}") from error


def note_choices(log: SlamLog, reporter: Reporter) -> None:
    """Note what the importer of a log omitted, and the noise it found."""
    if "left_out" in log.header:
        reporter.note(f"left out of the log: {log.header['left_out']}")
    if "noise" in log.header:
        reporter.note(f"noise {log.header['noise']}")
