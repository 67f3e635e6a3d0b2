"""Identify what a kernel computes by all code and constants that go into it.

The loaded code counts, not files: dates, folders and edits after the import play no
part.  Two checkouts with equal kernels have equal fingerprints.
"""

import hashlib
import os
import sys
from collections.abc import Iterator
from types import BuiltinFunctionType, CodeType, FunctionType, ModuleType
from typing import Any

import numba
import numpy as np
from numba import types

LIBRARIES = {"builtins", "math", "numba", "numpy"}
"""Named, with the versions of numba and numpy; not followed into their sources."""

_VALUES = (bool, int, float, complex, str, bytes, type(None), type(...), np.generic)
_UNRELATED = ("NUMBA_CACHE", "NUMBA_DEBUG", "NUMBA_NUM_THREADS")


class UnknownValueError(TypeError):
    """A kernel uses a global value of a kind that has no fingerprint."""


def code_fingerprint(kernel: Any) -> str:
    """Return a hash of all that decides which machine code a kernel becomes.

    It covers the byte code of the kernel, of every function that it calls, however
    deep, the names of their modules and the constants they read, with the versions of
    Python, numba and numpy, the options of the compiler and numba's environment
    variables.

    Parameters
    ----------
    kernel : dispatcher
        A function decorated by numba.

    Raises
    ------
    UnknownValueError
        If it uses a global value other than functions, classes, modules, numbers,
        strings, tuples, dicts and arrays.
    """
    digest = hashlib.sha256()
    for part in (*_compiler(), *_Description().of(kernel)):
        digest.update(f"{len(part)}:{part}".encode())
    return digest.hexdigest()


def _compiler() -> Iterator[str]:
    yield f"{sys.version} numba {numba.__version__} numpy {np.__version__}"
    for name, value in sorted(os.environ.items()):
        if name.startswith("NUMBA_") and not name.startswith(_UNRELATED):
            yield f"{name}={value}"


class _Description:
    """Describe values by text; what was described before, by its number."""

    def __init__(self) -> None:
        self._seen: dict[int, int] = {}

    def of(self, value: Any) -> Iterator[str]:
        """Yield the parts of a value's description."""
        if isinstance(value, _VALUES):
            yield f"{type(value).__name__} {value!r}"
        elif isinstance(value, tuple | list | frozenset):
            yield from self._collection(value)
        elif isinstance(value, dict):
            yield from self._collection(list(value.items()))
        elif isinstance(value, np.ndarray):
            yield f"array {value.dtype} {value.shape} {value.tobytes().hex()}"
        else:
            yield from self._named(value)

    def _collection(self, values: Any) -> Iterator[str]:
        yield f"{type(values).__name__} of {len(values)}"
        if isinstance(values, frozenset):  # its order differs between processes
            values = sorted(values, key=repr)
        for value in values:
            yield from self.of(value)

    def _named(self, value: Any) -> Iterator[str]:
        known = self._seen.get(id(value))
        self._seen.setdefault(id(value), len(self._seen))
        if known is not None:  # above, or around this: a function may call itself
            yield f"as number {known}"
        elif hasattr(value, "py_func"):  # a numba dispatcher
            yield f"kernel {_options(value)}"
            yield from self.of(value.py_func)
        elif _library(value) in LIBRARIES:
            yield f"{type(value).__name__} {_name(value)}"
        elif isinstance(value, FunctionType):
            yield from self._function(value)
        elif isinstance(value, type):
            yield from self._class(value)
        elif hasattr(value, "__wrapped__"):  # a numba intrinsic
            yield from self.of(value.__wrapped__)
        else:
            raise UnknownValueError(f"{value!r} has no fingerprint")

    def _class(self, value: type) -> Iterator[str]:
        yield f"class {_name(value)}"  # of a NamedTuple, kernels see the fields only
        yield from self.of(getattr(value, "_fields", ()))
        yield from self.of(getattr(value, "_field_defaults", {}))

    def _function(self, function: FunctionType) -> Iterator[str]:
        yield f"function {_name(function)}"  # compiled code imports the module again
        yield from self.of(function.__defaults__)
        yield from self.of(function.__kwdefaults__)
        for cell in function.__closure__ or ():
            yield from self.of(cell.cell_contents)
        codes = list(_with_inner(function.__code__))
        for code in codes:
            yield from self._code(code)
        names = sorted({name for code in codes for name in code.co_names})
        for name in names:
            if name in function.__globals__:
                yield name
                yield from self._global(function.__globals__[name], names)

    def _code(self, code: CodeType) -> Iterator[str]:
        yield f"{code.co_code.hex()} {code.co_exceptiontable.hex()} {code.co_flags}"
        yield f"{code.co_argcount} {code.co_posonlyargcount} {code.co_kwonlyargcount}"
        yield from self.of((code.co_varnames, code.co_names, code.co_freevars))
        yield from self.of(tuple(c for c in code.co_consts if not _is_code(c)))

    def _global(self, value: Any, names: list[str]) -> Iterator[str]:
        if not isinstance(value, ModuleType):
            yield from self.of(value)
            return
        yield f"module {value.__name__}"
        if value.__name__.partition(".")[0] not in LIBRARIES:
            for name in names:
                if hasattr(value, name):
                    yield from self.of(getattr(value, name))


def _with_inner(code: CodeType) -> Iterator[CodeType]:
    yield code
    for constant in code.co_consts:
        if _is_code(constant):
            yield from _with_inner(constant)


def _is_code(constant: object) -> bool:
    return isinstance(constant, CodeType)


def _options(kernel: Any) -> str:
    """Return the options of the compiler in one order; ``fastmath`` may be a set."""
    options = sorted(kernel.targetoptions.items())
    return repr([(k, sorted(v) if isinstance(v, set) else v) for k, v in options])


def _library(value: Any) -> str:
    """Return the library that a function, a class or a type of numba comes from."""
    if isinstance(value, BuiltinFunctionType | np.ufunc | np.dtype):
        return "builtins"
    if not hasattr(value, "__qualname__"):
        value = type(value) if isinstance(value, types.Type) else None
    return str(getattr(value, "__module__", None)).partition(".")[0]


def _name(value: Any) -> str:
    name = getattr(value, "__qualname__", None)
    return f"{value.__module__}.{name}" if name else repr(value)
