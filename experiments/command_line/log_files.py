"""Read a log for a command, and note what its importer chose."""

from collections.abc import Collection
from pathlib import Path

from ...sim_configs import list_presets
from ..logs.anonymous import without_identities
from ..logs.importers import read_log
from ..logs.slamlog import SlamLog
from ..runs.filter_settings import FilterSettings
from .errors import BadInputError
from .reporter import Reporter


def read_any_log(
    path: Path,
    robot: int | None = None,
    *,
    truth: Path | None = None,
    noise_from_file: bool = False,
    hide_identities: bool = False,
) -> SlamLog:
    """Read a log of any known format, with its truth if that is in another file.

    ``hide_identities`` keeps the identities of its readings for scores alone.

    Raises
    ------
    BadInputError
        If a file cannot be opened, or does not fit into memory.
    LogError
        If one is malformed.
    """
    try:
        log = read_log(path, robot=robot, truth=truth, noise_from_file=noise_from_file)
    except OSError as error:
        reason, file = error.strerror or error, error.filename or path
        hint = ""
        if str(path) in list_presets():
            hint = f"; {path} is a scenario: slamgym run {path}"
        raise BadInputError(f"cannot read the log {file}: {reason}{hint}") from error
    except MemoryError as error:
        raise BadInputError(f"the log {path} does not fit into memory") from error
    return without_identities(log) if hide_identities else log


def note_choices(log: SlamLog, reporter: Reporter) -> None:
    """Note what the importer of a log omitted, and where its noise is from."""
    if "left_out" in log.header:
        reporter.note(f"left out of the log: {log.header['left_out']}")
    if "noise" in log.header and "motion_std" in log.header:
        reporter.note(f"noise {log.header['noise']}")


def note_noise(
    log: SlamLog, settings: FilterSettings, given: Collection[str], reporter: Reporter
) -> None:
    """Note the noise of a log's filter, without what the user gave."""
    options = {
        "range_std_per_metre": settings.options.get("range_std_per_metre"),
        "bearing_std_metres": settings.options.get("bearing_std_metres"),
    }
    values = {
        "motion_std": settings.motion_std,
        "measurement_std": settings.measurement_std,
        "initial_pose_std": settings.initial_pose_std,
        **{name: (std,) for name, std in options.items() if std},
    }
    found = [
        f"{name} {','.join(f'{std:.6g}' for std in stds)}"
        for name, stds in values.items()
        if name not in given and (any(stds) or name != "initial_pose_std")
    ]
    if found:
        reporter.note(f"noise of {log.name}: {'; '.join(found)}")
