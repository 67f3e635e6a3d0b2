"""The program ``slamgym``, and the decorator by which a command joins it."""

import inspect
import sys
import textwrap
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, TypeVar

import typer

from ... import __version__
from .errors import OneLineErrors

_Function = TypeVar("_Function", bound=Callable[..., Any])

main = typer.Typer(
    name="slamgym",
    cls=OneLineErrors,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    add_completion=False,
)


def command(function: _Function) -> _Function:
    """Register a function as the command of its name, its parameters as the options.

    The first line of its docstring stands in the list of commands. The rest is the
    command's own help.
    """
    summary, text = _help_of(function)
    added: _Function = main.command(
        name=function.__name__.replace("_", "-"), short_help=summary, help=text
    )(function)
    return added


def _help_of(function: Callable[..., Any]) -> tuple[str, str]:
    r"""Return a docstring's first line, and its rest with the examples indented.

    click keeps the lines after \b as they are.
    """
    summary, _, rest = (inspect.getdoc(function) or "").partition("\n\n")
    text, _, examples = rest.partition("\n\nExamples\n--------\n")
    lines = textwrap.indent(examples, "  ")
    return summary, f"{text}\n\n\b\nExamples:\n{lines}" if examples else text


def _slamgym(
    context: typer.Context,
    version: Annotated[
        bool, typer.Option("--version", help="Print the version.")
    ] = False,
) -> None:
    """Run the program.

    Simulate a robot among landmarks, and estimate its path and the map by EKF-SLAM.

    Examples
    --------
    slamgym scenarios                 list the worlds
    slamgym run six_landmarks         drive in one, filter, draw
    slamgym replay data.txt           filter a log, draw
    slamgym COMMAND --help            explain a command
    """
    if (here := str(Path.cwd())) not in sys.path:
        sys.path.append(here)  # for the user's own estimators, "module:Class"
    if version:
        typer.echo(f"slamgym {__version__}")
    elif context.invoked_subcommand is None:
        typer.echo(context.get_help())


main.callback(invoke_without_command=True, help=_help_of(_slamgym)[1])(_slamgym)
