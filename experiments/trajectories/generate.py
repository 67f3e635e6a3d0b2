"""Generate trajectories shard by shard, and continue after an interruption."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from os import PathLike
from pathlib import Path
from reprlib import repr as short_repr

from ...envs.controllers import CONTROLLERS
from ...envs.spaces import count_rows
from ...sim_configs import Scenario, load_scenario
from ...sim_configs.scenario_errors import unknown_choice
from .dataset import is_whole
from .driven_episodes import drive_episodes
from .formats import TrajectoryFormat, trajectory_format
from .manifest import (
    MANIFEST,
    Job,
    Manifest,
    ShardEntry,
    checksum,
    read_manifest,
    versions_now,
    write_manifest,
)
from .shard_folder import claimed, replace_shard

Progress = Callable[[int, int], object]

_MOST_EPISODES = 100
_MOST_MEMORY = 256e6  # [bytes] of a shard


def generate_trajectories(
    scenario: Scenario | Mapping[str, object] | str | Path,
    out: str | PathLike[str],
    *,
    episodes: int,
    controller: str = "waypoints",
    seed: int = 0,
    format: str = "npz",
    episodes_per_shard: int | None = None,
    progress: Progress | None = None,
) -> Manifest:
    """Drive episodes and write them to a folder, or write those that it lacks.

    Every shard and the manifest appear complete or not at all. The same call on the
    same folder keeps complete shards, replaces damaged ones, and ends with the same
    bytes, whatever happened before. A call with more episodes adds them to those there
    are, and ends with the bytes of one call.

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
    progress : callable, optional
        Called with (steps done, steps of all episodes), which includes steps of
        earlier calls.

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
        If a file cannot be written.
    """
    world = load_scenario(scenario)
    _check_numbers(episodes=(episodes, 1), seed=(seed, 0))
    if episodes_per_shard is None:
        episodes_per_shard = default_episodes_per_shard(world)
    _check_numbers(episodes_per_shard=(episodes_per_shard, 1))
    if controller not in CONTROLLERS:
        raise ValueError(unknown_choice("controller", controller, CONTROLLERS))
    layout = trajectory_format(format)
    layout.check(world)
    job = Job(world, controller, seed, episodes, episodes_per_shard, format)
    with claimed(Path(out)):
        return _continue(job, Path(out), layout, progress)


def default_episodes_per_shard(scenario: Scenario) -> int:
    """Return how many episodes of a scenario a shard holds by default.

    Examples
    --------
    >>> default_episodes_per_shard(load_scenario("loop"))
    100
    """
    row = 25 * count_rows(scenario) + 57  # bytes of one moment
    return int(max(1, min(_MOST_EPISODES, _MOST_MEMORY // (row * scenario.steps))))


def _check_numbers(**numbers: tuple[int, int]) -> None:
    for name, (value, least) in numbers.items():
        if isinstance(value, bool) or not isinstance(value, int) or value < least:
            raise ValueError(f"{name} must be an integer >= {least}, got {value!r}")


def _continue(
    job: Job, out: Path, layout: TrajectoryFormat, progress: Progress | None
) -> Manifest:
    manifest = _begun(job, out, versions_now(layout.LIBRARIES))
    bar = _Bar(job, progress)
    entries = dict(enumerate(manifest.shards))
    for number in range(job.shards):
        entry = entries.get(number)
        if entry is not None and is_whole(out, entry):
            bar.skip(len(job.episodes_of(number)))
            continue
        entries[number] = _make_shard(job, number, out, layout, entry, bar)
        manifest = manifest.with_shards(entries[k] for k in sorted(entries))
        write_manifest(manifest, out)
    return manifest


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
    if there.episodes < job.episodes:
        manifest = _extended(manifest, job.episodes)
    _refuse_other(out, "", vars(manifest.job), vars(job))
    return manifest


def _extended(manifest: Manifest, episodes: int) -> Manifest:
    """Return the manifest of a job with more episodes.

    A last shard that is not full is left out: it is written again with more episodes.
    """
    job = replace(manifest.job, episodes=episodes)
    full = [
        shard
        for number, shard in enumerate(manifest.shards)
        if shard.episodes == len(job.episodes_of(number))
    ]
    return replace(manifest, job=job, shards=tuple(full))


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


def _make_shard(
    job: Job,
    number: int,
    out: Path,
    layout: TrajectoryFormat,
    promised: ShardEntry | None,
    bar: "_Bar",
) -> ShardEntry:
    """Drive and write the episodes of a shard."""
    episodes = job.episodes_of(number)
    name = f"shard_{number:05d}{layout.ENDING}"
    seeds = [job.seed + episode for episode in episodes]
    trajectories = drive_episodes(
        job.scenario, job.controller, seeds, progress=bar.advance
    )
    with replace_shard(out / name) as partial:
        layout.write(trajectories, partial)
        entry = ShardEntry(name, episodes.start, len(episodes), checksum(partial))
        if promised is not None and promised != entry:
            raise OSError(
                f"{out / name} was damaged, and generated again it differs from "
                f"{MANIFEST}: this machine does not make the same bits"
            )
    return entry


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
