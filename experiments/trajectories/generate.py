"""Generate trajectories shard by shard, and continue after an interruption."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Generator, Mapping
from contextlib import closing
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path
from reprlib import repr as short_repr
from typing import TYPE_CHECKING, NamedTuple

from ...envs.controllers import CONTROLLERS
from ...envs.spaces import count_rows
from ...sim_configs import Scenario, load_scenario
from ...sim_configs.field_types import unknown_choice
from ..runs.filter_settings import integer, one_blas_thread
from .formats import TrajectoryFormat, trajectory_format
from .manifest import (
    MANIFEST,
    Job,
    Manifest,
    ShardEntry,
    checksum,
    claimed,
    is_whole,
    naming,
    put_in_place,
    read_manifest,
    staging_folder,
    versions_now,
    write_manifest,
)

if TYPE_CHECKING:
    from ..monte_carlo.runner import Workers


Progress = Callable[[int, int], object]


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
    backend : {"loky", "dask", "ray"}, optional
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
    if episodes_per_shard is None:
        episodes_per_shard = default_episodes_per_shard(
            world, beliefs=estimator is not None
        )
    episodes_per_shard = integer("episodes_per_shard", episodes_per_shard, 1)
    if controller not in CONTROLLERS:
        raise ValueError(unknown_choice("controller", controller, CONTROLLERS))
    layout = trajectory_format(format)
    layout.check(world)
    smallest = checked_smallest_std(format, layout, smallest_std)
    check_estimator(world, format, layout, estimator)
    job = Job(
        world,
        controller,
        seed,
        episodes,
        episodes_per_shard,
        format,
        smallest,
        estimator,
    )
    versions = versions_of(job)
    workers = _engaged(jobs, backend)
    with claimed(Path(out)), naming(Path(out)):
        return _continue(job, Path(out), versions, workers, progress)


def _engaged(jobs: int | None, backend: str | None) -> Workers | None:
    if jobs is None and backend is None:
        return None
    from ..monte_carlo.runner import engage_workers  # noqa: PLC0415 (loads joblib)

    return engage_workers(jobs, backend)


def _continue(
    job: Job,
    out: Path,
    versions: dict[str, str],
    workers: Workers | None,
    progress: Progress | None,
) -> Manifest:
    manifest = _begun(job, out, versions)
    bar = _Bar(job, progress)
    entries = {job.shard_of(entry.first_episode): entry for entry in manifest.shards}
    missing = []
    for number in range(job.shards):
        entry, episodes = entries.get(number), len(job.episodes_of(number))
        if entry and entry.episodes == episodes and is_whole(out, entry):
            bar.skip(episodes)
        else:
            missing.append(number)
    with staging_folder(out) as staging:
        work = ShardWork(job, manifest.versions, staging)
        with closing(_made(work, missing, workers, bar)) as made:  # ends the workers
            for shard in made:
                promised = entries.get(shard.number)
                _check_promise(out, promised, shard.entry)
                put_in_place(work.fetch(shard), out, {promised, shard.entry})
                entries[shard.number] = shard.entry
                manifest = manifest.with_shards(entries[k] for k in sorted(entries))
                write_manifest(manifest, out)
    return manifest


def _made(
    work: ShardWork, numbers: list[int], workers: Workers | None, bar: _Bar
) -> Generator[MadeShard, None, None]:
    """Yield shards as they come, in any order where workers make them."""
    if workers is None:
        yield from (work.make(number, bar.advance) for number in numbers)
        return
    from ..monte_carlo.runner import saying_what_is_kept  # noqa: PLC0415

    kept = f"whole shards stay in {work.staging.parent}, the same command continues"
    with saying_what_is_kept(kept):
        for made in workers((make_shard, (work, number), {}) for number in numbers):
            yield made
            bar.advance(made.entry.episodes * work.job.scenario.steps)


def _check_promise(out: Path, promised: ShardEntry | None, made: ShardEntry) -> None:
    if promised and promised.episodes == made.episodes and promised != made:
        raise OSError(
            f"{out / made.name} was damaged, and generated again it differs from "
            f"{MANIFEST}: this machine does not make the same bits"
        )


def _begun(job: Job, out: Path, versions: dict[str, str]) -> Manifest:
    """Return the manifest of a job that was begun, or begin it."""
    manifest = read_manifest(out) if (out / MANIFEST).exists() else None
    if manifest is None or not manifest.shards:  # begun without a shard
        manifest = Manifest(job, versions)
        write_manifest(manifest, out)
        return manifest
    there = manifest.job
    _refuse_other(out, "scenario.", vars(there.scenario), vars(job.scenario))
    _refuse_other(out, "the version of ", manifest.versions, versions)
    if there.episodes < job.episodes:  # a last shard that is not full is made again
        manifest = replace(manifest, job=replace(there, episodes=job.episodes))
    _refuse_other(out, "", vars(manifest.job), vars(job))
    return manifest


def _refuse_other(
    out: Path, what: str, there: Mapping[str, object], wanted: Mapping[str, object]
) -> None:
    for name in {**there, **wanted}:
        if there.get(name) != wanted.get(name):
            raise ValueError(
                f"{out} holds another job, with {what}{name} = "
                f"{short_repr(there.get(name))}, not {short_repr(wanted.get(name))}: "
                "choose another out"
            )


class _Bar:
    """Count the steps that are done, and report them."""

    def __init__(self, job: Job, progress: Progress | None) -> None:
        self._steps = job.scenario.steps
        self._total = job.episodes * self._steps
        self._progress = progress
        self._done = 0

    def advance(self, steps: int) -> None:
        """Count steps that were driven."""
        self._done += steps
        if self._progress is not None:
            self._progress(self._done, self._total)

    def skip(self, episodes: int) -> None:
        """Count episodes of earlier calls."""
        self._done += episodes * self._steps


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
            from .driven_episodes import with_beliefs  # noqa: PLC0415

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
