"""Measure the present gain of the machine's second core: two independent processes."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing import get_context
from multiprocessing.connection import Connection
from time import perf_counter

Work = Callable[[], object]


@contextmanager
def two_processes(prepare: Callable[[], Work]) -> Iterator[Callable[[], float]]:
    """Start two processes, and yield a function that runs both once.

    Parameters
    ----------
    prepare : callable
        Of a module's top level; called in each process, returns the work.

    Yields
    ------
    callable
        Returns the seconds until the later one is done.
    """
    context = get_context("spawn")
    pairs = [context.Pipe() for _ in range(2)]
    processes = [
        context.Process(target=_serve, args=(far, prepare), daemon=True)
        for _, far in pairs
    ]
    for process in processes:
        process.start()
    near = [connection for connection, _ in pairs]
    _wait_for(near)

    def both() -> float:
        began = perf_counter()
        for connection in near:
            connection.send(True)
        _wait_for(near)
        return perf_counter() - began

    try:
        yield both
    finally:
        for connection in near:
            connection.send(False)
        for process in processes:
            process.join()


def _wait_for(connections: list[Connection]) -> None:
    for connection in connections:
        connection.recv()


def _serve(connection: Connection, prepare: Callable[[], Work]) -> None:
    work = prepare()
    work()
    connection.send("ready")
    while connection.recv():
        work()
        connection.send("done")
