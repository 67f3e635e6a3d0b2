"""Do jobs in processes of their own, quickly: for their results, or to kill them.

They are forked from a server that has loaded slamgym once; a fresh Python would take
two seconds for each.
"""

import multiprocessing
import os
import signal
import sys
import tempfile
import textwrap
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import forkserver
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import NamedTuple

KILLED = -signal.SIGKILL

#: A `Script` that begins so imports slamgym anew, from its folder.
WITHOUT_SLAMGYM = """
import gymnasium, sys
for known in (sys.modules, gymnasium.registry):
    for name in [name for name in known if name.startswith("slamgym")]:
        del known[name]
"""
#: A `Script` that begins so has neither slamgym nor matplotlib.
WITHOUT_MATPLOTLIB = f"""{WITHOUT_SLAMGYM}
for name in [name for name in sys.modules if name.startswith("matplotlib")]:
    del sys.modules[name]
"""

_CONTEXT = multiprocessing.get_context("forkserver")
_CONTEXT.set_forkserver_preload(["forked_preload"])


def start_server() -> None:
    """Start the server now, with the present environment, if it is not there yet."""
    forkserver.ensure_running()


def start(job: Callable[..., object], *arguments: object) -> BaseProcess:
    """Run a function of an importable module in a process of its own."""
    process = _CONTEXT.Process(target=job, args=arguments)
    process.start()
    return process


def result_of(job: Callable[..., object], *arguments: object) -> object:
    """Return what a function of an importable module returns in another process."""
    with ProcessPoolExecutor(1, mp_context=_CONTEXT) as process:
        return process.submit(job, *arguments).result()


def event():
    """Return an event that a job and its test share."""
    return _CONTEXT.Event()


class Output(NamedTuple):
    """What a process has printed."""

    stdout: str
    stderr: str


class Script:
    """Lines of Python that run in a process of their own, begun at once.

    The process differs from ``python -c`` in one respect: slamgym and the libraries
    that it needs are loaded already. It compiles kernels for the environment that it is
    given, and writes no byte code.

    Parameters
    ----------
    code : str
        The lines, which may be indented.
    folder : Path
        Where it runs and looks for modules.
    environment : dict of str to str
        Variables beyond those of the server.
    """

    def __init__(self, code: str, folder: Path, environment: dict[str, str]) -> None:
        self._files = [tempfile.mkstemp(suffix=suffix) for suffix in (".out", ".err")]
        names = [name for _, name in self._files]
        lines = textwrap.dedent(code)
        self._process = start(_run, lines, str(folder), environment, names)

    def output(self) -> Output:
        """Wait for its end, and return what it has printed."""
        self._process.join()
        texts = []
        for descriptor, name in self._files:
            with open(descriptor) as file:
                texts.append(file.read())
            os.unlink(name)
        assert self._process.exitcode == 0, texts[1]
        return Output(*texts)


def run(code: str, folder: Path | None = None, **environment: str) -> Output:
    """Run lines of Python as a `Script`, by default in the present folder."""
    return Script(code, folder or Path.cwd(), environment).output()


def _run(code: str, folder: str, environment: dict[str, str], files: list[str]) -> None:
    from numba import config

    for descriptor, name in enumerate(files, start=1):
        os.dup2(os.open(name, os.O_WRONLY), descriptor)
    os.chdir(folder)
    os.environ.update(environment)
    config.reload_config()
    tempfile.tempdir = None
    sys.path.insert(0, folder)
    sys.dont_write_bytecode = True
    try:
        exec(code, {"__name__": "__main__"})
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
