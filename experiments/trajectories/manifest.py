"""A data set of trajectories: its manifest, its folder, and how it is read.

A data set is a folder of shards with ``manifest.json``. The manifest names the job
(scenario, controller, seed, numbers, format), the versions that determine its bits, and
every shard with its SHA-256. It holds no date and no path: the same job gives the same
bytes. `load_trajectories` reads the trajectories one after the other.
"""

import contextlib
import hashlib
import json
import os
import platform
import re
import secrets
import shutil
import time
import warnings
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass, replace
from importlib import metadata
from os import PathLike
from pathlib import Path
from typing import Any, Literal

from ... import __version__
from ...sim_configs import Scenario
from ...sim_configs.atomic_file import replace_when_written
from ...sim_configs.scenario_files import scenario_text
from ...suggestions import closest
from ..runs.filter_settings import integer
from ..runs.own_files import files_below, locked_folder, set_aside
from .formats import trajectory_format
from .trajectory import Trajectory, scenario_from_text

MANIFEST = "manifest.json"
_KIND = "slamgym trajectories 1"


@dataclass(frozen=True)
class Job:
    """The description of a data set.

    Attributes
    ----------
    scenario : Scenario
        The world, with its ranges if it has any.
    controller : str
        Name of a controller, see `make_controller`.
    seed : int
        Seed of episode 0; episode i has seed + i.
    episodes : int
        Number of episodes.
    episodes_per_shard : int
        Number of episodes in each shard; the last one may have fewer.
    format : str
        Name of a format, see `trajectory_format`.
    smallest_std : float, optional
        Smallest standard deviation in files of g2o [m, rad].
    estimator : str, optional
        Filter whose beliefs are beside the truth.
    """

    scenario: Scenario
    controller: str
    seed: int
    episodes: int
    episodes_per_shard: int
    format: str
    smallest_std: float | None = None
    estimator: str | None = None

    @property
    def shards(self) -> int:
        """Number of shards."""
        return -(-self.episodes // self.episodes_per_shard)

    def shard_of(self, episode: int) -> int:
        """Return the number of the shard of an episode."""
        return episode // self.episodes_per_shard

    def episodes_of(self, shard: int) -> range:
        """Return the numbers of the episodes of a shard.

        Examples
        --------
        >>> from slamgym.sim_configs import load_scenario
        >>> scenario = load_scenario("loop")
        >>> Job(scenario, "random", 0, 120, 50, "npz").episodes_of(2)
        range(100, 120)
        """
        first = shard * self.episodes_per_shard
        return range(first, min(first + self.episodes_per_shard, self.episodes))


@dataclass(frozen=True)
class ShardEntry:
    """A written shard.

    Attributes
    ----------
    name : str
        Name of its file or folder, beside the manifest.
    first_episode, episodes : int
        First episode, and number of episodes.
    sha256 : str
        Its `checksum`.
    """

    name: str
    first_episode: int
    episodes: int
    sha256: str


@dataclass(frozen=True)
class Manifest:
    """A job, the versions that generate it, and the shards written so far.

    Attributes
    ----------
    job : Job
        The job.
    versions : dict of str to str
        Versions of all that can change a bit: packages, Python, processor type.
    shards : tuple of ShardEntry
        The shards in the order of their episodes; workers may leave gaps on the way.
    """

    job: Job
    versions: dict[str, str]
    shards: tuple[ShardEntry, ...] = ()

    @property
    def is_complete(self) -> bool:
        """Whether all episodes are written."""
        return sum(shard.episodes for shard in self.shards) == self.job.episodes

    def with_shards(self, shards: Iterable[ShardEntry]) -> "Manifest":
        """Return the manifest with other shards."""
        return replace(self, shards=tuple(shards))


def versions_now(libraries: Iterable[str] = ()) -> dict[str, str]:
    """Return the versions that determine the bits on this machine.

    Parameters
    ----------
    libraries : iterable of str
        Packages besides numpy.
    """
    return {
        "slamgym": __version__,
        "python": ".".join(platform.python_version_tuple()[:2]),
        "machine": platform.machine(),
        **{name: metadata.version(name) for name in ("numpy", *libraries)},
    }


def write_manifest(manifest: Manifest, folder: Path) -> None:
    """Write a manifest, which appears complete or not at all."""
    parts = {**vars(manifest.job), "scenario": scenario_text(manifest.job.scenario)}
    job = {name: part for name, part in parts.items() if part is not None}
    table = {
        "kind": _KIND,
        "job": job,
        "versions": manifest.versions,
        "shards": [asdict(shard) for shard in manifest.shards],
    }
    text = json.dumps(table, indent=1, ensure_ascii=False) + "\n"
    with replace_when_written(folder / MANIFEST) as partial:
        partial.write_text(text, encoding="utf-8", newline="\n")


def read_manifest(folder: Path) -> Manifest:
    """Read the manifest of a data set.

    Raises
    ------
    ValueError
        If there is none, or the file is malformed.
    """
    path = folder / MANIFEST
    if not path.is_file():
        raise ValueError(f"{folder} must be a data set with a {MANIFEST}, it has none")
    try:
        return _manifest(json.loads(path.read_text(encoding="utf-8")))
    except (KeyError, TypeError, ValueError, RecursionError) as error:
        raise ValueError(
            f"{path} must be a manifest of '{_KIND}': {type(error).__name__}: {error}"
        ) from None


def _manifest(table: dict[str, Any]) -> Manifest:
    if table["kind"] != _KIND:
        raise ValueError(f"kind is {table['kind']!r}")
    for name in (shard["name"] for shard in table["shards"]):
        if name in ("", "..") or Path(name).name != name:
            raise ValueError(f"a shard must be named without a folder, got {name!r}")
    return Manifest(
        job=_job(table["job"]),
        versions=dict(table["versions"]),
        shards=tuple(_shard(shard) for shard in table["shards"]),
    )


def _job(table: dict[str, Any]) -> Job:
    scenario = scenario_from_text(_text(table, "scenario"))
    job = Job(**{**table, "scenario": scenario})
    for name, least in {"seed": 0, "episodes": 1, "episodes_per_shard": 1}.items():
        integer(name, getattr(job, name), least)
    _text(table, "controller")
    _text(table, "format")
    if job.estimator is not None:
        _text(table, "estimator")
    return job


def _shard(table: dict[str, Any]) -> ShardEntry:
    _text(table, "sha256")
    entry = ShardEntry(**table)
    integer("first_episode", entry.first_episode, 0)
    integer("episodes", entry.episodes, 0)
    return entry


def _text(table: dict[str, Any], name: str) -> str:
    if not isinstance(table[name], str):
        raise ValueError(f"{name} must be text, got {table[name]!r}")
    return str(table[name])


def checksum(path: Path) -> str:
    """Compute the SHA-256 of a shard.

    For a folder it is the SHA-256 of the output of ``sha256sum`` for its files, named
    by their relative paths in alphabetical order.

    Raises
    ------
    FileNotFoundError
        If there is no such shard.
    """
    if not path.is_dir():
        return _file_checksum(path)
    names = (
        file.relative_to(path).as_posix() for file in path.rglob("*") if file.is_file()
    )
    lines = [f"{_file_checksum(path / name)}  {name}\n" for name in sorted(names)]
    return hashlib.sha256("".join(lines).encode()).hexdigest()


def _file_checksum(path: Path) -> str:
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


# --------------------------------------------------------------------------------------
# The folder of a data set while it is written: one writer, only complete shards.

_WRITING = ".writing-"
_ATTEMPTS, _BETWEEN = 20, 0.1  # [s]
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
        leftovers = [e for e in folder.iterdir() if _LEFTOVERS.fullmatch(e.name)]
        names = (Path(name).parts[0] for name in files_below(folder))
        foreign = next((name for name in names if not _LEFTOVERS.fullmatch(name)), None)
        if foreign and not (folder / MANIFEST).exists():
            raise ValueError(
                f"out must be a new or empty folder, or hold a {MANIFEST}: "
                f"{folder} holds {foreign}"
            )
        for leftover in leftovers:
            _remove(leftover)
        yield


@contextlib.contextmanager
def staging_folder(folder: Path) -> Iterator[Path]:
    """Provide an absolute folder inside `folder`, and remove it after the block.

    Shards are written there, and `put_in_place` moves them.
    """
    staging = folder.resolve() / f"{_WRITING}{secrets.token_hex(4)}"
    staging.mkdir()
    try:
        yield staging
    finally:
        _remove(staging)


@contextlib.contextmanager
def naming(folder: Path) -> Iterator[None]:
    """Name the folder in errors of the system, such as a full disk.

    Raises
    ------
    OSError
        In place of an error of the system.
    """
    try:
        yield
    except OSError as error:
        if error.strerror is None:
            raise
        raise OSError(
            f"{folder} cannot be written: {error.strerror}; whole shards stay there, "
            "and the same command continues"
        ) from error


def put_in_place(staged: Path, folder: Path, own: set[ShardEntry | None]) -> None:
    """Move a complete shard, a file or a folder, and replace the shard that is there.

    What is there is set aside with a warning, if it is none of our own shards.
    """
    path = folder / staged.name
    if os.path.lexists(path):
        if path.is_symlink() or not any(is_whole(folder, each) for each in own if each):
            set_aside(path, f"does not match its checksum in {MANIFEST}")
        else:
            _remove(path)
    staged.replace(path)


def _remove(path: Path) -> None:
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


_DAMAGED = ("raise", "skip")


class DamagedShardError(ValueError):
    """A shard is missing, or its bytes differ from the manifest."""


class TrajectoryDataset:
    """The trajectories in a folder; iteration reads shard after shard.

    Parameters
    ----------
    folder : Path
        Folder with a manifest.
    damaged : {"raise", "skip"}
        Treatment of damaged shards, see `load_trajectories`.

    Attributes
    ----------
    folder : Path
        Folder of the shards.
    manifest : Manifest
        Their description; ``manifest.is_complete`` reports whether all are written.
    """

    def __init__(self, folder: Path, damaged: Literal["raise", "skip"]) -> None:
        self.folder = folder
        self.manifest: Manifest = read_manifest(folder)
        self._skips = damaged == "skip"
        self._format = trajectory_format(self.manifest.job.format)

    def __len__(self) -> int:
        return sum(shard.episodes for shard in self.manifest.shards)

    def __iter__(self) -> Iterator[Trajectory]:
        for shard in self.manifest.shards:
            try:
                self._check(shard)
            except DamagedShardError as error:
                if not self._skips:
                    raise
                warnings.warn(f"{error}: left out", stacklevel=2)
                continue
            yield from self._format.read(self.folder / shard.name)

    def shard(self, number: int) -> Iterator[Trajectory]:
        """Yield the trajectories of one shard.

        Parameters
        ----------
        number : int
            Index in ``manifest.shards``.

        Raises
        ------
        DamagedShardError
            If the shard is damaged, even where iteration skips such shards.
        """
        shard = self.manifest.shards[number]
        self._check(shard)
        yield from self._format.read(self.folder / shard.name)

    def damaged_shards(self) -> list[str]:
        """Return the names of the shards that are missing or damaged."""
        return [
            shard.name
            for shard in self.manifest.shards
            if not is_whole(self.folder, shard)
        ]

    def _check(self, shard: ShardEntry) -> None:
        if not is_whole(self.folder, shard):
            last = shard.first_episode + shard.episodes - 1
            raise DamagedShardError(
                f"{self.folder / shard.name} does not match its checksum (episodes "
                f"{shard.first_episode} to {last})"
            )


def load_trajectories(
    path: str | PathLike[str], *, damaged: Literal["raise", "skip"] = "raise"
) -> TrajectoryDataset:
    """Open a folder of generated trajectories in any format.

    Parameters
    ----------
    path : path
        The folder; an unfinished one gives its written shards, and warns.
    damaged : {"raise", "skip"}, optional
        Treatment of a shard that does not match its checksum: iteration raises a
        `DamagedShardError`, or warns and continues with the next one.

    Returns
    -------
    TrajectoryDataset
        Iterable over `Trajectory` in the order of episodes, any number of times; one
        shard at a time is in memory.

    Raises
    ------
    ValueError
        If the folder holds no manifest, or `damaged` is neither.
    ImportError
        If the package of its format is not installed.

    Warns
    -----
    UserWarning
        If episodes are missing, with their number and the way to generate them.
    """
    if damaged not in _DAMAGED:
        hint = closest(str(damaged), _DAMAGED)
        raise ValueError(f"damaged must be 'raise' or 'skip', got {damaged!r}{hint}")
    dataset = TrajectoryDataset(Path(path), damaged)
    if not dataset.manifest.is_complete:
        warnings.warn(_unfinished(dataset), stacklevel=2)
    return dataset


def _unfinished(dataset: TrajectoryDataset) -> str:
    """Write how many episodes are there, and the job that generates the rest."""
    job = dataset.manifest.job
    return (
        f"{dataset.folder} is not finished: {len(dataset)} of {job.episodes} episodes "
        "are there. Where no process writes them now, the same slamgym generate or "
        f"generate_trajectories makes the others: scenario '{job.scenario.name}', "
        f"episodes={job.episodes}, controller={job.controller!r}, seed={job.seed}, "
        f"format={job.format!r}, episodes_per_shard={job.episodes_per_shard}"
    )


def is_whole(folder: Path, shard: ShardEntry) -> bool:
    """Whether a shard has the checksum in the manifest."""
    try:
        return checksum(folder / shard.name) == shard.sha256
    except OSError:
        return False
