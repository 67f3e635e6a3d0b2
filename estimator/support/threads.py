"""Share work over threads, for compiled functions that release the interpreter."""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

# Small shares: a thread whose core is busy then delays the others little.
SHARES_PER_THREAD = 8


def usable_cores() -> int:
    """Return the number of cores that this process may use, 1 where it is unknown."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return 1


def share_out(work: Callable[[slice], object], count: int, threads: int) -> None:
    """Do work on 0 … count − 1 in small slices, each by whichever thread is free.

    Examples
    --------
    >>> share_out(print, 3, threads=1)
    slice(0, 3, None)
    """
    threads = min(threads, count)
    if threads <= 1:
        work(slice(0, count))
        return
    share = -(-count // (SHARES_PER_THREAD * threads))
    shares = [slice(start, start + share) for start in range(0, count, share)]
    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(work, shares))
