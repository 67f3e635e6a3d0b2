"""Generate trajectories shard by shard, and continue after an interruption."""

from collections.abc import Callable, Generator, Mapping
from contextlib import closing
from dataclasses import replace
from os import PathLike
from pathlib import Path
from reprlib import repr as short_repr
from typing import TYPE_CHECKING

from ...envs.controllers import CONTROLLERS
from ...sim_configs import Scenario, load_scenario
from ...sim_configs.field_types import unknown_choice
from ..runs.integers import integer
from .dataset import is_whole
from .formats import trajectory_format
from .job_options import (
    check_estimator,
    checked_smallest_std,
    default_episodes_per_shard,
)
from .manifest import (
    MANIFEST,
    Job,
    Manifest,
    ShardEntry,
    read_manifest,
    write_manifest,
)
from .shard_folder import claimed, naming, put_in_place, staging_folder
from .shard_work import MadeShard, ShardWork, make_shard, versions_of

if TYPE_CHECKING:
    from ..monte_carlo.workers import Workers

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


def _engaged(jobs: int | None, backend: str | None) -> "Workers | None":
    if jobs is None and backend is None:
        return None
    from ..monte_carlo.workers import engage_workers  # noqa: PLC0415 (loads joblib)

    return engage_workers(jobs, backend)


def _continue(
    job: Job,
    out: Path,
    versions: dict[str, str],
    workers: "Workers | None",
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
    work: ShardWork, numbers: list[int], workers: "Workers | None", bar: "_Bar"
) -> Generator[MadeShard, None, None]:
    """Yield shards as they come, in any order where workers make them."""
    if workers is None:
        yield from (work.make(number, bar.advance) for number in numbers)
        return
    from ..monte_carlo.workers import saying_what_is_kept  # noqa: PLC0415

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
