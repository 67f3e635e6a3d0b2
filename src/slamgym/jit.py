"""Compile numerical kernels with numba, and keep them on disk.

Each decorator leaves a function of plain scalars and arrays that also runs as plain
Python: ``NUMBA_DISABLE_JIT=1`` turns compilation off, for a debugger.
"""

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numpy as np
from numba import config, njit, types
from numba.extending import intrinsic

from .kernel_cache import KernelCache

_PLAIN = bool(getattr(config, "DISABLE_JIT", 0))

Kernel = TypeVar("Kernel", bound=Callable[..., object])


def jit(function: Kernel) -> Kernel:
    """Compile a kernel at its first call and keep it in :mod:`.kernel_cache`.

    ``fastmath`` stays off, except in :func:`njit_reordered`: a kernel gives the same
    bits when called from Python, from another kernel, in a thread, or when loaded from
    the cache.  Where a multiply-add is to be rounded once, the code calls :func:`fma`.
    """
    return _compile(function, callable_from_python=True)


def njit_internal(function: Kernel) -> Kernel:
    """Compile a function that only kernels call, in about half the time.

    Python can call its ``py_func``.
    """
    return _compile(function, callable_from_python=False)


def njit_reordered(function: Kernel) -> Kernel:
    """Compile an internal function whose long sums may be added up in any order.

    They then run on whole vector registers. One kernel alone may call it: the compiler
    may choose another order in another kernel, and so other last bits.
    """
    return _compile(function, callable_from_python=False, reordered=True)


def njit_inlined(function: Kernel) -> Kernel:
    """Copy the body of a function into its caller, which compiles it only once.

    For a function that calls other kernels and has one caller.
    """
    return cast("Kernel", njit(inline="always", error_model="numpy")(function))


def _compile(
    function: Kernel, *, callable_from_python: bool, reordered: bool = False
) -> Kernel:
    options: dict[str, Any] = {
        "error_model": "numpy",
        "nogil": True,
        "no_cfunc_wrapper": True,
        "no_cpython_wrapper": not callable_from_python,
        "fastmath": {"reassoc", "nsz", "contract"} if reordered else False,
    }
    kernel = njit(**options)(function)
    if hasattr(kernel, "py_func"):  # else compilation is turned off
        kernel._cache = KernelCache(kernel)
    return cast("Kernel", kernel)


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
    _multiply_add if _PLAIN else intrinsic(_emitted_fma),
)
"""a b + c, rounded once."""


def _multiply_words(a: np.uint64, b: np.uint64) -> tuple[np.uint64, np.uint64]:
    """Return the high and the low half of a b, of 128 bits, in plain Python."""
    product = int(a) * int(b)
    return np.uint64(product >> 64), np.uint64(product & _ALL_BITS)


def _add_words(a: np.uint64, b: np.uint64) -> np.uint64:
    """Return a + b modulo 2⁶⁴ in plain Python, where numpy warns of overflow."""
    return np.uint64((int(a) + int(b)) & _ALL_BITS)


def _emitted_product(_typing: Any, _a: Any, _b: Any) -> tuple[Any, Any]:
    halves = cast("Any", types).UniTuple(types.uint64, 2)

    def generate(context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        word = arguments[0].type
        wide = type(word)(2 * word.width)
        product = builder.mul(*(builder.zext(each, wide) for each in arguments))
        high = builder.trunc(builder.lshr(product, wide(word.width)), word)
        low = builder.trunc(product, word)
        return context.make_tuple(builder, halves, (high, low))

    return halves(types.uint64, types.uint64), generate


def _emitted_sum(_typing: Any, _a: Any, _b: Any) -> tuple[Any, Any]:
    def generate(_context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        return builder.add(*arguments)

    return types.uint64(types.uint64, types.uint64), generate


_ALL_BITS = 2**64 - 1
multiply_words = cast(
    "Callable[[np.uint64, np.uint64], tuple[np.uint64, np.uint64]]",
    _multiply_words if _PLAIN else intrinsic(_emitted_product),
)
"""The high and the low half of the product of two words of 64 bits."""
add_words = cast(
    "Callable[[np.uint64, np.uint64], np.uint64]",
    _add_words if _PLAIN else intrinsic(_emitted_sum),
)
"""a + b modulo 2⁶⁴."""
