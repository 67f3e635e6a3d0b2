"""The clusters that may do the work of a command: Dask and Ray."""

import contextlib
import threading
from collections.abc import Iterator
from typing import Any

from .errors import BadInputError

_HERE = "127.0.0.1"  # what starts here listens to this machine only
_INTERVAL = 1.0  # between looks at the workers of a local cluster [s]


@contextlib.contextmanager
def connected(
    backend: str | None, scheduler: str | None, jobs: int | None
) -> Iterator[None]:
    """Connect to a cluster, or start one on this machine, for the block.

    Parameters
    ----------
    backend : str or None
        "dask" or "ray"; no other needs a cluster.
    scheduler : str or None
        Address of the cluster; None starts one for Dask, while Ray does so by itself.
    jobs : int or None
        Workers of a cluster that is started.

    Raises
    ------
    BadInputError
        If the backend is not installed, or none that has a scheduler.
    """
    if backend == "dask":
        with _dask_client(scheduler, jobs):
            yield
        return
    if scheduler is not None:
        _join_ray(backend, scheduler)
    yield


def _dask_client(scheduler: str | None, jobs: int | None) -> Any:
    try:
        import distributed
    except ImportError:
        raise BadInputError(
            "--backend dask needs dask.distributed: pip install 'slamgym[dask]'"
        ) from None
    client: Any = distributed.Client
    if scheduler is not None:
        return client(scheduler)
    return _with_new_workers(
        client(
            n_workers=jobs,
            threads_per_worker=1,
            host=_HERE,
            dashboard_address=f"{_HERE}:0",
        )
    )


@contextlib.contextmanager
def _with_new_workers(client: Any) -> Iterator[None]:
    """Replace workers of a local cluster that are gone.

    Dask restarts a worker that was killed, but not one that was killed as it started.
    """
    over, cluster = threading.Event(), client.cluster
    wanted = len(cluster.worker_spec)

    def replace() -> None:
        while not over.wait(_INTERVAL):
            if len(cluster.workers) < wanted:
                cluster.scale(wanted)

    with client:
        watch = threading.Thread(target=replace, daemon=True)
        watch.start()
        try:
            yield
        finally:
            over.set()
            watch.join()


def _join_ray(backend: str | None, scheduler: str) -> None:
    if backend != "ray":
        raise BadInputError("--scheduler is for --backend dask or ray")
    try:
        import ray  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise BadInputError("--backend ray needs ray: pip install ray") from None
    ray.init(address=scheduler)
