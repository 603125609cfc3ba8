"""File cache of compiled kernels that verifies each file before use.

Numba's own cache has two weaknesses. It loads any file that it finds: a truncated file causes an exception in
every run, and damaged machine code is executed. Moreover, all signatures of a function share one index file,
so two processes that compile different signatures at the same time may load each other's code.

This cache has a separate file for each compiled signature. The file contains a magic number, the SHA-256 of
the payload, and the payload. Its name contains a digest of all inputs to the compilation, so no index is
needed. Files are replaced atomically. A file that fails the check is removed, and the kernel is compiled
again. The removal of a file, or a failure to write one, is logged in one line; no exception reaches the
caller.
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
    """Cache of the compiled signatures of one function.

    It replaces ``numba.core.caching.FunctionCache`` as the ``_cache`` of a numba dispatcher.

    Args:
        function: The Python function.
        folder: Folder for the cache files.
    """

    def __init__(self, function: Callable[..., Any], folder: Path) -> None:
        code = function.__code__
        file = inspect.getfile(function)
        self._folder = folder
        self._stem = f"{Path(file).stem}.{function.__qualname__}-{code.co_firstlineno}"
        # excludes the file's path, so that installations of the same code share their kernels
        self._source = (sys.implementation.cache_tag, _file_digest(file), code.co_code.hex())

    @property
    def cache_path(self) -> str:
        """Path of the cache folder, for numba's statistics."""
        return str(self._folder)

    def load_overload(self, signature: Any, target_context: Any) -> Any:
        """Return the compiled code for ``signature``; None if there is no usable cache file.

        Numba's own cache first calls ``target_context.refresh()``. This loads modules that only the compiler
        needs, including scipy.linalg, and takes 0.2 s in every process. The compiler calls ``refresh()``
        itself.
        """
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
        except Exception as error:  # intact, but written by a different installation
            if _remove(path):
                _report(
                    self._folder, f"a file could not be loaded ({error!r:.200}) and was removed; recompiling"
                )
            return None

    def save_overload(self, signature: Any, compiled: Any) -> None:
        """Write the compiled code for ``signature`` to the cache, if possible."""
        if compiled.lifted or compiled.library.has_dynamic_globals:  # numba's own cache also excludes these
            return
        path = self._path(signature, compiled.codegen)
        try:
            _write(path, _numba_serialize.dumps((signature, compiled._reduce())))
        except OSError as error:
            reason = error.strerror or type(error).__name__
            _report(
                self._folder,
                f"a compiled kernel could not be cached ({reason}); it will be recompiled at the next start",
            )

    def enable(self) -> None:
        """Do nothing: the cache is always enabled."""

    def disable(self) -> None:
        """Do nothing: the cache is always enabled."""

    def flush(self) -> None:
        """Do nothing: a recompiled kernel overwrites its file."""

    def _path(self, signature: Any, codegen: Any) -> Path:
        depends_on = repr((self._source, signature, codegen.magic_tuple()))
        digest = hashlib.sha256(depends_on.encode()).hexdigest()[:24]
        return self._folder / f"{self._stem}.{digest}{SUFFIX}"


@functools.cache
def _file_digest(file: str) -> str:
    return hashlib.sha256(Path(file).read_bytes()).hexdigest()


def _read(path: Path) -> bytes:
    """Return the payload of a file. Raises OSError if it cannot be read, or ValueError if it is damaged."""
    if not stat.S_ISREG(path.stat().st_mode):  # opening a named pipe could block forever
        raise ValueError("not a file")
    data = path.read_bytes()
    payload = data[_HEAD_BYTES:]
    if data[:_HEAD_BYTES] != _MAGIC + hashlib.sha256(payload).digest():
        raise ValueError("not a kernel file, or damaged")
    return payload


def _write(path: Path, payload: bytes) -> None:
    replace_file(path, _MAGIC + hashlib.sha256(payload).digest() + payload)


def _heal(folder: Path) -> None:
    """Remove all damaged files in ``folder`` and log a single line about them.

    If several processes find damaged files at the same time, only one process removes and logs the files.
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
    """Log a warning about the cache, at most once per process, folder and kind of message."""
    kind = f"{folder} {what[:1].isdigit()}"
    if kind not in _reported:
        _reported.add(kind)
        _log.warning("kernel cache %s: %s", folder, what)
