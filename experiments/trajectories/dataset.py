"""Read generated trajectories one after the other."""

import warnings
from collections.abc import Iterator
from os import PathLike
from pathlib import Path
from typing import Literal

from ...suggestions import closest
from .formats import trajectory_format
from .manifest import Manifest, ShardEntry, checksum, read_manifest
from .trajectory import Trajectory

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
