"""Compile numerical kernels with numba, and keep them on disk.

Each decorator leaves a function of plain scalars and arrays that also runs as plain
Python: ``NUMBA_DISABLE_JIT=1`` turns compilation off, for a debugger.
"""

import contextlib
import ctypes
import hashlib
import os
import pickle
import sys
import tempfile
import time
import uuid
import warnings
from collections.abc import Callable, Iterator, Mapping
from functools import cache, cached_property
from pathlib import Path
from types import BuiltinFunctionType, CodeType, FunctionType, ModuleType
from typing import Any, TypeVar, cast

import numba
import numpy as np
from numba import config, njit, types
from numba.core import compiler, serialize
from numba.core.cpu import CPUTargetOptions
from numba.core.runtime.nrt import rtsys
from numba.extending import intrinsic

_PLAIN = bool(getattr(config, "DISABLE_JIT", 0))

Kernel = TypeVar("Kernel", bound=Callable[..., object])


def jit(function: Kernel) -> Kernel:
    """Compile a kernel at its first call and keep it in the cache.

    ``fastmath`` stays off, except in :func:`njit_reordered`: a kernel gives the same
    bits when called from Python, from another kernel, in a thread, or when loaded from
    the cache.  Where a multiply-add is to be rounded once, the code calls :func:`fma`.
    """
    return _compile(function, callable_from_python=True)


def jit_in_place(function: Kernel) -> Kernel:
    """Compile a kernel that changes only the arrays of its arguments.

    It may not allocate arrays.  Without counting references to them, a call takes less
    time, and so does every view of an array.
    """
    return _compile(function, callable_from_python=True, counted=False)


def njit_internal(function: Kernel) -> Kernel:
    """Compile a function that only kernels call, in about half the time.

    As :func:`jit_in_place`, it allocates no arrays, returns none and calls no kernel
    that returns any.  Python can call its ``py_func``.
    """
    return _compile(function, callable_from_python=False, counted=False)


def njit_allocating(function: Kernel) -> Kernel:
    """Compile an internal function that allocates, returns or is given back arrays."""
    return _compile(function, callable_from_python=False)


def njit_reordered(function: Kernel) -> Kernel:
    """Compile an internal function whose long sums may be added up in any order.

    They then run on whole vector registers. One kernel alone may call it: the compiler
    may choose another order in another kernel, and so other last bits.
    """
    return _compile(function, callable_from_python=False, reordered=True)


def njit_apart(function: Kernel) -> Kernel:
    """Compile an internal function whose arrays do not overlap in memory.

    Its loops then run on whole vector registers at once.  Otherwise they first compare
    the addresses of all arrays, which takes longer than the loop over a small map.
    """
    return _compile(function, callable_from_python=False, apart=True, counted=False)


def njit_inlined(function: Kernel) -> Kernel:
    """Copy the body of a function into its caller, which compiles it only once.

    For a short function, or one that calls other kernels and has one caller.
    """
    return cast("Kernel", njit(inline="always", error_model="numpy")(function))


_TARGET: Any = CPUTargetOptions  # numba has this flag, and no option that sets it
_TARGET.noalias = _TARGET.Mapping("noalias")


def _compile(
    function: Kernel,
    *,
    callable_from_python: bool,
    reordered: bool = False,
    apart: bool = False,
    counted: bool = True,
) -> Kernel:
    options: dict[str, Any] = {
        "error_model": "numpy",
        "nogil": True,
        "no_cfunc_wrapper": True,
        "no_cpython_wrapper": not callable_from_python,
        "fastmath": {"reassoc", "nsz", "contract"} if reordered else False,
        "noalias": apart,
        "_nrt": counted,
    }
    return cast("Kernel", _kept(njit(**options)(function)))


def _kept(kernel: Any) -> Any:
    """Keep a kernel in the cache, and compile it once for constants and variables."""

    def of_variables(args: Any, kws: Any) -> Any:
        plain: Any = types.unliteral
        named = {name: plain(value) for name, value in kws.items()}
        return type(kernel).get_call_template(kernel, tuple(map(plain, args)), named)

    if hasattr(kernel, "py_func"):  # else compilation is turned off
        kernel._cache = KernelCache(kernel)
        kernel.get_call_template = of_variables
    return kernel


def specialised(
    kernel: Kernel, changes: Mapping[Callable[..., Any], Callable[..., Any]], name: str
) -> Kernel:
    """Return a kernel that calls other functions in place of some, however deep.

    It is compiled and cached like the kernel itself.  What does not depend on the
    functions is shared with it.

    Parameters
    ----------
    kernel : callable
        The kernel.
    changes : mapping
        Compiled functions that it calls, directly or not, and what replaces them.
    name : str
        Distinguishes the new kernel from others made from this one.
    """
    parts = [code_fingerprint(part) for part in changes.values() if not _PLAIN]
    digest = hashlib.sha256("".join(parts).encode()).hexdigest()[:16]
    known: dict[int, Any] = {id(old): new for old, new in changes.items()}

    def remade(value: Any) -> Any:
        function = getattr(value, "py_func", value)
        if id(value) in known or not isinstance(function, FunctionType):
            return known.get(id(value), value)
        known[id(value)] = value  # inside itself, should it be recursive
        own = function.__globals__
        used = {each: own[each] for each in function.__code__.co_names if each in own}
        if _library(function) in LIBRARIES:
            return value
        new = {each: remade(part) for each, part in used.items()}
        if all(new[each] is part for each, part in used.items()):
            return value
        copy = FunctionType(
            *(function.__code__, own | new, f"{function.__name__}_{name}_{digest}"),
            *(function.__defaults__, function.__closure__),
        )
        copy.__qualname__, copy.__module__ = copy.__name__, function.__module__
        copy.__kwdefaults__ = function.__kwdefaults__
        known[id(value)] = copy if value is function else _recompiled(copy, value)
        return known[id(value)]

    return cast("Kernel", remade(kernel))


def _recompiled(function: Any, like: Any) -> Any:
    """Compile a function as another one was."""
    options = {k: v for k, v in like.targetoptions.items() if k != "nopython"}
    kernel = njit(**options)(function)
    return _kept(kernel) if isinstance(like._cache, KernelCache) else kernel


@cache
def _fma_in_c() -> Any:
    """Find the function in the C library; compiled kernels do without it."""
    return ctypes.CFUNCTYPE(*4 * [ctypes.c_double])(("fma", ctypes.CDLL(None)))


def _fma(a: float, b: float, c: float) -> np.float64:
    """Return a b + c, rounded once, in plain Python."""
    return np.float64(_fma_in_c()(a, b, c))


def _emitted_fma(_typing: Any, _a: Any, _b: Any, _c: Any) -> tuple[Any, Any]:
    def generate(_context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        return builder.fma(*arguments)

    return types.float64(types.float64, types.float64, types.float64), generate


# A compiler that is free to fuse (``fastmath``) does so depending on what is inlined
# where.  One kernel would then give different bits alone and inside another kernel.
#: a b + c, rounded once.
fma = cast(
    "Callable[[float, float, float], float]",
    _fma if _PLAIN else intrinsic(_emitted_fma),
)


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
#: The high and the low half of the product of two words of 64 bits.
multiply_words = cast(
    "Callable[[np.uint64, np.uint64], tuple[np.uint64, np.uint64]]",
    _multiply_words if _PLAIN else intrinsic(_emitted_product),
)
#: a + b modulo 2⁶⁴.
add_words = cast(
    "Callable[[np.uint64, np.uint64], np.uint64]",
    _add_words if _PLAIN else intrinsic(_emitted_sum),
)


# --------------------------------------------------------------------------------------
# Keep compiled kernels on disk, each under the fingerprint of its code.
#
# Nothing here can be stale, so nothing is compared or deleted at import.  Each compiled
# signature is one file, which is written under another name and then renamed: processes
# and users may share the folder.

_NUMBA: Any = numba
_RESULT: Any = compiler.CompileResult
_dumps: Any = serialize.dumps  # what numba's own cache uses, too

#: Size of the folder above which the kernels go that nobody has used for longest.
MAX_BYTES = 256 * 2**20
_USER_CACHES = {"win32": "~/AppData/Local", "darwin": "~/Library/Caches"}
_DAY = 86400.0
_DIGEST = hashlib.sha256().digest_size
_listeners: list[Callable[[], object]] = []


@contextlib.contextmanager
def on_compilation(notify: Callable[[], object]) -> Iterator[None]:
    """Call a function whenever a kernel must be compiled in the block.

    It is called before the compilation, and not for kernels that are loaded.
    """
    _listeners.append(notify)
    try:
        yield
    finally:
        _listeners.remove(notify)


def cache_folder() -> Path:
    """Return the folder of compiled kernels.

    It is ``slamgym`` in ``NUMBA_CACHE_DIR``, if that is set, else in the user's cache
    folder: ``XDG_CACHE_HOME``, or ``~/.cache`` and its like.  The path begins with
    ``~`` for a user without a home.
    """
    chosen = _NUMBA.config.CACHE_DIR
    if chosen:
        return Path(chosen).absolute() / "slamgym"
    usual = _USER_CACHES.get(sys.platform, "~/.cache")
    base = os.environ.get("XDG_CACHE_HOME") or usual
    return Path(os.path.expanduser(base)) / "slamgym"


class KernelCache:
    """The cache of one kernel, in the form that numba's dispatchers ask for.

    Parameters
    ----------
    kernel : dispatcher
        The function, decorated by numba.
    """

    def __init__(self, kernel: Any) -> None:
        self._kernel = kernel

    @property
    def cache_path(self) -> str:
        """The folder, for numba's statistics."""
        return str(cache_folder())

    def flush(self) -> None:
        """Do nothing: no file can be out of date."""

    @cached_property
    def _fingerprint(self) -> str | None:
        """Computed at the first call, when all that the kernel calls is defined."""
        try:
            return code_fingerprint(self._kernel)
        except UnknownValueError:
            return None

    def load_overload(self, signature: Any, target_context: Any) -> Any:
        """Return the compiled code for the types of a call, or None."""
        found = self._loaded(signature, target_context)
        if found is None:
            for notify in tuple(_listeners):
                notify()
        return found

    def _loaded(self, signature: Any, target_context: Any) -> Any:
        if self._fingerprint is None:
            return None
        rtsys.initialize(target_context)
        name = self._file_name(signature, target_context.codegen())
        for folder in (cache_folder(), _private_folder()):
            content = _read(folder / name) if folder else None
            if content:
                with contextlib.suppress(ImportError, AttributeError):  # a type moved
                    known, result = pickle.loads(content)
                    if known == signature:
                        return _RESULT._rebuild(target_context, *result)
        return None

    def save_overload(self, signature: Any, result: Any) -> None:
        """Keep the compiled code for the types of a call.

        Raises
        ------
        TypeError
            If the kernel does not count references, but returns an array, whose memory
            a caller would free, or gets one from a kernel that counts them, which
            nobody would free.
        """
        uncounted = not self._kernel.targetoptions["_nrt"]
        if uncounted and any("array" in str(each) for each in _handed_on(result)):
            self._kernel._reset_overloads()  # another call is refused, too
            raise TypeError(f"{self._kernel} hands on arrays: use njit_allocating")
        if self._fingerprint is None:
            return
        if result.library.has_dynamic_globals or result.lifted:
            return  # it holds addresses in the memory of this process
        name = self._file_name(signature, result.codegen)
        _save(name, _dumps((signature, result._reduce())))

    def _file_name(self, signature: Any, codegen: Any) -> str:
        machine = codegen.magic_tuple()  # the processor and what it can do
        key = f"{self._fingerprint} {signature} {machine}".encode()
        function = self._kernel.py_func
        readable = f"{function.__module__}.{function.__name__}".rpartition("slamgym.")
        return f"{readable[2]}-{hashlib.sha256(key).hexdigest()[:32]}.nbc"


def _handed_on(result: Any) -> Iterator[Any]:
    """Return the types of what a kernel returns, and of what others return to it."""
    yield result.signature.return_type
    types_of = result.type_annotation
    for call, signature in types_of.calltypes.items():
        if getattr(call, "op", None) != "call":
            continue
        if isinstance(types_of.typemap[call.func.name], types.Dispatcher):
            yield signature.return_type


def _read(file: Path) -> bytes | None:
    """Return a file's content if it is there and whole, and note that it is in use."""
    try:
        content = file.read_bytes()
        if time.time() - file.stat().st_mtime > _DAY:
            with contextlib.suppress(OSError):  # of another user
                os.utime(file)
    except OSError:
        return None
    digest, content = content[:_DIGEST], content[_DIGEST:]
    return content if hashlib.sha256(content).digest() == digest else None


def _save(name: str, content: bytes) -> None:
    content = hashlib.sha256(content).digest() + content
    folder = cache_folder()
    try:
        if not folder.is_absolute():
            raise OSError("there is no such home")
        folder.mkdir(parents=True, exist_ok=True)
        _write(folder / name, content)
    except OSError as error:
        reason = f"{folder} cannot be written ({error.strerror or error})"
        with contextlib.suppress(OSError):
            _save_privately(name, content, reason)
    else:
        _sweep_once(folder)


def _save_privately(name: str, content: bytes, reason: str) -> None:
    private = _private_folder() or _make_private_folder()
    if private is None:
        _warn_once(f"{reason}: every process compiles anew; set NUMBA_CACHE_DIR")
        return
    _warn_once(f"{reason}: they go to {private}; NUMBA_CACHE_DIR names another folder")
    _write(private / name, content)


@cache
def _warn_once(reason: str) -> None:
    text = f"the folder of compiled kernels {reason}"
    warnings.warn(text, RuntimeWarning, stacklevel=2)


def _write(file: Path, content: bytes) -> None:
    temporary = file.with_name(f"{uuid.uuid4().hex}.tmp")
    try:
        temporary.write_bytes(content)
        temporary.replace(file)
    except BaseException:
        with contextlib.suppress(OSError):
            temporary.unlink()
        raise


def _private_path() -> Path:
    user = os.getuid() if hasattr(os, "getuid") else "kernels"
    return Path(tempfile.gettempdir()) / f"slamgym-{user}"


def _private_folder() -> Path | None:
    """Return this user's temporary folder, if it exists and no one else owns it."""
    path = _private_path()
    try:
        state = path.lstat()
    except OSError:
        return None
    if not hasattr(os, "getuid"):  # Windows: a user's own temporary folder
        return path
    ours = state.st_uid == os.getuid() and state.st_mode & 0o170077 == 0o040000
    return path if ours else None


def _make_private_folder() -> Path | None:
    with contextlib.suppress(OSError):
        _private_path().mkdir(mode=0o700)
    return _private_folder()


@cache
def _sweep_once(folder: Path) -> None:
    """Delete what was unused for longest, once per process, if it is too much.

    A process that has loaded a kernel does not need its file any more, and one that
    misses a file compiles the kernel again.
    """
    files = sorted(_states(folder), reverse=True)
    total = 0
    for used, size, file in files:
        total += size
        abandoned = file.suffix == ".tmp" and time.time() - used > _DAY
        if total > MAX_BYTES or abandoned:
            with contextlib.suppress(OSError):
                file.unlink()


def _states(folder: Path) -> Iterator[tuple[float, int, Path]]:
    for file in folder.glob("*.*"):
        with contextlib.suppress(OSError):  # deleted by another process meanwhile
            state = file.stat()
            yield state.st_mtime, state.st_size, file


# --------------------------------------------------------------------------------------
# Identify what a kernel computes by all code and constants that go into it.
#
# The loaded code counts, not files: dates, folders and edits after the import play no
# part.  Two checkouts with equal kernels have equal fingerprints.

#: Named, with the versions of numba and numpy; not followed into their sources.
LIBRARIES = {"builtins", "math", "numba", "numpy"}

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
                    yield from self._global(getattr(value, name), names)


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
