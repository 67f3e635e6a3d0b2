"""Run several estimators over many runs of a scenario, on the same random numbers.

Run i of a job with seed s is simulated in the world of seed s + i. It depends on
nothing else, such as the number of runs, estimators or workers. Runs are simulated,
filtered and measured in blocks; a worker computes one block at a time.
"""

from collections.abc import Callable, Generator, Iterable, Mapping
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from joblib import delayed

from ...arrays import Array
from ...estimator import registry
from ...estimator.interface import SupportsTruth
from ...evaluation.error_bound import PosteriorBound
from ...sim_configs import Scenario, load_scenario
from ..runs.blas_threads import one_blas_thread
from ..runs.filter_settings import FilterSettings
from ..runs.integers import integer
from ..runs.simulated_runs import SimulatedRuns, simulate_runs
from .measure.association_measures import with_known_ids
from .measure.bounds import bound_runs, noise_of_runs
from .measure.estimator_choices import EstimatorChoice, estimator_choices
from .measure.filtered_runs import filter_runs
from .measure.run_measures import Block, measure_runs
from .store.job_folder import RESULTS
from .store.result_blocks import BlockFolder, Job, Span
from .store.results import dataset_of, load_results, write_results
from .workers import Workers, engage_workers, saying_what_is_kept

if TYPE_CHECKING:
    import xarray as xr

Progress = Callable[[int, int], object]

BLOCK_SIZE = 64


@dataclass(frozen=True)
class _Work:
    """All that a worker needs to compute a block."""

    scenario: Scenario
    assumed: Scenario
    settings: tuple[FilterSettings, ...]
    factories: Mapping[str, registry.EstimatorFactory]
    seed: int
    threads: int | None
    resolution: float

    def do(self, span: Span) -> list[Block]:
        """Simulate, filter and measure runs; return one block per estimator."""
        for name, factory in self.factories.items():
            if ":" not in name and not registry.is_registered(name):
                registry.register_estimator(name, factory)
        first = self.seed + span.first
        runs = simulate_runs(self.scenario, span.size, first, only_read=True)
        bound = bound_runs(self.scenario, runs)
        noise = noise_of_runs(self.scenario, self.assumed, runs)
        return [
            self._measure(settings, runs, bound, noise) for settings in self.settings
        ]

    def _measure(
        self,
        settings: FilterSettings,
        runs: SimulatedRuns,
        bound: PosteriorBound,
        noise: Array,
    ) -> Block:
        filtered = filter_runs(settings, runs, threads=self.threads)
        block = measure_runs(runs, filtered, bound, noise, resolution=self.resolution)
        if runs.true_ids is not None:
            block |= with_known_ids(settings, runs, self.threads)
        return block


def monte_carlo(
    scenario: Scenario | Mapping[str, object] | str | Path,
    estimators: str | Iterable[str | registry.EstimatorFactory] | Mapping[str, Any],
    runs: int,
    seed: int = 0,
    *,
    assumed: Scenario | Mapping[str, object] | str | Path | None = None,
    out: str | Path | None = None,
    jobs: int | None = None,
    backend: str | None = None,
    block_size: int = BLOCK_SIZE,
    first_run: int = 0,
    fresh: bool = False,
    resolution: float = 0.0,
    command: str = "",
    progress: Progress | None = None,
) -> "xr.Dataset":
    """Run estimators many times over a scenario, and measure every run.

    Parameters
    ----------
    scenario : Scenario, mapping, str or Path
        The world; its own controls drive the robot.
    estimators : str, iterable of str or class, or mapping
        Names separated by commas, such as ``"ekf,invariant[iterations=3]"`` or
        ``"mypackage.filters:MyFilter"``; or a list of names and classes; or a mapping
        from labels to a class or to a pair (name or class, options).
    runs : int
        Number of runs, at least 1; more than 20 are recommended.
    seed : int
        Seed of run 0; run i has ``seed + i``, so seeds closer than ``runs`` share
        worlds.
    assumed : Scenario, mapping, str or Path, optional
        The scenario whose noise the estimators assume; the world's by default.
    out : str or Path, optional
        A folder for the results. Blocks are written there as they come, and a stopped
        job continues after the last complete one. A file that was changed since is set
        aside with a warning.
    jobs : int, optional
        Number of workers; by default one process with all its cores.
    backend : {"loky", "threading", "dask", "ray"}, optional
        Provider of the workers; `joblib.parallel_config` can also set it from outside.
    block_size : int
        Number of runs in a block.
    first_run : int
        Leave the runs below it to other machines; a multiple of ``block_size``. See
        :func:`~slamgym.experiments.monte_carlo.merge_blocks`.
    fresh : bool
        Whether to remove what an earlier job left in ``out``.
    resolution : float
        True landmarks nearer to each other count as one place [m], in the scores of a
        world that hides identities.
    command : str, optional
        Command that reproduces the results, to be stored with them.
    progress : callable, optional
        Called with (runs done, runs) after every block.

    Returns
    -------
    xarray.Dataset
        The variables of ``run_measures.VARIABLES`` over (estimator, run, step), and
        where the world hides identities, of ``HIDDEN_VARIABLES``; opened from ``out``
        if given.

    Raises
    ------
    ValueError
        If a count is too small, the scenario or an estimator is unknown, or ``out``
        holds another job, or another process writes to it.

    Examples
    --------
    >>> results = monte_carlo("six_landmarks", "ekf,invariant", runs=2)
    >>> dict(results.pose_nees_invariant.sizes)
    {'estimator': 2, 'run': 2, 'step': 30}
    """
    world, choices = load_scenario(scenario), estimator_choices(estimators)
    assumed_world = world if assumed is None else load_scenario(assumed)
    _refuse_other_kind(assumed_world, world)
    size = integer("block_size", block_size, 1)
    asked = _span(integer("first_run", first_run, 0), integer("runs", runs, 1), size)
    whole_seed, apart = integer("seed", seed, 0), _resolution(resolution)
    job = Job(world, assumed_world, choices, whole_seed, size, apart)
    workers = engage_workers(jobs, backend)
    work = _Work(
        world,
        assumed_world,
        tuple(_checked(choice, assumed_world) for choice in choices),
        {choice.name: registry.find_estimator(choice.name) for choice in choices},
        job.seed,
        threads=None if workers is None else 1,
        resolution=job.resolution,
    )
    path = None if out is None else Path(out)
    with one_blas_thread(), BlockFolder(job, path, fresh=fresh) as folder:
        with saying_what_is_kept(_kept_in(path)):
            _complete(folder, asked, work, workers, progress or _no_progress)
        blocks = folder.blocks(asked)
        if path is None:
            return dataset_of(job, blocks, asked, command)
        write_results(path / RESULTS, job, blocks, asked, command)
        return load_results(path / RESULTS)


def _refuse_other_kind(assumed: Scenario, world: Scenario) -> None:
    """Refuse an assumed world with other identities than the true one."""
    if assumed.sensor.identities != world.sensor.identities:
        raise ValueError(
            "assumed must agree with scenario in sensor.identities: only its noise "
            "may differ"
        )


def _resolution(value: float) -> float:
    if not 0 <= value < float("inf"):
        raise ValueError(f"resolution must be a number >= 0, got {value!r}")
    return float(value)


def _no_progress(done: int, runs: int) -> None:
    """Report nothing."""


def _complete(
    folder: BlockFolder,
    asked: Span,
    work: _Work,
    workers: Workers | None,
    progress: Progress,
) -> None:
    """Compute the blocks that a folder lacks."""
    missing = folder.missing(asked)
    done = asked.size - sum(span.size for span in missing)
    progress(done, asked.size)
    with closing(_computed(work, missing, workers)) as computed:  # ends the workers
        for span, blocks in computed:
            folder.add(span, blocks)
            done += span.size
            progress(done, asked.size)


def _kept_in(path: Path | None) -> str:
    if path is None:
        return "nothing is kept without a folder for the results"
    return f"the finished runs are in {path}, and the same command continues"


def _computed(
    work: _Work, spans: list[Span], workers: Workers | None
) -> Generator[tuple[Span, list[Block]], None, None]:
    """Yield the blocks as they come, in any order."""
    if workers is None:
        yield from ((span, work.do(span)) for span in spans)
        return
    yield from workers(delayed(_do)(work, span) for span in spans)


def _do(work: _Work, span: Span) -> tuple[Span, list[Block]]:
    with one_blas_thread():  # in a process of its own
        return span, work.do(span)


def _checked(choice: EstimatorChoice, scenario: Scenario) -> FilterSettings:
    """Return the settings of an estimator that can be made."""
    if choice.name == "submaps" and "folder" in choice.options:
        raise ValueError("folder holds the submaps of one run: leave it out of many")
    settings = choice.settings(scenario)
    slam = settings.make(scenario.start.pose)
    if not scenario.sensor.identities and isinstance(slam, SupportsTruth):
        raise ValueError(
            f"estimator '{choice.name}' linearises at the true landmarks: it needs "
            "sensor.identities = true"
        )
    return settings


def _span(first_run: int, runs: int, block_size: int) -> Span:
    if first_run % block_size or first_run >= runs:
        raise ValueError(
            f"first_run must be a multiple of block_size = {block_size} below runs = "
            f"{runs}, got {first_run}"
        )
    return Span(first_run, runs)
