"""Compilation of kernels: ``@njit`` with a cache that cannot go stale.

A plain file cache detects edits to the file that defines a function, but not edits to other files whose
functions the function calls. Therefore the cache folder (:mod:`skinnode.compiled.kernel_cache`) is named
after a digest of every file that contains kernels: an edit to any of these files recompiles all kernels. The
cache folder is created in the first writable location among ``$SKINNODE_CACHE_DIR``, the user's cache folder
and the system's temporary folder. If no location is writable, kernels are not cached.

With ``error_model="numpy"``, a division by zero yields inf instead of raising an exception. With ``nogil``, a
thread pool can solve several patches at the same time. ``fastmath`` is off because results must not depend on
how a compiler reorders sums.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import llvmlite
import numba as typed_numba

from skinnode.compiled.kernel_cache import SUFFIX, KernelCache

numba: Any = typed_numba  # numba's type hints lack the configuration and options used here
_F = TypeVar("_F", bound=Callable[..., Any])
_KERNEL_FILES = (
    "compiled/*.py",
    "model/kernels.py",
    "solve/*.py",
    "solve/*/*.py",
    "bus_load/stuffing.py",
    "host/code_runs.py",
)


def _writable(folder: Path) -> bool:
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        if folder.stat().st_uid != os.getuid():  # never load another user's compiled code
            return False
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError:
        return False


@functools.cache
def cache_dir() -> Path | None:
    """Return the folder for compiled kernels, or None if no folder is writable."""
    package = Path(__file__).parents[1]
    digest = hashlib.sha256(f"{numba.__version__} {llvmlite.__version__}".encode())
    for pattern in _KERNEL_FILES:
        for file in sorted(package.glob(pattern)):
            digest.update(file.read_bytes())
    leaf = f"numba-{digest.hexdigest()[:16]}"
    roots = [os.environ.get("SKINNODE_CACHE_DIR"), os.environ.get("XDG_CACHE_HOME")]
    candidates = [Path(root) / "skinnode" / leaf for root in roots if root]
    with contextlib.suppress(RuntimeError):  # no home directory
        candidates.append(Path.home() / ".cache" / "skinnode" / leaf)
    with contextlib.suppress(OSError):  # no temporary folder
        candidates.append(Path(tempfile.gettempdir()) / f"skinnode-{os.getuid()}" / leaf)
    return next((folder for folder in candidates if _writable(folder)), None)


def is_cold(kernel: str = "solve_patch") -> bool:
    """Return whether ``kernel`` still has to be compiled.

    Commands use this function to explain a slow start.
    """
    folder = cache_dir()
    return folder is None or not any(folder.glob(f"*.{kernel}-*{SUFFIX}"))


_OPTIONS = {"nogil": True, "error_model": "numpy", "_nrt": False}


def njit_part(function: _F) -> _F:
    """Compile ``function`` for calls from other kernels only; its code is cached with its callers' code.

    Python cannot call the compiled function. Omitting the Python entry point saves a fifth of the compile
    time.
    """
    compiled: _F = numba.njit(no_cpython_wrapper=True, no_cfunc_wrapper=True, **_OPTIONS)(function)
    return compiled


def njit_body(function: _F) -> _F:
    """Inline ``function`` into the only kernel that calls it, before compilation.

    Compiling and linking ``function`` separately takes 50 % longer.
    """
    compiled: _F = numba.njit(inline="always", **_OPTIONS)(function)
    return compiled


def njit(function: _F) -> _F:
    """Compile ``function`` on its first call, and cache the compiled code in :func:`cache_dir`."""
    return _kept(function, nogil=True)


def njit_brief(function: _F) -> _F:
    """Compile ``function`` as :func:`njit` does, but hold the interpreter lock while it runs.

    Use this decorator for kernels that take about a microsecond. After releasing the lock, such a kernel
    could wait for the lock much longer than it runs.
    """
    return _kept(function, nogil=False)


def _kept(function: _F, *, nogil: bool) -> _F:
    compiled: _F = numba.njit(no_cfunc_wrapper=True, **_OPTIONS | {"nogil": nogil})(function)
    folder = cache_dir()
    if folder is not None and compiled is not function:  # if NUMBA_DISABLE_JIT is set, nothing is compiled
        compiled._cache = KernelCache(function, folder)  # type: ignore[attr-defined]
    return compiled
