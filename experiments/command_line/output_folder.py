"""The folder that a command writes: it appears complete or not at all."""

import contextlib
import errno
import glob
import json
import os
import re
import secrets
import shutil
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from ...sim_configs.atomic_file import naming_file
from ..logs.lines import LogError
from ..runs.folder_lock import WRITER, locked_folder, naming_folder
from .errors import BadInputError

_HOUR = 3600.0
SUMMARY = "summary.json"
"""Every output folder holds it; its ``files`` lists what slamgym wrote there."""


@contextlib.contextmanager
def output_folder(path: Path) -> Iterator[Path]:
    """Provide a new folder, and move it to `path` when the block ends without error.

    It replaces what slamgym wrote to `path` earlier; a folder that holds anything else
    is refused at once. An error or Ctrl-C leaves everything as it was.

    Parameters
    ----------
    path : Path
        Where the folder appears; missing folders above it are made.

    Yields
    ------
    Path
        An empty folder beside `path`.

    Raises
    ------
    BadInputError
        If `path` is a file, or a folder that holds what slamgym did not write.
    OSError
        If the folder cannot be written.
    """
    path = Path(os.path.realpath(path))  # a link stays, and names the folder to write
    _refuse_foreign_files(path)
    with _parents(path):
        partial = path.with_name(f".{path.name}.{secrets.token_hex(4)}.partial")
        with naming_folder(path):
            sweep(path)
            partial.mkdir()
        try:
            with _in_use(partial), _naming_in_place(partial, path):
                yield partial
            _swap(partial, path)
        finally:
            shutil.rmtree(partial, ignore_errors=True)


@contextlib.contextmanager
def _naming_in_place(partial: Path, path: Path) -> Iterator[None]:
    """Name files as in the final folder, and the folder where an error names none."""
    try:
        yield
    except LogError as error:
        raise LogError(str(error).replace(str(partial), str(path))) from error
    except OSError as error:
        if error.filename:
            file = str(error.filename).replace(str(partial), str(path))
            raise OSError(error.errno, error.strerror, file) from error
        if error.errno not in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO):
            raise
        raise OSError(
            f"the folder {path} cannot be written: {error.strerror}"
        ) from error


@contextlib.contextmanager
def _in_use(folder: Path) -> Iterator[None]:
    """Lock a folder during the block, where the file system has locks."""
    with contextlib.ExitStack() as stack:
        with contextlib.suppress(OSError, NotImplementedError):
            stack.enter_context(locked_folder(folder))
        yield


def sweep(path: Path) -> None:
    """Remove unfinished folders that killed commands left beside a folder.

    A living process holds a lock in its unfinished folder.  One without a lock is left
    alone for an hour, and an older output if it is the only one.
    """
    leftover = re.compile(rf"\.{re.escape(path.name)}\.[0-9a-f]{{8}}\.(partial|old)")
    for folder in path.parent.glob(f".{glob.escape(path.name)}.*"):
        kind = leftover.fullmatch(folder.name)
        needed = kind is None or (kind[1] == "old" and not path.exists())
        if not needed and _is_abandoned(folder):
            shutil.rmtree(folder, ignore_errors=True)


def _is_abandoned(folder: Path) -> bool:
    """Return whether no process writes to a folder any more."""
    try:
        if (folder / WRITER).exists():
            with locked_folder(folder):
                return True
        return time.time() - folder.stat().st_ctime > _HOUR
    except (OSError, NotImplementedError, ValueError):  # ValueError: it is in use
        return False


def default_folder(*names: str) -> Path:
    """Return a folder below results, its name safe for every file system.

    Examples
    --------
    >>> default_folder("loop", "mine:Filter").as_posix()
    'results/loop-mine_Filter'
    """
    return Path("results") / re.sub(r"[^\w.-]+", "_", "-".join(names))


def files_in(folder: Path) -> list[str]:
    """List the files below a folder but its lock, by their relative paths, sorted."""
    return sorted(set(_files_below(folder)) - {WRITER})


def _files_below(folder: Path) -> Iterator[str]:
    """Yield the relative paths of the files below a folder, its lock among them."""
    for entry in folder.rglob("*"):
        if not entry.is_dir():
            yield entry.relative_to(folder).as_posix()


def write_summary(folder: Path, summary: dict[str, Any]) -> dict[str, Any]:
    """Write summary.json with the list of all files in the folder.

    Returns
    -------
    dict
        The summary with ``files``.
    """
    complete = {**summary, "files": sorted([*files_in(folder), SUMMARY])}
    with naming_file(folder / SUMMARY):
        (folder / SUMMARY).write_text(as_json_text(complete), encoding="utf-8")
    return complete


def as_json_text(summary: dict[str, Any]) -> str:
    """Write a summary as indented JSON."""
    return json.dumps(summary, indent=2, allow_nan=False, ensure_ascii=False) + "\n"


def _refuse_foreign_files(path: Path) -> None:
    if not path.exists():
        return
    if not path.is_dir():
        raise BadInputError(f"--out must be a folder, got the file {path}")
    own = {*_listed_in_summary(path), WRITER}
    files = _files_below(path)  # perhaps very many
    foreign = next((name for name in files if name not in own), None)
    if foreign is not None:
        raise BadInputError(
            f"{path} holds {foreign}, which slamgym did not write there: "
            "choose another --out"
        )


def _listed_in_summary(folder: Path) -> set[str]:
    """Return the files that slamgym wrote to a folder according to its summary."""
    try:
        summary = json.loads((folder / SUMMARY).read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return set()
    files = summary.get("files") if isinstance(summary, dict) else None
    return {str(file) for file in files} if isinstance(files, list) else set()


@contextlib.contextmanager
def _parents(path: Path) -> Iterator[None]:
    """Make the folders above a path; after an error, remove those that are empty."""
    missing = [folder for folder in path.parents if not folder.exists()]
    try:
        with naming_folder(path):
            for folder in reversed(missing):
                folder.mkdir()
        yield
    except BaseException:
        with contextlib.suppress(OSError):
            for folder in missing:
                folder.rmdir()
        raise


def _swap(partial: Path, path: Path) -> None:
    """Move the new folder to `path`, and remove the old one."""
    if not path.exists():
        partial.replace(path)
        return
    old = partial.with_suffix(".old")
    path.replace(old)
    try:
        partial.replace(path)
    except BaseException:
        old.replace(path)
        raise
    shutil.rmtree(old, ignore_errors=True)
