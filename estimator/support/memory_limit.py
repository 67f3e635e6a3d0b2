"""Refuse a covariance that does not fit into memory, before it is filled.

`usable_cores` and `share_out` share work over threads, for compiled functions that
release the interpreter.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from math import inf, prod, sqrt
from pathlib import Path

import numpy as np
import psutil

from ...arrays import Array

# Less than this is not checked [bytes].
SMALL = 2**24

_CONTAINER = Path("/sys/fs/cgroup")


def covariance_bytes(landmarks: int) -> int:
    """Return the size of a dense covariance of a pose and n landmarks [bytes].

    Examples
    --------
    >>> covariance_bytes(10_000)
    3200960072
    """
    return 8 * (3 + 2 * landmarks) ** 2


def available_memory() -> float:
    """Return what may be filled without swapping [bytes], inf where it is unknown."""
    try:
        free = float(psutil.virtual_memory().available)
    except (OSError, KeyError):
        free = inf
    return min(free, _left_to_container())


def _left_to_container() -> float:
    """Return what the limit of a control group leaves [bytes].

    Cached files count as free.
    """
    try:
        limit, used = (
            float((_CONTAINER / name).read_text().strip().replace("max", "inf"))
            for name in ("memory.max", "memory.current")
        )
        lines = (_CONTAINER / "memory.stat").read_text().splitlines()
        cached = next(int(n) for name, n in map(str.split, lines) if name == "file")
    except (OSError, StopIteration, ValueError):
        return inf
    return limit - used + cached


def refuse_beyond_memory(
    what: str, needed: float, instead: str, *, held: float = 0.0
) -> None:
    """Refuse what takes more memory than is available.

    Parameters
    ----------
    what : str
        What takes the memory.
    needed : float
        How much it takes [bytes].
    instead : str
        What the user may do.
    held : float
        How much of it is held already [bytes].

    Raises
    ------
    MemoryError
        If it does not fit, with both figures.
    """
    if needed < SMALL:
        return
    free = available_memory() + held
    if needed > free:
        raise MemoryError(
            f"{what} takes {1e-9 * needed:.1f} GB of memory, and {1e-9 * free:.1f} GB "
            f"are available: {instead}"
        )


def landmarks_that_fit(least: int, wished: int) -> int:
    """Return the number of landmarks to allocate for, as far as memory allows.

    Parameters
    ----------
    least, wished : int
        Smallest and desired number of landmarks.

    Raises
    ------
    MemoryError
        If the smallest number does not fit.
    """
    if covariance_bytes(wished) < SMALL:
        return wished
    refuse_beyond_memory(
        f"a covariance of {least} landmarks",
        covariance_bytes(least),
        "'submaps' and 'sparse_information' take less",
    )
    free = available_memory()
    most = wished if free == inf else int((sqrt(free / 8) - 3) / 2)
    return max(least, min(wished, most))


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


CACHE_LINE = 64  # [bytes]


def aligned_zeros(*shape: int) -> Array:
    """Return zeros that begin on a cache line, so that no vector spans two lines.

    Examples
    --------
    >>> aligned_zeros(3, 5).ctypes.data % CACHE_LINE
    0
    """
    size = prod(shape)
    room = np.zeros(size + CACHE_LINE // 8)
    skipped = -room.ctypes.data % CACHE_LINE // 8
    return room[skipped : skipped + size].reshape(shape)
