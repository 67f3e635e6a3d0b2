"""Files that appear complete or not at all."""

import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def replace_when_written(path: str | Path) -> Iterator[Path]:
    """Lend a temporary path beside `path`, and move it there when all went well.

    An exception inside the block removes the temporary file; an older file at `path`
    then stays as it was.

    Parameters
    ----------
    path : str or Path
        Where the file shall appear; its folder must exist.

    Yields
    ------
    Path
        A hidden path in the same folder, with the same suffix, to write to.

    Raises
    ------
    FileNotFoundError
        When the folder does not exist.
    """
    target = Path(path)
    if not target.parent.is_dir():
        raise FileNotFoundError(f"the folder of {target} does not exist")
    partial = target.with_name(f".{target.stem}.{secrets.token_hex(4)}{target.suffix}")
    try:
        yield partial
        partial.replace(target)
    finally:
        partial.unlink(missing_ok=True)
