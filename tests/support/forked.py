"""Start jobs in processes of their own, quickly, so that tests can kill them.

They are forked from a server that has loaded slamgym once; a fresh Python would take
two seconds for each.
"""

import multiprocessing
import signal
from collections.abc import Callable
from multiprocessing.process import BaseProcess

KILLED = -signal.SIGKILL

_CONTEXT = multiprocessing.get_context("forkserver")
_CONTEXT.set_forkserver_preload(["forked_preload"])


def start(job: Callable[..., object], *arguments: object) -> BaseProcess:
    """Run a function of an importable module in a process of its own."""
    process = _CONTEXT.Process(target=job, args=arguments)
    process.start()
    return process


def event():
    """Return an event that a job and its test share."""
    return _CONTEXT.Event()
