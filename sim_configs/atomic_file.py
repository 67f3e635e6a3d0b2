"""Atomic replacement of files: a reader sees the old file or the complete new one."""

import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

unfinished: set[Path] = set()
"""Files and folders that this process is writing, to be removed if it must end."""


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
    """
    target = Path(path)
    if not target.parent.is_dir():
        raise FileNotFoundError(f"the folder of {target} does not exist")
    partial = target.with_name(f".{target.stem}.{secrets.token_hex(4)}{target.suffix}")
    unfinished.add(partial)
    try:
        yield partial
        partial.replace(target)
    finally:
        partial.unlink(missing_ok=True)
        unfinished.discard(partial)
