"""Engage the workers of a long job: processes, threads, or a cluster."""

import os
import signal
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from typing import Any

import psutil
from joblib import Parallel, effective_n_jobs, parallel_config
from joblib.parallel import BACKENDS as KNOWN_BACKENDS
from joblib.parallel import get_active_backend

from ...sim_configs.field_types import unknown_choice
from ..runs.integers import integer

Call = tuple[Callable[..., Any], tuple[Any, ...], dict[str, Any]]  # joblib's delayed
Workers = Callable[[Iterable[Call]], Iterable[Any]]

BACKENDS = ("loky", "threading", "dask", "ray")
_PATIENCE = 0.5
"""How long a worker lives on without the process that engaged it [s]."""


def engage_workers(jobs: int | None, backend: str | None) -> Workers | None:
    """Return workers that compute calls in any order; None if this process does it all.

    Parameters
    ----------
    jobs : int or None
        Number of workers; -1 for one on each core.
    backend : str or None
        One of `BACKENDS`; None for what joblib is configured to use.

    Raises
    ------
    ValueError
        If an argument does not fit, or Ray is not installed.
    """
    if backend not in (None, *BACKENDS):
        raise ValueError(unknown_choice("backend", backend, BACKENDS))
    if jobs not in (None, -1):
        integer("jobs", jobs or 0, 1)
    if backend == "ray":
        return _ray_workers(None if jobs == -1 else jobs)
    if backend is None and effective_n_jobs(jobs) == 1:
        return None
    return _joblib_workers(jobs, backend)


@contextmanager
def saying_what_is_kept(kept: str) -> Iterator[None]:
    """Report the loss of a worker process, and which results are kept."""
    try:
        yield
    except BrokenProcessPool as error:
        raise OSError(
            f"a worker process was killed, perhaps for lack of memory; {kept}"
        ) from error


def _joblib_workers(jobs: int | None, backend: str | None) -> Workers:
    chosen: dict[str, Any] = {} if backend is None else {"backend": backend}
    if jobs is not None or backend is not None:
        chosen["n_jobs"] = jobs or -1
    with parallel_config(**chosen):
        begin: dict[str, Any] = {}
        if isinstance(get_active_backend()[0], KNOWN_BACKENDS["loky"]):
            begin = {"initializer": _end_with, "initargs": (os.getpid(),)}
        workers: Workers = Parallel(
            return_as="generator_unordered", pre_dispatch="2*n_jobs", **begin
        )
        return workers


def _end_with(engaging: int) -> None:
    """Let this worker end when the process that engaged it is gone, and not before.

    A scheduler may send SIGTERM to all processes of a job.  The one that engaged the
    workers then ends them.
    """
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    threading.Thread(target=_watch, args=(engaging,), daemon=True).start()


def _watch(engaging: int) -> None:
    while os.getppid() == engaging and psutil.pid_exists(engaging):
        time.sleep(_PATIENCE)
    os._exit(1)


def _ray_workers(jobs: int | None) -> Workers:
    """Engage a cluster's workers by Ray's own pool.

    Ray's backend for joblib returns results only when the last one is complete, so that
    no block could be written before.
    """
    try:
        from ray.util.multiprocessing import Pool  # noqa: PLC0415  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise ValueError("backend 'ray' needs ray: pip install ray") from None

    def compute(calls: Iterable[Call]) -> Iterator[Any]:
        handler = signal.getsignal(signal.SIGTERM)
        with Pool(jobs) as pool:
            _handle_sigterm(handler)  # Ray replaces it by one that aborts
            yield from pool.imap_unordered(_call, calls)

    return compute


def _handle_sigterm(handler: Any) -> None:
    if callable(handler) and threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, handler)


def _call(call: Call) -> Any:
    function, arguments, options = call
    return function(*arguments, **options)
