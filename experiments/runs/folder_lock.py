"""A folder that one process at a time writes to."""

import contextlib
import os
import platform
from collections.abc import Iterator
from pathlib import Path


@contextlib.contextmanager
def sole_writer(folder: Path, note: Path | None = None) -> Iterator[None]:
    """Keep other writers out of a folder meanwhile.

    The lock is one of the operating system: it ends with the process at the latest,
    and holds among the processes of one machine.  (On Windows, nobody is kept out.)

    Parameters
    ----------
    folder : Path
        A folder that exists.
    note : Path, optional
        A file that says meanwhile who the writer is, for those kept out to tell.  A
        killed writer leaves it behind, where it keeps nobody out.

    Raises
    ------
    ValueError
        If another process writes to it, or this one elsewhere.
    OSError
        If the folder cannot be opened.
    """
    try:
        import fcntl  # noqa: PLC0415 (not on Windows)
    except ImportError:
        yield
        return
    handle = os.open(folder, os.O_RDONLY)
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise ValueError(
                f"another process is writing to {folder}{_who(note)}"
            ) from None
        with _shown(note):
            yield
    finally:
        fcntl.flock(handle, fcntl.LOCK_UN)  # in forked children too
        os.close(handle)


@contextlib.contextmanager
def _shown(note: Path | None) -> Iterator[None]:
    """Say who the writer is, where there is room for that."""
    if note is None:
        yield
        return
    with contextlib.suppress(OSError):
        text = f"process {os.getpid()} on {platform.node() or 'this machine'}\n"
        note.write_text(text, encoding="utf-8")
    try:
        yield
    finally:
        with contextlib.suppress(OSError):
            note.unlink()


def _who(note: Path | None) -> str:
    try:
        said = "" if note is None else note.read_text(encoding="utf-8").strip()
    except OSError:
        said = ""
    if not said:
        return ""
    return f": it is in use by {said}; wait for its end, or choose another folder"
