"""The program ``slamgym`` with all its commands.

Each command is a function in a module of its own, which takes options by name, and
it imports what is heavy when it runs, so that help answers at once.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

from ...leaves import leaf
from .commands import BadInputError, Reporter, command, docstring_of, main
from .options import Options, declared, takes

__all__ = ["main"]
__dir__ = __all__.copy

#: The modules of commands, in the order of the help. Each adds its command to the
#: program.
COMMANDS = (
    *("run", "replay", "smooth", "fit_noise", "monte_carlo", "generate", "judge"),
    *("benchmark", "noise_study", "explore", "render_video"),
)
for _name in COMMANDS:
    leaf(f"experiments.command_line.{_name}")


@dataclass(frozen=True, kw_only=True)
class ScenariosOptions(Options):
    """The options of ``slamgym scenarios``.

    Attributes
    ----------
    new
        Write the scenario to a new file, to change it. Other commands take this file in
        place of a name.
    """

    new: Path | None = declared(None, "FILE.toml", "print it")


@command
@takes("new as_json")
def scenarios(
    name: Annotated[
        str, typer.Argument(metavar="SCENARIO", help="A preset or a .toml file.")
    ] = "",
    *,
    given: ScenariosOptions,
) -> None:
    """List the scenarios, or explain one.

    List the scenarios that come with slamgym. Use their names in other commands. With
    a name, print every field of this scenario with its meaning, unit and default.

    Examples
    --------
    slamgym scenarios
    slamgym scenarios loop
    slamgym scenarios loop --new mine.toml
    """
    from ...sim_configs import list_presets, load_scenario

    if name or given.new:
        from .explained_scenario import explained

        text = explained(given.scenario(name or "loop"))
        if given.new is None:
            given.reporter().show_verbatim(text.rstrip("\n"))
        elif given.new.suffix != ".toml" or given.new.exists():
            raise BadInputError(
                f"--new must be a new .toml file, got {given.new}"
                f"{', which exists' * given.new.exists()}"
            )
        else:
            given.new.write_text(text, encoding="utf-8")
        given.reporter().finish({"scenario": text})
        return
    each = [(name, load_scenario(name)) for name in list_presets()]
    rows = [(name, x.landmarks.count, x.steps, x.description) for name, x in each]
    _show("scenarios", "name landmarks steps description", rows, given.reporter())


@command
@takes("as_json")
def estimators(*, given: Options) -> None:
    """List the filters.

    List the filters of slamgym, and those of other libraries, which you install with
    pip install 'slamgym[peers]'.

    Examples
    --------
    slamgym estimators
    slamgym estimators --json
    """
    from ...estimator.registry import PEERS, find_estimator, list_estimators

    each = [
        (name, "slamgym", True, docstring_of(find_estimator(name)))
        for name in list_estimators()
    ]
    each += [(p.name, p.library, p.installed, p.description) for p in PEERS.values()]
    rows = [(*facts, text.partition("\n")[0]) for *facts, text in each]
    _show("estimators", "name library installed description", rows, given.reporter())


def _show(what: str, keys: str, facts: Sequence[Any], reporter: Reporter) -> None:
    """Print facts as a table with the keys as headings, or as one JSON object."""
    from rich.table import Table

    rows = [dict(zip(keys.split(), each, strict=True)) for each in facts]
    table = Table(box=None, pad_edge=False)
    for key in rows[0]:
        numeric = type(rows[0][key]) is int
        table.add_column(
            key, justify="right" if numeric else "left", no_wrap=key == "name"
        )
    for row in rows:
        table.add_row(*(_cell(value) for value in row.values()))
    reporter.show(table)
    reporter.finish({what: rows})


def _cell(value: object) -> str:
    return {True: "yes", False: "no"}[value] if isinstance(value, bool) else str(value)
