"""The folder of a Monte Carlo: it belongs to one job (``job.json``) and one writer."""

import contextlib
import hashlib
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from ....sim_configs.atomic_file import replace_when_written
from ...runs.folder_lock import WRITER, locked_folder, naming_folder

FORMAT = "slamgym monte carlo 3"
JOB, BLOCKS, RESULTS = "job.json", "blocks", "results.nc"
_PARTIAL = re.compile(
    r"\.(job\.[0-9a-f]{8}\.json|results\.[0-9a-f]{8}\.nc"
    r"|runs-\d{7,}-\d{7,}\.[0-9a-f]{8}\.npz)"
)


@contextlib.contextmanager
def claimed(
    path: Path, identity: dict[str, Any], *, fresh: bool = False
) -> Iterator[None]:
    """Make a folder for a job, or check that it is the job's, and lock it.

    Files that a killed writer left half written are removed.

    Parameters
    ----------
    path : Path
        The folder; it is made if it does not exist.
    identity : dict
        The job in plain values.
    fresh : bool
        Whether to remove the blocks of an earlier job, this one or another.

    Raises
    ------
    ValueError
        If the folder holds another job, or what slamgym did not write, or another
        process writes to it.
    OSError
        If it cannot be written.
    """
    with naming_folder(path):
        path.mkdir(parents=True, exist_ok=True)
    with locked_folder(path):
        if any(not _is_leftover(entry) for entry in path.iterdir()):
            found = identity_in(path)
            if not fresh:
                refuse_other(path, found, identity)
        with naming_folder(path):
            for leftover in (*path.iterdir(), *(path / BLOCKS).glob(".*")):
                if _PARTIAL.fullmatch(leftover.name):
                    leftover.unlink()
            for old in (*blocks_in(path), path / RESULTS) if fresh else ():
                old.unlink(missing_ok=True)
            with replace_when_written(path / JOB) as partial:
                text = json.dumps(identity, indent=2, ensure_ascii=False)
                partial.write_text(text + "\n", encoding="utf-8")
            (path / BLOCKS).mkdir(exist_ok=True)
        yield


def blocks_in(path: Path) -> list[Path]:
    """List the whole blocks of a folder, in order."""
    return sorted((path / BLOCKS).glob("runs-*.npz"))


def digest_of(identity: dict[str, Any]) -> str:
    """Return the digest that identifies a job in its blocks."""
    text = json.dumps(identity, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


def identity_in(path: Path) -> dict[str, Any]:
    """Read the job of a folder.

    Raises
    ------
    ValueError
        If there is none.
    """
    file = path / JOB
    if not file.exists():
        raise ValueError(f"{path} holds no Monte Carlo of slamgym: there is no {JOB}")
    try:
        identity = json.loads(file.read_text(encoding="utf-8"))
    except (ValueError, RecursionError):
        identity = None
    if not isinstance(identity, dict) or identity.get("format") != FORMAT:
        raise ValueError(f"{file} is damaged, or not of a Monte Carlo of slamgym")
    return identity


def refuse_other(path: Path, found: dict[str, Any], asked: dict[str, Any]) -> None:
    """Refuse a folder of another job.

    Raises
    ------
    ValueError
        With the first difference.
    """
    for key, value in asked.items():
        if found.get(key) != value:
            raise ValueError(
                f"{path} holds results of {_described(key, found.get(key))}, "
                f"not of {_described(key, value)}: "
                "choose another folder, or ask for fresh results"
            )


def _is_leftover(entry: Path) -> bool:
    """Whether a writer that was killed at once may have left this file."""
    return entry.name == WRITER or _PARTIAL.fullmatch(entry.name) is not None


def _described(key: str, value: Any) -> str:
    """Describe a part of a job in a few words."""
    if key in ("scenario", "assumed"):
        lines = str(value).splitlines()
        digest = hashlib.sha256(str(value).encode()).hexdigest()[:8]
        return f"{key} {lines[0].removeprefix('name = ') if lines else ''} ({digest})"
    if key == "estimators" and isinstance(value, dict):
        return f"estimators {', '.join(value)}"
    if key == "code" and isinstance(value, dict):
        return f"code {', '.join(f'{k} {v}' for k, v in value.items())}"
    return f"{key} {value}"
