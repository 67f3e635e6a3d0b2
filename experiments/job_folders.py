"""Long jobs: blocks of runs that workers compute, kept in a folder of one writer.

A job is a function of a block, which is a `range` of runs. `resume` computes the
blocks that a folder lacks and keeps each as it comes, so that a job may be killed at
any time and continues after its last complete block. The folder is `claimed` for one
writer. A manifest lists its other files with their digests; what slamgym did not write
there, or what was changed since, is refused or set aside, and never lost.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import pickle
import platform
import re
import secrets
import shutil
import signal
import stat
import tempfile
import threading
import time
import warnings
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from concurrent.futures.process import BrokenProcessPool
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from filelock import FileLock, Timeout

from ..sim_configs.field_types import unknown_choice
from ..sim_configs.scenario_files import WRITER, replace_when_written
from .environment_variables import without_scripts_of_the_user
from .run_and_replay.filter_settings import integer, one_blas_thread

Result = TypeVar("Result")
Progress = Callable[[int, int], object]
Call = tuple[Callable[..., Any], tuple[Any, ...], dict[str, Any]]  # joblib's delayed
Workers = Callable[[Iterable[Call]], Generator[Any, None, None]]
#: Computes a block. It may report steps that are done by the function that it gets;
#: a worker gets None.
Work = Callable[[range, Callable[[int], object] | None], Result]

BACKENDS = ("loky", "threading", "dask")
#: How long a worker lives on without the process that engaged it [s].
_PATIENCE = 0.5


def blocks_of(runs: range, size: int) -> list[range]:
    """Divide runs into blocks; the last one may be shorter.

    Examples
    --------
    >>> blocks_of(range(50, 120), 50)
    [range(50, 100), range(100, 120)]
    """
    return [runs[first : first + size] for first in range(0, len(runs), size)]


def resume(
    work: Work[Result],
    missing: Sequence[range],
    keep: Callable[[range, Result], object],
    workers: Workers | None,
    *,
    runs: int,
    steps: int | None = None,
    progress: Progress | None = None,
    kept: str,
) -> None:
    """Compute the blocks that a job lacks, and keep each as it comes, in any order.

    Parameters
    ----------
    work : callable
        Computes a block; workers get it by pickle.
    missing : sequence of range
        The blocks.
    keep : callable
        Called here with a block and its result.
    workers : callable or None
        What `engage_workers` returns.
    runs : int
        Number of runs of the job, those of earlier calls included.
    steps : int, optional
        Steps of a run, where progress counts steps and not runs.
    progress : callable, optional
        Called with (done, all): at the start if it counts runs, after every block, and
        whenever the work reports steps.
    kept : str
        What remains if a worker process is killed.

    Raises
    ------
    OSError
        If a worker process is killed.
    """
    report, unit = progress or (lambda done, runs: None), steps or 1
    finished = runs - sum(map(len, missing))
    done = finished * unit

    def advance(more: int) -> None:
        nonlocal done
        done += more
        report(done, runs * unit)

    if steps is None:
        advance(0)
    try:
        with contextlib.closing(_computed(work, missing, workers, advance)) as computed:
            for block, result in computed:  # the end of the block ends the workers
                keep(block, result)
                finished += len(block)
                if done < finished * unit:
                    advance(finished * unit - done)
    except BrokenProcessPool as error:
        end = "was killed, perhaps for lack of memory"
        if finished == runs - sum(map(len, missing)):
            end = f"ended before its first block: its error is above, or it {end}"
        raise OSError(f"a worker process {end}; {kept}") from error


def _computed(
    work: Work[Result],
    missing: Sequence[range],
    workers: Workers | None,
    advance: Callable[[int], object],
) -> Generator[tuple[range, Result], None, None]:
    if workers is None:
        yield from ((block, work(block, advance)) for block in missing)
    else:
        yield from workers((_do, (work, block), {}) for block in missing)


def _do(work: Work[Result], block: range) -> tuple[range, Result]:
    with one_blas_thread():  # in a process of its own
        return block, work(block, None)


def engage_workers(jobs: int | None, backend: str | None) -> Workers | None:
    """Return workers that compute calls in any order; None if this process does it all.

    Parameters
    ----------
    jobs : int or None
        Number of workers; -1 for one on each core.
    backend : str or None
        One of `BACKENDS`; None for what joblib is configured to use.

    Raises
    ------
    ValueError
        If an argument does not fit.
    """
    if backend not in (None, *BACKENDS):
        raise ValueError(unknown_choice("backend", backend, BACKENDS))
    if jobs not in (None, -1):
        integer("jobs", jobs or 0, 1)
    from joblib import effective_n_jobs, parallel, parallel_config  # noqa: PLC0415

    if backend is None and effective_n_jobs(jobs) == 1:
        return None
    chosen: dict[str, Any] = {} if backend is None else {"backend": backend}
    if jobs is not None or backend is not None:
        chosen["n_jobs"] = jobs or -1
    with parallel_config(**chosen):
        begin: dict[str, Any] = {}
        if isinstance(parallel.get_active_backend()[0], parallel.BACKENDS["loky"]):
            begin = {"initializer": _end_with, "initargs": (os.getpid(),)}
        compute = parallel.Parallel(
            return_as="generator_unordered", pre_dispatch="2*n_jobs", **begin
        )

    return partial(_through_files if begin else _directly, compute)


def _directly(compute: Workers, calls: Iterable[Call]) -> Generator[Any, None, None]:
    with without_scripts_of_the_user():
        results = compute(calls)
        try:
            for result in results:  # noqa: UP028 (closes them too early, and warns)
                yield result
        finally:
            with warnings.catch_warnings(action="ignore", category=UserWarning):
                results.close()  # which warns of results that nobody has taken


def _through_files(
    compute: Workers, calls: Iterable[Call]
) -> Generator[Any, None, None]:
    """Compute calls by workers of loky, which share one pipe for their results.

    A worker that is killed halfway through a long message would leave the pipe blocked
    forever. The path of a file is short enough to go in at once.
    """
    from joblib.externals.loky.backend import resource_tracker  # noqa: PLC0415

    folder = Path(tempfile.mkdtemp(prefix="slamgym-"))
    # A process of joblib removes it if this one is killed.
    resource_tracker.register(str(folder), "folder")
    into_files: Iterable[Call] = ((_write_result, (folder, call), {}) for call in calls)
    try:
        with contextlib.closing(_directly(compute, into_files)) as paths:
            yield from map(_read_result, paths)
    finally:
        with contextlib.suppress(OSError):  # which would hide how the block ended
            remove(folder)
            resource_tracker.unregister(str(folder), "folder")


def _write_result(folder: Path, call: Call) -> Path:
    work, arguments, options = call
    result = work(*arguments, **options)
    with (
        naming(f"the temporary folder {folder}"),
        tempfile.NamedTemporaryFile(dir=folder, delete=False) as file,
    ):
        pickle.dump(result, file, pickle.HIGHEST_PROTOCOL)
    return Path(file.name)


def _read_result(path: Path) -> Any:
    with path.open("rb") as file:
        result = pickle.load(file)
    path.unlink()
    return result


def blocks_at_once(jobs: int | None, backend: str | None) -> int:
    """Return how many blocks the workers of these arguments compute at a time."""
    from joblib import effective_n_jobs, parallel_config  # noqa: PLC0415

    if backend is None:
        return max(int(effective_n_jobs(jobs)), 1)
    with parallel_config(backend, n_jobs=jobs or -1):
        return max(int(effective_n_jobs(jobs or -1)), 1)


def _end_with(engaging: int) -> None:
    """Let this worker end when the process that engaged it is gone, and not before.

    A scheduler may send SIGTERM to all processes of a job.  The one that engaged the
    workers then ends them.
    """
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    threading.Thread(target=_watch, args=(engaging,), daemon=True).start()


def _watch(engaging: int) -> None:
    while os.getppid() == engaging:
        time.sleep(_PATIENCE)
    os._exit(1)


# --------------------------------------------------------------------------------------
# The folder of a job: it has one writer, and belongs to one job.

#: Names of what a writer that was killed at once may have left half written.
_LEFTOVER = re.compile(
    r"\.writing-[0-9a-f]{8}"
    r"|\.{1,2}(job|manifest|results|report|summary|slamgym_files|runs-\d{7,}-\d{7,})"
    rf"(\.({WRITER}|[0-9a-f]{{8}})){{1,2}}\.(json|nc|html|npz)"
)
_ATTEMPTS, _BETWEEN = 20, 0.1  # [s]


@contextlib.contextmanager
def claimed(folder: Path) -> Iterator[str | None]:
    """Make the folder of a job if it does not exist, and lock it during the block.

    Yields
    ------
    str or None
        The name of a file or folder in it that `remove_leftovers` keeps; None if there
        is none.

    Raises
    ------
    ValueError
        If the folder is a file, or another process writes to it.
    OSError
        If it cannot be written.
    """
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"out must be a folder, got the file {folder}")
    with naming(f"the folder {folder}"):
        folder.mkdir(parents=True, exist_ok=True)
    with locked_folder(folder):
        parts = (Path(name).parts for name in files_below(folder))
        yield next((p[0] for p in parts if not any(map(_LEFTOVER.fullmatch, p))), None)


def remove_leftovers(*folders: Path) -> None:
    """Remove what a killed writer left half written in these folders."""
    for folder in folders:
        for path in folder.glob(".*"):
            if _LEFTOVER.fullmatch(path.name):
                remove(path)


@contextlib.contextmanager
def staging_folder(folder: Path) -> Iterator[Path]:
    """Provide an absolute folder inside a claimed one, and remove it after the block.

    What is complete moves from there to its place.
    """
    staging = folder.resolve() / f".writing-{secrets.token_hex(4)}"
    staging.mkdir()
    try:
        yield staging
    finally:
        remove(staging)


def remove(path: Path) -> None:
    """Remove a file or a folder, to which a worker that is ending may still write."""
    if path.is_symlink() or not path.is_dir():
        path.unlink(missing_ok=True)
        return
    for _ in range(_ATTEMPTS):
        shutil.rmtree(path, ignore_errors=True)
        if not path.exists():
            return
        time.sleep(_BETWEEN)
    shutil.rmtree(path)


def difference(found: Mapping[str, Any], asked: Mapping[str, Any]) -> str | None:
    """Return the first name under which two descriptions of jobs differ, if any."""
    names = {**found, **asked}
    return next((name for name in names if found.get(name) != asked.get(name)), None)


@contextlib.contextmanager
def naming(
    place: str | Path, kept: str = "", also: type[Exception] = OSError
) -> Iterator[None]:
    """Name what cannot be written in errors of the file system, and what is kept.

    Parameters
    ----------
    place : str or Path
        A file, or a folder.
    kept : str, optional
        The rest of the message.
    also : type, optional
        Another error that means the same.
    """
    try:
        yield
    except (OSError, also) as error:
        reason = getattr(error, "strerror", None)
        if type(error) is OSError and reason is None:
            raise  # it is a message of slamgym
        raise OSError(f"{place} cannot be written: {reason or error}{kept}") from error


# --------------------------------------------------------------------------------------
# The files that slamgym wrote to a folder, with the proof that nobody changed them.

#: The list of the files that slamgym wrote to its folder.
MANIFEST = ".slamgym_files.json"


class OwnFile(NamedTuple):
    """An entry of the manifest."""

    #: Path relative to the folder, with slashes.
    name: str
    #: In bytes.
    size: int
    sha256: str


def files_below(folder: Path) -> Iterator[str]:
    """Yield the relative paths of all files and links, without lock and manifest."""
    for place, folders, files in os.walk(folder):
        links = [name for name in folders if Path(place, name).is_symlink()]
        for name in (*files, *links):
            path = Path(place, name).relative_to(folder).as_posix()
            if path not in (WRITER, MANIFEST):
                yield path


def sha256_of(file: Path) -> str:
    """Compute the SHA-256 of a file."""
    with file.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def measured(file: Path, name: str) -> OwnFile:
    """Return the entry of a file under a name."""
    return OwnFile(name, file.stat().st_size, sha256_of(file))


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
    listed = {entry for entry in own if entry[:2] == (name, status.st_size)}
    if not listed or not stat.S_ISREG(status.st_mode):
        return None
    entry = measured(folder / name, name)
    return entry if entry in listed else None


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
    """Rename a file or folder that is in the way, and warn."""
    number, aside = 1, path.with_name(f"{path.name}.aside")
    while os.path.lexists(aside):
        number += 1
        aside = path.with_name(f"{path.name}.aside{number}")
    path.replace(aside)
    warnings.warn(f"{path} {reason}; it is moved to {aside.name}", stacklevel=2)


# --------------------------------------------------------------------------------------
# Lock a folder, so that one process at a time writes to it.

#: The lock file; it names the process that writes to the folder.
WRITER = ".slamgym_writer"


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
    with naming(f"the folder {folder}"):
        try:
            lock.acquire()
        except Timeout:
            used = ""
            with contextlib.suppress(OSError):
                used = file.read_text(encoding="utf-8").strip()
            if used:
                used = f": it is in use by {used}; wait for its end, or choose another "
                used += "folder"
            raise ValueError(f"another process is writing to {folder}{used}") from None
    try:
        with contextlib.suppress(OSError):  # on Windows the locked file is not writable
            text = f"process {os.getpid()} on {platform.node() or 'this machine'}\n"
            file.write_text(text, encoding="utf-8")
        yield
    finally:
        with contextlib.suppress(OSError):
            file.unlink()
        lock.release()
