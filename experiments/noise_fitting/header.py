"""Write a noise into the header of a log's file, and change nothing else."""

from __future__ import annotations

from os import PathLike
from pathlib import Path

from ..logs.lines import LogError, read_lines, write_whole
from ..logs.slamlog import FORMAT_LINE, numbers
from ..runs.filter_settings import FilterSettings


def refuse_other_formats(path: str | PathLike[str]) -> None:
    """Refuse a log that has no header for a noise.

    Raises
    ------
    LogError
        If the file is no slamlog 1.
    """
    is_file = Path(path).is_file()
    first = "".join(read_lines(path)[0].text.split()) if is_file else ""
    if first != "".join(FORMAT_LINE.split()):
        raise LogError(
            f"{path}: only the header of a slamlog 1 holds a noise; slamgym replay "
            "writes one of any log, log.csv"
        )


def write_noise(path: str | PathLike[str], settings: FilterSettings) -> None:
    """Put the noise of settings into the header of a slamlog 1.

    Every other line keeps its bytes.  The file is replaced at once or not at all.

    Parameters
    ----------
    path : path
        The file.
    settings : FilterSettings
        Their motion_std, measurement_std, range_std_per_metre and bearing_std_metres.

    Raises
    ------
    LogError
        If the file is no slamlog 1, or cannot be written.
    """
    refuse_other_formats(path)
    values = {
        "motion_std": numbers(*settings.motion_std),
        "measurement_std": numbers(*settings.measurement_std),
    }
    for key in ("range_std_per_metre", "bearing_std_metres"):
        if key in settings.options:
            values[key] = numbers(settings.options[key])
    with Path(path).open(encoding="utf-8", newline="") as stream:
        lines = stream.read().split("\n")
    write_whole(path, "\n".join(_with_header(lines, values)))


def _with_header(lines: list[str], values: dict[str, str]) -> list[str]:
    """Replace the header's lines of some keys; add the others below its first line."""
    keys = [_key(line) for line in lines]
    end = "\r" if any(line.endswith("\r") for line in lines) else ""
    result = [
        f"# {key}: {values[key]}{end}" if key in values else line
        for key, line in zip(keys, lines, strict=True)
    ]
    first = next(k for k, line in enumerate(lines) if line.strip())
    added = [f"# {key}: {values[key]}{end}" for key in values if key not in keys]
    return [*result[: first + 1], *added, *result[first + 1 :]]


def _key(line: str) -> str | None:
    """Return the key of a line of the header, None for another line."""
    text = line.strip()
    return text[1:].partition(":")[0].strip() if text.startswith("#") else None
