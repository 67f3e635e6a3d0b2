"""The manifest of a data set of trajectories, for checks and for reproduction.

A data set is a folder of shards with ``manifest.json``. The manifest names the job
(scenario, controller, seed, numbers, format), the versions that determine its bits, and
every shard with its SHA-256. It holds no date and no path: the same job gives the same
bytes.
"""

import hashlib
import json
import platform
from collections.abc import Iterable
from dataclasses import asdict, dataclass, replace
from importlib import metadata
from pathlib import Path
from typing import Any

from ... import __version__
from ...sim_configs import Scenario
from ...sim_configs.atomic_file import replace_when_written
from ...sim_configs.scenario_files import scenario_text
from ..runs.integers import integer
from .trajectory import scenario_from_text

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
