"""``slamgym benchmark``: scores of filters by a fixed protocol."""

from dataclasses import dataclass
from pathlib import Path

from rich.table import Table

from ...sim_configs.scenario_files import replace_when_written
from . import options
from .commands import FAILURE, BadInputError, command


@dataclass(frozen=True, kw_only=True)
class BenchmarkOptions(options.Options):
    """The options of ``slamgym benchmark``.

    Attributes
    ----------
    verify
        Repeat two of the worlds of a file, and compare all bits of their results.
    out
        A new file for the scores, the versions and the digests.
    """

    verify: Path | None = options.declared(None, "FILE.json", "score")
    out: Path | None = options.declared(None, "FILE.json", "print them")


@command
@options.takes("estimators verify out as_json")
def benchmark(*, given: BenchmarkOptions) -> int:
    """Score filters by a fixed protocol.

    Run filters in five worlds, 100 times each, with fixed seeds (protocol
    consistency-1). Scores: the mean |ln ratio| of the NEES of pose and map, where 0 is
    best, the efficiency of the position, and the time of a step. Others can verify the
    file on their machine.

    Examples
    --------
    slamgym benchmark
    slamgym benchmark -e mine:MyFilter,invariant --out scores.json
    slamgym benchmark --verify scores.json
    """
    from .. import consistency_protocol as protocol
    from .output_folder import as_json_text

    reporter = given.reporter()
    if given.verify:
        stored = protocol.read_scores(given.verify)
        options.refuse_broken(stored["estimators"])
        with reporter.warnings(), reporter.progress("repeating", unit="worlds") as tick:
            changed = protocol.differences(stored, tick)
        worlds = " and ".join(protocol.VERIFIED)
        text = f"Other bits: {', '.join(changed)}" if changed else "Same bits"
        reporter.show_verbatim(f"{text} in {worlds}: {stored['estimators']}")
        reporter.finish({"same": not changed, "changed": changed})
        return FAILURE if changed else 0
    if given.out and (given.out.suffix != ".json" or given.out.exists()):
        raise BadInputError(
            f"--out must be a new .json file, got {given.out}"
            f"{', which exists' * given.out.exists()}"
        )
    if given.out and not given.out.absolute().parent.is_dir():
        raise BadInputError(f"--out: the folder of {given.out} does not exist")
    options.refuse_broken(given.estimators)
    with reporter.warnings(), reporter.progress("running", unit="worlds") as tick:
        found = protocol.score_filters(given.estimators, progress=tick)
    table = Table(box=None, pad_edge=False)
    for heading in ("filter", "pose", "map", "efficiency", "µs a step"):
        table.add_column(heading, justify="left" if heading == "filter" else "right")
    for label, scores in found["scores"].items():
        values = (*scores.values(), found["microseconds"][label])
        table.add_row(label, *("–" if v is None else f"{v:.3g}" for v in values))
    reporter.show(table)
    if given.out:
        with replace_when_written(given.out) as partial:
            partial.write_text(as_json_text(found), encoding="utf-8")
        reporter.show_verbatim(f"Wrote {given.out}")
    reporter.finish(found)
    return 0
