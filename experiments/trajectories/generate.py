"""Generate trajectories shard by shard, and continue after an interruption."""

from __future__ import annotations

import os
import platform
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from importlib import metadata
from os import PathLike
from pathlib import Path
from reprlib import repr as short_repr
from typing import NamedTuple

from ... import __version__
from ...envs.controllers import CONTROLLERS
from ...envs.spaces import count_rows
from ...sim_configs import Scenario, load_scenario
from ...sim_configs.field_types import unknown_choice
from ..job_folders import (
    Progress,
    claimed,
    difference,
    engage_workers,
    naming,
    remove,
    remove_leftovers,
    resume,
    set_aside,
    staging_folder,
)
from ..run_and_replay.filter_settings import integer
from .formats import TrajectoryFormat, trajectory_format
from .manifest import (
    MANIFEST,
    DatasetJob,
    Manifest,
    ShardEntry,
    digest,
    is_whole,
    read_manifest,
    write_manifest,
)


def generate_trajectories(
    scenario: Scenario | Mapping[str, object] | str | Path,
    out: str | PathLike[str],
    *,
    episodes: int,
    controller: str = "waypoints",
    seed: int = 0,
    format: str = "npz",
    episodes_per_shard: int | None = None,
    smallest_std: float | None = None,
    estimator: str | None = None,
    jobs: int | None = None,
    backend: str | None = None,
    progress: Progress | None = None,
) -> Manifest:
    """Drive episodes and write them to a folder, or write those that it lacks.

    Every shard and the manifest appear complete or not at all. The same call on the
    same folder keeps complete shards, makes damaged ones again, and ends with the same
    bytes, whatever happened before. A damaged shard, or another file under the name of
    a shard, is set aside with a warning. A call with more episodes adds them to those
    there are, and ends with the bytes of one call.

    Parameters
    ----------
    scenario : Scenario, mapping, str or Path
        The world, as in :func:`slamgym.sim_configs.load_scenario`, perhaps with ranges.
    out : path
        The folder: new, empty, or begun by the same job, perhaps with fewer episodes.
    episodes : int
        Number of episodes, each of ``scenario.steps`` steps.
    controller : str, optional
        Name of the controller, see `make_controller`.
    seed : int, optional
        Seed of episode 0; episode i has the world of seed + i.
    format : str, optional
        Format of the files, see `formats`.
    episodes_per_shard : int, optional
        The default is 100, or fewer if they would take more than 256 MB of memory.
    smallest_std : float, optional
        Smallest standard deviation in the files of g2o [m, rad], 1e-3 by default; other
        formats have none.
    estimator : str, optional
        A filter, with or without options in brackets, whose beliefs after every scan
        are written beside the truth; see `with_beliefs`. The formats npz, parquet and
        minari hold them.
    jobs : int, optional
        Number of workers, which make one shard at a time each; -1 for one on each
        core. By default this process does all. The bytes are the same.
    backend : {"loky", "dask"}, optional
        Provider of the workers.
    progress : callable, optional
        Called with (steps done, steps of all episodes), which includes steps of
        earlier calls; with workers, after every shard.

    Returns
    -------
    Manifest
        The manifest of the complete data set.

    Raises
    ------
    ValueError
        If an argument does not fit, or the folder holds another job or something else.
        Nothing is written then.
    ImportError
        If the package of the format is not installed.
    OSError
        If a file cannot be written, or a worker is killed.
    """
    world = load_scenario(scenario)
    episodes, seed = integer("episodes", episodes, 1), integer("seed", seed, 0)
    integer("the seed of the last episode", seed + episodes - 1, 0)
    size = episodes_per_shard
    if size is None:
        size = default_episodes_per_shard(world, beliefs=estimator is not None)
    size = integer("episodes_per_shard", size, 1)
    if controller not in CONTROLLERS:
        raise ValueError(unknown_choice("controller", controller, CONTROLLERS))
    layout = trajectory_format(format)
    layout.check(world)
    smallest = checked_smallest_std(format, layout, smallest_std)
    check_estimator(world, format, layout, estimator)
    job = DatasetJob(
        world, controller, seed, episodes, size, format, smallest, estimator
    )
    versions = versions_of(job)
    serial = jobs is None and backend is None
    workers = None if serial else engage_workers(jobs, backend)
    folder = Path(out)
    kept = "; whole shards stay there, and the same command continues"
    with claimed(folder) as anything, naming(folder, kept):
        manifest = _begun(job, folder, versions, anything)
        with staging_folder(folder) as staging:
            shards = _Shards(folder, staging, manifest)
            resume(
                ShardWork(job, versions, staging),
                shards.missing(),
                shards.keep,
                workers,
                runs=job.episodes,
                steps=world.steps,
                progress=progress,
                kept=f"whole shards stay in {staging.parent}, the same command "
                "continues",
            )
    return shards.manifest


def _begun(
    job: DatasetJob, folder: Path, versions: dict[str, str], anything: str | None
) -> Manifest:
    """Return the manifest of a job that was begun, or begin it."""
    there = (folder / MANIFEST).exists()
    if anything and not there:
        raise ValueError(
            f"out must be a new or empty folder, or hold a {MANIFEST}: "
            f"{folder} holds {anything}"
        )
    remove_leftovers(folder)
    manifest = read_manifest(folder) if there else None
    if manifest is None or not manifest.shards:  # begun without a shard
        manifest = Manifest(job, versions)
        write_manifest(manifest, folder)
        return manifest
    begun = vars(manifest.job)
    if manifest.job.episodes < job.episodes:
        begun = begun | {"episodes": job.episodes}
    for what, found, asked in (
        ("scenario.", vars(manifest.job.scenario), vars(job.scenario)),
        ("the version of ", manifest.versions, versions),
        ("", begun, vars(job)),
    ):
        name = difference(found, asked)
        if name is not None:
            raise ValueError(
                f"{folder} holds another job, with {what}{name} = "
                f"{short_repr(found.get(name))}, not {short_repr(asked.get(name))}: "
                "choose another out"
            )
    return replace(manifest, job=job)


@dataclass
class _Shards:
    """The shards of a data set in its folder, which is claimed."""

    folder: Path
    staging: Path
    manifest: Manifest

    def missing(self) -> list[range]:
        """Return the episodes of each shard that is missing, damaged or not full."""
        whole = {
            range(shard.first_episode, shard.first_episode + shard.episodes)
            for shard in self.manifest.shards
            if is_whole(self.folder, shard)
        }
        return [block for block in self.manifest.job.shards if block not in whole]

    def keep(self, block: range, made: MadeShard) -> None:
        """Move a shard to its place, and list it in the manifest.

        What is there is set aside with a warning, if it is none of our own shards.
        """
        listed = {shard.first_episode: shard for shard in self.manifest.shards}
        promised, entry = listed.get(block.start), made.entry
        path = self.folder / entry.name
        if promised and promised.episodes == entry.episodes and promised != entry:
            raise OSError(
                f"{path} was damaged, and generated again it differs from {MANIFEST}: "
                "this machine does not make the same bits"
            )
        staged = fetched(made, self.staging)
        if os.path.lexists(path):
            own = [shard for shard in (promised, entry) if shard]
            if path.is_symlink() or not any(is_whole(self.folder, s) for s in own):
                set_aside(path, f"does not match its checksum in {MANIFEST}")
            else:
                remove(path)
        staged.replace(path)
        listed[block.start] = entry
        in_order = tuple(listed[first] for first in sorted(listed))
        self.manifest = replace(self.manifest, shards=in_order)
        write_manifest(self.manifest, self.folder)


class MadeShard(NamedTuple):
    """A shard in a staging folder, or its content."""

    entry: ShardEntry
    path: Path
    #: Content of its files by their relative paths ("." for a shard that is one file);
    #: None if the shard stands in the staging folder of the job.
    files: dict[str, bytes] | None = None


@dataclass(frozen=True)
class ShardWork:
    """All that a worker needs to make any shard of a data set.

    Attributes
    ----------
    job : DatasetJob
        The data set.
    versions : dict of str to str
        Versions in its manifest; a worker with other ones refuses to work.
    staging : Path
        Absolute folder for shards that are not in place yet. A worker on a machine
        without it sends the files instead.
    """

    job: DatasetJob
    versions: dict[str, str]
    staging: Path

    def __call__(
        self, episodes: range, progress: Callable[[int], object] | None
    ) -> MadeShard:
        """Drive and write the episodes of a shard.

        Parameters
        ----------
        episodes : range
            The shard's.
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
        if self.staging.is_dir():  # another worker may have begun this shard
            place = Path(tempfile.mkdtemp(dir=self.staging))
            return self._write(episodes, place, progress)
        with tempfile.TemporaryDirectory() as folder:
            made = self._write(episodes, Path(folder), progress)
            files = [made.path] if made.path.is_file() else made.path.rglob("*")
            content = {
                file.relative_to(made.path).as_posix(): file.read_bytes()
                for file in files
                if file.is_file()
            }
            return made._replace(files=content)

    def _write(
        self, episodes: range, folder: Path, progress: Callable[[int], object] | None
    ) -> MadeShard:
        # The process that engages workers never loads the simulator.
        from .driven_episodes import drive_episodes, with_beliefs  # noqa: PLC0415

        job, layout = self.job, trajectory_format(self.job.format)
        seeds = [job.seed + episode for episode in episodes]
        driven = drive_episodes(job.scenario, job.controller, seeds, progress=progress)
        if job.estimator is not None:
            driven = [with_beliefs(each, job.estimator) for each in driven]
        number = episodes.start // job.episodes_per_shard
        path = folder / f"shard_{number:05d}{layout.ENDING}"
        options = {name: getattr(job, name) for name in layout.OPTIONS}
        layout.write(driven, path, **options)
        entry = ShardEntry(path.name, episodes.start, len(episodes), digest(path))
        return MadeShard(entry, path)


def fetched(made: MadeShard, staging: Path) -> Path:
    """Return the path of a shard in the staging folder, where its files are put."""
    if made.files is None:
        return made.path
    path = staging / made.entry.name
    for name, content in made.files.items():
        file = path / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(content)
    return path


def versions_of(job: DatasetJob) -> dict[str, str]:
    """Return the versions that determine the bits of a job on this machine."""
    kernels = () if job.estimator is None else ("numba",)
    packages = ("numpy", *trajectory_format(job.format).LIBRARIES, *kernels)
    return {
        "slamgym": __version__,
        "python": ".".join(platform.python_version_tuple()[:2]),
        "machine": platform.machine(),
        **{name: metadata.version(name) for name in packages},
    }


_MOST_EPISODES = 100
_MOST_MEMORY = 256e6  # [bytes] of a shard


def checked_smallest_std(
    format: str, layout: TrajectoryFormat, given: float | None
) -> float | None:
    """Return the smallest standard deviation that a format writes, if it has one."""
    usual = layout.OPTIONS.get("smallest_std")
    if given is None:
        return usual
    if usual is None:
        raise ValueError(
            f"smallest_std is of the format 'g2o': format '{format}' writes no noise"
        )
    if not 0 < given < float("inf"):
        raise ValueError(f"smallest_std must be a finite number > 0, got {given!r}")
    return float(given)


def check_estimator(
    world: Scenario, format: str, layout: TrajectoryFormat, estimator: str | None
) -> None:
    """Refuse a filter that cannot be, and a format that does not hold beliefs."""
    if estimator is None:
        return
    if not isinstance(estimator, str):
        raise TypeError(f"estimator must be the name of a filter, got {estimator!r}")
    if not layout.HOLDS_BELIEFS:
        raise ValueError(
            f"estimator must be None for format '{format}', which holds no beliefs "
            f"(npz, parquet and minari do), got {estimator!r}"
        )
    from .driven_episodes import belief_settings  # noqa: PLC0415 (loads the filters)

    belief_settings(world, estimator).make((0.0, 0.0, 0.0))


def default_episodes_per_shard(scenario: Scenario, *, beliefs: bool = False) -> int:
    """Return how many episodes of a scenario a shard holds by default.

    Examples
    --------
    >>> from slamgym.sim_configs import load_scenario
    >>> default_episodes_per_shard(load_scenario("loop"))
    100
    """
    row = 25 * count_rows(scenario) + 57  # bytes of one moment
    if beliefs:
        row += 56 * count_rows(scenario) + 96
    return int(max(1, min(_MOST_EPISODES, _MOST_MEMORY // (row * scenario.steps))))
