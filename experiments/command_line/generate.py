"""``slamgym generate``: many drives through a scenario, written as a data set."""

from pathlib import Path

from rich.console import Console
from rich.text import Text

from ...sim_configs import Scenario
from ..trajectories.generate import generate_trajectories
from ..trajectories.manifest import Manifest
from .errors import InterruptedRunError
from .output_folder import default_folder
from .reporter import Reporter


def write_trajectories(
    scenario: Scenario,
    *,
    episodes: int,
    controller: str,
    seed: int,
    format: str,
    episodes_per_shard: int | None,
    out: Path | None,
    as_json: bool,
) -> None:
    """Generate trajectories, or go on where that was stopped, and tell where they lie.

    Parameters
    ----------
    scenario : Scenario
        The world.
    episodes, controller, seed, format, episodes_per_shard
        As in `generate_trajectories`.
    out : Path or None
        The folder to write; None chooses one below results.
    as_json : bool
        Whether to print the summary for programs.
    """
    place = out or default_folder(scenario.name, controller, format)
    reporter = Reporter(as_json=as_json)
    with reporter.progress("driving", unit="steps") as tick:
        try:
            manifest = generate_trajectories(
                scenario,
                place,
                episodes=episodes,
                controller=controller,
                seed=seed,
                format=format,
                episodes_per_shard=episodes_per_shard,
                progress=tick,
            )
        except KeyboardInterrupt:
            raise InterruptedRunError(
                f"interrupted; whole shards stay in {place}, the same command goes on"
            ) from None
    size = sum(file.stat().st_size for file in place.rglob("*") if file.is_file())
    if not as_json:  # in lines as they are: two of them are meant to be copied
        message = Text(_message(manifest, place, size))
        Console(highlight=False).print(message, soft_wrap=True)
    reporter.finish(_summary(manifest, place, size))


def _message(manifest: Manifest, place: Path, size: int) -> str:
    job, shards = manifest.job, len(manifest.shards)
    return (
        f"{place}: {job.episodes:,} episodes of {job.scenario.steps:,} steps as "
        f"{job.format}, {size / 1e6:,.1f} MB in {shards} shard{'s' * (shards > 1)}\n"
        "from slamgym.experiments.trajectories import load_trajectories\n"
        f'for trajectory in load_trajectories("{place.as_posix()}"): ...'
    )


def _summary(manifest: Manifest, place: Path, size: int) -> dict[str, object]:
    job = manifest.job
    return {
        "slamgym": manifest.versions["slamgym"],
        "scenario": job.scenario.name,
        "controller": job.controller,
        "seed": job.seed,
        "episodes": job.episodes,
        "steps": job.episodes * job.scenario.steps,
        "format": job.format,
        "shards": len(manifest.shards),
        "bytes": size,
        "out": str(place),
    }
