"""Compile numerical kernels with numba, and never run a stale one."""

from collections.abc import Callable
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any, TypeVar, cast

from numba import njit

SOURCES = Path(__file__).parents[1]

Kernel = TypeVar("Kernel", bound=Callable[..., object])


def compiled(function: Kernel) -> Kernel:
    """Compile a kernel at its first call and keep it in numba's cache on disk.

    It takes none of the liberties of ``fastmath``: one function gives the same bits
    alone, called by another kernel, in a thread, or loaded from the cache; where
    multiply-adds are to be fused, :mod:`.fused` says so.  ``NUMBA_DISABLE_JIT=1`` runs
    the plain Python functions instead, for a debugger.
    """
    return _compile(function, callable_from_python=True)


def part(function: Kernel) -> Kernel:
    """Compile a function that only kernels call, in about half the time.

    Its ``py_func`` can be called from Python.
    """
    return _compile(function, callable_from_python=False)


def inlined(function: Kernel) -> Kernel:
    """Make a function part of the kernel that calls it, so that it compiles but once.

    For what conducts other kernels and is itself called from one place.
    """
    return cast("Kernel", njit(inline="always", error_model="numpy")(function))


def _compile(function: Kernel, *, callable_from_python: bool) -> Kernel:
    options: dict[str, Any] = {
        "cache": True,
        "error_model": "numpy",
        "nogil": True,
        "no_cfunc_wrapper": True,
        "no_cpython_wrapper": not callable_from_python,
    }
    kernel = njit(**options)(function)
    stats = getattr(kernel, "stats", None)  # None without JIT
    if stats is not None:
        discard_stale_cache(SOURCES, Path(stats.cache_path))
    return cast("Kernel", kernel)


@cache
def discard_stale_cache(sources: Path, cached: Path) -> None:
    """Delete cached kernels that are older than any source file; once per folder.

    Numba looks at the file of the kernel itself only, not at the files of the kernels
    it calls: after an edit of one of those it would run yesterday's code.

    Parameters
    ----------
    sources, cached : Path
        Folder of the sources, and the folder in which numba keeps what it compiled.
    """
    newest = max((f.stat().st_mtime for f in sources.rglob("*.py")), default=0.0)
    for file in cached.glob("*.nb[ic]"):
        with suppress(OSError):  # somebody else's cache
            if file.stat().st_mtime < newest:
                file.unlink()
