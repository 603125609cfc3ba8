"""Decorators that compile kernels and cache them without risking stale code.

Numba's own cache does not notice changes in other files whose functions a kernel calls. The name of the cache
folder (:mod:`skinnode.compiled.kernel_cache`) therefore contains a digest of all files with kernels; a change
in any of them causes all kernels to be recompiled. The folder is created in ``$SKINNODE_CACHE_DIR``, in the
user's cache folder or in the system's temporary folder, whichever is writable first. If none is writable,
kernels are not cached.

Kernels are compiled with ``error_model="numpy"``, so that division by zero yields inf instead of raising an
exception. Most are also compiled with ``nogil``, so that several threads can solve patches in parallel.
``fastmath`` is off, because it would allow the compiler to reorder sums.
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

numba: Any = typed_numba  # Any, because numba's type hints lack options used here
_F = TypeVar("_F", bound=Callable[..., Any])
_KERNEL_FILES = (
    "compiled/*.py",
    "model/kernels.py",
    "solve/*.py",
    "solve/*/*.py",
    "solve/posterior/local/*.py",
    "solve/posterior/past/*.py",
    "bus_load/stuffing*.py",
    "host/repeated_codes.py",
)


def _writable(folder: Path) -> bool:
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        if folder.stat().st_uid != os.getuid():  # do not load another user's compiled code
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
    """Return whether ``kernel`` is missing from the cache and will be compiled on its first call.

    In this case, commands print a notice that the start will be slow.
    """
    folder = cache_dir()
    return folder is None or not any(folder.glob(f"*.{kernel}-*{SUFFIX}"))


_OPTIONS = {"nogil": True, "error_model": "numpy", "_nrt": False}


def njit_part(function: _F) -> _F:
    """Compile ``function`` for use by other kernels; it is cached as part of their code.

    Python cannot call the compiled function. Omitting the Python entry point shortens compilation by a fifth.
    """
    compiled: _F = numba.njit(no_cpython_wrapper=True, no_cfunc_wrapper=True, **_OPTIONS)(function)
    return compiled


def njit_body(function: _F) -> _F:
    """Inline ``function`` into the kernel that calls it; for functions with a single caller.

    Compiling and linking it separately would take 50 % longer.
    """
    compiled: _F = numba.njit(inline="always", **_OPTIONS)(function)
    return compiled


def njit(function: _F) -> _F:
    """Compile ``function`` on its first call, and cache the compiled code in :func:`cache_dir`."""
    return _kept(function, nogil=True)


def njit_brief(function: _F) -> _F:
    """Compile ``function`` like :func:`njit`, but keep the interpreter lock (GIL) while it runs.

    This decorator is for kernels that run for about a microsecond. Acquiring the lock again after such a
    kernel could take much longer than the kernel itself.
    """
    return _kept(function, nogil=False)


def _kept(function: _F, *, nogil: bool) -> _F:
    compiled: _F = numba.njit(no_cfunc_wrapper=True, **_OPTIONS | {"nogil": nogil})(function)
    folder = cache_dir()
    if folder is not None and compiled is not function:  # equal if NUMBA_DISABLE_JIT is set
        compiled._cache = KernelCache(function, folder)  # type: ignore[attr-defined]
    return compiled
