"""Compile numerical kernels with numba, and never run a stale one."""

from collections.abc import Callable
from pathlib import Path
from typing import TypeVar, cast

from numba import njit

Kernel = TypeVar("Kernel", bound=Callable[..., object])


def compiled(function: Kernel) -> Kernel:
    """Compile a kernel at its first call and keep it in numba's cache on disk.

    Of the liberties of ``fastmath`` it takes only the fused multiply-add: sums keep
    their order, so that a kernel gives the same bits alone, inlined in another kernel,
    or in a thread.  ``NUMBA_DISABLE_JIT=1`` runs the plain Python functions instead,
    for a debugger.
    """
    options = {"cache": True, "error_model": "numpy", "nogil": True}
    return cast("Kernel", njit(fastmath={"contract"}, **options)(function))


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
