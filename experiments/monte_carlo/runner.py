"""Many runs of one scenario through several estimators, on the same random numbers.

Run i of a job with seed s takes place in the world seeded s + i and depends on nothing
else: not on how many runs, estimators or workers there are.  Runs are simulated,
filtered and measured in blocks; a block is what one worker does at a time, what is
written at a time, and what memory holds.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from joblib import Parallel, delayed, effective_n_jobs, parallel_config

from ...estimator.registry import (
    EstimatorFactory,
    find_estimator,
    list_estimators,
    register_estimator,
)
from ...sim_configs import Scenario, load_scenario
from ...sim_configs.scenario_errors import closest
from ..runs.blas_threads import one_blas_thread
from ..runs.filter_settings import FilterSettings
from ..runs.simulated_runs import simulate_runs
from .measure.estimator_choices import EstimatorChoice, estimator_choices
from .measure.filtered_runs import filter_runs
from .measure.run_measures import Block, measure_runs
from .store.job_folder import RESULTS
from .store.result_blocks import BlockFolder, Job, Span
from .store.results import dataset_of, load_results, write_results

if TYPE_CHECKING:
    import xarray as xr

Progress = Callable[[int, int], object]
Call = tuple[Callable[..., Any], tuple[Any, ...], dict[str, Any]]  # joblib's delayed
Workers = Callable[[Iterable[Call]], Iterable[Any]]

BACKENDS = ("loky", "threading", "dask", "ray")
BLOCK_SIZE = 64
_LARGEST = 2**63  # what a file of results can hold


@dataclass(frozen=True)
class _Work:
    """What a worker needs for any block."""

    scenario: Scenario
    settings: tuple[FilterSettings, ...]
    factories: Mapping[str, EstimatorFactory]
    seed: int
    threads: int | None

    def do(self, span: Span) -> list[Block]:
        """Simulate, filter and measure some runs; one entry per estimator."""
        for name, factory in self.factories.items():
            if ":" not in name and name not in list_estimators():
                register_estimator(name, factory)
        runs = simulate_runs(self.scenario, span.size, self.seed + span.first)
        return [
            measure_runs(runs, filter_runs(settings, runs, threads=self.threads))
            for settings in self.settings
        ]


def monte_carlo(
    scenario: Scenario | Mapping[str, object] | str | Path,
    estimators: str | Iterable[str] | Mapping[str, Any],
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
    command: str = "",
    progress: Progress | None = None,
) -> "xr.Dataset":
    """Run estimators many times over a scenario, and measure every run.

    Parameters
    ----------
    scenario : Scenario, mapping, str or Path
        The world; its own controls drive the robot.
    estimators : str, iterable of str, or mapping
        Names with commas between, such as ``"ekf,invariant[iterations=3]"`` or
        ``"mypackage.filters:MyFilter"``; or labels with a class, or with a pair
        (name or class, options), each.
    runs : int
        How many; at least 1, and better more than 20.
    seed : int
        Of run 0; run i is seeded ``seed + i``, so seeds closer than ``runs`` share
        worlds.
    assumed : Scenario, mapping, str or Path, optional
        The scenario whose noise the estimators are told; that of the world where not
        given.
    out : str or Path, optional
        A folder for the results.  Blocks are written there as they come, and a job that
        was stopped goes on after the last whole one.
    jobs : int, optional
        Workers; one process with all its cores where not given.
    backend : {"loky", "threading", "dask", "ray"}, optional
        What provides the workers, see `joblib.parallel_config`, which can also set it
        from outside.
    block_size : int
        Runs in a block.
    first_run : int
        Runs below it are another machine's part; a multiple of ``block_size``.  See
        :func:`~slamgym.experiments.monte_carlo.merge_blocks`.
    fresh : bool
        Whether to remove what an earlier job left in ``out``.
    command : str, optional
        What to note as the way to do it again.
    progress : callable, optional
        Called with (runs done, runs) after every block.

    Returns
    -------
    xarray.Dataset
        The variables of ``run_measures.VARIABLES`` over (estimator, run, step); opened
        from ``out`` where that is given.

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
    world, choices = _with_identities(scenario), estimator_choices(estimators)
    told = world if assumed is None else load_scenario(assumed)
    size = _whole("block_size", block_size, 1)
    asked = _span(_whole("first_run", first_run, 0), _whole("runs", runs, 1), size)
    job = Job(world, told, choices, _whole("seed", seed, 0), size)
    workers = _workers(jobs, backend)
    work = _Work(
        world,
        tuple(_checked(choice, told) for choice in choices),
        {choice.name: find_estimator(choice.name) for choice in choices},
        job.seed,
        threads=None if workers is None else 1,
    )
    path = None if out is None else Path(out)
    with one_blas_thread(), BlockFolder(job, path, fresh=fresh) as folder:
        missing = folder.missing(asked)
        done = asked.size - sum(span.size for span in missing)
        report = progress or (lambda done, runs: None)
        report(done, asked.size)
        for span, blocks in _computed(work, missing, workers):
            folder.add(span, blocks)
            done += span.size
            report(done, asked.size)
        if path is None:
            return dataset_of(job, folder.blocks(asked), asked, command)
        target = path / RESULTS
        write_results(target, job, folder.blocks(asked), asked, command)
        return load_results(target)


def _computed(
    work: _Work, spans: list[Span], workers: Workers | None
) -> Iterator[tuple[Span, list[Block]]]:
    """Yield the blocks as they come, in any order."""
    if workers is None:
        yield from ((span, work.do(span)) for span in spans)
        return
    yield from workers(delayed(_do)(work, span) for span in spans)


def _do(work: _Work, span: Span) -> tuple[Span, list[Block]]:
    with one_blas_thread():  # in a process of its own
        return span, work.do(span)


def _workers(jobs: int | None, backend: str | None) -> Workers | None:
    """Engage workers, or None where this process does it alone."""
    if backend is not None and backend not in BACKENDS:
        hint = closest(backend, BACKENDS)
        raise ValueError(
            f"backend must be one of {', '.join(BACKENDS)}, got '{backend}'{hint}"
        )
    if jobs is not None and jobs != -1:
        _whole("jobs", jobs, 1)
    if backend == "ray":
        return _ray_workers(None if jobs == -1 else jobs)
    if backend is None and effective_n_jobs(jobs) == 1:
        return None
    chosen: dict[str, Any] = {} if backend is None else {"backend": backend}
    if jobs is not None or backend is not None:
        chosen["n_jobs"] = jobs or -1
    with parallel_config(**chosen):
        workers: Workers = Parallel(
            return_as="generator_unordered", pre_dispatch="2*n_jobs"
        )
        return workers


def _ray_workers(jobs: int | None) -> Workers:
    """Engage a cluster's workers by Ray's own pool.

    Ray's backend for joblib hands results out only when the last one is there, so that
    nothing could be written before.
    """
    try:
        from ray.util.multiprocessing import Pool  # noqa: PLC0415 (an extra)
    except ImportError:
        raise ValueError("backend 'ray' needs ray: pip install ray") from None

    def work_off(calls: Iterable[Call]) -> Iterator[Any]:
        with Pool(jobs) as pool:
            yield from pool.imap_unordered(_call, calls)

    return work_off


def _call(call: Call) -> Any:
    function, arguments, options = call
    return function(*arguments, **options)


def _checked(choice: EstimatorChoice, scenario: Scenario) -> FilterSettings:
    """Set up an estimator, and see that it can be made before any run."""
    if choice.name == "submaps" and "folder" in choice.options:
        raise ValueError("folder holds the submaps of one run: leave it out of many")
    settings = choice.settings(scenario)
    settings.make(scenario.start.pose)
    return settings


def _with_identities(source: Scenario | Mapping[str, object] | str | Path) -> Scenario:
    scenario = load_scenario(source)
    if not scenario.sensor.identities:
        raise ValueError(f"scenario '{scenario.name}' must not hide identities")
    return scenario


def _whole(name: str, value: int, least: int) -> int:
    whole = isinstance(value, int | np.integer) and not isinstance(value, bool)
    if not (whole and least <= value < _LARGEST):
        raise ValueError(f"{name} must be an integer >= {least}, got {value!r}")
    return int(value)


def _span(first_run: int, runs: int, block_size: int) -> Span:
    if first_run % block_size or first_run >= runs:
        raise ValueError(
            f"first_run must be a multiple of block_size = {block_size} below runs = "
            f"{runs}, got {first_run}"
        )
    return Span(first_run, runs)
