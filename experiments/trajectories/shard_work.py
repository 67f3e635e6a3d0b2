"""Drive and write single shards, in this process or in a worker."""

import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from ..runs.blas_threads import one_blas_thread
from .formats import trajectory_format
from .manifest import Job, ShardEntry, checksum, versions_now


class MadeShard(NamedTuple):
    """A shard in a staging folder, or its content."""

    number: int
    """Its place in the data set, from 0."""
    entry: ShardEntry
    files: dict[str, bytes] | None
    """Content of its files by their relative paths ("." for a shard that is one file);
    None if the shard stands in the staging folder."""


@dataclass(frozen=True)
class ShardWork:
    """All that a worker needs to make any shard of a data set.

    Attributes
    ----------
    job : Job
        The data set.
    versions : dict of str to str
        Versions in its manifest; a worker with other ones refuses to work.
    staging : Path
        Absolute folder for shards that are not in place yet. A worker on a machine
        without it sends the files instead.
    """

    job: Job
    versions: dict[str, str]
    staging: Path

    def make(
        self, number: int, progress: Callable[[int], object] | None = None
    ) -> MadeShard:
        """Drive and write the episodes of a shard.

        Parameters
        ----------
        number : int
            Which shard, from 0.
        progress : callable, optional
            Called with the number of steps just done, in all episodes together.

        Raises
        ------
        ValueError
            If this machine has other versions than the manifest.
        """
        here = versions_of(self.job)
        if here != self.versions:
            raise ValueError(
                f"a worker has the versions {here}, the data set {self.versions}: both "
                "must be equal, for equal bytes"
            )
        if self.staging.is_dir():
            return MadeShard(number, self._write(number, self.staging, progress), None)
        with tempfile.TemporaryDirectory() as folder:
            entry = self._write(number, Path(folder), progress)
            return MadeShard(number, entry, _content(_place(Path(folder), entry)))

    def fetch(self, made: MadeShard) -> Path:
        """Return the path of a made shard in the staging folder."""
        path = _place(self.staging, made.entry)
        if made.files is not None:
            for name, content in made.files.items():
                file = path / name
                file.parent.mkdir(parents=True, exist_ok=True)
                file.write_bytes(content)
        return path

    def _write(
        self, number: int, staging: Path, progress: Callable[[int], object] | None
    ) -> ShardEntry:
        # The process that engages workers never loads the simulator.
        from .driven_episodes import drive_episodes  # noqa: PLC0415

        job, layout = self.job, trajectory_format(self.job.format)
        episodes = job.episodes_of(number)
        name = f"shard_{number:05d}{layout.ENDING}"
        seeds = [job.seed + episode for episode in episodes]
        trajectories = drive_episodes(
            job.scenario, job.controller, seeds, progress=progress
        )
        if job.estimator is not None:
            from .beliefs import with_beliefs  # noqa: PLC0415

            name_of = job.estimator
            trajectories = [with_beliefs(each, name_of) for each in trajectories]
        partial = staging / str(episodes.start) / name
        partial.parent.mkdir()
        options = {name: getattr(job, name) for name in layout.OPTIONS}
        layout.write(trajectories, partial, **options)
        return ShardEntry(name, episodes.start, len(episodes), checksum(partial))


def versions_of(job: Job) -> dict[str, str]:
    """Return the versions that determine the bits of a job on this machine."""
    kernels = () if job.estimator is None else ("numba",)
    return versions_now((*trajectory_format(job.format).LIBRARIES, *kernels))


def make_shard(work: ShardWork, number: int) -> MadeShard:
    """Make a shard in a worker, on one thread."""
    with one_blas_thread():
        return work.make(number)


def _place(staging: Path, entry: ShardEntry) -> Path:
    return staging / str(entry.first_episode) / entry.name


def _content(shard: Path) -> dict[str, bytes]:
    files = [shard] if shard.is_file() else shard.rglob("*")
    return {
        file.relative_to(shard).as_posix(): file.read_bytes()
        for file in files
        if file.is_file()
    }
