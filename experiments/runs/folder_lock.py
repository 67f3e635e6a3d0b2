"""Lock a folder, so that one process at a time writes to it."""

import contextlib
import os
import platform
from collections.abc import Iterator
from pathlib import Path

from filelock import FileLock, Timeout

WRITER = ".slamgym_writer"
"""The lock file; it names the process that writes to the folder."""


@contextlib.contextmanager
def locked_folder(folder: Path) -> Iterator[None]:
    """Keep other writers out of a folder during the block.

    The operating system holds the lock. It ends with the process at the latest, and
    works among the processes of one machine. A killed writer leaves the file `WRITER`
    behind, which locks nobody out.

    Parameters
    ----------
    folder : Path
        A folder that exists.

    Raises
    ------
    ValueError
        If another process, or this one elsewhere, writes to the folder.
    OSError
        If the folder cannot be written.
    """
    file = folder / WRITER
    lock = FileLock(file, timeout=0)
    with naming_folder(folder):
        try:
            lock.acquire()
        except Timeout:
            raise ValueError(
                f"another process is writing to {folder}{_named(file)}"
            ) from None
    try:
        with contextlib.suppress(OSError):  # on Windows the locked file is not writable
            text = f"process {os.getpid()} on {platform.node() or 'this machine'}\n"
            file.write_text(text, encoding="utf-8")
        yield
    finally:
        with contextlib.suppress(OSError):
            file.unlink()
        lock.release()


@contextlib.contextmanager
def naming_folder(folder: Path) -> Iterator[None]:
    """Name the folder in errors of the file system."""
    try:
        yield
    except OSError as error:
        reason = error.strerror or error
        raise OSError(f"the folder {folder} cannot be written: {reason}") from error


def _named(file: Path) -> str:
    try:
        writer = file.read_text(encoding="utf-8").strip()
    except OSError:
        writer = ""
    if not writer:
        return ""
    return f": it is in use by {writer}; wait for its end, or choose another folder"
