"""File cache of compiled kernels that verifies each file before use.

Numba's own file cache unpickles any file that it finds. A truncated file therefore causes an exception in the
first call to a kernel on every run, and machine code with a flipped bit is executed. In numba's cache, all
signatures of a function share one index file. Two processes that compile different signatures at the same
time can therefore store the code of one signature under the name of the other.

In this cache, each compiled signature has its own file, which contains a magic number, the SHA-256 of the
payload, and the payload itself. The file name contains a digest of all inputs of the compilation, so no
index is needed. Files are written under a temporary name and renamed. If a file fails verification, it is
removed, the kernel is recompiled, and one line is logged. One line is also logged if a kernel cannot be
cached. Cache errors never reach the caller.
"""

from __future__ import annotations

import contextlib
import fcntl
import functools
import hashlib
import inspect
import logging
import os
import pickle
import shutil
import stat
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Final

from numba.core import compiler, serialize

from skinnode.files.whole_file import replace_file

_numba_compiler: Any = compiler  # neither module has type hints
_numba_serialize: Any = serialize
_MAGIC: Final = b"skinnode kernel 1\n"
_HEAD_BYTES: Final = len(_MAGIC) + hashlib.sha256().digest_size
SUFFIX: Final = ".nbc"

_log = logging.getLogger(__name__)
_reported: set[str] = set()


class KernelCache:
    """Cache of the compiled signatures of a function.

    Replaces ``numba.core.caching.FunctionCache`` as the ``_cache`` of a dispatcher.

    Args:
        function: The Python function.
        folder: Folder for the cache files.
    """

    def __init__(self, function: Callable[..., Any], folder: Path) -> None:
        code = function.__code__
        file = inspect.getfile(function)
        self._folder = folder
        self._stem = f"{Path(file).stem}.{function.__qualname__}-{code.co_firstlineno}"
        # the path of the file is omitted, so that all installations of the same code share their kernels
        self._source = (sys.implementation.cache_tag, _file_digest(file), code.co_code.hex())

    @property
    def cache_path(self) -> str:
        """Path of the cache folder; numba's statistics read this property."""
        return str(self._folder)

    def load_overload(self, signature: Any, target_context: Any) -> Any:
        """Return the compiled code of ``signature``, or None if there is no usable file."""
        target_context.refresh()
        path = self._path(signature, target_context.codegen())
        try:
            payload = _read(path)
        except FileNotFoundError:
            return None
        except (OSError, ValueError):
            _heal(self._folder)
            return None
        try:
            kept_signature, parts = pickle.loads(payload)
            return (
                _numba_compiler.CompileResult._rebuild(target_context, *parts)
                if kept_signature == signature
                else None
            )
        except Exception as error:  # an intact file that another installation has written
            if _remove(path):
                _report(
                    self._folder, f"a file could not be loaded ({error!r:.200}) and was removed; recompiling"
                )
            return None

    def save_overload(self, signature: Any, compiled: Any) -> None:
        """Write ``compiled`` to the cache if possible."""
        if compiled.lifted or compiled.library.has_dynamic_globals:  # numba's cache excludes these too
            return
        path = self._path(signature, compiled.codegen)
        try:
            _write(path, _numba_serialize.dumps((signature, compiled._reduce())))
        except OSError as error:
            reason = error.strerror or type(error).__name__
            _report(
                self._folder,
                f"a compiled kernel could not be cached ({reason}); it is recompiled at the next start",
            )

    def enable(self) -> None:
        """Do nothing: the cache is always enabled."""

    def disable(self) -> None:
        """Do nothing: the cache is always enabled."""

    def flush(self) -> None:
        """Do nothing: a recompiled kernel replaces its file."""

    def _path(self, signature: Any, codegen: Any) -> Path:
        depends_on = repr((self._source, signature, codegen.magic_tuple()))
        digest = hashlib.sha256(depends_on.encode()).hexdigest()[:24]
        return self._folder / f"{self._stem}.{digest}{SUFFIX}"


@functools.cache
def _file_digest(file: str) -> str:
    return hashlib.sha256(Path(file).read_bytes()).hexdigest()


def _read(path: Path) -> bytes:
    """Return the payload of a file. Raises OSError if the file is unreadable, ValueError if it is damaged."""
    if not stat.S_ISREG(path.stat().st_mode):  # reading a named pipe could block forever
        raise ValueError("not a file")
    data = path.read_bytes()
    payload = data[_HEAD_BYTES:]
    if data[:_HEAD_BYTES] != _MAGIC + hashlib.sha256(payload).digest():
        raise ValueError("not a kernel file, or damaged")
    return payload


def _write(path: Path, payload: bytes) -> None:
    replace_file(path, _MAGIC + hashlib.sha256(payload).digest() + payload)


def _heal(folder: Path) -> None:
    """Remove all damaged files in ``folder`` together, so that one log line reports them.

    If several processes find the damage, only the first removes and reports the files.
    """
    with _locked(folder):
        files = list(folder.glob(f"*{SUFFIX}"))
        damaged = [file for file in files if _is_damaged(file)]
        removed = sum(map(_remove, damaged))
    if removed:
        _report(folder, f"{removed} of {len(files)} files were damaged and have been removed; recompiling")
    elif damaged:
        _report(
            folder,
            f"{len(damaged)} of {len(files)} files are damaged and cannot be removed; they are not used",
        )


def _is_damaged(file: Path) -> bool:
    try:
        _read(file)
    except FileNotFoundError:
        return False
    except (OSError, ValueError):
        return True
    return False


def _remove(path: Path) -> bool:
    try:
        path.unlink()
    except FileNotFoundError:  # another process removed it
        return False
    except OSError:  # possibly a folder
        shutil.rmtree(path, ignore_errors=True)
        return not path.exists()
    return True


@contextlib.contextmanager
def _locked(folder: Path) -> Iterator[None]:
    try:
        descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    except OSError:
        yield
        return
    try:
        with contextlib.suppress(OSError):  # some network file systems cannot lock folders
            fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)


def _report(folder: Path, what: str) -> None:
    """Log the message ``what`` once per process and folder, so that a full disk produces only one line."""
    kind = f"{folder} {what[:1].isdigit()}"
    if kind not in _reported:
        _reported.add(kind)
        _log.warning("kernel cache %s: %s", folder, what)
