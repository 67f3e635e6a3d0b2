"""``slamgym monte-carlo``: many runs, and whether the filters are consistent."""

import contextlib
import logging
import re
import shlex
import signal
import sys
import threading
from _thread import interrupt_main
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from multiprocessing import active_children
from pathlib import Path
from typing import Any

from rich.text import Text

from ...sim_configs import Scenario, load_scenario
from ...sim_configs.field_types import unknown_choice
from ..environment_variables import without_scripts_of_the_user
from . import options
from .commands import (
    FAILURE,
    BadInputError,
    LostSchedulerError,
    Reporter,
    command,
    interruptible,
)

FORMATS = ("pdf", "svg", "png")


@dataclass(frozen=True, kw_only=True)
class MonteCarloOptions(options.Options):
    """The options of ``slamgym monte-carlo``.

    Attributes
    ----------
    runs
        Number of runs. Run i is the world of seed SEED + i, so studies with overlapping
        seed ranges share worlds.
    until
        "decided": run until there is a verdict on every filter, which holds 5 % at
        all looks together; at most RUNS.
    assume
        A change of the scenario that only the filters assume, such as
        motion.std=[0.1,0.1,0.1]. May be repeated.
    block_size
        Number of runs computed and written together.
    first_run
        Omit the runs below N, a multiple of the block size.
    merge
        Add the results of another machine for this job. May be repeated.
    fresh
        Remove earlier results in the folder first.
    figures
        Also write the figures of the report for print, 85 and 170 mm wide, as pdf, svg
        or png.
    out
        The folder to write. An interrupted job there continues, and more runs are added
        to existing ones.
    """

    runs: int = options.declared(200, "")
    until: str | None = options.declared(None, "decided")
    assume: list[str] | None = options.declared(None, "KEY=VALUE")
    block_size: int = options.declared(64, "N")
    first_run: int = options.declared(0, "N")
    merge: list[Path] | None = options.declared(None, "DIR")
    fresh: bool = options.declared(False, "--fresh")
    figures: str | None = options.declared(None, "FORMAT")
    out: Path | None = options.declared(None, "DIR", "results/monte-carlo-<scenario>")


@command
@options.takes(
    "estimators runs until seed steps set_ assume resolution jobs backend scheduler "
    "block_size first_run merge fresh figures out as_json"
)
def monte_carlo(scenario: options.ScenarioName, *, given: MonteCarloOptions) -> int:
    """Many runs: are the filters consistent?

    Run filters many times over a scenario, all on the same random numbers, and
    decide with known error rates whether their covariances agree with their errors.
    Writes results.nc (estimator x run x step, for xarray), summary.json and a report
    to open in a browser, report.html.

    Examples
    --------
    slamgym monte-carlo loop --estimators ekf,invariant --runs 200 --out loop
    slamgym monte-carlo loop --until decided --runs 1000
    slamgym monte-carlo six_landmarks -e mine:MyFilter --runs 100 --jobs 4
    slamgym monte-carlo loop --assume motion.std=[0.1,0.1,0.1]
    slamgym monte-carlo loop --figures pdf
    slamgym monte-carlo hidden_identities -e 'ekf[management={backdate=true}]'
    slamgym monte-carlo loop --runs 5000 --backend dask --scheduler tcp://b:8786
    """  # noqa: D400 (the list of commands shows the question)
    from .. import monte_carlo_study
    from ..job_folders import replace_own
    from ..monte_carlo_study.report import write_figures, write_html_report
    from ..monte_carlo_study.results import REPORT, RESULTS, SUMMARY
    from ..monte_carlo_study.runner import SMALL_NOISE_SHARE
    from .output_folder import as_json_text, default_folder

    world = given.scenario(scenario)
    assumed = options.changes("--assume", given.assume)
    reporter = given.reporter()
    options.refuse_broken(given.estimators)
    if given.figures not in (None, *FORMATS):
        raise BadInputError(unknown_choice("--figures", given.figures, FORMATS))
    place = given.out or default_folder("monte-carlo", world.name)
    told = world.with_changes(**assumed) if assumed else world
    cluster = connected(given.backend, given.scheduler, given.jobs)
    with reporter.note_if_compiling("the filters"):
        _compile(given.estimators, identities=world.sensor.identities)
    if given.merge:
        monte_carlo_study.merge_blocks(given.merge, place)
    with (
        cluster,
        reporter.warnings(),
        reporter.progress("running", unit="runs") as tick,
        interruptible(
            f"interrupted; the finished runs are in {place}, "
            "and the same command continues"
        ),
        monte_carlo_study.monte_carlo(
            world,
            given.estimators,
            given.runs,
            given.seed,
            until=given.until,
            assumed=told,
            out=place,
            jobs=given.jobs,
            backend=given.backend,
            block_size=given.block_size,
            first_run=given.first_run,
            fresh=given.fresh,
            resolution=given.resolution,
            command=shlex.join(["slamgym", *sys.argv[1:]]),
            progress=tick,
            small_noise=True,
        ) as results,
    ):
        summary = monte_carlo_study.summarise_monte_carlo(results)
        summary["files"] = [RESULTS, SUMMARY, REPORT]
        _quote_checks(summary, world)
        if given.figures:
            summary["files"] += write_figures(results, summary, place, given.figures)
        with replace_own(place / REPORT) as partial:
            write_html_report(results, summary, partial)
        with replace_own(place / SUMMARY) as partial:
            partial.write_text(as_json_text(summary), encoding="utf-8")
    share = 100 * results.attrs.get(SMALL_NOISE_SHARE, 0.0)
    more = f"Runs with less noise, which show causes, took {share:.0f} % of the time."
    return show_study(reporter, summary, place, *[more] * bool(share))


_MOST_FINDINGS = 2
_OF_A_MAP = re.compile(r"landmark|\bl\d*[xy]\b")


def _quote_checks(summary: dict[str, Any], world: Scenario) -> None:
    """Add findings of `check_estimator` about own filters that are not consistent.

    The check has a world of its own, with the sensor and the motion of the presets. If
    only the map is wrong, findings about the pose alone are not quoted: the pose then
    disagrees with the reported map, but not with the truth.
    """
    from ...estimator.check_estimator import find_breaches
    from ...estimator.registry import find_estimator
    from ..monte_carlo_study.verdict import KINDS, MAP

    if world.sensor.kind != "bearing_range" or not world.sensor.identities:
        return
    for entry in summary["estimators"].values():
        is_bad = KINDS[entry["verdict"]] == "bad" or entry["failed_runs"]
        if ":" not in entry["name"] or not is_bad:
            continue
        factory = partial(find_estimator(entry["name"]), **(entry["options"] or {}))
        found = find_breaches(factory, ("required", "correct"))
        if (entry["diagnosis"] or {}).get("cause") == MAP:
            found = tuple(each for each in found if _OF_A_MAP.search(each.message))
        entry["check"] = [finding.message for finding in found[:_MOST_FINDINGS]]


_MOST_COLUMNS = 4  # of estimators, in a terminal of 80


def show_study(
    reporter: Reporter, summary: dict[str, Any], place: Path, *more: str
) -> int:
    """Print what a study has found, with further sentences; return the exit code."""
    from ..monte_carlo_study.report import monte_carlo_table
    from ..monte_carlo_study.verdict import diagnosis_lines
    from .tables import written

    sentences = [
        sentence
        for label, entry in summary["estimators"].items()
        for sentence in (entry["sentence"], *diagnosis_lines(label, entry))
    ]
    entries = list(summary["estimators"].items())
    for k in range(0, len(entries), _MOST_COLUMNS):
        shown = {**summary, "estimators": dict(entries[k : k + _MOST_COLUMNS])}
        reporter.show(monte_carlo_table(shown), "")
    reporter.show(*map(Text, [*sentences, *more]), "")
    if summary["notes"]:
        reporter.show(*map(Text, summary["notes"]), "")
    reporter.show(written(str(place), summary["files"]))
    reporter.finish({**summary, "out": str(place)})
    went_well = any(entry["good_runs"] for entry in summary["estimators"].values())
    return 0 if went_well else FAILURE


def _compile(estimators: str, *, identities: bool) -> None:
    """Run all estimators for some steps, which compiles their kernels."""
    from ..monte_carlo_study import monte_carlo

    small = load_scenario("six_landmarks").with_changes(
        steps=8, sensor={"identities": identities}
    )
    with contextlib.suppress(Exception):  # the job itself fails too, and reports it
        monte_carlo(small, estimators, 1, progress=False)


# --------------------------------------------------------------------------------------
# The cluster that can compute the runs of a command.

#: What starts here listens to this machine only.
_HERE = {
    "host": "127.0.0.1",
    "dashboard_address": "127.0.0.1:0",
    "threads_per_worker": 1,
}
_INTERVAL = 1.0  # between looks at the workers of a local cluster [s]


def connected(backend: str | None, scheduler: str | None, jobs: int | None) -> Any:
    """Connect to a cluster, or start one on this machine, for the block.

    Parameters
    ----------
    backend : str or None
        "dask"; no other needs a cluster.
    scheduler : str or None
        Address of the cluster; None starts one on this machine.
    jobs : int or None
        Workers of a cluster that is started.

    Raises
    ------
    BadInputError
        If the backend is not installed, or has no scheduler.
    """
    if backend == "dask":
        return _dask_client(scheduler, jobs)
    if scheduler is not None:
        raise BadInputError("--scheduler requires --backend dask")
    return contextlib.nullcontext()


def _dask_client(scheduler: str | None, jobs: int | None) -> Any:
    try:
        import distributed
    except ImportError:
        raise BadInputError(
            "--backend dask needs dask.distributed: pip install 'slamgym[dask]'"
        ) from None
    client: Any = distributed.Client
    if scheduler is not None:
        return _naming_loss(client(scheduler), scheduler)
    return _with_new_workers(partial(client, n_workers=jobs, **_HERE))


@contextlib.contextmanager
def _naming_loss(client: Any, address: str) -> Iterator[None]:
    """End the block, and name the scheduler, where the client has lost it.

    Without it, joblib would wait for results forever, or raise one error or another.

    Raises
    ------
    LostSchedulerError
        If the block ends with an error, and the client has no connection.
    """

    def end_if_lost() -> None:
        if client.status == "closed":  # it has tried for 30 s
            is_deaf = signal.getsignal(signal.SIGINT) is signal.SIG_IGN
            interrupt_main(signal.SIGTERM if is_deaf else signal.SIGINT)

    with client:
        try:
            with _repeated(end_if_lost):
                yield
        except BaseException as error:
            if client.status == "running":
                raise
            raise LostSchedulerError(
                f"the Dask scheduler {address} is lost; what is finished is kept, and "
                "the same command continues"
            ) from error


@contextlib.contextmanager
def _with_new_workers(start: Callable[[], Any]) -> Iterator[None]:
    """Start a local cluster, and replace workers that are gone.

    Dask restarts a worker that was killed, but not one that was killed as it started.
    """

    def replace() -> None:
        if len(cluster.workers) < wanted:
            cluster.scale(wanted)

    with contextlib.ExitStack() as ended, without_scripts_of_the_user():
        client = ended.enter_context(start())
        cluster = client.cluster
        wanted = len(cluster.worker_spec)
        try:
            with _repeated(replace):
                yield
        except BaseException:
            with _silent():  # until the cluster has ended
                _kill_workers(cluster)
                ended.close()
            raise


@contextlib.contextmanager
def _silent() -> Iterator[None]:
    """Print no messages of Dask during the block."""
    loggers = [
        logging.getLogger(name) for name in ("distributed", "distributed.client")
    ]
    levels = [logger.level for logger in loggers]
    try:
        for logger in loggers:
            logger.setLevel(logging.CRITICAL)
        yield
    finally:
        for logger, level in zip(loggers, levels, strict=True):
            logger.setLevel(level)


def _kill_workers(cluster: Any) -> None:
    """End the workers of a local cluster before they print that they lost it."""
    nannies = tuple(cluster.workers.values())
    for nanny in nannies:
        nanny.close_gracefully()  # that is, it starts no other worker
    workers = {nanny.pid for nanny in nannies}
    for process in active_children():
        with contextlib.suppress(ValueError):  # Dask has just closed it
            if process.pid in workers:
                process.kill()


@contextlib.contextmanager
def _repeated(check: Callable[[], None]) -> Iterator[None]:
    """Call a function again and again during the block, in another thread."""
    over = threading.Event()

    def watch() -> None:
        while not over.wait(_INTERVAL):
            check()

    thread = threading.Thread(target=watch, daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()
