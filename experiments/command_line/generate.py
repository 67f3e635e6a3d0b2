"""``slamgym generate``: write many drives through a scenario as a data set."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from ...suggestions import counted
from .. import trajectories
from .commands import command, interruptible
from .monte_carlo import connected
from .options import REQUIRED, Options, ScenarioName, declared, refuse_broken, takes

if TYPE_CHECKING:
    from ..trajectories.manifest import Manifest


@dataclass(frozen=True, kw_only=True)
class GenerateOptions(Options):
    """The options of ``slamgym generate``.

    Attributes
    ----------
    episodes
        Number of episodes; episode i has seed SEED + i.
    format_
        npz, parquet and minari hold all data; slamlog, g2o and tum hold the parts that
        their formats can express.
    shard
        Episodes in each file or folder of the data set.
    smallest_std
        Smallest standard deviation in files of g2o [m, rad].
    believer
        A filter; its beliefs after every scan are written with the truth (npz, parquet
        and minari).
    out
        The folder to write: new, empty, or begun by the same command, which then
        continues, perhaps with more episodes.
    """

    episodes: int = declared(REQUIRED, "N", min=1)
    format_: str = declared("npz", "--format NAME")
    shard: int | None = declared(None, "N", "100, or fewer large ones", min=1)
    smallest_std: float | None = declared(None, "--smallest-std S", "0.001")
    believer: str | None = declared(None, "--estimator -e NAME", "none")
    out: Path | None = declared(None, "DIR", "results/<name>-<controller>-<format>")


@command
@takes(
    "episodes controller seed format_ shard smallest_std believer jobs backend "
    "scheduler steps set_ out as_json",
    controller="waypoints",
)
def generate(scenario: ScenarioName, *, given: GenerateOptions) -> None:
    """Write a data set of trajectories.

    Drive many episodes of a scenario and write them as a data set: the actions, the
    readings, and the truth. After an interruption, the same command continues where
    it stopped; with more episodes, it adds those to the folder. The same command always
    writes the same bytes.

    Examples
    --------
    slamgym generate loop --episodes 1000
    slamgym generate corridor --episodes 50 --controller random --format parquet
    slamgym generate loop --episodes 100000 --jobs -1
    slamgym generate hidden_identities --episodes 100 --estimator invariant
    slamgym generate loop --episodes 9 --set randomise.motion_std=[0.5,2]
    """
    from .output_folder import default_folder

    world = given.scenario(scenario)
    if given.believer is not None:
        refuse_broken(given.believer)
    place = given.out or default_folder(world.name, given.controller, given.format_)
    reporter = given.reporter()
    stopped = f"interrupted; whole shards stay in {place}, the same command continues"
    with (
        connected(given.backend, given.scheduler, given.jobs),
        reporter.warnings(),
        reporter.progress("driving", unit="steps") as tick,
        interruptible(stopped),
    ):
        manifest = trajectories.generate_trajectories(
            world,
            place,
            episodes=given.episodes,
            controller=given.controller,
            seed=given.seed,
            format=given.format_,
            episodes_per_shard=given.shard,
            smallest_std=given.smallest_std,
            estimator=given.believer,
            jobs=given.jobs,
            backend=given.backend,
            progress=tick,
        )
    size = sum(file.stat().st_size for file in place.rglob("*") if file.is_file())
    reporter.show_verbatim(_message(manifest, place, size))
    reporter.finish(_summary(manifest, place, size))


def _message(manifest: "Manifest", place: Path, size: int) -> str:
    job, shards = manifest.job, len(manifest.shards)
    return (
        f"{place}: {job.episodes:,} episodes of {job.scenario.steps:,} steps as "
        f"{job.format}, {size / 1e6:,.1f} MB in {counted(shards, 'shard')}\n"
        "from slamgym import load_trajectories\n"
        f'for trajectory in load_trajectories("{place.as_posix()}"): ...'
    )


def _summary(manifest: "Manifest", place: Path, size: int) -> dict[str, object]:
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
