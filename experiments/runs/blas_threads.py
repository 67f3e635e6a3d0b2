"""Limit BLAS to one thread, which is fastest for the small products of filters."""

from contextlib import AbstractContextManager
from typing import Any

from threadpoolctl import threadpool_limits


def one_blas_thread() -> AbstractContextManager[Any]:
    """Run linear algebra on one thread within the context.

    Several threads are many times slower on shared cores, and the last bits of a
    product depend on their number.

    Examples
    --------
    >>> from threadpoolctl import threadpool_info
    >>> with one_blas_thread():
    ...     pools = [pool for pool in threadpool_info() if pool["user_api"] == "blas"]
    >>> {pool["num_threads"] for pool in pools}
    {1}
    """
    import scipy.linalg  # noqa: F401, PLC0415 (loads the BLAS to be limited)

    limits: AbstractContextManager[Any] = threadpool_limits(1, user_api="blas")
    return limits
