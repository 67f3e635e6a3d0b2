"""The folder a command writes: there when complete, or not at all."""

import contextlib
import json
import re
import secrets
import shutil
from collections.abc import Iterator
from pathlib import Path

from .errors import BadInputError

SUMMARY = "summary.json"
"""Every output folder holds it; its ``files`` lists what slamgym wrote there."""


@contextlib.contextmanager
def output_folder(path: Path) -> Iterator[Path]:
    """Lend a new folder, which takes its place at `path` when all went well.

    What slamgym wrote to `path` earlier is replaced; a folder that holds anything else
    is refused at once. After an error or Ctrl-C all is as before.

    Parameters
    ----------
    path : Path
        Where the folder shall appear; missing folders above it are made.

    Yields
    ------
    Path
        An empty folder beside it, to write to.

    Raises
    ------
    BadInputError
        If `path` is a file, or a folder that holds what slamgym did not write.
    OSError
        If the folder cannot be written.
    """
    path = path.absolute()
    _refuse_what_is_not_ours(path)
    with _parents(path):
        partial = path.with_name(f".{path.name}.{secrets.token_hex(4)}.partial")
        _make(partial, path)
        try:
            yield partial
            _swap(partial, path)
        finally:
            shutil.rmtree(partial, ignore_errors=True)


def default_folder(*names: str) -> Path:
    """Choose a folder below results by names, of which odd characters are replaced.

    Examples
    --------
    >>> default_folder("loop", "mine:Filter").as_posix()
    'results/loop-mine_Filter'
    """
    return Path("results") / re.sub(r"[^\w.-]+", "_", "-".join(names))


def files_in(folder: Path) -> list[str]:
    """List the files below a folder by their paths from there, sorted."""
    files = (entry for entry in folder.rglob("*") if not entry.is_dir())
    return sorted(file.relative_to(folder).as_posix() for file in files)


def _refuse_what_is_not_ours(path: Path) -> None:
    if path.exists() and not path.is_dir():
        raise BadInputError(f"--out must be a folder, got the file {path}")
    if not path.exists():
        return
    foreign = sorted(set(files_in(path)) - _listed_in_summary(path))
    if foreign:
        raise BadInputError(
            f"{path} holds {foreign[0]}, which slamgym did not write there: "
            "choose another --out"
        )


def _listed_in_summary(folder: Path) -> set[str]:
    """Read which files slamgym wrote to a folder, none if it did not."""
    try:
        summary = json.loads((folder / SUMMARY).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return set()
    files = summary.get("files") if isinstance(summary, dict) else None
    return {str(file) for file in files} if isinstance(files, list) else set()


@contextlib.contextmanager
def _parents(path: Path) -> Iterator[None]:
    """Make the folders above a path; remove those still empty after an error."""
    missing = [folder for folder in path.parents if not folder.exists()]
    try:
        for folder in reversed(missing):
            _make(folder, path)
        yield
    except BaseException:
        with contextlib.suppress(OSError):
            for folder in missing:
                folder.rmdir()
        raise


def _make(folder: Path, path: Path) -> None:
    try:
        folder.mkdir()
    except OSError as error:
        reason = error.strerror or error
        raise OSError(f"the folder {path} cannot be written: {reason}") from error


def _swap(partial: Path, path: Path) -> None:
    """Put the new folder in the place of the old one, if there is one."""
    if not path.exists():
        partial.replace(path)
        return
    old = partial.with_suffix(".old")
    path.replace(old)
    try:
        partial.replace(path)
    except BaseException:
        old.replace(path)
        raise
    shutil.rmtree(old, ignore_errors=True)
