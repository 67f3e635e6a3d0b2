"""The files that slamgym wrote to a folder, with the proof that nobody changed them.

`locked_folder` lets one process at a time write to a folder.
"""

import contextlib
import hashlib
import json
import os
import platform
import stat
import warnings
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

from filelock import FileLock, Timeout

from ...sim_configs.atomic_file import replace_when_written

MANIFEST = ".slamgym_files.json"
"""The list of the files that slamgym wrote to its folder."""


class OwnFile(NamedTuple):
    """An entry of the manifest."""

    name: str
    """Path relative to the folder, with slashes."""
    size: int
    """In bytes."""
    sha256: str


def files_below(folder: Path) -> Iterator[str]:
    """Yield the relative paths of all files and links, without lock and manifest."""
    for place, folders, files in os.walk(folder):
        links = [name for name in folders if Path(place, name).is_symlink()]
        for name in (*files, *links):
            path = Path(place, name).relative_to(folder).as_posix()
            if path not in (WRITER, MANIFEST):
                yield path


def measured(file: Path, name: str) -> OwnFile:
    """Return the entry of a file under a name."""
    with file.open("rb") as stream:
        digest = hashlib.file_digest(stream, "sha256").hexdigest()
    return OwnFile(name, file.stat().st_size, digest)


def own_files(folder: Path) -> set[OwnFile]:
    """Read the manifest of a folder; a missing or damaged one lists no file."""
    try:
        table = json.loads((folder / MANIFEST).read_text(encoding="utf-8"))
        return {OwnFile(**entry) for entry in table["files"]}
    except (OSError, ValueError, TypeError, KeyError, RecursionError):
        return set()


def write_own_files(folder: Path, files: Iterable[OwnFile]) -> None:
    """Write the manifest of a folder."""
    table = {"files": [file._asdict() for file in sorted(files)]}
    with replace_when_written(folder / MANIFEST) as partial:
        partial.write_text(json.dumps(table, indent=1) + "\n", encoding="utf-8")


def own_entry(folder: Path, name: str, own: set[OwnFile]) -> OwnFile | None:
    """Return the entry that proves a file to be slamgym's and unchanged, if any."""
    status = (folder / name).lstat()
    is_listed = any((name, status.st_size) == entry[:2] for entry in own)
    if not is_listed or not stat.S_ISREG(status.st_mode):
        return None
    entry = measured(folder / name, name)
    return entry if entry in own else None


@contextlib.contextmanager
def replace_own(path: Path) -> Iterator[Path]:
    """Write a file as `replace_when_written` does, and list it in the manifest.

    A file at `path` that slamgym did not write, or that was changed since, is set aside
    with a warning.

    Yields
    ------
    Path
        A temporary path, for writing.
    """
    with replace_when_written(path) as partial:
        yield partial
        own = own_files(path.parent)
        entries = {entry for entry in own if entry.name != path.name}
        if os.path.lexists(path):
            replaced = own_entry(path.parent, path.name, own)
            if replaced is None:
                set_aside(path, "is not as slamgym wrote it")
            else:  # the file stays if the process is killed before the move
                entries.add(replaced)
        write_own_files(path.parent, {*entries, measured(partial, path.name)})


def set_aside(path: Path, reason: str) -> None:
    """Give another name to a file or folder that is in the way, and warn."""
    number, aside = 1, path.with_name(f"{path.name}.aside")
    while os.path.lexists(aside):
        number += 1
        aside = path.with_name(f"{path.name}.aside{number}")
    path.replace(aside)
    warnings.warn(f"{path} {reason}; it is moved to {aside.name}", stacklevel=2)


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
