"""The folder of a data set while it is written: one writer, whole shards, no rests."""

import contextlib
import re
import secrets
import shutil
from collections.abc import Iterator
from pathlib import Path

from ..runs.folder_lock import sole_writer
from .manifest import MANIFEST

_WRITING = ".writing-"
_RESTS = re.compile(r"\.writing-[0-9a-f]{8}|\.manifest\.[0-9a-f]{8}\.json")


@contextlib.contextmanager
def claimed(folder: Path) -> Iterator[None]:
    """Make a folder if need be, and keep other writers out of it meanwhile.

    What a killed writer left half done is removed. (On Windows, nobody is kept out.)

    Raises
    ------
    ValueError
        If the folder is a file, or holds what is no data set, or another process
        writes to it.
    """
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"out must be a folder, got the file {folder}")
    folder.mkdir(parents=True, exist_ok=True)
    with sole_writer(folder):
        foreign = sorted(
            entry.name for entry in folder.iterdir() if not _RESTS.fullmatch(entry.name)
        )
        if foreign and MANIFEST not in foreign:
            raise ValueError(
                f"out must be a new or empty folder, or hold a {MANIFEST}: "
                f"{folder} holds {foreign[0]}"
            )
        for entry in folder.iterdir():
            if _RESTS.fullmatch(entry.name):
                _remove(entry)
        yield


@contextlib.contextmanager
def written_whole(path: Path) -> Iterator[Path]:
    """Lend a path of the same name elsewhere; when all went well, move it to `path`.

    Works for files and for folders, and replaces what is there.

    Yields
    ------
    Path
        Where to write the file, or make the folder.
    """
    workshop = path.with_name(f"{_WRITING}{secrets.token_hex(4)}")
    workshop.mkdir()
    try:
        partial = workshop / path.name
        yield partial
        _remove(path)
        partial.replace(path)
    finally:
        shutil.rmtree(workshop, ignore_errors=True)


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
