"""Variants of kernels: the same code with other functions in place of some.

Kernels are written for bearing and range, with Jacobians.  `specialised` makes those of
another sensor or method from them.
"""

import hashlib
from collections.abc import Callable, Iterator, Mapping
from types import CodeType, FunctionType, ModuleType
from typing import Any, cast

import numpy as np
from numba import njit

from .jit import Kernel, compiler_for, kept

#: Libraries whose versions count in the digest, not their sources.
LIBRARIES = ("builtins", "math", "numba", "numpy")


def specialised(
    kernel: Kernel, changes: Mapping[Callable[..., Any], Callable[..., Any]], name: str
) -> Kernel:
    """Return a kernel in which other functions replace some, at any depth of calls.

    It is compiled and cached like the kernel itself, under a name with a digest of the
    other functions.  Parts that do not depend on them are shared with the kernel.

    Parameters
    ----------
    kernel : callable
        The kernel.
    changes : mapping
        Compiled functions that it calls, directly or not, and their replacements.
    name : str
        Distinguishes the new kernel from others made from this one.
    """
    digest = hashlib.sha256()
    for part in _parts_of(list(changes.values()), set()):
        digest.update(part)
    known: dict[int, Any] = {id(old): new for old, new in changes.items()}

    def remade(value: Any) -> Any:
        function = getattr(value, "py_func", value)
        if id(value) in known or not isinstance(function, FunctionType):
            return known.get(id(value), value)
        known[id(value)] = value  # inside itself, if it is recursive
        own = function.__globals__
        used = {each: own[each] for each in function.__code__.co_names if each in own}
        if function.__module__.partition(".")[0] in LIBRARIES:
            return value
        new = {each: remade(part) for each, part in used.items()}
        if all(new[each] is part for each, part in used.items()):
            return value
        copy = FunctionType(
            *(function.__code__, own | new),
            *(f"{function.__name__}_{name}_{digest.hexdigest()[:16]}",),
            *(function.__defaults__, function.__closure__),
        )
        copy.__qualname__, copy.__module__ = copy.__name__, function.__module__
        copy.__kwdefaults__ = function.__kwdefaults__
        known[id(value)] = copy if value is function else _recompiled(copy, value)
        return known[id(value)]

    return cast("Kernel", remade(kernel))


def _recompiled(function: Any, like: Any) -> Any:
    """Compile a function with the options of another one."""
    options = {k: v for k, v in like.targetoptions.items() if k != "nopython"}
    kernel = njit(**options, **compiler_for(options))(function)
    return kept(kernel) if "_nrt" in options else kernel  # else not one of `.jit`


def _parts_of(value: Any, seen: set[int]) -> Iterator[bytes]:
    """Yield what determines the machine code of functions: code, and values it reads.

    Functions of a user may call functions in other files, and read values that change
    without an edit of a file.
    """
    function = getattr(value, "py_func", getattr(value, "__wrapped__", value))
    if isinstance(value, list | tuple):
        yield repr((type(value), getattr(value, "_fields", None))).encode()
        for each in value:
            yield from _parts_of(each, seen)
    elif isinstance(value, np.ndarray):
        yield f"{value.dtype} {value.shape}".encode() + value.tobytes()
    elif not isinstance(function, FunctionType):
        kind = getattr(value, "__qualname__", value)
        parts = [getattr(value, name, None) for name in ("_fields", "__members__")]
        yield repr((kind, parts)).encode()
    elif id(function) not in seen:
        seen.add(id(function))
        options = sorted(getattr(value, "targetoptions", {}).items())
        yield f"{function.__module__}.{function.__qualname__} {options}".encode()
        if function.__module__.partition(".")[0] not in LIBRARIES:
            cells = [cell.cell_contents for cell in function.__closure__ or ()]
            named = sorted((function.__kwdefaults__ or {}).items())
            yield from _parts_of((cells, function.__defaults__, named), seen)
            names: set[str] = set()
            for code in _with_inner(function.__code__):
                constants = [each for each in code.co_consts if not _is_code(each)]
                yield code.co_code
                yield repr((code.co_names, code.co_varnames, constants)).encode()
                names.update(code.co_names)
            yield from _values_of(names, function.__globals__, seen)


def _values_of(
    names: set[str], known: dict[str, Any], seen: set[int]
) -> Iterator[bytes]:
    for name in sorted(names & known.keys()):
        value = known[name]
        yield name.encode()
        asked = hash((id(value), frozenset(names)))  # others may ask for other names
        if not isinstance(value, ModuleType):
            yield from _parts_of(value, seen)
        elif value.__name__.partition(".")[0] in LIBRARIES or asked in seen:
            yield value.__name__.encode()
        else:
            seen.add(asked)
            yield from _values_of(names, vars(value), seen)


def _with_inner(code: CodeType) -> Iterator[CodeType]:
    yield code
    for constant in code.co_consts:
        if _is_code(constant):
            yield from _with_inner(constant)


def _is_code(constant: object) -> bool:
    return isinstance(constant, CodeType)
