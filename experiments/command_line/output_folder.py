"""The folder that a command writes: its files appear together or not at all."""

import contextlib
import csv
import errno
import json
import os
import re
import shutil
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from ...sim_configs.scenario_files import naming_file, unfinished
from .. import job_folders
from ..logs.slamlog import LogError
from .commands import BadInputError

#: Every output folder holds it; its ``files`` lists the files of the command.
SUMMARY = "summary.json"
#: What `run` writes, beside its log, and no other command.
SCENARIO = "scenario.toml"
#: The folder of unfinished output, inside the output folder.
STAGING = ".slamgym_partial"


@contextlib.contextmanager
def output_folder(path: Path) -> Iterator[Path]:
    """Provide a folder for new files, which move to `path` at the end of the block.

    They replace what slamgym wrote to `path` earlier. A folder that holds anything else
    is refused at once, also a file that was changed since. An error or Ctrl-C in the
    block leaves everything as it was. The next command completes a move that was cut
    short.

    Parameters
    ----------
    path : Path
        The folder of the output; it is made if it does not exist.

    Yields
    ------
    Path
        An empty folder inside `path`.

    Raises
    ------
    BadInputError
        If `path` is a file, or a folder that holds what slamgym did not write.
    ValueError
        If another process writes to the folder.
    OSError
        If the folder cannot be written.
    """
    folder = Path(os.path.realpath(path))  # a link stays, and names the folder to write
    if folder.exists() and not folder.is_dir():
        raise BadInputError(f"--out must be a folder, got the file {path}")
    staging = folder / STAGING
    with (
        _made(folder),
        job_folders.locked_folder(folder),
        _naming_in_place(staging, folder),
    ):
        _publish(folder)  # what a killed command left
        with job_folders.naming(f"the folder {folder}"):
            staging.mkdir()
        unfinished.add(staging)
        try:
            yield staging
            names = job_folders.files_below(staging)
            new = {job_folders.measured(staging / name, name) for name in names}
            job_folders.write_own_files(staging, new)  # from here on they are complete
        except BaseException:
            shutil.rmtree(staging, ignore_errors=True)
            raise
        finally:
            unfinished.discard(staging)
        _publish(folder)


@contextlib.contextmanager
def _made(folder: Path) -> Iterator[None]:
    """Make a folder and those above it; after an error, remove those that are empty."""
    missing = [place for place in (folder, *folder.parents) if not place.exists()]
    try:
        with job_folders.naming(f"the folder {folder}"):
            folder.mkdir(parents=True, exist_ok=True)
        yield
    except BaseException:
        with contextlib.suppress(OSError):
            for place in missing:
                place.rmdir()
        raise


@contextlib.contextmanager
def _naming_in_place(staging: Path, folder: Path) -> Iterator[None]:
    """Name files as in the final folder, and the folder where an error names none."""
    try:
        yield
    except LogError as error:
        raise LogError(str(error).replace(str(staging), str(folder))) from error
    except OSError as error:
        if error.filename:
            file = str(error.filename).replace(str(staging), str(folder))
            raise OSError(error.errno, error.strerror, file) from error
        if error.errno not in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO):
            raise
        raise OSError(
            f"the folder {folder} cannot be written: {error.strerror}"
        ) from error


def _publish(folder: Path) -> None:
    """Move complete new files into a folder, and discard incomplete ones.

    Nothing happens if the folder holds a file that the manifests of the old and of the
    new files do not prove to be slamgym's.
    """
    staging = folder / STAGING
    old, new = job_folders.own_files(folder), job_folders.own_files(staging)
    present = set()
    for name in job_folders.files_below(folder):
        if name.startswith(f"{STAGING}/") and not staging.is_symlink():
            continue
        if job_folders.own_entry(folder, name, old | new) is None:
            raise BadInputError(_in_the_way(folder, name, old | new))
        present.add(name)
    if (staging / job_folders.MANIFEST).exists():
        names = {entry.name for entry in new}
        for name in names.intersection(job_folders.files_below(staging)):
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (staging / name).replace(folder / name)
        for name in present - names:
            _remove(folder, name)
        (staging / job_folders.MANIFEST).replace(folder / job_folders.MANIFEST)
    shutil.rmtree(staging, ignore_errors=True)


def _in_the_way(folder: Path, name: str, own: set[job_folders.OwnFile]) -> str:
    """Describe a file that keeps a folder from being written, and the way out."""
    known = any(name == entry.name for entry in own)
    what = "was changed since" if known else "slamgym did not write there"
    kept = folder / STAGING
    complete = (kept / job_folders.MANIFEST).exists()
    waiting = f"; the new files stay in {kept}" if complete else ""
    return (
        f"{folder} holds {name}, which {what}: move it away, or choose another --out"
        f"{waiting}"
    )


def _remove(folder: Path, name: str) -> None:
    """Remove a file of a folder, and the folders in it that are empty then."""
    (folder / name).unlink()
    with contextlib.suppress(OSError):
        for place in Path(name).parents[:-1]:
            (folder / place).rmdir()


def default_folder(*names: str) -> Path:
    """Return a folder below results, its name safe for every file system.

    Examples
    --------
    >>> default_folder("loop", "mine:Filter").as_posix()
    'results/loop-mine_Filter'
    """
    return Path("results") / re.sub(r"[^\w.-]+", "_", "-".join(names))


def folder_of_log(*names: str) -> Path:
    """Return `default_folder`, or another one where that holds what `run` has written.

    The log may be that of the run, whose scenario would be lost.
    """
    folder = default_folder(*names)
    is_of_run = (folder / SCENARIO).exists()
    return default_folder("replay", *names) if is_of_run else folder


def write_summary(folder: Path, summary: dict[str, Any]) -> dict[str, Any]:
    """Write summary.json with the list of all files in the folder.

    Returns
    -------
    dict
        The summary with ``files``.
    """
    complete = {**summary, "files": sorted([*job_folders.files_below(folder), SUMMARY])}
    with naming_file(folder / SUMMARY):
        (folder / SUMMARY).write_text(as_json_text(complete), encoding="utf-8")
    return complete


def write_csv(
    path: Path, columns: Iterable[str], rows: Iterable[Iterable[Any]]
) -> None:
    """Write rows as CSV below the names of their columns, empty where None."""
    with naming_file(path), path.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(columns)
        writer.writerows(rows)


def as_json_text(summary: dict[str, Any]) -> str:
    """Write a summary as indented JSON."""
    return json.dumps(summary, indent=2, allow_nan=False, ensure_ascii=False) + "\n"
