"""The folder of a data set while it is written: one writer, only complete shards."""

import contextlib
import re
import secrets
import shutil
from collections.abc import Iterator
from pathlib import Path

from ..runs.folder_lock import WRITER, locked_folder
from .manifest import MANIFEST

_WRITING = ".writing-"
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
def replace_shard(path: Path) -> Iterator[Path]:
    """Provide a temporary path of the same name, and move it to `path` after the block.

    Works for files and for folders, and replaces what is there.

    Yields
    ------
    Path
        Where to write the file, or make the folder.
    """
    temporary = path.with_name(f"{_WRITING}{secrets.token_hex(4)}")
    temporary.mkdir()
    try:
        partial = temporary / path.name
        yield partial
        _remove(path)
        partial.replace(path)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
