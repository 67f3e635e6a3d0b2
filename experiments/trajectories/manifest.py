"""A data set of trajectories: its manifest, its folder, and how it is read.

A data set is a folder of shards with ``manifest.json``. The manifest names the job
(scenario, controller, seed, numbers, format), the versions that determine its bits, and
every shard with its SHA-256. It holds no date and no path: the same job gives the same
bytes. `load_trajectories` reads the trajectories one after the other.
"""

import hashlib
import json
import warnings
import zipfile
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass
from os import PathLike
from pathlib import Path
from typing import Any, Literal

from ...sim_configs import Scenario
from ...sim_configs.field_types import unknown_choice
from ...sim_configs.scenario_files import replace_when_written, scenario_text
from ..job_folders import blocks_of, sha256_of
from ..run_and_replay.filter_settings import integer
from .formats import trajectory_format
from .trajectory import Trajectory, scenario_from_text

MANIFEST = "manifest.json"
_KIND = "slamgym trajectories 1"


@dataclass(frozen=True)
class DatasetJob:
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
    def shards(self) -> list[range]:
        """The episodes of every shard."""
        return blocks_of(range(self.episodes), self.episodes_per_shard)


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
        Its `digest`.
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
    job : DatasetJob
        The job.
    versions : dict of str to str
        Versions of all that can change a bit: packages, Python, processor type.
    shards : tuple of ShardEntry
        The shards in the order of their episodes; workers may leave gaps on the way.
    """

    job: DatasetJob
    versions: dict[str, str]
    shards: tuple[ShardEntry, ...] = ()

    @property
    def is_complete(self) -> bool:
        """Whether all episodes are written."""
        return sum(shard.episodes for shard in self.shards) == self.job.episodes


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
    job, shards = table["job"], table["shards"]
    texts = ["scenario", "controller", "format"]
    if "estimator" in job and job["estimator"] is not None:
        texts.append("estimator")
    job = _checked(job, texts, seed=0, episodes=1, episodes_per_shard=1)
    shards = [_checked(one, ["sha256"], first_episode=0, episodes=0) for one in shards]
    return Manifest(
        job=DatasetJob(**{**job, "scenario": scenario_from_text(job["scenario"])}),
        versions=dict(table["versions"]),
        shards=tuple(ShardEntry(**one) for one in shards),
    )


def _checked(row: dict[str, Any], texts: Iterable[str], **least: int) -> dict[str, Any]:
    """Return a row with some texts, and with some integers of a least value."""
    for name in texts:
        if not isinstance(row[name], str):
            raise ValueError(f"{name} must be text, got {row[name]!r}")
    for name, lowest in least.items():
        integer(name, row[name], lowest)
    return row


def digest(path: Path) -> str:
    """Compute the SHA-256 of a shard.

    For a folder it is the SHA-256 of the output of ``sha256sum`` for its files, named
    by their relative paths in alphabetical order.

    Raises
    ------
    FileNotFoundError
        If there is no such shard.
    """
    if not path.is_dir():
        return sha256_of(path)
    names = (
        file.relative_to(path).as_posix() for file in path.rglob("*") if file.is_file()
    )
    lines = [f"{sha256_of(path / name)}  {name}\n" for name in sorted(names)]
    return hashlib.sha256("".join(lines).encode()).hexdigest()


_DAMAGED = ("raise", "skip")

#: What the readers raise for a file of anything else.
_NO_SHARD = (ValueError, TypeError, LookupError, MemoryError, zipfile.BadZipFile)


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
        for number in range(len(self.manifest.shards)):
            try:
                yield from self.shard(number)
            except DamagedShardError as error:
                if not self._skips:
                    raise
                warnings.warn(f"{error}: left out", stacklevel=2)

    def shard(self, number: int) -> Iterator[Trajectory]:
        """Yield the trajectories of one shard.

        Parameters
        ----------
        number : int
            Index in ``manifest.shards``.

        Raises
        ------
        DamagedShardError
            If the file is damaged or is no shard, even where iteration skips it.
        """
        shard = self.manifest.shards[number]
        if not is_whole(self.folder, shard):
            last = shard.first_episode + shard.episodes - 1
            raise DamagedShardError(
                f"{self.folder / shard.name} does not match its checksum (episodes "
                f"{shard.first_episode} to {last})"
            )
        path = self.folder / shard.name
        try:
            yield from self._format.read(path)
        except _NO_SHARD as error:
            reason = f"{type(error).__name__}: {error}"
            raise DamagedShardError(f"{path} is no shard ({reason})") from None

    def damaged_shards(self) -> list[str]:
        """Return the names of the shards that are missing or damaged."""
        return [
            shard.name
            for shard in self.manifest.shards
            if not is_whole(self.folder, shard)
        ]


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
        raise ValueError(unknown_choice("damaged", damaged, _DAMAGED))
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
        return digest(folder / shard.name) == shard.sha256
    except OSError:
        return False
