"""Compile numerical kernels with numba, and keep them on disk.

Each decorator leaves a function of plain scalars and arrays that also runs as plain
Python: ``NUMBA_DISABLE_JIT=1`` turns compilation off, for a debugger.
"""

import contextlib
import ctypes
import gc
import hashlib
import os
import re
import shutil
import sys
import tempfile
import warnings
from collections.abc import Callable, Iterator, Mapping
from functools import cache, cached_property, partial
from pathlib import Path
from types import FunctionType
from typing import Any, TypeVar, cast

import numba
import numpy as np
from numba import config, njit, types
from numba.core import caching, codegen, compiler, event, registry, sigutils
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
    """Compile a function that only kernels call, in less time.

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


class InternalCode(codegen.JITCodeLibrary):
    """Code of a function that only kernels call, without machine code of its own.

    A kernel contains the code of all functions below it, optimised together.  To
    optimise each of these functions by itself, too, would take longer.
    """

    def _optimize_final_module(self) -> None:
        pass

    def _finalize_specific(self) -> None:
        pass

    def serialize_using_object_code(self) -> Any:
        """Return what the cache keeps."""
        return cast("Any", self).serialize_using_bitcode()


class InternalCodegen(codegen.JITCPUCodegen):
    """Numba's code generator, of functions that only kernels call."""

    _library_class = InternalCode

    def _add_module(self, _module: Any) -> None:
        pass

    def set_env(self, _name: str, _environment: Any) -> None:
        """Do nothing: a `KernelCache` sets those of all functions below a kernel."""


@cache
def _internal_target() -> Any:
    """Return numba's target, with another code generator."""
    generator: Any = InternalCodegen
    target = registry.cpu_target.target_context
    return target.subtarget(_internal_codegen=generator("internal"))


class Checked(compiler.Compiler):
    """Numba's compiler, which refuses a kernel that loses count of references."""

    def compile_extra(self, function: FunctionType) -> Any:
        """Compile a function.

        Raises
        ------
        TypeError
            If the kernel does not count references, but returns an array, whose memory
            a caller would free, or receives one from a kernel that counts them, whose
            memory would never be freed.
        """
        compiled: Any = super()
        with _rarely_collecting():
            result = compiled.compile_extra(function)
        uncounted = not cast("Any", self).state.flags.nrt
        if uncounted and any("array" in str(each) for each in _handed_on(result)):
            name = function.__qualname__
            raise TypeError(f"{name} hands on arrays: use njit_allocating")
        return result


@contextlib.contextmanager
def _rarely_collecting() -> Iterator[None]:
    """Look for cyclic garbage rarely in the block; it takes a tenth of a compilation.

    Without any look, the largest kernels would need two thirds more memory.
    """
    usual = gc.get_threshold()
    if usual[0]:  # else the program never looks
        gc.set_threshold(max(usual[0], 50_000), *usual[1:])
    try:
        yield
    finally:
        gc.set_threshold(*usual)


class Internal(Checked):
    """The compiler of a function that only kernels call."""

    def __init__(self, typing: Any, _target: Any, *others: Any) -> None:
        cast("Any", super()).__init__(typing, _internal_target(), *others)


def _handed_on(result: Any) -> Iterator[Any]:
    """Return the types of what a kernel returns, and of what others return to it."""
    yield result.signature.return_type
    types_of = result.type_annotation
    for call, signature in types_of.calltypes.items():
        if getattr(call, "op", None) != "call":
            continue
        if isinstance(types_of.typemap[call.func.name], types.Dispatcher):
            yield signature.return_type


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
    return cast("Kernel", kept(njit(**options, **compiler_for(options))(function)))


def compiler_for(options: Mapping[str, Any]) -> dict[str, Any]:
    """Return the option of numba for its compiler, by those of a function."""
    # The order of sums is chosen once, in the function's own code.
    is_internal = options.get("no_cpython_wrapper") and not options.get("fastmath")
    return {"pipeline_class": Internal if is_internal else Checked}


def kept(kernel: Any) -> Any:
    """Keep a kernel in the cache, and compile it once for types that `plain` unites."""

    def of_variables(args: Any, kws: Any) -> Any:
        named = {name: plain(value) for name, value in kws.items()}
        return type(kernel).get_call_template(kernel, tuple(map(plain, args)), named)

    if hasattr(kernel, "py_func"):  # else compilation is turned off
        kernel._cache = KernelCache(kernel)
        kernel.get_call_template = of_variables
    return kernel


def plain(kind: Any) -> Any:
    """Return the type for which a kernel is compiled.

    Constants count as variables, and read-only arrays as others: no kernel writes into
    an array that a caller passes as read-only.  Plain Python refuses that.
    """
    known: Any = types
    if isinstance(kind, types.BaseAnonymousTuple):
        return known.BaseTuple.from_types([*map(plain, cast("Any", kind))])
    if isinstance(kind, types.Array) and not kind.mutable:
        return kind.copy(readonly=False)
    return known.unliteral(kind)


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
# Keep compiled kernels on disk, in numba's own cache.  It does not notice an edit in
# another file.  Therefore, each state of the sources has its own folder.

#: Parts of the package that contain kernels, or values that kernels read.
SOURCES = (
    *("jit.py", "kernel_variants.py", "arrays.py"),
    *("agents", "envs", "estimator", "evaluation"),
    "experiments/logs/decimals.py",
)
#: Number of states of the sources whose kernels are kept; about 50 MB each.
KEPT_STATES = 8
_STATE = re.compile("[0-9a-f]{16}")  # the name of its folder
_UNRELATED = ("NUMBA_CACHE_", "NUMBA_DEBUG_", "NUMBA_NUM_THREADS")
_USER_CACHES = {"win32": "~/AppData/Local", "darwin": "~/Library/Caches"}


@contextlib.contextmanager
def on_compilation(notify: Callable[[], object]) -> Iterator[None]:
    """Call a function whenever a kernel must be compiled in the block.

    It is called before the compilation, and not for kernels that are loaded.
    """

    class Listener(event.Listener):
        def on_start(self, _event: Any) -> None:
            notify()

        def on_end(self, _event: Any) -> None:
            pass

    with event.install_listener("numba:compile", Listener()):
        yield


def digest_of_sources() -> str:
    """Return a digest of everything that determines the machine code of the kernels.

    It covers the source code, the versions of Python, numba and numpy, and numba's
    environment variables.
    """
    digest = hashlib.sha256(
        f"{sys.version} {numba.__version__} {np.__version__}".encode()
    )
    for name, value in sorted(os.environ.items()):
        if name.startswith("NUMBA_") and not name.startswith(_UNRELATED):
            digest.update(f"{name}={value}".encode())
    home = Path(__file__).parent
    for file in _source_files():
        digest.update(f"{file.relative_to(home)}".encode())
        digest.update(file.read_bytes())
    return digest.hexdigest()[:16]


def _source_files() -> Iterator[Path]:
    for place in (Path(__file__).parent / part for part in SOURCES):
        files = [place] if place.is_file() else sorted(place.rglob("*.py"))
        yield from filter(Path.is_file, files)  # no link of an editor


def _stamp(file: Path) -> tuple[int, int, int]:
    """Return what every write to a file changes."""
    state = file.stat()
    return state.st_ctime_ns, state.st_mtime_ns, state.st_size


_STAMPS = {file: _stamp(file) for file in _source_files()}
_DIGEST = digest_of_sources()  # at import: later edits are not in this process


@cache
def cache_folder() -> Path | None:
    """Return the folder of compiled kernels, or None if they cannot be kept.

    The folder is in ``slamgym`` in ``NUMBA_CACHE_DIR``, if that is set, else in the
    user's cache folder: ``XDG_CACHE_HOME``, or the default of the system, such as
    ``~/.cache``.  If it cannot be written, a temporary folder of the user replaces it.
    Machine code that another user could have written is never loaded.
    """
    usual = os.environ.get("XDG_CACHE_HOME") or _USER_CACHES.get(
        sys.platform, "~/.cache"
    )
    chosen = getattr(config, "CACHE_DIR", "")
    root = Path(chosen or os.path.expanduser(usual)) / "slamgym"
    root = root if root.parts[0].startswith("~") else root.absolute()
    user = os.getuid() if hasattr(os, "getuid") else "kernels"
    temporary = Path(tempfile.gettempdir()) / f"slamgym-{user}"
    is_known = temporary.exists()
    problem = _problem_with(root / _DIGEST)
    if not problem:
        _forget_old_states(root)
        return root / _DIGEST
    _forget_old_states(temporary)
    if _problem_with(temporary) or _problem_with(temporary / _DIGEST):
        _warn(f"{problem}: every process compiles again; set NUMBA_CACHE_DIR")
        return None
    if not is_known:
        _warn(f"{problem}: {temporary} replaces it; NUMBA_CACHE_DIR sets another one")
    return temporary / _DIGEST


def _problem_with(folder: Path) -> str:
    """Make a folder that only this user can enter; return why it cannot be used."""
    try:
        if str(folder).startswith("~"):
            raise OSError("the home folder is unknown")
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        state = folder.lstat()
    except OSError as error:
        return f"{folder} cannot be written ({error.strerror or error})"
    is_private = state.st_mode & 0o170077 == 0o040000
    if hasattr(os, "getuid") and not (is_private and state.st_uid == os.getuid()):
        return f"{folder} can be written by others"
    with contextlib.suppress(OSError):  # it may be read only
        os.utime(folder)
    return ""


def _warn(problem: str) -> None:
    text = f"the folder of compiled kernels {problem}"
    warnings.warn(text, RuntimeWarning, stacklevel=2)


def _forget_old_states(root: Path) -> None:
    """Delete the kernels of all states of the sources, except those used last.

    A process that has loaded a kernel no longer needs its file.  A process that does
    not find a file compiles the kernel again.
    """
    with contextlib.suppress(OSError):  # another process deletes them, too
        states = [each for each in root.iterdir() if _STATE.fullmatch(each.name)]
        states.sort(key=lambda state: state.stat().st_mtime)
        for state in states[:-KEPT_STATES]:
            shutil.rmtree(state, ignore_errors=True)


class _Locator:
    """Give numba the folder of a kernel's files, and what distinguishes their names."""

    def __init__(self, function: FunctionType) -> None:
        self._module = function.__module__

    @classmethod
    def from_function(cls, function: Any, _file: str) -> "_Locator":
        return cls(function)

    def get_cache_path(self) -> str:
        return str(cache_folder())

    def ensure_cache_path(self) -> None:
        cache_folder()

    def get_source_stamp(self) -> str:
        return _DIGEST

    def get_disambiguator(self) -> str:
        return self._module.rpartition("slamgym.")[2]


class _Results(caching.CompileResultCacheImpl):
    _locator_classes: Any = (_Locator,)

    def rebuild(self, target: Any, payload: Any) -> Any:
        (_, kind, _), *_ = payload
        target = _internal_target() if kind == "bitcode" else target
        return cast("Any", super()).rebuild(target, payload)


class _Files(caching.FunctionCache):
    _impl_class = _Results


class KernelCache:
    """The cache of one kernel, in the form that numba's dispatchers ask for.

    Parameters
    ----------
    kernel : dispatcher
        The function, decorated by numba.
    """

    def __init__(self, kernel: Any) -> None:
        self._kernel = kernel

    @cached_property
    def _files(self) -> Any:
        """Numba's own cache; None for a kernel that is not kept."""
        function = self._kernel.py_func
        is_ours = function.__module__.startswith("slamgym.")
        is_elsewhere = getattr(config, "CACHE_LOCATOR_CLASSES", "")
        if not is_ours or is_elsewhere or function.__closure__ or not cache_folder():
            return None
        return cast("Any", _Files)(function)

    @property
    def cache_path(self) -> str:
        """The folder, for numba's statistics."""
        return str(cache_folder())

    def flush(self) -> None:
        """Do nothing: no file can be out of date."""

    def load_overload(self, signature: Any, target: Any) -> Any:
        """Return the compiled code for the types of a call, or None."""
        arguments, _ = cast("Any", sigutils).normalize_signature(signature)
        usual = tuple(map(plain, arguments))
        if usual != arguments:
            self._kernel.compile(usual)
            result = self._kernel.overloads[usual]
            own = result.signature.replace(args=arguments)
            return result._replace(signature=own, metadata=None)
        if self._files is None:
            return None
        try:
            # Without loading numba's compiler, as `refresh` would do.
            quick = target.subtarget(refresh=partial(rtsys.initialize, target))
            found = self._files.load_overload(signature, quick)
        except Exception:  # a damaged file can raise any error
            found = None
            with contextlib.suppress(OSError):
                self._files.flush()
        # Two processes that compile for different types may write the same file.
        return found if found and found.signature.args == signature else None

    def save_overload(self, signature: Any, result: Any) -> None:
        """Keep the compiled code for the types of a call."""
        for each in result._find_referenced_environments():
            result.library.codegen.set_env(each.env_name, each)
        if self._files is None or result.library.has_dynamic_globals or result.lifted:
            return  # these hold addresses in the memory of this process
        # The folder may be read only, its files damaged, and the sources edited since
        # the import.
        with contextlib.suppress(Exception):
            if all(_stamp(file) == stamp for file, stamp in _STAMPS.items()):
                self._files.save_overload(signature, result)
