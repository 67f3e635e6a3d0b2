"""What a command prints: progress to standard error, results to standard output."""

import contextlib
import json
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from typing import Any

from rich import progress as bars
from rich.console import Console, RenderableType
from rich.text import Text

Tick = Callable[[int, int], None]

_BETWEEN = 0.1  # [s] between two updates of a bar


class Reporter:
    """Print results as text, or as one JSON object and nothing else.

    Parameters
    ----------
    as_json : bool
        Whether to print JSON.
    """

    def __init__(self, *, as_json: bool) -> None:
        self._as_json = as_json
        self._results = Console(highlight=False)
        self._notes = Console(stderr=True, highlight=False)

    def show(self, *results: RenderableType) -> None:
        """Print results as text, one below the other."""
        if not self._as_json:
            for result in results:
                self._results.print(result)

    def show_verbatim(self, text: str) -> None:
        """Print text without wrapping or markup, so that its lines can be copied."""
        if not self._as_json:
            self._results.print(Text(text), soft_wrap=True)

    def note(self, text: str) -> None:
        """Print a remark on standard error."""
        self._notes.print(f"note: {text}", markup=False)

    def finish(self, summary: dict[str, Any]) -> None:
        """Print the JSON object."""
        if self._as_json:
            text = json.dumps(summary, allow_nan=False, ensure_ascii=False)
            if not _is_encodable(text):
                text = json.dumps(summary, allow_nan=False)
            sys.stdout.write(text + "\n")

    @contextlib.contextmanager
    def progress(self, doing: str, unit: str = "") -> Iterator[Tick]:
        """Show a progress bar on a terminal during the block.

        Parameters
        ----------
        doing : str
            The activity, such as "filtering".
        unit : str, optional
            What is counted; the bar then shows the rate and the time left too.

        Yields
        ------
        callable
            Updates the bar with (done, total), at any rate of calls. The rate excludes
            what is done at the first call, as when a stopped job continues.
        """
        columns = (
            bars.TextColumn("{task.description:<10}"),
            bars.BarColumn(),
            bars.MofNCompleteColumn(),
            *((_Rate(unit), bars.TimeRemainingColumn(compact=True)) if unit else ()),
        )
        with bars.Progress(
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
        """Print the warnings of the block as plain lines on standard error."""

        def show(message: Warning | str, *_: object, **__: object) -> None:
            self.note(str(message))

        with warnings.catch_warnings():
            warnings.simplefilter("always", UserWarning)
            warnings.showwarning = show
            yield

    @contextlib.contextmanager
    def note_if_compiling(self, what: str) -> Iterator[None]:
        """Print a note to standard error, once, if the block compiles kernels."""
        from ...jit import on_compilation

        is_noted = False

        def note() -> None:
            nonlocal is_noted
            if not is_noted:
                self._notes.print(f"compiling {what}, once after each installation …")
            is_noted = True

        with on_compilation(note):
            yield


def _is_encodable(text: str) -> bool:
    """Return whether standard output can write a text."""
    try:
        text.encode(sys.stdout.encoding or "utf-8")
    except UnicodeEncodeError:
        return False
    return True


class _Rate(bars.ProgressColumn):
    """Column of a progress bar: how many units are done per second."""

    def __init__(self, unit: str) -> None:
        super().__init__()
        self._unit = unit

    def render(self, task: bars.Task) -> Text:
        """Return the rate, empty until it is known."""
        speed = task.speed or task.finished_speed
        return Text(f"{speed:,.0f} {self._unit}/s" if speed else "")
