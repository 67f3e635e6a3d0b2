"""Do jobs in processes of their own, quickly: for their results, or to kill them.

They are forked from a server that has loaded slamgym once; a fresh Python would take
two seconds for each.
"""

import multiprocessing
import signal
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing.process import BaseProcess

KILLED = -signal.SIGKILL

_CONTEXT = multiprocessing.get_context("forkserver")
_CONTEXT.set_forkserver_preload(["forked_preload"])


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
