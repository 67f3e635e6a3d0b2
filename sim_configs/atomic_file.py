"""Atomic replacement of files, and errors that name the file."""

import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

#: Files and folders that this process is writing, to be removed if it must end.
unfinished: set[Path] = set()


@contextmanager
def replace_when_written(path: str | Path) -> Iterator[Path]:
    """Yield a temporary path beside `path`, and move it there at the end of the block.

    An exception inside the block removes the temporary file and leaves an older file at
    `path` unchanged.

    Parameters
    ----------
    path : str or Path
        The final path; its folder must exist.

    Yields
    ------
    Path
        A hidden path in the same folder with the same suffix, for writing.

    Raises
    ------
    FileNotFoundError
        If the folder does not exist.
    OSError
        If the file cannot be written; it names `path`.
    """
    target = Path(path)
    if not target.parent.is_dir():
        raise FileNotFoundError(f"the folder of {target} does not exist")
    partial = target.with_name(f".{target.stem}.{secrets.token_hex(4)}{target.suffix}")
    unfinished.add(partial)
    try:
        with naming_file(target, partial):
            yield partial
            partial.replace(target)
    finally:
        partial.unlink(missing_ok=True)
        unfinished.discard(partial)


@contextmanager
def naming_file(path: Path, written: Path | None = None) -> Iterator[None]:
    """Name a file in errors of the system that name none, such as a size limit's.

    Parameters
    ----------
    path : Path
        The file to name.
    written : Path, optional
        A temporary file in its place, whose name errors do not repeat.
    """
    try:
        yield
    except OSError as error:
        named = error.filename
        if error.errno is None or (named and str(named) != str(written)):
            raise
        raise OSError(error.errno, error.strerror, str(path)) from error
