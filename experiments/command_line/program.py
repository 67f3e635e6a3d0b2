"""The program ``slamgym``, and the decorator by which a command joins it."""

import sys
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


def command(
    summary: str, text: str = "", *examples: str
) -> Callable[[_Function], _Function]:
    """Register a function as the command of its name, its parameters as the options.

    Parameters
    ----------
    summary : str
        One line for the list of commands.
    text : str
        What the command's own help explains; the docstring where empty.
    *examples : str
        Command lines that end the help.
    """

    def register(function: _Function) -> _Function:
        added: _Function = main.command(
            name=function.__name__.replace("_", "-"),
            short_help=summary,
            help=_with_examples(text, examples) if text else None,
        )(function)
        return added

    return register


def _with_examples(text: str, examples: tuple[str, ...]) -> str:
    r"""Compose a help text; click keeps the lines after \b as they are."""
    lines = "\n".join(f"  {example}" for example in examples)
    return f"{text}\n\n\b\nExamples:\n{lines}"


@main.callback(
    invoke_without_command=True,
    help=_with_examples(
        "Landmark worlds to drive a robot in, and EKF-SLAM filters to follow it.",
        (
            "slamgym scenarios                 list the worlds",
            "slamgym run six_landmarks         drive in one, filter, draw",
            "slamgym replay data.txt           filter a log, draw",
            "slamgym COMMAND --help            explain a command",
        ),
    ),
)
def _slamgym(
    context: typer.Context,
    version: Annotated[
        bool, typer.Option("--version", help="Print the version.")
    ] = False,
) -> None:
    if (here := str(Path.cwd())) not in sys.path:
        sys.path.append(here)  # for the user's own estimators, "module:Class"
    if version:
        typer.echo(f"slamgym {__version__}")
    elif context.invoked_subcommand is None:
        typer.echo(context.get_help())
