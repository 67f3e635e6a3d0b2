"""The folder of a data set while it is written: one writer, only complete shards."""

import contextlib
import re
import secrets
import shutil
import time
from collections.abc import Iterator
from pathlib import Path

from ..runs.folder_lock import WRITER, locked_folder
from .manifest import MANIFEST

_WRITING = ".writing-"
_ATTEMPTS, _BETWEEN = 20, 0.1  # [s]
_LEFTOVERS = re.compile(r"\.writing-[0-9a-f]{8}|\.manifest\.[0-9a-f]{8}\.json")


@contextlib.contextmanager
def claimed(folder: Path) -> Iterator[None]:
    """Make a folder if it does not exist, and lock it during the block.

    Files that a killed writer left half written are removed.

    Raises
    ------
    ValueError
        If the folder is a file, or holds something other than a data set, or another
        process writes to it.
    """
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"out must be a folder, got the file {folder}")
    folder.mkdir(parents=True, exist_ok=True)
    with locked_folder(folder):
        names = {entry.name for entry in folder.iterdir()} - {WRITER}
        leftovers = set(filter(_LEFTOVERS.fullmatch, names))
        foreign = sorted(names - leftovers)
        if foreign and MANIFEST not in foreign:
            raise ValueError(
                f"out must be a new or empty folder, or hold a {MANIFEST}: "
                f"{folder} holds {foreign[0]}"
            )
        for name in leftovers:
            _remove(folder / name)
        yield


@contextlib.contextmanager
def staging_folder(folder: Path) -> Iterator[Path]:
    """Provide an absolute folder inside `folder`, and remove it after the block.

    Shards are written there, and `put_in_place` moves them.
    """
    staging = folder.resolve() / f"{_WRITING}{secrets.token_hex(4)}"
    staging.mkdir()
    try:
        yield staging
    finally:
        _remove(staging)


@contextlib.contextmanager
def naming(folder: Path) -> Iterator[None]:
    """Name the folder in errors of the system, such as a full disk.

    Raises
    ------
    OSError
        In place of an error of the system.
    """
    try:
        yield
    except OSError as error:
        if error.strerror is None:
            raise
        raise OSError(
            f"{folder} cannot be written: {error.strerror}; whole shards stay there, "
            "and the same command continues"
        ) from error


def put_in_place(staged: Path, path: Path) -> None:
    """Move a complete shard, a file or a folder, and replace what is there."""
    _remove(path)
    staged.replace(path)


def _remove(path: Path) -> None:
    """Remove a file or a folder, to which a worker that is ending may still write."""
    if not path.is_dir():
        path.unlink(missing_ok=True)
        return
    for _ in range(_ATTEMPTS):
        shutil.rmtree(path, ignore_errors=True)
        if not path.exists():
            return
        time.sleep(_BETWEEN)
    shutil.rmtree(path)
