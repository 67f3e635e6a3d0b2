"""Keep compiled kernels on disk, each under the fingerprint of its code.

Nothing here can be stale, so nothing is compared or deleted at import.  Each compiled
signature is one file, which is written under another name and then renamed: processes
and users may share the folder.
"""

import contextlib
import hashlib
import os
import pickle
import sys
import tempfile
import time
import uuid
import warnings
from collections.abc import Callable, Iterator
from functools import cache, cached_property
from pathlib import Path
from typing import Any

import numba
from numba.core import compiler, serialize

from .code_fingerprint import UnknownValueError, code_fingerprint

_NUMBA: Any = numba
_RESULT: Any = compiler.CompileResult
_dumps: Any = serialize.dumps  # what numba's own cache uses, too

MAX_BYTES = 256 * 2**20
"""Size of the folder above which the kernels go that nobody has used for longest."""
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
        self.enabled = True

    @property
    def cache_path(self) -> str:
        """The folder, for numba's statistics."""
        return str(cache_folder())

    def enable(self) -> None:
        """Use the folder."""
        self.enabled = True

    def disable(self) -> None:
        """Neither read nor write the folder."""
        self.enabled = False

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
        if not self.enabled or self._fingerprint is None:
            return None
        target_context.refresh()
        name = self._file_name(signature, target_context.codegen())
        for folder in (cache_folder(), _private_folder()):
            content = _read(folder / name) if folder else None
            if content:
                known, result = pickle.loads(content)
                if known == signature:
                    return _RESULT._rebuild(target_context, *result)
        return None

    def save_overload(self, signature: Any, result: Any) -> None:
        """Keep the compiled code for the types of a call."""
        if not self.enabled or self._fingerprint is None:
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
    """Return this user's temporary folder, if it is there and nobody else's."""
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
