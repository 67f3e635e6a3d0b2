"""The folder of a data set while it is written: one writer, only complete shards."""

import contextlib
import os
import re
import secrets
import shutil
import time
from collections.abc import Iterator
from pathlib import Path

from ..runs.folder_lock import locked_folder
from ..runs.own_files import files_below, set_aside
from .dataset import is_whole
from .manifest import MANIFEST, ShardEntry

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
        leftovers = [e for e in folder.iterdir() if _LEFTOVERS.fullmatch(e.name)]
        names = (Path(name).parts[0] for name in files_below(folder))
        foreign = next((name for name in names if not _LEFTOVERS.fullmatch(name)), None)
        if foreign and not (folder / MANIFEST).exists():
            raise ValueError(
                f"out must be a new or empty folder, or hold a {MANIFEST}: "
                f"{folder} holds {foreign}"
            )
        for leftover in leftovers:
            _remove(leftover)
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


def put_in_place(staged: Path, folder: Path, own: set[ShardEntry | None]) -> None:
    """Move a complete shard, a file or a folder, and replace the shard that is there.

    What is there is set aside with a warning, if it is none of our own shards.
    """
    path = folder / staged.name
    if os.path.lexists(path):
        if path.is_symlink() or not any(is_whole(folder, each) for each in own if each):
            set_aside(path, f"does not match its checksum in {MANIFEST}")
        else:
            _remove(path)
    staged.replace(path)


def _remove(path: Path) -> None:
    """Remove a file or a folder, to which a worker that is ending may still write."""
    if path.is_symlink() or not path.is_dir():
        path.unlink(missing_ok=True)
        return
    for _ in range(_ATTEMPTS):
        shutil.rmtree(path, ignore_errors=True)
        if not path.exists():
            return
        time.sleep(_BETWEEN)
    shutil.rmtree(path)
