"""Whether a covariance fits into memory: told before it is filled, with the figures."""

from math import inf, sqrt
from pathlib import Path

# What takes less than this is not worth the question [bytes].
SMALL = 2**24

_SYSTEM, _CONTAINER = Path("/proc/meminfo"), Path("/sys/fs/cgroup")


def covariance_bytes(landmarks: int) -> int:
    """Return the size of a dense covariance of the pose and so many landmarks [bytes].

    Examples
    --------
    >>> covariance_bytes(10_000)
    3200960072
    """
    return 8 * (3 + 2 * landmarks) ** 2


def available_memory() -> float:
    """Return what may be filled without swapping [bytes], inf where nobody tells.

    Linux tells, of the machine and of a container.  Where a system refuses to allocate
    what it does not have, as Windows does, numpy raises the error by itself.
    """
    try:
        lines = (line.split() for line in _SYSTEM.read_text().splitlines())
        free = next(1024.0 * int(n) for name, n, *_ in lines if name == "MemAvailable:")
        return min(free, _left_to_container())
    except (OSError, StopIteration, ValueError):
        return inf


def _left_to_container() -> float:
    """Return what a control group's limit leaves [bytes]; cached files give way."""
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
    """Refuse what takes more memory than there is.

    Parameters
    ----------
    what : str
        What takes it.
    needed : float
        How much, of which ``held`` is held already [bytes].
    instead : str
        What to do.

    Raises
    ------
    MemoryError
        Where it does not suffice, with both figures.
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
    """Return for how many landmarks to make room: the wished, or what memory allows.

    Parameters
    ----------
    least, wished : int
        How many there must be room for, and how many there would better be.
    copies : int
        How many covariances of that size there will be.

    Raises
    ------
    MemoryError
        Where there is no room for the least.
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
