"""Run several estimators over many runs of a scenario, on the same random numbers.

Run i of a job with seed s is simulated in the world of seed s + i. It depends on
nothing else, such as the number of runs, estimators or workers. `monte_carlo`
simulates, filters and measures runs in blocks; a worker computes one block at a time.
`engage_workers` starts processes, threads, or a cluster.
"""

from __future__ import annotations

import os
import signal
import threading
import time
import tomllib
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import psutil
from joblib import Parallel, delayed, effective_n_jobs, parallel_config
from joblib.parallel import BACKENDS as KNOWN_BACKENDS
from joblib.parallel import get_active_backend

from ...arrays import Array
from ...estimator import registry
from ...estimator.interface import SupportsTruth
from ...evaluation.error_bound import PosteriorBound
from ...sim_configs import Scenario, load_scenario
from ...sim_configs.field_types import unknown_choice
from ..runs.filter_settings import (
    EstimatorChoice,
    FilterSettings,
    estimator_choices,
    integer,
    one_blas_thread,
)
from ..runs.simulated_runs import SimulatedRuns, simulate_runs
from .filtered_runs import bound_runs, filter_runs, noise_of_runs
from .results import (
    RESULTS,
    BlockFolder,
    Job,
    Span,
    dataset_of,
    load_results,
    write_results,
)
from .run_measures import Block, measure_runs, with_known_ids

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
) -> xr.Dataset:
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
        :func:`~slamgym.experiments.merge_blocks`.
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


Call = tuple[Callable[..., Any], tuple[Any, ...], dict[str, Any]]  # joblib's delayed
Workers = Callable[[Iterable[Call]], Iterable[Any]]

BACKENDS = ("loky", "threading", "dask", "ray")
_PATIENCE = 0.5
"""How long a worker lives on without the process that engaged it [s]."""


def engage_workers(jobs: int | None, backend: str | None) -> Workers | None:
    """Return workers that compute calls in any order; None if this process does it all.

    Parameters
    ----------
    jobs : int or None
        Number of workers; -1 for one on each core.
    backend : str or None
        One of `BACKENDS`; None for what joblib is configured to use.

    Raises
    ------
    ValueError
        If an argument does not fit, or Ray is not installed.
    """
    if backend not in (None, *BACKENDS):
        raise ValueError(unknown_choice("backend", backend, BACKENDS))
    if jobs not in (None, -1):
        integer("jobs", jobs or 0, 1)
    if backend == "ray":
        return _ray_workers(None if jobs == -1 else jobs)
    if backend is None and effective_n_jobs(jobs) == 1:
        return None
    return _joblib_workers(jobs, backend)


@contextmanager
def saying_what_is_kept(kept: str) -> Iterator[None]:
    """Report the loss of a worker process, and which results are kept."""
    try:
        yield
    except BrokenProcessPool as error:
        raise OSError(
            f"a worker process was killed, perhaps for lack of memory; {kept}"
        ) from error


def _joblib_workers(jobs: int | None, backend: str | None) -> Workers:
    chosen: dict[str, Any] = {} if backend is None else {"backend": backend}
    if jobs is not None or backend is not None:
        chosen["n_jobs"] = jobs or -1
    with parallel_config(**chosen):
        begin: dict[str, Any] = {}
        if isinstance(get_active_backend()[0], KNOWN_BACKENDS["loky"]):
            begin = {"initializer": _end_with, "initargs": (os.getpid(),)}
        workers: Workers = Parallel(
            return_as="generator_unordered", pre_dispatch="2*n_jobs", **begin
        )
        return workers


def _end_with(engaging: int) -> None:
    """Let this worker end when the process that engaged it is gone, and not before.

    A scheduler may send SIGTERM to all processes of a job.  The one that engaged the
    workers then ends them.
    """
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    threading.Thread(target=_watch, args=(engaging,), daemon=True).start()


def _watch(engaging: int) -> None:
    while os.getppid() == engaging and psutil.pid_exists(engaging):
        time.sleep(_PATIENCE)
    os._exit(1)


def _ray_workers(jobs: int | None) -> Workers:
    """Engage a cluster's workers by Ray's own pool.

    Ray's backend for joblib returns results only when the last one is complete, so that
    no block could be written before.
    """
    try:
        from ray.util.multiprocessing import Pool  # noqa: PLC0415  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise ValueError("backend 'ray' needs ray: pip install ray") from None

    def compute(calls: Iterable[Call]) -> Iterator[Any]:
        handler = signal.getsignal(signal.SIGTERM)
        with Pool(jobs) as pool:
            _handle_sigterm(handler)  # Ray replaces it by one that aborts
            yield from pool.imap_unordered(_call, calls)

    return compute


def _handle_sigterm(handler: Any) -> None:
    if callable(handler) and threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, handler)


def _call(call: Call) -> Any:
    function, arguments, options = call
    return function(*arguments, **options)


ASSUMED_FILE = "assumed.toml"


def python_call(summary: dict[str, Any]) -> str:
    """Write the call of ``monte_carlo`` that made a summary.

    The call reads a scenario that is no preset, or a changed one, from a file, and a
    comment asks to save it first; likewise the scenario whose noise was assumed.

    Parameters
    ----------
    summary : dict
        Result of ``summarise_monte_carlo``.
    """
    preset = _is_preset(summary)
    name = summary["scenario"]
    world = name if preset else f"{name}.toml"
    files = [] if preset else [world]
    arguments = [repr(world), _estimators(summary["estimators"])]
    first = summary["first_run"]
    arguments += [f"runs={first + summary['runs']}", f"seed={summary['seed']}"]
    if summary["assumed_toml"]:
        files.append(ASSUMED_FILE)
        arguments.append(f"assumed={ASSUMED_FILE!r}")
    arguments += [
        f"{option}={summary[option]}"
        for option in ("block_size", "resolution", "first_run")
        if summary[option]
    ]
    note = (
        f"# first save {' and '.join(map(repr, files))}, see below\n" if files else ""
    )
    listed = "".join(f"    {argument},\n" for argument in arguments)
    return (
        "from slamgym.experiments.monte_carlo import monte_carlo\n\n"
        f"{note}monte_carlo(\n{listed})"
    )


def _is_preset(summary: dict[str, Any]) -> bool:
    """Whether the scenario equals the preset of its name."""
    try:
        world = load_scenario(tomllib.loads(summary["scenario_toml"]))
        return bool(world == load_scenario(summary["scenario"]))
    except ValueError:
        return False


def _estimators(entries: dict[str, Any]) -> str:
    """Write names alone where they suffice, else labels with (name, options)."""
    named = {
        label: (entry.get("name", label), entry.get("options") or {})
        for label, entry in entries.items()
    }
    if all(label == name and not options for label, (name, options) in named.items()):
        return repr(list(named))
    return repr(named)
