"""Refuse a covariance that does not fit into memory, before it is filled."""

from __future__ import annotations

from math import inf, sqrt
from pathlib import Path

import psutil

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


def landmarks_that_fit(least: int, wished: int, copies: int = 1) -> int:
    """Return the number of landmarks to allocate for, as far as memory allows.

    Parameters
    ----------
    least, wished : int
        Smallest and desired number of landmarks.
    copies : int
        Number of covariances of that size.

    Raises
    ------
    MemoryError
        If the smallest number does not fit.
    """
    if copies * covariance_bytes(wished) < SMALL:
        return wished
    refuse_beyond_memory(
        f"a covariance of {least} landmarks",
        copies * covariance_bytes(least),
        "'submaps' and 'sparse_information' take less",
    )
    free = available_memory()
    most = wished if free == inf else int((sqrt(free / copies / 8) - 3) / 2)
    return max(least, min(wished, most))
