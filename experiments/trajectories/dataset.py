"""Generated trajectories, read back one after the other."""

import warnings
from collections.abc import Iterator
from os import PathLike
from pathlib import Path
from typing import Literal

from ...sim_configs.scenario_errors import closest
from .formats import trajectory_format
from .manifest import Manifest, ShardEntry, checksum, read_manifest
from .trajectory import Trajectory

_DAMAGED = ("raise", "skip")


class DamagedShardError(ValueError):
    """A shard does not have the bytes that its manifest promises, or is gone."""


class TrajectoryDataset:
    """The trajectories in a folder; iterating reads shard after shard.

    Parameters
    ----------
    folder : Path
        Where a manifest lies.
    damaged : {"raise", "skip"}
        What to do about damaged shards, see `load_trajectories`.

    Attributes
    ----------
    folder : Path
        Where the shards lie.
    manifest : Manifest
        What they are; ``manifest.is_complete`` tells whether any are still to come.
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
            From 0, its place in ``manifest.shards``.

        Raises
        ------
        DamagedShardError
            If the shard is damaged; whatever was told to `load_trajectories`.
        """
        shard = self.manifest.shards[number]
        self._check(shard)
        yield from self._format.read(self.folder / shard.name)

    def damaged_shards(self) -> list[str]:
        """Name the shards that do not match their checksums, or are gone."""
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
    """Open a folder of generated trajectories, of whatever format.

    Parameters
    ----------
    path : path
        The folder; one that is not finished gives what it has, and warns.
    damaged : {"raise", "skip"}, optional
        What happens at a shard that does not match its checksum: iterating raises a
        `DamagedShardError`, or warns and goes on with the next.

    Returns
    -------
    TrajectoryDataset
        Iterable over `Trajectory` in the order of episodes, as often as one likes; at
        any time one shard is in memory.

    Raises
    ------
    ValueError
        If the folder holds no manifest, or `damaged` is neither.
    ImportError
        If the package of its format is not installed.

    Warns
    -----
    UserWarning
        If episodes are still to come: how many there are, and what goes on with them.
    """
    if damaged not in _DAMAGED:
        hint = closest(str(damaged), _DAMAGED)
        raise ValueError(f"damaged must be 'raise' or 'skip', got {damaged!r}{hint}")
    dataset = TrajectoryDataset(Path(path), damaged)
    if not dataset.manifest.is_complete:
        warnings.warn(_unfinished(dataset), stacklevel=2)
    return dataset


def _unfinished(dataset: TrajectoryDataset) -> str:
    """Tell how much is there, and the job that makes the rest."""
    job = dataset.manifest.job
    return (
        f"{dataset.folder} is not finished: {len(dataset)} of {job.episodes} episodes "
        "are there. Where no process writes them now, the same slamgym generate or "
        f"generate_trajectories makes the others: scenario '{job.scenario.name}', "
        f"episodes={job.episodes}, controller={job.controller!r}, seed={job.seed}, "
        f"format={job.format!r}, episodes_per_shard={job.episodes_per_shard}"
    )


def is_whole(folder: Path, shard: ShardEntry) -> bool:
    """Tell whether a shard has the bytes that its manifest promises."""
    try:
        return checksum(folder / shard.name) == shard.sha256
    except OSError:
        return False
