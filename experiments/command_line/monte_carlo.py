"""``slamgym monte-carlo``: many runs, and whether the filters told the truth."""

import contextlib
import shlex
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from rich.text import Text

from ...sim_configs import Scenario, load_scenario
from ...sim_configs.atomic_file import replace_when_written
from ..monte_carlo import merge_blocks, monte_carlo
from ..monte_carlo.measure.estimator_choices import estimator_choices
from ..monte_carlo.report.html_report import write_html_report
from ..monte_carlo.report.summary import summarise_monte_carlo
from ..monte_carlo.report.table import monte_carlo_table
from .errors import FAILURE, BadInputError, InterruptedRunError
from .output_folder import default_folder
from .reporter import Reporter
from .run_files import as_json_text
from .tables import written

REPORT, SUMMARY = "report.html", "summary.json"

_NOTE = "getting the filters ready …"


class Workers(NamedTuple):
    """Who does the work."""

    jobs: int | None = None
    backend: str | None = None
    scheduler: str | None = None
    """Address of a Dask cluster, or of a Ray cluster."""


class Blocks(NamedTuple):
    """Which part of the work, and what becomes of earlier results."""

    size: int
    """Runs in a block."""
    first_run: int = 0
    """Those below are another machine's."""
    merged: Sequence[Path] = ()
    """Folders of other machines, to take over."""
    fresh: bool = False
    """Whether to remove earlier results."""


def run_monte_carlo(
    scenario: Scenario,
    estimators: str,
    *,
    runs: int,
    seed: int,
    assumed: Mapping[str, Any],
    workers: Workers,
    blocks: Blocks,
    out: Path | None,
    as_json: bool,
) -> int:
    """Run, measure, decide, and write results.nc, summary.json and report.html.

    Parameters
    ----------
    scenario : Scenario
        The world.
    estimators : str
        Which, as in `estimator_choices`.
    runs, seed : int
        As in `monte_carlo`.
    assumed : mapping
        Changes of the scenario whose noise the filters are told.
    workers : Workers
        Who does the work.
    blocks : Blocks
        Which part of it.
    out : Path or None
        The folder to write; None chooses one below results.
    as_json : bool
        Whether to print the summary for programs.

    Returns
    -------
    int
        Exit code: 1 if no run of any estimator went well.
    """
    reporter = Reporter(as_json=as_json)
    estimator_choices(estimators)  # a wrong name is told before any work
    place = out or default_folder("monte-carlo", scenario.name)
    told = scenario.with_changes(**assumed) if assumed else scenario
    with reporter.patience(_NOTE):
        _compile(estimators)
    if blocks.merged:
        merge_blocks(blocks.merged, place)
    with (
        _cluster(workers),
        reporter.warnings(),
        reporter.progress("running", unit="runs") as tick,
        _resumable(place),
        monte_carlo(
            scenario,
            estimators,
            runs,
            seed,
            assumed=told,
            out=place,
            jobs=workers.jobs,
            backend=workers.backend,
            block_size=blocks.size,
            first_run=blocks.first_run,
            fresh=blocks.fresh,
            command=shlex.join(["slamgym", *sys.argv[1:]]),
            progress=tick,
        ) as results,
    ):
        summary = summarise_monte_carlo(results)
        summary["files"] = ["results.nc", SUMMARY, REPORT]
        write_html_report(results, summary, place / REPORT)
    with replace_when_written(place / SUMMARY) as partial:
        partial.write_text(as_json_text(summary), encoding="utf-8")
    sentences = [entry["sentence"] for entry in summary["estimators"].values()]
    reporter.show(monte_carlo_table(summary), "")
    reporter.show(*(Text(sentence) for sentence in sentences), "")
    if summary["notes"]:
        reporter.show(*(Text(note) for note in summary["notes"]), "")
    reporter.show(written(str(place), summary["files"]))
    reporter.finish({**summary, "out": str(place)})
    went_well = any(entry["good_runs"] for entry in summary["estimators"].values())
    return 0 if went_well else FAILURE


def _compile(estimators: str) -> None:
    """Run all estimators for two steps, so that their kernels are there."""
    small = load_scenario("six_landmarks").with_changes(steps=2)
    with contextlib.suppress(Exception):  # what fails here fails there, and says so
        monte_carlo(small, estimators, 1)


@contextlib.contextmanager
def _cluster(workers: Workers) -> Iterator[None]:
    """Join the cluster that the work is for, or start one on this machine."""
    if workers.backend == "dask":
        with _dask_client(workers):
            yield
        return
    if workers.scheduler is not None and workers.backend != "ray":
        raise BadInputError("--scheduler is for --backend dask or ray")
    if workers.scheduler is not None:
        try:
            import ray  # noqa: PLC0415 (an extra)
        except ImportError:
            raise BadInputError("--backend ray needs ray: pip install ray") from None
        ray.init(address=workers.scheduler)
    yield


def _dask_client(workers: Workers) -> contextlib.AbstractContextManager[Any]:
    try:
        import distributed  # noqa: PLC0415 (an extra)
    except ImportError:
        raise BadInputError(
            "--backend dask needs dask.distributed: pip install 'slamgym[dask]'"
        ) from None
    client: Any = distributed.Client
    if workers.scheduler is not None:
        joined: contextlib.AbstractContextManager[Any] = client(workers.scheduler)
        return joined
    started: contextlib.AbstractContextManager[Any] = client(
        n_workers=workers.jobs, threads_per_worker=1, dashboard_address=None
    )
    return started


@contextlib.contextmanager
def _resumable(place: Path) -> Iterator[None]:
    """Say after Ctrl-C where the runs done so far lie."""
    try:
        yield
    except KeyboardInterrupt:
        raise InterruptedRunError(
            f"interrupted; the runs done lie in {place}, and the same command goes on"
        ) from None
