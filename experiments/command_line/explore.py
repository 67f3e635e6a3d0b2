"""``slamgym explore``: a page with sliders for the noise."""

from dataclasses import dataclass
from pathlib import Path

from ...sim_configs.field_types import unknown_choice
from . import options
from .commands import BadInputError, command


@dataclass(frozen=True, kw_only=True)
class ExploreOptions(options.Options):
    """The options of ``slamgym explore``.

    Attributes
    ----------
    runs
        Runs for each of 49 pairs of noises.
    change
        Whose noise changes: that of the filters, of the world, or of both.
    out
        The page. A page that explore wrote is replaced.
    """

    runs: int = options.declared(100, "", min=2)
    change: str = options.declared("filter", "filter|world|both")
    out: Path | None = options.declared(None, "FILE.html", "explore-<scenario>.html")


@command
@options.takes("estimators runs seed steps set_ change out as_json")
def explore(scenario: options.ScenarioName, *, given: ExploreOptions) -> None:
    """Write a page with sliders for the noise.

    Run filters with σ of motion and of measurement multiplied by 0.1 to 10, and write a
    web page with a slider for each. The page shows the NEES, the verdict and the
    ellipses of a typical run. It works offline.

    Examples
    --------
    slamgym explore loop
    slamgym explore six_landmarks -e ekf,invariant,unscented --out lecture.html
    slamgym explore coarse_loop --change both --runs 50
    """
    from ..noise_explorer import CHANGED, explore_noise, write_explorer

    world = given.scenario(scenario)
    options.refuse_broken(given.estimators)
    if given.change not in CHANGED:
        raise BadInputError(unknown_choice("--change", given.change, CHANGED))
    place = given.out or Path(f"explore-{world.name}.html")
    _refuse_other(place)
    reporter = given.reporter()
    with reporter.warnings(), reporter.progress("running", unit="runs") as tick:
        facts = explore_noise(
            world,
            given.estimators,
            given.runs,
            given.seed,
            change=given.change,
            progress=tick,
        )
    write_explorer(place, facts)
    reporter.show_verbatim(f"Wrote {place}")
    head = {key: facts[key] for key in ("world", "runs", "change", "filters")}
    reporter.finish({"out": str(place), **head})


def _refuse_other(path: Path) -> None:
    """Refuse a file that cannot be written, or that explore has not written."""
    if path.suffix != ".html" or not path.parent.is_dir():
        raise BadInputError(f"--out must be an .html file in a folder, got {path}")
    if path.exists() and b" \xe2\x80\x93 slamgym explore</title>" not in (
        path.read_bytes()
    ):
        raise BadInputError(f"--out: {path} exists, and explore has not written it")
