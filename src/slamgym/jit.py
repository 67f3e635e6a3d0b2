"""Compile numerical kernels with numba, and never run stale code.

Each decorator leaves a function of plain scalars and arrays that also runs as plain
Python: ``NUMBA_DISABLE_JIT=1`` turns compilation off, for a debugger.
"""

from collections.abc import Callable
from contextlib import suppress
from functools import cache
from inspect import getfile
from pathlib import Path
from typing import Any, TypeVar, cast

from numba import config, njit, types
from numba.extending import intrinsic

SOURCES = Path(__file__).parent / "estimator"
"""Kernels of any folder call functions from any file in it."""

Kernel = TypeVar("Kernel", bound=Callable[..., object])


def jit(function: Kernel) -> Kernel:
    """Compile a kernel at its first call and keep it in numba's cache on disk.

    ``fastmath`` stays off: a kernel gives the same bits when called from Python, from
    another kernel, in a thread, or when loaded from the cache.  Where a multiply-add is
    to be rounded once, the code calls :func:`fma`.
    """
    return _compile(function, callable_from_python=True)


def njit_internal(function: Kernel) -> Kernel:
    """Compile a function that only kernels call, in about half the time.

    Python can call its ``py_func``.
    """
    return _compile(function, callable_from_python=False)


def njit_inlined(function: Kernel) -> Kernel:
    """Copy the body of a function into its caller, which compiles it only once.

    For a function that calls other kernels and has one caller.
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
    stats = getattr(kernel, "stats", None)  # None where compilation is turned off
    if stats is not None:
        own_folder = Path(getfile(function)).parent
        cached = Path(stats.cache_path)
        discard_stale_cache(SOURCES, cached)
        if not own_folder.is_relative_to(SOURCES):
            discard_stale_cache(own_folder, cached)
    return cast("Kernel", kernel)


@cache
def discard_stale_cache(sources: Path, cached: Path) -> None:
    """Delete cached kernels older than any source file or this one; once per folder.

    Numba compares a cached kernel with its own file only.  After an edit in the file of
    a function that the kernel calls, numba would run the old code.

    Parameters
    ----------
    sources, cached : Path
        Folder of the sources, and the folder of numba's cache.
    """
    files = [Path(__file__), *sources.rglob("*.py")]
    newest = max(file.stat().st_mtime for file in files)
    for file in cached.glob("*.nb[ic]"):
        with suppress(OSError):  # a cache that belongs to another user
            if file.stat().st_mtime < newest:
                file.unlink()


def _multiply_add(a: float, b: float, c: float) -> float:
    """Return a b + c in plain Python, rounded twice."""
    return a * b + c


def _emitted_fma(_typing: Any, _a: Any, _b: Any, _c: Any) -> tuple[Any, Any]:
    def generate(_context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        return builder.fma(*arguments)

    return types.float64(types.float64, types.float64, types.float64), generate


# A compiler that is free to fuse (``fastmath``) does so depending on what is inlined
# where.  One kernel would then give different bits alone and inside another kernel.
fma = cast(
    "Callable[[float, float, float], float]",
    _multiply_add if getattr(config, "DISABLE_JIT", 0) else intrinsic(_emitted_fma),
)
"""a b + c, rounded once."""
