"""One BLAS thread: several wait for each other over the small products of filters."""

from contextlib import AbstractContextManager
from typing import Any

from threadpoolctl import threadpool_limits


def one_blas_thread() -> AbstractContextManager[Any]:
    """Let linear algebra run on one thread, as long as the context lasts.

    Several are many times slower where the cores are shared, and the last bits of a
    product depend on how many there are.

    Examples
    --------
    >>> from threadpoolctl import threadpool_info
    >>> with one_blas_thread():
    ...     pools = [pool for pool in threadpool_info() if pool["user_api"] == "blas"]
    >>> {pool["num_threads"] for pool in pools}
    {1}
    """
    import scipy.linalg  # noqa: F401, PLC0415 (its BLAS must be there to be limited)

    limits: AbstractContextManager[Any] = threadpool_limits(1, user_api="blas")
    return limits
