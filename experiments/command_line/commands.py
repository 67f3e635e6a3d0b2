"""The program ``slamgym``, and the decorator by which a command joins it: `command`.

A command ends with one line on standard error and an exit code, whatever happens. A
`Reporter` prints its progress to standard error, and its results to standard output.
"""

import ast
import contextlib
import gc
import importlib
import inspect
import io
import json
import os
import shutil
import signal
import socket
import sys
import textwrap
import threading
import time
import warnings
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Annotated, Any, NoReturn, TypeVar

import numpy as np
import typer
from rich.console import Console, RenderableType
from rich.text import Text
from typer.core import TyperGroup

from ... import __version__
from ...sim_configs.scenario_files import unfinished
from ...suggestions import FOLDERS
from ..environment_variables import environment
from ..progress_bar import Tick, progress_bar

_Function = TypeVar("_Function", bound=Callable[..., Any])


FAILURE, BAD_INPUT, INTERRUPTED, TERMINATED = 1, 2, 130, 143


class BrokenFilterError(ValueError):
    """A filter of the user's own cannot run; the message lists why, one a line."""


class InterruptedRunError(Exception):
    """Ctrl-C or SIGTERM, its cause; the message may name the work that remains."""


class OneLineErrors(TyperGroup):
    """A group of commands that reports an error in one line, or in a list.

    Bad input ends with exit code 2, a failure with 1, Ctrl-C with 130, SIGTERM with
    143. The traceback is shown when the environment variable ``SLAMGYM_TRACEBACK`` is
    set.
    """

    def main(self, *args: Any, **kwargs: Any) -> Any:
        """Run a command, and exit the program unless in another one."""
        stands_alone = kwargs.pop("standalone_mode", True)
        kwargs["standalone_mode"] = False
        line = threading.Lock()
        if not stands_alone:
            return super().main(*args, **kwargs)
        _open_closed_streams()
        _replace_unknown_characters()
        try:
            with rarely_collecting(), ending_in_time(line), terminable(), _same_look():
                result = super().main(*args, **kwargs)
        except Exception as error:
            if "SLAMGYM_TRACEBACK" in os.environ:
                raise
            line.acquire()  # waits for the end where another thread has taken it
            with contextlib.suppress(OSError):  # of a full disk
                sys.stderr.write(f"slamgym: {message_of(error)}\n")
            sys.exit(exit_code_of(error))
        sys.exit(result if isinstance(result, int) else 0)

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """Look up a command; its help names arguments without their types."""
        command: Any = super().get_command(ctx, cmd_name)
        for parameter in command.params if command else ():
            if parameter.param_type_name == "argument":
                parameter.display_type_rich = lambda ctx: None
        return command

    def make_context(self, *args: Any, **kwargs: Any) -> Any:
        """Read the arguments that precede the command."""
        _remaining.clear()
        with _naming_interrupts():
            return super().make_context(*args, **kwargs)

    def invoke(self, ctx: Any) -> Any:
        """Run the chosen command."""
        with _naming_interrupts():
            return super().invoke(ctx)


@contextlib.contextmanager
def _naming_interrupts() -> Iterator[None]:
    """Raise `InterruptedRunError` for an interrupt, which typer ends silently."""
    try:
        yield
    except LostSchedulerError:  # which no user has interrupted
        raise
    except BaseException as error:
        cause: BaseException | None = error
        while cause and not isinstance(cause, KeyboardInterrupt):
            cause = cause.__context__  # another error in the clean-up hides it
        if cause is None:
            raise
        raise InterruptedRunError(*_remaining[-1:]) from cause


class LostSchedulerError(OSError):
    """The scheduler of a cluster is lost; an interrupt has ended the wait for it."""


class TerminationError(KeyboardInterrupt):
    """A scheduler or ``kill`` sent SIGTERM; it is handled like Ctrl-C."""


_CODES = {signal.SIGINT: INTERRUPTED, signal.SIGTERM: TERMINATED}
_NOTHING_WRITTEN = "interrupted; nothing was written"

_OF_SCENARIOS = {
    "--motion-std": "motion.std=[0.1,0.1,0.05]",
    "--measurement-std": "sensor.std=[0.02,0.1]",
    "--initial-pose-std": "start.std=[0.1,0.1,0.05]",
    "--range-std-per-metre": "sensor.range_std_per_metre=0.05",
    "--noise-at-rest": "motion.noise_at_rest=true",
}

#: How long a command may clean up after a signal before it is ended [s].
_PATIENCE = 1.0
_SHOW_CURSOR = b"\r\x1b[K\x1b[?25h"  # and clear the line of the progress bar


def _end_after_a_signal(reader: socket.socket, line: threading.Lock) -> None:
    """Wait for a signal, give the main thread some time, and end the process."""
    with reader:
        while received := reader.recv(1):
            if received[0] in _CODES:
                break
        else:
            return
    deadline = time.monotonic() + _PATIENCE
    from multiprocessing import active_children

    time.sleep(max(deadline - time.monotonic(), 0))
    message = _remaining[-1] if _remaining else _NOTHING_WRITTEN
    if line.acquire(blocking=False):
        shown = _SHOW_CURSOR if os.isatty(2) else b""
        os.write(2, shown + f"slamgym: {message}\n".encode())
    for process in active_children():  # those of joblib ignore SIGTERM
        if process.pid is not None:
            with contextlib.suppress(OSError):
                os.kill(process.pid, signal.SIGKILL)
    for path in tuple(unfinished):
        with contextlib.suppress(OSError):
            path.unlink() if path.is_file() else shutil.rmtree(path, ignore_errors=True)
    os._exit(_CODES[signal.Signals(received[0])])


def _one_line(text: str) -> str:
    return "; ".join(line.strip() for line in text.splitlines() if line.strip())


#: Messages of the blocks that can be interrupted, the innermost last.
_remaining: list[str] = []


class _ClosedOutput(io.TextIOBase):
    """Standard output that the user has closed, as by ``>&-``."""

    def write(self, text: str) -> int:
        """Refuse the text, since it would be lost."""
        raise OSError("standard output is closed: there is no place for the results")


def _open_closed_streams() -> None:
    """Keep files from the numbers of closed streams; refuse results for nobody."""
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest number that is free
    if sys.stdout is None:
        sys.stdout = _ClosedOutput()
    if sys.stderr is None:
        sys.stderr = io.StringIO()


@contextlib.contextmanager
def _same_look() -> Iterator[None]:
    """Ignore the user's settings of matplotlib during the block.

    Some need LaTeX or make figures unreadable, such as a dark background.
    """
    with environment("MATPLOTLIBRC", os.devnull):
        if Path("matplotlibrc").exists():  # which matplotlib reads first
            importlib.import_module("matplotlib").rcdefaults()
        yield


def _replace_unknown_characters() -> None:
    """Print a question mark for each character that a terminal's encoding lacks."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")


def _terminate(_number: int, _frame: object) -> NoReturn:
    signal.signal(signal.SIGTERM, signal.SIG_IGN)  # a second one spoils no clean-up
    raise TerminationError


def _way_to_set(error: Any) -> str:
    """Return the way to set what a command for scenarios has no option for."""
    taken = getattr(getattr(error, "ctx", None), "command", None)
    options = [name for option in getattr(taken, "params", ()) for name in option.opts]
    option = getattr(error, "option_name", None) or ""
    return way_to_set(option) if "--set" in options else ""


@contextlib.contextmanager
def ending_in_time(line: threading.Lock) -> Iterator[None]:
    """End this process soon after a SIGINT or SIGTERM in the block, whatever it does.

    Python runs signal handlers in its main thread, and only between two steps of Python
    code: a kernel, or a decomposition of a large matrix, may delay them for minutes.
    The system's own handler also writes to a socket, where a thread waits. If the
    process still exists `_PATIENCE` later, the thread ends it, also outside the block.

    Parameters
    ----------
    line : threading.Lock
        Taken for good by the thread that writes the line about the end.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    reader, writer = socket.socketpair()
    writer.setblocking(False)
    former = signal.set_wakeup_fd(writer.fileno(), warn_on_full_buffer=False)
    threading.Thread(
        target=_end_after_a_signal, args=(reader, line), daemon=True
    ).start()
    try:
        yield
    finally:
        signal.set_wakeup_fd(former)
        writer.close()


@contextlib.contextmanager
def rarely_collecting() -> Iterator[None]:
    """Look for cyclic garbage in the block a hundredth as often, and not at the exit.

    The imports of a command create hundreds of thousands of objects that all stay. To
    visit them again and again takes a fifth of the time of a short command. Only the
    first command of a process freezes them, because its garbage stays, too.
    """
    usual = gc.get_threshold()
    gc.set_threshold(100 * usual[0], *usual[1:])
    try:
        yield
    finally:
        if not gc.get_freeze_count():
            gc.freeze()
        gc.set_threshold(*usual)


def exit_code_of(error: Exception) -> int:
    """Return the exit code of an error: bad input, failure or interruption.

    Examples
    --------
    >>> exit_code_of(ValueError("steps must be >= 2, got 1")), exit_code_of(OSError())
    (2, 1)
    """
    if isinstance(error, InterruptedRunError):
        terminated = isinstance(error.__cause__, TerminationError)
        return TERMINATED if terminated else INTERRUPTED
    if isinstance(error, np.linalg.LinAlgError):
        return FAILURE
    is_asked_wrongly = hasattr(error, "format_message")
    return BAD_INPUT if is_asked_wrongly or isinstance(error, ValueError) else FAILURE


def message_of(error: Exception) -> str:
    r"""Return the message of an error as one line, or the list of a broken filter.

    Examples
    --------
    >>> message_of(ValueError("dt must be > 0, got 0\n steps must be >= 2, got 1"))
    'dt must be > 0, got 0; steps must be >= 2, got 1'
    """
    if isinstance(error, BrokenFilterError | InterruptedRunError):
        return str(error) or _NOTHING_WRITTEN
    if hasattr(error, "format_message"):  # of the command line itself
        return _one_line(error.format_message()) + _way_to_set(error)
    if isinstance(error, OSError) and error.filename and error.strerror:
        return f"{error.filename}: {error.strerror}"
    if isinstance(error, MemoryError):
        return _one_line(str(error)) or "there is not enough memory"
    if isinstance(error, ValueError | OSError | ImportError):
        return _one_line(str(error))
    what = f"{type(error).__name__}: {_one_line(str(error))}"
    where = ", ".join(getattr(error, "__notes__", ["internal error"]))
    return f"{where}: {what} (SLAMGYM_TRACEBACK=1 shows where)"


@contextlib.contextmanager
def terminable() -> Iterator[None]:
    """Raise `TerminationError` in the block at the first SIGTERM, unless ignored."""
    usual = signal.getsignal(signal.SIGTERM)
    in_main_thread = threading.current_thread() is threading.main_thread()
    if usual is not signal.SIG_DFL or not in_main_thread:
        yield
        return
    signal.signal(signal.SIGTERM, _terminate)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, usual)


def way_to_set(option: str) -> str:
    """Return how to set a noise of a world that has an option for logs, else nothing.

    Examples
    --------
    >>> way_to_set("--noise-at-rest"), way_to_set("--robot")
    ('; for the world: --set motion.noise_at_rest=true', '')
    """
    change = _OF_SCENARIOS.get(option)
    return f"; for the world: --set {change}" if change else ""


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
    summary, _, rest = docstring_of(function).partition("\n\n")
    text, _, examples = rest.partition("\n\nExamples\n--------\n")
    lines = textwrap.indent(examples, "  ")
    return summary, f"{text}\n\n\b\nExamples:\n{lines}" if examples else text


def docstring_of(item: Any) -> str:
    """Return the docstring of a function or class, also where -OO has removed it."""
    if sys.flags.optimize < 2:
        return inspect.getdoc(item) or ""
    return _docstrings_of(item.__module__).get(item.__name__, "")


@cache
def _docstrings_of(module: str) -> dict[str, str]:
    """Read the docstrings of the functions and classes of a module in its source."""
    try:
        source = inspect.getsource(sys.modules[module])
    except (OSError, TypeError):  # not written in Python
        return {}
    named = (ast.FunctionDef, ast.ClassDef)
    parts = [each for each in ast.parse(source).body if isinstance(each, named)]
    return {part.name: ast.get_docstring(part) or "" for part in parts}


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
    FOLDERS[:] = [str(Path.cwd())]  # for the user's own estimators, "module:Class"
    if version:
        typer.echo(f"slamgym {__version__}")
    elif context.invoked_subcommand is None:
        typer.echo(context.get_help())


main.callback(invoke_without_command=True, help=_help_of(_slamgym)[1])(_slamgym)


class BadInputError(ValueError):
    """The user's input cannot be used; the message gives the reason in one line."""


@contextlib.contextmanager
def interruptible(message: str) -> Iterator[None]:
    """Report Ctrl-C and SIGTERM in the block with a message about what remains."""
    _remaining.append(message)
    yield
    _remaining.remove(message)  # it stays if the block is interrupted


# --------------------------------------------------------------------------------------
# What a command prints.


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
            try:
                text.encode(sys.stdout.encoding or "utf-8")
            except UnicodeEncodeError:
                text = json.dumps(summary, allow_nan=False)
            sys.stdout.write(text + "\n")

    def progress(
        self, doing: str, unit: str = ""
    ) -> contextlib.AbstractContextManager[Tick]:
        """Show a progress bar on a terminal during a block, see `progress_bar`."""
        return progress_bar(doing, unit, self._notes)

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
