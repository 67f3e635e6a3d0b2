"""The progress bar of long work, in a terminal or a notebook, and nowhere else."""

from __future__ import annotations

import contextlib
import sys
import time
from collections.abc import Callable, Iterator
from importlib import import_module
from typing import Any, TextIO

from rich import progress as bars
from rich.console import Console
from rich.text import Text

Tick = Callable[[int, int], None]

_BETWEEN = 0.1  # [s] between two updates


@contextlib.contextmanager
def progress_bar(
    doing: str, unit: str = "", console: Console | None = None
) -> Iterator[Tick]:
    """Show a progress bar during the block: in a notebook, or on a terminal.

    Parameters
    ----------
    doing : str
        The activity, such as "filtering".
    unit : str, optional
        What is counted; the bar on a terminal then shows the rate and the time left.
    console : Console, optional
        Where to show the bar, if it is a terminal. By default this is a notebook, or
        standard error.

    Yields
    ------
    callable
        Updates the bar with (done, total), at any rate of calls. The rate excludes
        what is done at the first call, as when a stopped job continues.
    """
    if console is None and (shown := _notebook()) is not None:
        with _notebook_bar(doing, unit, shown) as tick:
            yield tick
        return
    if console is None:
        # rich trusts variables such as FORCE_COLOR, even for a file.
        console = Console(stderr=True, force_terminal=_is_terminal(sys.stderr))
    columns = (
        bars.TextColumn("{task.description:<10}"),
        bars.BarColumn(),
        bars.MofNCompleteColumn(),
        *((_Rate(unit), bars.TimeRemainingColumn(compact=True)) if unit else ()),
    )
    with bars.Progress(
        *columns,
        console=console,
        transient=True,
        disable=not console.is_terminal,
        redirect_stdout=_is_terminal(sys.stdout),  # what goes to a file stays there
    ) as bar:
        task = bar.add_task(doing, total=None)

        def update(done: int, total: int) -> None:  # the speed excludes the first call
            bar.update(task, completed=done, total=total)

        yield _now_and_then(update)


def _is_terminal(stream: TextIO | None) -> bool:
    return stream is not None and stream.isatty()


def _now_and_then(update: Tick) -> Tick:
    """Return a function that passes on some of its calls, the first and the last."""
    next_look = 0.0

    def tick(done: int, total: int) -> None:
        nonlocal next_look
        now = time.monotonic()
        if now >= next_look or done == total:
            next_look = now + _BETWEEN
            update(done, total)

    return tick


class _Rate(bars.ProgressColumn):
    """Column of a progress bar: how many units are done per second."""

    def __init__(self, unit: str) -> None:
        super().__init__()
        self._unit = unit

    def render(self, task: bars.Task) -> Text:
        """Return the rate, empty until it is known."""
        speed = task.speed or task.finished_speed
        return Text(f"{speed:,.0f} {self._unit}/s" if speed else "")


def _notebook() -> Callable[..., Any] | None:
    """Return IPython's function that shows an object, in a notebook only."""
    ipython = sys.modules.get("IPython")
    shell = ipython and ipython.get_ipython()
    if type(shell).__name__ != "ZMQInteractiveShell":
        return None
    shown: Callable[..., Any] = import_module("IPython.display").display
    return shown


@contextlib.contextmanager
def _notebook_bar(doing: str, unit: str, display: Callable[..., Any]) -> Iterator[Tick]:
    """Show a bar that the browser draws, and remove it after the block."""

    def show(html: str, text: str) -> None:
        given = {"text/html": html, "text/plain": text}
        handle.update(given, raw=True)

    def update(done: int, total: int) -> None:
        text = f"{doing} {done}/{total} {unit}".rstrip()
        show(f'<progress value="{done}" max="{total}"></progress> {text}', text)

    handle = display({"text/plain": ""}, raw=True, display_id=True)
    try:
        yield _now_and_then(update)
    finally:
        show("", "")
