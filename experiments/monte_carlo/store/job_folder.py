"""The folder of a Monte Carlo: it belongs to one job (``job.json``) and one writer."""

import contextlib
import hashlib
import json
import os
import re
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from ....sim_configs.atomic_file import replace_when_written
from ...runs.folder_lock import locked_folder, naming_folder
from ...runs.own_files import files_below, own_entry, own_files, set_aside

FORMAT = "slamgym monte carlo 3"
JOB, BLOCKS, RESULTS = "job.json", "blocks", "results.nc"
REPORT, SUMMARY = "report.html", "summary.json"
_PARTIAL = re.compile(
    r"\.{1,2}(job|results|report|summary|slamgym_files|runs-\d{7,}-\d{7,})"
    r"(\.[0-9a-f]{8}){1,2}\.(json|nc|html|npz)"
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
        Whether to remove the results of an earlier job, this one or another. Files
        that were changed since are set aside with a warning.

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
        found = None
        if any(not _is_leftover(Path(name)) for name in files_below(path)):
            found = identity_in(path)
            if not fresh:
                refuse_other(path, found, identity)
        with naming_folder(path):
            for file in (*path.iterdir(), *(path / BLOCKS).glob(".*")):
                if _is_leftover(file):
                    file.unlink()
            if fresh and found:
                _clear(path, found)
            with replace_when_written(path / JOB) as partial:
                text = json.dumps(identity, indent=2, ensure_ascii=False)
                partial.write_text(text + "\n", encoding="utf-8")
            (path / BLOCKS).mkdir(exist_ok=True)
        yield


def _clear(path: Path, identity: dict[str, Any]) -> None:
    """Remove the results of a job, and set aside what is not proven to be one."""
    digest, own = digest_of(identity), own_files(path)
    for block in blocks_in(path):
        problem = problem_with(block, digest)
        if problem:
            set_aside(block, problem)
        else:
            block.unlink()
    for name in (RESULTS, REPORT, SUMMARY):
        if not os.path.lexists(path / name):
            continue
        if own_entry(path, name, own):
            (path / name).unlink()
        else:
            set_aside(path / name, "is not as slamgym wrote it")


def blocks_in(path: Path) -> list[Path]:
    """List the whole blocks of a folder, in order."""
    return sorted((path / BLOCKS).glob("runs-*.npz"))


def problem_with(block: Path, digest: str) -> str:
    """Return what is wrong with a block of a job; empty if it is complete.

    Raises
    ------
    ValueError
        If it is of another job.
    """
    try:
        with zipfile.ZipFile(block) as archive:
            if archive.testzip() is not None:
                return "is damaged"
        with np.load(block, allow_pickle=False) as arrays:
            job = str(arrays["job"])
    except (ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        return f"is truncated or damaged ({error})"
    if job != digest:
        raise ValueError(f"{block} is of another job than its folder: move it away")
    return ""


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


def _is_leftover(file: Path) -> bool:
    """Whether a writer that was killed at once may have left this file."""
    return _PARTIAL.fullmatch(file.name) is not None


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
