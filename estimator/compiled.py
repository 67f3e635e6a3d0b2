"""Compile numerical kernels with numba, and never run a stale one."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, cast

from numba import njit

Kernel = TypeVar("Kernel", bound=Callable[..., object])


def compiled(function: Kernel) -> Kernel:
    """Compile a kernel at its first call and keep it in numba's cache on disk.

    Of the liberties of ``fastmath`` it takes only the fused multiply-add: sums keep
    their order, so that a kernel gives the same bits alone, inlined in another kernel,
    or in a thread.  ``NUMBA_DISABLE_JIT=1`` runs the plain Python functions instead,
    for a debugger.
    """
    return _compile(function, callable_from_python=True)


def part(function: Kernel) -> Kernel:
    """Compile a function that only kernels call, in about half the time.

    Its ``py_func`` can be called from Python.
    """
    return _compile(function, callable_from_python=False)


def _compile(function: Kernel, *, callable_from_python: bool) -> Kernel:
    options: dict[str, Any] = {
        "cache": True,
        "error_model": "numpy",
        "nogil": True,
        "fastmath": {"contract"},
        "no_cfunc_wrapper": True,
        "no_cpython_wrapper": not callable_from_python,
    }
    return cast("Kernel", njit(**options)(function))


def discard_stale_cache(folder: Path) -> None:
    """Delete cached kernels that are older than any source file of the folder.

    Numba looks at the file of the kernel itself only, not at the files of the kernels
    it calls: after an edit of one of those it would run yesterday's code.

    Parameters
    ----------
    folder : Path
        Folder of the sources, with numba's cache in its ``__pycache__``.
    """
    newest = max(source.stat().st_mtime for source in folder.glob("*.py"))
    for cached in (folder / "__pycache__").glob("*.nb[ic]"):
        if cached.stat().st_mtime < newest:
            cached.unlink(missing_ok=True)


discard_stale_cache(Path(__file__).parent)
