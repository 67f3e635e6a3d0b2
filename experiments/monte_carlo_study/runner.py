"""Run several estimators over many runs of a scenario, on the same random numbers.

Run i of a job with seed s is simulated in the world of seed s + i. It depends on
nothing else, such as the number of runs, estimators or workers. `monte_carlo`
simulates, filters and measures runs in blocks; a worker computes one block at a time.
`engage_workers` starts processes, threads, or a cluster.
"""

from __future__ import annotations

import json
import tomllib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ...argument_checks import one_of, usable_cores
from ...arrays import Array
from ...envs.spaces import count_rows
from ...estimator import registry
from ...evaluation.diagnosis import SMALLEST_NOISE
from ...sim_configs import Scenario, load_scenario
from ..job_folders import (
    Progress,
    blocks_at_once,
    blocks_of,
    engage_workers,
    resume,
    staging_folder,
)
from ..run_and_replay.filter_settings import (
    EstimatorChoice,
    FilterSettings,
    estimator_choices,
    integer,
    one_blas_thread,
)
from ..run_and_replay.simulated_runs import simulate_runs
from .filtered_runs import bound_runs, filter_runs, noise_of_runs
from .looks import DECIDED, Look, Watch, earlier_looks, error_rate_after, verdict_of
from .results import (
    RESULTS,
    BlockFolder,
    Blocks,
    MonteCarloJob,
    add_to_results,
    dataset_of,
    load_results,
    opened,
    write_results,
)
from .run_measures import (
    LARGER,
    ORACLE,
    SMALL_NOISE,
    Block,
    explain_first_gap,
    joined,
    measure_runs,
    oracle_of_runs,
    with_known_ids,
)
from .verdict import averages_of, runs_to_repeat, scores_of

if TYPE_CHECKING:
    import xarray as xr


BLOCK_SIZE = 64
#: Factors of all noise: each is used if those before do not decide, the last with more
#: runs.
LESS_NOISE = 0.1, SMALLEST_NOISE, SMALLEST_NOISE
#: Attribute of results, but of no file: share of the time for runs with less noise.
SMALL_NOISE_SHARE = "small_noise_share"
EACH_RUN = "estimator", "run"
_MOST_BYTES, _BYTES_OF_READING = 2**28, 17


def monte_carlo(
    scenario: Scenario | Mapping[str, object] | str | Path,
    estimators: str
    | Iterable[str | registry.EstimatorFactory]
    | Mapping[str, Any] = "ekf,invariant",
    runs: int = 200,
    seed: int = 0,
    *,
    until: str | None = None,
    assumed: Scenario | Mapping[str, object] | str | Path | None = None,
    out: str | Path | None = None,
    jobs: int | None = None,
    backend: str | None = None,
    block_size: int = BLOCK_SIZE,
    first_run: int = 0,
    fresh: bool = False,
    resolution: float = 0.0,
    command: str = "",
    progress: Progress | bool | None = True,
    small_noise: bool = False,
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
    runs : int, default 200
        Number of runs, at least 1; more than 20 are recommended.
    seed : int
        Seed of run 0; run i has ``seed + i``, so seeds closer than ``runs`` share
        worlds.
    until : "decided", optional
        Run until there is a verdict on every estimator, at most `runs`. Results end
        with the block that decides, whatever the number of workers, and equal those of
        a study with that number of runs. Tests that hold 5 % at all looks together
        decide; see ``slamgym.evaluation.sequential_tests``.
    assumed : Scenario, mapping, str or Path, optional
        The scenario whose noise the estimators assume; the world's by default.
    out : str or Path, optional
        A folder for the results. Blocks are written there as they come, and a stopped
        job continues after the last complete one. A file that was changed since is set
        aside with a warning.
    jobs : int, optional
        Number of workers; by default one process with all its cores.
    backend : {"loky", "threading", "dask"}, optional
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
    progress : bool or callable, default True
        Whether to show a progress bar, if this is a notebook or a terminal; or a
        function, called with (runs done, runs) after every block.
    small_noise : bool
        Whether to repeat some runs of a filter that is not consistent with less noise,
        which shows the cause; see :func:`~slamgym.evaluation.diagnose`. The command
        does so. The results then have the variables `SMALL_NOISE` too.

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
    if assumed_world.sensor.identities != world.sensor.identities:
        raise ValueError(
            "assumed must agree with scenario in sensor.identities: only its noise "
            "may differ"
        )
    size = integer("block_size", block_size, 1)
    asked = range(integer("first_run", first_run, 0), integer("runs", runs, 1))
    if first_run % size or first_run >= runs:
        raise ValueError(
            f"first_run must be a multiple of block_size = {size} below runs = {runs}, "
            f"got {first_run}"
        )
    seed = integer("seed", seed, 0)
    if not 0 <= resolution < float("inf"):
        raise ValueError(f"resolution must be a number >= 0, got {resolution!r}")
    if until is not None:
        one_of("until", until, (DECIDED,))
    job = MonteCarloJob(world, assumed_world, choices, seed, size, float(resolution))
    workers = engage_workers(jobs, backend)
    work = _Work(
        job,
        tuple(_checked(choice, assumed_world) for choice in choices),
        {choice.name: registry.find_estimator(choice.name) for choice in choices},
        threads=None if workers is None else 1,
    )
    factors = LESS_NOISE if small_noise else ()
    repeat = partial(_repeated, job, factors, jobs=jobs, backend=backend)
    with one_blas_thread(), _shown(progress) as told:
        study = _Study(
            job,
            blocks_of(asked, size),
            partial(resume, work, workers=workers),
            until,
            wave=blocks_at_once(jobs, backend),
            progress=told,
        )
        if out is None:
            return study.in_memory(command, repeat)
        with opened(Path(out), job.identity(), fresh=fresh) as folder:
            return study.in_folder(folder, command, repeat)


@contextmanager
def _shown(progress: Progress | bool | None) -> Iterator[Progress | None]:
    """Yield the caller's function of progress, that of a new bar, or None."""
    if progress is not True:
        yield progress or None
        return
    from ..progress_bar import progress_bar  # noqa: PLC0415 (loads rich)

    with progress_bar("running", "runs") as tick:
        yield tick


class _Study(NamedTuple):
    """A job with its runs, computed at once or until it is decided."""

    job: MonteCarloJob
    blocks: list[range]
    #: `resume` of the work.
    compute: Callable[..., None]
    until: str | None
    #: How many blocks to compute between looks.
    wave: int
    progress: Progress | None

    def in_memory(self, command: str, repeat: Callable[..., Any]) -> xr.Dataset:
        """Compute the results, and repeat some runs with less noise."""
        begun = perf_counter()
        found: dict[range, list[Block]] = {}
        kept = "nothing is kept without a folder for the results"
        compute = partial(self.compute, keep=found.__setitem__, kept=kept)

        def stored(span: Sequence[range]) -> Blocks:
            return ((block, found[block]) for block in span)

        blocks = self._computed(compute, stored, Watch)
        runs, more = _runs_of(blocks), _attributes(self.until, [])
        parts = ((block, found.pop(block)) for block in blocks)
        whole = dataset_of(self.job, parts, runs, command, more)
        added, told = repeat(runs, perf_counter() - begun, whole)
        variables = {name: (EACH_RUN, values) for name, values in added.items()}
        return whole.assign(variables).assign_attrs(told)

    def in_folder(
        self, folder: BlockFolder, command: str, repeat: Callable[..., Any]
    ) -> xr.Dataset:
        """Do the same in a folder, from the blocks that it has."""
        begun, out, job = perf_counter(), folder.path, self.job
        kept = f"the finished runs are in {out}, and the same command continues"
        looks, first = [Look(*each) for each in folder.looks()], self.blocks[0].start

        def compute(span: list[range], **told: Any) -> None:
            missing = folder.missing(span, job.variables)
            self.compute(missing, folder.add, kept=kept, **told)

        def stored(span: Sequence[range]) -> Blocks:
            return folder.read(span, job)

        rate = error_rate_after([look for look in looks if look.first == first])
        blocks = self._computed(compute, stored, partial(Watch, rate))
        runs = _runs_of(blocks)
        look = Look(first, runs.stop, self.until or "")
        results, more = (
            out / RESULTS,
            _attributes(self.until, earlier_looks(looks, look)),
        )
        write_results(results, job, stored(blocks), runs, command, more)
        took = perf_counter() - begun
        with load_results(results) as whole, staging_folder(out) as aside:
            added, told = repeat(runs, took, whole, out=aside / "less_noise")
        if added:
            add_to_results(results, added)
        folder.keep_look(look)
        return load_results(results).assign_attrs(told)

    def _computed(
        self,
        compute: Callable[..., None],
        stored: Callable[[Sequence[range]], Blocks],
        new_watch: Callable[[], Watch],
    ) -> list[range]:
        """Compute all blocks, or until every estimator is decided.

        Returns
        -------
        list of range
            The blocks up to the one that decides, which does not depend on how many
            are computed at a time.
        """
        blocks, runs = self.blocks, len(_runs_of(self.blocks))
        if self.until is None:
            compute(blocks, runs=runs, progress=self.progress)
            return blocks
        watches = [new_watch() for _ in self.job.estimators]

        def advance(done: int, _: int) -> None:
            if self.progress is not None:
                self.progress(done, runs)

        for k in range(0, len(blocks), self.wave):
            span = blocks[k : k + self.wave]
            until_here = _runs_of(blocks[: k + self.wave])
            compute(span, runs=len(until_here), progress=advance)
            for number, (_, parts) in enumerate(stored(span), start=k + 1):
                for watch, part in zip(watches, parts, strict=True):
                    watch.add_block(part)
                if all(watch.decided for watch in watches):
                    return blocks[:number]
        return blocks


def _attributes(until: str | None, earlier: Sequence[Look]) -> dict[str, str]:
    """Return what results state about the looks at them."""
    found = {"until": until} if until else {}
    return found | ({"looks": json.dumps(earlier)} if earlier else {})


def _runs_of(blocks: Sequence[range]) -> range:
    return range(blocks[0].start, blocks[-1].stop)


def _repeated(
    job: MonteCarloJob,
    factors: Sequence[float],
    asked: range,
    seconds: float,
    results: xr.Dataset,
    *,
    out: Path | None = None,
    **engine: Any,
) -> tuple[dict[str, Array], dict[str, float]]:
    """Repeat runs with less noise, to find why a filter is not consistent.

    Returns
    -------
    dict
        `SMALL_NOISE`, shape (estimators, runs); empty if nothing is repeated. If
        ``out`` is given, this folder stores the repeated runs meanwhile.
    dict
        `SMALL_NOISE_SHARE`, the share of the time that this took; ``seconds`` is the
        time of the other runs.
    """
    begun = perf_counter()
    shape = len(job.estimators), len(asked)
    found: dict[str, Array] = {name: np.full(shape, np.nan) for name in SMALL_NOISE}
    for row, choice in enumerate(job.estimators if factors else ()):
        scores = scores_of(results, choice.label, "invariant")
        verdict = verdict_of(scores, "invariant")
        for factor in factors:
            so_far = {name: ("run", values[row]) for name, values in found.items()}
            known = scores._replace(results=scores.results.assign(so_far))
            count = runs_to_repeat(known, verdict)
            if not count:
                break
            with monte_carlo(
                with_less_noise(job.scenario, factor),
                {choice.label: (choice.name, choice.options)},
                asked.start + count,
                job.seed,
                assumed=with_less_noise(job.assumed, factor),
                out=out,
                block_size=job.block_size,
                first_run=asked.start,
                fresh=True,
                progress=False,
                **engine,
            ) as small:
                averages = averages_of(scores_of(small, choice.label, "invariant"))
            averages["small_noise_factor"] = np.full(count, factor)
            is_smaller = np.nanmin(found["small_noise_factor"][row], initial=1) > factor
            for name, values in averages.items():
                if is_smaller:
                    found[f"{LARGER}{name}"][row] = found[name][row]
                found[name][row, :count] = values
    if np.isnan(found["small_noise_factor"]).all():
        return {}, {}
    took = perf_counter() - begun
    return found, {SMALL_NOISE_SHARE: took / (seconds + took)}


def with_less_noise(scenario: Scenario, factor: float) -> Scenario:
    """Multiply all noises, and the deviations of the first pose, by a factor.

    Examples
    --------
    >>> with_less_noise(load_scenario("six_landmarks"), 0.5).motion.std
    (0.125, 0.05, 0.05)
    """
    changes: dict[str, Any] = {
        name: {"std": factor * sensor.std}
        for name in ("gps", "compass")
        if (sensor := getattr(scenario, name)) is not None
    }
    changes["start"] = {"std": [factor * std for std in scenario.start.std]}
    return with_noise_times(scenario, factor, factor).with_changes(**changes)


def with_noise_times(scenario: Scenario, motion: float, sensor: float) -> Scenario:
    """Multiply the noise of the motion, and that of the measurements."""
    given = scenario.sensor
    return scenario.with_changes(
        motion={"std": [motion * std for std in scenario.motion.std]},
        sensor={
            "std": [sensor * std for std in given.std],
            "range_std_per_metre": sensor * given.range_std_per_metre,
        },
    )


@dataclass(frozen=True)
class _Work:
    """All that a worker needs to compute a block."""

    job: MonteCarloJob
    settings: tuple[FilterSettings, ...]
    factories: Mapping[str, registry.EstimatorFactory]
    threads: int | None

    def __call__(self, block: range, _: object) -> list[Block]:
        """Simulate, filter and measure runs; return one block per estimator."""
        for name, factory in self.factories.items():
            if ":" not in name and not registry.is_registered(name):
                registry.register_estimator(name, factory)
        size = runs_at_once(self.job.scenario)
        starts = range(block.start, block.stop, size)
        spans = [range(k, min(k + size, block.stop)) for k in starts]
        return [joined(each) for each in zip(*map(self._measured, spans), strict=True)]

    def _measured(self, span: range) -> list[Block]:
        world, first = self.job.scenario, self.job.seed + span.start
        runs = simulate_runs(world, len(span), first, only_read=True)
        bound = bound_runs(world, runs, threads=self.threads)
        noise = noise_of_runs(world, self.job.assumed, runs)
        oracle = oracle_of_runs(world, runs, self.job.resolution)
        parts = []
        for settings in self.settings:
            filtered = filter_runs(settings, runs, threads=self.threads)
            part = measure_runs(
                runs, filtered, bound, noise, resolution=self.job.resolution
            )
            explain_first_gap(part, settings, runs)
            if runs.true_ids is not None:
                part |= with_known_ids(settings, runs, self.threads)
                part[ORACLE] = oracle
            parts.append(part)
        return parts


def runs_at_once(scenario: Scenario) -> int:
    """Return how many runs to hold in memory: few where they have many readings.

    Examples
    --------
    >>> runs_at_once(load_scenario("six_landmarks")) > BLOCK_SIZE
    True
    """
    readings = (scenario.steps + 1) * count_rows(scenario)
    return max(usable_cores(), _MOST_BYTES // (readings * _BYTES_OF_READING))


def _checked(choice: EstimatorChoice, scenario: Scenario) -> FilterSettings:
    """Return the settings of an estimator that can be made."""
    if choice.name == "submaps" and "folder" in choice.options:
        raise ValueError("folder holds the submaps of one run: leave it out of many")
    settings = choice.settings(scenario)
    slam = settings.make(scenario.start.pose)
    if not scenario.sensor.identities and hasattr(slam, "observe_truth"):
        raise ValueError(
            f"estimator '{choice.name}' linearises at the true landmarks: it needs "
            "sensor.identities = true"
        )
    return settings


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
    if until := summary.get("until"):
        arguments.append(f"until={until!r}")
    note = (
        f"# first save {' and '.join(map(repr, files))}, see below\n" if files else ""
    )
    listed = "".join(f"    {argument},\n" for argument in arguments)
    return f"from slamgym import monte_carlo\n\n{note}monte_carlo(\n{listed})"


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
