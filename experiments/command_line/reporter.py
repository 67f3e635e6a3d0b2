"""Where a command talks: progress to standard error, results to standard output."""

import contextlib
import json
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterator
from typing import Any

from rich.console import Console, RenderableType
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    Task,
    TextColumn,
    TimeRemainingColumn,
)
from rich.text import Text

Tick = Callable[[int, int], None]

_PATIENCE = 1.0  # [s] of silence before a note is printed
_BETWEEN = 0.1  # [s] between two moves of a bar


class Reporter:
    """Talks to people, or to a program: then all it prints is one JSON object.

    Parameters
    ----------
    as_json : bool
        Whether a program listens.
    """

    def __init__(self, *, as_json: bool) -> None:
        self._as_json = as_json
        self._results = Console(highlight=False)
        self._notes = Console(stderr=True, highlight=False)

    def show(self, *results: RenderableType) -> None:
        """Print results for people, one below the other."""
        if not self._as_json:
            for result in results:
                self._results.print(result)

    def finish(self, summary: dict[str, Any]) -> None:
        """Print the object for programs."""
        if self._as_json:
            text = json.dumps(summary, allow_nan=False, ensure_ascii=False)
            sys.stdout.write(text + "\n")

    @contextlib.contextmanager
    def progress(self, doing: str, unit: str = "") -> Iterator[Tick]:
        """Show a bar on a terminal, moved by the function lent, until all is done.

        Parameters
        ----------
        doing : str
            What goes on, such as "filtering".
        unit : str, optional
            What is counted; the bar then tells the rate and the time left too.

        Yields
        ------
        callable
            To be called with (done, total), as often as one likes. What is done at the
            first call, as when a stopped job goes on, counts for no rate.
        """
        columns = (
            TextColumn("{task.description:<10}"),
            BarColumn(),
            MofNCompleteColumn(),
            *((_Rate(unit), TimeRemainingColumn(compact=True)) if unit else ()),
        )
        with Progress(
            *columns,
            console=self._notes,
            transient=True,
            disable=not self._notes.is_terminal,
        ) as bar:
            task = bar.add_task(doing, total=None)
            next_look: float | None = None

            def tick(done: int, total: int) -> None:
                nonlocal next_look
                now = time.monotonic()
                if next_look is None:
                    bar.reset(task, completed=done, total=total)
                elif now < next_look and done != total:
                    return
                next_look = now + _BETWEEN
                bar.update(task, completed=done, total=total)

            yield tick

    @contextlib.contextmanager
    def warnings(self) -> Iterator[None]:
        """Print warnings that come meanwhile as plain lines on standard error."""

        def show(message: Warning | str, *_: object, **__: object) -> None:
            self._notes.print(f"note: {message}", markup=False)

        with warnings.catch_warnings():
            warnings.simplefilter("always", UserWarning)
            warnings.showwarning = show
            yield

    @contextlib.contextmanager
    def patience(self, note: str) -> Iterator[None]:
        """Print a note to standard error if what happens meanwhile takes long."""
        timer = threading.Timer(_PATIENCE, self._notes.print, [note])
        timer.daemon = True
        timer.start()
        try:
            yield
        finally:
            timer.cancel()


class _Rate(ProgressColumn):
    """How many of something are done in a second."""

    def __init__(self, unit: str) -> None:
        super().__init__()
        self._unit = unit

    def render(self, task: Task) -> Text:
        """Write the rate, once it is known."""
        speed = task.speed or task.finished_speed
        return Text(f"{speed:,.0f} {self._unit}/s" if speed else "")
